"""Both codecs: what goes in comes out, bit for bit, and nothing else is ever taken."""

import math
import struct
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from golden import LAYOUTS, changed, fixed, messages
from hypothesis import given
from hypothesis import strategies as st
from links import ONE, close, command, hello, layout, state
from rotorgram.models.errors import InputError
from rotorgram.udp.protocol import binary, text
from rotorgram.udp.protocol.errors import DecodeError, VersionMismatch
from rotorgram.udp.protocol.layout import MAX_DRONES, ArrayLayout, Layout
from rotorgram.udp.protocol.messages import (
    Command,
    Hello,
    Message,
    Refuse,
    State,
    Welcome,
)

DTYPES = ("float32", "float64", "uint8", "int32", "int64")


@st.composite
def layouts(draw: st.DrawFn) -> Layout:
    lengths = st.integers(1, 3)
    shapes = st.lists(lengths, max_size=2).map(tuple)
    dtypes = st.sampled_from(DTYPES)
    arrays = st.builds(ArrayLayout, shape=shapes, dtype=dtypes)
    discrete = draw(st.booleans())
    drones = draw(st.integers(1, 5))
    observation = draw(st.lists(arrays, min_size=1, max_size=3))
    action = None
    choices = 0
    if discrete:
        choices = draw(st.integers(1, 9))
    else:
        action = draw(arrays)
    telemetry = draw(st.lists(shapes, max_size=3))
    return Layout(
        drones=drones,
        observation=tuple(observation),
        action=action,
        choices=choices,
        telemetry=tuple((shape, "") for shape in telemetry),
    )


def random_array(dice: np.random.Generator, dtype: np.dtype, shape: tuple[int, ...]) -> np.ndarray:
    if dtype.kind == "f":
        numbers = dice.normal(size=shape)
        scale = 10.0 ** dice.integers(-30, 30)
        return (numbers * scale).astype(dtype)
    return dice.integers(0, 200, shape).astype(dtype)


@given(layouts(), st.integers(0, 2**32))
def test_any_state_and_command_comes_back(of: Layout, seed: int) -> None:
    dice = np.random.default_rng(seed)
    n = of.drones
    observations = [random_array(dice, s.dtype, s.shape) for s in of.observation_slots]
    telemetry = [random_array(dice, s.dtype, s.shape) for s in of.telemetry_slots]
    sent = State(
        session=3,
        sequence=9,
        time=0.25,
        observations=tuple(observations),
        rewards=dice.normal(size=n),
        terminated=dice.random(n) < 0.5,
        truncated=dice.random(n) < 0.5,
        telemetry=tuple(telemetry),
    )
    assert_comes_back(sent, of, of.state.size)
    actions = random_array(dice, of.actions.dtype, of.actions.shape)
    if of.choices:
        actions %= of.choices
    orders = dice.integers(0, 3, n).astype(np.uint8)
    order = Command(session=3, sequence=9, actions=actions, orders=orders)
    assert_comes_back(order, of, of.commands[False, False].size)
    order.seeds = dice.integers(0, 2**64, n, np.uint64)
    assert_comes_back(order, of, of.commands[True, False].size)


def assert_comes_back(message: State | Command, of: Layout, size: int) -> None:
    data = binary.encode(message, of)
    back = binary.decode(data, of)
    assert len(data) == size
    assert type(back) is type(message)
    for field in fields(message):
        there = getattr(message, field.name)
        here = getattr(back, field.name)
        if isinstance(there, np.ndarray):
            assert not here.flags.writeable
        np.testing.assert_equal(here, there)
    assert binary.encode(back, of) == data


def test_any_flipped_bit_and_any_cut_is_seen() -> None:
    for _, env, message in messages():
        of = LAYOUTS[env]
        data = binary.encode(message, of)
        for bit in range(8 * len(data)):
            raw = bytearray(data)
            raw[bit // 8] ^= 1 << bit % 8
            with pytest.raises(DecodeError):
                binary.decode(bytes(raw), of)
        for end in range(len(data)):
            with pytest.raises(DecodeError):
                binary.decode(data[:end], of)
        with pytest.raises(DecodeError):
            binary.decode(data + b"\0", of)


@pytest.mark.parametrize("due", [state(7), command(7)])
def test_only_the_datagram_that_is_due_takes_the_short_way(due: Message) -> None:
    """Every value of every byte of the header, with and without a checksum made right."""
    data = binary.encode(due, ONE)
    session, sequence = struct.unpack_from("<QQ", data, 8)

    def read(datagram: bytes) -> Message | None:
        return binary.decode_due(data[3], datagram, session, sequence, ONE)

    taken = read(data)
    assert taken is not None
    assert binary.encode(taken, ONE) == data
    for at in range(24):
        for value in range(256):
            near = bytearray(data)
            near[at] = value
            taken = read(bytes(near))
            assert (taken is None) == (value != data[at])
            right = fixed(bytes(near))
            taken = read(right)
            assert (taken is None) == (right != data)
    for end in range(len(data)):
        assert read(data[:end]) is None
    body = data[24:]
    for wrong in (b"", body[:-1], body + b"\0"):  # with a right checksum
        datagram = binary.frame(data[3], session, sequence, wrong)
        assert read(datagram) is None


@given(st.binary(max_size=100), st.integers(0, 255), st.integers(0, 20))
def test_any_bytes_with_a_right_checksum_are_read_or_refused(
    body: bytes, kind: int, sequence: int
) -> None:
    data = binary.frame(kind, 1, sequence, body)
    try:
        message = binary.decode(data, ONE)
    except DecodeError:
        return
    if not isinstance(message, State | Command | Hello | Welcome):  # reserved bytes may differ
        again = binary.encode(message, ONE)
        assert binary.decode(again, ONE) == message


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("drones", [1, 1000])
def test_what_is_not_finite_does_not_travel(value: float, drones: int) -> None:
    of = layout(drones, 1, ((2,),))
    for change in ("observations", "rewards", "telemetry"):
        wrong = state(1, of=of)
        array = getattr(wrong, change)
        if change != "rewards":
            array = array[0]
        array.flat[-1] = value
        with pytest.raises(InputError, match="finite"):
            binary.encode(wrong, of)
    action = command(1, of=of)
    action.actions.flat[-1] = value
    with pytest.raises(InputError, match="finite"):
        binary.encode(action, of)
    data = binary.encode(state(1, of=of), of)
    at = of.state.slots[1].at
    number = struct.pack("<d", value)
    body = data[24:at] + number + data[at + 8 :]
    forged = binary.frame(4, 1, 1, body)
    with pytest.raises(DecodeError, match="finite"):
        binary.decode(forged, of)


def test_finite_numbers_whose_sum_is_not_travel() -> None:
    of = layout(1, 1, ((2,),))
    huge = state(1, of=of)
    huge.telemetry[0][:] = 1.7e308
    data = binary.encode(huge, of)
    back = binary.decode(data, of)
    assert isinstance(back, State)
    assert (back.telemetry[0] == 1.7e308).all()


def test_arrays_are_never_converted() -> None:
    of = layout(2, 2)
    order = command(1, of=of)
    for shape, dtype in (((2, 2), float), ((2, 3), np.float32), ((2, 2), complex)):
        order.actions = np.zeros(shape, dtype)
        with pytest.raises(InputError, match=r"expected float32 of shape \(2, 2\)"):
            binary.encode(order, of)


def test_a_discrete_action_is_checked_for_every_drone() -> None:  # fault 13
    of = Layout(drones=2, observation=(ArrayLayout(shape=()),), action=None, choices=3)
    wrong = command(1, of=of)
    for order in (0, 1, 2):
        wrong.orders[1] = order
        for action in (-1, 3):
            wrong.actions[1] = action
            with pytest.raises(InputError, match="a choice 0 to 2, got"):
                binary.encode(wrong, of)


def test_versions() -> None:
    data = binary.encode(hello())
    newer = changed(data, 2, b"\4")
    with pytest.raises(VersionMismatch, match="expected 3, got 4"):
        binary.decode(newer)
    refuse = Refuse(session=1, reason="x")
    data = binary.encode(refuse)
    newer = changed(data, 2, b"\4")
    assert binary.decode(newer) == refuse


def test_sizes_that_do_not_fit() -> None:
    for drones, size in ((MAX_DRONES + 1, 1), (MAX_DRONES, 300)):
        with pytest.raises(InputError, match="expected"):
            layout(drones, size)
    for change in ({"worlds": 0}, {"versions": (3, 2)}, {"spec": ""}):
        with pytest.raises(InputError, match="expected"):
            hello(**change)
    for reason in ("x" * 513, "a\nb"):
        with pytest.raises(InputError, match="expected"):
            close(1, reason=reason)


# ---- text

FLOATS = st.floats(allow_nan=False, allow_infinity=False)


@given(FLOATS, FLOATS, st.floats(width=32, allow_nan=False, allow_infinity=False), st.booleans())
def test_text_comes_back_bit_for_bit(reward: float, told: float, seen: float, flag: bool) -> None:
    of = layout(1, 1, ((2,), ()))
    sent = state(2**64 - 1, session=0, of=of)
    sent.observations[0][:] = seen
    sent.rewards[:] = reward
    sent.terminated[:] = flag
    sent.truncated[:] = not flag
    sent.telemetry[0][:] = told, -0.0
    sent.telemetry[1][:] = 1.5
    line = text.encode(sent, of)
    got = text.decode_state(line, of)
    assert isinstance(got, State)
    assert binary.encode(got, of) == binary.encode(sent, of)
    order = command(5, value=seen)
    line = text.encode(order)
    back = text.decode_command(line, ONE, 77)
    assert isinstance(back, Command)
    assert binary.encode(back, ONE) == binary.encode(order, ONE)


MATRIX = replace(ONE, observation=(ArrayLayout(shape=(2, 2)),))
BYTES = replace(ONE, observation=(ArrayLayout(shape=(2,), dtype="uint8"),))


@pytest.mark.parametrize("of", [layout(2), MATRIX, BYTES])
def test_layouts_that_text_cannot_tell(of: Any) -> None:
    with pytest.raises(InputError, match="text codec"):
        text.check_layout(of)


def test_text_is_in_the_paper_s_frame() -> None:
    """A craft at x 3 m, y -1 m, z 2 m; its nose points right, it climbs and turns to the left."""
    frames = ("world", "body to world", "world", "body", "world")
    shapes = ((3,), (4,), (3,), (3,), (2,))
    of = replace(ONE, telemetry=tuple(zip(shapes, frames, strict=True)))
    half = math.sqrt(0.5)
    sent = state(1, of=of)
    position, attitude, velocity, rates, other = sent.telemetry
    position[0] = (3.0, -1.0, 2.0)
    attitude[0] = (half, 0.0, 0.0, -half)
    velocity[0] = (0.0, 0.0, 0.5)
    rates[0] = (0.0, 0.0, 0.25)
    other[0] = (7.0, 8.0)
    line = text.encode(sent, of)
    fields = line.decode().split(",")
    numbers = [float(field) for field in fields[5:]]
    assert numbers[:3] == [1.0, 2.0, 3.0]  # right, up, forward
    assert numbers[3:6] == pytest.approx([0.0, 90.0, 0.0])
    assert numbers[6:9] == [0.0, 0.5, 0.0]
    assert numbers[9:12] == [0.0, -0.25, 0.0]  # left-handed: to the right is positive
    assert numbers[12:] == [7.0, 8.0]
    assert sum(text.telemetry_sizes(of)) == 14
    got = text.decode_state(line, of)
    assert isinstance(got, State)
    for there, back in zip(sent.telemetry, got.telemetry, strict=True):
        assert back == pytest.approx(there)


def of_numbers(count: int) -> Layout:
    """One drone whose line has so many numbers: the reward, three of observation, the telemetry."""
    observation = ArrayLayout(shape=(3,))
    return replace(ONE, observation=(observation,), telemetry=(((count - 4,), ""),))


def test_the_longest_line_is_known_at_the_start() -> None:  # fault 57
    of = of_numbers(47)
    text.check_layout(of)
    longest = -2.2250738585072014e-308
    sent = state(2**64 - 1, value=-1.1754944e-38, of=of)
    sent.rewards[:] = longest
    sent.telemetry[0][:] = longest
    line = text.encode(sent, of)
    assert 1175 < len(line) <= 1200
    with pytest.raises(InputError, match="lines of at most 1200 bytes, got up to 1224 with 48 num"):
        text.check_layout(of_numbers(48))


def test_a_hello_of_nothing_but_extensions_is_not_read() -> None:
    """Four bytes each: a million of them fit into a Hello, and take seconds."""
    start = struct.pack("<BB2xII4x", 2, 2, 1, 2) + b"{}"
    body = start + bytes(4 * 64)
    data = binary.frame(binary.HELLO, 1, 0, body)
    some = binary.decode(data)
    assert isinstance(some, Hello)
    assert len(some.extensions) == 64
    data = binary.frame(binary.HELLO, 1, 0, body + bytes(4))
    with pytest.raises(DecodeError, match="extensions: expected at most 64"):
        binary.decode(data)

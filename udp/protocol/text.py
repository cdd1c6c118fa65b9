"""The text codec: one drone, numbers separated by commas, at most 1,200 bytes of ASCII.

The paper's peers turn arrays of numbers into bytes and back (section 2.1). There is no Hello. The
grammar is in docs/protocol.md.

Numbers are written as float64 with the fewest digits that read back as the same bits; a float32
is written as the float64 of the same value. Telemetry is in the paper's frame.
"""

import re
from collections.abc import Callable, Iterable
from math import isfinite, prod

import numpy as np

from ...models.errors import InputError
from ...models.frames import (
    attitudes_in_paper_frame,
    positions_in_paper_frame,
    positions_in_world_frame,
    quaternions_in_world_frame,
)
from .errors import DecodeError
from .layout import Array, ArrayLayout, Layout
from .messages import FLY, MAX_UINT64, RESET, Close, Command, State

MAX_LINE = 1200
_LONGEST_NUMBER = 24  # bytes: -2.2250738585072014e-308
_FIXED = 24  # bytes of the longest sequence number and two flags, with their commas
_WHOLE = re.compile(r"0|[1-9][0-9]{0,19}")
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


def is_text(datagram: bytes) -> bool:
    """Whether a datagram can be a text message: every one begins with a digit."""
    return datagram[:1].isdigit()


def check_layout(layout: Layout) -> None:
    """Raise `InputError` if the messages of a layout cannot be written as text."""
    arrays = layout.observation
    action = layout.action
    if layout.drones != 1:
        raise InputError(f"text codec: expected one drone, got {layout.drones}: use binary")
    if [_is_flat(array) for array in arrays] != [True]:
        got = ", ".join(f"{array.dtype} of shape {array.shape}" for array in arrays)
        raise InputError(
            f"text codec: expected one flat array of float32 as observation, got {got}: use binary"
        )
    if not (action is None or _is_flat(action)):
        raise InputError(f"text codec: expected flat actions of float32, got {action}: use binary")
    state = 1 + arrays[0].shape[0] + sum(telemetry_sizes(layout))  # the reward is a number too
    longest = _FIXED + (_LONGEST_NUMBER + 1) * max(state, prod(layout.actions.shape))
    if longest > MAX_LINE:
        raise InputError(
            f"text codec: expected lines of at most {MAX_LINE} bytes, got up to {longest} with "
            f"{state} numbers: use binary"
        )


def _is_flat(array: ArrayLayout) -> bool:
    return len(array.shape) == 1 and array.dtype == "float32"


def telemetry_sizes(layout: Layout) -> list[int]:
    """Numbers of each array of telemetry in a line."""
    return [3 if one in _CONVERSIONS else prod(one[0]) for one in layout.telemetry]


def _converted(telemetry: Iterable[Array], layout: Layout, *, to_paper: bool) -> list[Array]:
    """The telemetry of one drone in the paper's frames, or from them."""
    converted = []
    for array, kind in zip(telemetry, layout.telemetry, strict=True):
        into, back = _CONVERSIONS.get(kind, (np.asarray, np.asarray))
        converted.append(into(array) if to_paper else back(array))
    return converted


_Conversion = Callable[[Array], Array]

_CONVERSIONS: dict[tuple[tuple[int, ...], str], tuple[_Conversion, _Conversion]] = {
    ((3,), "world"): (positions_in_paper_frame, positions_in_world_frame),
    ((4,), "body to world"): (attitudes_in_paper_frame, quaternions_in_world_frame),
    # The paper's axes are left-handed: rotations about them have the other sign.
    ((3,), "body"): (
        lambda rates: 0.0 - positions_in_paper_frame(rates),
        lambda rates: 0.0 - positions_in_world_frame(rates),
    ),
}
"""Telemetry by shape and frame: into the paper's frame, and back. Other telemetry stays as it is.
"""


def encode(message: State | Command | Close, layout: Layout | None = None) -> bytes:
    """One line, without its end; a State needs a layout.

    Raises `InputError` if it cannot be written.
    """
    match message:
        case State():
            flags = ["01"[message.terminated.item()], "01"[message.truncated.item()]]
            assert layout is not None
            telemetry = _converted(message.telemetry, layout, to_paper=True)
            arrays = (message.rewards, *message.observations, *telemetry)
            reward, *others = _numbers(arrays)
            fields = [reward, *flags, *others]
        case Command() if message.orders.item() == RESET:
            fields = ["reset"] if message.seeds is None else ["reset", str(message.seeds.item())]
        case Command():
            if message.orders.item() != FLY or message.asks is not None:
                raise InputError("text codec: expected an action or a reset, got another order")
            fields = _numbers([message.actions])
        case Close():
            fields = ["close"]
    return ",".join([str(message.sequence), *fields]).encode()


def _numbers(arrays: Iterable[Array]) -> list[str]:
    numbers = [number for array in arrays for number in array.ravel().tolist()]
    if not all(map(isfinite, numbers)):
        raise InputError(f"expected finite numbers, got {numbers}")
    return [repr(number) for number in numbers]


def decode_state(datagram: bytes, layout: Layout) -> State | Close:
    """A simulator's line, as of session 0. Raises `DecodeError` for anything else."""
    sequence, fields = split(datagram)
    if fields == ["close"]:
        return Close(session=0, sequence=sequence, reason="the simulator closed")
    observation = layout.observation_slots[0]
    size = observation.shape[1]
    sizes = telemetry_sizes(layout)
    expected = 3 + size + sum(sizes)
    if len(fields) != expected:
        raise DecodeError(
            f"state: expected {expected + 1} fields (sequence, reward, terminated, truncated, "
            f"{size} of observation, {sum(sizes)} of telemetry), got {len(fields) + 1}"
        )
    numbers = np.array([_floats("state: telemetry", fields[3 + size :])])
    telemetry = np.split(numbers, np.cumsum(sizes)[:-1], axis=1) if sizes else []
    converted = _converted(telemetry, layout, to_paper=False)
    slots = layout.telemetry_slots
    shaped = [array.reshape(slot.shape) for array, slot in zip(converted, slots, strict=True)]
    return State(
        session=0,
        sequence=sequence,
        time=0.0,
        rewards=np.array(_floats("state: reward", fields[:1])),
        terminated=np.array([_flag("state: terminated", fields[1])]),
        truncated=np.array([_flag("state: truncated", fields[2])]),
        observations=(_float32("state: observation", fields[3 : 3 + size]),),
        telemetry=tuple(shaped),
    )


def decode_command(datagram: bytes, layout: Layout, session: int) -> Command | Close:
    """An agent's line, taken as one of `session`. Raises `DecodeError` for anything else."""
    sequence, fields = split(datagram)
    if fields == ["close"]:
        return Close(session=session, sequence=sequence, reason="the agent closed")
    actions = layout.actions
    size = prod(actions.shape)
    reset = fields[0] == "reset"
    fits = len(fields) <= 2 if reset else len(fields) == size
    if not fits:
        raise DecodeError(
            f"command: expected sequence,reset[,seed] or sequence and {size} of action, "
            f"got {datagram[:80]!r}"
        )
    if reset:
        order = RESET
        action = actions.zeros()
    else:
        order = FLY
        action = _action(fields, layout)
    orders = np.array([order], np.uint8)
    command = Command(session=session, sequence=sequence, actions=action, orders=orders)
    if reset and len(fields) == 2:
        command.seeds = np.array([_whole("command: seed", fields[1])], np.uint64)
    return command


def _action(fields: list[str], layout: Layout) -> Array:
    if not layout.choices:
        return _float32("command: action", fields)
    choice = _whole("command: action", fields[0])
    most = layout.choices - 1
    if choice > most:
        raise DecodeError(f"command: action: expected a choice 0 to {most}, got {choice}")
    return np.array([choice])


def split(datagram: bytes) -> tuple[int, list[str]]:
    """Sequence number and the other fields of a line. Raises `DecodeError`."""
    if len(datagram) > MAX_LINE:
        raise DecodeError(f"text line: expected at most {MAX_LINE} bytes, got {len(datagram)}")
    try:
        line = datagram.decode("ascii").removesuffix("\n").removesuffix("\r")
    except UnicodeDecodeError:
        raise DecodeError("text line: expected ASCII") from None
    sequence, _, rest = line.partition(",")
    if not rest:
        raise DecodeError(f"text line: expected sequence,field..., got {line[:80]!r}")
    return _whole("text line: sequence", sequence), rest.split(",")


def _whole(name: str, field: str) -> int:
    number = int(field) if _WHOLE.fullmatch(field) else -1
    if not 0 <= number <= MAX_UINT64:
        raise DecodeError(f"{name}: expected a whole number below 2^64, got {field[:80]!r}")
    return number


def _flag(name: str, field: str) -> bool:
    if field not in ("0", "1"):
        raise DecodeError(f"{name}: expected 0 or 1, got {field[:80]!r}")
    return field == "1"


def _floats(name: str, fields: list[str]) -> list[float]:
    if not all(map(_NUMBER.fullmatch, fields)):
        raise DecodeError(f"{name}: expected decimal numbers, got {','.join(fields)[:80]!r}")
    return _finite(name, [float(field) for field in fields])


def _float32(name: str, fields: list[str]) -> Array:
    """Numbers of one drone, float32, shape (1, len(fields))."""
    with np.errstate(over="ignore", under="ignore"):  # independent of the program's settings
        array: Array = np.array([_floats(name, fields)]).astype(np.float32)
    _finite(name, array[0].tolist())
    return array


def _finite(name: str, numbers: list[float]) -> list[float]:
    if not all(map(isfinite, numbers)):
        raise DecodeError(f"{name}: expected finite numbers, got {numbers}")
    return numbers

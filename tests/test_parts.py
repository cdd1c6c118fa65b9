"""Messages in parts: cut, put together in any order, within bounds, over both links."""

import random
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rotorgram.udp import binary
from rotorgram.udp.agent_link import AgentLink
from rotorgram.udp.errors import DecodeError
from rotorgram.udp.keys import Key
from rotorgram.udp.link import LinkConfig
from rotorgram.udp.messages import Close, Command, Hello, Refuse, State
from rotorgram.udp.parts import Assembler, cut, is_part, turned
from rotorgram.udp.simulator_link import SimulatorLink

DRONES = 4096
HERE = ("127.0.0.1", 8000)
ELSEWHERE = ("127.0.0.1", 9000)


def hello(drones: int = DRONES, session: int = 7) -> Hello:
    bounds = np.ones(3, np.float32)
    return Hello(
        session=session,
        env_id="a/B-v0",
        num_drones=drones,
        observation_low=-bounds,
        observation_high=bounds,
        action_low=-bounds[:1],
        action_high=bounds[:1],
        discrete_actions=0,
        control_period=0.02,
        model_hash="0" * 32,
        telemetry_names=tuple("XYZ"),
        options="",
    )


def state(sequence: int, drones: int = DRONES, session: int = 7) -> State:
    dice = np.random.default_rng(sequence)
    return State(
        session=session,
        sequence=sequence,
        observations=dice.normal(size=(drones, 3)).astype(np.float32),
        rewards=dice.normal(size=drones),
        terminated=dice.random(drones) < 0.5,
        truncated=dice.random(drones) < 0.5,
        telemetry=dice.normal(size=(drones, 3)),
    )


def command(sequence: int, drones: int = 3 * DRONES, session: int = 7) -> Command:
    dice = np.random.default_rng(sequence)
    return Command(
        session=session,
        sequence=sequence,
        actions=dice.normal(size=(drones, 1)).astype(np.float32),
        resets=dice.random(drones) < 0.5,
        seeds=dice.integers(0, 2**63, drones).astype(np.uint64),
    )


def test_a_message_that_fits_is_not_cut() -> None:
    small = binary.encode(state(1, drones=3))
    assert cut(small) == [small]
    assert not is_part(small)


@given(order=st.randoms(use_true_random=False))
def test_parts_in_any_order_and_twice_make_the_message(order: random.Random) -> None:
    message = binary.encode(state(5))
    parts = cut(message)
    assert len(parts) == 3
    assert all(is_part(part) and len(part) <= binary.MAX_MESSAGE for part in parts)
    assert {binary.peek(part) for part in parts} == {(binary.STATE, 7, 5)}
    flight = parts + order.choices(parts, k=3)
    order.shuffle(flight)
    assembler = Assembler(binary.state_size(hello()))
    whole = [taken for part in flight if (taken := assembler.take(5, part)) is not None]
    assert whole[0] == message
    assert set(whole) == {message}


def test_sizes_are_those_of_the_messages() -> None:
    assert binary.state_size(hello()) == len(binary.encode(state(1)))
    assert binary.command_size(hello()) == len(binary.encode(command(1, drones=DRONES)))


def test_a_part_is_no_message() -> None:
    with pytest.raises(DecodeError, match="type: expected 1 to 8, got 132"):
        binary.decode(cut(binary.encode(state(1)))[0])


def test_a_buffer_that_is_too_small_delays_only() -> None:
    """Of each burst the first three parts arrive: repeats begin with others."""
    message = binary.encode(state(1, drones=20_000))
    parts, assembler = cut(message), Assembler(len(message))
    assert len(parts) > 12
    for times in range(len(parts)):
        whole = [assembler.take(1, part) for part in turned(parts, times)[:3]]
        if whole[-1] or any(whole):
            assert message in whole
            return
    raise AssertionError("never whole")


def test_a_message_has_the_header_of_its_parts() -> None:
    other = binary.encode(state(2, drones=1))
    halves = part(0, 2, other[:30]), part(1, 2, other[30:])
    assembler = Assembler(len(other))
    assert assembler.take(1, halves[0]) is None
    with pytest.raises(DecodeError, match="header of its parts"):
        assembler.take(1, halves[1])


def test_parts_of_an_older_message_change_nothing() -> None:
    old, new = (cut(binary.encode(state(n))) for n in (4, 5))
    assembler = Assembler(binary.state_size(hello()))
    for part in new[:-1]:
        assert assembler.take(5, part) is None
        assert assembler.take(4, old[-1]) is None
    assert assembler.take(5, new[-1]) == binary.encode(state(5))


def part(number: int, count: int, slice_: bytes) -> bytes:
    body = number.to_bytes(2, "little") + count.to_bytes(2, "little") + bytes(4) + slice_
    return binary.frame(binary.STATE | binary.PART, 7, 1, body)


@pytest.mark.parametrize(
    ("wrong", "expected"),
    [
        (part(0, 0, b"a"), "expected one of at most 8192, got 0 of 0"),
        (part(2, 2, b"a"), "got 2 of 2"),
        (part(0, 8193, b"a"), "got 0 of 8193"),
        (part(0, 2, b""), "expected a slice of a message, got 32 bytes"),
        (part(0, 2, b"")[:26], "expected a slice of a message, got 26 bytes"),
        (part(0, 2, bytes(101)), "parts: expected at most 100 bytes in all, got more"),
    ],
)
def test_wrong_parts(wrong: bytes, expected: str) -> None:
    with pytest.raises(DecodeError, match=expected):
        Assembler(100).take(1, wrong)


def test_parts_are_never_kept_beyond_the_largest_message() -> None:
    assembler = Assembler(100)
    for number in range(1000):
        try:
            assembler.take(1, part(number, 8192, bytes(30)))
        except DecodeError:
            continue
        assert sum(map(len, assembler._slices.values())) <= 100


# ---- over both links


class Pair:
    """A simulator's and an agent's link, with a network between them that loses parts."""

    def __init__(self, *, sealed: bool, loss: float, drones: int = DRONES) -> None:
        secret = bytes(range(32))
        keys = (Key(secret, "simulator"), Key(secret, "agent")) if sealed else (None, None)
        config = LinkConfig(min_resend=0.005, max_resend=0.05)
        self.drones = drones
        self.seen: dict[str, list[bytes]] = {"simulator": [], "agent": []}
        self.simulator = SimulatorLink(
            hello(drones), config, key=keys[0], tap=lambda p, m, d: self.seen["simulator"].append(d)
        )
        self.agent = AgentLink(
            lambda _: "", (3, 3), key=keys[1], tap=lambda p, m, d: self.seen["agent"].append(d)
        )
        self.dice = random.Random(0)
        self.loss = loss
        self.now = 0.0
        self.simulator.connect(self.now)

    def carry(self) -> list[Any]:
        """Carry what is there, once; what it brought."""
        brought = []
        for datagram in self.simulator.take_outgoing():
            if self.dice.random() >= self.loss:
                brought.append(self.agent.receive(datagram, HERE, self.now))
        for datagram, address in self.agent.take_outgoing():
            assert address == HERE
            if self.dice.random() >= self.loss:
                brought.append(self.simulator.receive(datagram, self.now))
        return [b for b in brought if b]

    def until(self, kind: Any) -> Any:
        for _ in range(500):
            for brought in self.carry():
                message = getattr(brought, "message", brought)
                if isinstance(message, kind):
                    return message
            self.now += 0.06
            assert self.simulator.handle_timer(self.now)
        raise AssertionError(f"no {kind}")


@pytest.mark.parametrize("loss", [0.0, 0.4])
@pytest.mark.parametrize("sealed", [False, True])
def test_a_flight_in_parts(sealed: bool, loss: float) -> None:
    pair = Pair(sealed=sealed, loss=loss, drones=3 * DRONES)
    for number in range(1, 6):
        while pair.simulator.state != "ready":
            pair.carry()
            pair.now += 0.06
            pair.simulator.handle_timer(pair.now)
        sent = state(number, pair.drones, pair.simulator.hello.session)
        pair.simulator.send_state(sent, pair.now)
        taken = pair.until(State)
        assert binary.encode(taken) == binary.encode(sent)
        answer = command(number, pair.drones, pair.simulator.hello.session)
        pair.agent.send_command(0, answer, pair.now)
        assert binary.encode(pair.until(Command)) == binary.encode(answer)
    assert pair.seen["simulator"] == pair.seen["agent"]
    counters = pair.agent.statistics.counters
    assert counters["malformed"] == counters["forged"] == 0


def test_an_agent_that_was_started_again_answers_parts() -> None:
    for sealed in (False, True):
        pair = Pair(sealed=sealed, loss=0.0)
        pair.until(object)
        session = pair.simulator.hello.session
        pair.simulator.send_state(state(1, session=session), 0.0)
        pair.until(State)
        pair.agent = Pair(sealed=sealed, loss=0.0).agent
        for _ in range(3):
            pair.now += 1.0
            pair.simulator.handle_timer(pair.now)
            pair.carry()
        assert pair.simulator.hello.session != session
        assert pair.simulator.statistics.counters["forged"] == 0
        assert pair.simulator.state == "ready"


def test_strangers_parts_are_kept_for_a_few_only() -> None:
    pair = Pair(sealed=False, loss=0.0)
    for session in range(100, 150):
        address = ("127.0.0.1", 10_000 + session)
        pair.agent.receive(binary.encode(hello(session=session)), address, 0.0)
        for piece in cut(binary.encode(state(1, session=session)))[:-1]:
            assert pair.agent.receive(piece, address, 0.0) is None
    kept = pair.agent._admission
    held = [opening for opening in kept.openings.values() if opening.parts]
    assert len(held) == len(kept.assembling) == 16
    # Who comes now is taken in all the same.
    pair.agent.take_outgoing()
    pair.until(object)
    pair.simulator.send_state(state(1, session=pair.simulator.hello.session), 0.0)
    assert pair.until(State).sequence == 1


def first_parts(agent: AgentLink, number: int) -> list[tuple[bytes, tuple[str, int]]]:
    """A simulator's Hello to the agent, and the parts of its first State with its address."""
    address = ("127.0.0.1", 10_000 + number)
    agent.receive(binary.encode(hello(session=number)), address, 0.0)
    return [(piece, address) for piece in cut(binary.encode(state(1, session=number)))]


def test_as_many_as_there_are_places_may_come_in_parts_at_the_same_moment() -> None:
    agent = AgentLink(lambda _: "", (3, 3), places=40)
    everybody = [first_parts(agent, number) for number in range(1, 41)]
    for round_ in zip(*everybody, strict=True):  # one part of each, then the next of each
        events = [agent.receive(piece, address, 0.0) for piece, address in round_]
    assert [event.place for event in events if event and event.joined] == list(range(40))
    assert not agent._admission.assembling


def test_strangers_do_not_push_out_who_goes_on_sending_parts() -> None:
    agent = AgentLink(lambda _: "", (3, 3), places=1)
    honest = first_parts(agent, 1)
    assert len(honest) == 3
    for number, (piece, address) in enumerate(honest):
        for stranger in range(15):  # one less than the sessions for which parts are kept
            other, there = first_parts(agent, 100 + 15 * number + stranger)[0]
            assert agent.receive(other, there, 0.0) is None
        event = agent.receive(piece, address, 0.0)
    assert event is not None
    assert event.joined


def test_a_state_in_parts_is_turned_away_with_all_the_words_that_fit_the_whole() -> None:
    reasons = [""]
    agent = AgentLink(lambda _: reasons[0], (3, 3))
    agent.receive(binary.encode(hello()), HERE, 0.0)
    agent.take_outgoing()
    reasons[0] = "another simulator has come meanwhile"
    whole = binary.encode(state(1))
    ends = [*range(0, len(whole) - 1, 60_000), len(whole) - 1, len(whole)]
    slices = [whole[start:end] for start, end in pairwise(ends)]
    for number, slice_ in enumerate(slices):
        assert agent.receive(part(number, len(slices), slice_), HERE, 0.0) is None
    ((datagram, _),) = agent.take_outgoing()
    message = binary.decode(datagram)
    assert isinstance(message, Close)
    assert message.reason == reasons[0]


def test_a_strangers_parts_do_not_disturb_a_session() -> None:
    pair = Pair(sealed=False, loss=0.0)
    pair.until(object)
    session = pair.simulator.hello.session
    pair.simulator.send_state(state(1, session=session), 0.0)
    pieces = pair.simulator.take_outgoing()
    junk = cut(binary.encode(state(1, session=session + 1)))
    for piece, other in zip(pieces, junk, strict=True):
        pair.agent.receive(other, ELSEWHERE, 0.0)
        pair.agent.receive(other, HERE, 0.0)
        event = pair.agent.receive(piece, HERE, 0.0)
    assert event is not None
    assert binary.encode(event.message) == binary.encode(state(1, session=session))
    assert pair.simulator.receive(junk[0], 0.0) is None


def test_a_hello_of_too_large_states_is_refused() -> None:
    pair = Pair(sealed=False, loss=0.0)
    bounds = np.zeros(8000, np.float32)
    large = replace(hello(65_536), observation_low=bounds, observation_high=bounds)
    pair.agent.receive(binary.encode(large), ELSEWHERE, 0.0)
    ((datagram, _),) = pair.agent.take_outgoing()
    refuse = binary.decode(datagram)
    assert isinstance(refuse, Refuse)
    assert refuse.reason.startswith("expected States and Commands of at most 16777216 bytes, got 2")

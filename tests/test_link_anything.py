"""Attackers: who makes up datagrams, or has the network, and sends anything in any order."""

import random
from collections import Counter
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
)
from links import (
    ANYWHERE,
    HERE,
    SECRET,
    STRANGER,
    begin,
    close,
    command,
    fixed,
    hello,
    of_agent,
    of_simulator,
    pair,
    state,
    step,
)
from rotorgram.udp import LinkConfig, binary
from rotorgram.udp.agent_link import AgentLink
from rotorgram.udp.keys import OVERHEAD, Key
from rotorgram.udp.link import Address
from rotorgram.udp.messages import Close, Command, Refuse, State, Welcome
from rotorgram.udp.simulator_link import SimulatorLink

# ---- nobody is sent more than he sent

greetings = st.builds(
    lambda session, env, names: hello(session=session, env_id=env, telemetry_names=names),
    st.sampled_from([77, 78, 2**64 - 1]),
    st.sampled_from(["", "a/B-v0", "x" * 512]),
    st.sampled_from([(), ("X", "Y")]),
).map(binary.encode)
states = st.builds(state, st.integers(0, 3), st.sampled_from([77, 78])).map(binary.encode)
closes = st.builds(close, st.integers(0, 3), st.sampled_from([77, 78])).map(binary.encode)
lines = st.sampled_from([b"1,0,0,0,0", b"0,0,0,0,0", b"1,close", b"x", b"7,0.0,1,1,0.5\r\n"])
junk = st.binary(max_size=80)
versions = st.tuples(st.sampled_from([1, 3, 255]), greetings | states | closes).map(
    lambda pair: fixed(pair[1][:2] + bytes([pair[0]]) + pair[1][3:])
)
cut = st.tuples(greetings | states, st.integers(0, 90)).map(lambda pair: fixed(pair[0][: pair[1]]))
plain = greetings | states | closes | lines | junk | versions | cut
SEALERS = [Key(SECRET, "simulator"), Key(bytes(32), "simulator"), Key(SECRET, "agent")]
datagrams = st.tuples(st.sampled_from([None, *SEALERS]), plain).map(
    lambda pair: pair[0].seal(pair[1]) if pair[0] else pair[1]
)


@settings(deadline=None, max_examples=400)
@given(
    st.lists(st.tuples(st.booleans(), datagrams), max_size=12),
    st.booleans(),
    st.sampled_from(["", "no " + "ü" * 300]),
    st.integers(0, 12),
    st.booleans(),
)
@example([(False, binary.encode(hello(env_id="")))], False, "", 12, True)
@example([(False, SEALERS[0].seal(binary.encode(hello(env_id=""))))], True, "", 12, True)
def test_a_stranger_is_sent_no_more_bytes_than_he_sent(
    heard: list[tuple[bool, bytes]], sealed: bool, refusal: str, closes_at: int, full: bool
) -> None:
    reasons = [""]
    agent = AgentLink(
        lambda _: reasons[0], (1, 0), places=1, key=Key(SECRET, "agent") if sealed else None
    )
    if full:
        other = SimulatorLink(
            hello(), LinkConfig(), key=Key(SECRET, "simulator") if sealed else None
        )
        _, first = begin(other, agent)
        assert agent.receive(first, HERE, 0.0) is not None
    balance: Counter[Address] = Counter()

    def settle() -> None:
        for answer, there in agent.take_outgoing():
            balance[there] -= len(answer)
        assert min(balance[STRANGER], balance[ANYWHERE]) >= 0

    for number, (elsewhere, datagram) in enumerate(heard):
        if number == closes_at:
            agent.close("a reason " + "ü" * 300, 0.0)
        if number == len(heard) // 2:
            reasons[0] = refusal
        address = (STRANGER, ANYWHERE)[elsewhere]
        balance[address] += len(datagram)
        agent.receive(datagram, address, 0.0)
        if {s.peer for s in agent.places if s} & {STRANGER, ANYWHERE}:
            return  # without a key whoever says the right words is no stranger
        settle()
    agent.close("a reason " + "ü" * 300, 0.0)
    settle()


def test_what_is_remembered_of_strangers_is_bounded() -> None:
    agent = AgentLink(lambda _: "", (1, 0), places=1)
    for full in (False, True):
        if full:
            other = SimulatorLink(hello(), LinkConfig())
            agent.receive(begin(other, agent)[1], HERE, 0.0)
        for number in range(3000):
            agent.receive(binary.encode(hello(session=1000 + number)), ("10.0.0.1", number), 0.0)
            agent.take_outgoing()
    for number in range(3000):
        session = 10_000 + number
        agent.receive(binary.encode(hello(session=session)), HERE, 0.0)
        assert agent.receive(binary.encode(state(1, session)), HERE, 0.0) is not None
        agent.take_outgoing()
    kept = agent._admission
    assert max(len(kept.openings), len(kept.waiting), len(kept.ended)) == 1024
    assert len(kept.seats) == 1


# ---- anything, in any order


class Network(RuleBasedStateMachine):
    """Two simulators and an agent of two places, and somebody who has the network.

    He delivers, loses, copies and reorders what they send, and sends on his own what he has seen,
    or has changed, or has made up. Either side may be started again or close.
    """

    sealed = False

    def __init__(self) -> None:
        super().__init__()
        self.now = 100.0
        self.seen: list[bytes] = []
        self.sent: set[bytes] = set()
        self.flying: list[tuple[str, Address, bytes]] = []
        self.chosen: dict[tuple[int, int], set[float]] = {}
        self.simulators: dict[Address, SimulatorLink] = {}
        self.steps: Counter[int] = Counter()
        self.numbers: dict[int, int] = {}
        self.balance: Counter[Address] = Counter()
        self.count = 0

    @initialize(steps=st.integers(0, 20))
    def start(self, steps: int) -> None:
        self.start_agent()
        for number in range(2):
            self.start_simulator(number)
        for _ in range(steps):
            self.flow()

    # ---- both sides

    @rule()
    def start_agent(self) -> None:
        key = Key(SECRET, "agent") if self.sealed else None
        self.agent = AgentLink(lambda _: "", (1, 0), places=2, key=key)

    @rule(number=st.integers(0, 1))
    def start_simulator(self, number: int) -> None:
        key = Key(SECRET, "simulator") if self.sealed else None
        link = SimulatorLink(
            hello(session=self.draw()), LinkConfig(), key=key, draw_session=self.draw
        )
        self.simulators["10.0.0.1", number] = link
        link.connect(self.now)
        self.collect()

    def draw(self) -> int:
        self.count += 1
        return self.count

    @rule(number=st.integers(0, 1))
    def close_simulator(self, number: int) -> None:
        self.simulators["10.0.0.1", number].close("bye", self.now)
        self.collect()

    @rule()
    def close_agent(self) -> None:
        self.agent.close("bye", self.now)
        self.collect()

    @rule(place=st.integers(0, 1))
    def free(self, place: int) -> None:
        self.agent.free(place)

    @rule(place=st.integers(0, 1))
    def decide(self, place: int) -> None:
        session = self.agent.places[place]
        if session and session.state == "deciding":
            value = float(np.float32(random.Random(len(self.chosen)).random()))
            self.chosen.setdefault((session.number, session.sequence), set()).add(value)
            answer = command(session.sequence, session.number, value)
            self.agent.send_command(place, answer, self.now)
            self.collect()

    @rule(seconds=st.sampled_from([0.0, 0.03, 0.3, 2.0, 40.0]))
    def wait(self, seconds: float) -> None:
        self.now += seconds
        self.agent.handle_timer(self.now)
        for link in self.simulators.values():
            link.handle_timer(self.now)
        self.collect()

    # ---- the network

    def collect(self) -> None:
        for address, link in self.simulators.items():
            for datagram in link.take_outgoing():
                self.flying.append(("agent", address, datagram))
        for datagram, address in self.agent.take_outgoing():
            self.flying.append(("simulator", address, datagram))
            self.balance[address] -= len(datagram)
        for _, _, datagram in self.flying:
            if datagram not in self.sent:
                self.sent.add(datagram)
                self.seen.append(datagram)

    @rule(number=st.integers(0, 7), copies=st.integers(0, 2))
    @precondition(lambda self: self.flying)
    def deliver(self, number: int, copies: int) -> None:
        to, address, datagram = self.flying.pop(number % len(self.flying))
        for _ in range(copies):
            self.give(to, address, datagram)
        self.collect()

    @rule()
    def flow(self) -> None:
        """All that is on its way arrives, and the agent decides."""
        flying, self.flying = self.flying, []
        for to, address, datagram in flying:
            self.give(to, address, datagram)
        for place in range(2):
            self.decide(place)
        self.collect()

    def give(self, to: str, address: Address, datagram: bytes) -> None:
        if to == "agent":
            self.give_agent(address, datagram)
        elif address in self.simulators:
            self.give_simulator(address, datagram)

    def give_agent(self, address: Address, datagram: bytes) -> None:
        self.balance[address] += len(datagram)
        agent = self.agent
        before = [(s, s.sequence) if s else (None, 0) for s in agent.places]
        count = len(agent._outbox.datagrams)
        event = agent.receive(datagram, address, self.now)
        assert len(agent._outbox.datagrams) <= count + 1
        if event is None:
            assert [s for s, _ in before] == agent.places
            return
        assert not (agent.closed and isinstance(event.message, State))
        session, sequence = before[event.place]
        if isinstance(event.message, Close):
            assert agent.places[event.place] is None
        elif event.joined:
            assert agent.places[event.place] is not session
        else:
            assert agent.places[event.place] is session
            assert event.message.sequence == sequence + 1
        if self.sealed and isinstance(event.message, State):
            assert address in self.simulators
            assert event.message.sequence == event.message.observations.item() + 1

    def give_simulator(self, address: Address, datagram: bytes) -> None:
        link = self.simulators[address]
        sequence, session, count = link.sequence, link.hello.session, len(link._outgoing)
        message = link.receive(datagram, self.now)
        assert len(link._outgoing) <= count + 1
        if isinstance(message, Command):
            assert (message.session, message.sequence) == (session, sequence)
            assert np.isfinite(message.actions).all()
            self.steps[session] += 1
            assert self.steps[session] == sequence
            if self.sealed:
                assert self.chosen[session, sequence] == {message.actions.item()}
        if isinstance(message, Command | Welcome):
            number = link.sequence + 1
            link.send_state(state(number, session, float(number - 1)), self.now)

    # ---- somebody

    def attack(self, address: Address, datagram: bytes) -> None:
        """Send it to everybody; with a key nothing comes of it, but what was sent before."""
        before = self.snapshot()
        self.give_agent(address, datagram)
        for there in self.simulators:
            self.give_simulator(there, datagram)
        if self.sealed and datagram not in self.sent:
            assert self.snapshot() == before
        self.collect()

    def snapshot(self) -> object:
        links = {address: of_simulator(link) for address, link in self.simulators.items()}
        return of_agent(self.agent), links

    addresses = st.sampled_from([("10.0.0.1", 0), ("10.0.0.1", 1), ANYWHERE])

    @rule(number=st.integers(0, 1000), address=addresses)
    @precondition(lambda self: self.seen)
    def replay(self, number: int, address: Address) -> None:
        self.attack(address, self.seen[-1 - number % len(self.seen)])

    @rule(
        number=st.integers(0, 1000),
        address=addresses,
        at=st.integers(0, 200),
        new=st.binary(min_size=1, max_size=9),
        fix=st.booleans(),
        size=st.none() | st.integers(0, 200),
    )
    @precondition(lambda self: self.seen)
    def change(
        self, number: int, address: Address, at: int, new: bytes, fix: bool, size: int | None
    ) -> None:
        datagram = self.seen[-1 - number % len(self.seen)]
        at %= len(datagram)
        datagram = (datagram[:at] + new + datagram[at + len(new) :])[:size]
        self.attack(address, fixed(datagram) if fix else datagram)

    @rule(address=addresses, datagram=datagrams)
    def make_up(self, address: Address, datagram: bytes) -> None:
        # Who has the key is no stranger: he may say Hello.
        if not (self.sealed and datagram[OVERHEAD : OVERHEAD + 2] == binary.MAGIC):
            self.attack(address, datagram)

    @rule(
        address=addresses,
        session=st.integers(0, 8),
        sequence=st.integers(0, 30),
        kind=st.sampled_from([state, command, close]),
        side=st.sampled_from(["simulator", "agent"]),
    )
    def forge(self, address: Address, session: int, sequence: int, kind: Any, side: Any) -> None:
        datagram = binary.encode(kind(sequence, session))
        if self.sealed:  # with a key of his own
            datagram = Key(bytes(32), side).for_session(session, 0).seal(datagram)
        self.attack(address, datagram)

    # ---- what is always so

    @invariant()
    def links_are_in_a_known_state(self) -> None:
        if not hasattr(self, "agent"):
            return
        for link in self.simulators.values():
            assert link.state in ("hello", "ready", "waiting", "closing", "closed")
            assert link.state != "ready"  # the physics answers at once
            if link.state in ("hello", "waiting", "closing"):
                assert link.next_timer() is not None
        for place, session in enumerate(self.agent.places):
            if session:
                assert session.state in ("deciding", "expecting", "closing")
                assert (session.state == "closing") == self.agent.closed
                assert self.agent._admission.seats[session.peer] == place
        assert len(self.agent._admission.seats) == sum(map(bool, self.agent.places))
        if self.sealed:
            assert self.balance[ANYWHERE] >= 0


class SealedNetwork(Network):
    """Whatever he did: once he lets everything pass, everybody flies again."""

    sealed = True

    def teardown(self) -> None:
        if not self.simulators or self.agent.closed:
            return
        begun = Counter(self.steps)
        for _ in range(8):
            for _ in range(4):
                self.flow()
            self.wait(1.1)
        for link in self.simulators.values():
            if link.state not in ("closing", "closed"):
                session = link.hello.session
                assert self.steps[session] > begun[session]


TestOpenNetwork = Network.TestCase
TestSealedNetwork = SealedNetwork.TestCase
TestOpenNetwork.settings = TestSealedNetwork.settings = settings(
    max_examples=60, stateful_step_count=40, deadline=None
)


@pytest.mark.parametrize("sealed", [False, True], ids=["open", "sealed"])
def test_junk_changes_nothing_but_counters(sealed: bool) -> None:
    dice = random.Random(3)
    link, agent = pair(sealed)
    _, first = begin(link, agent)
    step(link, agent, first)
    before = of_agent(agent), of_simulator(link)
    for size in (0, 1, 5, 24, 100, 65507):
        for start in (
            b"",
            b"\xa7R\x02\x04",
            b"\xa7R\x02\x01",
            b"\xa7S",
            b"1,",
            b"\xa7S" + bytes(16),
        ):
            body = (start + dice.randbytes(size))[:65507]
            for address in (HERE, STRANGER):
                assert agent.receive(body, address, 0.0) is None
            assert link.receive(body, 0.0) is None
    assert (of_agent(agent), of_simulator(link)) == before
    assert link.take_outgoing() == []
    for side, count in ((link, 36), (agent, 72)):
        counters = side.statistics.counters
        assert counters["forged"] + counters["malformed"] == count
        assert bool(counters["forged"])
    assert all(isinstance(binary.decode(d), Refuse) for d, _ in agent.take_outgoing())

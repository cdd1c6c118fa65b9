"""Attackers: who records, replays, damages and makes up datagrams, and who only has the port."""

import random
import zlib
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
from rotorgram.udp import LinkConfig, binary
from rotorgram.udp.agent_link import AgentLink
from rotorgram.udp.keys import OVERHEAD, Key, is_sealed
from rotorgram.udp.link import Address
from rotorgram.udp.messages import Close, Command, Refuse, State, Welcome
from rotorgram.udp.simulator_link import SimulatorLink
from test_link import HERE, SECRET, STRANGER, close, command, hello, state, state_of
from test_link_world import World, clean

ANYWHERE = ("10.6.6.6", 666)


def fixed(datagram: bytes) -> bytes:
    """With its checksum made right, behind whatever seal it has."""
    at = OVERHEAD if is_sealed(datagram) else 0
    head, body = datagram[: at + 4], datagram[at + 8 :]
    if len(datagram) < at + 24:
        return datagram
    return head + zlib.crc32(body, zlib.crc32(head[at:])).to_bytes(4, "little") + body


def of_agent(link: AgentLink) -> object:
    """All that a datagram may change, but for what is remembered of those who come."""
    return link.closed, [
        s and (s.peer, s.number, s.state, s.sequence, s.reply, s.asked_at) for s in link.places
    ]


def of_simulator(link: SimulatorLink) -> object:
    numbers = (link._sent_at, link._resend_at, link._deadline, link._smoothed, link._variation)
    return link.state, link.sequence, link.hello.session, link.sends, link._outstanding, numbers


# ---- replays


class Recorded(World):
    """A world that notes every datagram."""

    def __init__(self, codec: str) -> None:
        self.tape: list[tuple[str, bytes]] = []
        super().__init__(self._note, codec=codec)

    def _note(self, datagram: bytes) -> list[tuple[float, bytes]]:
        return clean(datagram)

    def _put(self, physics: Any, to: str, datagram: bytes) -> None:
        self.tape.append((to, datagram))
        super()._put(physics, to, datagram)


def recorded(codec: str) -> Recorded:
    """Five sessions: with either side restarted, closed by either side, and one that goes on."""
    world = Recorded(codec)
    world.run_steps(3)
    world.start_agent()
    world.run_steps(3)
    world.start_simulator(world.physics[0].address)
    world.run_steps(3)
    world.physics[0].link.close("enough", world.now)
    world.run(lambda: world.agent.places == [None])
    world.start_simulator(world.physics[0].address)
    world.run_steps(3)
    world.start_simulator(world.physics[0].address)
    world.run_steps(6)
    assert len(world.joined) == 5
    return world


@pytest.mark.parametrize("waits", ["agent", "simulator"])
def test_what_was_sealed_before_changes_nothing_now(waits: str) -> None:
    world = recorded("sealed")
    physics, agent = world.physics[0], world.agent
    world._send()
    if waits == "simulator":
        world._arrive()
        world._send()
    ((_, _, _, to, awaited),) = world._flying  # on its way, so the only one that counts
    assert to == waits
    world._flying.clear()
    before = of_agent(agent), of_simulator(physics.link)
    address, now = physics.address, world.now
    for _, datagram in world.tape:
        for sender in (address, STRANGER):
            if datagram != awaited or sender != address:
                assert agent.receive(datagram, sender, now) is None
        if datagram != awaited:
            assert physics.link.receive(datagram, now) is None
        assert (of_agent(agent), of_simulator(physics.link)) == before
        # What is answered is what anybody may ask for, and moves nobody.
        for answer, _ in agent.take_outgoing():
            if answer != awaited:
                assert physics.link.receive(answer, now) is None
        assert physics.link.take_outgoing() == []
        assert (of_agent(agent), of_simulator(physics.link)) == before
    world.run_steps(10, most=2)
    assert len(world.joined) == 5
    world.check()


@pytest.mark.parametrize("sealed", [False, True], ids=["open", "sealed"])
def test_no_damaged_datagram_counts(sealed: bool) -> None:
    world = recorded("sealed" if sealed else "binary")
    physics, agent = world.physics[0], world.agent
    world._send()
    before = of_agent(agent), of_simulator(physics.link)
    dice = random.Random(1)
    for _, datagram in world.tape:
        for bit in dice.sample(range(8 * len(datagram)), 60):
            raw = bytearray(datagram)
            raw[bit // 8] ^= 1 << bit % 8
            flipped = bytes(raw)
            attempts = {flipped, fixed(flipped) if sealed else flipped, flipped[: bit // 8]}
            for hostile in attempts - {datagram}:
                assert agent.receive(hostile, physics.address, world.now) is None
                assert physics.link.receive(hostile, world.now) is None
    assert (of_agent(agent), of_simulator(physics.link)) == before
    assert physics.link.take_outgoing() == []
    agent.take_outgoing()
    world.run_steps(10, most=2)


def pair(sealed: bool, session: int = 77) -> tuple[SimulatorLink, AgentLink]:
    keys: list[Any] = [Key(SECRET, side) if sealed else None for side in ("simulator", "agent")]
    numbers = iter(range(1000, 2000))
    link = SimulatorLink(
        hello(session=session), LinkConfig(), key=keys[0], draw_session=lambda: next(numbers)
    )
    return link, new_agent(keys[1])


def new_agent(key: Key | None) -> AgentLink:
    return AgentLink(lambda _: "", (1, 0), key=key)


def only(outgoing: list[Any]) -> bytes:
    (first,) = outgoing
    return first if isinstance(first, bytes) else first[0]


def begin(link: SimulatorLink, agent: AgentLink) -> tuple[bytes, bytes]:
    """To State 1, which is not delivered; the Hello and the State."""
    if not link.sends:
        link.connect(0.0)
    greeting = only(link.take_outgoing())
    agent.receive(greeting, HERE, 0.0)
    link.receive(only(agent.take_outgoing()), 0.0)
    link.send_state(state(1, link.hello.session), 0.0)
    return greeting, only(link.take_outgoing())


def step(link: SimulatorLink, agent: AgentLink, datagram: bytes) -> bytes:
    """The Command for a State, and the next State."""
    event = agent.receive(datagram, HERE, 0.0)
    assert event is not None
    answer = command(event.message.sequence, event.message.session)
    agent.send_command(event.place, answer, 0.0)
    assert isinstance(link.receive(only(agent.take_outgoing()), 0.0), Command)
    link.send_state(state(link.sequence + 1, link.hello.session), 0.0)
    return only(link.take_outgoing())


@pytest.mark.parametrize("sealed", [False, True], ids=["open", "sealed"])
def test_an_old_hello_does_not_take_the_place_of_a_new_one(sealed: bool) -> None:
    old, agent = pair(sealed)
    greeting, _ = begin(old, agent)  # killed before its State 1 came
    link, _ = pair(sealed, session=78)
    _, first = begin(link, agent)
    agent.receive(greeting, HERE, 0.0)  # late, or replayed
    agent.take_outgoing()
    step(link, agent, first)
    assert state_of(agent) == "expecting"


def test_what_began_before_the_session_that_took_its_place_is_over() -> None:
    """Late, from a simulator that was killed: without a key it would be believed."""
    old, agent = pair(False)
    _, late = begin(old, agent)
    link, _ = pair(False, session=78)
    _, first = begin(link, agent)
    step(link, agent, first)
    assert agent.receive(late, HERE, 0.0) is None
    assert agent.places[0] is not None
    assert agent.places[0].number == 78


@pytest.mark.parametrize("sealed", [False, True], ids=["open", "sealed"])
def test_what_began_after_it_may_still_come(sealed: bool) -> None:
    old, agent = pair(sealed)
    _, late = begin(old, agent)
    link, _ = pair(sealed, session=78)
    _, first = begin(link, agent)
    assert agent.receive(late, HERE, 0.0) is not None  # takes a place, though nobody flies it
    step(link, agent, first)
    assert agent.places[0] is not None
    assert agent.places[0].number == 78


def test_an_old_session_does_not_lock_out_the_simulator_that_came_since() -> None:
    """Its Hello and State 1 come late, between the Hello of the new one and its Welcome, lost."""
    old, agent = pair(False)
    greeting, late = begin(old, agent)
    agent = new_agent(None)
    link, _ = pair(False, session=78)
    link.connect(0.0)
    agent.receive(only(link.take_outgoing()), HERE, 0.0)
    for datagram in (greeting, late):
        agent.receive(datagram, HERE, 0.0)
    agent.take_outgoing()
    link.handle_timer(1.0)
    agent.receive(only(link.take_outgoing()), HERE, 1.0)
    link.receive(only(agent.take_outgoing()), 1.0)
    assert link.state == "ready"


@pytest.mark.parametrize("sealed", [False, True], ids=["open", "sealed"])
def test_an_old_session_takes_a_place_at_its_state_and_not_before(sealed: bool) -> None:
    old, agent = pair(sealed)
    greeting, first = begin(old, agent)
    second = step(old, agent, first)
    link, _ = pair(sealed, session=78)
    _, state_1 = begin(link, agent)
    assert agent.places[0] is not None
    assert agent.places[0].number == 77
    event = agent.receive(state_1, HERE, 0.0)
    assert event is not None
    assert (event.joined, agent.places[0].number) == (True, 78)
    before = of_agent(agent)
    for datagram in (greeting, first, second, greeting):
        assert agent.receive(datagram, HERE, 0.0) is None
    assert of_agent(agent) == before


@pytest.mark.parametrize("sealed", [False, True], ids=["open", "sealed"])
def test_a_hello_from_before_the_agents_restart_leads_nobody_astray(sealed: bool) -> None:
    """The new agent welcomes it, and then gets the third State of that session."""
    link, agent = pair(sealed)
    greeting, first = begin(link, agent)
    third = step(link, agent, step(link, agent, first))
    agent = new_agent(Key(SECRET, "agent") if sealed else None)
    agent.receive(greeting, HERE, 0.0)
    agent.take_outgoing()
    assert agent.receive(third, HERE, 0.0) is None
    assert link.receive(only(agent.take_outgoing()), 0.0) is None
    assert (link.state, link.hello.session) == ("hello", 1000)
    _, again = begin(link, agent)
    step(link, agent, again)


def test_a_hello_and_a_state_from_before_the_restart_neither() -> None:
    """Without a key these two begin a session that nobody flies; its fourth State says so."""
    link, agent = pair(False)
    greeting, first = begin(link, agent)
    third = step(link, agent, step(link, agent, first))
    for decides in (False, True):
        agent = new_agent(None)
        agent.receive(greeting, HERE, 0.0)
        assert agent.receive(first, HERE, 0.0) is not None
        if decides:
            agent.send_command(0, command(1), 0.0)
        agent.take_outgoing()
        assert agent.receive(third, HERE, 0.0) is None
        assert binary.peek(only(agent.take_outgoing())) == (binary.UNKNOWN, 77, 3)


def test_an_unknown_that_was_asked_for_before_counts_for_nothing() -> None:
    """Who sees a session's number can ask for Unknowns before the agent knows it."""
    link, agent = pair(True)
    foe = Key(bytes(32), "simulator").for_session(77, 0)
    hoard = []
    for sequence in range(1, 5):
        datagram = foe.seal(binary.encode(state(sequence)))
        assert agent.receive(datagram, ANYWHERE, 0.0) is None
        hoard.append(only(agent.take_outgoing()))
    _, datagram = begin(link, agent)
    for _ in range(3):
        before = of_simulator(link)
        for unknown in hoard:
            assert link.receive(unknown, 0.0) is None
        assert of_simulator(link) == before
        datagram = step(link, agent, datagram)
    # Nor does the tag of the true State help, on a State that was changed.
    agent = new_agent(Key(SECRET, "agent"))
    agent.receive(fixed(datagram[:-9] + b"\1" + datagram[-8:]), HERE, 0.0)
    assert link.receive(only(agent.take_outgoing()), 0.0) is None
    assert link.state == "waiting"
    agent.receive(datagram, HERE, 0.0)
    link.receive(only(agent.take_outgoing()), 0.0)
    assert link.state == "hello"


def test_a_welcome_for_somebody_else_does_not_stop_the_simulator() -> None:
    """A copy of its Hello from elsewhere brings another nonce; its State 1 is then of no key."""
    link, agent = pair(True)
    link.connect(0.0)
    greeting = only(link.take_outgoing())
    agent.receive(greeting, HERE, 0.0)
    agent.take_outgoing()  # lost
    agent.receive(greeting, ANYWHERE, 0.0)
    link.receive(only(agent.take_outgoing()), 0.0)
    link.send_state(state(1), 0.0)
    assert agent.receive(only(link.take_outgoing()), HERE, 0.0) is None
    link.receive(only(agent.take_outgoing()), 0.0)
    assert link.hello.session == 1000
    step(link, agent, begin(link, agent)[1])


def test_messages_do_not_return_to_their_sender() -> None:
    link, agent = pair(True)
    greeting, first = begin(link, agent)
    second = step(link, agent, first)
    assert agent.places[0] is not None
    before = of_agent(agent), of_simulator(link)
    for datagram in (greeting, first, second):
        assert link.receive(datagram, 0.0) is None
    assert agent.receive(agent.places[0].reply[0], HERE, 0.0) is None
    assert (of_agent(agent), of_simulator(link)) == before


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
    assert max(len(agent._openings), len(agent._waiting), len(agent._ended)) == 1024
    assert len(agent._seats) == 1


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
        count = len(agent._outgoing)
        event = agent.receive(datagram, address, self.now)
        assert len(agent._outgoing) <= count + 1
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
                assert self.agent._seats[session.peer] == place
        assert len(self.agent._seats) == sum(map(bool, self.agent.places))
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

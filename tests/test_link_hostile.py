"""Attackers: who records, replays and damages datagrams."""

import random
from typing import Any

import pytest
from links import (
    ANYWHERE,
    HERE,
    SECRET,
    STRANGER,
    begin,
    command,
    fixed,
    new_agent,
    of_agent,
    of_simulator,
    only,
    pair,
    state,
    state_of,
    step,
)
from rotorgram.udp import binary
from rotorgram.udp.keys import Key
from test_link_world import World, clean

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

"""Simulators and an agent joined by a bad network, with a clock of its own; either side restarts.

The physics only counts its steps, and the agent answers with how often it was asked: so both show
whether every command was chosen once and stepped once.
"""

import itertools
import random
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from links import ONE, SECRET, Fate, Network, hello, send_command, send_state
from rotorgram.udp import LinkConfig
from rotorgram.udp.protocol.auth import Key
from rotorgram.udp.protocol.client import Address, Client
from rotorgram.udp.protocol.messages import Close, Command, Refuse, State, Welcome
from rotorgram.udp.protocol.server import Server

SILENCE = 30.0
"""After so long the agent frees the place of a simulator, s."""


def clean(datagram: bytes) -> list[tuple[float, bytes]]:
    return [(0.001, datagram)]


def bad(seed: int, *, flips: bool = True) -> Fate:
    """Loses 30 %, copies 20 %, reorders, and damages 10 % (not by text, which has no checksum)."""
    dice = random.Random(seed)

    def fate(datagram: bytes) -> list[tuple[float, bytes]]:
        copies = dice.choices([0, 1, 2, 3], [0.3, 0.5, 0.15, 0.05])[0]
        return [(dice.choice([0.001, 0.004, 0.3, 2.0]), damaged(datagram)) for _ in range(copies)]

    def damaged(datagram: bytes) -> bytes:
        if not flips or dice.random() > 0.1:
            return datagram
        raw = bytearray(datagram)
        raw[dice.randrange(len(raw))] ^= 1 << dice.randrange(8)
        return bytes(raw)[: dice.choice([len(raw), dice.randrange(len(raw))])]

    return fate


@dataclass
class Physics:
    """A simulator: its link, and the steps of each of its sessions."""

    address: Address
    link: Client
    steps: dict[int, list[float]] = field(default_factory=dict)
    """Actions of each session, in the order of its steps."""
    ended: str = ""

    @property
    def session(self) -> int:
        return self.link.hello.session

    def send_state(self, now: float) -> None:
        """The observation is the number of steps, modulo what float32 holds."""
        steps = self.steps.setdefault(self.session, [])
        send_state(self.link, len(steps), now)

    def receive(self, datagram: bytes, now: float) -> None:
        message = self.link.receive(datagram, now)
        if isinstance(message, Command):
            assert message.session == self.session
            self.steps[self.session].append(message.actions.item())
            assert len(self.steps[self.session]) == message.sequence
        if isinstance(message, Command | Welcome):
            self.send_state(now)
        if isinstance(message, Close | Refuse):
            self.ended = message.reason or "closed"


class World(Network):
    """Several simulators, and an agent; each side may be started anew."""

    def __init__(
        self, fate: Fate, *, codec: str = "binary", simulators: int = 1, slots: int | None = None
    ) -> None:
        self.text = codec == "text"
        self.sealed = codec == "sealed"
        self.slots = simulators if slots is None else slots
        self.chosen: dict[tuple[Address, int], list[list[float]]] = {}
        """Actions that each agent chose in each session, in the order of its States."""
        self.asked = 0
        self.joined: list[int] = []
        """Sessions that took a slot."""
        self.closes: list[str] = []
        self.physics: list[Physics] = []
        self._numbers = itertools.count(1)
        super().__init__(self.new_agent(), fate, {})
        self.now = 1000.0
        self.heard: list[float] = [self.now] * self.slots
        for number in range(simulators):
            self.start_simulator(("10.0.0.1", number))

    # ---- who there is

    def new_agent(self) -> Server:
        key = Key(SECRET, "agent") if self.sealed else None
        return Server(lambda _: ONE, lambda: ONE, slots=self.slots, key=key)

    def start_agent(self) -> None:
        """A new one at the same address: it knows nothing of what was."""
        self.server = self.new_agent()
        self.heard = [self.now] * self.slots

    def start_simulator(self, address: Address) -> Physics:
        """Another one, in place of that at the same address, which is dead at once."""
        if old := self.of(address):
            self.remove(old)
        key = Key(SECRET, "simulator") if self.sealed else None
        link = Client(
            hello(session=next(self._numbers)),
            ONE,
            LinkConfig(),
            by_text=self.text,
            key=key,
            draw_session=lambda: next(self._numbers),
        )
        physics = Physics(address, link)
        self.physics.append(physics)
        self.clients[address] = link
        link.connect(self.now)
        if self.text:
            physics.send_state(self.now)
        return physics

    def remove(self, physics: Physics) -> None:
        self.physics.remove(physics)
        del self.clients[physics.address]

    def of(self, address: Address) -> Physics | None:
        return next((p for p in self.physics if p.address == address), None)

    # ---- what happens

    def run_steps(self, count: int, most: float = 1e9) -> None:
        """Until each simulator has made so many more steps in one session."""
        begun = [(p, s, len(p.steps.get(s, []))) for p in self.physics for s in [p.session]]

        def done() -> bool:
            return all(
                len(p.steps.get(p.session, [])) >= count + (at if p.session == s else 0)
                for p, s, at in begun
                if p in self.physics
            )

        self.pass_time(done, most)

    def simulator_received(self, address: Address, datagram: bytes) -> None:
        physics = self.of(address)
        assert physics is not None
        physics.receive(datagram, self.now)

    def silence(self, address: Address) -> None:
        physics = self.of(address)
        assert physics is not None
        physics.ended = "silent"

    def agent_received(self, event: Any, address: Address) -> None:
        if event is None:
            return
        self.heard[event.slot] = self.now
        if isinstance(event.message, Close):
            self.closes.append(event.message.reason)
            return
        self._choose(event.slot, event.message, event.joined)

    def _choose(self, slot: int, message: State, joined: bool) -> None:
        session = self.server.slots[slot]
        assert session is not None
        by_agents = self.chosen.setdefault((session.peer, message.session), [])
        if joined:
            self.joined.append(message.session)
            by_agents.append([])
            # With a key no agent takes up what another began, not even from late datagrams.
            assert len(by_agents) == 1 or not self.sealed
        if not self.text:
            # The State shows every command that was chosen before it, each stepped once.
            assert message.observations[0].item() == len(by_agents[-1]) == message.sequence - 1
        self.asked += 1
        value = float(np.float32(1 / self.asked))
        by_agents[-1].append(value)
        send_command(self.server, slot, value, self.now)

    def free_slots(self) -> None:
        for slot, session in enumerate(self.server.slots):
            flies = session and session.state != "closing"
            if flies and self.now - self.heard[slot] > SILENCE:
                self.server.free(slot)

    def check(self) -> None:
        """Every step was chosen, in that order; of what was chosen all but the last was stepped."""
        for physics in self.physics:
            for session, steps in physics.steps.items():
                number = 0 if self.text else session
                agents = self.chosen.get((physics.address, number), [[]])
                # Without a key an agent may take up, from late datagrams, what another began.
                for step, action in enumerate(steps):
                    assert action in [chosen[step] for chosen in agents if step < len(chosen)]
                if len(agents) == 1 and session == physics.session:
                    assert len(steps) <= len(agents[0]) <= len(steps) + 1


# ---- exactly once


@pytest.mark.parametrize("simulators", [1, 3])
@pytest.mark.parametrize("codec", ["binary", "text", "sealed"])
@pytest.mark.parametrize("seed", range(3))
def test_each_command_is_stepped_once_whatever_the_network(
    seed: int, codec: str, simulators: int
) -> None:
    world = World(bad(seed, flips=codec != "text"), codec=codec, simulators=simulators)
    world.run_steps(150)
    world.check()
    counters = world.server.statistics.counters
    assert counters["sessions"] == simulators
    assert counters["duplicate"] > 50
    for physics in world.physics:
        steps = physics.steps[physics.session]
        assert len(steps) >= 150
        resent = physics.link.statistics.counters["resent"]
        assert resent > 25
    if codec != "text":
        assert counters["malformed"] + counters["forged"] > 5


@pytest.mark.parametrize("lost", [{1}, {2}, {3}, {4}, {1, 2, 3}, {5, 6, 7, 8}, {2, 5, 9}])
def test_chosen_losses(lost: set[int]) -> None:
    numbers = itertools.count(1)

    def losing(datagram: bytes) -> list[tuple[float, bytes]]:
        if next(numbers) in lost:
            return []
        return [(0.001, datagram)]

    world = World(losing)
    world.run_steps(5)
    world.check()
    (physics,) = world.physics
    assert physics.link.statistics.counters["resent"] == len(lost)


def test_a_clean_network_repeats_nothing() -> None:
    world = World(clean)
    world.run_steps(100)
    world.check()
    assert world.now == pytest.approx(1000.0 + 0.002 * 101)
    physics = world.physics[0]
    assert physics.link.statistics.counters == {"sent": 102, "received": 101, "sessions": 1}
    assert world.server.statistics.counters == {"sent": 101, "received": 101, "sessions": 1}
    assert len(physics.link.statistics.round_trips) == 100
    assert max(physics.link.statistics.round_trips) == pytest.approx(0.002)


# ---- restarts


def test_a_clean_restart_of_the_agent_costs_one_message_more() -> None:
    world = World(clean, codec="sealed")
    world.run_steps(10)
    physics = world.physics[0]
    world.pass_time(lambda: physics.link.state == "waiting")
    world.send()
    world.flying.clear()  # what was on its way to the one that was killed
    old = physics.session
    world.start_agent()
    world.run_steps(10)
    assert physics.session != old
    world.check()
    # The resent State brings an Unknown, then comes the Hello; the tenth Command is on its way.
    counters = world.server.statistics.counters
    assert counters == {"received": 12, "sent": 12, "foreign": 1, "sessions": 1}
    assert len(physics.steps[old]) == 10


@pytest.mark.parametrize("codec", ["binary", "sealed"])
@pytest.mark.parametrize("seed", range(4))
def test_a_simulator_that_is_started_again_has_its_place_back(seed: int, codec: str) -> None:
    world = World(bad(seed), codec=codec, simulators=3)
    dice = random.Random(seed)
    for _ in range(4):
        world.run_steps(dice.randrange(12))
        again = dice.choice(world.physics)
        begun = world.now
        others = [p for p in world.physics if p is not again]
        sessions = [p.session for p in others]
        physics = world.start_simulator(again.address)
        world.run_steps(10, most=200)
        world.check()
        assert not physics.ended
        assert [p.session for p in others] == sessions  # it is nobody else's business
        assert begun < world.now
    assert not any(p.ended for p in world.physics)


@pytest.mark.parametrize("codec", ["binary", "sealed"])
@pytest.mark.parametrize("seed", range(2))
def test_more_simulators_than_slots_take_turns(seed: int, codec: str) -> None:
    world = World(bad(seed), codec=codec, simulators=4, slots=2)
    flown: set[Address] = set()
    while len(flown) < 4:
        world.pass_time(
            lambda: any(len(p.steps.get(p.session, [])) >= 10 for p in world.physics), most=100
        )
        for physics in [p for p in world.physics if len(p.steps.get(p.session, [])) >= 10]:
            physics.link.close("enough", world.now)
            world.pass_time(lambda p=physics: p.link.state == "closed", most=1)  # type: ignore[misc]
            flown.add(physics.address)
            world.check()
            world.remove(physics)
    assert not any(p.ended for p in world.physics)


@pytest.mark.parametrize("codec", ["binary", "sealed"])
@pytest.mark.parametrize("seed", range(4))
def test_after_any_trouble_all_fly_again(seed: int, codec: str) -> None:
    """Whatever was lost, late or restarted: once the network is good, nobody hangs."""
    world = World(bad(seed), codec=codec, simulators=3)
    dice = random.Random(seed)
    for _ in range(12):
        end = world.now + dice.choice([0.005, 0.3, 1.0, 4.0])
        world.pass_time(lambda end=end: world.now >= end)  # type: ignore[misc]
        if dice.random() < 0.4:
            world.start_agent()
        elif dice.random() < 0.7:
            world.start_simulator(dice.choice(world.physics).address)
    world.fate = clean
    assert not any(p.ended for p in world.physics)
    world.run_steps(20, most=10)
    world.check()


def test_a_text_agent_that_is_started_again_takes_up_the_session() -> None:
    world = World(bad(5, flips=False), codec="text")
    world.run_steps(20)
    physics = world.physics[0]
    world.start_agent()
    world.run_steps(20, most=200)
    assert world.joined == [0, 0]
    assert physics.link.sequence > 40
    assert len(physics.steps[physics.session]) == physics.link.sequence - 1


def test_a_text_simulator_that_is_started_again_is_taken_in_after_the_silence() -> None:
    world = World(clean, codec="text")
    world.run_steps(20)
    begun = world.now
    world.start_simulator(world.physics[0].address)  # its numbers are old ones
    world.pass_time(lambda: bool(world.joined[1:]), most=100)
    assert world.now - begun == pytest.approx(SILENCE, abs=1)
    assert world.server.statistics.counters["stale"] > 20
    world.run_steps(20)


# ---- the end


@pytest.mark.parametrize("codec", ["binary", "text", "sealed"])
@pytest.mark.parametrize("side", ["simulator", "agent"])
def test_a_close_is_answered_by_a_close(side: str, codec: str) -> None:
    world = World(clean, codec=codec, simulators=2)
    world.run_steps(5)
    begun = world.now
    if side == "simulator":
        for physics in world.physics:
            physics.link.close("enough", world.now)
    else:
        world.server.close("enough", world.now)
    world.pass_time(lambda: all(p.link.state == "closed" for p in world.physics), most=1)
    world.pass_time(lambda: world.server.slots == [None, None], most=1)
    assert world.now - begun == pytest.approx(0.002, abs=1e-6)
    if side == "simulator":
        assert world.closes == ["the simulator closed" if codec == "text" else "enough"] * 2
    else:
        reason = "the agent closed" if codec == "text" else "enough"
        assert [p.ended for p in world.physics] == [reason] * 2
    sent = sum(p.link.statistics.counters["resent"] for p in world.physics)
    assert sent == world.server.statistics.counters["resent"] == 0


@pytest.mark.parametrize("codec", ["binary", "text", "sealed"])
@pytest.mark.parametrize("side", ["simulator", "agent", "both"])
@pytest.mark.parametrize("seed", range(5))
def test_closes_that_are_lost_are_repeated(seed: int, side: str, codec: str) -> None:
    dice = random.Random(seed)
    world = World(clean, codec=codec)
    world.run_steps(5)
    world.fate = lambda datagram: [(0.001, datagram)] if dice.random() < 0.6 else []
    physics = world.physics[0]
    if side != "agent":
        physics.link.close("enough", world.now)
    if side != "simulator":
        world.server.close("enough", world.now)
    begun = world.now
    world.pass_time(lambda: physics.link.state == "closed" and world.server.slots == [None], most=1)
    assert world.now - begun < 0.26
    # None of it was left to the linger alone: ten tries each way.
    assert physics.ended or world.closes


def test_nobody_answers_a_close() -> None:
    world = World(clean)
    world.run_steps(5)
    world.fate = lambda datagram: []
    world.physics[0].link.close("enough", world.now)
    world.server.close("enough", world.now)
    begun = world.now
    world.pass_time(lambda: world.physics[0].link.state == "closed", most=1)
    assert world.now - begun == pytest.approx(0.25)
    world.pass_time(lambda: world.server.slots == [None], most=1)
    assert world.now - begun == pytest.approx(0.25)

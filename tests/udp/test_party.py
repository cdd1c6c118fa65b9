"""The rules of a world that several agents fly, without sockets and on a fake clock."""

from typing import Any

import numpy as np
import pytest
from links import HERE, NONCE, BothSides, hello, layout, outgoing
from rotorgram.udp.protocol import binary
from rotorgram.udp.protocol.client import Client, LinkConfig
from rotorgram.udp.protocol.errors import LinkError, PeerSilent, Refused
from rotorgram.udp.protocol.messages import (
    FLY,
    FREEZE,
    RESET,
    Close,
    State,
)
from rotorgram.udp.protocol.party import AgentLink, Participation, SeveralAgents
from rotorgram.udp.protocol.server import Server

PATIENCE = 10.0
TIMEOUT = 60.0


class World:
    """Two drones; it notes what is done to it."""

    def __init__(self) -> None:
        self.height = np.zeros((2, 1), np.float32)
        self.rewards = np.zeros(2)
        self.terminated = self.truncated = self.out = np.zeros(2, bool)
        self.telemetry: dict[str, Any] = {}
        self.flown: list[list[float]] = []
        self.seeds: list[list[int] | None] = []

    @property
    def observations(self) -> dict[str, Any]:
        return {"height": self.height}

    def advance(self, actions: Any, resets: Any, seeds: Any, frozen: Any, asks: Any = None) -> None:
        if resets is not None:
            assert resets.all()
            self.seeds.append(None if seeds is None else seeds.tolist())
            self.height = np.zeros((2, 1), np.float32)
            return
        self.flown.append(actions[:, 0].tolist())
        self.height = self.height + actions


class Swarm(BothSides):
    """Both sides of a world of two drones, each flown by an agent of its own."""

    def __init__(self, shares: tuple[list[int], ...] = ([0], [1])) -> None:
        self.now = 0.0
        self.world = World()
        self.layout = layout(len(shares[0]))
        config = LinkConfig(timeout=TIMEOUT)
        links = []
        for i, rows in enumerate(shares):
            client = Client(hello(70 + i), self.layout, config, draw_session=lambda i=i: 80 + i)
            links.append(AgentLink(("127.0.0.1", 1000 + i), client, np.array(rows)))
        self.rules = SeveralAgents(self.world, layout(2), 0.1, links, patience=PATIENCE)
        self.agents = [self.agent() for _ in shares]
        self.states: list[list[State]] = [[], []]
        self.closed = ["", ""]
        self.rules.start(0.0)

    def agent(self, refusal: str = "") -> Server:
        return Server(lambda _: refusal or self.layout, draw_nonce=lambda: NONCE)

    def pump(self) -> None:
        """Carry datagrams until nothing moves."""
        moving = True
        while moving:
            moving = self.rules.step(self.now)
            self.rules.answer(self.now)
            pairs = zip(self.rules.links, self.agents, strict=True)
            for number, (link, agent) in enumerate(pairs):
                for datagram in outgoing(link.client):
                    event = agent.receive(datagram, HERE, self.now)
                    if event and isinstance(event.message, State):
                        self.states[number].append(event.message)
                    elif event:
                        self.closed[number] = event.message.reason
                    moving = True
                for datagram, _ in outgoing(agent):
                    self.rules.receive(link, datagram, self.now)
                    moving = True

    def say(self, number: int, order: int, value: float = 0.0, seed: int | None = None) -> None:
        seeds = None if seed is None else np.array([seed], np.uint64)
        actions = np.full((1, 1), value, np.float32)
        orders = np.array([order], np.uint8)
        self.send(number, actions, orders, seeds)

    def send(self, number: int, actions: Any, orders: Any, seeds: Any = None) -> None:
        (session,) = self.agents[number].slots
        assert session is not None
        session.send_command(actions, orders, seeds, self.now)

    def never_answered(self) -> None:
        """Let time pass in which every datagram is lost."""
        while True:
            self.now = self.rules.next_timer()
            self.rules.handle_timers(self.now)

    def restart(self, number: int) -> None:
        """Another agent takes the place of one that was killed."""
        self.agents[number] = self.agent()

    @property
    def participations(self) -> list[Participation]:
        return [link.participation for link in self.rules.links]


def begun() -> Swarm:
    """A world in which both have flown a step."""
    swarm = Swarm()
    swarm.pump()
    for number in (0, 1):
        swarm.say(number, FLY, number + 1.0)
    swarm.pump()
    assert swarm.world.flown == [[1.0, 2.0]]
    return swarm


def test_the_world_steps_when_all_have_answered() -> None:
    swarm = begun()
    assert swarm.world.seeds == [[70, 71]]  # the session of the first drone's agent, and one more
    assert [[s.observations[0].item() for s in states] for states in swarm.states] == [
        [0.0, 1.0], [0.0, 2.0]
    ]  # fmt: skip
    swarm.say(0, FLY, 5.0)
    swarm.pump()
    assert len(swarm.world.flown) == 1
    swarm.say(1, FLY, 6.0)
    swarm.pump()
    assert swarm.world.flown[1:] == [[5.0, 6.0]]


def test_all_have_to_ask_for_a_reset() -> None:
    swarm = begun()
    swarm.say(1, RESET, seed=9)
    swarm.pump()
    assert swarm.world.seeds == [[70, 71]]
    swarm.say(0, RESET, seed=5)
    swarm.pump()
    assert swarm.world.seeds == [[70, 71], [5, 5]]
    assert swarm.participations == ["flying"] * 2


def test_the_drones_of_a_silent_agent_hold() -> None:
    swarm = begun()
    swarm.say(0, FLY, 1.0)
    swarm.pump()
    swarm.wait(PATIENCE - 0.1)
    assert swarm.participations[1] == "flying"
    swarm.wait(0.2)
    assert swarm.participations[1] == "ready"  # in a new session
    assert swarm.world.flown[1:] == [[1.0, 0.0]]
    swarm.say(1, FLY, 7.0)  # it comes back, and gets State 1 of the next episode
    swarm.pump()
    assert len(swarm.world.flown) == 2
    swarm.say(0, RESET, seed=3)
    swarm.pump()
    assert swarm.states[1][-1].sequence == 1
    assert swarm.world.seeds[1:] == [[3, 3]]
    assert swarm.participations == ["flying"] * 2


def test_an_agent_that_is_started_anew_flies_from_the_next_episode_on() -> None:
    swarm = Swarm()
    swarm.pump()
    swarm.restart(0)
    swarm.wait(1.0)  # its State is answered with Unknown
    assert swarm.participations == ["ready", "flying"]
    swarm.say(1, FLY, 2.0)
    swarm.pump()
    assert swarm.world.flown == [[0.0, 2.0]]
    swarm.say(1, RESET, seed=9)
    swarm.pump()
    assert swarm.participations == ["flying"] * 2
    assert swarm.rules.episodes == 2


def test_an_agent_that_asks_for_a_reset_before_the_others_waits_for_them() -> None:
    swarm = begun()
    swarm.say(1, RESET)
    swarm.say(0, FLY, 3.0)
    swarm.pump()
    assert swarm.world.flown[1:] == [[3.0, 0.0]]
    assert swarm.participations == ["flying", "waiting"]
    swarm.say(0, RESET, seed=4)
    swarm.pump()
    assert swarm.world.seeds[1:] == [[4, 4]]
    assert swarm.participations == ["flying"] * 2


def test_an_agent_that_resets_a_start_gets_it_again() -> None:
    swarm = Swarm()
    swarm.pump()
    swarm.say(0, RESET, seed=4)
    swarm.say(1, FLY, 1.0)
    swarm.pump()
    assert swarm.world.seeds == [[70, 71]]
    assert swarm.world.flown == []
    swarm.say(0, FLY, 2.0)
    swarm.pump()
    assert swarm.rules.episodes == 1
    assert len(swarm.states[0]) - len(swarm.states[1]) == 1


def test_an_agent_that_came_back_does_not_hide_the_seeds_of_the_others() -> None:  # fault 50
    swarm = begun()
    swarm.restart(0)
    swarm.wait(1.0)  # its State is answered with Unknown; it begins a new session
    assert swarm.participations[0] == "ready"
    swarm.say(1, RESET, seed=9)
    swarm.pump()
    assert swarm.world.seeds[1:] == [[9, 9]]
    assert swarm.rules.cause is not None
    assert swarm.rules.cause.seeds.tolist() == [9, 9]
    assert swarm.participations == ["flying"] * 2


def test_different_orders_of_one_agent_close_its_link() -> None:
    swarm = Swarm(([0, 1],))
    swarm.pump()
    orders = np.array([FLY, FREEZE], np.uint8)
    swarm.send(0, np.zeros((2, 1), np.float32), orders)
    swarm.pump()
    reason = "orders: expected to fly or to reset all 2 drones, got others"
    assert swarm.closed[0] == reason
    assert swarm.participations == ["left"]
    assert swarm.world.flown == []


@pytest.mark.parametrize(
    ("order", "reason"),
    [(FLY, "an action came after the end of an episode: expected a reset"),
     (FREEZE, "orders: expected to fly or to reset all 1 drones, got others")],
)  # fmt: skip
def test_a_command_that_the_world_cannot_follow_closes_one_link(order: int, reason: str) -> None:
    swarm = begun()
    if order == FLY:
        swarm.world.out = np.array([False, True])
    swarm.say(0, FLY, 1.0)
    swarm.say(1, order)
    swarm.pump()
    assert swarm.participations == ["flying", "left"]
    assert len(swarm.world.flown) == 2
    swarm.agents[0].close("enough", swarm.now)
    swarm.pump()
    assert swarm.rules.reason == "enough"
    assert swarm.closed == ["", reason]


def test_before_the_world_begins_a_refusal_and_silence_end_it() -> None:
    swarm = Swarm()
    swarm.agents[1] = swarm.agent("another vehicle")
    with pytest.raises(Refused, match=r"^the agent at 127.0.0.1:1001 refused: another vehicle$"):
        swarm.pump()
    silent = Swarm()
    sentence = "^no answer from the agent at .* for 60 s, Hello sent .*, and the world begins when"
    with pytest.raises(PeerSilent, match=sentence):
        silent.never_answered()


def test_an_agent_that_closes_before_the_world_begins_ends_it() -> None:
    swarm = Swarm()
    link = swarm.rules.links[0]
    server = swarm.agents[0]
    for datagram in outgoing(link.client):
        server.receive(datagram, HERE, 0.0)
    for datagram, _ in outgoing(server):
        swarm.rules.receive(link, datagram, 0.0)
    assert link.participation == "ready"
    bye = binary.encode(Close(session=70, sequence=0, reason="no more"))
    with pytest.raises(LinkError, match=r"1000 closed before the world began: no more$"):
        swarm.rules.receive(link, bye, 0.0)


def test_time_that_this_process_was_stopped_counts_for_nobody() -> None:
    swarm = begun()
    swarm.say(0, FLY, 1.0)
    swarm.pump()
    swarm.now += 1000.0
    swarm.rules.pardon(1000.0)
    swarm.rules.handle_timers(swarm.now)
    assert swarm.participations == ["flying"] * 2
    swarm.wait(PATIENCE)
    assert swarm.participations[1] == "ready"

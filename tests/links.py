"""What the tests of both state machines share: messages, layouts, both sides, and a network."""

import random
from collections.abc import Callable
from heapq import heappop, heappush
from math import inf
from typing import Any

import numpy as np
from rotorgram.udp.protocol import binary
from rotorgram.udp.protocol.auth import Key
from rotorgram.udp.protocol.client import Address, Client, LinkConfig
from rotorgram.udp.protocol.layout import ArrayLayout, Layout
from rotorgram.udp.protocol.messages import (
    FLY,
    Close,
    Command,
    Hello,
    Message,
    Missing,
    Refuse,
    State,
    Unknown,
    Wait,
    Welcome,
)
from rotorgram.udp.protocol.party import WorldRules
from rotorgram.udp.protocol.server import Server
from rotorgram.udp.protocol.session import Event

SESSION = 77
OTHER = 78
NONCE = 99
HERE = ("127.0.0.1", 8000)
STRANGER = ("127.0.0.1", 9999)
CONFIG = LinkConfig(timeout=10)
SECRET = bytes(range(32))
CAUSES = {"malformed", "forged", "foreign", "refused", "duplicate", "stale"}
SHARED = {Hello, Welcome, Refuse, Wait, Unknown}
"""Sealed with the shared key; all else with that of the session."""


def layout(drones: int = 1, size: int = 1, shapes: tuple[tuple[int, ...], ...] = ()) -> Layout:
    numbers = ArrayLayout(shape=(size,))
    told = tuple((shape, "") for shape in shapes)
    return Layout(drones=drones, observation=(numbers,), action=numbers, telemetry=told)


ONE = layout()


def hello(session: int = SESSION, **changes: Any) -> Hello:
    return Hello(**{"session": session, "spec": '{"env_id":"a/B-v0"}', **changes})


def state(
    sequence: int, session: int = SESSION, value: float = 0.0, of: Layout = ONE, nonce: int = NONCE
) -> State:
    n = of.drones
    observations = [np.full((n, *a.shape), value).astype(a.dtype) for a in of.observation]
    telemetry = [np.zeros((n, *shape)) for shape, _ in of.telemetry]
    return State(
        session=session,
        sequence=sequence,
        time=0.0,
        nonce=nonce if sequence == 1 else 0,
        observations=tuple(observations),
        rewards=np.zeros(n),
        terminated=np.zeros(n, bool),
        truncated=np.zeros(n, bool),
        telemetry=tuple(telemetry),
    )


def command(sequence: int, session: int = SESSION, value: float = 0.0, of: Layout = ONE) -> Command:
    actions = np.full(of.actions.shape, value).astype(of.actions.dtype)
    orders = np.full(of.drones, FLY, np.uint8)
    return Command(session=session, sequence=sequence, actions=actions, orders=orders)


def close(sequence: int, session: int = SESSION, reason: str = "bye") -> Close:
    return Close(session=session, sequence=sequence, reason=reason)


WELCOME = Welcome(session=SESSION, nonce=NONCE)


def simulator(
    *, of: Layout = ONE, sealed: bool = False, config: LinkConfig = CONFIG, **rest: Any
) -> Client:
    key = Key(SECRET, "simulator") if sealed else None
    said = rest.pop("said", hello())
    return Client(said, of, config, key=key, **{"draw_session": lambda: OTHER, **rest})


def agent(
    refusal: str = "", *, of: Layout = ONE, sealed: bool = False, slots: int = 1, **rest: Any
) -> Server:
    key = Key(SECRET, "agent") if sealed else None
    rest = {"draw_nonce": lambda: NONCE, "text_layout": lambda: ONE, **rest}
    return Server(lambda _: refusal or of, slots=slots, key=key, **rest)


class BothSides:
    """A world and its agents, on a clock that the test moves."""

    now: float
    rules: WorldRules

    def pump(self) -> None:
        """Carry datagrams until nothing moves."""
        raise NotImplementedError

    def wait(self, seconds: float) -> None:
        """Let time pass, with every timer at its time."""
        until = self.now + seconds
        while self.rules.next_timer() <= until:
            self.now = max(self.now, self.rules.next_timer())
            self.rules.handle_timers(self.now)
            self.pump()
        self.now = until


def outgoing(side: Client | Server) -> Any:
    """The datagrams that a side has to send, each once."""
    if isinstance(side, Client):
        taken: Any = side.outgoing
        side.outgoing = []
    else:
        taken = side.outbox.datagrams
        side.outbox.datagrams = []
    return taken


def send_state(link: Client, value: float, now: float) -> State:
    """The next State of a client, every number of its observation the same."""
    s = state(1, value=value, of=link.layout)
    return link.send_state(
        0.0, s.observations, s.rewards, s.terminated, s.truncated, s.telemetry, now
    )


def send_command(server: Server, slot: int, value: float, now: float) -> None:
    session = server.slots[slot]
    assert session is not None
    c = command(1, value=value, of=session.layout)
    session.send_command(c.actions, c.orders, None, now)


class Wire:
    """Makes the datagrams of one side as they travel: sealed or not."""

    def __init__(self, side: Any, sealed: bool) -> None:
        self.key = Key(SECRET, side) if sealed else None

    def __call__(self, message: Message, asked: bytes = b"") -> bytes:
        """As an answer to a State, if it is an Unknown."""
        datagram = binary.encode(message, ONE)
        if self.key is None:
            return datagram
        if type(message) in SHARED or (isinstance(message, Missing) and not message.sequence):
            return self.key.seal(datagram, asked if isinstance(message, Unknown) else b"")
        return self.key.for_session(message.session, NONCE).seal(datagram)


def dropped(link: Client | Server) -> dict[str, int]:
    return {cause: n for cause, n in link.statistics.counters.items() if cause in CAUSES and n}


Fate = Callable[[bytes], list[tuple[float, bytes]]]
"""What becomes of a datagram: delays, s, and bytes."""


class Network:
    """Simulators and an agent, joined by a network with a clock of its own.

    Time passes from one event to the next: an arrival or a timer.
    """

    def __init__(self, server: Server, fate: Fate, clients: dict[Address, Client]) -> None:
        self.server = server
        self.fate = fate
        self.clients = clients
        self.now = 0.0
        self.sent = 0
        self.flying: list[tuple[float, int, bool, Address, bytes]] = []
        """When it arrives, its number, whether at the agent, the simulator's address, the bytes."""
        self._copies = 0

    def agent_received(self, event: Any, address: Address) -> None:
        """The agent took a datagram: what its server made of it."""
        raise NotImplementedError

    def simulator_received(self, address: Address, datagram: bytes) -> None:
        """A datagram reaches a simulator."""
        raise NotImplementedError

    def silence(self, address: Address) -> None:
        """A simulator gave its agent up."""
        raise AssertionError("silent")

    def free_slots(self) -> None:
        """Look for simulators that were silent."""

    def pass_time(self, until: Callable[[], bool], most: float = inf) -> None:
        """Let time pass until something is so; at most that many seconds."""
        end = self.now + most
        while not until():
            self.send()
            assert self.now < end, f"not in {most} s"
            timers = [client.next_timer() for client in self.clients.values()]
            due = min([self.server.next_timer(), *timers])
            if self.flying and self.flying[0][0] <= due:
                self._arrive()
            else:
                assert due < inf, "nothing will ever happen"
                self.now = max(self.now, due)
                self.server.handle_timer(self.now)
                for address, client in self.clients.items():
                    if not client.handle_timer(self.now):
                        self.silence(address)
            self.free_slots()

    def send(self) -> None:
        """Put what both sides have to send on its way."""
        for address, client in self.clients.items():
            for datagram in outgoing(client):
                self._put(True, address, datagram)
        for datagram, address in outgoing(self.server):
            if address in self.clients:
                self._put(False, address, datagram)

    def _put(self, up: bool, address: Address, datagram: bytes) -> None:
        self.sent += 1
        for delay, copy in self.fate(datagram):
            self._copies += 1
            heappush(self.flying, (self.now + delay, self._copies, up, address, copy))

    def _arrive(self) -> None:
        arrival, _, up, address, datagram = heappop(self.flying)
        self.now = max(self.now, arrival)
        if up:
            self.agent_received(self.server.receive(datagram, address, self.now), address)
        elif address in self.clients:  # whoever is there now: a killed process reads nothing
            self.simulator_received(address, datagram)


class Pair(Network):
    """One simulator counts its steps in its observation, the agent its choices in its action."""

    def __init__(self, client: Client, server: Server, fate: Fate, peer: Address = HERE) -> None:
        super().__init__(server, fate, {peer: client})
        self.client = client
        self.steps: list[float] = []
        """Actions in the order in which the simulator stepped them."""
        self.seen: list[float] = []
        """Observations in the order in which the agent took them."""

    def run(self, steps: int) -> None:
        self.client.connect(self.now)
        self.pass_time(lambda: len(self.steps) >= steps)

    def agent_received(self, event: Any, address: Address) -> None:
        if isinstance(event, Event) and isinstance(event.message, State):
            self.seen.append(float(event.message.observations[0].flat[0]))
            send_command(self.server, event.slot, len(self.seen), self.now)

    def simulator_received(self, address: Address, datagram: bytes) -> None:
        message = self.client.receive(datagram, self.now)
        if isinstance(message, Command):
            self.steps.append(float(message.actions.flat[0]))
        if isinstance(message, Command | Welcome):
            send_state(self.client, len(self.steps), self.now)


class Fleet(Network):
    """Simulators, one for each slot of an agent that answers all of their States at once."""

    def __init__(self, clients: list[Client], server: Server, fate: Fate) -> None:
        super().__init__(server, fate, {(HERE[0], i): each for i, each in enumerate(clients)})
        self.steps = 0

    def run(self, steps: int) -> None:
        for client in self.clients.values():
            client.connect(self.now)
        self.pass_time(lambda: self.steps >= steps)

    def agent_received(self, event: Any, address: Address) -> None:
        slots = self.server.slots
        if all(session and session.state == "deciding" for session in slots):
            self.steps += 1
            for slot in range(len(slots)):
                send_command(self.server, slot, 0.0, self.now)

    def simulator_received(self, address: Address, datagram: bytes) -> None:
        client = self.clients[address]
        message = client.receive(datagram, self.now)
        if isinstance(message, Command | Welcome):
            send_state(client, 0.0, self.now)


def lossy(share: float, delay: float = 1e-3, seed: int = 1) -> Fate:
    """Loses a share of all datagrams; the others take `delay`, s."""
    dice = random.Random(seed)
    return lambda datagram: [] if dice.random() < share else [(delay, datagram)]

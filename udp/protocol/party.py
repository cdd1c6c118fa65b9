"""The rules of a simulator: what its world does with the messages of its agents.

Free of sockets and clocks, as `client`: a driver hands in datagrams and the time, and then calls
`step` and `answer`. `OneAgent` commands every drone; `SeveralAgents` share the drones of one world.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from operator import itemgetter
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from .client import Address, Client, address_text
from .errors import LinkError, PeerSilent, Refused
from .layout import Array, Layout
from .messages import FLY, RESET, Close, Command, Refuse, Welcome
from .statistics import warn

Mask = NDArray[np.bool_]
Seeds = NDArray[np.uint64]

_COMPLAIN_AFTER = 1.0  # silence of an agent before it is logged, once for each message, s
NO_RESET = "an action came after the end of an episode: expected a reset"


class World(Protocol):
    """N drones that take a step of the wire together: see `rotorgram.envs.Loop`."""

    rewards: NDArray[np.float64]
    terminated: Mask
    truncated: Mask
    done: Mask
    out: Mask

    @property
    def observations(self) -> Mapping[str, Array]: ...
    @property
    def telemetry(self) -> Mapping[str, NDArray[np.float64]]: ...
    def advance(
        self,
        actions: Array,
        resets: Mask | None,
        seeds: Seeds | None,
        frozen: Mask | None,
        asks: Seeds | None = None,
    ) -> None: ...


Participation = Literal["coming", "ready", "flying", "waiting", "left"]
"""What an agent does in the running episode.

* `coming`: its Welcome is awaited, at first, or since it was silent or started anew.
* `ready`: its Welcome has come; the next episode sends its first State.
* `flying`: the world waits for its Commands.
* `waiting`: it asked for a reset, and waits for it.
* `left`: it closed, or was silent for too long.
"""


@dataclass(eq=False)
class AgentLink:
    """One agent of a simulator."""

    address: Address
    client: Client
    """The exchange with it, with its statistics."""
    rows: slice | Array
    """Rows of its drones in the arrays of a world: the first agent has the first."""
    participation: Participation = "coming"
    command: Command | None = None
    """The Command that the next step or reset takes."""
    patient_until: float = 0.0
    """When it is lost if no Command has come, s."""
    seed: int = 0
    """Of the first episode, as of its Welcome."""
    trouble: str = ""
    """Why datagrams do not reach it, as far as the transport knows."""
    logged: float = -inf
    """Send time of the last message whose silence was logged."""

    @property
    def name(self) -> str:
        """For sentences."""
        return f"the agent at {address_text(self.address)}"

    @property
    def order(self) -> int | None:
        """The order of its Command for all its drones; None if they differ."""
        assert self.command is not None
        orders = self.command.orders
        return int(orders[0]) if (orders == orders[0]).all() else None

    def silence(self, seconds: float, sends: int) -> str:
        """A sentence about an answer that did not come."""
        client = self.client
        message = f"State {client.sequence}" if client.sequence else "Hello"
        words = f"no answer from {self.name} for {seconds:g} s, {message} sent {sends} times"
        if self.trouble:
            words += f"; {self.trouble}"
        if client.key and not client.sequence:
            words += "; an agent with another key does not answer"
        if last := client.statistics.last_error:
            words += f"; last datagram dropped: {last}"
        return words


Links = list[AgentLink]


@dataclass(eq=False)
class WorldRules:
    """Base of the rules: the links, their timers and their ends.

    The caller hands each datagram to `receive`, and calls `step` and `answer` after it.

    Attributes:
        links: The agents.
        reason: Why the flight has ended; None before.
        cause: The Command that moved the world; the driver sets it to None when it has looked.
        unasked: Steps of the session that no Command has asked for.
        more: Telemetry beside the world's, of all drones.
    """

    world: World
    layout: Layout
    period: float  # of a control step, s
    links: Links

    def __post_init__(self) -> None:
        self.reason: str | None = None
        self.cause: Command | None = None
        self._due: Links = []  # of States
        self.unasked = 0
        self.more: tuple[Array, ...] = ()

    def start(self, now: float) -> None:
        """Say Hello to every agent."""
        for link in self.links:
            link.client.connect(now)

    def next_timer(self) -> float:
        """When `handle_timers` wants to be called; infinite if never."""
        timer = inf
        for link in self.links:
            timer = min(timer, link.client.resend_at, link.client.deadline)
        return timer

    def handle_timers(self, now: float) -> None:
        """Resend what is due. Raises `PeerSilent` where the flight cannot go on."""
        for link in self.links:
            client = link.client
            if now < client.next_timer():
                continue
            sends = client.sends
            asked_at = client.asked_at
            unlogged = now > asked_at + _COMPLAIN_AFTER and link.logged != asked_at
            if not client.handle_timer(now):
                self._lose_silent(link, link.silence(client.config.timeout, sends))
            elif unlogged and not client.is_queued and (link.trouble or not client.sequence):
                link.logged = asked_at
                words = link.silence(_COMPLAIN_AFTER, client.sends)
                warn(f"{words}; asking for {client.config.timeout:g} s in all")

    def pardon(self, seconds: float) -> None:
        """Move all deadlines: this process was stopped, and the agents could not know."""
        for link in self.links:
            link.client.deadline += seconds
            link.patient_until += seconds

    def close(self, reason: str, now: float) -> None:
        """End every exchange."""
        for link in self.links:
            link.client.close(reason, now)

    def answer(self, now: float) -> None:
        """Send the States that are due. Raises `InputError` if one is not finite."""
        due = self._due
        self._due = []
        world = self.world
        for link in due:
            rows = link.rows
            own = itemgetter(rows)
            link.client.send_state(
                (link.client.sequence + self.unasked) * self.period,
                tuple(map(own, world.observations.values())),
                world.rewards[rows],
                world.terminated[rows],
                world.truncated[rows],
                tuple(map(own, (*world.telemetry.values(), *self.more))),
                now,
            )

    def _lose_silent(self, link: AgentLink, why: str) -> None:
        raise NotImplementedError


def first_seeds(seed: int, drones: int) -> Seeds:
    """Seeds of a simulator's own first reset: drone i takes seed + i, modulo 2^64."""
    return np.uint64(seed) + np.arange(drones, dtype=np.uint64)


def neutral(layout: Layout) -> Array:
    """Actions that change nothing."""
    actions = layout.actions.zeros()
    if layout.choices:
        actions += (layout.choices - 1) // 2
    return actions


def reset_of_all(layout: Layout, seeds: Seeds | None) -> Command:
    """A Command that resets every drone, such as the simulator's own first one."""
    orders = np.full(layout.drones, RESET, np.uint8)
    actions = layout.actions.zeros()
    return Command(session=0, sequence=0, actions=actions, orders=orders, seeds=seeds)


class OneAgent(WorldRules):
    """One agent commands every drone, each by its own order."""

    def __post_init__(self) -> None:
        super().__post_init__()
        (self._link,) = self.links
        self._client = self._link.client
        self._to_follow: Command | None = None
        self._all_fly = bytes(self.layout.drones)  # orders

    def start(self, now: float) -> None:
        """Say Hello. An agent that flies text sends no Welcome: begin without."""
        super().start(now)
        if self._client.by_text:
            self._begin(self._client.hello.session)

    def receive(self, link: AgentLink, datagram: bytes, now: float) -> None:
        """Take a datagram. Raises `Refused`."""
        message = self._client.receive(datagram, now)
        if message is None or self.reason is not None:
            return
        if isinstance(message, Command):
            self._to_follow = message
        elif isinstance(message, Welcome):
            self._begin(message.first_seed)
        elif isinstance(message, Refuse):
            raise Refused(f"{link.name} refused: {message.reason}")
        elif isinstance(message, Close):
            if self._client.by_text and not self._client.statistics.round_trips:
                raise Refused(
                    f"{link.name} closed before its first command: it has no free slot, has a key, "
                    "or flies no text"
                )
            self.reason = message.reason or "the agent closed"

    def step(self, now: float) -> bool:
        """Follow the last Command. False: no further call can move the world."""
        command = self._to_follow
        if command is None:
            return False
        if command.orders.tobytes() == self._all_fly:
            self.world.advance(command.actions, None, None, None, command.asks)
        else:
            resets = command.resets
            self.world.advance(command.actions, resets, command.seeds, command.frozen, command.asks)
        self.cause = command
        self._to_follow = None
        self._due.append(self._link)
        return False

    def _begin(self, seed: int) -> None:
        self.unasked = 0
        seeds = first_seeds(seed, self.layout.drones)
        self._to_follow = reset_of_all(self.layout, seeds)

    def _lose_silent(self, link: AgentLink, why: str) -> None:
        raise PeerSilent(why)


@dataclass(eq=False)
class SeveralAgents(WorldRules):
    """One world, in which each agent owns some of the drones.

    The world begins when all agents have come, and steps when all that fly have answered. It begins
    another episode when all that take part have asked for a reset. An agent that asks while others
    fly waits, and its drones hold meanwhile: they take the action that changes nothing. So do those
    of an agent that was silent for `patience`, was started anew or closed. An agent that comes back
    takes part again from the next episode on.

    Attributes:
        episodes: Begun so far; a reset before anything was flown begins the same episode again.
        steps: Control steps of the running episode.
    """

    patience: float  # longest wait for a Command, s

    def __post_init__(self) -> None:
        super().__post_init__()
        self.episodes = self.steps = 0

    # ---- episodes and steps

    def step(self, now: float) -> bool:
        """Step or begin the world if it is time to; whether another call may move it again."""
        flying = self._who("flying")
        if not self.episodes and len(self._who("ready")) < len(self.links):
            return False
        if not flying:
            if not self._who("waiting", "ready"):
                return False
            self._begin()
            return True
        if any(link.command is None for link in flying):
            return False
        # Closes the first wrong link; the next call looks again.
        if not any(self._close_wrong(link, now) for link in flying):
            self._follow(flying)
        return True

    def _follow(self, flying: Links) -> None:
        """Do what the Commands of all flying agents say."""
        resetting = [link for link in flying if link.order == RESET]
        if len(resetting) == len(flying):
            self._begin()
        elif self.steps == 0 and resetting:
            for link in resetting:  # its episode has just begun: the same start again
                self._queue(link)
        else:
            self._fly(flying)

    def _begin(self) -> None:
        """Begin an episode for all that take part."""
        joining = self._who("flying", "waiting", "ready")
        self.cause = reset = reset_of_all(self.layout, self._seeds(joining))
        self.world.advance(reset.actions, reset.resets, reset.seeds, None)
        if self.steps or not self.episodes:
            self.episodes += 1
        self.steps = 0
        for link in joining:
            link.participation = "flying"
            self._queue(link)

    def _seeds(self, joining: Links) -> Seeds | None:
        """Seeds of the next episode, from the first Command of those that join; None: none came."""
        drones = self.layout.drones
        if not self.episodes:  # from the Welcome, as `OneAgent` takes it
            return first_seeds(joining[0].seed, drones)
        commands = [link.command for link in joining if link.command]
        seeds = commands[0].seeds if commands else None
        return None if seeds is None else np.full(drones, seeds[0], np.uint64)

    def _fly(self, flying: Links) -> None:
        """Fly the world for one control period."""
        actions = neutral(self.layout)
        asks = np.zeros(self.layout.drones, np.uint64)
        staying = []
        for link in flying:
            assert link.command is not None
            if link.order == RESET:
                self._lose(link, "waiting")
            else:
                staying.append(link)
                actions[link.rows] = link.command.actions
                if link.command.asks is not None:
                    asks[link.rows] = link.command.asks
        self.steps += 1
        orders = np.full(self.layout.drones, FLY, np.uint8)
        self.cause = Command(
            session=0, sequence=self.steps, actions=actions, orders=orders, asks=asks
        )
        self.world.advance(actions, None, None, None, asks)
        for link in staying:
            self._queue(link)

    def _close_wrong(self, link: AgentLink, now: float) -> bool:
        """Close a link whose Command the world cannot follow; True if it did."""
        if link.order not in (FLY, RESET):
            drones = link.client.layout.drones
            wrong = f"orders: expected to fly or to reset all {drones} drones, got others"
        elif link.order == FLY and self._is_out(link):
            wrong = NO_RESET
        else:
            return False
        link.client.close(wrong, now)
        self._lose(link, "left", wrong)
        return True

    def _lose(self, link: AgentLink, participation: Participation, why: str = "") -> None:
        """Let the drones of an agent hold for the rest of the episode."""
        flew = link.participation == "flying" and not self._is_out(link)
        link.participation = participation
        if participation != "waiting":
            link.command = None
        if flew and why:
            warn(f"{link.name} is lost ({why}): its drones hold")
        if len(self._who("left")) == len(self.links):
            self.reason = why

    def _is_out(self, link: AgentLink) -> bool:
        """Whether all of its drones are out."""
        return bool(self.world.out[link.rows].all())

    def _who(self, *wanted: Participation) -> Links:
        return [link for link in self.links if link.participation in wanted]

    # ---- States

    def _queue(self, link: AgentLink) -> None:
        """Send an agent the State of its drones with the next `answer`."""
        link.command = None
        self._due.append(link)

    def answer(self, now: float) -> None:
        """Send the States that are due."""
        for link in self._due:
            link.patient_until = now + self.patience
        super().answer(now)

    # ---- timers and messages

    def next_timer(self) -> float:
        """When `handle_timers` wants to be called; infinite if never."""
        flying = self._who("flying")
        patience = [link.patient_until for link in flying if link.command is None]
        return min([super().next_timer(), *patience])

    def handle_timers(self, now: float) -> None:
        """Resend what is due, and lose agents that were silent for too long."""
        for link in self._who("flying"):
            if link.command is None and now >= link.patient_until:
                self._lose(link, "coming", f"no Command for {self.patience:g} s")
                link.client.begin_again(now)
        super().handle_timers(now)

    def _lose_silent(self, link: AgentLink, why: str) -> None:
        if not self.episodes:
            raise PeerSilent(f"{why}, and the world begins when all have come")
        self._lose(link, "left", why)
        if self.reason is not None:
            raise PeerSilent(f"{why}, and no other is left")

    def receive(self, link: AgentLink, datagram: bytes, now: float) -> None:
        """Take a datagram of an agent. Before the world has begun, raises `LinkError`."""
        session = link.client.hello.session
        message = link.client.receive(datagram, now)
        if link.client.hello.session != session:  # its answer was Unknown
            self._lose(link, "coming", "it was started anew")
        elif link.participation == "left":
            return
        elif isinstance(message, Command):
            link.command = message
        elif isinstance(message, Welcome):
            link.participation = "ready"
            link.seed = message.first_seed
        elif isinstance(message, Refuse | Close):
            if self.episodes:
                self._lose(link, "left", message.reason or "the agent closed")
            elif isinstance(message, Refuse):
                raise Refused(f"{link.name} refused: {message.reason}")
            else:
                reason = message.reason or "no reason"
                raise LinkError(f"{link.name} closed before the world began: {reason}")


Rules = OneAgent | SeveralAgents

"""The simulator of several agents: one world, whose drones are flown by different processes."""

import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from enum import Enum
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from ...envs.spec import EnvSpec
from ...models.errors import InputError, NotCopied, expect
from ..layouts import layout_of
from ..protocol.auth import Key, read_keys
from ..protocol.client import Address, Client, LinkConfig, largest_datagram, new_session
from ..protocol.errors import LinkError, PeerSilent, Refused
from ..protocol.messages import (
    FLY,
    FREEZE,
    MAX_UINT64,
    POLICIES,
    RESET,
    WHEN_LOST,
    Close,
    Command,
    Hello,
    Message,
    Refuse,
    State,
    Welcome,
)
from ..protocol.transitions import SimulatorState
from .simulator import (
    ALIVE_EVERY,
    COMPLAIN_AFTER,
    DEFAULT_SIMULATOR,
    Observer,
    run_to_the_end,
)
from .sockets import LONGEST_WAIT, PAUSE, Port, address_text, log_notices, resolve
from .stepped import make_stepped

_LOST_STATES: Final = (SimulatorState.CLOSING, SimulatorState.CLOSED)


class Presence(Enum):
    """What an agent does in the running episode."""

    COMING = "coming"
    """It has not welcomed this simulator yet, or not again since it was started anew."""
    READY = "ready"
    """It has, and gets its first State with the next episode."""
    FLYING = "flying"
    """The world waits for its Commands."""
    WAITING = "waiting"
    """It asked for a reset, and waits for it."""
    SILENT = "silent"
    """The world waited for its Command in vain, and asks for it still."""
    LATE = "late"
    """It came back, and was told that its episode was truncated."""
    LEFT = "left"
    """It closed, or was silent for too long."""


class Absence(NamedTuple):
    """An agent whose drones its policy flies, until the end of an episode."""

    agent: int
    """Its number, from 0."""
    episode: int
    """Number of the episode, from 1 at the first State."""
    step: int
    """Control steps that its drones had flown in that episode by its Commands; 0 too if it takes no
    part at all."""
    presence: Presence
    """`WAITING`: it asked for a reset while others flew on."""


class Party:
    """One agent of a `SharedSimulator`.

    Attributes:
        number: From 0.
        address: Host and port.
        rows: Of its drones in the world's arrays, shape (n,).
        when_lost: Its policy.
        link: The exchange with it, with its statistics.
        presence: What it does in the running episode.
    """

    def __init__(
        self, number: int, address: Address, spec: EnvSpec, rows: np.ndarray, when_lost: str,
        config: LinkConfig, key: Key | None,
    ) -> None:  # fmt: skip
        self.number, self.address, self.rows, self.when_lost = number, address, rows, when_lost
        hello = Hello(session=new_session(), spec=spec.to_json())
        config = replace(config, drop_seed=config.drop_seed + number)
        largest = largest_datagram(address, config.max_datagram)
        self.link = Client(hello, layout_of(spec), config, largest=largest, key=key)
        self.presence = Presence.COMING
        self.command: Command | None = None  # that the next step or reset takes
        self.patient_until = 0.0
        self.complain_at: float | None = None
        self.seed: int | None = None  # of the Welcome
        self.in_flight = np.zeros(len(rows), bool)  # drones, when it was lost
        self.shown: tuple[Any, ...] = ()  # observations and telemetry of its last State

    @property
    def order(self) -> int | None:
        """What its Command says for all its drones; None if it says different things."""
        assert self.command is not None
        orders = self.command.orders
        return int(orders[0]) if (orders == orders[0]).all() else None


class SharedSimulator(NotCopied):
    """One world of several drones, each flown by one of several agents over UDP.

    Every agent is an ordinary one (`RemoteEnv`, `RemoteParallelEnv`, …): its Hello names its own
    drones, its States have their rows. The world steps when all agents that fly have answered, so
    its numbers are those of the world in process with the same actions, bit for bit.

    The world begins an episode when all agents that take part have asked for a reset; the seed of
    the first drone counts. An agent that asks while others fly waits, and its drones do meanwhile
    what its policy says. So they do once it is lost: it was silent for `patience`, was started
    anew, or closed. One that comes back takes part again from the next episode on.

    Args:
        env: Id of a registered task for several drones.
        agents: Their addresses (host, port), which share the drones evenly in their order; or, by
            address, the names of the drones of each.
        drones: Of the world: `drone_0` and so on.
        when_lost: Policy of agents that state none: `hold` (the action that changes nothing),
            `land` (`Loop.land`) or `end` (rotors stand still).
        patience: Longest wait for a Command, s.
        bind: Address of this side; port 0 takes a free one.
        config: Times of the exchange. `timeout`: longest wait for an agent that is to come, or to
            come back, s.
        Others: As `Simulator`.

    Attributes:
        address: Address of this side.
        spec: Spec of the env, with all drones.
        stepped: The loop.
        parties: The agents.
        observer: As of a `Simulator`, with Commands and States of the whole world, after a step or
            a reset (None); None at first.
        absences: Every `Absence` so far: with the seeds and the actions they determine each number.
        episodes: Begun so far; a reset before anything was flown begins the same anew.
        steps: Control steps of the running episode.
        seed: Of the running episode; None: the streams of the one before went on.

    Raises:
        InputError: An argument is not what it should be.
        OSError: The port is in use.
    """

    def __init__(
        self,
        env: str,
        agents: Sequence[Address] | Mapping[Address, Sequence[str]],
        *,
        drones: int,
        when_lost: str = "hold",
        patience: float = 10.0,
        bind: Address = DEFAULT_SIMULATOR,
        vehicle: Path | str | None = None,
        backend: str = "mujoco",
        config: LinkConfig | None = None,
        key_file: Path | str | None = None,
        insecure: bool = False,
        **options: Any,
    ) -> None:
        right = isinstance(patience, int | float) and 0 < patience < float("inf")
        expect(right, "patience", "seconds > 0", f"{patience!r}")
        expect(
            when_lost in POLICIES, "when_lost", f"one of {', '.join(POLICIES)}", f"{when_lost!r}"
        )
        key = Key(read_keys(key_file)[0], "simulator") if key_file else None
        anywhere, self.config = insecure or key is not None, config or LinkConfig()
        self.patience, self.absences, self.episodes, self.steps = patience, list[Absence](), 0, 0
        self.observer: Observer | None = None
        self.seed: int | None = None
        self._when_lost, self._stopped, self._ran = when_lost, False, False
        with ExitStack() as failing:
            self.stepped: Any = make_stepped(
                env, drones, drones=drones, vehicle=vehicle, backend=backend, options=options
            )
            failing.callback(self.stepped.close)
            right = hasattr(self.stepped, "retire")
            expect(right, "env", "a registered task for several drones", f"{env!r}")
            self.spec: EnvSpec = self.stepped.spec
            self._layout = layout_of(self.spec)
            self.parties = []
            for number, (address, names) in enumerate(_shares(agents, self.spec.agents)):
                there = resolve(address, insecure=anywhere)
                expect(there[1], "agents", "the port of each agent, 1 to 65535", "0")
                spec = replace(self.spec, agents=names)
                rows = np.array([self.spec.agents.index(name) for name in names])
                party = Party(number, there, spec, rows, when_lost, self.config, key)
                self.parties.append(party)
            self._by_address = {party.address: party for party in self.parties}
            same = len(self._by_address) == len(self.parties)
            expect(same, "agents", "a different address of each", f"{list(self._by_address)}")
            self._port = Port(bind, insecure=anywhere)
            failing.callback(self._port.close)
            self._port.keep(self._by_address)
            self.address: Address = self._port.address
            others = self.address not in self._by_address
            expect(others, "agents", "addresses of agents", f"that of this side, {self.address}")
            failing.pop_all()

    def run(self) -> str:
        """Fly until every agent has closed; the reason that the last one gave. Runs once.

        Raises:
            PeerSilent: An agent did not come within `config.timeout`; later: the last that was
                left did not come back.
            Refused: An agent turned this simulator away before the world began, with a reason.
            LinkError: An agent closed before the world began.
            KeyboardInterrupt: Ctrl-C.
        """
        if self._ran:
            raise ValueError("run: expected one call for each SharedSimulator, got another")
        self._ran = True
        return run_to_the_end(self._fly, self._close_links, self._say_alive, self.stop)

    def stop(self) -> None:
        """Make `run` tell the agents and return. May be called from another thread."""
        self._stopped = True

    def close(self) -> None:
        """Close the socket and the world. Not while it runs: see `stop`."""
        self._port.close()
        self.stepped.close()

    def __enter__(self) -> "SharedSimulator":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ---- episodes and steps

    def _fly(self) -> str:
        """Until all have left: why the last one did. Empty if this side was stopped."""
        now = time.monotonic()
        for party in self.parties:
            party.link.connect(now)
            party.complain_at = now + COMPLAIN_AFTER
        self._left = ""
        while not self._stopped:
            self._flush()
            if all(party.presence is Presence.LEFT for party in self.parties):
                return self._left
            if not self._advance():
                self._exchange()
        return ""

    def _advance(self) -> bool:
        """Step or begin the world if it is time to; whether anything was sent."""
        flying = self._who(Presence.FLYING)
        if not self.episodes:
            if len(self._who(Presence.READY)) < len(self.parties):
                return False
            self._begin(first=True)
        elif again := self._started_anew():
            if any(party.presence is Presence.COMING for party in again):
                return False
            for party in again:
                party.presence = Presence.FLYING
                self._send(party)
        elif not flying:
            if not self._who(Presence.WAITING, Presence.READY):
                return False
            self._begin()
        elif any(party.command is None for party in flying):
            return False
        elif any(self._close_wrong(party, flying) for party in flying):
            pass
        elif all(party.order == RESET for party in flying):
            self._begin()
        elif self.steps == 0 and any(party.order == RESET for party in flying):
            for party in flying:
                if party.order == RESET:  # it has just begun: the same start again
                    self._send(party)
        else:
            self._step(flying)
        return True

    @property
    def _is_first_start(self) -> bool:
        """Whether the first episode has begun, and nothing was flown."""
        return self.episodes == 1 and self.steps == 0

    def _started_anew(self) -> list[Party]:
        """Agents that were started anew before the last one came: the first step waits for them."""
        if not self._is_first_start:
            return []
        lost = {absence.agent for absence in self.absences}
        coming = self._who(Presence.COMING, Presence.READY)
        return [party for party in coming if party.number not in lost]

    def _begin(self, *, first: bool = False) -> None:
        """Begin an episode for all that take part."""
        joining = self._who(Presence.FLYING, Presence.WAITING, Presence.READY)
        count, layout = self._layout.drones, self._layout
        party = min(joining, key=lambda party: int(party.rows.min()))
        seeds: np.ndarray | None = None
        if first:  # as a simulator of one agent
            seed = party.link.hello.session if party.seed is None else party.seed
            seeds = np.array([(seed + i) & MAX_UINT64 for i in range(count)], np.uint64)
        elif party.command is not None and party.command.seeds is not None:
            seeds = np.full(count, party.command.seeds[party.rows.argmin()], np.uint64)
        self.seed = None if seeds is None else int(seeds[0])
        nothing = np.zeros(layout.actions.shape, layout.actions.dtype)
        self.stepped.advance(nothing, np.ones(count, bool), seeds, None)
        self.episodes, self.steps = self.episodes + (first or self.steps > 0), 0
        # Those of a start that nobody flew are told anew.
        self.absences = [one for one in self.absences if one.episode < self.episodes]
        for absent in self.parties:
            if absent not in joining:
                self._let_go(absent)
        for party in joining:
            party.presence = Presence.FLYING
            self._send(party)
        self._show(None)

    def _step(self, flying: list[Party]) -> None:
        """Fly the world for one control period, if anyone flies in it."""
        layout, flown = self._layout, False
        actions = np.zeros(layout.actions.shape, layout.actions.dtype)
        if layout.choices:
            actions += (layout.choices - 1) // 2  # of those that hold
        for party in list(flying):
            assert party.command is not None
            if party.order == RESET:
                flying.remove(party)
                self._lose(party, Presence.WAITING)
            else:
                actions[party.rows] = party.command.actions
                flown |= party.order == FLY
        if flown:
            self.stepped.advance(actions, None, None, None)
            self.steps += 1
        for party in flying:
            self._send(party, again=party.order == FREEZE)
        if flown:
            self._show(actions)

    def _show(self, actions: np.ndarray | None) -> None:
        """Tell the observer of a step with these actions, or of a reset."""
        if self.observer is None:
            return
        stepped, count, cause = self.stepped, self._layout.drones, None
        if actions is not None:
            orders = np.full(count, FLY, np.uint8)
            cause = Command(session=0, sequence=self.steps, actions=actions, orders=orders)
        state = State(
            session=0,
            sequence=self.steps + 1,
            time=self.steps * self.spec.control_period,
            observations=tuple(stepped.observations.values()),
            rewards=stepped.rewards,
            terminated=stepped.terminated,
            truncated=stepped.truncated,
            telemetry=tuple(stepped.telemetry.values()),
        )
        self.observer(cause, state)

    def _close_wrong(self, party: Party, flying: list[Party]) -> bool:
        """Close the link to an agent whose Command the world cannot follow; whether it did."""
        out, wrong = self._out(party), ""
        frozen = all(other.order in (FREEZE, RESET) for other in flying)
        if party.order is None:
            wrong = (
                f"orders: expected the same for all {len(party.rows)} drones, got different ones"
            )
        elif party.order == FLY and out.all():
            wrong = "an action came after the end of an episode: expected a reset"
        elif party.order == FREEZE and not (frozen or out.all()):
            wrong = "orders: expected no frozen drone in a world that others fly on in, got some"
        if wrong:
            party.link.close(wrong, time.monotonic())
            self._lose(party, Presence.LEFT, wrong)
        return bool(wrong)

    def _lose(self, party: Party, presence: Presence, why: str = "") -> None:
        """An agent flies its drones no more: its policy does, for the rest of the episode."""
        was, party.presence = party.presence, presence
        if presence is not Presence.WAITING:
            party.command = None
        if was is Presence.FLYING:
            party.in_flight = ~self._out(party)
        flew = was is Presence.FLYING and party.in_flight.any()
        if flew:
            self._let_go(party)
        if presence is Presence.LEFT:
            self._left = why
        if why and flew:
            where, policy = address_text(party.address), party.when_lost
            party.link.statistics.notice(f"the agent at {where} is lost ({why}): {policy}")

    def _let_go(self, party: Party) -> None:
        """Leave its drones to its policy."""
        absence = Absence(party.number, self.episodes, self.steps, party.presence)
        self.absences.append(absence)
        if party.when_lost != "hold":
            mask = np.zeros(self._layout.drones, bool)
            mask[party.rows] = True
            (self.stepped.land if party.when_lost == "land" else self.stepped.retire)(mask)

    def _out(self, party: Party) -> np.ndarray:
        """Which of its drones are out, bool, shape (n,)."""
        out: np.ndarray = self.stepped.out[party.rows]
        return out

    # ---- the exchange

    def _who(self, *presences: Presence) -> list[Party]:
        return [party for party in self.parties if party.presence in presences]

    def _send(self, party: Party, *, again: bool = False, cut: bool = False) -> None:
        """Send an agent the State of its drones.

        `again`: nothing has happened to them. `cut`: its episode was truncated. The arrays of both
        are those of its last State: the world may be in another episode.
        """
        stepped, rows, link, now = self.stepped, party.rows, party.link, time.monotonic()
        if flew := not (again or cut):
            party.shown = (
                tuple(array[rows] for array in stepped.observations.values()),
                tuple(array[rows] for array in stepped.telemetry.values()),
            )
        nothing = np.zeros(len(rows), bool)
        observations, telemetry = party.shown
        party.command = None
        party.patient_until = now + self.patience
        link.send_state(
            link.sequence * self.spec.control_period,
            observations,
            stepped.rewards[rows] if flew else np.zeros(len(rows)),
            stepped.terminated[rows] if flew else nothing,
            stepped.truncated[rows] if flew else party.in_flight if cut else nothing,
            telemetry,
            now,
        )
        self._flush_one(party)

    def _exchange(self) -> None:
        """Wait for one datagram or timer, and take it in."""
        before = time.monotonic()
        due = [timer for p in self.parties if (timer := p.link.next_timer()) is not None]
        due += [p.patient_until for p in self._who(Presence.FLYING) if p.command is None]
        left = min(due, default=before + LONGEST_WAIT) - before
        if left > 0:
            if arrival := self._arrival(left):
                self._receive(*arrival)
            if self._port.closed:
                raise OSError("the simulator was closed")
        now = time.monotonic()
        if (pause := now - before - min(max(left, 0.0), LONGEST_WAIT)) > PAUSE:
            for party in self.parties:  # this process was stopped, and the agents could not know
                party.link.pardon(pause)
                party.patient_until += pause
        for party in self.parties:
            self._handle_timers(party, now)

    def _arrival(self, timeout: float) -> tuple[Party, bytes] | None:
        """The next datagram of an agent. None: nothing came, or an earlier one found nobody."""
        with suppress(OSError):
            datagram, address = self._port.receive(timeout, strangers=False)
            if party := self._by_address.get(address):
                return party, datagram
        return None

    def _handle_timers(self, party: Party, now: float) -> None:
        awaited = party.presence is Presence.FLYING and party.command is None
        if awaited and now >= party.patient_until:
            self._lose(party, Presence.SILENT, f"no Command for {self.patience:g} s")
        timer = party.link.next_timer()
        if timer is not None and now >= timer and not party.link.handle_timer(now):
            why = f"no answer from the agent at {address_text(party.address)} for "
            why += f"{self.config.timeout:g} s"
            if not self.episodes:
                raise PeerSilent(f"{why}, and the world begins when all have come")
            self._lose(party, Presence.LEFT, why)
            if len(self._who(Presence.LEFT)) == len(self.parties):
                raise PeerSilent(f"{why}, and no other is left")
        elif party.presence is Presence.COMING and party.complain_at and now > party.complain_at:
            why = f"no answer from the agent at {address_text(party.address)} for "
            why += f"{COMPLAIN_AFTER:g} s; asking for {self.config.timeout:g} s in all"
            party.link.statistics.notice(why)
            party.complain_at = None

    def _receive(self, party: Party, datagram: bytes) -> None:
        session = party.link.hello.session
        message = party.link.receive(datagram, time.monotonic())
        if party.link.hello.session != session:  # its answer was Unknown
            if self._is_first_start and party.presence is Presence.FLYING:
                party.presence = Presence.COMING  # before the others came: they wait for it
            else:
                self._lose(party, Presence.COMING, "it was started anew")
        elif message is not None and party.presence is not Presence.LEFT:
            self._take(party, message)

    def _take(self, party: Party, message: Message) -> None:
        """Take in a message that moves the exchange with an agent on."""
        where = address_text(party.address)
        if isinstance(message, Refuse | Close):
            if not self.episodes and isinstance(message, Refuse):
                raise Refused(f"the agent at {where} refused: {message.reason}")
            if not self.episodes:
                reason = message.reason or "no reason"
                raise LinkError(f"the agent at {where} closed before the world began: {reason}")
            self._lose(party, Presence.LEFT, message.reason or "the agent closed")
        elif isinstance(message, Welcome):
            party.presence, party.seed = Presence.READY, message.seed
            self._take_policy(party, message)
        elif isinstance(message, Command):
            party.command = message
            if party.presence in (Presence.SILENT, Presence.LATE):
                self._take_late(party)

    def _take_policy(self, party: Party, welcome: Welcome) -> None:
        party.when_lost = self._when_lost
        for extension in welcome.extensions:
            if extension.number == WHEN_LOST:
                policy = extension.value.decode("ascii", "replace")
                if policy in POLICIES:  # of another version: that of this side
                    party.when_lost = policy
        if party.when_lost == "land":
            try:
                self.stepped.land(np.zeros(self._layout.drones, bool))
            except InputError as error:
                if not self.episodes:
                    raise
                party.when_lost = self._when_lost  # one agent does not end the flight of others
                where = address_text(party.address)
                party.link.statistics.notice(
                    f"the agent at {where} cannot have land ({error}): {party.when_lost}"
                )

    def _take_late(self, party: Party) -> None:
        """A Command of an agent that does not take part in the running episode."""
        if party.order == RESET:
            party.presence = Presence.WAITING
        elif party.order == FREEZE:
            self._send(party, again=True)
        elif party.presence is Presence.SILENT and party.in_flight.any():
            party.presence = Presence.LATE
            self._send(party, cut=True)
        else:
            wrong = "an action came after the end of an episode: expected a reset"
            party.link.close(wrong, time.monotonic())
            self._lose(party, Presence.LEFT, wrong)

    def _flush(self) -> None:
        for party in self.parties:
            self._flush_one(party)

    def _flush_one(self, party: Party) -> None:
        for datagram in party.link.take_outgoing():
            self._put(party, datagram)
        log_notices(party.link.statistics, time.monotonic())

    def _put(self, party: Party, datagram: bytes) -> None:
        try:
            self._port.send(datagram, party.address)
        except OSError:  # as good as lost
            party.link.statistics.counters["unsent"] += 1

    def _say_alive(self, finished: threading.Event) -> None:
        """In a thread: tell agents that wait for a State that it will come."""
        while not finished.wait(ALIVE_EVERY):
            for party in self.parties:
                for datagram in party.link.alive():
                    self._put(party, datagram)

    def _close_links(self, reason: str) -> None:
        """Tell all agents, until they have answered or will not."""
        for party in self.parties:
            if party.link.state not in _LOST_STATES:
                party.link.close(reason, time.monotonic())
        self._flush()
        while timers := [t for p in self.parties if (t := p.link.next_timer()) is not None]:
            if self._port.closed:
                return
            left = min(timers) - time.monotonic()
            if arrival := self._arrival(max(left, 0.0)):
                arrival[0].link.receive(arrival[1], time.monotonic())
            for party in self.parties:
                party.link.handle_timer(time.monotonic())
            self._flush()


def _shares(
    agents: Sequence[Address] | Mapping[Address, Sequence[str]], names: tuple[str, ...]
) -> list[tuple[Address, tuple[str, ...]]]:
    """Drones of each agent. Raises `InputError` unless every drone has one."""
    if isinstance(agents, Mapping):
        shares = [(address, tuple(own)) for address, own in agents.items()]
        given = sorted(name for _, own in shares for name in own)
        right = all(own for _, own in shares) and given == sorted(names)
        expect(right, "agents", f"each of {', '.join(names)} once", ", ".join(given) or "none")
        return shares
    count, drones = len(agents), len(names)
    right = count > 0 and drones % count == 0
    expect(right, "agents", f"a divisor of {drones} drones", f"{count} agents")
    size = drones // count
    return [(address, names[i * size : (i + 1) * size]) for i, address in enumerate(agents)]

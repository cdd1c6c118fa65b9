"""The agent's socket, and the simulators that have a place at it. Needs no MuJoCo."""

import logging
import math
import time
import weakref
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import numpy as np

from .agent_link import AgentLink, Event
from .errors import PeerClosed, PeerSilent
from .interface import Interface, announced, known, refusal
from .journal import Journal, of_agent
from .keys import Key, read_key
from .link import Address
from .messages import Close, Command, Hello, State
from .sockets import LARGE, Port, address_text, log_notices, pause_between_parts

__all__ = ["Server", "ServerConfig"]

_log: Final = logging.getLogger("rotorgram.udp")
_LONGEST_WAIT: Final = 0.5  # s


@dataclass(frozen=True, kw_only=True)
class ServerConfig:
    """How an agent listens, whom it lets fly for it, and how long it waits."""

    env_id: str
    """The env to fly. A simulator of another one is refused."""
    options: dict[str, Any]
    """Options of that env; with some given, a simulator of others is refused."""
    drones: int | None
    """Drones of each simulator; None: as many as the first has."""
    places: int
    """Simulators to fly at the same time."""
    connect_timeout: float
    """Longest wait for a simulator to take a place that is free, s."""
    timeout: float
    """Longest wait for an answer from one that has a place, s. Then its place is free."""
    key_file: Path | str | None
    insecure: bool
    record: Path | str | None

    def __post_init__(self) -> None:
        for name in ("connect_timeout", "timeout"):
            seconds = getattr(self, name)
            if not (math.isfinite(seconds) and seconds > 0):
                raise ValueError(f"{name}: expected seconds > 0, got {seconds}")


class Server:
    """Exchanges Commands for States with every simulator, all at the same time.

    Attributes:
        link: The state machine.
        interface: What is flown: of the first simulator that came, or before as the options say.
        states: The last State of each place; None before the first.
        lost: For each place why its simulator was lost during the last exchange; "" if it was not.

    Raises:
        ValueError: An address, a time or the key file is not what it should be.
        OSError: The port is in use.
    """

    def __init__(self, address: Address, config: ServerConfig) -> None:
        self.config = config
        self.interface = known(config.env_id, config.options)
        expected = self.interface if config.options else None
        self._wanted = _Wanted(config.env_id, expected, config.drones)
        self._hello: Hello | None = None
        key = Key(read_key(Path(config.key_file)), "agent") if config.key_file else None
        sizes = self.interface.observation.shape[0], len(self.interface.telemetry)
        journal: Journal | None = None
        if config.record:
            journal = of_agent(config.record, config.env_id, config.options, self.interface)
        self._journal = journal
        self.link = AgentLink(
            self._wanted.refusal,
            sizes,
            places=config.places,
            key=key,
            tap=journal.tap if journal else None,
        )
        self.link.takes_text = config.drones in (None, 1)
        self.states: list[State | None] = [None] * config.places
        self.lost = [""] * config.places
        self._deadlines = [0.0] * config.places
        self._port = Port(address, insecure=config.insecure or key is not None)
        if journal:
            try:
                journal.start(self.link.statistics, self.link.places)
            except BaseException:
                self._port.close()
                raise
        # Runs once: in close(), with the garbage, or when the program ends.
        self.close = weakref.finalize(self, _leave, self.link, self._port, journal)

    @property
    def address(self) -> Address:
        """Address that this side listens on."""
        return self._port.address

    @property
    def hello(self) -> Hello | None:
        """What the last simulator that came said; None before one did, or if it speaks text."""
        return self._hello

    def connect(self) -> None:
        """Wait until it is the agent's turn at every place.

        Raises:
            PeerSilent: A place stayed free, or its simulator fell silent and no other came.
            PeerClosed: The last simulator ended the exchange.
        """
        if not self.close.alive:
            raise gym.error.ClosedEnvironmentError("expected an open env, got a closed one")
        self._gather()
        self.lost = [""] * len(self.lost)

    def exchange(
        self,
        places: Collection[int],
        actions: np.ndarray,
        resets: np.ndarray,
        seeds: np.ndarray | None = None,
        holds: np.ndarray | None = None,
    ) -> None:
        """Send each place its Command, and wait for the States of all.

        A simulator that is lost meanwhile is replaced by another that comes; then `lost` says why
        and `states` has the first State of that one.

        Args:
            places: Numbers of the places that get a Command.
            actions: float32, shape (places in all, N, k).
            resets: bool, shape (places in all, N).
            seeds: uint64, shape (places in all, N), or None.
            holds: bool, shape (places in all, N), or None.

        Raises:
            ValueError: An action is not finite; nothing was sent.
            PeerSilent, PeerClosed: As `connect`.
        """
        commands = {place: self._command(place, actions, resets, seeds, holds) for place in places}
        self.lost = [""] * len(self.lost)
        now = time.monotonic()
        for place, command in commands.items():
            self.link.send_command(place, command, now)
        self._gather()

    def _command(
        self,
        place: int,
        actions: np.ndarray,
        resets: np.ndarray,
        seeds: np.ndarray | None,
        holds: np.ndarray | None,
    ) -> Command:
        session = self.link.places[place]
        assert session is not None
        return Command(
            session=session.number,
            sequence=session.sequence,
            actions=actions[place],
            resets=resets[place],
            seeds=None if seeds is None else seeds[place],
            holds=None if holds is None or not holds[place].any() else holds[place],
        )

    def _gather(self) -> None:
        """Send what is due and answer what comes, until it is the agent's turn everywhere."""
        link, config, now = self.link, self.config, time.monotonic()
        for place, session in enumerate(link.places):
            wait = config.timeout if session else config.connect_timeout
            self._deadlines[place] = now + wait
        while waiting := [p for p, s in enumerate(link.places) if not s or s.state != "deciding"]:
            _flush(link, self._port)
            if self._journal:
                self._journal.write()
            left = min(self._deadlines[place] for place in waiting) - time.monotonic()
            if left <= 0:
                self._give_up(waiting)
                continue
            try:
                # Not for long: another thread may have closed the env.
                wait = min(left, _LONGEST_WAIT)
                datagram, address = self._port.receive(wait, strangers=None in link.places)
            except (OSError, ValueError):
                if not self.close.alive:
                    raise gym.error.ClosedEnvironmentError("the env was closed") from None
                continue  # nothing came; or (Windows) an earlier datagram found nobody
            event = link.receive(datagram, address, time.monotonic())
            if event:
                self._handle(event, address)
        _flush(link, self._port)

    def _handle(self, event: Event, address: Address) -> None:
        place, message, here = event.place, event.message, address_text(address)
        if isinstance(message, Close):
            self._lose(place, f"the simulator at {here} closed: {message.reason}")
            self._keep_sockets()
            if not any(self.link.places):
                _flush(self.link, self._port)
                raise PeerClosed(self.lost[place])
            self._say_waiting(place)
            return
        if event.joined:
            session = self.link.places[place]
            assert session is not None
            self._keep_sockets()
            self._hello = session.hello
            if session.hello:
                self.link.takes_text = False
                # One that tells no options had to have those that were asked for.
                told, asked = announced(session.hello), self._wanted.interface
                options = told.options or (asked.options if asked else "")
                self.interface = replace(told, options=options)
            self._wanted.interface, self._wanted.drones = self.interface, len(message.rewards)
            if self.states[place] is not None and not self.lost[place]:
                self._lose(place, f"the simulator at {here} was started anew")
                _log.warning("%s", self.lost[place])
        self.states[place] = message

    def _give_up(self, waiting: list[int]) -> None:
        """Free the places of the silent. Raises `PeerSilent` if nobody took one that was free."""
        now = time.monotonic()
        for place in waiting:
            if now < self._deadlines[place]:
                continue
            session = self.link.places[place]
            if session is None:
                raise PeerSilent(self._nobody_came(self.lost[place]))
            here, there = address_text(self.address), address_text(session.peer)
            self.link.free(place)
            self._keep_sockets()
            self._lose(
                place,
                f"no datagram from the simulator at {there} for {self.config.timeout:g} s, "
                f"waiting at {here} for State {session.sequence + 1}{self._last_dropped()}",
            )
            self._say_waiting(place)

    def _keep_sockets(self) -> None:
        self._port.keep([session.peer for session in self.link.places if session])

    def _lose(self, place: int, reason: str) -> None:
        self.lost[place] = reason
        self._deadlines[place] = time.monotonic() + self.config.connect_timeout

    def _say_waiting(self, place: int) -> None:
        here, wait = address_text(self.address), self.config.connect_timeout
        long = f"{wait:g} s " if wait < 86_400 else ""  # who waits for a month waits
        _log.warning("%s; waiting %sfor another at %s", self.lost[place], long, here)

    def _nobody_came(self, lost: str) -> str:
        who = f"{lost}; no other" if lost else "no simulator"
        dropped = self._last_dropped()
        return (
            f"{who} came to {address_text(self.address)} for {self.config.connect_timeout:g} s"
            f"{'' if dropped in lost else dropped}"
        )

    def _last_dropped(self) -> str:
        last = self.link.statistics.last_error
        return f"; last datagram dropped: {last}" if last else ""


@dataclass
class _Wanted:
    """What a simulator must have. The link holds it: a `Server` held by its link would never go."""

    env_id: str
    interface: Interface | None
    drones: int | None

    def refusal(self, hello: Hello) -> str:
        return refusal(self.env_id, self.interface, self.drones, hello)


def _leave(link: AgentLink, port: Port, journal: Journal | None) -> None:
    """Tell every simulator, until it has answered or will not."""
    link.close("the agent closed", time.monotonic())
    while True:
        _flush(link, port)
        timer = link.next_timer()
        if timer is None:
            break
        left = max(timer - time.monotonic(), 0.0)
        with suppress(OSError):  # nothing came
            datagram, address = port.receive(left, strangers=False)
            link.receive(datagram, address, time.monotonic())
        link.handle_timer(time.monotonic())
    port.close()
    if journal:
        journal.close()


def _flush(link: AgentLink, port: Port) -> None:
    for number, (datagram, address) in enumerate(link.take_outgoing()):
        if len(datagram) > LARGE:
            pause_between_parts(number)
        try:
            port.send(datagram, address)
        except OSError:  # as good as lost: the simulator asks again, or the wait ends in time
            link.statistics.counters["unsent"] += 1
    log_notices(link.statistics, time.monotonic())

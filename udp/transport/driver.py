"""Drives the rules of a simulator: waits on its socket, steps its world, sends its States."""

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from math import inf
from typing import TYPE_CHECKING, Final

import gymnasium as gym

from ...models.errors import NotCopied
from ..protocol.client import Address, Client
from ..protocol.errors import LinkError
from ..protocol.messages import Command
from ..protocol.party import NO_RESET, WorldRules
from .sockets import LONGEST_WAIT, PAUSE, Port, log_notices
from .stepped import Steppable

if TYPE_CHECKING:
    from ..journal import Journal

_ALIVE_EVERY: Final = 0.5  # period of the message Alive while an agent waits for a State, s

Observer = Callable[[Command | None], None]
"""Called with the Command that moved the drones, or None where all of them were reset, once the
world has moved: see `Driver.observer`."""


class Driver(NotCopied):
    """A simulator on a socket, for one agent or several.

    Attributes:
        address: Address of this side.
        spec: Spec of the env.
        stepped: The loop or the envs.
        rules: What the world does with the messages of its agents.
        observer: Called after every step of the world, once the agents have its State.
    """

    def __init__(self, stepped: Steppable, rules: WorldRules, port: Port) -> None:
        self.stepped = stepped
        self.spec = stepped.spec
        self.address: Address = port.address
        self.observer: Observer | None = None
        self.rules = rules
        self._port = port
        self._receive = port.receiver()
        self._by_address = {link.address: link for link in rules.links}
        self._stopped = self._ran = False
        self._journal: Journal | None = None

    @property
    def link(self) -> Client:
        """The exchange with the first agent."""
        return self.rules.links[0].client

    def run(self) -> str:
        """Fly until every agent has closed; the reason that the last one gave. Runs once.

        The agents are told at once when the run ends, also by an error of the env or by Ctrl-C.

        Raises:
            PeerSilent: Nothing came from an agent within the timeout, and no other is left.
            Refused: An agent turned this simulator away, with a reason.
            LinkError: An agent closed before a shared world began, or the only one went on after
                an episode's end without a reset.
            KeyboardInterrupt: Ctrl-C.
        """
        if self._ran:
            name = type(self).__name__
            raise ValueError(f"run: expected one call for each {name}, got another")
        self._ran = True
        reason = "the simulator was stopped"
        finished = threading.Event()
        heart = threading.Thread(target=self._say_alive, args=(finished,), daemon=True)
        heart.start()
        try:
            return self._fly() or reason
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
            raise
        finally:
            finished.set()
            self._end(reason)

    def stop(self) -> None:
        """Make `run` tell the agents and return, after the step that is being computed.

        May be called from another thread and in a signal handler, any number of times.
        """
        self._stopped = True

    def close(self) -> None:
        """Close the socket, the envs and the record. Not while it runs: see `stop`."""
        self._port.close()
        self.stepped.close()
        if self._journal:
            self._journal.close()

    def __enter__(self) -> "Driver":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _fly(self) -> str:
        """Fly until all agents have closed: the reason of the last one. Empty after `stop`."""
        rules = self.rules
        rules.start(time.monotonic())
        while not self._stopped:
            try:
                again = rules.step(time.monotonic())
            except gym.error.ResetNeeded as error:
                raise LinkError(f"{NO_RESET} ({error})") from None
            rules.answer(time.monotonic())
            self._flush()
            if rules.moved:
                rules.moved = False
                if self.observer is not None:
                    self.observer(rules.cause)
                if self._journal:
                    self._journal.write()
            if rules.reason is not None:
                return rules.reason
            if again:
                continue
            before = time.monotonic()
            left = min(rules.next_timer() - before, LONGEST_WAIT)
            if left <= 0:
                rules.handle_timers(before)
                continue
            try:
                datagram, address = self._receive(left)
            except OSError as error:
                self._note(error, time.monotonic() - before - left)
                continue
            if link := self._by_address.get(address):
                link.trouble = ""
                rules.receive(link, datagram, time.monotonic())
        return ""

    def _end(self, reason: str) -> None:
        """Send Close to the agents until they answer, or their time for that is over."""
        rules = self.rules
        rules.close(reason, time.monotonic())
        self._flush()
        while not self._port.closed:
            timer = min([link.client.next_timer() for link in rules.links])
            if timer == inf:
                break
            left = timer - time.monotonic()
            with suppress(OSError):  # nothing came, or an earlier datagram found nobody
                datagram, address = self._receive(max(left, 0.0))
                if link := self._by_address.get(address):
                    link.client.receive(datagram, time.monotonic())
            for each in rules.links:
                each.client.handle_timer(time.monotonic())
            self._flush()
        if self._journal:
            self._journal.close()

    def _flush(self) -> None:
        """Send what is due, before any wait."""
        for link in self.rules.links:
            client = link.client
            outgoing = client.outgoing
            client.outgoing = []
            for datagram in outgoing:
                try:
                    self._port.send(datagram, link.address)
                except OSError as error:  # a full buffer or no network: as good as lost
                    client.statistics.counters["unsent"] += 1
                    link.trouble = _words(error, "sending")
            if client.statistics.notices:
                log_notices(client.statistics)

    def _note(self, error: OSError, pause: float) -> None:
        """Nothing came, and the wait was too long by `pause`, s. Raises `OSError` if closed."""
        if self._port.closed:
            raise error
        if pause > PAUSE:  # this process was stopped
            self.rules.pardon(pause)
        if len(self.rules.links) == 1 and not isinstance(error, TimeoutError):
            self.rules.links[0].trouble = _words(error, "receiving")

    def _say_alive(self, finished: threading.Event) -> None:
        """In a thread: tell agents that wait for a State that it will come."""
        while not finished.wait(_ALIVE_EVERY):
            for link in self.rules.links:
                for datagram in link.client.alive(time.monotonic()):
                    with suppress(OSError):  # as good as lost
                        self._port.send(datagram, link.address)


def _words(error: OSError, what: str) -> str:
    if isinstance(error, ConnectionError):
        return "nothing listens on that port"
    return f"{what} failed: {error.strerror}"

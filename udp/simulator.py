"""The simulator's side: a UDP client that steps Gymnasium envs by the commands of an agent."""

import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, Literal

import gymnasium as gym

from ..envs import ENV_ID
from .errors import PeerSilent, Refused
from .fleet import Fleet
from .journal import of_simulator
from .keys import Key, read_key
from .link import Address, LinkConfig, encode
from .messages import Close, Command, Message, Refuse, State, Welcome
from .simulator_link import SimulatorLink
from .sockets import (
    LARGE,
    address_text,
    log_notices,
    open_socket,
    pause_between_parts,
    receive,
    resolve,
)

__all__ = ["DEFAULT_AGENT", "DEFAULT_SIMULATOR", "Observer", "Simulator"]

DEFAULT_AGENT: Final = ("127.0.0.1", 8001)
DEFAULT_SIMULATOR: Final = ("127.0.0.1", 8000)

Observer = Callable[[Message | None, State], None]
"""Is told what moved the drones, a Command or the Welcome that resets them all, and the State that
it led to: valid during the call only. None, by text: the reset before the first State."""


class Simulator:
    """Simulated drones that an agent flies over UDP.

    Args:
        env: Id of a registered env, or the env itself: flat float32 observations, and actions
            that are flat float32 or `Discrete`.
        server: Address (host, port) of the agent.
        num_envs: Number of drones: independent copies of the env.
        bind: Address of this side; port 0 takes a free port.
        codec: `binary`, or the paper's `text`.
        config: Times of the exchange.
        key_file: File with the key that the agent has too (`rotorgram key`). With it any address
            is allowed, for only those who hold the key can take part.
        insecure: Allow an address that is not loopback without a key.
        record: MCAP file to write every message to; it must not exist.
        options: Options of the env, by name.

    Attributes:
        observer: Called for every State once it is sent, while the agent thinks; None at first.

    Raises:
        ValueError: An option, an address, the key file or the env's spaces are not what they
            should be.
        OSError: The port is in use, or the record cannot be written.
    """

    def __init__(
        self,
        env: str | gym.Env[Any, Any] = ENV_ID,
        *,
        server: Address = DEFAULT_AGENT,
        num_envs: int = 1,
        bind: Address = DEFAULT_SIMULATOR,
        codec: Literal["binary", "text"] = "binary",
        config: LinkConfig | None = None,
        key_file: Path | str | None = None,
        insecure: bool = False,
        record: Path | str | None = None,
        **options: Any,
    ) -> None:
        if codec not in ("binary", "text"):
            raise ValueError(f"codec: expected 'binary' or 'text', got {codec!r}")
        if codec == "text" and num_envs != 1:
            raise ValueError(f"codec: expected 'binary' for {num_envs} drones, got 'text'")
        key = Key(read_key(Path(key_file)), "simulator") if key_file else None
        anywhere = insecure or key is not None
        self.server = resolve(server, insecure=anywhere)
        if self.server[1] == 0:
            raise ValueError("server: expected the port of the agent, 1 to 65535, got 0")
        self.config = config or LinkConfig()
        self._keyed, self._text = key is not None, codec == "text"
        self.fleet = Fleet(env, num_envs, options)
        self._trouble = ""
        self.observer: Observer | None = None
        with ExitStack() as failing:  # what is open, should a later step fail
            failing.callback(self.fleet.close)
            by_text = codec == "text"
            encode(self.fleet.state(1, 1), as_text=by_text)  # raises if it is more than a datagram
            self._journal = of_simulator(record, self.fleet, options) if record else None
            tap = self._journal.tap if self._journal else None
            self.link = SimulatorLink(
                self.fleet.hello, self.config, text_codec=by_text, key=key, tap=tap
            )
            self._socket = open_socket(bind, insecure=anywhere, peer=self.server)
            failing.callback(self._socket.close)
            if self._journal:
                self._journal.start(self.link.statistics)
            failing.pop_all()

    @property
    def address(self) -> Address:
        """Address of this side."""
        host, port = self._socket.getsockname()
        return host, port

    def run(self) -> str:
        """Fly until the agent closes; the reason that it gave. A simulator runs once.

        Whatever ends the run, an error of the env or Ctrl-C too, the agent is told at once.

        Raises:
            PeerSilent: Nothing came from the agent within `config.timeout`.
            Refused: The agent turned this simulator away, with a reason.
            LinkError: The agent went on after an episode's end without a reset.
        """
        if self.link.state == "closed" or self.link.sends:
            raise ValueError("run: expected one call for each Simulator, got another")
        reason = "the simulator was stopped"
        try:
            return self._fly()
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
            raise
        finally:
            self.link.close(reason, time.monotonic())
            self._exchange_until_closed()
            if self._journal:
                self._journal.close()

    def close(self) -> None:
        """Close the socket, the envs and the record."""
        self._socket.close()
        self.fleet.close()
        if self._journal:
            self._journal.close()

    def __enter__(self) -> "Simulator":
        """Return the simulator, to be closed at the end of the block."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    def _fly(self) -> str:
        link, fleet = self.link, self.fleet
        link.connect(time.monotonic())
        if link.state == "ready":  # by text: the agent says nothing before the first State
            fleet.reset(link.hello.session)
            self._send_state(None)
        while True:
            message = self._wait()
            if isinstance(message, Close):
                if self._text and not link.statistics.round_trips.count:
                    raise Refused(
                        f"the agent at {address_text(self.server)} closed before its first "
                        "command: it has no free place, has a key, or flies no text"
                    )
                return message.reason or "the agent closed"
            if isinstance(message, Welcome):
                fleet.reset(message.session if message.seed is None else message.seed)
            elif isinstance(message, Command):
                fleet.step(message.actions, message.resets, message.seeds, message.holds)
            self._send_state(message)

    def _send_state(self, cause: Message | None) -> None:
        state = self.fleet.state(self.link.hello.session, self.link.sequence + 1)
        self.link.send_state(state, time.monotonic())
        if self.observer is not None:
            self._flush()
            self.observer(cause, state)

    def _wait(self) -> Message:
        """Send what is due and wait for the message that moves the exchange on."""
        link = self.link
        while True:
            self._flush()
            if self._journal:
                self._journal.write()
            timer = link.next_timer()
            assert timer is not None
            left = timer - time.monotonic()
            if left <= 0:
                sends = link.sends  # of what was not answered, not of the Close that follows
                if not link.handle_timer(time.monotonic()):
                    raise PeerSilent(self._silence(sends))
                continue
            message = self._receive(left)
            if isinstance(message, Refuse):
                raise Refused(f"the agent at {address_text(self.server)} refused: {message.reason}")
            if message is not None:
                return message

    def _receive(self, timeout: float) -> Message | None:
        try:
            datagram, _ = receive(self._socket, timeout)
        except TimeoutError:
            return None
        except ConnectionError:  # nothing listens there yet: the timer says when to ask again
            self._trouble = "nothing listens on that port"
            return None
        except OSError as error:  # no way there, a firewall says: the same
            if self._socket.fileno() < 0:  # closed by another thread
                raise
            self._trouble = f"receiving failed: {error.strerror}"
            return None
        self._trouble = ""
        return self.link.receive(datagram, time.monotonic())

    def _exchange_until_closed(self) -> None:
        """Until the agent has answered our Close, or will not."""
        while self._socket.fileno() >= 0:
            self._flush()
            timer = self.link.next_timer()
            if timer is None:
                return
            left = timer - time.monotonic()
            if left > 0:
                self._receive(left)
            else:
                self.link.handle_timer(time.monotonic())

    def _flush(self) -> None:
        for number, datagram in enumerate(self.link.take_outgoing()):
            if len(datagram) > LARGE:
                pause_between_parts(number)
            try:
                self._socket.send(datagram)
            except ConnectionError:
                self.link.statistics.counters["unsent"] += 1
                self._trouble = "nothing listens on that port"
            except OSError as error:  # a full buffer or a network that is down: as good as lost
                self.link.statistics.counters["unsent"] += 1
                self._trouble = f"sending failed: {error.strerror}"
        log_notices(self.link.statistics, time.monotonic())

    def _silence(self, sends: int) -> str:
        what = "Hello" if self.link.sequence == 0 else f"State {self.link.sequence}"
        key = ""
        if self._keyed and what == "Hello":
            key = "; an agent with another key does not answer"
        why = f"; {self._trouble}" if self._trouble else ""
        last = self.link.statistics.last_error
        dropped = f"; last datagram dropped: {last}" if last else ""
        return (
            f"no answer from the agent at {address_text(self.server)} "
            f"for {self.config.timeout:g} s, {what} sent {sends} times{why}{key}{dropped}"
        )

"""The simulator: a UDP client that steps envs by the commands of an agent."""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final, Literal

import gymnasium as gym
import numpy as np

from ...models.errors import NotCopied, expect
from ..layouts import layout_of
from ..protocol.auth import Key, read_keys
from ..protocol.client import Address, Client, LinkConfig, largest_datagram, new_session
from ..protocol.errors import LinkError, PeerSilent, Refused
from ..protocol.messages import Close, Command, Hello, Message, Refuse, State, Welcome
from ..protocol.transitions import SimulatorState
from .sockets import LONGEST_WAIT, PAUSE, address_text, log_notices, open_socket, resolve
from .stepped import Stepped, make_stepped, reset_all

DEFAULT_AGENT: Final = ("127.0.0.1", 8001)
DEFAULT_SIMULATOR: Final = ("127.0.0.1", 8000)

ALIVE_EVERY: Final = 0.5  # period of the message Alive while a long step is computed, s
COMPLAIN_AFTER: Final = 1.0  # A wait for the agent that is told, once, s

Observer = Callable[[Message | None, State], None]
"""Called with the message that moved the drones, a Command or the Welcome that resets them all, and
the State after it: valid during the call only. None, by text: the reset before the first State."""


class Simulator(NotCopied):
    """Simulated drones that an agent flies over UDP.

    Args:
        env: Id of a registered env, or one Gymnasium env itself: observations are a Box or a Dict
            of Box, actions a Box or `Discrete`.
        server: Address (host, port) of the agent.
        num_envs: Drones in all; None: those of one world.
        drones: Of each world.
        bind: Address of this side; port 0 takes a free port.
        codec: `binary`, or the paper's `text`.
        vehicle: As `make_stepped`.
        backend: As `make_stepped`.
        config: Times of the exchange.
        key_file: As `AgentSettings`, and so are `insecure` and `record`.
        options: Options of the env, by name.

    Attributes:
        address: Address of this side.
        spec: Spec of the env.
        stepped: The loop or the envs.
        observer: Called for every State once it is sent, while the agent thinks; None at first.

    Raises:
        InputError: An option, an address, the key file or the env's spaces are not what they
            should be.
        OSError: The port is in use, or the record cannot be written.
    """

    def __init__(
        self,
        env: str | gym.Env[Any, Any] = "rotorgram/Elevation-v0",
        *,
        server: Address = DEFAULT_AGENT,
        num_envs: int | None = None,
        drones: int = 1,
        bind: Address = DEFAULT_SIMULATOR,
        codec: Literal["binary", "text"] = "binary",
        vehicle: Path | str | None = None,
        backend: str = "mujoco",
        config: LinkConfig | None = None,
        key_file: Path | str | None = None,
        insecure: bool = False,
        record: Path | str | None = None,
        **options: Any,
    ) -> None:
        expect(codec in ("binary", "text"), "codec", "'binary' or 'text'", f"{codec!r}")
        self._text = codec == "text"
        key = Key(read_keys(key_file)[0], "simulator") if key_file else None
        anywhere = insecure or key is not None
        self.server = resolve(server, insecure=anywhere)
        expect(self.server[1], "server", "the port of the agent, 1 to 65535", "0")
        self.config = config or LinkConfig()
        self.observer: Observer | None = None
        self._keyed = key is not None
        self._trouble = ""
        self._stopped = False
        self._began_at: float | None = None  # when the step began that is being computed
        with ExitStack() as failing:  # closes what is open if a later step fails
            self.stepped: Stepped = make_stepped(
                env, drones if num_envs is None else num_envs, drones=drones, vehicle=vehicle,
                backend=backend, options=options,
            )  # fmt: skip
            failing.callback(self.stepped.close)
            self.spec = self.stepped.spec
            worlds = self.stepped.num_envs // drones
            hello = Hello(session=new_session(), spec=self.spec.to_json(), worlds=worlds)
            self.link = Client(
                hello,
                layout_of(self.spec, worlds),
                self.config,
                largest=largest_datagram(self.server, self.config.max_datagram),
                by_text=self._text,
                key=key,
            )
            self._socket = open_socket(bind, insecure=anywhere, peer=self.server)
            failing.callback(self._socket.close)
            self.address: Address = self._socket.getsockname()
            another = self.server != self.address
            expect(another, "server", "the address of the agent", "that of this side")
            self._journal: Any = None
            if record:
                from ..journal import Journal
                from ..journal.writer import models_of

                about, models = models_of(self.stepped)
                if about:
                    about["backend"] = backend
                journal = Journal(
                    record,
                    self.link.statistics,
                    side="simulator",
                    text_hello=hello,
                    about=about,
                    models=models,
                )
                self._journal, self.link.tap = journal, journal.tap
            failing.pop_all()

    def run(self) -> str:
        """Fly until the agent closes; the reason that it gave. A simulator runs once.

        The agent is told at once when the run ends, also by an error of the env. In the main
        thread Ctrl-C ends it after the step that is being computed; a second one at once.

        Raises:
            PeerSilent: Nothing came from the agent within `config.timeout`.
            Refused: The agent turned this simulator away, with a reason.
            LinkError: The agent went on after an episode's end without a reset.
            KeyboardInterrupt: Ctrl-C.
        """
        if self.link.state is SimulatorState.CLOSED or self.link.sends:
            raise ValueError("run: expected one call for each Simulator, got another")
        return run_to_the_end(self._fly, self._end, self._say_alive, self.stop)

    def stop(self) -> None:
        """Make `run` tell the agent and return, after the step that is being computed.

        May be called from another thread and in a signal handler, any number of times.
        """
        self._stopped = True

    def close(self) -> None:
        """Close the socket, the envs and the record. Not while it runs: see `stop`."""
        self._socket.close()
        self.stepped.close()
        if self._journal:
            self._journal.close()

    def __enter__(self) -> "Simulator":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ---- the exchange

    def _fly(self) -> str:
        """Until the agent closes: its reason. Empty if this side was stopped."""
        link = self.link
        link.connect(time.monotonic())
        self._flush()
        if self._text:  # the agent says nothing before the first State
            reset_all(self.stepped, link.layout, link.hello.session)
            self._send_state(None)
        while not self._stopped:
            message = self._wait()
            if message is None or self._stopped:
                break
            if isinstance(message, Close):
                if self._text and not link.statistics.round_trips.count:
                    raise Refused(
                        f"the agent at {address_text(self.server)} closed before its first "
                        "command: it has no free slot, has a key, or flies no text"
                    )
                return message.reason or "the agent closed"
            self._began_at = time.monotonic()
            if isinstance(message, Welcome):
                seed = message.session if message.seed is None else message.seed
                reset_all(self.stepped, link.layout, seed)
            elif isinstance(message, Command):
                self._step(message)
            self._began_at = None
            self._send_state(message)
        return ""

    def _step(self, command: Command) -> None:
        orders = command.orders
        try:
            if np.count_nonzero(orders):  # of few drones faster than `any`
                self.stepped.advance(command.actions, command.resets, command.seeds, command.frozen)
            else:
                self.stepped.advance(command.actions, None, None, None)
        except gym.error.ResetNeeded as error:
            raise LinkError(
                f"an action came after the end of an episode: expected a reset ({error})"
            ) from None

    def _send_state(self, cause: Message | None) -> None:
        stepped, link = self.stepped, self.link
        state = link.send_state(
            link.sequence * self.spec.control_period,
            tuple(stepped.observations.values()),
            stepped.rewards,
            stepped.terminated,
            stepped.truncated,
            tuple(stepped.telemetry.values()),
            time.monotonic(),
        )
        self._flush()
        if self.observer is not None:
            self.observer(cause, state)

    def _wait(self) -> Message | None:
        """Wait for the message that moves the exchange on. None if this side was stopped."""
        link = self.link
        if self._journal:
            self._journal.write()
        complain_at: float | None = time.monotonic() + COMPLAIN_AFTER
        while not self._stopped:
            timer = link.next_timer()
            assert timer is not None
            before = time.monotonic()
            left = timer - before
            if left <= 0:
                sends = link.sends  # of what was not answered, not of the Close that follows
                if not link.handle_timer(before):
                    raise PeerSilent(self._silence(sends, self.config.timeout))
                if complain_at and before > complain_at and (self._trouble or not link.sequence):
                    told = self._silence(link.sends, COMPLAIN_AFTER)
                    link.statistics.notice(f"{told}; asking for {self.config.timeout:g} s in all")
                    complain_at = None
                self._flush()
                continue
            message = self._receive(left)
            if isinstance(message, Command):
                return message  # nothing is due before its State
            self._flush()
            if isinstance(message, Refuse):
                raise Refused(f"the agent at {address_text(self.server)} refused: {message.reason}")
            if message is not None:
                return message
            pause = time.monotonic() - before - min(left, LONGEST_WAIT)
            if pause > PAUSE:
                link.pardon(pause)
        return None

    def _receive(self, timeout: float) -> Message | None:
        try:
            datagram, _ = self._socket.receive(timeout)
        except TimeoutError:
            return None
        except OSError as error:  # nothing listens there yet: the timer says when to ask again
            if self._socket.fileno() < 0:
                raise
            self._note_trouble("receiving", error)
            return None
        self._trouble = ""
        return self.link.receive(datagram, time.monotonic())

    def _end(self, reason: str) -> None:
        """Tell the agent, until it has answered or will not."""
        self.link.close(reason, time.monotonic())
        self._flush()
        while self._socket.fileno() >= 0 and (timer := self.link.next_timer()) is not None:
            left = timer - time.monotonic()
            if left > 0:
                self._receive(left)
            else:
                self.link.handle_timer(time.monotonic())
            self._flush()
        if self._journal:
            self._journal.close()

    def _flush(self) -> None:
        """Send what is due, before any wait."""
        for datagram in self.link.take_outgoing():
            self._send(datagram)
        log_notices(self.link.statistics, time.monotonic())

    def _send(self, datagram: bytes) -> None:
        try:
            self._socket.send(datagram)
        except OSError as error:  # a full buffer or a network that is down: as good as lost
            self.link.statistics.counters["unsent"] += 1
            self._note_trouble("sending", error)

    def _note_trouble(self, what: str, error: OSError) -> None:
        refused = isinstance(error, ConnectionError)
        self._trouble = (
            "nothing listens on that port" if refused else f"{what} failed: {error.strerror}"
        )

    def _say_alive(self, finished: threading.Event) -> None:
        """In a thread: tell the agent of a long step that it is being computed."""
        while not finished.wait(ALIVE_EVERY):
            began_at = self._began_at
            if began_at is not None and time.monotonic() - began_at > ALIVE_EVERY / 2:
                for datagram in self.link.alive():
                    self._send(datagram)

    def _silence(self, sends: int, seconds: float) -> str:
        what = "Hello" if self.link.sequence == 0 else f"State {self.link.sequence}"
        locked = self._keyed and what == "Hello"
        key = "; an agent with another key does not answer" if locked else ""
        why = f"; {self._trouble}" if self._trouble else ""
        last = self.link.statistics.last_error
        dropped = f"; last datagram dropped: {last}" if last else ""
        return (
            f"no answer from the agent at {address_text(self.server)} "
            f"for {seconds:g} s, {what} sent {sends} times{why}{key}{dropped}"
        )


def run_to_the_end(
    fly: Callable[[], str],
    end: Callable[[str], None],
    say_alive: Callable[[threading.Event], None],
    stop: Callable[[], None],
) -> str:
    """The reason for which `fly` ended, `say_alive` beside it in a thread: `end` gets it, or what
    went wrong. Ctrl-C calls `stop`, and is raised at the end.
    """
    reason, finished = "the simulator was stopped", threading.Event()
    heart = threading.Thread(target=say_alive, args=(finished,), daemon=True)
    with _deferred_interrupt(stop) as interrupted:
        heart.start()
        try:
            return fly() or reason
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
            raise
        finally:
            finished.set()
            end(reason)
            if interrupted:
                raise KeyboardInterrupt


@contextmanager
def _deferred_interrupt(stop: Callable[[], None]) -> Iterator[list[bool]]:
    """Have Ctrl-C call `stop`, and only a second one interrupt. The list says whether it came."""
    came: list[bool] = []
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield came
        return

    def note(*_: object) -> None:
        came.append(True)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        stop()

    signal.signal(signal.SIGINT, note)
    try:
        yield came
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)

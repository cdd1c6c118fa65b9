"""The simulator's side: a UDP client that steps a Gymnasium env by the commands of an agent."""

import json
import secrets
import time
from dataclasses import asdict, is_dataclass
from typing import Any, Final, Literal, TypeGuard

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from ..envs import ENV_ID
from .errors import LinkError, PeerSilent, Refused
from .link import Address, LinkConfig, SimulatorLink
from .messages import Close, Command, Hello, Message, Refuse, State, Welcome
from .sockets import address_text, open_socket, receive, resolve

__all__ = [
    "DEFAULT_AGENT",
    "DEFAULT_SIMULATOR",
    "Simulator",
    "describe",
    "make_env",
    "options_text",
]

DEFAULT_AGENT: Final = ("127.0.0.1", 8001)
DEFAULT_SIMULATOR: Final = ("127.0.0.1", 8000)


class Simulator:
    """One simulated drone that an agent flies over UDP.

    Args:
        env: Id of a registered env, or the env itself: flat float32 observations, and actions
            that are flat float32 or `Discrete`.
        server: Address (host, port) of the agent.
        bind: Address of this side; port 0 takes a free port.
        codec: `binary`, or the paper's `text`.
        config: Times of the exchange.
        insecure: Allow an address that is not loopback: datagrams are not authenticated.
        options: Options of the env, by name.

    Raises:
        ValueError: An option, an address or the env's spaces are not what they should be.
        OSError: The port is in use.
    """

    def __init__(
        self,
        env: str | gym.Env[Any, Any] = ENV_ID,
        *,
        server: Address = DEFAULT_AGENT,
        bind: Address = DEFAULT_SIMULATOR,
        codec: Literal["binary", "text"] = "binary",
        config: LinkConfig | None = None,
        insecure: bool = False,
        **options: Any,
    ) -> None:
        if codec not in ("binary", "text"):
            raise ValueError(f"codec: expected 'binary' or 'text', got {codec!r}")
        self.server = resolve(server, insecure=insecure)
        if self.server[1] == 0:
            raise ValueError("server: expected the port of the agent, 1 to 65535, got 0")
        self.env = make_env(env, options)
        self.config = config or LinkConfig()
        hello = describe(self.env)
        self._telemetry = hello.telemetry_names
        self.link = SimulatorLink(hello, self.config, text_codec=codec == "text")
        self._discrete = bool(hello.discrete_actions)
        self._over = False
        self._trouble = ""
        self._socket = open_socket(bind, insecure=insecure, peer=self.server)

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
            self.link.close(reason)
            self._flush()

    def close(self) -> None:
        """Close the socket and the env."""
        self._socket.close()
        self.env.close()

    def __enter__(self) -> "Simulator":
        """Return the simulator, to be closed at the end of the block."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    def _fly(self) -> str:
        seed = None
        self.link.connect(time.monotonic())
        if self.link.state == "hello":
            answer = self._wait()
            if isinstance(answer, Close):
                return answer.reason
            assert isinstance(answer, Welcome)
            seed = answer.seed
        state = self._reset(seed)
        while True:
            self.link.send_state(state, time.monotonic())
            answer = self._wait()
            if isinstance(answer, Close):
                return answer.reason
            assert isinstance(answer, Command)
            state = self._obey(answer)

    def _obey(self, command: Command) -> State:
        if command.resets[0]:
            return self._reset(command.seed)
        if self._over:
            raise LinkError(
                f"the agent at {address_text(self.server)} sent an action after the end of the "
                "episode: expected a reset"
            )
        action: Any = command.actions[0]
        if self._discrete:
            action = int(action[0])
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._over = bool(terminated or truncated)
        return self._state(observation, float(reward), terminated, truncated, info)

    def _reset(self, seed: int | None) -> State:
        observation, info = self.env.reset(seed=seed)
        self._over = False
        return self._state(observation, 0.0, False, False, info)

    def _state(
        self, observation: Any, reward: float, terminated: bool, truncated: bool, info: Any
    ) -> State:
        return State(
            session=self.link.hello.session,
            sequence=self.link.sequence + 1,
            observations=np.asarray(observation, np.float32)[np.newaxis],
            rewards=np.array((reward,)),
            terminated=np.array((terminated,), bool),
            truncated=np.array((truncated,), bool),
            telemetry=np.array(([info[name] for name in self._telemetry],), np.float64),
        )

    def _wait(self) -> Message:
        """Send what is due and wait for the message that answers it."""
        link, sock = self.link, self._socket
        while True:
            self._flush()
            timer = link.next_timer()
            assert timer is not None
            left = timer - time.monotonic()
            if left <= 0:
                if not link.handle_timer(time.monotonic()):
                    raise PeerSilent(self._silence())
                continue
            try:
                message = link.receive(receive(sock, left)[0], time.monotonic())
            except TimeoutError:
                continue
            except ConnectionError:  # nothing listens there yet: the timer says when to ask again
                self._trouble = "nothing listens on that port"
                continue
            except OSError as error:  # no way there, a firewall says: the same
                if sock.fileno() < 0:  # closed by another thread
                    raise
                self._trouble = f"receiving failed: {error.strerror}"
                continue
            if isinstance(message, Refuse):
                raise Refused(f"the agent at {address_text(self.server)} refused: {message.reason}")
            if message is not None:
                return message

    def _flush(self) -> None:
        for datagram in self.link.take_outgoing():
            try:
                self._socket.send(datagram)
            except ConnectionError:
                self._trouble = "nothing listens on that port"
            except OSError as error:  # a full buffer or a network that is down: as good as lost
                self._trouble = f"sending failed: {error.strerror}"

    def _silence(self) -> str:
        what = "Hello" if self.link.sequence == 0 else f"State {self.link.sequence}"
        why = f"; {self._trouble}" if self._trouble else ""
        dropped = f"; last datagram dropped: {self.link.last_error}" if self.link.last_error else ""
        return (
            f"no answer from the agent at {address_text(self.server)} "
            f"for {self.config.timeout:g} s, {what} sent {self.link.sends} times{why}{dropped}"
        )


def make_env(env: str | gym.Env[Any, Any], options: dict[str, Any]) -> gym.Env[Any, Any]:
    """The env of an id and options, or the env itself. Raises `ValueError`."""
    if not isinstance(env, str):
        if options:
            raise ValueError(f"options {sorted(options)}: expected none with an env already made")
        return env
    try:
        return gym.make(env, disable_env_checker=True, **options)
    except (gym.error.Error, ImportError) as error:
        raise ValueError(f"env: expected a registered id, got {env!r}: {error}") from None
    except TypeError as error:
        raise ValueError(f"options of {env}: {error}") from None


def describe(env: gym.Env[Any, Any]) -> Hello:
    """The Hello of an env, with a new session. Raises `ValueError` for spaces that do not fit."""
    observation, action = env.observation_space, env.action_space
    low: np.ndarray
    high: np.ndarray
    if not _is_flat(observation):
        raise ValueError(f"observation space: expected a flat Box of float32, got {observation}")
    if isinstance(action, spaces.Discrete) and action.start == 0:
        low, high, discrete = np.zeros(1), np.array([action.n - 1]), int(action.n)
    elif _is_flat(action):
        low, high, discrete = action.low, action.high, 0
    else:
        raise ValueError(
            f"action space: expected a flat Box of float32 or Discrete(n), got {action}"
        )
    base: Any = env.unwrapped
    return Hello(
        session=secrets.randbits(64) or 1,
        env_id=env.spec.id if env.spec else type(base).__name__,
        num_drones=1,
        observation_low=observation.low,
        observation_high=observation.high,
        action_low=low.astype(np.float32),
        action_high=high.astype(np.float32),
        discrete_actions=discrete,
        control_period=getattr(base, "control_period", 1 / (env.metadata.get("render_fps") or 50)),
        model_hash=getattr(base, "model_hash", "0" * 32),
        telemetry_names=tuple(getattr(base, "telemetry_names", ())),
        options=options_text(getattr(base, "config", None)),
    )


def options_text(config: Any) -> str:
    """An env's options as a Hello tells them: JSON, or "" if they are no dataclass."""
    if not is_dataclass(config) or isinstance(config, type):
        return ""
    return json.dumps(asdict(config), sort_keys=True, separators=(",", ":"))


def _is_flat(space: Any) -> TypeGuard[spaces.Box]:
    return isinstance(space, spaces.Box) and len(space.shape) == 1 and space.dtype == np.float32

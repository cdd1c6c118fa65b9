"""The agent's side: a UDP server that is a Gymnasium env. Needs no MuJoCo."""

import json
import math
import socket
import time
import weakref
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from ..envs import ENV_ID, TELEMETRY_NAMES, ElevationConfig
from ..envs.config import action_space, observation_space
from .errors import PeerClosed, PeerSilent
from .link import Address, AgentLink
from .messages import MAX_UINT64, Close, Command, Hello, State
from .simulator import DEFAULT_AGENT, describe, make_env, options_text
from .sockets import address_text, open_socket, receive

__all__ = ["RemoteEnv"]


class RemoteEnv(gym.Env[np.ndarray, Any]):
    """A drone in a simulator elsewhere, flown in lock-step over UDP.

    The simulator may start before or after. Its Hello brings the spaces; a text simulator says
    none, and then they are those of `env_id` with `options`. Observations, rewards, ends of
    episodes and telemetry are those of the env in the simulator, bit for bit; `info` carries the
    telemetry alone.

    A simulator that falls silent raises `PeerSilent`; the next `reset` waits for it again. The
    simulator is told when the env is closed, garbage-collected, or its program ends.

    Args:
        address: Address (host, port) to listen on; port 0 takes a free one (see `address`).
        env_id: The env to fly. A simulator of another one is refused.
        options: Options of that env. A text simulator needs them where they are not the default;
            with them given, a simulator with other spaces is refused.
        connect: Wait for the simulator now. Otherwise `connect` or the first `reset` waits.
        connect_timeout: Longest wait for a simulator, s.
        timeout: Longest wait for an answer from it, s.
        insecure: Allow an address that is not loopback: datagrams are not authenticated.

    Raises:
        ValueError: An address, option, action or seed is not what it should be.
        OSError: The port is in use.
        PeerSilent: No simulator came, or it fell silent.
        PeerClosed: The simulator ended the exchange.
        gymnasium.error.ResetNeeded: A step before a reset, or after an episode's end.
        gymnasium.error.ClosedEnvironmentError: A reset after `close`.
    """

    def __init__(
        self,
        address: Address = DEFAULT_AGENT,
        *,
        env_id: str = ENV_ID,
        options: Mapping[str, Any] | None = None,
        connect: bool = True,
        connect_timeout: float = 60.0,
        timeout: float = 30.0,
        insecure: bool = False,
    ) -> None:
        self.render_mode = None
        self.env_id = env_id
        self.connect_timeout = _seconds("connect_timeout", connect_timeout)
        self.timeout = _seconds("timeout", timeout)
        expected = _known(env_id, dict(options or {}))
        self._take(expected)
        self._flying = False
        self._ending = ""
        sizes = expected.observation.shape[0], len(expected.telemetry)
        accept = partial(_refusal, env_id, expected if options else None)
        self.link = AgentLink(accept, sizes)
        self._socket = open_socket(address, insecure=insecure)
        # Runs once: in close(), with the garbage, or when the program ends.
        self._leave = weakref.finalize(self, _leave, self.link, self._socket)
        if connect:
            try:
                self.connect()
            except BaseException:
                self.close()
                raise

    @property
    def address(self) -> Address:
        """Address that this side listens on."""
        host, port = self._socket.getsockname()
        return host, port

    @property
    def hello(self) -> Hello | None:
        """What the simulator said of itself; None before it came, or if it speaks text."""
        return self.link.hello

    def connect(self) -> None:
        """Wait until it is the agent's turn: for the simulator's first State, if none has come."""
        if not self._leave.alive:
            raise gym.error.ClosedEnvironmentError(_CLOSED)
        if self.link.state != "deciding":
            self._receive(self.connect_timeout if self.link.peer is None else self.timeout)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode in the simulator, with its generator seeded where a seed is given."""
        if seed is not None and not 0 <= seed <= MAX_UINT64:
            raise ValueError(f"seed: expected 0 to 2^64 - 1, got {seed}")
        if options:
            raise ValueError(f"options: expected none over UDP, got {options}")
        super().reset(seed=seed)
        self.connect()
        state = self._exchange(self._no_action, _RESET, seed)
        self._flying = True
        return state.observations[0].copy(), self._info(state)

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Fly for one control period. The action is sent as float32."""
        if not self._flying:
            raise gym.error.ResetNeeded("step: expected a call of reset() first")
        state = self._exchange(self._actions(action), _NO_RESET, None)
        terminated, truncated = state.terminated.item(), state.truncated.item()
        self._flying = not (terminated or truncated)
        observation = state.observations[0].copy()
        return observation, state.rewards.item(), terminated, truncated, self._info(state)

    def close(self) -> None:
        """Tell the simulator and close the socket. May be called again."""
        self._leave()
        self._flying = False

    def _actions(self, action: Any) -> np.ndarray:
        if isinstance(self.action_space, spaces.Discrete):
            if not self.action_space.contains(action):
                last = int(self.action_space.n) - 1
                raise ValueError(f"action: expected a whole number 0 to {last}, got {action!r}")
            return np.array([[action]], np.float32)
        array = np.asarray(action, dtype=np.float32)
        if array.shape != self.action_space.shape:
            raise ValueError(
                f"action: expected an array of shape {self.action_space.shape}, "
                f"got shape {array.shape}"
            )
        return array[np.newaxis]

    def _exchange(self, actions: np.ndarray, resets: np.ndarray, seed: int | None) -> State:
        link = self.link
        command = Command(
            session=link.session,
            sequence=link.sequence,
            actions=actions,
            resets=resets,
            seed=seed,
        )  # an action that is wrong raises here, and nothing has happened
        self._flying = False  # until the answer is there
        link.send_command(command)
        return self._receive(self.timeout)

    def _receive(self, timeout: float) -> State:
        """Send what is due and answer what comes, until it is the next State."""
        if self.link.state == "closed":
            raise PeerClosed(self._ending)
        left = timeout
        deadline = time.monotonic() + timeout
        while True:
            _flush(self.link, self._socket)
            try:
                message = self.link.receive(*receive(self._socket, left))
            except OSError:
                if not self._leave.alive:
                    raise gym.error.ClosedEnvironmentError(_CLOSED) from None
                message = None  # nothing came; or (Windows) an earlier datagram found nobody
            if isinstance(message, State):
                return message
            if isinstance(message, Close):
                host, port = self.link.peer or ("", 0)
                self._ending = f"the simulator at {host}:{port} closed: {message.reason}"
                raise PeerClosed(self._ending)
            if isinstance(message, Hello):
                self._take(_announced(message))
            # Whatever else came, it must not extend the wait.
            left = deadline - time.monotonic()
            if left <= 0:
                _flush(self.link, self._socket)
                raise PeerSilent(self._silence(timeout))

    def _silence(self, timeout: float) -> str:
        dropped = f"; last datagram dropped: {self.link.last_error}" if self.link.last_error else ""
        here = address_text(self.address)
        if self.link.peer is None:
            return f"no simulator came to {here} for {timeout:g} s{dropped}"
        return (
            f"no datagram from the simulator at {address_text(self.link.peer)} for {timeout:g} s, "
            f"waiting at {here} for State {self.link.sequence + 1}{dropped}"
        )

    def _take(self, interface: "_Interface") -> None:
        self.observation_space = interface.observation
        self.action_space = interface.action
        self.metadata = {"render_modes": [], "render_fps": round(1 / interface.control_period)}
        self._names = interface.telemetry
        self._no_action = np.zeros((1, *(self.action_space.shape or (1,))), np.float32)

    def _info(self, state: State) -> dict[str, Any]:
        return dict(zip(self._names, state.telemetry[0].tolist(), strict=True))


_CLOSED = "expected an open RemoteEnv, got a closed one"
_RESET = np.array([True])
_NO_RESET = np.array([False])


@dataclass(frozen=True, kw_only=True)
class _Interface:
    """What an agent must know of an env."""

    observation: spaces.Box
    action: spaces.Space[Any]
    telemetry: tuple[str, ...]
    control_period: float
    options: str
    """As `Hello.options`."""


def _announced(hello: Hello) -> _Interface:
    """What a simulator says of its env."""
    action: spaces.Space[Any]
    if hello.discrete_actions:
        action = spaces.Discrete(hello.discrete_actions)
    else:
        action = spaces.Box(hello.action_low, hello.action_high, dtype=np.float32)
    return _Interface(
        observation=spaces.Box(hello.observation_low, hello.observation_high, dtype=np.float32),
        action=action,
        telemetry=hello.telemetry_names,
        control_period=hello.control_period,
        options=hello.options,
    )


def _known(env_id: str, options: dict[str, Any]) -> _Interface:
    """What follows from an env id, without MuJoCo where the env is ours."""
    if env_id == ENV_ID:
        config = ElevationConfig.from_options(options)
        return _Interface(
            observation=observation_space(config),
            action=action_space(config),
            telemetry=TELEMETRY_NAMES,
            control_period=config.control_period,
            options=options_text(config),
        )
    with closing(make_env(env_id, options)) as env:
        return _announced(describe(env))


def _refusal(env_id: str, expected: _Interface | None, hello: Hello) -> str:
    """Why not to fly the simulator of this Hello, or ""."""
    if hello.env_id != env_id:
        return f"expected a simulator of {env_id}, got one of {hello.env_id}"
    if hello.num_drones != 1:
        return f"expected a simulator of one drone, got one of {hello.num_drones}"
    got = _announced(hello)
    if expected and (differences := _differences(expected.options, got.options)):
        return differences
    if expected and (got.observation, got.action) != (expected.observation, expected.action):
        return (
            f"expected {expected.observation} and {expected.action} as the options say, "
            f"got {got.observation} and {got.action}"
        )
    return ""


def _differences(expected: str, got: str) -> str:
    """In which options two envs differ, in a sentence; "" if in none, or if one tells none."""
    if not (expected and got):
        return ""
    try:
        ours, theirs = json.loads(expected), dict(json.loads(got))
    except (ValueError, TypeError):
        return f"options: expected a JSON object, got {got[:80]}"
    differing = [
        f"{name} {value!r}, got {theirs.get(name)!r}"
        for name, value in ours.items()
        if theirs.get(name) != value
    ]
    return f"expected {'; expected '.join(differing)}" if differing else ""


def _seconds(name: str, seconds: float) -> float:
    if not (math.isfinite(seconds) and seconds > 0):
        raise ValueError(f"{name}: expected seconds > 0, got {seconds}")
    return seconds


def _leave(link: AgentLink, sock: socket.socket) -> None:
    link.close("the agent closed")
    _flush(link, sock)
    sock.close()


def _flush(link: AgentLink, sock: socket.socket) -> None:
    for datagram, address in link.take_outgoing():
        try:
            sock.sendto(datagram, address)
        except OSError:  # as good as lost: the simulator asks again, or the wait ends in time
            link.counters["unsent"] += 1

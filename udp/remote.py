"""One drone elsewhere, as a Gymnasium env of the agent's. Needs no MuJoCo."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from ..envs import ENV_ID
from .link import Address
from .messages import MAX_UINT64, State
from .served import ServedEnv, keep_space
from .server import Server, ServerConfig
from .simulator import DEFAULT_AGENT

__all__ = ["LOST", "RemoteEnv"]

LOST: Final = "simulator_lost"
"""Key of `info`: why the simulator was lost whose episode ends here as truncated."""


class RemoteEnv(ServedEnv, gym.Env[np.ndarray, Any]):
    """A drone in a simulator elsewhere, flown in lock-step over UDP.

    The simulator may start before or after. Its Hello brings the spaces; a text simulator says
    none, and then they are those of `env_id` with `options`. Observations, rewards, ends of
    episodes and telemetry are those of the env in the simulator, bit for bit; `info` carries the
    telemetry alone.

    A simulator that is killed and started again, or another one that comes in its place, goes on:
    the running episode ends as truncated, with the observation before it, reward 0 and the reason
    in `info["simulator_lost"]`. If none comes, `PeerSilent` is raised; the next `reset` waits
    again. The simulator is told when the env is closed, garbage-collected, or its program ends.

    Args:
        address: Address (host, port) to listen on; port 0 takes a free one (see `address`).
        env_id: The env to fly. A simulator of another one is refused.
        options: Options of that env. A text simulator needs them where they are not the default;
            with them given, a simulator with other spaces is refused.
        connect: Wait for the simulator now. Otherwise `connect` or the first `reset` waits.
        connect_timeout: Longest wait for a simulator, s, be it the first or one that replaces
            another.
        timeout: Longest wait for an answer from it, s, before another may take its place.
        key_file: File with the key that the simulators have too (`rotorgram key`). With it any
            address is allowed, for only those who hold the key can take part.
        insecure: Allow an address that is not loopback without a key.
        record: MCAP file to write every message to; it must not exist.

    Raises:
        ValueError: An address, option, key file, action or seed is not what it should be.
        OSError: The port is in use.
        PeerSilent: No simulator came, or it fell silent and no other came.
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
        key_file: Path | str | None = None,
        insecure: bool = False,
        record: Path | str | None = None,
    ) -> None:
        self.render_mode = None
        self.env_id = env_id
        config = ServerConfig(
            env_id=env_id,
            options=dict(options or {}),
            drones=1,
            places=1,
            connect_timeout=connect_timeout,
            timeout=timeout,
            key_file=key_file,
            insecure=insecure,
            record=record,
        )
        self._server = Server(address, config)
        self._flying = False
        self._take_interface()
        if connect:
            try:
                self.connect()
            except BaseException:
                self.close()
                raise

    def connect(self) -> None:
        """Wait until it is the agent's turn: for the simulator's first State, if none has come."""
        self._server.connect()
        self._take_interface()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode in the simulator, with its generator seeded where a seed is given."""
        if seed is not None and not 0 <= seed <= MAX_UINT64:
            raise ValueError(f"seed: expected 0 to 2^64 - 1, got {seed}")
        if options:
            raise ValueError(f"options: expected none over UDP, got {options}")
        super().reset(seed=seed)
        self._flying = False
        self.connect()
        seeds = None if seed is None else np.array([[seed]], np.uint64)
        self._server.exchange(_ONLY, self._no_action, _RESET, seeds)
        while self._server.lost[0]:  # the simulator that has come instead was not reset
            self._server.exchange(_ONLY, self._no_action, _RESET, seeds)
        self._take_interface()
        self._flying = True
        self._state = self._take_state()
        return self._state.observations[0].copy(), self._info(self._state)

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Fly for one control period. The action is sent as float32."""
        if not self._flying:
            raise gym.error.ResetNeeded("step: expected a call of reset() first")
        actions = self._actions(action)
        self._flying = False  # until the answer is there
        try:
            self._server.exchange(_ONLY, actions, _NO_RESET)
        except ValueError:  # an action that is wrong, and nothing has happened
            self._flying = True
            raise
        if reason := self._server.lost[0]:
            info = {**self._info(self._state), LOST: reason}
            return self._state.observations[0].copy(), 0.0, False, True, info
        self._state = state = self._take_state()
        terminated, truncated = state.terminated.item(), state.truncated.item()
        self._flying = not (terminated or truncated)
        observation = state.observations[0].copy()
        return observation, state.rewards.item(), terminated, truncated, self._info(state)

    def close(self) -> None:
        """Tell the simulator and close the socket. May be called again."""
        self._server.close()
        self._flying = False

    def _actions(self, action: Any) -> np.ndarray:
        if isinstance(self.action_space, spaces.Discrete):
            if not self.action_space.contains(action):
                last = int(self.action_space.n) - 1
                raise ValueError(f"action: expected a whole number 0 to {last}, got {action!r}")
            return np.array([[[action]]], np.float32)
        # Whatever the program has set; what overflows is infinite, and refused as such.
        with np.errstate(over="ignore", under="ignore"):
            array = np.asarray(action, dtype=np.float32)
        if array.shape != self.action_space.shape:
            raise ValueError(
                f"action: expected an array of shape {self.action_space.shape}, "
                f"got shape {array.shape}"
            )
        return array[np.newaxis, np.newaxis]

    def _take_state(self) -> State:
        state = self._server.states[0]
        assert state is not None
        return state

    def _take_interface(self) -> None:
        interface = self._server.interface
        keep_space(self, "observation_space", interface.observation)
        keep_space(self, "action_space", interface.action)
        self.metadata = {"render_modes": [], "render_fps": round(1 / interface.control_period)}
        self._names = interface.telemetry
        self._no_action = np.zeros((1, 1, *(self.action_space.shape or (1,))), np.float32)

    def _info(self, state: State) -> dict[str, Any]:
        return dict(zip(self._names, state.telemetry[0].tolist(), strict=True))


_ONLY = (0,)
_RESET = np.array([[True]])
_NO_RESET = np.array([[False]])

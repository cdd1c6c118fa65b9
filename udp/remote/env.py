"""One drone in a remote simulator as a Gymnasium env of the agent."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import numpy as np

from ...envs.spaces import action_space, observation_space
from ...envs.spec import Discrete, EnvSpec, component_names
from ...models.errors import InputError
from ..protocol.client import Address
from ..protocol.messages import FLY, MAX_UINT64, RESET, State
from ..transport.agent import Agent, AgentConfig
from ..transport.simulator import DEFAULT_AGENT
from .served import LOST, ServedEnv, action_dtype, checked_actions

__all__ = ["RemoteEnv"]

_FLY: Final = np.array([FLY], np.uint8)
_RESET: Final = np.array([RESET], np.uint8)


class RemoteEnv(ServedEnv, gym.Env[Any, Any]):
    """A drone in a remote simulator, flown in lock-step over UDP.

    The simulator may start before or after. Its Hello brings the spec of its env, and the spaces
    follow from that: this side needs neither the env's code nor MuJoCo. A text simulator says no
    Hello, and is read by the spec of `env_id` with `options`, which must be registered here.
    Observations, rewards, ends of episodes and telemetry are those of the env in the simulator, bit
    for bit; `info` carries the telemetry by its components.

    A simulator that is killed and started again, or another one that comes in its place, goes on:
    the running episode ends as truncated, with the observation before it, reward 0 and the reason
    in `info["simulator_lost"]`. If none comes, `PeerSilent` is raised; the next `reset` waits
    again. The simulator is told when the env is closed, garbage-collected, or its program ends.

    Args:
        address: Address (host, port) to listen on; port 0 takes a free one (see `address`).
        env_id: A simulator of another env is refused; None flies any.
        options: A simulator of other options is refused; None takes any. Those that are not given
            have their defaults if the env is registered here, and any value otherwise.
        vehicle_hash: A simulator of another vehicle is refused; None takes any.
        connect: Wait for the simulator now. Otherwise `connect` or the first `reset` waits.
        connect_timeout: Longest wait for a simulator, s, the first or one that replaces another.
        timeout: Longest wait for an answer from it, s, before another may take its place. While
            it computes, it says so.
        max_datagram: Largest datagram, bytes, a seal not counted. None: 65,483 on loopback, 1,200
            elsewhere.
        key_file: File with the key that the simulators have too (`rotorgram key`). With it any
            address is allowed, because only holders of the key can take part.
        insecure: Allow an address that is not loopback without a key.
        record: MCAP file to write every message to; it must not exist.

    Attributes:
        env_spec: The `EnvSpec` of the env, once a simulator has come.
        control_period: Time of a step, s, likewise.

    Raises:
        InputError: An address, option, key file, action or seed is not what it should be; nothing
            was sent.
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
        env_id: str | None = None,
        options: Mapping[str, Any] | None = None,
        vehicle_hash: str | None = None,
        connect: bool = True,
        connect_timeout: float = 60.0,
        timeout: float = 30.0,
        max_datagram: int | None = None,
        key_file: Path | str | None = None,
        insecure: bool = False,
        record: Path | str | None = None,
    ) -> None:
        self.render_mode = None
        self._flying = False
        config = AgentConfig(
            env_id=env_id,
            options=options,
            vehicle_hash=vehicle_hash,
            worlds=1,
            connect_timeout=connect_timeout,
            timeout=timeout,
            max_datagram=max_datagram,
            key_file=key_file,
            insecure=insecure,
            record=record,
        )
        self._agent = Agent(address, config)
        if connect:
            try:
                self.connect()
            except BaseException:
                self.close()
                raise

    def connect(self) -> None:
        """Wait until it is the agent's turn: for the simulator's first State, if none has come."""
        self._agent.connect()
        self._take_spec()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode in the simulator, with its generator seeded where a seed is given."""
        if seed is not None and not 0 <= seed <= MAX_UINT64:
            raise InputError(f"seed: expected 0 to 2^64 - 1, got {seed}")
        if options:
            raise InputError(f"options: expected none over UDP, got {options}")
        super().reset(seed=seed)
        self._flying = False
        self.connect()
        seeds = None if seed is None else np.array([seed], np.uint64)
        self._agent.exchange({0: (self._no_action, _RESET, seeds)})
        while self._agent.lost[0]:  # the simulator that has come instead was not reset
            self._agent.exchange({0: (self._no_action, _RESET, seeds)})
        self._take_spec()
        self._flying = True
        self._state = self._take_state()
        return self._observation(self._state), self._info(self._state)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Fly for one control period. The action is sent in the dtype of its space."""
        if not self._flying:
            raise gym.error.ResetNeeded("step: expected a call of reset() first")
        actions = checked_actions(action, self._action_dtype, self._action_shape)[np.newaxis]
        self._flying = False  # until the answer is there
        try:
            self._agent.exchange({0: (actions, _FLY, None)})
        except InputError:  # an action that is wrong, and nothing has happened
            self._flying = True
            raise
        if reason := self._agent.lost[0]:
            info = {**self._info(self._state), LOST: reason}
            return self._observation(self._state), 0.0, False, True, info
        self._state = state = self._take_state()
        terminated, truncated = state.terminated.item(), state.truncated.item()
        self._flying = not (terminated or truncated)
        observation = self._observation(state)
        return observation, state.rewards.item(), terminated, truncated, self._info(state)

    def close(self) -> None:
        """Tell the simulator and close the socket. May be called again."""
        self._agent.close()
        self._flying = False

    def _take_state(self) -> State:
        state = self._agent.states[0]
        assert state is not None
        return state

    def _take_spec(self) -> None:
        """Set spaces and other attributes from the spec. Spaces that have not changed are kept:
        their generators may have been seeded.
        """
        spec = self._spec_that_came()
        if getattr(self, "env_spec", None) == spec:
            return
        self.env_spec: EnvSpec = spec
        self.control_period = spec.control_period
        self.observation_space = observation_space(spec)
        self.action_space = action_space(spec)
        fps = max(1, round(1 / spec.control_period))
        self.metadata = {"render_modes": [], "render_fps": fps}
        self._arrays = tuple(array.name for array in spec.observation)
        self._names = tuple(n for array in spec.telemetry for n in component_names(array))
        self._action_shape = () if isinstance(spec.action, Discrete) else spec.action.shape
        self._action_dtype = action_dtype(spec)
        self._no_action: np.ndarray = np.zeros((1, *self._action_shape), self._action_dtype)

    def _observation(self, state: State) -> Any:
        """As the space has it, a copy."""
        arrays = state.observations
        if len(arrays) == 1:
            return np.array(arrays[0][0])
        return {name: np.array(a[0]) for name, a in zip(self._arrays, arrays, strict=True)}

    def _info(self, state: State) -> dict[str, Any]:
        numbers: list[float] = []
        for array in state.telemetry:
            numbers += array.tolist()[0] if array.ndim == 2 else array.ravel().tolist()
        return dict(zip(self._names, numbers, strict=True))

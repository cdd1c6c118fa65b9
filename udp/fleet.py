"""The drones of a simulator: one env or many, reset and stepped by the arrays of a Command."""

import json
from dataclasses import asdict, is_dataclass
from typing import Any, TypeGuard

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from .errors import LinkError
from .messages import MAX_DRONES, MAX_UINT64, Hello, State
from .simulator_link import new_session

__all__ = ["Fleet", "describe", "make_env", "options_text"]


class Fleet:
    """N independent copies of one env.

    Args:
        env: Id of a registered env, or one env itself.
        num_envs: N.
        options: Options of the env, by name.

    Raises:
        ValueError: An option, the number or the env's spaces are not what they should be.
    """

    def __init__(
        self, env: str | gym.Env[Any, Any], num_envs: int, options: dict[str, Any]
    ) -> None:
        if type(num_envs) is not int or not 1 <= num_envs <= MAX_DRONES:
            raise ValueError(f"num_envs: expected 1 to {MAX_DRONES}, got {num_envs!r}")
        if num_envs > 1 and not isinstance(env, str):
            raise ValueError(f"num_envs: expected 1 with an env already made, got {num_envs}")
        self.envs = [make_env(env, options) for _ in range(num_envs)]
        try:
            self.hello = describe(self.envs[0], num_envs)
        except BaseException:
            self.close()
            raise
        self._discrete = bool(self.hello.discrete_actions)
        self._names = self.hello.telemetry_names
        self._over = np.zeros(num_envs, bool)
        self._observations = np.zeros((num_envs, self.hello.observation_low.size), np.float32)
        self._rewards = np.zeros(num_envs)
        self._terminated = np.zeros(num_envs, bool)
        self._truncated = np.zeros(num_envs, bool)
        self._telemetry = np.zeros((num_envs, len(self._names)))

    def reset(self, seed: int) -> None:
        """Reset every drone: drone i with seed + i, modulo 2^64."""
        for drone in range(len(self.envs)):
            self._reset(drone, (seed + drone) & MAX_UINT64)

    def step(self, actions: np.ndarray, resets: np.ndarray, seeds: np.ndarray | None) -> None:
        """Reset the flagged drones, with their seeds if there are any, and step the others.

        Args:
            actions: float32, shape (N, k).
            resets: bool, shape (N,).
            seeds: uint64, shape (N,), or None.

        Raises:
            LinkError: A drone whose episode has ended is to be stepped; none was.
        """
        flown_on = np.flatnonzero(self._over & ~resets)
        if flown_on.size:
            raise LinkError(
                f"an action came for drone {flown_on[0]} after the end of its episode: "
                "expected a reset"
            )
        for drone, reset in enumerate(resets.tolist()):
            if reset:
                self._reset(drone, None if seeds is None else int(seeds[drone]))
            else:
                self._step(drone, actions[drone])

    def state(self, session: int, sequence: int) -> State:
        """What every drone sees now. Its arrays are those of the next one too."""
        return State(
            session=session,
            sequence=sequence,
            observations=self._observations,
            rewards=self._rewards,
            terminated=self._terminated,
            truncated=self._truncated,
            telemetry=self._telemetry,
        )

    def close(self) -> None:
        """Close the envs."""
        for env in self.envs:
            env.close()

    def _reset(self, drone: int, seed: int | None) -> None:
        observation, info = self.envs[drone].reset(seed=seed)
        self._keep(drone, observation, 0.0, False, False, info)

    def _step(self, drone: int, action: Any) -> None:
        if self._discrete:
            action = int(action[0])
        self._keep(drone, *self.envs[drone].step(action))

    def _keep(
        self,
        drone: int,
        observation: Any,
        reward: Any,
        terminated: bool,
        truncated: bool,
        info: dict[str, Any],
    ) -> None:
        observation = np.asarray(observation)
        if observation.shape != self._observations.shape[1:] or observation.dtype != np.float32:
            raise ValueError(
                f"observation: expected float32 of shape {self._observations.shape[1:]}, "
                f"got {observation.dtype} of shape {observation.shape}"
            )
        self._observations[drone] = observation
        self._rewards[drone] = reward
        self._terminated[drone] = terminated
        self._truncated[drone] = truncated
        self._over[drone] = terminated or truncated
        if self._names:
            self._telemetry[drone] = [info[name] for name in self._names]


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


def describe(env: gym.Env[Any, Any], num_envs: int = 1) -> Hello:
    """The Hello of so many envs, with a new session. Raises `ValueError` if spaces do not fit."""
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
        session=new_session(),
        env_id=env.spec.id if env.spec else type(base).__name__,
        num_drones=num_envs,
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

"""The drones of a simulator, reset and stepped by the arrays of a Command."""

import json
from collections.abc import Sequence
from dataclasses import asdict, is_dataclass
from typing import Any, Protocol, TypeGuard

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import load_env_creator

from .errors import LinkError
from .messages import MAX_DRONES, MAX_UINT64, Hello, State
from .simulator_link import new_session

__all__ = ["Fleet", "describe", "make_env", "options_text"]


class Drones(Protocol):
    """N drones that take a step of the wire together. A vector env that does is used as it is."""

    observations: np.ndarray
    """float32, shape (N, n)."""
    rewards: np.ndarray
    """float64, shape (N,)."""
    terminated: np.ndarray
    """bool, shape (N,)."""
    truncated: np.ndarray
    """bool, shape (N,)."""
    telemetry: np.ndarray
    """float64, shape (N, m)."""

    def advance(
        self,
        actions: np.ndarray,
        resets: np.ndarray,
        seeds: np.ndarray | None,
        holds: np.ndarray | None,
    ) -> None:
        """As `rotorgram.envs.autoreset.AdvancingVectorEnv.advance`."""

    def close(self) -> None:
        """Close the env."""


class Fleet:
    """N independent drones of one env.

    An env whose registered vector env has a method `advance`, as ours, is stepped by that one;
    any other is made N times.

    Args:
        env: Id of a registered env, or one env itself.
        num_envs: N.
        options: Options of the env, by name.

    Attributes:
        env: The vector env, or the first of the single ones.
        hello: What there is to say of it, with a new session.

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
        self.env: Any
        self._drones: Drones
        if num_envs > 1 and isinstance(env, str) and _is_stepped_as_one(env):
            self.env = self._drones = make_env(env, options, num_envs)
            self.hello = describe(self.env, num_envs)
        else:
            self._drones = drones = _Singles([make_env(env, options) for _ in range(num_envs)])
            self.env, self.hello = drones.envs[0], drones.hello
        self._over = np.zeros(num_envs, bool)

    def reset(self, seed: int) -> None:
        """Reset every drone: drone i with seed + i, modulo 2^64."""
        count = self.hello.num_drones
        seeds = np.array([(seed + i) & MAX_UINT64 for i in range(count)], np.uint64)
        actions = np.zeros((count, self.hello.action_low.size), np.float32)
        self._drones.advance(actions, np.ones(count, bool), seeds, None)
        self._over.fill(False)

    def step(
        self,
        actions: np.ndarray,
        resets: np.ndarray,
        seeds: np.ndarray | None = None,
        holds: np.ndarray | None = None,
    ) -> None:
        """Reset the flagged drones, with their seeds if there are any, and step the others.

        Args:
            actions: float32, shape (N, k).
            resets: bool, shape (N,).
            seeds: uint64, shape (N,), or None.
            holds: bool, shape (N,): neither reset nor stepped; None for none.

        Raises:
            LinkError: A drone whose episode has ended is to be stepped; none was.
        """
        left_alone = resets if holds is None else resets | holds
        flown_on = np.flatnonzero(self._over & ~left_alone)
        if flown_on.size:
            raise LinkError(
                f"an action came for drone {flown_on[0]} after the end of its episode: "
                "expected a reset"
            )
        self._drones.advance(actions, resets, seeds, holds)
        self._over = self._drones.terminated | self._drones.truncated | (self._over & ~resets)

    def state(self, session: int, sequence: int) -> State:
        """What every drone sees now. Its arrays may be those of the next one too."""
        drones = self._drones
        return State(
            session=session,
            sequence=sequence,
            observations=drones.observations,
            rewards=drones.rewards,
            terminated=drones.terminated,
            truncated=drones.truncated,
            telemetry=drones.telemetry,
        )

    def close(self) -> None:
        """Close the envs."""
        self._drones.close()


class _Singles:
    """Single envs, one after the other: `Drones`."""

    def __init__(self, envs: Sequence[gym.Env[Any, Any]]) -> None:
        self.envs = envs
        count = len(envs)
        try:
            self.hello = describe(envs[0], count)
        except BaseException:
            self.close()
            raise
        self._discrete = bool(self.hello.discrete_actions)
        self._names = self.hello.telemetry_names
        self.observations = np.zeros((count, self.hello.observation_low.size), np.float32)
        self.rewards = np.zeros(count)
        self.terminated, self.truncated = np.zeros(count, bool), np.zeros(count, bool)
        self.telemetry = np.zeros((count, len(self._names)))

    def advance(
        self,
        actions: np.ndarray,
        resets: np.ndarray,
        seeds: np.ndarray | None,
        holds: np.ndarray | None,
    ) -> None:
        for drone, reset in enumerate(resets.tolist()):
            env = self.envs[drone]
            if holds is not None and holds[drone]:
                self.rewards[drone] = 0.0
                self.terminated[drone] = self.truncated[drone] = False
            elif reset:
                seed = None if seeds is None else int(seeds[drone])
                observation, info = env.reset(seed=seed)
                self._keep(drone, observation, 0.0, False, False, info)
            else:
                action = actions[drone]
                self._keep(drone, *env.step(int(action[0]) if self._discrete else action))

    def close(self) -> None:
        for env in self.envs:
            env.close()

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
        if observation.shape != self.observations.shape[1:] or observation.dtype != np.float32:
            raise ValueError(
                f"observation: expected float32 of shape {self.observations.shape[1:]}, "
                f"got {observation.dtype} of shape {observation.shape}"
            )
        self.observations[drone] = observation
        self.rewards[drone] = reward
        self.terminated[drone] = terminated
        self.truncated[drone] = truncated
        if self._names:
            self.telemetry[drone] = [info[name] for name in self._names]


def make_env(
    env: str | gym.Env[Any, Any], options: dict[str, Any], num_envs: int | None = None
) -> Any:
    """The env of an id and options, or the env itself; with a number, the vector env of the id.

    Raises `ValueError`.
    """
    if not isinstance(env, str):
        if options:
            raise ValueError(f"options {sorted(options)}: expected none with an env already made")
        return env
    try:
        if num_envs is None:
            return gym.make(env, disable_env_checker=True, **options)
        mode = gym.VectorizeMode.VECTOR_ENTRY_POINT
        return gym.make_vec(env, num_envs, vectorization_mode=mode, **options)
    except (gym.error.Error, ImportError) as error:
        raise ValueError(f"env: expected a registered id, got {env!r}: {error}") from None
    except TypeError as error:
        raise ValueError(f"options of {env}: {error}") from None


def _is_stepped_as_one(env_id: str) -> bool:
    """Whether an env has a vector env that takes a step of the wire."""
    try:
        entry = gym.spec(env_id).vector_entry_point
        return hasattr(load_env_creator(entry) if isinstance(entry, str) else entry, "advance")
    except (gym.error.Error, ImportError):
        return False  # `make_env` says what is wrong


def describe(env: Any, num_envs: int = 1) -> Hello:
    """The Hello of so many envs, with a new session. Raises `ValueError` if spaces do not fit.

    Args:
        env: One of them, or the vector env of all.
        num_envs: How many.
    """
    observation = getattr(env, "single_observation_space", env.observation_space)
    action = getattr(env, "single_action_space", env.action_space)
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

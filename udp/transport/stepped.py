"""Envs of a simulator: the loop of a registered task, or Gymnasium envs one after the other."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from ...envs import registry
from ...envs.spaces import action_space, observation_space
from ...envs.spec import ArraySpec, Discrete, EnvSpec, canonical_id, component_names
from ...models.errors import InputError, expect
from ..protocol.layout import MAX_DRONES
from ..protocol.party import World


class Steppable(World, Protocol):
    """What a simulator steps: the loop of a registered task, or Gymnasium envs."""

    spec: EnvSpec
    num_envs: int

    def close(self) -> None: ...


def make_stepped(
    env: str | gym.Env[Any, Any],
    num_envs: int,
    *,
    drones: int = 1,
    vehicle: Path | str | None = None,
    backend: str = "mujoco",
    options: Mapping[str, Any],
) -> Steppable:
    """N drones of an env. Raises `InputError` if its spaces or an argument are not right.

    Args:
        env: Id of a registered task, of an env of Gymnasium, or one env itself.
        num_envs: N, a multiple of `drones`.
        drones: Of each world, for a registered task.
        vehicle: File or name, for a registered task; None is the paper's.
        backend: One of `sim.BACKENDS`, for a registered task.
        options: Of the env, by name.
    """
    expect(type(drones) is int and drones >= 1, "drones", "1 or more", f"{drones!r}")
    right = type(num_envs) is int and 1 <= num_envs <= MAX_DRONES
    expect(right, "num_envs", f"1 to {MAX_DRONES}", f"{num_envs!r}")
    expect(num_envs % drones == 0, "drones", f"a divisor of num_envs = {num_envs}", f"{drones}")
    if isinstance(env, str):
        if registry.is_known(env):
            from ...envs.config import EnvConfig
            from ...envs.loop import Loop

            config = EnvConfig.from_keywords(
                env, drones=drones, vehicle=vehicle, backend=backend, **options
            )
            return Loop(config, num_envs // drones)
        try:
            envs = [gym.make(env, disable_env_checker=True, **options) for _ in range(num_envs)]
        except (gym.error.Error, ImportError) as error:
            raise InputError(f"env: expected a registered id, got {env!r}: {error}") from None
        except TypeError as error:
            raise InputError(f"options of {env}: {error}") from None
    else:
        expect(not options, f"options {sorted(options)}", "none with an env already made")
        expect(num_envs == 1, "num_envs", "1 with an env already made", f"{num_envs}")
        envs = [env]
    ours = vehicle is not None or backend != "mujoco" or drones > 1
    expect(not ours, "vehicle, backend, drones", f"none for {env!r}, which is no task of ours")
    return GymnasiumBatch(envs, options)


class GymnasiumBatch:
    """Gymnasium envs, one after the other."""

    def __init__(self, envs: Sequence[gym.Env[Any, Any]], options: Mapping[str, Any]) -> None:
        self.envs, self.num_envs = envs, len(envs)
        self.spec = spec_of_gymnasium(envs[0], options)
        n, spec = self.num_envs, self.spec
        self.observations = {a.name: np.zeros((n, *a.shape), a.dtype) for a in spec.observation}
        self.telemetry = {a.name: np.zeros((n, *a.shape)) for a in spec.telemetry}
        self.rewards = np.zeros(n)
        self.terminated, self.truncated = np.zeros(n, bool), np.zeros(n, bool)
        self._waiting = np.ones(n, bool)  # for a reset

    def advance(self, actions: np.ndarray, resets: Any, seeds: Any, frozen: Any) -> None:
        none = np.zeros(self.num_envs, bool)
        resets, frozen = none if resets is None else resets, none if frozen is None else frozen
        waiting = self._waiting & ~resets & ~frozen
        if waiting.any():
            raise gym.error.ResetNeeded(f"step: expected a reset of env {waiting.argmax()} first")
        for i, env in enumerate(self.envs):
            reward: Any = 0.0
            terminated = truncated = False
            if resets[i]:
                observation, info = env.reset(seed=None if seeds is None else int(seeds[i]))
                self._keep(i, observation, info)
            elif not frozen[i]:
                action = int(actions[i]) if isinstance(self.spec.action, Discrete) else actions[i]
                observation, reward, terminated, truncated, info = env.step(action)
                self._keep(i, observation, info)
            self.rewards[i], self.terminated[i], self.truncated[i] = reward, terminated, truncated
            self._waiting[i] = terminated or truncated or (frozen[i] and self._waiting[i])

    def close(self) -> None:
        for env in self.envs:
            env.close()

    def _keep(self, i: int, observation: Any, info: Mapping[str, Any]) -> None:
        named = isinstance(observation, dict)
        for array in self.spec.observation:
            value = np.asarray(observation[array.name] if named else observation)
            if value.shape != array.shape or value.dtype != array.dtype:
                expected = f"{array.dtype} of shape {array.shape}"
                got = f"{value.dtype} of shape {value.shape}"
                raise InputError(f"observation {array.name}: expected {expected}, got {got}")
            self.observations[array.name][i] = value
        for array in self.spec.telemetry:
            numbers = [info[name] for name in component_names(array)]
            self.telemetry[array.name][i] = np.reshape(numbers, array.shape)


def spec_of_gymnasium(env: gym.Env[Any, Any], options: Mapping[str, Any]) -> EnvSpec:
    """The env's own spec, or one from its spaces. `InputError`: one cannot cross the wire."""
    base: Any = env.unwrapped
    observation = env.observation_space
    boxes = observation.spaces if isinstance(observation, spaces.Dict) else {"": observation}
    arrays = tuple(_array(name or "observation", box) for name, box in boxes.items())
    action: ArraySpec | Discrete
    if isinstance(env.action_space, spaces.Discrete) and env.action_space.start == 0:
        action = Discrete(n=int(env.action_space.n))
    else:
        action = _array("action", env.action_space)
    spec, ours = getattr(base, "env_spec", None), (env.observation_space, env.action_space)
    if isinstance(spec, EnvSpec) and ours == (observation_space(spec), action_space(spec)):
        return spec
    fps = env.metadata.get("render_fps") or 50
    return EnvSpec(
        env_id=canonical_id(env.spec.id) if env.spec else type(base).__name__,
        options=dict(options),
        control_period=float(getattr(base, "control_period", 1 / fps)),
        observation=arrays,
        action=action,
    )


def _array(name: str, space: Any) -> ArraySpec:
    if not isinstance(space, spaces.Box):
        raise InputError(f"{name} space: expected Box, a Dict of Box, or Discrete, got {space}")
    low, high = (tuple(b.astype(np.float64).ravel().tolist()) for b in (space.low, space.high))
    return ArraySpec(name=name, shape=space.shape, dtype=str(space.dtype), low=low, high=high)

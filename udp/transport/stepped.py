"""What a simulator steps: the loop of a registered task, or another Gymnasium env."""

from collections.abc import Mapping
from typing import Any, Protocol, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from ...envs import registry
from ...envs.config import EnvConfig
from ...envs.spaces import action_space, observation_space
from ...envs.spec import ArraySpec, Discrete, EnvSpec, canonical_id, component_names
from ...models import InputError
from ...models.fields import check
from ..protocol.layout import DRONES, Array
from ..protocol.party import Mask, Seeds, World

GymEnv = gym.Env[Any, Any]


class Steppable(World, Protocol):
    """N drones of one spec."""

    spec: EnvSpec
    num_envs: int

    def close(self) -> None: ...


def make_stepped(
    env: str | EnvConfig | GymEnv,
    num_envs: int | None,
    keywords: Mapping[str, object],
) -> Steppable:
    """N drones of an env. Raises `InputError` if its spaces or an argument are not right.

    Args:
        env: Config, id of a registered task, or one Gymnasium env itself.
        num_envs: N, a multiple of the drones of a world; None: one world. Of an env that is no task
            of ours there is one.
        keywords: As of `EnvConfig.from_keywords`, with an id.
    """
    if isinstance(env, gym.Env):
        if keywords or num_envs not in (None, 1):
            got = ", ".join(keywords) or f"num_envs = {num_envs}"
            raise InputError(f"env: expected one env without keywords, got {got}")
        return GymnasiumWorld(env)
    config = EnvConfig.from_keywords(env, **keywords)
    registry.task_type(config.env_id)  # raises for one that is not known here
    drones = config.drones
    count = check("num_envs", DRONES, drones if num_envs is None else num_envs)
    if count % drones:
        raise InputError(f"drones: expected a divisor of num_envs = {count}, got {drones}")
    from ...envs.compiled import make_loop

    return make_loop(config, count // drones)


class GymnasiumWorld:
    """One Gymnasium env."""

    num_envs = 1

    def __init__(self, env: GymEnv) -> None:
        self.spec = spec = spec_of_gymnasium(env)
        self.observations = {a.name: np.zeros((1, *a.shape), a.dtype) for a in spec.observation}
        self.telemetry = {a.name: np.zeros((1, *a.shape)) for a in spec.telemetry}
        self.rewards = np.zeros(1)
        self.terminated = np.zeros(1, bool)
        self.truncated = np.zeros(1, bool)
        self._env = env
        self.out = self.done = np.ones(1, bool)  # it waits for a reset

    def advance(
        self,
        actions: Array,
        resets: Mask | None,
        seeds: Seeds | None,
        frozen: Mask | None,
        asks: Seeds | None = None,
    ) -> None:
        is_reset = resets is not None and resets.all()
        is_frozen = frozen is not None and frozen.all()
        if self.out.all() and not (is_reset or is_frozen):
            raise gym.error.ResetNeeded("step: expected a reset first")
        reward: SupportsFloat = 0.0
        terminated = truncated = False
        if is_reset:
            observation, info = self._env.reset(seed=None if seeds is None else int(seeds[0]))
        elif not is_frozen:
            action = int(actions[0]) if isinstance(self.spec.action, Discrete) else actions[0]
            observation, reward, terminated, truncated, info = self._env.step(action)
        if is_reset or not is_frozen:
            self._keep(observation, info)
            self.out[:] = terminated or truncated
        self.rewards[:] = float(reward)
        self.terminated[:] = terminated
        self.truncated[:] = truncated

    def close(self) -> None:
        self._env.close()

    def _keep(self, observation: object, info: Mapping[str, float]) -> None:
        for array in self.spec.observation:
            value = np.asarray(
                observation[array.name] if isinstance(observation, dict) else observation
            )
            if value.shape != array.shape or value.dtype != array.dtype:
                raise InputError(
                    f"observation {array.name}: expected {array.dtype} of shape {array.shape}, "
                    f"got {value.dtype} of shape {value.shape}"
                )
            self.observations[array.name][0] = value
        for array in self.spec.telemetry:
            numbers = [info[name] for name in component_names(array)]
            self.telemetry[array.name][0] = np.reshape(numbers, array.shape)


def spec_of_gymnasium(env: GymEnv) -> EnvSpec:
    """The env's own spec, or one from its spaces, with the keywords of `gymnasium.make` as options.

    Raises `InputError` if one cannot cross the wire.
    """
    base = env.unwrapped
    observation = env.observation_space
    boxes = observation.spaces if isinstance(observation, spaces.Dict) else {"": observation}
    arrays = tuple(_array(name or "observation", box) for name, box in boxes.items())
    action: ArraySpec | Discrete
    if isinstance(env.action_space, spaces.Discrete) and env.action_space.start == 0:
        action = Discrete(choices=int(env.action_space.n))
    else:
        action = _array("action", env.action_space)
    spec = getattr(base, "env_spec", None)
    ours = (env.observation_space, env.action_space)
    if isinstance(spec, EnvSpec) and ours == (observation_space(spec), action_space(spec)):
        return spec
    fps = env.metadata.get("render_fps") or 50
    return EnvSpec(
        env_id=canonical_id(env.spec.id) if env.spec else type(base).__name__,
        options=env.spec.kwargs if env.spec else {},
        control_period=float(getattr(base, "control_period", 1 / fps)),
        observation=arrays,
        action=action,
    )


def _array(name: str, space: object) -> ArraySpec:
    if not isinstance(space, spaces.Box):
        raise InputError(f"{name} space: expected Box, a Dict of Box, or Discrete, got {space}")
    low, high = (tuple(b.astype(np.float64).ravel().tolist()) for b in (space.low, space.high))
    return ArraySpec(name=name, shape=space.shape, dtype=str(space.dtype), low=low, high=high)

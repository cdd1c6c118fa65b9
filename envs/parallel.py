"""The drones of one world as PettingZoo's agents: a vector env behind the parallel signature."""

from typing import Any

import numpy as np

from ..models.errors import InputError, require
from .actions import Actions
from .autoreset import AdvancingVectorEnv, Observation
from .info import Info
from .rendering import RENDER_MODES
from .spaces import action_space, observation_space
from .vector import LocalVectorEnv

require("pettingzoo", "swarm", "the parallel env")

from pettingzoo import ParallelEnv  # noqa: E402  # where it is missing, one sentence says so

Told = dict[str, Any]
"""By the names of agents."""


class AdvancingParallelEnv(ParallelEnv[str, Any, Any]):  # type: ignore[misc]
    """Base of local and remote parallel envs: one world of an `AdvancingVectorEnv`.

    One whose episode ends leaves `agents`: its rotors stand still, and the others fly on. Spaces,
    rewards, ends and `info` are those of a single env of the task.

    Attributes:
        control_period: Time of a step, s.
    """

    def __init__(self, world: AdvancingVectorEnv) -> None:
        self._world = world
        self.env_spec = world.env_spec
        names = self.env_spec.agents
        self.control_period = world.control_period
        if world.num_envs != len(names):
            raise InputError(f"worlds: expected one, got {world.num_envs // len(names)}")
        fps = world.metadata["render_fps"]
        self.metadata = {"render_modes": [], "render_fps": fps, "name": self.env_spec.env_id,
                         "is_parallelizable": True}  # fmt: skip
        self.possible_agents = list(names)
        self.agents: list[str] = []
        self._rows = {agent: row for row, agent in enumerate(names)}
        self.observation_spaces = {agent: observation_space(self.env_spec) for agent in names}
        self.action_spaces = {agent: action_space(self.env_spec) for agent in names}
        self._actions = Actions.of(self.env_spec.action, 1)

    def observation_space(self, agent: str) -> Any:
        """The same object for an agent in every call."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Any:
        """The same object for an agent in every call."""
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: Info | None = None) -> tuple[Told, Told]:
        """Begin an episode with all agents; a seed makes it reproducible. `options` are ignored."""
        seen, info = self._world.reset(seed=seed)
        self.agents = list(self.possible_agents)
        return self._told(seen, info, self.agents)

    def step(self, actions: Told) -> tuple[Told, Told, Told, Told, Told]:
        """Fly for one control period with an action of each of `agents`.

        Gives observations, rewards, terminated, truncated and infos of those agents; one that ends
        is not among `agents` any more. Actions of others are ignored.
        """
        flown = self.agents
        world = self._world
        if not isinstance(actions, dict) or not actions.keys() >= set(flown):
            got = sorted(actions) if isinstance(actions, dict) else type(actions).__name__
            raise InputError(f"actions: expected a dict with {', '.join(flown)}, got {got}")
        given = np.zeros(world.action_space.shape or (), world.action_space.dtype)
        for agent in flown:
            action = self._actions.checked(actions[agent], name=f"action of {agent}")
            given[self._rows[agent]] = action[0]
        seen, rewards, terminated, truncated, info = world.step(given)
        self.agents = [agent for agent in flown if not world.out[self._rows[agent]]]
        observations, infos = self._told(seen, info, flown)
        scores = self._numbers(rewards, flown)
        ends = self._numbers(terminated, flown)
        return observations, scores, ends, self._numbers(truncated, flown), infos

    def render(self) -> Any:
        """A picture of the world, uint8, shape (360, 480, 3), with `rgb_array`; None otherwise."""
        pictures = self._world.render()
        return pictures[0] if pictures else None

    def close(self) -> None:
        """Close the window or tell the simulator; release memory."""
        self._world.close()

    def _numbers(self, values: np.ndarray, agents: list[str]) -> Told:
        return {agent: values[self._rows[agent]].item() for agent in agents}

    def _told(self, seen: Observation, info: Info, agents: list[str]) -> tuple[Told, Told]:
        """Observations and infos of some agents."""
        names = [name for name in info if not name.startswith("_")]
        several = isinstance(seen, dict)
        observations = {}
        infos = {}
        for agent in agents:
            row = self._rows[agent]
            observations[agent] = {n: x[row] for n, x in seen.items()} if several else seen[row]
            infos[agent] = {name: info[name][row] for name in names if info[f"_{name}"][row]}
        return observations, infos


class LocalParallelEnv(AdvancingParallelEnv):
    """Drones that fly a task in one world, in process: agents `drone_0` and so on.

    Args:
        env_id: Of a registered task for several drones.
        drones: How many.
        render_mode: None, `rgb_array` (a picture of the world) or `human` (a window).
        keywords: As of `EnvConfig.from_keywords`.

    Raises:
        InputError: An option, seed or action is not what it should be; the env is as before.
        PhysicsError: The physics reported a bad state; `reset` makes the env usable again.
        gymnasium.error.ResetNeeded: A step before a reset, or after the last agent left.
        gymnasium.error.ClosedEnvironmentError: A step or a reset after `close`.
    """

    def __init__(
        self,
        env_id: str,
        drones: int = 2,
        render_mode: str | None = None,
        **keywords: Any,
    ) -> None:
        world = LocalVectorEnv(
            env_id, drones, render_mode, autoreset_mode="Disabled", drones=drones, **keywords
        )
        super().__init__(world)
        self.render_mode = render_mode
        self.metadata["render_modes"] = RENDER_MODES

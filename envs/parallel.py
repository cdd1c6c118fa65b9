"""The drones of one world as PettingZoo's agents: the loop behind its parallel signature."""

from pathlib import Path
from typing import Any

import numpy as np

from ..models.errors import InputError, NotCopied, expect, require
from ..sim import Backend
from .loop import Loop
from .rendering import RENDER_MODES, Renderer
from .spaces import action_space, info_columns, joined, observation_space

require("pettingzoo", "swarm", "the parallel env")

from pettingzoo import ParallelEnv  # noqa: E402  # where it is missing, one sentence says so

Told = dict[str, Any]
"""By the names of agents."""


class LocalParallelEnv(NotCopied, ParallelEnv[str, Any, Any]):  # type: ignore[misc]
    """Drones that fly a task in one world, in process.

    Agents are `drone_0` and so on. One whose episode ends leaves `agents`: its rotors stand still,
    and the others fly on. Spaces, rewards, ends and `info` are those of a single env of the task.

    Args:
        env_id: Of a registered task for several drones.
        drones: How many.
        render_mode: None, `rgb_array` (a picture of the world) or `human` (a window).
        vehicle: As of `Vehicle.load`: a file or a name; None is the paper's.
        backend: What steps the world.
        options: Of the task, by name.

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
        *,
        vehicle: Path | str | None = None,
        backend: Backend = "mujoco",
        **options: Any,
    ) -> None:
        self._loop = loop = Loop(
            env_id, drones=drones, vehicle=vehicle, backend=backend, options=options
        )
        self.render_mode, self._renderer = render_mode, Renderer(render_mode, loop)
        self.env_spec, self.control_period = loop.spec, loop.spec.control_period
        fps = max(1, round(1 / self.control_period))
        self.metadata = {"render_modes": RENDER_MODES, "render_fps": fps, "name": loop.spec.env_id,
                         "is_parallelizable": True}  # fmt: skip
        self.possible_agents = list(loop.spec.agents)
        self.agents: list[str] = []
        self._rows = {agent: row for row, agent in enumerate(self.possible_agents)}
        self.observation_spaces = {a: observation_space(loop.spec) for a in self._rows}
        self.action_spaces = {a: action_space(loop.spec) for a in self._rows}
        self._everybody = np.ones(drones, bool)
        self._actions = np.zeros((drones, len(loop.task.controller.low)), np.float32)
        self._episodes = 0

    def observation_space(self, agent: str) -> Any:
        """The same object for an agent in every call."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Any:
        """The same object for an agent in every call."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Told, Told]:
        """Begin an episode with all agents; a seed makes it reproducible. `options` are ignored."""
        seeds = None if seed is None else [seed] * len(self._rows)
        self._loop.advance(self._actions, self._everybody, seeds)
        self.agents = list(self.possible_agents)
        self._episodes += 1
        if self.render_mode == "human":
            self.render()
        return self._observations(self.agents), self._infos(self.agents)

    def step(self, actions: Told) -> tuple[Told, Told, Told, Told, Told]:
        """Fly for one control period with an action of each of `agents`.

        Gives observations, rewards, terminated, truncated and infos of those agents; one that ends
        is not among `agents` any more.
        """
        flown, loop = self.agents, self._loop
        right = isinstance(actions, dict) and actions.keys() >= set(flown)
        got = sorted(actions) if isinstance(actions, dict) else type(actions).__name__
        expect(right, "actions", f"a dict with {', '.join(flown)}", f"{got}")
        given = self._actions.copy()
        for agent in flown:
            given[self._rows[agent]] = self._checked(agent, actions[agent])
        loop.advance(given)
        self.agents = [agent for agent in flown if not loop.out[self._rows[agent]]]
        if self.render_mode == "human":
            self.render()
        return (
            self._observations(flown),
            {agent: loop.rewards[self._rows[agent]].item() for agent in flown},
            {agent: loop.terminated[self._rows[agent]].item() for agent in flown},
            {agent: loop.truncated[self._rows[agent]].item() for agent in flown},
            self._infos(flown),
        )

    def render(self) -> Any:
        """A picture of the world, uint8, shape (360, 480, 3), with `rgb_array`; None otherwise."""
        pictures = self._renderer.render([self._episodes] * len(self._rows))
        return pictures[0] if pictures else None

    def close(self) -> None:
        """Close the window, if there is one; release memory."""
        self._renderer.close()
        self._loop.close()

    def _checked(self, agent: str, action: Any) -> np.ndarray:
        try:
            array = np.asarray(action)
        except ValueError:
            array = np.asarray(None)
        shape = self.action_spaces[agent].shape
        if array.dtype.kind not in "iuf" or array.shape != shape:
            raise InputError(
                f"actions: expected an array of real numbers of shape {shape} for {agent}, got "
                f"{action!r:.80}"
            )
        return array

    def _observations(self, agents: list[str]) -> Told:
        seen = joined(self._loop.spec, self._loop.observations)
        if isinstance(seen, dict):
            return {a: {n: x[self._rows[a]] for n, x in seen.items()} for a in agents}
        return {agent: seen[self._rows[agent]] for agent in agents}

    def _infos(self, agents: list[str]) -> Told:
        loop = self._loop
        columns = info_columns(loop.spec, loop.telemetry)
        columns |= {f"reward_{name}": term for name, term in loop.reward_terms.items()}
        return {
            agent: {name: column[self._rows[agent]].item() for name, column in columns.items()}
            for agent in agents
        }

"""The loop that joins a vehicle, a world and a task; every env and every simulator is this one.

A single env is the loop with one world. An agent's command resets some drones, freezes some, and
flies the others for one control period: `advance` is that step, the step of the wire.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import numpy as np

from ..models.errors import InputError
from ..models.frames import attitudes_in_paper_frame, positions_in_paper_frame
from ..models.vehicle import Vehicle
from ..sim import Array, Backend, PhysicsError, World, make_world
from . import registry
from .spec import ArraySpec, Discrete, EnvSpec, canonical_id
from .tasks.task import Outcome, Task

__all__ = ["Loop", "make_task", "spec_of"]

_SMALL: Final = 64
"""Up to this many numbers Python's loop is faster than NumPy's call."""


def make_task(
    env_id: str,
    options: Mapping[str, Any],
    vehicle: Path | str | None = None,
    shape: tuple[int, int] = (1, 1),
    xp: Any = np,
) -> Task:
    """The task of an env id with options by name, for W worlds of A drones. Raises `InputError`."""
    kind = registry.task_type(env_id)
    checked = kind.Options.from_options(options)
    craft = Vehicle.load(vehicle, linear_drag=checked.linear_drag)
    craft.substeps(checked.control_period)  # raises where they do not go together
    return kind(checked, craft, shape, xp)


def spec_of(env_id: str, task: Task) -> EnvSpec:
    """What an agent must know of a task's env."""
    vehicle, controller = task.vehicle, task.controller
    if controller.choices:
        action: ArraySpec | Discrete = Discrete(
            n=controller.choices, components=controller.components
        )
    else:
        action = ArraySpec(
            name="action",
            shape=(len(controller.low),),
            low=controller.low,
            high=controller.high,
            components=controller.components,
        )
    return EnvSpec(
        env_id=env_id,
        options=asdict(task.options),
        control_period=task.options.control_period,
        vehicle=vehicle.name,
        vehicle_hash=vehicle.hash,
        observation=task.observation,
        action=action,
        telemetry=_telemetry_specs(task),
        metrics=task.metrics,
    )


def _telemetry_specs(task: Task) -> tuple[ArraySpec, ...]:
    def numbers(name: str, components: Sequence[str], **rest: Any) -> ArraySpec:
        names = tuple(components)
        return ArraySpec(name=name, shape=(len(names),), dtype="float64", components=names, **rest)

    vehicle = task.vehicle
    specs = [
        numbers("position", "XYZ", unit="m", frame="paper"),
        numbers("attitude", ("phi", "theta", "psi"), unit="deg", frame="paper"),
        numbers(
            "thrust",
            [f"F{i + 1}" for i in range(vehicle.num_rotors)],
            unit="N",
            low=tuple(vehicle.thrust_low.tolist()),
            high=tuple(vehicle.thrust_high.tolist()),
        ),
    ]
    if has_goal(task):
        names = ("X_goal", "Y_goal", "Z_goal")
        specs.append(numbers("goal", names, unit="m", frame="paper"))
    if task.metrics:
        units = tuple(metric.unit for metric in task.metrics)
        specs.append(numbers("metrics", [metric.name for metric in task.metrics], unit=units))
    return tuple(specs)


def has_goal(task: Task) -> bool:
    """Whether a task says where the drones should be."""
    return type(task).goal is not Task.goal


class Loop:
    """N drones of one env, each in a world of its own.

    Args:
        env_id: Of a registered task.
        num_envs: N.
        vehicle: MJCF file; None is the paper's.
        backend: What steps the physics.
        options: Of the task, by name.
        settings: Of the backend: `num_threads`, or `device`.

    Attributes:
        spec: What there is to know of it.
        task, world: What is joined here.
        observations: By name, shape (N, *shape), of the declared dtypes. This and the following
            are made anew by each `advance`: those of the last one stay as they were.
        rewards: float64, shape (N,); 0 for a drone that did not fly.
        reward_terms: By name, each of shape (N,).
        terminated, truncated: bool, shape (N,).
        done: bool, shape (N,): the episode has ended and the next has not begun.
        steps: Control steps of the running episode, shape (N,).

    Raises:
        InputError: An argument, seed or action is not what it should be; nothing has changed.
        PhysicsError: A state is bad; the drones that flew are to be reset.
        gymnasium.error.ResetNeeded: A drone whose episode has not begun, or has ended, is to fly.
    """

    def __init__(
        self,
        env_id: str,
        num_envs: int = 1,
        *,
        vehicle: Path | str | None = None,
        backend: Backend = "mujoco",
        options: Mapping[str, Any] | None = None,
        **settings: Any,
    ) -> None:
        draft = make_task(env_id, options or {}, vehicle)
        self.world: World = make_world(draft.vehicle, num_envs, backend, **settings)
        xp = self._xp = self.world.xp
        self.task = type(draft)(draft.options, draft.vehicle, self.world.shape, xp)
        self.spec = spec_of(canonical_id(env_id), self.task)
        self.num_envs = num_envs
        self.vehicle = draft.vehicle
        self._substeps = draft.vehicle.substeps(draft.options.control_period)
        self._length = draft.options.episode_length
        self._has_goal = has_goal(draft)
        self._action_shape = (*self.world.shape, len(self.task.controller.low))
        self._choices = self.task.controller.choices
        self._drones = (num_envs,)
        self._zeros = 0.0 * self.world.state.position[:, 0, 0]
        self._nobody = self._zeros != 0.0
        self._everybody = ~self._nobody
        self.steps: Array = self._xp.astype(self._zeros, self._xp.int64)
        self.observations: dict[str, Array] = {}
        self.rewards = self._zeros
        self.reward_terms: dict[str, Array] = {}
        self.terminated = self.truncated = self.done = self._nobody
        self._waiting = self._everybody  # for a reset
        self._anyone_waits = True
        self._begun = False
        self._outcome: Outcome | None = None
        self._telemetry: dict[str, np.ndarray] | None = None

    def advance(
        self,
        actions: Array,
        resets: Array | None = None,
        seeds: Sequence[int | None] | np.ndarray | None = None,
        frozen: Array | None = None,
        chosen: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """Reset some drones, freeze some, and fly the others for one control period.

        Rewards and flags of a drone that is reset or frozen are 0, and its action is ignored. One
        that is frozen is afterwards as it was before.

        Args:
            actions: float32, shape (N, k), or whole numbers, shape (N,) or (N, 1).
            resets: bool, shape (N,); None resets none.
            seeds: Shape (N,), of those that are reset; None leaves their streams as they are.
            frozen: bool, shape (N,); None freezes none.
            chosen: By the names of `Task.choices`, what replaces a draw, shape (N,).
        """
        idle = resets if frozen is None else frozen if resets is None else resets | frozen
        flown = None if idle is None or not idle.any() else ~idle
        self._check_begun(flown)
        if flown is None or flown.any():
            self._fly(actions, flown)
        if resets is not None and resets.any():
            self.begin(resets, seeds, chosen)
        self._look(flown)

    def begin(
        self,
        mask: Array,
        seeds: Sequence[int | None] | np.ndarray | None = None,
        chosen: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """Begin episodes of the drones of a mask, bool, shape (N,): part of `advance`."""
        if not self._begun and not mask.all():  # the first time a task wants all of them
            self._begin(self._everybody, {})
            self._waiting = ~mask
        if seeds is not None:
            self.world.seed(mask, seeds)
        shape = self.world.shape
        self._begin(mask, {name: x.reshape(shape) for name, x in (chosen or {}).items()})

    def _begin(self, mask: Array, chosen: Mapping[str, np.ndarray]) -> None:
        world = self.world
        world.reset(mask, self.task.begin(mask[:, None], world.draw(mask, chosen)))
        self._begun = True
        self.steps = self._xp.where(mask, 0, self.steps)
        self._waiting = self._waiting & ~mask
        self._anyone_waits = bool(self._waiting.any())
        self.done = self.done & ~mask

    def _check_begun(self, flown: Array | None) -> None:
        if not self._anyone_waits:
            return
        waiting = self._waiting if flown is None else self._waiting & flown
        if waiting.any():
            first = int(waiting.nonzero()[0][0])
            raise gym.error.ResetNeeded(f"step: expected a call of reset() for env {first} first")

    def _fly(self, actions: Array, flown: Array | None) -> None:
        world = self.world
        values = self._values(actions, flown)
        thrust = self.task.controller.thrust(values, world.state)
        try:
            world.step(thrust, self._substeps, flown)
        except PhysicsError:
            self._waiting = self._waiting | (self._everybody if flown is None else flown)
            self._anyone_waits = True
            raise
        self.steps = self.steps + (1 if flown is None else self._xp.astype(flown, self._xp.int64))

    def _look(self, flown: Array | None) -> None:
        """Observations, rewards and ends after a step."""
        task, state, n = self.task, self.world.state, self._drones
        self._telemetry = None
        observed = task.observe(state)
        self.observations = {
            array.name: self._declared(observed[array.name], array) for array in task.observation
        }
        self._outcome = outcome = task.outcome(state)
        ended = outcome.terminated.reshape(n)
        late = self.steps >= self._length
        terms = {name: term.reshape(n) for name, term in outcome.reward.items()}
        if flown is None:
            self.terminated, self.truncated = ended, late & ~ended
        else:
            self.terminated, self.truncated = ended & flown, late & ~ended & flown
            # A drone that did not fly gets no reward: nothing has ended, nothing was won.
            terms = {name: self._xp.where(flown, term, 0.0) for name, term in terms.items()}
        self.reward_terms = terms
        self.rewards = sum(terms.values(), self._zeros)
        over = self.terminated | self.truncated
        if over.any():
            self._waiting, self._anyone_waits = self._waiting | over, True
            self.done = self.done | over

    def _declared(self, values: Array, array: ArraySpec) -> Array:
        """An observation (W, A, *shape) as (N, *shape) of its dtype."""
        shaped = values.reshape((*self._drones, *array.shape))
        return self._xp.astype(shaped, getattr(self._xp, array.dtype))

    def _values(self, actions: Array, flown: Array | None) -> Array:
        """Actions as controllers take them: float64, shape (W, A, k). Raises `InputError`."""
        if self._xp is np:
            values = self._checked(np.asarray(actions), flown)
        else:
            values = self.world.checked(actions, self._action_shape, self._choices)  # type: ignore[attr-defined]
        return values.reshape(self._action_shape)

    def _checked(self, actions: np.ndarray, flown: Array | None) -> np.ndarray:
        kind = actions.dtype.kind
        if kind not in ("iuf" if not self._choices else "iufb"):
            raise InputError(f"actions: expected real numbers, got {actions.dtype}")
        if actions.size != self._action_shape[0] * self._action_shape[1] * self._action_shape[2]:
            raise InputError(
                f"actions: expected shape {(self.num_envs, self._action_shape[2])}, "
                f"got {actions.shape}"
            )
        values = actions.reshape(self.num_envs, -1)
        if values.dtype != np.float32 and not self._choices:
            with np.errstate(over="ignore"):  # what overflows is infinite, and refused as such
                values = values.astype(np.float32)
        right = self._right(values)
        if right is not None:
            wrong = ~right if flown is None else ~right & flown
            if wrong.any():
                self._refuse(values, int(wrong.argmax()))
            values = np.where(right[:, None], values, values.dtype.type(0))
        return values.astype(np.float64)

    def _right(self, values: np.ndarray) -> np.ndarray | None:
        """Whose actions are of the space, shape (N,); None if all are."""
        if self._choices:
            right = ((values >= 0) & (values < self._choices) & (values % 1 == 0)).all(axis=1)
        else:
            if values.size <= _SMALL:
                total = sum(values.ravel().tolist())
                if total - total == 0.0:  # else one is NaN or infinite, or they add up to too much
                    return None
            right = np.isfinite(values).all(axis=1)
        return None if right.all() else right

    def _refuse(self, values: np.ndarray, first: int) -> None:
        expected = f"a whole number 0 to {self._choices - 1}" if self._choices else "finite numbers"
        got = values[first].tolist()
        raise InputError(f"actions: expected {expected}, got {got} for env {first}")

    @property
    def telemetry(self) -> dict[str, np.ndarray]:
        """By the names of `spec.telemetry`, float64, shape (N, *shape), in the paper's frame."""
        if self._telemetry is None:
            state, n = self.world.state, self.num_envs
            host = _on_host
            told = {
                "position": positions_in_paper_frame(host(state.position).reshape(n, 3)),
                "attitude": attitudes_in_paper_frame(host(state.quaternion).reshape(n, 4)),
                "thrust": host(state.thrust).reshape(n, -1).copy(),
            }
            if self._has_goal:
                goal = host(self.task.goal(state)).reshape(n, 3)
                told["goal"] = positions_in_paper_frame(goal)
            if self._outcome is not None and self.task.metrics:
                metrics = [host(self._outcome.metrics[m.name]) for m in self.task.metrics]
                told["metrics"] = np.stack(metrics, axis=-1).reshape(n, -1)
            self._telemetry = told
        return self._telemetry

    def close(self) -> None:
        """Let go of threads and memory."""
        self.world.close()

    def __reduce__(self) -> Any:
        """Raise: simulator memory cannot be copied, and a copy that seems to fly would be wrong."""
        raise TypeError("a running env cannot be copied or pickled: make another one")


def _on_host(array: Array) -> np.ndarray:
    if isinstance(array, np.ndarray):
        return array
    copied: np.ndarray = array.detach().cpu().numpy().astype(np.float64)
    return copied

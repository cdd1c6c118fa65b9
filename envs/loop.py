"""The loop that joins a vehicle, a world and a task; every env and simulator runs it.

A single env is the loop with one world. An agent's command resets some drones, freezes some, and
flies the others for one control period: `advance` is that step, the step of the wire.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from math import isfinite, prod
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import numpy as np

from ..models import scenes_of
from ..models.errors import InputError, NotCopied, expect
from ..models.fleet import Fleet, load_vehicles
from ..models.frames import attitudes_in_paper_frame, positions_in_paper_frame
from ..models.swarm import drone_names
from ..sim import (
    PARAMETERS,
    Array,
    Backend,
    Draw,
    EffectOptions,
    PhysicsError,
    Pose,
    Randomization,
    World,
    WorldState,
    clip,
    constant,
    each,
    make_controller,
    make_world,
    on_host,
    plain,
)  # fmt: skip
from ..sim.sensors import Sensors, readings_of
from . import registry
from .autoreset import Seeds, checked_seeds, worlds_done
from .delay import Delay
from .sights import Sights, arrays_of, objects_of_all, views_of
from .spec import ArraySpec, Discrete, EnvSpec, canonical_id
from .tasks.task import Outcome, Task

_DESCENT: Final = 0.7  # of `Loop.land`, m/s: PX4's default of MPC_LAND_SPEED
_SMALL: Final = 64  # Up to this many numbers Python's loop is faster than NumPy's call


def make_task(
    env_id: str,
    options: Mapping[str, Any],
    vehicle: Path | str | None = None,
    shape: tuple[int, int] = (1, 1),
    xp: Any = np,
) -> Task:
    """The task of an env id with options by name, for W worlds of A drones. Raises `InputError`."""
    kind = registry.task_type(env_id)
    for name in ("setup", "begin", "observe", "outcome"):
        own = getattr(kind, name) is not getattr(Task, name)
        expect(own, env_id, f"a task with a method {name}()", f"{kind.__name__} without one")
    checked = kind.Options.from_options(options)
    least, most, drones = kind.fewest, kind.drones, shape[1]
    range_told = f"{least} to {most}" if most > least else f"{most}"
    right = type(drones) is int and least <= drones <= most
    expect(right, "drones", f"{range_told} with {canonical_id(env_id)}", f"{drones!r}")
    craft = load_vehicles(vehicle, drones, linear_drag=checked.linear_drag)
    craft.substeps(checked.control_period)  # raises where they do not go together
    measured = checked.sensors if isinstance(craft, Fleet) else {}
    expect(not measured, "sensors", "none with several vehicles", ", ".join(measured))
    task = kind(checked, craft, shape, xp)
    for name in ("controller", "observation"):
        if not hasattr(task, name):
            raise InputError(f"{env_id}: expected setup() to set self.{name}, it does not")
    return task


def _check_returned(
    spec: EnvSpec, observed: Any, outcome: Any, num_envs: int, *, alone: bool
) -> None:
    """Tell the author of a task what its methods have to return. Raises `InputError`."""
    env_id, names = spec.env_id, [array.name for array in spec.observation]
    mapping = isinstance(observed, Mapping)
    got = list(observed) if mapping else type(observed).__name__
    right = mapping and observed.keys() >= set(names)
    expect(right, env_id, f"observe() to return a dict of {names}", f"{got}")
    for array in spec.observation:
        shape = tuple(getattr(observed[array.name], "shape", ()))
        expect(
            prod(shape) == num_envs * array.size,
            env_id,
            f"observe() to return {array.name} of shape {array.shape} for each of {num_envs} "
            "drones",
            f"an array of shape {shape}",
        )
    returned = type(outcome).__name__
    expect(isinstance(outcome, Outcome), env_id, "outcome() to return an Outcome", returned)
    for metric in spec.metrics:
        told = list(outcome.metrics)
        expect(metric.name in told, env_id, f"the metric {metric.name!r}", f"{told}")
    expect(
        alone or any(getattr(term, "shape", ()) for term in outcome.reward.values()),
        env_id,
        "a reward for each drone",
        f"{outcome.reward}: make an array of it, as 1.0 + 0.0 * state.position[..., 2]",
    )
    kind = getattr(outcome.terminated, "dtype", type(outcome.terminated).__name__)
    expect("bool" in str(kind), env_id, "terminated as truth values", f"{kind}")


def spec_of(
    env_id: str, task: Task, drones: int = 1, pictures: tuple[ArraySpec, ...] | None = None
) -> EnvSpec:
    """The `EnvSpec` of a task's env with so many drones in a world, and with these pictures."""
    vehicle, controller = task.vehicle, task.controller
    names, low, high = controller.components, controller.low, controller.high
    action: ArraySpec | Discrete = (
        Discrete(n=controller.choices, components=names)
        if controller.choices
        else ArraySpec(
            name="action",
            shape=(len(low),),
            low=low,
            high=high,
            unit=getattr(controller, "units", ""),
            frame=getattr(controller, "frame", ""),
            components=names,
        )
    )
    return EnvSpec(
        env_id=env_id,
        options=task.options.to_options(),
        control_period=task.options.control_period,
        vehicle=vehicle.name,
        vehicle_hash=vehicle.hash,
        agents=drone_names(drones),
        observation=tuple(_repeated(a, task.options.history) for a in _observed(task))
        + (_pictures(task, drones) if pictures is None else pictures),
        action=action,
        telemetry=_telemetry_specs(task),
        metrics=task.metrics,
        marks=task.marks,
    )


def _observed(task: Task) -> tuple[ArraySpec, ...]:
    """What is observed of one moment: by the task, and by sensors."""
    options = task.options
    readings = readings_of(options.sensors, task.vehicle, options.control_period)
    return task.observation + tuple(ArraySpec(**reading._asdict()) for reading in readings)


def _pictures(task: Task, drones: int) -> tuple[ArraySpec, ...]:
    """What cameras add to an observation; nothing is drawn."""
    if not task.options.cameras:
        return ()
    views = views_of(task, drones)
    if not any(view.kind == "segmentation" for view in views):
        return arrays_of(views, ())
    from ..rendering.seen import objects_of

    hung, scenes = bool(task.effects.get("payload")), scenes_of(task.options.world)
    objects = [objects_of(task.vehicle, drones, one, task.marks, payload=hung) for one in scenes]
    return arrays_of(views, objects_of_all(objects))


def _repeated(array: ArraySpec, count: int) -> ArraySpec:
    """So many values of an array side by side along its first axis, the oldest first."""
    if count == 1:
        return array
    length, *rest = array.shape or (1,)
    low, high = (np.tile(end.ravel(), count) for end in array.bounds())
    units = array.unit if isinstance(array.unit, str) else array.unit * count
    names = tuple(
        name if age == 0 else f"{name}, {age} step{'s' * (age > 1)} ago"
        for age in reversed(range(count))
        for name in array.components
    )
    return replace(
        array, shape=(count * length, *rest), low=tuple(low.tolist()), high=tuple(high.tolist()),
        unit=units, components=names,
    )  # fmt: skip


def _telemetry_specs(task: Task) -> tuple[ArraySpec, ...]:
    def numbers(name: str, components: Sequence[str], **rest: Any) -> ArraySpec:
        names = tuple(components)
        return ArraySpec(name=name, shape=(len(names),), dtype="float64", components=names, **rest)

    vehicle = task.vehicle
    specs = [
        numbers("position", "XYZ", unit="m", frame="paper"),
        numbers("attitude", ("phi", "theta", "psi"), unit="deg", frame="paper"),
        numbers(  # bounds of the commands: rotors whose efficiency is drawn may leave them
            "thrust",
            [f"F{i + 1}" for i in range(vehicle.num_rotors)],
            unit="N",
            low=tuple(np.atleast_2d(vehicle.thrust_low).min(axis=0).tolist()),
            high=tuple(np.atleast_2d(vehicle.thrust_high).max(axis=0).tolist()),
        ),
    ]
    if drawn := Randomization(task.options.randomize, None).names:
        units = tuple(PARAMETERS[name].unit for name in drawn)
        specs.append(numbers("drawn", [f"drawn_{name}" for name in drawn], unit=units))
    if task.effects.get("payload"):
        names = ("X_payload", "Y_payload", "Z_payload")
        specs.append(numbers("payload", names, unit="m", frame="paper"))
    if type(task).goal is not Task.goal:
        names = ("X_goal", "Y_goal", "Z_goal")
        specs.append(numbers("goal", names, unit="m", frame="paper"))
    if task.metrics:
        units = tuple(metric.unit for metric in task.metrics)
        specs.append(numbers("metrics", [metric.name for metric in task.metrics], unit=units))
    return tuple(specs)


class Loop(NotCopied):
    """N drones of one env, each in a world of its own, or so many together.

    Drones of one world begin together. One whose episode ends before those of the others is *out*:
    its rotors stand still, it gets no reward and no second end, and the others fly on. The world is
    done when all are out. Masks and seeds have an element for each drone, and those of one world
    are alike; its first one's seed counts.

    The vehicle is a file, None the paper's; options are the task's, by name; settings the
    backend's: see `sim.make_world`.

    Attributes:
        task, world: Their arrays have the leading axes of the world; all others here have one axis
            of N drones, world by world, and are new after each `advance`.
        observations: By name, shape (N, *shape), of the declared dtypes.
        rewards: float64, shape (N,); 0 for a drone that did not fly.
        terminated, truncated: bool, shape (N,).
        done: bool, shape (N,): the world's episode has ended and the next has not begun.
        out: bool, shape (N,): its own has ended.
        terms: Terms of the last rewards by name, with the leading axes of the world.

    Raises:
        InputError: An argument, seed or action is not what it should be; nothing has changed, but
            for a start that the task refuses: see `advance`.
        PhysicsError: A state is bad; reset the drones that flew.
        gymnasium.error.ResetNeeded: An action came before an episode's beginning or after its end.
        gymnasium.error.ClosedEnvironmentError: A step or a reset after `close`.
    """

    def __init__(
        self,
        env_id: str,
        num_worlds: int = 1,
        *,
        drones: int = 1,
        vehicle: Path | str | None = None,
        backend: Backend = "mujoco",
        options: Mapping[str, Any] | None = None,
        **settings: Any,
    ) -> None:
        draft = make_task(env_id, options or {}, vehicle, (1, drones))
        chosen, craft = draft.options, draft.vehicle
        effects = EffectOptions.from_options(draft.effects)
        randomize = Randomization(chosen.randomize, effects) if chosen.randomize else None
        self.world: World = make_world(
            craft, num_worlds, backend, drones=drones, effects=effects, randomize=randomize,
            **settings,
        )  # fmt: skip
        self._xp = self.world.xp
        self.task = type(draft)(chosen, craft, self.world.shape, self._xp)
        self._sights = Sights(self.task, (num_worlds, drones)) if chosen.cameras else None
        pictures = self._sights.arrays if self._sights else ()
        self.spec = spec_of(canonical_id(env_id), self.task, drones, pictures)
        self.num_envs, self.vehicle = num_worlds * drones, craft
        self._drones = drones
        self._prepare_step()
        self._prepare_observations()
        self._prepare_memory(randomize)
        self._clear()

    def _prepare_step(self) -> None:
        """What a step needs to know of actions and times."""
        controller, options = self.task.controller, self.task.options
        self._choices, self._width = controller.choices, len(controller.low)
        self._action_shape = (*self.world.shape, self._width)
        self._length = options.episode_length
        self._substeps = self.vehicle.substeps(options.control_period)
        # An estimate is one for a control step, and so are the thrusts of what sees it.
        often = getattr(controller, "every_step", False) and not options.estimated
        self._held = 1 if often else self._substeps

    def _prepare_observations(self) -> None:
        """Arrays of observations and telemetry, and the sensors."""
        options, observed = self.task.options, _observed(self.task)
        flat = (1,) if options.history > 1 else ()
        self._arrays = [
            (a.name, (self.num_envs, *(a.shape or flat)), getattr(self._xp, a.dtype))
            for a in observed
        ]
        sensors, period = options.sensors, options.control_period
        self._sensors = Sensors(sensors, self.world, period) if sensors else None
        # An estimate may leave the task's bounds.
        self._limits = {a.name: a.bounds() for a in observed if options.estimated}
        ends = np.cumsum([0, *(array.size for array in self.spec.telemetry)]).tolist()
        self._columns = {  # where each array of the telemetry lies in the row of a single drone
            array.name: slice(*ends[i : i + 2]) for i, array in enumerate(self.spec.telemetry)
        }
        self._has_goal = "goal" in self._columns

    def _prepare_memory(self, randomize: Randomization | None) -> None:
        """Delays that are drawn, and the observations that are kept."""
        self._drawn = () if randomize is None else randomize.names

        names, count = [name for name, *_ in self._arrays], self.task.options.history
        self._late_actions: Delay | None = None
        self._late_observations: dict[str, Delay] = {}
        if randomize is not None and "action_delay" in self._drawn:
            self._late_actions = Delay(randomize.most_steps("action_delay"), self._xp)
        if randomize is not None and "observation_delay" in self._drawn:
            most = randomize.most_steps("observation_delay")
            seen = [*names, *(view.name for view in self._sights.views)] if self._sights else names
            self._late_observations = {name: Delay(most, self._xp) for name in seen}
        self._history = {name: Delay(count - 1, self._xp) for name in names if count > 1}

    def _clear(self) -> None:
        """No episode has begun, and nothing was seen."""
        none = self.world.state.touching != self.world.state.touching  # all False, on its device
        self._none, self._nobody = none, none.reshape(self.num_envs)
        self._everybody: Array = ~none
        self.terminated = self.truncated = self.done = self.out = self._nobody
        self.rewards: Array = 0.0 * self._nobody
        self.observations: dict[str, Array] = {}
        self.terms: dict[str, Array] = {}
        self._steps: Array = plain((0 * self._nobody).reshape(self.world.shape))
        self._waiting, self._anyone_waits = ~self._nobody, True  # for a reset
        self._begun = self._closed = self._anyone_out = False
        least = np.clip(0.0, self.vehicle.thrust_low, self.vehicle.thrust_high)
        self._rest = constant(least, self.world.state.thrust)  # of rotors that stand still
        self._landing: Array | None = None  # bool, shape (N,): those that `land` brings down
        self._outcome: Outcome | None = None
        self._telemetry: dict[str, np.ndarray] | None = None

    def advance(
        self,
        actions: Array,
        resets: Array | None = None,
        seeds: Seeds | None = None,
        frozen: Array | None = None,
        chosen: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """Reset some drones, freeze some, and fly the others for one control period.

        As `AdvancingVectorEnv.advance`; `chosen` has by the names of `Task.choices` what replaces
        a draw, shape (N,). Where the task refuses such a start, the others have flown, those to be
        reset are where they were, and their streams of random numbers have moved on.
        """
        resets = None if resets is None else self.ours(resets)
        frozen = None if frozen is None else self.ours(frozen)
        if self._drones > 1:
            self._check_together(resets, frozen)
        idle = resets if frozen is None else frozen if resets is None else resets | frozen
        flown = None if idle is None or not idle.any() else ~idle
        if self._anyone_waits:  # always after `close`
            if self._closed:
                raise gym.error.ClosedEnvironmentError("expected an open env, got a closed one")
            waiting = self._waiting if flown is None else self._waiting & flown
            if waiting.any():
                first = f"env {int(waiting.nonzero()[0][0])}"
                raise gym.error.ResetNeeded(f"step: expected a call of reset() for {first} first")
        begins = resets is not None and bool(resets.any())
        if begins:
            seeds = checked_seeds(seeds, self.num_envs)
        if flown is None or flown.any():
            self._fly(actions, flown)
        if begins:
            self._begin(resets, seeds, chosen or {})
        self._look(flown, resets if begins else None)

    def _fly(self, actions: Array, flown: Array | None) -> None:
        world = self.world
        if self._xp is np:
            values = self._checked(np.asarray(actions), flown)
        else:
            values = world.checked(actions, self._width, self._choices, flown)
            values = values.reshape(self._action_shape)
        some = None if flown is None else flown.reshape(world.shape)[()]
        if self._late_actions is not None:
            self._late_actions.push(None if some is None else some[..., None], values)
            values = self._late_actions.get(each(world.parameters["action_delay"]))
        controller, rest = self.task.controller, self._rest
        try:
            for step in range(0, self._substeps, self._held):
                thrust = controller.thrust(values, self._seen())
                if self._landing is not None:
                    coming = self._landing.reshape(world.shape)[..., None]
                    down = self._lander.thrust(self._descent, self._seen())
                    thrust = self._xp.where(coming, down, thrust)
                if self._anyone_out:
                    thrust = self._xp.where(self.out.reshape(world.shape)[..., None], rest, thrust)
                world.step(thrust, self._held, some, again=step > 0)
        except PhysicsError:
            self._waiting = self._waiting | (~self._nobody if flown is None else flown)
            self._anyone_waits = True
            raise
        self._steps = self._steps + (1 if some is None else some)
        flying = self._everybody if some is None else some
        if self._sensors is not None:
            self._sensors.sample(flying)
        self.task.remember(world.state, flying)
        if self._landing is not None:
            self.retire(self._landing & world.state.touching.reshape(self.num_envs))

    def retire(self, drones: Array) -> None:
        """Take drones out of the running episode, bool, shape (N,).

        Their rotors stand still until the world begins anew. They get no reward and no flag.
        """
        if (some := self.ours(drones) & ~self.out).any():
            self._end(some)

    def land(self, drones: Array) -> None:
        """Bring drones down until they touch something, then retire them; bool, shape (N,).

        From the next step on their actions are ignored: they hold their place over the ground and
        sink at 0.7 m/s, as far as the vehicle can, by the level `velocity`. Raises `InputError`
        where the vehicle cannot be flown at that level.
        """
        if not hasattr(self, "_lander"):
            period, lag = self._held * self.vehicle.timestep, self.task.lag
            lander: Any = make_controller("velocity", self.vehicle, period, lag=lag)
            self._lander, fastest = lander, lander.ranges()[2][0]
            action = np.array([0.0, 0.0, -min(1.0, _DESCENT / fastest), 0.0])
            like = self.world.state.thrust
            self._descent = constant(action, like) + 0.0 * like[..., :1]
        some = self.ours(drones)
        if some.any():
            self._landing = some if self._landing is None else self._landing | some

    def _begin(self, mask: Array, seeds: Any, chosen: Mapping[str, np.ndarray]) -> None:
        """Begin the episodes of the drones of a mask, bool, shape (N,)."""
        world, lead = self.world, self.world.shape
        if not (self._begun or mask.all()):  # the first time a task wants all of them
            everybody = self._everybody
            self._reset(everybody, self._start(everybody, world.draw(everybody)))
        some = mask.reshape(lead)[()]
        if seeds is not None:
            world.seed(some, seeds if self._drones == 1 else seeds[:: self._drones])
            if self._sights is not None:
                self._sights.seed(mask, seeds)
        draws = {name: values.reshape(lead)[()] for name, values in chosen.items()}
        self._reset(some, self._start(some, world.draw(some, draws)))
        self._begun = True
        if self._late_actions is not None:  # on their way are actions that change nothing
            like = world.state.thrust
            neutral = np.full(self._width, float((self._choices - 1) // 2 if self._choices else 0))
            rest = constant(neutral, like) + 0.0 * like[..., :1]
            self._late_actions.begin(some[..., None], rest)
        self._steps = plain(self._xp.where(some, 0, self._steps))
        self._waiting = self._waiting & ~mask
        self._anyone_waits = bool(self._waiting.any())
        self.done, self.out = self.done & ~mask, self.out & ~mask
        if self._landing is not None:
            left = self._landing & ~mask
            self._landing = left if left.any() else None
        self._anyone_out = bool(self.out.any())

    def _reset(self, mask: Array, pose: Pose) -> None:
        self.world.reset(mask, pose)
        if self._sensors is not None:
            self._sensors.begin(mask)

    def _seen(self) -> WorldState:
        """The state that controller and observation see."""
        return self.world.state if self._sensors is None else self._sensors.seen()

    def _start(self, mask: Array, draw: Draw) -> Pose:
        """Starts of the drones of a mask. Raises `InputError` if a task gives another thing."""
        pose = self.task.begin(mask, draw)
        wanted = (*self.world.shape, 3)
        got = tuple(getattr(pose.position, "shape", ())) if isinstance(pose, Pose) else type(pose)
        if got != wanted:
            raise InputError(
                f"{self.spec.env_id}: expected begin() to return a Pose with a position of shape "
                f"{wanted}, got {got}"
            )
        return pose

    def _look(self, flown: Array | None, begun: Array | None = None) -> None:
        """Observations, rewards and ends after a step; `begun` as the mask of `_begin`."""
        task, state, n = self.task, self.world.state, self.num_envs
        self._telemetry = None
        observed, outcome = task.observe(self._seen()), task.outcome(state)
        if self._sensors is not None and isinstance(observed, Mapping):
            observed = {**observed, **self._sensors.readings}
            for name, limits in self._limits.items():
                low, high = (constant(end, observed[name]) for end in limits)
                observed[name] = clip(observed[name], low, high)
        if self._outcome is None:
            one = replace(self.spec, observation=_observed(task))
            _check_returned(one, observed, outcome, n, alone=not self.world.shape)
        self.observations = {}
        for name, shape, dtype in self._arrays:
            self.observations[name] = _as_type(observed[name].reshape(shape), dtype)
        if self._sights is not None:
            self.observations |= self._sights.look(state, self.steps, flown, begun)
        if self._late_observations:
            age = self._per_drone(self.world.parameters["observation_delay"])
            for name, past in self._keep(self._late_observations, flown, begun):
                ones = (n,) + (1,) * (self.observations[name].ndim - 1)
                self.observations[name] = past.get(age.reshape(ones))
        for name, past in self._keep(self._history, flown, begun):
            self.observations[name] = past.row()
        self._outcome, self.terms = outcome, outcome.reward
        ended: Array = outcome.terminated
        late = (self._steps >= self._length) > ended  # for truth values a > b is a and not b
        total: Array = 0.0
        for term in self.terms.values():
            total = total + term
        # New arrays, whatever the task gave: arrays of earlier steps must not change.
        if not self.world.shape:  # a single drone's numbers
            finite = isfinite(total)
            self.rewards = np.array((float(total),))
            # An array of truth values is fastest as a copy of another.
            self.terminated, self.truncated = self._nobody.copy(), self._nobody.copy()
            if may_end := bool(ended or late):
                self.terminated[0], self.truncated[0] = ended, late
        else:
            # A task may compute in float32.
            total = np.asarray(total, np.float64) if self._xp is np else total
            self.rewards = total.reshape(n)
            finite = self._xp is not np or _is_finite(self.rewards)
            self.terminated = (ended | self._none).reshape(n)
            self.truncated = late.reshape(n)
            may_end = True
        if self._xp is np and not (finite and all(map(_is_finite, self.observations.values()))):
            self._refuse_not_finite()
        if self._anyone_out:
            flown = ~self.out if flown is None else flown & ~self.out
        if flown is not None:
            # A drone that did not fly gets no reward: nothing has ended, nothing was won.
            self.rewards = self._xp.where(flown, self.rewards, 0.0)
            self.terminated, self.truncated = self.terminated & flown, self.truncated & flown
        if may_end:
            ends = self.terminated | self.truncated
            if ends.any():
                self._end(ends)

    def _end(self, ends: Array) -> None:
        """Take in the ends of episodes, bool, shape (N,)."""
        self.out = self.out | ends
        self.done = worlds_done(self.out, self._drones)
        self._anyone_out = self._drones > 1
        self._waiting = self._waiting | self.done
        self._anyone_waits = bool(self._waiting.any())

    def _check_together(self, *masks: Array | None) -> None:
        """Raise `InputError` for a mask that has some of a world's drones."""
        for mask in masks:
            if mask is not None:
                rows = mask.reshape(self.world.shape)
                right = bool((rows == rows[:, :1]).all())
                expect(right, "resets, frozen", f"all {self._drones} drones of a world or none",
                       "some of them")  # fmt: skip

    def _keep(
        self, past: dict[str, Delay], flown: Array | None, begun: Array | None
    ) -> Iterator[tuple[str, Delay]]:
        """Add the observations of now to those of the last steps; a reset's are all of now."""
        for name, kept in past.items():
            values = self.observations[name]
            ones = (self.num_envs,) + (1,) * (values.ndim - 1)
            if begun is not None:
                kept.begin(begun.reshape(ones), values)
            kept.push(None if flown is None else flown.reshape(ones), values)
            yield name, kept

    def _refuse_not_finite(self) -> None:
        """Raise `InputError` for the NaN or infinity that a task gave."""
        for name, values in (*self.observations.items(), ("reward", self.rewards)):
            bad = ~np.isfinite(values.reshape(self.num_envs, -1)).all(axis=1)
            if bad.any():
                raise InputError(
                    f"{self.spec.env_id}: expected finite numbers for {name}, got "
                    f"{values[bad][0].tolist()} for env {int(bad.argmax())}"
                )

    def _checked(self, actions: np.ndarray, flown: Array | None) -> np.ndarray:
        """Actions as controllers take them: float64, shape (W, A, k). Raises `InputError`."""
        if actions.dtype.kind not in "iuf":
            raise InputError(f"actions: expected real numbers, got {actions.dtype}")
        if actions.size != self.num_envs * self._width:
            shape = (self.num_envs, self._width)
            raise InputError(f"actions: expected shape {shape}, got {actions.shape}")
        values = actions.reshape(self._action_shape)
        if values.dtype != np.float32 and not self._choices:
            with np.errstate(over="ignore"):  # an overflow is infinite, and refused as such
                values = values.astype(np.float32)
        if not self._choices and _is_finite(values):
            return values.astype(np.float64)
        right, expected = np.isfinite(values), "finite numbers"
        if self._choices:
            right = (values >= 0) & (values < self._choices) & (values % 1 == 0)
            expected = f"a whole number 0 to {self._choices - 1}"
        wrong = ~right.reshape(self.num_envs, -1).all(axis=1)
        if wrong.any():
            if (refused := wrong if flown is None else wrong & flown).any():
                first = int(refused.argmax())
                got = values.reshape(self.num_envs, -1)[first].tolist()
                raise InputError(f"actions: expected {expected}, got {got} for env {first}")
            values = np.where(wrong.reshape(*self.world.shape, 1), values.dtype.type(0), values)
        return values.astype(np.float64)

    @property
    def steps(self) -> Array:
        """Control steps of each running episode, shape (N,)."""
        return self._per_drone(self._steps)

    @property
    def reward_terms(self) -> dict[str, Array]:
        """Terms of the last rewards by name, each of shape (N,)."""
        return {name: self._per_drone(term) for name, term in self.terms.items()}

    @property
    def metrics(self) -> dict[str, Array]:
        """Metrics of the task by name, each of shape (N,)."""
        metrics = self._outcome.metrics if self._outcome else {}
        return {name: self._per_drone(value) for name, value in metrics.items()}

    @property
    def telemetry(self) -> dict[str, np.ndarray]:
        """By the names of `spec.telemetry`, float64, shape (N, *shape), in the paper's frame."""
        if self._telemetry is None:
            if self.world.shape:
                self._telemetry = self._tell()
            else:
                told = np.array((self.row(),))
                self._telemetry = {name: told[:, at] for name, at in self._columns.items()}
        return self._telemetry

    def _tell(self) -> dict[str, np.ndarray]:
        state, n = self.world.state, self.num_envs
        told = {
            "position": positions_in_paper_frame(on_host(state.position).reshape(n, 3)),
            "attitude": attitudes_in_paper_frame(on_host(state.quaternion).reshape(n, 4)),
            "thrust": on_host(state.thrust).reshape(n, -1).astype(np.float64),
        }
        if self._drawn:
            columns = [on_host(self.world.parameters[name]) for name in self._drawn]
            told["drawn"] = np.stack(columns, axis=-1, dtype=np.float64).reshape(n, -1)
        if state.payload is not None:
            payload = on_host(state.payload).reshape(n, 3)
            told["payload"] = positions_in_paper_frame(payload)
        if self._has_goal:
            goal = on_host(self.task.goal(state))
            told["goal"] = positions_in_paper_frame(goal.reshape(n, 3))
        if metrics := self.metrics:
            columns = [on_host(metrics[metric.name]) for metric in self.task.metrics]
            told["metrics"] = np.stack(columns, axis=1, dtype=np.float64)
        return told

    def row(self) -> list[float]:
        """The telemetry of a single drone in a row, in a third of the time."""
        state = self.world.state
        x, y, z = state.position.tolist()
        level = not any(state.quaternion.tolist()[1:])
        angles = (0.0, 0.0, 0.0) if level else attitudes_in_paper_frame(state.quaternion).tolist()
        row = [0.0 - y, z, x, *angles, *state.thrust.tolist()]
        for name in self._drawn:
            row.append(float(self.world.parameters[name]))
        if state.payload is not None:
            x, y, z = state.payload.tolist()
            row += (0.0 - y, z, x)
        if self._has_goal:
            x, y, z = self.task.goal(state).tolist()
            row += (0.0 - y, z, x)
        if self._outcome is not None:
            for metric in self.task.metrics:
                row.append(float(self._outcome.metrics[metric.name]))
        return row

    def detach(self) -> None:
        """End the graph of gradients, on the backend `rigid`, at the present state."""
        world: Any = self.world
        world.detach()
        for name, value in vars(self.task).items():
            if getattr(value, "requires_grad", False):
                setattr(self.task, name, value.detach())
        actions = () if self._late_actions is None else (self._late_actions,)
        for past in (*actions, *self._late_observations.values(), *self._history.values()):
            past.detach()
        self.observations = {name: x.detach() for name, x in self.observations.items()}
        self.rewards = self.rewards.detach()

    def close(self) -> None:
        """Release threads and memory; what the last step gave can be read on."""
        self.world.close()
        if self._sights is not None:
            self._sights.close()
        self._closed = self._anyone_waits = True

    def ours(self, mask: Array) -> Array:
        """A mask that the caller gave, NumPy's or a tensor, as an array of the world's kind."""
        kind = getattr(mask, "dtype", None)
        right = kind == np.bool_ or str(kind) == "torch.bool"
        if not right or tuple(mask.shape) != (self.num_envs,):
            expected = f"bool of shape ({self.num_envs},)"
            raise InputError(f"resets, frozen: expected {expected}, got {mask!r:.80}")
        if self._xp is np:
            return mask
        if isinstance(mask, np.ndarray):
            mask = np.require(mask, requirements="W")  # that of a datagram is read-only
        return self._xp.asarray(mask, device=self._nobody.device)

    def _per_drone(self, values: Array) -> Array:
        if not self.world.shape:
            return np.array((values,))
        if not getattr(values, "shape", ()):  # one number for all drones
            values = values + 0.0 * self._nobody
        return _as_type(values.reshape(self.num_envs), values.dtype)


class OnHost:
    """A loop whose results are NumPy arrays, wherever its world runs, for simulators."""

    def __init__(self, loop: Loop) -> None:
        self.loop, self.spec, self.num_envs = loop, loop.spec, loop.num_envs
        self.close = loop.close
        self._take()

    def advance(self, *command: Any, **named: Any) -> None:
        """As `Loop.advance`."""
        self.loop.advance(*command, **named)
        self._take()

    def retire(self, drones: np.ndarray) -> None:
        """As `Loop.retire`."""
        self.loop.retire(drones)
        self._take()

    def land(self, drones: np.ndarray) -> None:
        """As `Loop.land`."""
        self.loop.land(drones)

    def _take(self) -> None:
        loop = self.loop
        self.observations = {  # copies already, of the declared types
            name: np.ascontiguousarray(values.detach().cpu().numpy())
            for name, values in loop.observations.items()
        }
        self.rewards = on_host(loop.rewards)
        self.terminated, self.truncated = on_host(loop.terminated), on_host(loop.truncated)
        self.done, self.out = on_host(loop.done), on_host(loop.out)

    @property
    def telemetry(self) -> dict[str, np.ndarray]:
        """As of `Loop`."""
        return self.loop.telemetry


def _is_finite(values: np.ndarray) -> bool:
    # Else one is NaN or infinite, or they add up to too much.
    if values.size <= _SMALL and isfinite(sum(values.ravel().tolist())):
        return True
    return values.dtype.kind != "f" or bool(np.isfinite(values).all())


def _as_type(values: Array, dtype: Any) -> Array:
    """A copy of that type."""
    return values.astype(dtype) if isinstance(values, np.ndarray) else values.to(dtype, copy=True)

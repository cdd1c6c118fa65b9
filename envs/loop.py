"""The loop that joins a vehicle, a world and a task; every env and simulator runs it.

It is a list of stages. An agent's command resets some drones, freezes some, and flies the others
for one control period: `advance` is that step, the step of the wire.
"""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from ..models.errors import InputError
from ..sim import Array, PhysicsError, Randomization, World, make_world
from ..sim.sensors import Sensors
from ..sim.snapshots import Arrays, joined, part_of
from .autoreset import Seeds, checked_seeds
from .config import EnvConfig
from .specification import make_task, observed, spec_of
from .stages import clock
from .stages.actions import ActionDelay, Actions, Receive
from .stages.delays import ObservationDelay
from .stages.ends import Ends
from .stages.flight import Control, Flight, StandStill
from .stages.history import History
from .stages.judge import Judge, Remember, Starts
from .stages.landing import Landed, Landing
from .stages.measure import Measure
from .stages.pictures import Pictures
from .stages.radio import Radio
from .stages.record import Mask, Record, Stage
from .stages.sensing import Readings, Sensing
from .tasks.task import Task
from .telemetry import quantities_of


class Stages:
    """The list of a loop's stages, in its order; a feature that is off is not in it.

    A step has four regions: the clock, for all drones; flight, for those that fly; begin, for those
    whose episode begins; and from `Measure` on for both, together.

    Attributes:
        actions: Checks what an agent sends.
        all: In the order in which an episode begins.
        fly: Steps of the drones that fly.
        begin: What all of them do when an episode begins.
        observe: Steps from `Measure` on.
        kept: Names of the record that keep their values between steps.
        measure: The first of those.
        pictures: Their specs.
        cameras, sensors: None where there are none.
    """

    def __init__(
        self,
        env_id: str,
        task: Task,
        world: World,
        shape: tuple[int, int],
        randomize: Randomization | None,
    ) -> None:
        drawn = () if randomize is None else randomize.names
        config = task.config
        controller = task.controller
        vehicle = task.vehicle
        self._task = task
        self._world = world
        self._look = lambda: world.state
        self.sensors: Sensors | None = None
        sensing, readings = self._sensors()
        self.actions = Actions(world.shape, len(controller.low), controller.choices)
        self._flying: list[Stage] = [Receive(self.actions.neutral())]
        if randomize is not None and "action_delay" in drawn:
            longest = randomize.most_steps("action_delay")
            self._flying.append(ActionDelay(world, longest, self.actions.neutral()))
        substeps = vehicle.substeps(task.control_period)
        # An estimate is computed once in a control step, and so is a thrust that follows from it.
        often = getattr(controller, "every_step", False) and not config.estimated
        self._held = 1 if often else substeps
        parts: list[Stage] = [Control(controller, self._look)]
        if shape[1] > 1:
            parts.append(StandStill(world))
        self._flight = Flight(world, parts, substeps, self._held)
        self._flying += [self._flight, clock.Clock()]
        judge = Judge(env_id, task)
        self.measure = measure = Measure(world, task.control_period)
        radio: list[Stage] = []
        if task.has_radio:
            radio.append(Radio(task.options, task.control_period, shape[1], task.ended))
        self._observing = [measure, *sensing, Remember(task), *radio, judge, *readings]
        pictures = [Pictures(task, world.random, shape)] if config.cameras else []
        self._observing += pictures
        self.cameras = pictures[0] if pictures else None
        self.pictures = pictures[0].specs if pictures else ()
        if randomize is not None and "observation_delay" in drawn:
            longest = randomize.most_steps("observation_delay")
            self._observing.append(ObservationDelay(world, longest))
        if config.history > 1:
            names = tuple(array.name for array in observed(task))
            self._observing.append(History(config.history, names, len(world.shape)))
        self._ends = Ends(env_id, world.shape, task.episode_length)
        self._observing.append(self._ends)
        self._starts = Starts(env_id, task, world)
        self._collect()

    def _sensors(self) -> tuple[list[Stage], list[Stage]]:
        """Stages that sample sensors and that add their readings to the observation."""
        config = self._task.config
        if not config.sensors:
            return [], []
        self.sensors = sensors = Sensors(config.sensors, self._world, self._task.control_period)
        estimated = config.estimated
        if estimated:
            self._look = sensors.seen
        bounded = observed(self._task) if estimated else ()
        return [Sensing(sensors, replaces=estimated)], [Readings(sensors, bounded)]

    def _collect(self) -> None:
        self.all = [self._starts, *self._flying, *self._observing]
        self.fly = [stage.step for stage in self._flying]
        self.begin = [stage.begin for stage in self.all]
        self.observe = [stage.step for stage in self._observing]
        self.kept = tuple(name for stage in self.all for name in stage.arrays)

    def land(self) -> Landed:
        """Add the stages with which drones land by themselves."""
        for stage in self._observing:
            if isinstance(stage, Landed):
                return stage
        period = self._held * self._world.vehicle.timestep
        landing = Landing(self._world, self._look, period, self._task.config.effects)
        self._flight.parts.insert(1, landing)
        landed = Landed()
        self._observing.insert(self._observing.index(self._ends), landed)
        self._collect()
        return landed


class Loop:
    """N drones of one env, each in a world of its own, or so many together.

    Drones of one world begin together. One whose episode ends before those of the others is *out*:
    its rotors stand still, it gets no reward and no second end, and the others fly on. The world is
    done when all are out. Masks and seeds have an element for each drone, and those of one world
    are alike; its first one's seed counts.

    Args:
        config: What is flown.
        num_worlds: W.

    Attributes:
        config: As given, resolved.
        task, world: Their arrays have the leading axes of the world; all others here have one axis
            of N drones, world by world, and are new after each `advance`.
        observations: By name, shape (N, *shape), of the declared dtypes.
        rewards: float64, shape (N,); 0 for a drone that did not fly.
        terminated, truncated: bool, shape (N,).
        done: bool, shape (N,): the world's episode has ended and the next has not begun.
        out: bool, shape (N,): its own has ended.

    Raises:
        InputError: An argument, seed or action is not what it should be; nothing has changed, but
            for a start that the task refuses: see `advance`.
        PhysicsError: A state is bad; reset the drones that flew.
        gymnasium.error.ResetNeeded: An action came before an episode's beginning or after its end.
        gymnasium.error.ClosedEnvironmentError: A step or a reset after `close`.
    """

    def __init__(self, config: EnvConfig, num_worlds: int = 1) -> None:
        self.config = config = config.resolve()
        backend = config.backend
        shape = (num_worlds, config.drones)
        alone = shape == (1, 1) and backend.name == "mujoco"
        self.task: Task = make_task(config, () if alone else shape)
        self.num_envs = num_worlds * config.drones
        self.vehicle = self.task.vehicle
        flown = self.task.config
        randomize = Randomization(flown.randomize, flown.effects) if flown.randomize else None
        self.world: World = make_world(
            self.vehicle,
            num_worlds,
            backend.name,
            drones=config.drones,
            effects=flown.effects,
            randomize=randomize,
            **backend.settings,
        )
        self.stages = Stages(config.env_id, self.task, self.world, shape, randomize)
        self.spec = spec_of(config, self.task, self.stages.pictures)
        self.record: Record = Record(self.world.shape, self.task.memory)
        self.record.kept = self.stages.kept
        self._quantities = quantities_of(self.task)
        self._arrays = [
            (array.name, (self.num_envs, *array.shape), np.dtype(array.dtype))
            for array in self.spec.observation
        ]
        self._telemetry: dict[str, NDArray[np.float64]] | None = None
        self._has_begun = self._closed = False
        self.observations: dict[str, NDArray[Any]] = {}
        self._take_results()

    def advance(
        self,
        actions: Array,
        resets: Array | None = None,
        seeds: Seeds | None = None,
        frozen: Array | None = None,
        chosen: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """Reset some drones, freeze some, and fly the others for one control period.

        As `AdvancingVectorEnv.advance`; `chosen` has what replaces a draw, by the names of
        `Task.reset_options`, shape (N,). Where the task refuses such a start, the others have
        flown, those to be reset are where they were, and their random numbers have moved on.
        """
        self._check_open()
        record = self.record
        stages = self.stages
        clock.take(record, resets, frozen)
        flies = record.flown is None or bool(record.flown.any())
        if record.begun is not None:
            seeds = checked_seeds(seeds, self.num_envs)
        if flies:
            record.sent = stages.actions.checked(actions, record.flown)
        record.rest()
        if flies:
            try:
                record.run(record.flown, stages.fly)
            except PhysicsError:
                record.lose()
                raise
        if record.begun is not None:
            self._begin(record.begun, seeds, chosen or {})
        self._observe()
        self._take_results()

    def _begin(self, begun: Mask, seeds: Any, chosen: Mapping[str, np.ndarray]) -> None:
        """Begin episodes: the task sets the start, and the other stages follow from it."""
        record = self.record
        stages = self.stages
        everybody = bool(begun.all())
        record.chosen = {}
        if not (self._has_begun or everybody):  # the first time all of them
            record.begun = begun | True
            record.run(None, stages.begin)
            record.begun = begun
            record.waiting = begun | True
        if seeds is not None:
            for stage in stages.all:
                stage.seed(begun, seeds[:: len(self.spec.agents)])
        lead = record.shape
        record.chosen = {name: values.reshape(lead)[()] for name, values in chosen.items()}
        record.run(None if everybody else begun, stages.begin)
        record.count()
        self._has_begun = True

    def _observe(self) -> None:
        """Drones that flew, and those that begin, are measured, judged and observed."""
        record = self.record
        active = record.flown
        if active is not None and record.begun is not None:
            active = active | record.begun
        if active is not None and active.all():
            active = None
        if active is None or active.any():
            record.run(active, self.stages.observe)

    def _take_results(self) -> None:
        """New arrays of N drones, of the declared dtypes."""
        record = self.record
        count = (self.num_envs,)
        self._telemetry = None
        observations = vars(record).get("observations")
        self.observations = {}
        for name, shape, dtype in self._arrays:
            if observations is None:
                self.observations[name] = np.zeros(shape, dtype)
            else:
                self.observations[name] = np.array(observations[name], dtype).reshape(shape)
        self.rewards = np.array(record.reward).reshape(count)
        self.terminated = np.array(record.terminated).reshape(count)
        self.truncated = np.array(record.truncated).reshape(count)
        self.done = np.array(record.done).reshape(count)
        self.out = np.array(record.out).reshape(count)

    def retire(self, drones: Array) -> None:
        """Take drones out of the running episode, bool, shape (N,).

        Their rotors stand still. They get no reward and no flag.
        """
        leaving = clock.drones_of(self.record, drones) & ~self.record.out
        if leaving.any():
            self.record.end(leaving)
            self.done = np.array(self.record.done).reshape(self.num_envs)
            self.out = np.array(self.record.out).reshape(self.num_envs)

    def land(self, drones: Array) -> None:
        """Bring drones down until they touch something, then retire them; bool, shape (N,).

        From the next step on their actions are ignored. Raises `InputError` where the vehicle
        cannot be flown at the level `velocity`.
        """
        landed = self.stages.land()
        landed.prepare(self.record, clock.drones_of(self.record, drones))
        self.record.kept = self.stages.kept

    @property
    def steps(self) -> NDArray[np.int64]:
        """Control steps of each running episode, shape (N,)."""
        return np.array(self.record.steps).reshape(self.num_envs)

    @property
    def terms(self) -> Mapping[str, Array]:
        """Terms of the last rewards by name, with the leading axes of the world."""
        return self.record.terms

    @property
    def reward_terms(self) -> dict[str, NDArray[np.float64]]:
        """Terms of the last rewards by name, each of shape (N,)."""
        return {name: self._per_drone(term) for name, term in self.record.terms.items()}

    @property
    def metrics(self) -> dict[str, NDArray[np.float64]]:
        """Metrics of the task by name, each of shape (N,)."""
        return {name: self._per_drone(value) for name, value in self.record.metrics.items()}

    @property
    def telemetry(self) -> dict[str, NDArray[np.float64]]:
        """By the names of `spec.telemetry`, float64, shape (N, *shape)."""
        if self._telemetry is None:
            self._telemetry = {
                quantity.spec.name: quantity.values(self) for quantity in self._quantities
            }
        return self._telemetry

    def row(self) -> list[float]:
        """The telemetry of a single drone in a row."""
        row: list[float] = []
        for quantity in self._quantities:
            row += quantity.read(self).ravel().tolist()
        return row

    def snapshot(self) -> dict[str, NDArray[Any]]:
        """Copies of all arrays that a later step depends on, by name.

        Raises `gymnasium.error.ClosedEnvironmentError` after `close`.
        """
        self._check_open()
        stages = self.stages
        parts: dict[str, Arrays] = {
            "world": self.world.snapshot(),
            "record": self.record.snapshot(),
            "loop": {"has_begun": np.array(self._has_begun)},
        }
        if stages.sensors is not None:
            parts["sensors"] = stages.sensors.snapshot()
        if stages.cameras is not None:
            parts["cameras"] = stages.cameras.snapshot(self.record)
        return joined(parts)

    def restore(self, snapshot: Arrays) -> None:
        """Put back a snapshot of a loop of the same config and size; no step runs.

        No later bit differs from those that followed it.

        Raises:
            InputError: It is of another number of drones; nothing has changed.
            gymnasium.error.ClosedEnvironmentError: The loop is closed.
        """
        self._check_open()
        record = self.record
        stages = self.stages
        kept = part_of(snapshot, "record")
        shape = getattr(kept.get("kept/steps"), "shape", None)
        if shape != record.shape:
            raise InputError(f"snapshot: expected one of drones {record.shape}, got {shape}")
        if "kept/landing" in kept:
            stages.land()
            record.kept = stages.kept
        self.world.restore(part_of(snapshot, "world"))
        if stages.sensors is not None:
            stages.sensors.restore(part_of(snapshot, "sensors"))
        record.restore(kept)
        if "landing" in record.kept and "kept/landing" not in kept:
            record.landing = np.zeros(record.shape, bool)[()]
        if stages.cameras is not None:
            stages.cameras.restore(part_of(snapshot, "cameras"))
        self._has_begun = bool(snapshot["loop/has_begun"])
        if self._has_begun:
            stages.measure.step(record)
        self._take_results()

    def __reduce__(self) -> Any:
        worlds = self.num_envs // self.config.drones
        return type(self), (self.config, worlds), self.snapshot()

    def __setstate__(self, snapshot: Arrays) -> None:
        self.restore(snapshot)

    def close(self) -> None:
        """Release threads and memory; what the last step gave can be read on."""
        for stage in self.stages.all:
            stage.close()
        self._closed = True

    def _check_open(self) -> None:
        if self._closed:
            raise gym.error.ClosedEnvironmentError("expected an open env, got a closed one")

    def _per_drone(self, values: Array) -> NDArray[np.float64]:
        if not np.ndim(values):  # one number for all drones
            return np.full(self.num_envs, values, np.float64)
        return np.array(values).reshape(self.num_envs)

"""The loop that joins a vehicle, a world and a task; every env and simulator runs it.

It runs a list of stages. An agent's command resets some drones, freezes some, and flies the others
for one control period: `advance` is that step, the step of the wire.
"""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from ..models.errors import InputError
from ..sim import Array, PhysicsError, World, make_world
from ..sim.sensors.instruments import Moment
from ..sim.snapshots import Arrays, Snapshot, joined, part_of
from ..sim.state import ByName, found, is_traced, some
from .autoreset import Seed, Seeds, Told, checked_seeds, stacked
from .config import EnvConfig
from .events import BALL, balls_of
from .pipeline import Pipeline
from .specification import instruments_of, make_task, spec_of
from .stages import clock
from .stages.record import Floats, Mask, Record
from .tasks.task import Task
from .telemetry import quantities_of, telemetry_of

_READINGS = "readings"


class Loop:
    """N drones of one env, each in its own world, or `config.drones` in each world.

    Drones of one world begin together. One whose episode ends before those of the others is *out*:
    its rotors stand still, it gets no reward and no second end, and the others fly on. The world is
    done when all are out. Masks are alike within a world; the seed of its first drone counts.

    Args:
        config: What is flown.
        num_worlds: W.

    Attributes:
        config: As given, resolved.
        pipeline: Its stages.
        instruments: What measures after each step.
        measures: Whether they do.
        arrays: Of the observation, those of the stages.
        quantities: Of the telemetry.
        num_envs: N. Arrays below have one axis of N drones, world by world, and are new after each
            `advance`; those of record, world and task have the axes of `world.shape`.
        observations: By name, shape (N, *shape), of the declared dtypes.
        rewards: float64, shape (N,); 0 for a drone that did not fly.
        terminated, truncated: bool, shape (N,).
        done: bool, shape (N,): the world's episode has ended and the next has not begun.
        out: bool, shape (N,): its own has ended.
        headline: The metric that decides, float64, shape (N,); NaN where the task has none.

    Raises:
        InputError: An argument, seed or action is wrong; nothing has changed but as of `advance`.
        PhysicsError: A state is bad; reset the drones that flew.
        gymnasium.error.ResetNeeded: An action came before an episode's beginning or after its end.
        gymnasium.error.ClosedEnvironmentError: A step or a reset after `close`.
    """

    def __init__(self, config: EnvConfig, num_worlds: int = 1) -> None:
        self.config = config = config.resolve()
        backend = config.backend
        shape = (num_worlds, config.drones)
        self._task = task = make_task(config, shape)
        self.vehicle = task.vehicle
        flown = task.config
        self._world = world = make_world(
            self.vehicle,
            num_worlds,
            backend.name,
            drones=config.drones,
            effects=flown.effects,
            randomize=flown.drawn,
            scene=flown.scene,
            thrown=balls_of(flown.events),
            **backend.settings,
        )
        self.pipeline = pipeline = Pipeline(task, world)
        self.spec = spec_of(config, task)
        self.instruments = instruments_of(task)
        self.measures = bool(self.instruments)
        later = {name for instrument in self.instruments for name in instrument.every}
        self.arrays = [array for array in self.spec.observation if array.name not in later]
        kept = tuple(name for stage in pipeline.stages for name in stage.arrays)
        self._record = Record(world.shape, task.memory, kept)
        self.num_envs = num_worlds * config.drones
        self.quantities = quantities_of(task)
        self._throws = [event["kind"] == BALL for event in flown.events]
        self._closed = False
        self._told: Told | None = None  # None: record, world and task are asked instead
        self.observations: ByName
        self._take()

    def prepare(self) -> None:
        """Do now what the first step would do once."""

    def advance(
        self,
        actions: Array,
        resets: Array | None = None,
        seeds: Seed = None,
        frozen: Array | None = None,
        asks: Array | None = None,
    ) -> None:
        """Reset some drones, freeze some, and fly the others for one control period.

        As `AdvancingVectorEnv.advance`. If the task refuses a start, the others have flown. The
        drones to be reset have not moved, and their random numbers have been drawn.
        """
        self._check_open()
        record = self._record
        clock.take(record, resets, frozen)
        flies = some(record.flown)
        wanted = None if record.begun is None else checked_seeds(seeds, self.num_envs)
        if wanted is not None:
            wanted = wanted[:: self.config.drones]  # of worlds
        if flies:
            record.sent = self.pipeline.actions.checked(actions, record.flown)
            if self.spec.asks:
                record.asked = self._asked(asks)
        self._step(wanted, flies=flies)

    def _asked(self, asks: Array | None) -> Mask:
        """Which events happen by request, (W, A, E)."""
        bits = np.uint64(1) << np.arange(len(self.spec.asks), dtype=np.uint64)
        numbers = np.zeros(self.num_envs, np.uint64) if asks is None else asks
        return (numbers[:, None] & bits > 0).reshape(*self._record.shape, -1)

    def _step(self, seeds: Seeds | None, *, flies: bool) -> None:
        """Run the regions for the masks of the record."""
        record = self._record
        pipeline = self.pipeline
        record.rest()
        if flies:
            steps = record.steps + (1 if record.flown is None else record.flown)
            self._move_solids(steps, vars(record).get("fired"))
            try:
                record.run(record.flown, pipeline.fly)
            except PhysicsError:
                record.wait(record.flown)
                raise
        if record.begun is not None:
            self._begin(record.begun, seeds)
        active = record.active
        if some(active):
            record.run(active, pipeline.observe)
        if record.begun is not None:
            self._refuse_stuck()
        self._take()
        self._measure()

    def stuck(self) -> Array:
        """Drones whose start touches a solid that no seed has drawn, bool, (W, A)."""
        record = self._record
        scenery = self._world.scenery
        if scenery.scene.is_seeded:
            return np.zeros_like(record.unfit)
        position = record.state.position
        radius = self.vehicle.radius
        starts = record.state.touching & (record.steps == 0) & ~record.waiting
        if scenery.hidden:
            return starts & (position[..., 2] > radius)
        return starts & (scenery.distance(position, starts) < radius)

    def _refuse_stuck(self) -> None:
        """Raise `InputError` for a start as of `stuck`; its world must be reset again."""
        stuck = self.stuck()
        if found(stuck):
            self._record.wait(stuck.any(axis=1, keepdims=True))
            place = self._record.state.position[stuck][0].astype(float)
            name = self._world.scenery.touched(place, self.vehicle.radius)
            raise InputError(
                f"start: expected one that touches nothing, got {place.round(3).tolist()}, which "
                f"touches {name}: move one of them"
            )

    def _move_solids(self, steps: Array, fired: Array | None) -> None:
        """Move solids to their places after so many control steps of each episode, (W, A); what is
        thrown has hung in the air until its event, (W, A, E).
        """
        scenery = self._world.scenery
        period = self._task.control_period
        if scenery.moves:
            starts = None
            if fired is not None:
                starts = period * fired[..., self._throws].min(axis=1)
            scenery.move(steps >= 0, period * steps[:, 0], starts)

    def _begin(self, begun: Mask, seeds: Seeds | None) -> None:
        """Begin episodes: the task sets the start, and the other stages follow from it."""
        record = self._record
        begin = self.pipeline.begin
        all_begin = bool(begun.all())
        if not record.has_begun and not all_begin:
            record.begin_all(begin)
        if seeds is not None:
            self._world.random.seed(begun, seeds)
        record.run(None if all_begin else begun, begin)

    def _measure(self) -> None:
        """Let instruments measure, and observe what they read."""
        if not self.measures:
            return
        record = self._record
        everybody = np.ones(record.shape, bool)
        seen = self._moment()
        moment = Moment(
            begun=~everybody if record.begun is None else record.begun,
            flown=everybody if record.flown is None else record.flown,
            scenery=self._world.scenery,
            **seen,
        )
        for instrument in self.instruments:
            instrument.measure(moment)
        self._observe(moment.late)

    def _moment(self) -> ByName:
        """What instruments see, by the names of `Moment`."""
        random = self._world.random
        return {"keys": random.keys, "episode": random.episode, **self.sight()}

    def sight(self) -> ByName:
        """What they see that a step changes."""
        record = self._record
        state = record.state
        names = ("position", "quaternion", "payload")
        seen = {"late": self._late(), "steps": record.steps}
        seen |= {name: getattr(state, name) for name in names}
        if any(mark.moves for mark in self._task.marks):
            seen["goal"] = self._task.goal(state)
        return {name: values for name, values in seen.items() if values is not None}

    def _late(self) -> Array:
        return self._world.parameters.get("observation_delay", 0 * self._record.steps)

    def _observe(self, late: Array) -> None:
        """Add what instruments read to the observations, in the order of the spec."""
        seen = self.observations
        for instrument in self.instruments:
            for name, values in instrument.observed(late).items():
                seen[name] = np.array(values).reshape(-1, *values.shape[2:])
        self.observations = {array.name: seen[array.name] for array in self.spec.observation}

    def snapshot(self) -> Snapshot:
        """Copies of all arrays that a later step depends on, by name.

        Raises `gymnasium.error.ClosedEnvironmentError` after `close`.
        """
        self._check_open()
        arrays = self.state()
        for instrument in self.instruments:
            arrays |= joined({_READINGS: instrument.snapshot()})
        arrays["loop/config"] = np.array(self.spec.config_digest)
        return {**arrays, "loop/arrays": np.array(sorted(arrays))}

    def state(self) -> Snapshot:
        """The arrays of a snapshot, without what tells it from others."""
        record = self._record
        parts: dict[str, Arrays] = {"record": record.snapshot()}
        for stage in self.pipeline.stages:
            parts[type(stage).__name__] = stage.snapshot()
        return joined(parts)

    def restore(self, snapshot: Arrays) -> None:
        """Put back a snapshot of a loop of the same config and size; no step runs.

        Later steps give the same bits as after the snapshot.

        Raises:
            InputError: It is of another config or number of drones, or lacks an array; nothing has
                changed.
            gymnasium.error.ClosedEnvironmentError: The loop is closed.
        """
        self._check_open()
        _check_snapshot(snapshot, self._record.shape, self.spec.config_digest)
        self.put(snapshot)
        self._take()
        for instrument in self.instruments:
            instrument.restore(part_of(snapshot, _READINGS))
        self._observe(self._late())

    def put(self, state: Arrays) -> None:
        """Put back what `state` gave."""
        record = self._record
        record.restore(part_of(state, "record"))
        for stage in self.pipeline.stages:
            stage.restore(record, part_of(state, type(stage).__name__))
            if stage is self.pipeline.flight and not is_traced(record.steps):
                # before what measures distances
                self._move_solids(record.steps, vars(record).get("fired"))

    def __reduce__(self) -> Any:
        return type(self), (self.config, self._record.shape[0]), self.snapshot()

    __setstate__ = restore

    def _take(self) -> None:
        """New arrays of N drones, of the declared dtypes."""
        record = self._record
        count = self.num_envs
        self._told = None
        self.headline: Floats = np.array(self.headline_now(), np.float64).reshape(count)
        known = vars(record).get("observations", {})
        self.observations = {}
        for array in self.arrays if known else self.spec.observation:
            nothing = np.zeros((*record.shape, *array.shape))  # before an episode
            values = np.array(known.get(array.name, nothing), array.dtype)
            self.observations[array.name] = values.reshape(count, *array.shape)
        self.rewards = np.array(record.reward).reshape(count)
        self.terminated = np.array(record.terminated).reshape(count)
        self.truncated = np.array(record.truncated).reshape(count)
        self.done = np.array(record.done).reshape(count)
        self.out = np.array(record.out).reshape(count)

    @property
    def record(self) -> Record:
        """What the stages share."""
        self._settle()
        return self._record

    @property
    def world(self) -> World:
        """What flies."""
        self._settle()
        return self._world

    @property
    def task(self) -> Task:
        """The task, with its memory."""
        self._settle()
        return self._task

    def _settle(self) -> None:
        """See to it that record, world and task have the state, and the next step begins there."""

    @property
    def steps(self) -> NDArray[np.int64]:
        """Control steps of each running episode, shape (N,)."""
        return np.array(self.record.steps).reshape(self.num_envs)

    @property
    def metrics(self) -> dict[str, Floats]:
        """Metrics of the task by name, each of shape (N,)."""
        return _per_drone(self._begun().metrics, self.num_envs)

    def headline_now(self) -> Array:
        """The metric that decides, (W, A), as the record has it."""
        record = self._record
        metric = self.spec.headline
        if metric is None or not record.has_begun:
            return np.nan + record.reward
        return record.metrics[metric.name]

    @property
    def telemetry(self) -> Mapping[str, Floats]:
        """By the names of `spec.telemetry`, float64, shape (N, *shape)."""
        return self.told()()[0]

    def told(self) -> Told:
        """Telemetry and terms of the reward as they are now, for later."""
        if self._told is None:
            count = self.num_envs
            terms = _per_drone(self._begun().terms, count)
            self._told = Told(stacked, (_per_drone(telemetry_of(self), count, -1), terms))
        return self._told

    def _begun(self) -> Record:
        """The record. Raises `ResetNeeded` before the first episode."""
        record = self.record
        if not record.has_begun:
            raise gym.error.ResetNeeded("telemetry: expected a call of reset() first")
        return record

    def close(self) -> None:
        """Release threads and memory; what the last step gave can be read on."""
        self._settle()
        self._world.close()
        for instrument in self.instruments:
            instrument.close()
        self._closed = True

    def _check_open(self) -> None:
        if self._closed:
            raise gym.error.ClosedEnvironmentError("expected an open env, got a closed one")


def _check_snapshot(snapshot: Arrays, shape: tuple[int, ...], config: str) -> None:
    """Raise `InputError` for a snapshot of other drones, of another config, or without an array."""
    given = getattr(snapshot.get("record/kept/steps"), "shape", None)
    if given != shape:
        raise InputError(f"snapshot: expected one of drones {shape}, got {given}")
    digest = snapshot.get("loop/config")
    if digest != config:
        raise InputError(f"snapshot: expected one of config {config}, got one of {digest}")
    names = snapshot.get("loop/arrays", np.array(["loop/arrays"])).tolist()
    missing = [name for name in names if name not in snapshot]
    if missing:
        raise InputError(f"snapshot: expected all of its arrays, got none of {missing[0]}")


def _per_drone(arrays: Mapping[str, Array], *shape: int) -> dict[str, Floats]:
    """New arrays of N drones, float64, of another shape."""
    return {name: np.array(x, np.float64).reshape(shape) for name, x in arrays.items()}

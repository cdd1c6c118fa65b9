"""Poses of the cameras of a data set: on flights, in journals, at random places.

A plan is a TOML file; `docs/capture.md` has its fields. It gives the same poses on every machine:
random places come from its seed, flights from the seeds of the evaluation episodes.
"""

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import cycle, groupby, pairwise
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..agents import CONTROLLERS
from ..agents.checkpoints import Checkpoint, load
from ..agents.policies import Policy
from ..envs.config import EnvConfig, words_of
from ..envs.registry import env_spec
from ..envs.registry import load as load_env
from ..envs.spec import Mark
from ..models.cameras import View, chosen_views
from ..models.errors import InputError, shortened
from ..models.fields import (
    Choice,
    Limits,
    NonNegativeInt,
    PositiveInt,
    Text,
    check,
    check_fields,
    check_names,
    read_table,
)
from ..models.files import read_toml
from ..models.vehicle import Vehicle
from ..scenes import scenes_of
from ..sim.rotations import multiplied
from .recorded import recorded_trajectories
from .trajectories import Trajectory, flown_trajectories

Floats = NDArray[np.float64]

MAX_FRAMES = 1_000_000
_FARTHEST = 1e4  # m

_Count = Annotated[int, Limits(1, MAX_FRAMES, whole=True)]
_Angle = Annotated[float, Limits(0, math.pi, "rad")]


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseSequence:
    """T poses of A drones of one world: an episode, or random places.

    MuJoCo's world frame, m.
    """

    times: Floats
    """Since the start of the episode, shape (T,), s; those of random places are 0."""
    position: Floats
    """Shape (T, A, 3)."""
    quaternion: Floats
    """From body to world, scalar first, shape (T, A, 4)."""
    velocity: Floats | None = None
    """Mean over the control step before, m/s, shape (T, A, 3)."""
    body_rates: Floats | None = None
    """Mean over the control step before, body frame, rad/s, shape (T, A, 3)."""
    goal: Floats | None = None
    """Shape (T, A, 3)."""
    payload: Floats | None = None
    """Shape (T, A, 3)."""
    marks: tuple[Mark, ...] = ()
    name: str = ""
    """Name of its source."""
    scene: str = "plain"
    """Surroundings of the drones."""

    def __len__(self) -> int:
        return len(self.times)

    @property
    def drones(self) -> int:
        """A."""
        return int(self.position.shape[1])

    def at(self, rows: slice | list[int]) -> "PoseSequence":
        """Some of the poses."""
        arrays: dict[str, Any] = {
            name: values[rows]
            for name, values in vars(self).items()
            if isinstance(values, np.ndarray)
        }
        return replace(self, **arrays)

    def state(self, row: int) -> dict[str, Floats]:
        """One pose of all drones, as `Cameras.take` has it."""
        names = ("position", "quaternion", "velocity", "body_rates", "goal", "payload")
        arrays = {name: getattr(self, name) for name in names}
        return {name: values[row] for name, values in arrays.items() if values is not None}


@dataclass(frozen=True, kw_only=True)
class PoseSource:
    """A table `[[poses]]` of a plan."""

    scene: str = ""
    """Surroundings; empty: those of the plan."""

    @abstractmethod
    def sequences(
        self, vehicle: str | None, rng: np.random.Generator, scenes: int
    ) -> list[PoseSequence]:
        """Its poses, for so many scenes in turn. Raises `InputError`."""


@dataclass(frozen=True, kw_only=True)
class RandomPoses(PoseSource):
    """Evenly in a box, with any heading, tilted up to an angle."""

    count: _Count
    center: Annotated[tuple[float, ...], Limits(-_FARTHEST, _FARTHEST, "m", count=3)] = (0, 0, 5)
    size: Annotated[tuple[float, ...], Limits(0, _FARTHEST, "m", count=3)] = (10, 10, 6)
    tilt: _Angle = 0.3

    def sequences(
        self, vehicle: str | None, rng: np.random.Generator, scenes: int
    ) -> list[PoseSequence]:
        """One part for each scene, all nearly as long."""
        shares = rng.uniform(-0.5, 0.5, (self.count, 3))
        half = rng.uniform(-np.pi, np.pi, self.count) / 2
        zero = np.zeros(self.count)
        heading = np.stack((np.cos(half), zero, zero, np.sin(half)), axis=-1)
        quaternion = multiplied(_tilts((self.count,), self.tilt, rng), heading)
        position = np.array(self.center) + np.array(self.size) * shares
        whole = PoseSequence(times=zero, position=position[:, None], quaternion=quaternion[:, None])
        parts = min(scenes, self.count)
        ends = np.linspace(0, self.count, parts + 1).astype(int).tolist()
        return [whole.at(slice(*pair)) for pair in pairwise(ends)]


@dataclass(frozen=True, kw_only=True)
class _FlightPoses(PoseSource):
    """Poses of flights, at every so many control steps."""

    every: _Count = 10
    aside: Annotated[float, Limits(0, _FARTHEST, "m")] = 0.0
    """Cameras are moved by up to this distance along x and y, and upwards."""
    tilt: _Angle = 0.0
    """Cameras are tilted by up to this angle."""

    @abstractmethod
    def trajectories(self, vehicle: str | None) -> list[Trajectory]:
        """Episode after episode, each with a trajectory of every drone. Raises `InputError`."""

    def sequences(
        self, vehicle: str | None, rng: np.random.Generator, scenes: int
    ) -> list[PoseSequence]:
        """One sequence for each episode."""
        found = []
        low = (-self.aside, -self.aside, 0.0)
        for _, world in groupby(self.trajectories(vehicle), key=attrgetter("episode")):
            sequence = _sequence(list(world), self.every)
            shape = sequence.position.shape
            position = sequence.position + rng.uniform(low, self.aside, shape)
            tilts = _tilts(shape[:-1], self.tilt, rng)
            quaternion = multiplied(tilts, sequence.quaternion)
            found.append(replace(sequence, position=position, quaternion=quaternion))
        return found


@dataclass(frozen=True, kw_only=True)
class FlownPoses(_FlightPoses):
    """Evaluation episodes of a policy."""

    env: Annotated[str, Text()] | None = None
    """None: the checkpoint's, or Hover."""
    agent: Annotated[str, Text()] = "geometric"
    options: Mapping[str, Any] = field(default_factory=dict)
    episodes: _Count = 1
    first: NonNegativeInt = 0
    drones: _Count = 1

    def trajectories(self, vehicle: str | None) -> list[Trajectory]:
        """Flown in this process."""
        env_id = load_env(self.env or "rotorgram/Hover-v0")  # the plan is the user's own
        options = dict(self.options)
        controller = CONTROLLERS.get(self.agent)
        checkpoint: Checkpoint | None = None
        if controller is not None:
            options = {**controller.options, **options}
        elif self.agent != "random":
            checkpoint = load(Path(self.agent))
            if self.env is None:
                env_id = checkpoint.env_id
            if env_id == checkpoint.env_id:
                options = {**checkpoint.options, **options}
        config = EnvConfig.from_keywords(env_id, vehicle=vehicle, drones=self.drones, **options)
        spec = env_spec(config)
        policy: Policy | None = None
        if controller is not None:
            policy = controller(spec)
        elif checkpoint is not None:
            if vehicle is None and checkpoint.spec.vehicle_hash != spec.vehicle_hash:
                raise InputError(
                    f"plan: vehicle: expected {checkpoint.spec.vehicle}, on which {self.agent} was "
                    "trained, got none"
                )
            policy = checkpoint.policy(spec)
        episodes = range(self.first, self.first + self.episodes)
        return flown_trajectories(policy, config, episodes, "final")


@dataclass(frozen=True, kw_only=True)
class JournalPoses(_FlightPoses):
    """Episodes of one drone of a journal."""

    file: Annotated[str, Text()]
    session: PositiveInt | None = None
    drone: NonNegativeInt = 0

    def trajectories(self, vehicle: str | None) -> list[Trajectory]:
        """Read from the journal."""
        path = Path(self.file)
        flown = recorded_trajectories(path, session=self.session, drone=self.drone)
        recorded = flown[0].spec.vehicle
        own = Vehicle.load(vehicle).name
        if recorded != own:
            raise InputError(
                f"plan: vehicle: expected {recorded}, which flies in {path}, got {own}"
            )
        return flown


_SOURCES: Final[Mapping[str, type[PoseSource]]] = {
    "random": RandomPoses,
    "flight": FlownPoses,
    "journal": JournalPoses,
}


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Content of a data set of pictures. `Plan.read` reads a file."""

    text: str
    """The TOML file."""
    cameras: tuple[str, ...] = ("front", "front_segmentation")
    """Words as of the option `cameras` of a task."""
    poses: tuple[PoseSource, ...]
    vehicle: str | None = None
    scene: str = "plain"
    """Flights and places are shared among the scenes of `scenes_of`."""
    seed: Annotated[int, Limits(0, (1 << 63) - 1, whole=True)] = 0
    fine: bool = True
    """With shadows and smooth edges."""
    least_area: PositiveInt = 1
    """Pixels that an object needs to get a label."""

    def __post_init__(self) -> None:
        check_fields(self, "plan: ")
        scenes_of(self.scene)
        object.__setattr__(self, "cameras", words_of("plan: cameras", self.cameras))
        self.views()

    @classmethod
    def read(cls, path: Path) -> "Plan":
        """Read a TOML file. Raises `InputError`, or `OSError` where it cannot be read."""
        table = read_toml(path, "plan")
        check_names(table, [name for name in cls.__dataclass_fields__ if name != "text"], "plan")
        poses = table.pop("poses", None)
        if not isinstance(poses, list) or not poses:
            raise InputError(f"plan: expected a table [[poses]] or more, got {shortened(poses)}")
        sources = [_source(one, number) for number, one in enumerate(poses, 1)]
        return cls(text=path.read_text("utf-8"), poses=tuple(sources), **table)

    def views(self) -> tuple[View, ...]:
        """The pictures of each pose. Raises `InputError`."""
        return chosen_views(self.cameras, Vehicle.load(self.vehicle).cameras)

    def sequences(self) -> list[PoseSequence]:
        """All poses. Raises `InputError`."""
        found: list[PoseSequence] = []
        kinds = {kind: word for word, kind in _SOURCES.items()}
        for number, source in enumerate(self.poses, 1):
            name = f"{number} {kinds[type(source)]}"
            rng = np.random.default_rng([self.seed, number])
            scenes = scenes_of(source.scene or self.scene)
            sequences = source.sequences(self.vehicle, rng, len(scenes))
            for sequence, scene in zip(sequences, cycle(scenes), strict=False):
                found.append(replace(sequence, name=name, scene=scene))
        count = sum(map(len, found))
        if count > MAX_FRAMES:
            raise InputError(f"plan: expected at most {MAX_FRAMES} poses, got {count}")
        return found


def _source(table: object, number: int) -> PoseSource:
    """A source of poses from its table. Raises `InputError`."""
    name = f"plan: poses[{number}]"
    given = dict(table) if isinstance(table, Mapping) else {}
    word = check(f"{name}.from", Choice(tuple(_SOURCES)), given.pop("from", None))
    source = read_table(_SOURCES[word], given, name)
    if source.scene:
        scenes_of(source.scene)
    if isinstance(source, RandomPoses):
        lowest = source.center[2] - source.size[2] / 2
        if lowest < 0:
            raise InputError(f"{name}: expected a box above the ground, got one from {lowest:g} m")
    if isinstance(source, FlownPoses) and not isinstance(source.options, Mapping):
        got = shortened(source.options)
        raise InputError(f"{name}.options: expected options by name, got {got}")
    return source


def _tilts(shape: tuple[int, ...], largest: float, rng: np.random.Generator) -> Floats:
    """Rotations by up to an angle, rad, about any level axis, quaternions, (*shape, 4)."""
    axis = rng.uniform(-np.pi, np.pi, shape)
    half = largest * np.sqrt(rng.uniform(0, 1, shape)) / 2
    x = np.sin(half) * np.cos(axis)
    y = np.sin(half) * np.sin(axis)
    return np.stack((np.cos(half), x, y, np.zeros(shape)), axis=-1)


def _sequence(world: Sequence[Trajectory], every: int) -> PoseSequence:
    """Every so many steps of the trajectories of the drones of a world."""
    steps = np.arange(0, max(map(len, world)) + 1, every)
    spec = world[0].spec
    drones = [_poses_after(one, steps) for one in world]
    arrays: dict[str, Any] = {
        key: np.stack([poses[key] for poses in drones], axis=1) for key in drones[0]
    }
    times = steps.astype(np.float64) * spec.control_period
    return PoseSequence(times=times, marks=spec.marks, **arrays)


def _poses_after(one: Trajectory, steps: NDArray[np.int_]) -> dict[str, Floats]:
    """Poses of one drone after so many steps; after its end it stays where it is."""
    arrays = one.telemetry
    rows = np.minimum(steps, len(one))
    now = one.pose[rows]
    before = one.pose[np.maximum(rows - 1, 0)]
    turned = np.zeros((len(rows), 3))
    for turn, new, old in zip(turned, now[:, 3:], before[:, 3:], strict=True):
        mujoco.mju_subQuat(turn, new, old)
    seconds = np.where(steps <= len(one), one.spec.control_period, np.inf)[:, None]
    poses = {
        "position": now[:, :3],
        "quaternion": now[:, 3:],
        "velocity": (now[:, :3] - before[:, :3]) / seconds,
        "body_rates": turned / seconds,
    }
    for key in ("goal", "payload"):
        if key in arrays:
            poses[key] = arrays[key][rows]
    return poses

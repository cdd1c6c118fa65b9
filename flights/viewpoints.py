"""Poses of the cameras of a data set: those of recorded flights, moved and tilted at random.

The same journals and the same seed give the same poses on every machine.
"""

import math
from collections.abc import Iterator, Sequence
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from .. import models
from ..envs.config import words_of
from ..envs.spec import Mark
from ..models import InputError
from ..models.fields import Limits, NonNegativeInt, PositiveInt, check_fields, immutable
from ..scenes import parse_scene
from ..sim.rotations import multiplied
from .recorded import read_episodes
from .trajectories import Flights, Floats, Trajectory

if TYPE_CHECKING:
    from ..models.cameras import View


@immutable
class CaptureConfig:
    """Which pictures are taken of recorded flights."""

    cameras: tuple[str, ...] = ("front", "front_segmentation")
    """Pictures of each frame: cameras of the vehicle, each NAME, NAME_KIND or NAME@WIDTHxHEIGHT."""
    vehicle: str | None = None
    """File or name of the vehicle that flew. Default: the paper's."""
    scene: str = "plain"
    """Surroundings: plain, airport, or a TOML or MJCF file, or one from a seed, as forest:3."""
    every: PositiveInt = 10
    """Control steps from one frame to the next."""
    aside: Annotated[float, Limits(0, 1e4, "m")] = 0.0
    """Drones are moved at random by up to this distance along x and y, and upwards, m."""
    tilt: Annotated[float, Limits(0, math.pi, "rad")] = 0.0
    """Drones are tilted at random by up to this angle, rad."""
    seed: NonNegativeInt = 0
    """Seed of the random moves and tilts."""
    fast: bool = False
    """Draw without shadows and without smooth edges."""

    def __post_init__(self) -> None:
        check_fields(self)
        parse_scene(self.scene)
        self.views()

    def views(self) -> "tuple[View, ...]":
        """The pictures of each frame. Raises `InputError`."""
        from ..models.cameras import chosen_views  # it imports MuJoCo

        words = words_of("cameras", self.cameras)
        return chosen_views(words, models.Vehicle.load(self.vehicle).cameras)


@immutable
class PoseSequence:
    """T poses of the A drones of a world, in one episode."""

    source: str
    """Name of the journal."""
    times: Floats
    """Since the start of the episode, shape (T,), s."""
    states: dict[str, Floats]
    """As `Cameras.take` has them, after the time: `position`, shape (T, A, 3), `quaternion`, and
    where there are any `goal` and `payload`."""
    marks: tuple[Mark, ...]

    def __len__(self) -> int:
        return len(self.times)

    @property
    def drones(self) -> int:
        """Number of drones, A."""
        return int(self.states["position"].shape[1])

    def state(self, row: int) -> dict[str, Floats]:
        """One pose of all drones."""
        poses = {name: values[row] for name, values in self.states.items()}
        return poses | {"time": self.times[row : row + 1]}


def sequences_of(journals: Sequence[Path], config: CaptureConfig) -> list[PoseSequence]:
    """Poses of every episode of journals, as far as it was recorded.

    Raises:
        InputError: A file is no journal, has no episode, or is of another vehicle.
        OSError: It cannot be read.
    """
    given = models.Vehicle.load(config.vehicle).name
    found = []
    for number, path in enumerate(journals, 1):
        rng = np.random.default_rng([config.seed, number])
        episodes = list(_episodes(path))
        if not episodes:
            raise InputError(f"{path}: expected an episode with a step in it, got none")
        for episode in episodes:
            recorded = episode[0].spec.vehicle
            if recorded != given:
                raise InputError(
                    f"vehicle: expected {recorded}, which flies in {path}, got {given}"
                )
            found.append(_sequence(path.name, episode, config, rng))
    return found


def _episodes(path: Path) -> Iterator[Flights]:
    """For each episode of a world, the trajectories of its drones."""
    flown: dict[tuple[int, int, int], Flights] = {}
    for one in read_episodes(path):
        if isinstance(one, Trajectory):
            world = one.drone // len(one.spec.agents)
            flown.setdefault((one.session, world, one.episode), []).append(one)
    for _, episode in sorted(flown.items()):
        yield sorted(episode, key=attrgetter("drone"))


def _sequence(
    source: str, episode: Sequence[Trajectory], config: CaptureConfig, rng: Generator
) -> PoseSequence:
    """Every so many steps of an episode; a drone whose flight has ended stays where it is."""
    steps = np.arange(0, max(map(len, episode)) + 1, config.every)
    rows = [np.minimum(steps, len(one)) for one in episode]
    poses = _stacked([one.pose for one in episode], rows)
    low = (-config.aside, -config.aside, 0.0)
    moved = rng.uniform(low, config.aside, poses[..., :3].shape)
    # Rotations about any level axis.
    shape = poses.shape[:-1]
    axis = rng.uniform(-np.pi, np.pi, shape)
    half = config.tilt * np.sqrt(rng.uniform(0, 1, shape)) / 2
    x = np.sin(half) * np.cos(axis)
    y = np.sin(half) * np.sin(axis)
    tilts = np.stack((np.cos(half), x, y, np.zeros(shape)), axis=-1)
    states = {"position": poses[..., :3] + moved, "quaternion": multiplied(tilts, poses[..., 3:])}
    for name in ("goal", "payload"):
        if name in episode[0].telemetry:
            states[name] = _stacked([one.telemetry[name] for one in episode], rows)
    spec = episode[0].spec
    times = steps.astype(np.float64) * spec.control_period
    return PoseSequence(source=source, times=times, states=states, marks=spec.marks)


def _stacked(arrays: Sequence[Floats], rows: Sequence[NDArray[np.int_]]) -> Floats:
    """Some rows of the array of each drone, (T, A, n)."""
    chosen = [array[own] for array, own in zip(arrays, rows, strict=True)]
    return np.stack(chosen, axis=1)

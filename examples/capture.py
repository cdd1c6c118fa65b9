"""Labelled pictures of recorded flights as a data set. `docs/capture.md` has the layout.

    rotorgram evaluate geometric --env rotorgram/Landing-v0 --vehicle crazyflie2 \\
        --episodes 2 --record landing.mcap
    python examples/capture.py landing.mcap --vehicle crazyflie2 --out pad [--help]

Poses are those of recorded flights, moved and tilted at random: the same journals and the same seed
give the same poses on every machine. Each frame is one pose of the drones of a world. Workers
return its files as bytes; this process writes them, the labels last.
"""

import io
import json
import math
import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, fields
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Annotated, NamedTuple

import mujoco
import numpy as np
import tyro
from numpy.random import Generator
from numpy.typing import NDArray
from PIL import Image
from rotorgram.envs.spec import Mark
from rotorgram.flights.executors import Tell, WorkersConfig, open_executor, run_jobs
from rotorgram.flights.folders import new_folder
from rotorgram.flights.recorded import read_episodes
from rotorgram.flights.trajectories import Flights, Floats, Trajectory
from rotorgram.models import InputError, Vehicle
from rotorgram.models.cameras import View, chosen_views
from rotorgram.models.errors import NoOpenGL
from rotorgram.models.fields import (
    Limits,
    NonNegativeInt,
    PositiveInt,
    check_fields,
    immutable,
)
from rotorgram.models.files import software_versions, write_whole
from rotorgram.models.library import words_of
from rotorgram.models.swarm import drone_names
from rotorgram.rendering.cameras import Cameras
from rotorgram.rendering.gl import offscreen_context
from rotorgram.scenes import parse_scene
from rotorgram.sim.rotations import product
from tyro.conf import Positional

MOST_FRAMES = 64  # of a job
Picture = NDArray[np.generic]
Labels = dict[str, object]
"""The labels of one frame or picture: an object of JSON."""
view_of = itemgetter("camera", "drone", "width", "height")
"""What the pictures of one view share."""


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

    def views(self) -> tuple[View, ...]:
        """The pictures of each frame. Raises `InputError`."""
        words = words_of("cameras", self.cameras)
        return chosen_views(words, Vehicle.load(self.vehicle).cameras)


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
    given = Vehicle.load(config.vehicle).name
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
    tilts = (np.cos(half), x, y, np.zeros(shape))
    turned = product(tilts, np.moveaxis(poses[..., 3:], -1, 0))
    states = {"position": poses[..., :3] + moved, "quaternion": np.stack(turned, axis=-1)}
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


class Job(NamedTuple):
    """Some frames of a sequence, one after the other."""

    config: CaptureConfig
    poses: PoseSequence
    sequence: int
    """Number of the sequence."""
    start: int
    """Number of its first frame."""
    rows: range
    """Poses of the frames."""


class Taken(NamedTuple):
    """Result of a job."""

    objects: tuple[str, ...]
    """Names of all objects of the scene, seen or not."""
    frames: list[tuple[dict[str, bytes], Labels]]
    """Of each frame its files, by their paths in the folder, and its labels."""


def capture(
    journals: Sequence[Path],
    out: Path,
    config: CaptureConfig,
    workers: WorkersConfig,
) -> int:
    """Take pictures of recorded flights into a new folder; the number of frames.

    Pictures that are taken stay, also after an error.

    Raises:
        InputError: `out` exists, or as of `sequences_of`.
        OSError: It cannot be written.
        RunsFailed: Workers fail.
    """
    sequences = sequences_of(journals, config)
    folder = new_folder(out, "capture")
    count = sum(map(len, sequences))
    processes = workers.jobs or os.cpu_count() or 1
    longest = min(MOST_FRAMES, -(-count // (2 * processes)))
    jobs: dict[str, Job] = {}
    start = 0
    for number, poses in enumerate(sequences):
        for first in range(0, len(poses), longest):
            rows = range(first, min(first + longest, len(poses)))
            job = Job(config, poses, number, start, rows)
            jobs[f"frames from {start + first} on"] = job
        start += len(poses)
    objects = set[str]()
    labels: list[Labels] = []

    def keep(_: Job, taken: Taken) -> None:
        objects.update(taken.objects)
        for files, own in taken.frames:
            for name, data in files.items():
                write_whole(folder / name, data)
            text = json.dumps(own, separators=(",", ":"))
            write_whole(folder / "labels" / f"{own['frame']:06}.json", text)
            labels.append(own)

    with open_executor(workers, len(jobs)) as executor:
        run_jobs(executor, take, jobs, keep, print_progress)
    labels.sort(key=lambda own: own["frame"])
    vehicle_hash = Vehicle.load(config.vehicle).hash
    made = {**asdict(config), "vehicle_hash": vehicle_hash, "versions": software_versions()}
    write_coco(labels, objects, made, folder / "coco.json")
    return count


def print_progress(name: str, done: int, total: int, _: str) -> None:
    """Print how many jobs are done."""
    if name == "all runs":
        print(f"{done} of {total} jobs", end="\r", file=sys.stderr)


# ---- in workers


def take(job: Job, tell: Tell) -> Taken:
    """The frames of a job."""
    poses = job.poses
    everybody = np.ones(poses.drones, bool)
    frames = []
    opened = Cameras(
        Vehicle.load(job.config.vehicle),
        job.config.views(),
        (1, poses.drones),
        scene=job.config.scene,
        marks=poses.marks,
        payload="payload" in poses.states,
        fine=not job.config.fast,
    )
    with closing(opened) as cameras:
        due = dict.fromkeys(cameras.pictures, everybody)
        for row in job.rows:
            cameras.take(due, poses.state(row))
            frames.append(frame_of(job, row, cameras))
            tell(len(frames), len(job.rows), "frames")
        return Taken(cameras.objects[1:], frames)  # the first is no object


def frame_of(job: Job, row: int, cameras: Cameras) -> tuple[dict[str, bytes], Labels]:
    """Files and labels of the pictures that the cameras have just taken."""
    poses = job.poses
    number = job.start + row
    state = poses.state(row)
    names = drone_names(poses.drones)
    files: dict[str, bytes] = {}
    pictures = []
    for view in cameras.views:
        # A camera that stands takes one picture for all drones.
        drones = range(1 if view.camera.stands else poses.drones)
        for drone in drones:
            suffix = f"_{drone}" if len(drones) > 1 else ""
            image = cameras.pictures[view.name][drone]
            ending, data = encoded(view, image)
            file = f"{view.kind}/{view.camera.name}/{number:06}{suffix}.{ending}"
            files[file] = data
            lens = lens_of(cameras, view, drone)
            height, width = view.shape[:2]
            picture: Labels = {
                "file": file,
                "camera": view.camera.name,
                "kind": view.kind,
                "drone": names[drone],
                "width": width,
                "height": height,
                "matrix": lens.matrix.tolist(),
                "rotation": lens.rotation.tolist(),
                "translation": lens.translation.tolist(),
            }
            if view.kind == "segmentation":
                picture["objects"] = list(objects_in(image[..., 0], cameras.objects))
            pictures.append(picture)
    labels = {
        "frame": number,
        "sequence": job.sequence,
        "source": poses.source,
        "time": float(poses.times[row]),
        "pose": {name: values.tolist() for name, values in state.items()},
        "pictures": pictures,
    }
    return files, labels


def encoded(view: View, image: Picture) -> tuple[str, bytes]:
    """Ending and bytes of the file of a picture."""
    data = io.BytesIO()
    if view.kind == "depth":
        np.save(data, image[..., 0])
        return "npy", data.getvalue()
    if view.kind == "segmentation":
        image = image[..., 0].astype(np.uint16)
    Image.fromarray(image).save(data, "PNG")
    return "png", data.getvalue()


def objects_in(numbers: Picture, names: Sequence[str]) -> Iterator[Labels]:
    """Objects of a segmentation picture (H, W): name, box from its mask, area, run lengths.

    The box is [left, top, width, height], pixels. Run lengths are COCO's: down each column, those
    outside first.
    """
    for number in np.unique(numbers[numbers != 0]).tolist():
        mask = numbers == number
        rows, columns = np.nonzero(mask)
        edges = np.flatnonzero(np.diff(mask.ravel(order="F"), prepend=False))
        runs = np.diff(edges, prepend=0, append=mask.size)
        left = int(columns.min())
        top = int(rows.min())
        yield {
            "number": number,
            "name": names[number],
            "box": [left, top, int(columns.max()) + 1 - left, int(rows.max()) + 1 - top],
            "area": len(rows),
            "runs": runs.tolist(),
        }


# ---- COCO's format of object detection


def write_coco(
    frames: Sequence[Labels], objects: Iterable[str], settings: Mapping[str, object], file: Path
) -> None:
    """Write the objects of all segmentation pictures, with the labels of all frames.

    The categories are the kinds of all objects of the scenes, seen or not. Raises `OSError`.
    """
    kinds = sorted(set(map(category, objects)))
    categories = {kind: number for number, kind in enumerate(kinds, 1)}
    images: list[Labels] = []
    annotations: list[Labels] = []
    for frame in frames:
        pictures = frame["pictures"]
        colors = {view_of(one): one["file"] for one in pictures if one["kind"] == "rgb"}
        for picture in pictures:
            if picture["kind"] != "segmentation":
                continue
            # An image is named by the colours of its camera in the same size, if there are any.
            image = {
                "id": len(images) + 1,
                "file_name": colors.get(view_of(picture), picture["file"]),
                "width": picture["width"],
                "height": picture["height"],
                "sequence": frame["sequence"],
                "time": frame["time"],
            }
            images.append(image)
            for thing in picture["objects"]:
                size = [picture["height"], picture["width"]]
                annotation = {
                    "id": len(annotations) + 1,
                    "image_id": image["id"],
                    "category_id": categories[category(thing["name"])],
                    "bbox": thing["box"],
                    "area": thing["area"],
                    "iscrowd": 0,
                    "segmentation": {"size": size, "counts": thing["runs"]},
                    "object": thing["name"],
                }
                annotations.append(annotation)
    content = {
        "info": settings,
        "images": images,
        "annotations": annotations,
        "categories": [{"id": number, "name": name} for name, number in categories.items()],
    }
    write_whole(file, json.dumps(content, separators=(",", ":")) + "\n")


class Lens(NamedTuple):
    """How points of the world come to pixels: p = K (R x + t), then over its third number."""

    matrix: Floats
    """K, shape (3, 3), pixels."""
    rotation: Floats
    """R, shape (3, 3), from the world's frame to the camera's."""
    translation: Floats
    """t, shape (3,), m."""


def lens_of(cameras: Cameras, view: View, drone: int = 0) -> Lens:
    """The lens of a view's camera, of a drone of the world that was drawn last.

    A camera's frame here: x right, y down, z along its axis, as in computer vision.
    """
    model = cameras.model
    name = view.camera.name
    camera = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, name)
    if camera < 0:  # a drone carries it
        camera = model.camera(f"{drone_names(drone + 1)[drone]}/{name}").id
    axes = cameras.data.cam_xmat[camera].reshape(3, 3)
    rotation = (axes * (1.0, -1.0, -1.0)).T
    translation = -rotation @ cameras.data.cam_xpos[camera]
    height, width, _ = view.shape
    return Lens(matrix_of(model, camera, width, height), rotation, translation)


def matrix_of(model: mujoco.MjModel, camera: int, width: int, height: int) -> Floats:
    """K of a camera of a model, shape (3, 3), pixels."""
    if model.cam_sensorsize[camera].any():
        focal = model.cam_intrinsic[camera]
        scale = np.array((width, height)) / model.cam_sensorsize[camera]
        fx, fy = focal[:2] * scale
        cx = width / 2 - focal[2] * scale[0]
        cy = height / 2 - focal[3] * scale[1]
    else:
        fx = fy = 0.5 * height / np.tan(np.radians(model.cam_fovy[camera]) / 2)
        cx = width / 2
        cy = height / 2
    return np.array(((fx, 0.0, cx), (0.0, fy, cy), (0.0, 0.0, 1.0)))


def category(name: str) -> str:
    """Kind of an object: its name without numbers, as forest/tree of forest/tree_12."""
    return re.sub(r"_\d+\b", "", name)


@immutable
class Command(CaptureConfig, WorkersConfig):
    """Take pictures of recorded flights, with depth, objects, boxes and poses, as a data set."""

    journals: Positional[tuple[Path, ...]]
    """MCAP files that --record wrote."""
    out: Path
    """Folder to write to. It must not exist."""

    def __post_init__(self) -> None:
        CaptureConfig.__post_init__(self)
        WorkersConfig.__post_init__(self)

    def run(self) -> None:
        """Take them; say where and how many."""
        config = CaptureConfig(
            **{one.name: getattr(self, one.name) for one in fields(CaptureConfig)}
        )
        workers = WorkersConfig(jobs=self.jobs, runner=self.runner, address=self.address)
        offscreen_context(16, 16).free()
        frames = capture(self.journals, self.out, config, workers)
        print(f"{self.out}: {frames} frames of {len(config.views())} pictures a drone")


if __name__ == "__main__":
    try:
        tyro.cli(Command).run()
    except (InputError, NoOpenGL, OSError) as error:
        sys.exit(str(error))
    except KeyboardInterrupt:
        sys.exit(130)

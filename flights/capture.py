"""Labelled pictures: `rotorgram capture` takes them in workers, and writes them as a data set.

Each frame is one pose of the drones of a world. Workers return its files as bytes; this process
writes them, the labels last: a frame that has labels is whole, and is never taken again.
`docs/capture.md` has the layout.
"""

import hashlib
import io
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..agents.checkpoints import write_whole
from ..models.cameras import View
from ..models.errors import InputError
from ..models.swarm import drone_names
from ..models.vehicle import Vehicle
from .coco import write_coco
from .executors import OnProgress, Tell, WorkersConfig, open_executor, run_jobs
from .folders import locked
from .viewpoints import Plan, PoseSequence

if TYPE_CHECKING:
    from ..rendering.cameras import Cameras

LABELS: Final = "labels"
_CHUNK: Final = 64  # frames of a job, at most
_ENDINGS: Final = {
    "rgb": ("png",),
    "depth": ("npy", "png"),
    "segmentation": ("png",),
    "flow": ("npy",),
}
"""File name extensions of each kind of picture."""
_FARTHEST: Final = 65.535  # m: the largest number of millimetres in 16 bits


@dataclass(frozen=True, kw_only=True)
class _Job:
    """Some consecutive frames of a sequence, and the pose before them, if there is one."""

    plan: Plan
    poses: PoseSequence
    """These poses alone."""
    sequence: int
    """Number of the whole sequence."""
    first: int
    """Number of the first frame."""
    before: int
    """1 if `poses` begins with the pose before the first frame, else 0."""

    @property
    def name(self) -> str:
        last = self.first + len(self.poses) - self.before - 1
        return f"frames {self.first} to {last}"


class Frame(NamedTuple):
    """The pictures and labels of a pose."""

    number: int
    files: dict[str, bytes]
    """By their paths in the folder."""
    labels: dict[str, Any]


def capture(
    plan: Plan, folder: Path, config: WorkersConfig, on_progress: OnProgress = lambda *_: None
) -> int:
    """Take all pictures of a plan that the folder does not have yet; the number of its frames.

    Pictures that are taken stay, also after an error.

    Raises:
        InputError: The folder is of another plan, vehicle or version of MuJoCo.
        OSError: It cannot be written.
        RunsFailed: Workers fail.
    """
    with locked(folder):
        sequences = plan.sequences()
        views = plan.views()
        _claim(folder / "plan.toml", plan.text, "plan")
        _claim(
            folder / "made_of.json",
            _made_of(plan, sequences, views),
            "vehicle, flights and MuJoCo",
        )
        for unfinished in folder.rglob(".*.tmp"):  # by a run that was killed
            unfinished.unlink()
        workers = config.jobs or os.cpu_count() or 1
        found = _jobs(plan, sequences, views, folder, workers)
        jobs = {job.name: job for job in found}
        if jobs:

            def keep(_: _Job, frames: list[Frame]) -> None:
                _write(folder, frames)

            with open_executor(config, len(jobs), on_progress) as executor:
                run_jobs(executor, _take, jobs, keep, on_progress)
        count = sum(map(len, sequences))
        write_coco(plan, sequences, read_labels(folder, count), folder / "coco.json")
    return count


def _claim(file: Path, text: str, what: str) -> None:
    """Write a file that identifies the folder, or raise `InputError` if it has another content."""
    if not file.exists():
        write_whole(file, text.encode())
    elif file.read_bytes() != text.encode():
        raise InputError(f"{file.parent}: expected a folder of the same {what}, got one of others")


def _made_of(plan: Plan, sequences: Sequence[PoseSequence], views: Sequence[View]) -> str:
    """Hashes of what decides the pictures besides the plan, in JSON."""
    digest = hashlib.blake2b(digest_size=16)
    for sequence in sequences:
        for name, value in vars(sequence).items():
            digest.update(name.encode())
            content = value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode()
            digest.update(content)
    made = {
        "vehicle": Vehicle.load(plan.vehicle).hash,
        "cameras": hashlib.blake2b(repr(views).encode(), digest_size=16).hexdigest(),
        "poses": digest.hexdigest(),
        "mujoco": mujoco.__version__,
    }
    return json.dumps(made, indent=2) + "\n"


def _jobs(
    plan: Plan,
    sequences: Sequence[PoseSequence],
    views: Sequence[View],
    folder: Path,
    workers: int,
) -> Iterator[_Job]:
    """Runs of consecutive frames that are not whole."""
    first = 0
    share = -(-sum(map(len, sequences)) // (2 * workers))
    longest = min(share, _CHUNK)
    for number, poses in enumerate(sequences):
        missing = [
            row
            for row in range(len(poses))
            if not _is_whole(folder, first + row, views, poses.drones)
        ]
        while missing:
            start = missing[0]
            count = 1
            while count < min(longest, len(missing)) and missing[count] == start + count:
                count += 1
            before = min(start, 1)
            yield _Job(
                plan=plan,
                poses=poses.part(start - before, start + count),
                sequence=number,
                first=first + start,
                before=before,
            )
            missing = missing[count:]
        first += len(poses)


def _is_whole(folder: Path, number: int, views: Sequence[View], drones: int) -> bool:
    """Whether a frame's labels are there, and all its files in their sizes."""
    try:
        pictures = json.loads(label_file(folder, number).read_bytes())["pictures"]
        labelled = [(p["camera"], p["kind"], p["width"], p["height"]) for p in pictures]
        sizes = {file: size for p in pictures for file, size in p["files"].items()}
        same_sizes = all((folder / file).stat().st_size == size for file, size in sizes.items())
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return False
    expected = []
    files = set()
    for view in views:
        height, width = view.shape[:2]
        for drone in range(pictures_of(view, drones)):
            expected.append((view.camera.name, view.kind, width, height))
            for ending in _ENDINGS[view.kind]:
                files.add(picture_name(view, number, drone, drones, ending))
    return same_sizes and labelled == expected and files == sizes.keys()


def label_file(folder: Path, number: int) -> Path:
    """Path of a frame's labels."""
    return folder / LABELS / f"{number:06}.json"


def pictures_of(view: View, drones: int) -> int:
    """Pictures of a view in each frame: one of each drone, or one of a camera that stands."""
    return drones if view.camera.carried else 1


def picture_name(view: View, number: int, drone: int, drones: int, ending: str) -> str:
    """Path of a picture in the folder."""
    suffix = f"_{drone}" if pictures_of(view, drones) > 1 else ""
    return f"{view.kind}/{view.camera.name}/{number:06}{suffix}.{ending}"


# ---- in workers


def _take(job: _Job, tell: Tell) -> list[Frame]:
    """The frames of a job."""
    from ..rendering.cameras import Cameras

    plan = job.plan
    poses = job.poses
    drones = poses.drones
    everybody = np.ones(drones, bool)
    frames = []
    opened = Cameras(
        Vehicle.load(plan.vehicle),
        plan.views(),
        (1, drones),
        scene=poses.scene,
        marks=poses.marks,
        payload=poses.payload is not None,
        fine=plan.fine,
    )
    with closing(opened) as cameras:
        for row in range(len(poses)):
            is_frame = row >= job.before  # the pose before serves optical flow alone
            number = job.first + row - job.before
            state = poses.state(row)
            due = dict.fromkeys(cameras.pictures, everybody & is_frame)
            begun = everybody & (row == 0)
            rng = {0: np.random.default_rng([plan.seed, 0, number])}  # sources count from 1
            cameras.take(due, begun, state, rng.__getitem__)
            if not is_frame:
                continue
            labels = {
                "frame": number,
                "sequence": job.sequence,
                "source": poses.name,
                "scene": poses.scene,
                "time": float(poses.times[row]),
            }
            frames.append(_frame(number, cameras, drones, state, labels, plan.least_area))
            tell(len(frames), len(poses) - job.before, "frames")
    return frames


def _frame(
    number: int,
    cameras: "Cameras",
    drones: int,
    state: Mapping[str, NDArray[np.float64]],
    labels: Mapping[str, Any],
    least_area: int,
) -> Frame:
    """Files and labels of the pictures that the cameras have just taken."""
    files: dict[str, bytes] = {}
    pictures = []
    for view in cameras.views:
        for drone in range(pictures_of(view, drones)):
            image = cameras.pictures[view.name][drone]
            encoded = {
                picture_name(view, number, drone, drones, ending): data
                for ending, data in _encoded(view.kind, image)
            }
            files.update(encoded)
            lens = cameras.lens(view.name, state, drone)
            height, width = view.shape[:2]
            picture: dict[str, Any] = {
                "camera": view.camera.name,
                "kind": view.kind,
                "drone": drone_names(drones)[drone],
                "width": width,
                "height": height,
                "matrix": lens.matrix.tolist(),
                "rotation": lens.rotation.tolist(),
                "translation": lens.translation.tolist(),
                "distortion": list(lens.distortion),
                "files": {path: len(data) for path, data in encoded.items()},
            }
            if view.kind == "segmentation":
                found = objects_in(image[..., 0], cameras.objects)
                picture["objects"] = [thing for thing in found if thing["area"] >= least_area]
            pictures.append(picture)
    pose = {name: values.tolist() for name, values in state.items()}
    return Frame(number, files, {**labels, "pose": pose, "pictures": pictures})


def _encoded(kind: str, image: NDArray[Any]) -> Iterator[tuple[str, bytes]]:
    """Ending and bytes of the files of a picture."""
    if kind == "rgb":
        yield "png", _png(image)
    elif kind == "segmentation":
        yield "png", _png(image[..., 0].astype(np.uint16))
    elif kind == "flow":
        yield "npy", _npy(image)
    else:
        depth = image[..., 0]
        yield "npy", _npy(depth)
        millimetres = np.rint(1000 * depth.astype(np.float64))
        near = np.where(depth <= _FARTHEST, millimetres, 0)
        yield "png", _png(near.astype(np.uint16))


def _npy(array: NDArray[Any]) -> bytes:
    data = io.BytesIO()
    np.save(data, array)
    return data.getvalue()


def _png(array: NDArray[Any]) -> bytes:
    from PIL import Image

    data = io.BytesIO()
    Image.fromarray(array).save(data, "PNG")
    return data.getvalue()


def objects_in(numbers: NDArray[np.int32], names: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Objects of a segmentation picture (H, W): name, box from its mask, area, run lengths.

    The box is [left, top, width, height], pixels. Run lengths are COCO's: down each column, those
    outside first.
    """
    for number in np.unique(numbers).tolist():
        if number == 0:
            continue
        mask = numbers == number
        rows = np.flatnonzero(mask.any(axis=1))
        columns = np.flatnonzero(mask.any(axis=0))
        flat = np.concatenate(([False], mask.ravel(order="F")))
        edges = np.flatnonzero(flat[1:] != flat[:-1])
        runs = np.diff(np.concatenate(([0], edges, [mask.size])))
        width = int(np.ptp(columns)) + 1
        height = int(np.ptp(rows)) + 1
        yield {
            "number": number,
            "name": names[number],
            "box": [int(columns[0]), int(rows[0]), width, height],
            "area": int(mask.sum()),
            "runs": runs.tolist(),
        }


# ---- files


def _write(folder: Path, frames: Iterable[Frame]) -> None:
    """Write frames, the labels of each last."""
    for frame in frames:
        for name, data in frame.files.items():
            write_whole(folder / name, data)
        labels = json.dumps(frame.labels, separators=(",", ":"))
        write_whole(label_file(folder, frame.number), labels.encode())


def read_labels(folder: Path, count: int) -> list[dict[str, Any]]:
    """Labels of the first `count` frames; all of them have to be whole."""
    files = (label_file(folder, number) for number in range(count))
    return [json.loads(file.read_bytes()) for file in files]

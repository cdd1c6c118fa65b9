"""Labelled pictures: `rotorgram capture` takes them in workers, and writes them as a data set.

Each frame is one pose of the drones of a world. Workers return its files as bytes; this process
writes them, the labels last: a frame that has labels is whole, and is never taken again.
`docs/capture.md` has the layout.
"""

import hashlib
import io
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..agents.checkpoints import write_whole
from ..models.cameras import View
from ..models.errors import InputError
from ..models.swarm import drone_names
from ..models.vehicle import Vehicle
from .coco import Labels, write_coco
from .executors import OnProgress, Tell, WorkersConfig, open_executor, run_jobs
from .folders import locked
from .viewpoints import Plan, PoseSequence

if TYPE_CHECKING:
    from ..rendering.cameras import Cameras

_MOST_FRAMES = 64  # of a job
_FARTHEST = 65.535  # m: the largest number of millimetres in 16 bits
Picture = NDArray[np.generic]


class _Job(NamedTuple):
    """Some frames of a sequence."""

    plan: Plan
    poses: PoseSequence
    """Those of the frames."""
    sequence: int
    """Number of the whole sequence."""
    numbers: list[int]
    """Of the frames."""


Frame = tuple[dict[str, bytes], Labels]
"""Files of a pose by their paths in the folder, and its labels."""


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
        _claim(folder / "plan.toml", plan.text, "plan")
        _claim(folder / "made_of.json", _made_of(plan, sequences), "vehicle, flights and MuJoCo")
        for unfinished in folder.rglob(".*.tmp"):  # by a run that was killed
            unfinished.unlink()
        count = sum(map(len, sequences))
        workers = config.jobs or os.cpu_count() or 1
        longest = min(_MOST_FRAMES, -(-count // (2 * workers)))
        jobs = {}
        for job in _jobs(plan, sequences, folder, longest):
            jobs[f"frames {job.numbers[0]} to {job.numbers[-1]}"] = job

        def keep(_: _Job, frames: list[Frame]) -> None:
            for files, labels in frames:
                for name, data in files.items():
                    write_whole(folder / name, data)
                text = json.dumps(labels, separators=(",", ":"))
                write_whole(label_file(folder, labels["frame"]), text.encode())

        if jobs:
            with open_executor(config, len(jobs), on_progress) as executor:
                run_jobs(executor, _take, jobs, keep, on_progress)
        write_coco(plan, sequences, read_labels(folder, count), folder / "coco.json")
    return count


def label_file(folder: Path, number: int) -> Path:
    """Path of a frame's labels."""
    return folder / "labels" / f"{number:06}.json"


def read_labels(folder: Path, count: int) -> list[Labels]:
    """Labels of the first `count` frames; all of them have to be whole."""
    return [json.loads(label_file(folder, number).read_bytes()) for number in range(count)]


def _claim(file: Path, text: str, what: str) -> None:
    """Write a file that identifies the folder, or raise `InputError` if it has another content."""
    if not file.exists():
        write_whole(file, text.encode())
    elif file.read_bytes() != text.encode():
        raise InputError(f"{file.parent}: expected a folder of the same {what}, got one of others")


def _made_of(plan: Plan, sequences: Sequence[PoseSequence]) -> str:
    """Hashes of what decides the pictures besides the plan, in JSON."""
    digest = hashlib.blake2b(digest_size=16)
    for sequence in sequences:
        for name, value in vars(sequence).items():
            digest.update(name.encode())
            content = value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode()
            digest.update(content)
    made = {
        "vehicle": Vehicle.load(plan.vehicle).hash,
        "cameras": hashlib.blake2b(repr(plan.views()).encode(), digest_size=16).hexdigest(),
        "poses": digest.hexdigest(),
        "mujoco": mujoco.__version__,
    }
    return json.dumps(made, indent=2) + "\n"


def _jobs(
    plan: Plan, sequences: Sequence[PoseSequence], folder: Path, longest: int
) -> Iterator[_Job]:
    """Jobs of at most so many frames, for those that are not whole."""
    start = 0  # number of the first frame of the sequence
    for index, poses in enumerate(sequences):
        for first in range(0, len(poses), longest):
            rows = range(first, min(first + longest, len(poses)))
            missing = [row for row in rows if not _is_whole(folder, start + row)]
            if missing:
                numbers = [start + row for row in missing]
                yield _Job(plan, poses.at(missing), index, numbers)
        start += len(poses)


def _is_whole(folder: Path, number: int) -> bool:
    """Whether a frame's labels are there, and all its files in their sizes."""
    try:
        labels = json.loads(label_file(folder, number).read_bytes())
        sizes = [item for picture in labels["pictures"] for item in picture["files"].items()]
        same = all((folder / file).stat().st_size == size for file, size in sizes)
        return same and labels["frame"] == number and bool(labels["pose"])
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return False


# ---- in workers


def _take(job: _Job, tell: Tell) -> list[Frame]:
    """The frames of a job."""
    from ..rendering.cameras import Cameras

    poses = job.poses
    everybody = np.ones(poses.drones, bool)
    frames = []
    opened = Cameras(
        Vehicle.load(job.plan.vehicle),
        job.plan.views(),
        (1, poses.drones),
        scene=poses.scene,
        marks=poses.marks,
        payload=poses.payload is not None,
        fine=job.plan.fine,
    )
    with closing(opened) as cameras:
        due = dict.fromkeys(cameras.pictures, everybody)
        for row in range(len(poses)):
            cameras.take(due, poses.state(row))
            frames.append(_frame(job, row, cameras))
            tell(len(frames), len(poses), "frames")
    return frames


def _frame(job: _Job, row: int, cameras: "Cameras") -> Frame:
    """Files and labels of the pictures that the cameras have just taken."""
    poses = job.poses
    number = job.numbers[row]
    state = poses.state(row)
    names = drone_names(poses.drones)
    files: dict[str, bytes] = {}
    pictures = []
    for view in cameras.views:
        # A camera that stands takes one picture for all drones.
        drones = range(poses.drones if view.camera.carried else 1)
        for drone in drones:
            suffix = f"_{drone}" if len(drones) > 1 else ""
            stem = f"{view.kind}/{view.camera.name}/{number:06}{suffix}"
            image = cameras.pictures[view.name][drone]
            encoded = {f"{stem}.{ending}": data for ending, data in _encoded(view, image)}
            files |= encoded
            lens = cameras.lens(view.name, state, drone)
            height, width = view.shape[:2]
            picture: Labels = {
                "camera": view.camera.name,
                "kind": view.kind,
                "drone": names[drone],
                "width": width,
                "height": height,
                "matrix": lens.matrix.tolist(),
                "rotation": lens.rotation.tolist(),
                "translation": lens.translation.tolist(),
                "files": {path: len(data) for path, data in encoded.items()},
            }
            if view.kind == "segmentation":
                found = objects_in(image[..., 0], cameras.objects)
                least = job.plan.least_area
                picture["objects"] = [thing for thing in found if thing["area"] >= least]
            pictures.append(picture)
    labels = {
        "frame": number,
        "sequence": job.sequence,
        "source": poses.name,
        "scene": poses.scene,
        "time": float(poses.times[row]),
        "pose": {name: values.tolist() for name, values in state.items()},
        "pictures": pictures,
    }
    return files, labels


def _encoded(view: View, image: Picture) -> Iterator[tuple[str, bytes]]:
    """Ending and bytes of the files of a picture."""
    if view.kind == "rgb":
        yield "png", _png(image)
    elif view.kind == "segmentation":
        yield "png", _png(image[..., 0].astype(np.uint16))
    else:
        data = io.BytesIO()
        np.save(data, image[..., 0])
        yield "npy", data.getvalue()
        depth = image[..., 0].astype(np.float64)
        millimetres = np.where(depth <= _FARTHEST, np.rint(1000 * depth), 0)
        yield "png", _png(millimetres.astype(np.uint16))


def _png(array: Picture) -> bytes:
    from PIL import Image

    data = io.BytesIO()
    Image.fromarray(array).save(data, "PNG")
    return data.getvalue()


def objects_in(numbers: Picture, names: Sequence[str]) -> Iterator[Labels]:
    """Objects of a segmentation picture (H, W): name, box from its mask, area, run lengths.

    The box is [left, top, width, height], pixels. Run lengths are COCO's: down each column, those
    outside first.
    """
    for number in np.unique(numbers[numbers != 0]).tolist():
        mask = numbers == number
        rows, columns = np.nonzero(mask)
        flat = np.concatenate(([False], mask.ravel(order="F")))
        edges = np.flatnonzero(flat[1:] != flat[:-1])
        runs = np.diff(np.concatenate(([0], edges, [mask.size])))
        left = int(columns.min())
        top = int(rows.min())
        yield {
            "number": number,
            "name": names[number],
            "box": [left, top, int(columns.max()) + 1 - left, int(rows.max()) + 1 - top],
            "area": len(rows),
            "runs": runs.tolist(),
        }

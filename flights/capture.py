"""Labelled pictures: `rotorgram capture` takes them in workers, and writes them as a data set.

Each frame is one pose of the drones of a world. Workers give its files as bytes; this process
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
from typing import Any, Final, NamedTuple

import mujoco
import numpy as np

from ..agents.checkpoints import write_whole
from ..models.cameras import View
from ..models.errors import expect
from ..models.swarm import drone_names
from ..models.vehicle import Vehicle
from .executors import OnProgress, Tell, WorkersConfig, open_executor, run_jobs
from .folders import locked
from .viewpoints import Plan, Walk

LABELS: Final = "labels"
_KEPT: Final = {"plan.toml": "plan", "made_of.json": "vehicle, flights and MuJoCo"}
"""Files that tell of what a folder is."""
_CHUNK: Final = 64  # frames of a job, at most
_ENDINGS: Final = {
    "rgb": ("png",), "depth": ("npy", "png"), "segmentation": ("png",), "flow": ("npy",)
}  # fmt: skip
"""Of the files of a picture of each kind."""
_DEEPEST: Final = 65.535  # m: what 16 bits of millimetres hold


@dataclass(frozen=True, kw_only=True)
class _Job:
    """Some frames of a walk, and the pose before them, if there is one."""

    plan: Plan
    walk: Walk
    """Of these poses alone."""
    sequence: int
    """Number of the whole walk."""
    first: int
    """Number of the first frame."""
    before: int
    """1 if the walk has the pose before, else 0."""


class Frame(NamedTuple):
    """What a worker made of a pose."""

    number: int
    files: dict[str, bytes]
    """By their paths in the folder."""
    labels: dict[str, Any]


def capture(
    plan: Plan, folder: Path, config: WorkersConfig, on_progress: OnProgress = lambda *_: None
) -> int:
    """Take all pictures of a plan that the folder does not have yet; the number of its frames.

    Raises `InputError` where the folder is of another plan, `OSError` where it cannot be written,
    `RunsFailed` where workers fail. What was taken stays.
    """
    from .capture_formats import write_formats

    with locked(folder):
        walks, views = plan.walks(), plan.views()
        for name, content in zip(_KEPT, (plan.text, _made_of(plan, walks, views)), strict=True):
            _keep(folder / name, content.encode())
        for left in folder.rglob(".*.tmp"):  # by a run that was killed
            left.unlink()
        jobs = {
            f"frames {job.first} to {job.first + len(job.walk) - job.before - 1}": job
            for job in _jobs(plan, walks, views, folder, config.jobs or os.cpu_count() or 1)
        }
        if jobs:
            with open_executor(config, len(jobs), on_progress) as executor:
                keep = lambda _, frames: _write(folder, frames)  # noqa: E731
                run_jobs(executor, _take, jobs, keep, on_progress)
        write_formats(plan, walks, folder)
    return sum(map(len, walks))


def _keep(file: Path, content: bytes) -> None:
    """Write a file that tells of what a folder is, or raise `InputError` if it is of another."""
    if file.exists():
        same, what = file.read_bytes() == content, _KEPT[file.name]
        expect(same, str(file.parent), f"a folder of the same {what}", "one of others")
    else:
        write_whole(file, content)


def _made_of(plan: Plan, walks: Sequence[Walk], views: Sequence[View]) -> str:
    """Hashes of what decides the pictures besides the plan, in JSON."""
    vehicle, digest = Vehicle.load(plan.vehicle), hashlib.blake2b(digest_size=16)
    for walk in walks:
        for name, value in vars(walk).items():
            digest.update(name.encode())
            digest.update(
                value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode()
            )
    made = {
        "vehicle": vehicle.hash,
        "cameras": hashlib.blake2b(repr(views).encode(), digest_size=16).hexdigest(),
        "poses": digest.hexdigest(),
        "mujoco": mujoco.__version__,
    }
    return json.dumps(made, indent=2) + "\n"


def _jobs(
    plan: Plan, walks: Sequence[Walk], views: Sequence[View], folder: Path, workers: int
) -> Iterator[_Job]:
    """Runs of frames that are not whole."""
    number, most = 0, -(-sum(map(len, walks)) // (2 * workers))
    for sequence, walk in enumerate(walks):
        drones = walk.position.shape[1]
        missing = [
            row for row in range(len(walk)) if not _is_whole(folder, number + row, views, drones)
        ]
        while missing:
            start, some = missing[0], missing[: min(most, _CHUNK)]
            count = sum(row == start + i for i, row in enumerate(some))
            before = min(start, 1)
            yield _Job(
                plan=plan, walk=walk.part(start - before, start + count), sequence=sequence,
                first=number + start, before=before,
            )  # fmt: skip
            missing = missing[count:]
        number += len(walk)


def _is_whole(folder: Path, number: int, views: Sequence[View], drones: int) -> bool:
    """Whether a frame's labels and files are there as they were written; by the files' sizes."""
    try:
        pictures = json.loads(label_file(folder, number).read_bytes())["pictures"]
        told = [(one["camera"], one["kind"], one["width"], one["height"]) for one in pictures]
        sizes = {folder / file: size for one in pictures for file, size in one["files"].items()}
        right = all(file.stat().st_size == size for file, size in sizes.items())
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return False
    wanted = [
        (view.camera.name, view.kind, *view.shape[1::-1])
        for view in views
        for _ in range(takers(view, drones))
    ]
    files = {
        folder / picture_name(view, number, drone, drones, end)
        for view in views
        for drone in range(takers(view, drones))
        for end in _ENDINGS[view.kind]
    }
    return right and told == wanted and files == sizes.keys()


def label_file(folder: Path, number: int) -> Path:
    """Of a frame."""
    return folder / LABELS / f"{number:06}.json"


def takers(view: View, drones: int) -> int:
    """How many drones of a world have pictures of their own; of one that stands, one."""
    return drones if view.camera.carried else 1


def picture_name(view: View, number: int, drone: int, drones: int, end: str) -> str:
    """Path of a picture in the folder."""
    which = f"_{drone}" if takers(view, drones) > 1 else ""
    return f"{view.kind}/{view.camera.name}/{number:06}{which}.{end}"


# ---- in workers


def _take(job: _Job, tell: Tell) -> list[Frame]:
    """The frames of a job."""
    from ..rendering.cameras import Cameras

    plan, walk = job.plan, job.walk
    drones = walk.position.shape[1]
    frames = []
    with closing(
        Cameras(
            Vehicle.load(plan.vehicle), plan.views(), (1, drones), world=walk.world,
            marks=walk.marks, payload=walk.payload is not None, fine=plan.fine,
        )
    ) as cameras:  # fmt: skip
        everybody = np.ones(drones, bool)
        for row in range(len(walk)):
            shown = row >= job.before  # the pose before is not: what flows, flows from there
            state, due = walk.state(row), dict.fromkeys(cameras.pictures, everybody & shown)
            number = job.first + row - job.before
            dice = {0: np.random.default_rng([plan.seed, 0, number])}  # sources count from 1
            cameras.take(due, everybody if row == 0 else ~everybody, state, dice.__getitem__)
            if shown:
                labels = {"frame": number, "sequence": job.sequence, "source": walk.name,
                          "world": walk.world, "time": float(walk.times[row])}  # fmt: skip
                frames.append(_frame(number, cameras, drones, state, labels, plan.least_area))
                tell(len(frames), len(walk) - job.before, "frames")
    return frames


def _frame(
    number: int,
    cameras: Any,
    drones: int,
    state: Mapping[str, np.ndarray],
    labels: Mapping[str, Any],
    least_area: int,
) -> Frame:
    """Files and labels of what cameras have just taken."""
    files: dict[str, bytes] = {}
    pictures = []
    for view in cameras.views:
        for drone in range(takers(view, drones)):
            picture = cameras.pictures[view.name][drone]
            lens = cameras.lens(view.name, state, drone)
            name = view.camera.name
            told: dict[str, Any] = {
                "camera": name, "kind": view.kind, "drone": drone_names(drones)[drone],
                "width": view.shape[1], "height": view.shape[0],
                "matrix": lens.matrix.tolist(), "rotation": lens.rotation.tolist(),
                "translation": lens.translation.tolist(),
                "distortion": list(lens.distortion),
            }  # fmt: skip
            for end, data in _encoded(view.kind, picture):
                path = picture_name(view, number, drone, drones, end)
                files[path] = data
                told.setdefault("files", {})[path] = len(data)
            if view.kind == "segmentation":
                found = objects_in(picture[..., 0], cameras.objects)
                told["objects"] = [one for one in found if one["area"] >= least_area]
            pictures.append(told)
    pose = {name: values.tolist() for name, values in state.items()}
    return Frame(number, files, {**labels, "pose": pose, "pictures": pictures})


def _encoded(kind: str, picture: np.ndarray) -> Iterator[tuple[str, bytes]]:
    """Ending and bytes of the files of a picture."""
    from PIL import Image

    if kind in ("depth", "flow"):
        data = io.BytesIO()
        np.save(data, picture[..., 0] if kind == "depth" else picture)
        yield "npy", data.getvalue()
    if kind == "flow":
        return
    if kind == "depth":
        near = picture[..., 0] <= _DEEPEST
        picture = np.where(near, np.rint(1000 * picture[..., 0].astype(np.float64)), 0)
    elif kind == "segmentation":
        picture = picture[..., 0]
    array = picture if kind == "rgb" else picture.astype(np.uint16)
    data = io.BytesIO()
    Image.fromarray(array).save(data, "PNG")
    yield "png", data.getvalue()


def objects_in(numbers: np.ndarray, names: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Objects of a segmentation picture (H, W): name, box from its mask, area, run lengths.

    The box is [left, top, width, height], pixels. Run lengths are COCO's: down each column, those
    outside first.
    """
    for number in np.unique(numbers).tolist():
        if number == 0:
            continue
        mask = numbers == number
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        flat = np.concatenate(([False], mask.ravel(order="F")))
        edges = np.flatnonzero(flat[1:] != flat[:-1])
        runs = np.diff(np.concatenate(([0], edges, [mask.size])))
        yield {
            "number": number,
            "name": names[number],
            "box": [
                int(columns[0]), int(rows[0]),
                int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1,
            ],
            "area": int(mask.sum()),
            "runs": runs.tolist(),
        }  # fmt: skip


# ---- files


def _write(folder: Path, frames: Iterable[Frame]) -> None:
    """Write frames, the labels of each last."""
    for frame in frames:
        for name, data in frame.files.items():
            write_whole(folder / name, data)
        labels = json.dumps(frame.labels, separators=(",", ":"))
        write_whole(label_file(folder, frame.number), labels.encode())


def read_labels(folder: Path, count: int) -> list[dict[str, Any]]:
    """Labels of so many frames in their order; all of them have to be whole."""
    files = (label_file(folder, number) for number in range(count))
    return [json.loads(file.read_bytes()) for file in files]

"""Labelled pictures: `rotorgram capture` takes them in workers, and writes them as a data set.

Each frame is one pose of the drones of a world. Workers give its files as bytes; this process
writes them, the labels last: a frame that has labels is whole, and is never taken again.
`docs/capture.md` has the layout.
"""

import io
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from ..models.errors import InputError, expect
from ..models.fleet import load_vehicles
from ..models.swarm import drone_names
from .folders import locked
from .settings import WorkersConfig
from .viewpoints import Plan, Walk
from .workers import OnProgress, Tell, open_workers

PLAN_FILE: Final = "plan.toml"
LABELS: Final = "labels"
_CHUNK: Final = 16  # frames of a job
_ENDINGS: Final = {
    "rgb": ("png",), "depth": ("npy", "png"), "segmentation": ("png",), "flow": ("npy",)
}  # fmt: skip
"""Of the files of a picture of each kind."""
_DEEPEST: Final = 65.535  # m: what 16 bits of millimetres hold


@dataclass(frozen=True, kw_only=True)
class _Job:
    """Some frames of a walk, whose first pose has a number."""

    plan: Plan
    walk: Walk
    first: int
    rows: range


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
        _keep_plan(plan, folder)
        walks = plan.walks()
        for name in ("rgb", "depth", "segmentation", LABELS):
            (folder / name).mkdir(exist_ok=True)
        jobs = {
            f"frames {job.first + job.rows[0]} to {job.first + job.rows[-1]}": job
            for job in _jobs(plan, walks, folder)
        }
        if jobs:
            with open_workers(config, on_progress) as workers:
                workers.fly_all(_take, jobs, lambda _, frames: _write(folder, frames))
        write_formats(plan, walks, folder)
    return sum(map(len, walks))


def _keep_plan(plan: Plan, folder: Path) -> None:
    """Write the plan, or raise `InputError` if the folder has another."""
    file = folder / PLAN_FILE
    if file.exists():
        same = file.read_text(encoding="utf-8") == plan.text
        expect(same, str(folder), "a folder of the same plan", "one of another")
        return
    write_whole(file, plan.text.encode())


def _jobs(plan: Plan, walks: Sequence[Walk], folder: Path) -> Iterator[_Job]:
    """Runs of frames of which a file is missing."""
    number, views = 0, plan.views()
    for walk in walks:
        drones = walk.position.shape[1]
        missing = []
        for row in range(len(walk)):
            files = [label_file(folder, number + row)]
            for view in views:
                files += [
                    folder / picture_name(view.kind, view.camera.name, number + row, i, drones, end)
                    for i in range(drones)
                    for end in _ENDINGS[view.kind]
                ]
            if not all(file.exists() for file in files):
                missing.append(row)
        while missing:
            start = missing[0]
            run = [i for k, i in enumerate(missing[:_CHUNK]) if i == start + k]
            yield _Job(plan=plan, walk=walk, first=number, rows=range(start, start + len(run)))
            missing = missing[len(run) :]
        number += len(walk)


def label_file(folder: Path, number: int) -> Path:
    """Of a frame."""
    return folder / LABELS / f"{number:06}.json"


def picture_name(kind: str, camera: str, number: int, drone: int, drones: int, end: str) -> str:
    """Path of a picture in the folder."""
    which = f"_{drone}" if drones > 1 else ""
    return f"{kind}/{camera}/{number:06}{which}.{end}"


# ---- in workers


def _take(job: _Job, tell: Tell) -> list[Frame]:
    """The frames of a job."""
    from ..rendering.cameras import Cameras

    plan, walk = job.plan, job.walk
    drones = walk.position.shape[1]
    vehicle = load_vehicles(plan.vehicle, drones)
    frames = []
    with closing(
        Cameras(
            vehicle, plan.views(), (1, drones), world=walk.world,
            marks=walk.marks, payload=walk.payload is not None, fine=plan.fine,
        )
    ) as cameras:  # fmt: skip
        everybody = np.ones(drones, bool)
        if start := job.rows[0]:  # the pose before: what flows, flows from there
            cameras.take(dict.fromkeys(cameras.pictures, ~everybody), ~everybody,
                         walk.state(start - 1))  # fmt: skip
        for row in job.rows:
            state, due = walk.state(row), dict.fromkeys(cameras.pictures, everybody)
            dice = {0: np.random.default_rng([plan.seed, 0, job.first + row])}  # sources: from 1
            cameras.take(due, everybody if row == 0 else ~everybody, state, dice.__getitem__)
            frames.append(_frame(job.first + row, cameras, drones, state))
            tell(row - start + 1, len(job.rows), "frames")
    return frames


def _frame(number: int, cameras: Any, drones: int, state: Mapping[str, np.ndarray]) -> Frame:
    """Files and labels of what cameras have just taken."""
    files: dict[str, bytes] = {}
    pictures = []
    for view in cameras.views:
        for drone in range(drones):
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
                path = picture_name(view.kind, name, number, drone, drones, end)
                files[path] = data
                told.setdefault("files", []).append(path)
            if view.kind == "segmentation":
                told["objects"] = list(objects_in(picture[..., 0], cameras.objects))
            pictures.append(told)
    pose = {name: values.tolist() for name, values in state.items()}
    return Frame(number, files, {"frame": number, "pose": pose, "pictures": pictures})


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
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            write_whole(folder / name, data)
        labels = json.dumps(frame.labels, separators=(",", ":"))
        write_whole(label_file(folder, frame.number), labels.encode())


def write_whole(path: Path, data: bytes) -> None:
    """Write a file: after a crash at any moment it is whole, or as before. Raises `OSError`."""
    unfinished = path.with_name(f".{path.name}.part")
    try:
        unfinished.write_bytes(data)
        os.replace(unfinished, path)
    except OSError as error:
        with suppress(OSError):
            unfinished.unlink()
        raise OSError(error.errno, error.strerror, str(path)) from None


def read_labels(folder: Path) -> list[dict[str, Any]]:
    """Labels of all frames in their order. Raises `InputError`."""
    found = []
    for file in sorted((folder / LABELS).glob("[0-9]*.json")):
        try:
            labels = json.loads(file.read_text(encoding="utf-8"))
        except ValueError as error:
            raise InputError(f"{file}: expected labels of a frame, got {error}") from None
        right = isinstance(labels, dict) and {"frame", "pose", "pictures"} <= labels.keys()
        expect(right, str(file), "labels of a frame", "others; without this file it is made anew")
        found.append(labels)
    return found

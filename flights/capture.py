"""Labelled pictures: `rotorgram capture` takes them in workers, and writes them as a data set.

Each frame is one pose of the drones of a world. Workers return its files as bytes; this process
writes them, the labels last. `docs/capture.md` has the layout.
"""

import io
import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..models.cameras import View
from ..models.files import software_versions, write_whole
from ..models.swarm import drone_names
from ..models.vehicle import Vehicle
from ..rendering.cameras import Cameras
from .executors import OnProgress, Tell, WorkersConfig, open_executor, run_jobs
from .folders import new_folder
from .viewpoints import CaptureConfig, PoseSequence, sequences_of

_MOST_FRAMES = 64  # of a job
Picture = NDArray[np.generic]
Labels = dict[str, Any]
"""The labels of one frame or picture: an object of JSON."""
_view = itemgetter("camera", "drone", "width", "height")
"""What the pictures of one view share."""


class _Job(NamedTuple):
    """Some frames of a sequence, one after the other."""

    config: CaptureConfig
    poses: PoseSequence
    sequence: int
    """Number of the sequence."""
    start: int
    """Number of its first frame."""
    rows: range
    """Poses of the frames."""


class _Taken(NamedTuple):
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
    on_progress: OnProgress = lambda *_: None,
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
    longest = min(_MOST_FRAMES, -(-count // (2 * processes)))
    jobs: dict[str, _Job] = {}
    start = 0
    for number, poses in enumerate(sequences):
        for first in range(0, len(poses), longest):
            rows = range(first, min(first + longest, len(poses)))
            job = _Job(config, poses, number, start, rows)
            jobs[f"frames from {start + first} on"] = job
        start += len(poses)
    objects = set[str]()
    labels: list[Labels] = []

    def keep(_: _Job, taken: _Taken) -> None:
        objects.update(taken.objects)
        for files, own in taken.frames:
            for name, data in files.items():
                write_whole(folder / name, data)
            text = json.dumps(own, separators=(",", ":"))
            write_whole(folder / "labels" / f"{own['frame']:06}.json", text)
            labels.append(own)

    with open_executor(workers, len(jobs), on_progress) as executor:
        run_jobs(executor, _take, jobs, keep, on_progress)
    labels.sort(key=lambda own: own["frame"])
    vehicle_hash = Vehicle.load(config.vehicle).hash
    made = {**asdict(config), "vehicle_hash": vehicle_hash, "versions": software_versions()}
    write_coco(labels, objects, made, folder / "coco.json")
    return count


# ---- in workers


def _take(job: _Job, tell: Tell) -> _Taken:
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
            frames.append(_frame(job, row, cameras))
            tell(len(frames), len(job.rows), "frames")
        return _Taken(cameras.objects[1:], frames)  # the first is no object


def _frame(job: _Job, row: int, cameras: Cameras) -> tuple[dict[str, bytes], Labels]:
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
            ending, data = _encoded(view, image)
            file = f"{view.kind}/{view.camera.name}/{number:06}{suffix}.{ending}"
            files[file] = data
            lens = cameras.lens(view.name, state, drone)
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


def _encoded(view: View, image: Picture) -> tuple[str, bytes]:
    """Ending and bytes of the file of a picture."""
    from PIL import Image

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
        colors = {_view(one): one["file"] for one in pictures if one["kind"] == "rgb"}
        for picture in pictures:
            if picture["kind"] != "segmentation":
                continue
            # An image is named by the colours of its camera in the same size, if there are any.
            image = {
                "id": len(images) + 1,
                "file_name": colors.get(_view(picture), picture["file"]),
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


def category(name: str) -> str:
    """Kind of an object: its name without numbers, as forest/tree of forest/tree_12."""
    return re.sub(r"_\d+\b", "", name)

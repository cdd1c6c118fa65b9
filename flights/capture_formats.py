"""A capture's folder for those who read it: COCO, poses as KITTI's, LeRobot's layout, a sheet of
pictures to look at, a datasheet. All is made anew from the pictures and the labels of the frames.
"""

import io
import json
import re
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from ..agents.checkpoints import software_versions, write_whole
from ..models.vehicle import Vehicle
from ..rendering.seen import NOTHING, objects_of
from .capture import read_labels
from .capture_lerobot import write_lerobot
from .viewpoints import Plan, Walk

_SHOWN: Final = 8  # frames on the contact sheet
_THUMB: Final = 160  # pixels: width of a picture on it


def write_formats(plan: Plan, walks: Sequence[Walk], folder: Path) -> None:
    """Write all of them. Raises `OSError`, and `InputError` where one is in the way."""
    labels = read_labels(folder, sum(map(len, walks)))
    _write_json(folder / "coco.json", coco(labels, _categories(plan, walks)))
    _write_kitti(folder, labels)
    write_lerobot(folder, plan, walks)
    _write_sheet(folder, labels)
    write_whole(folder / "README.md", datasheet(plan, walks, labels).encode())


def category(name: str) -> str:
    """Kind of an object: its name without the numbers that tell it from its like."""
    return re.sub(r"_\d+\b", "", name)


# ---- COCO


def _categories(plan: Plan, walks: Sequence[Walk]) -> list[str]:
    """Kinds of all objects that there are, seen or not, in the order of the alphabet."""
    vehicle, kinds = Vehicle.load(plan.vehicle), set[str]()
    worlds = {
        (walk.position.shape[1], walk.world, walk.marks, walk.payload is not None) for walk in walks
    }
    for drones, world, marks, payload in worlds:
        kinds |= {*map(category, objects_of(vehicle, drones, world, marks, payload=payload))}
    return sorted(kinds - {NOTHING})


def coco(labels: Sequence[Mapping[str, Any]], categories: Sequence[str]) -> dict[str, Any]:
    """The objects in all segmentation pictures, as COCO's object detection has them.

    A picture is named by the colours of its camera in the same size, else by its objects.
    """
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    numbers = {kind: number for number, kind in enumerate(categories, 1)}
    for frame in labels:
        names = {
            _taken(one): file
            for one in frame["pictures"]
            for file in one["files"]
            if one["kind"] == "rgb"
        }
        for one in frame["pictures"]:
            if one["kind"] != "segmentation":
                continue
            size = {"width": one["width"], "height": one["height"]}
            (file,) = one["files"]
            where = {"file_name": names.get(_taken(one), file), "sequence": frame["sequence"]}
            images.append({"id": len(images) + 1, **where, **size})
            for thing in one["objects"]:
                annotations.append(
                    {
                        "id": len(annotations) + 1,
                        "image_id": len(images),
                        "category_id": numbers[category(thing["name"])],
                        "bbox": thing["box"],
                        "area": thing["area"],
                        "iscrowd": 0,
                        "segmentation": {
                            "size": [one["height"], one["width"]], "counts": thing["runs"]
                        },
                        "object": thing["name"],
                    }
                )  # fmt: skip
    kinds = [{"id": number, "name": name} for name, number in numbers.items()]
    return {"images": images, "annotations": annotations, "categories": kinds}


def _taken(picture: Mapping[str, Any]) -> tuple[Any, ...]:
    """By whom, and in which size."""
    return tuple(picture[key] for key in ("camera", "drone", "width", "height"))


# ---- KITTI


def _write_kitti(folder: Path, labels: Sequence[Mapping[str, Any]]) -> None:
    """poses/SEQUENCE_CAMERA_DRONE.txt: [R | t] from the camera to the world, 12 numbers for each
    frame; calib.txt: the projection of each picture of each drone.
    """
    shutil.rmtree(folder / "poses", ignore_errors=True)
    (folder / "poses").mkdir()
    poses: dict[str, dict[int, str]] = {}
    projections: dict[str, str] = {}
    for frame in labels:
        for one in frame["pictures"]:
            rotation, translation = np.array(one["rotation"]).T, np.array(one["translation"])
            pose = _row(np.column_stack((rotation, -rotation @ translation)))
            name = f"{frame['sequence']:03}_{one['camera']}_{one['drone']}"
            poses.setdefault(name, {})[frame["frame"]] = pose
            kind = "" if one["kind"] == "rgb" else f"_{one['kind']}"
            matrix = np.column_stack((np.array(one["matrix"]), np.zeros(3)))
            projections[f"P_{one['camera']}{kind}_{one['drone']}"] = _row(matrix)
    for name, lines in poses.items():
        text = "".join(f"{line}\n" for line in lines.values())
        write_whole(folder / "poses" / f"{name}.txt", text.encode())
    text = "".join(f"{name}: {numbers}\n" for name, numbers in projections.items())
    write_whole(folder / "calib.txt", text.encode())


def _row(matrix: np.ndarray) -> str:
    return " ".join(f"{value:.9g}" for value in matrix.ravel())


# ---- to look at


def _write_sheet(folder: Path, labels: Sequence[Mapping[str, Any]]) -> None:
    """contact.png: some frames from the first to the last, a row each, with all their pictures."""
    from PIL import Image

    from ..rendering.cameras import shown

    chosen = np.unique(np.linspace(0, len(labels) - 1, _SHOWN).round().astype(int)).tolist()
    rows = []
    for number in chosen:
        row = []
        for one in labels[number]["pictures"]:
            path = folder / next(iter(one["files"]))
            if path.suffix == ".npy":
                picture = np.load(path)
            else:
                with Image.open(path) as image:
                    picture = np.asarray(image)
            picture = picture.reshape(one["height"], one["width"], -1)
            small = Image.fromarray(shown(one["kind"], picture))
            height = max(round(_THUMB * one["height"] / one["width"]), 1)
            row.append(np.asarray(small.resize((_THUMB, height))))
        tall = max(picture.shape[0] for picture in row)
        row = [np.pad(p, ((0, tall - p.shape[0]), (0, 0), (0, 0))) for p in row]
        rows.append(np.hstack(row))
    wide = max(row.shape[1] for row in rows)
    rows = [np.pad(row, ((0, 0), (0, wide - row.shape[1]), (0, 0))) for row in rows]
    data = io.BytesIO()
    Image.fromarray(np.vstack(rows)).save(data, "PNG")
    write_whole(folder / "contact.png", data.getvalue())


def datasheet(plan: Plan, walks: Sequence[Walk], labels: Sequence[Mapping[str, Any]]) -> str:
    """README.md: what the folder has, where it comes from, what it does not have."""
    pictures: Counter[str] = Counter()
    objects: Counter[str] = Counter()
    for frame in labels:
        for one in frame["pictures"]:
            pictures[f"{one['kind']} of {one['camera']}, {one['width']} × {one['height']}"] += 1
            objects.update(category(thing["name"]) for thing in one.get("objects", ()))
    vehicle = Vehicle.load(plan.vehicle)
    sources = Counter[str]()
    for walk in walks:
        sources[f"{walk.name}, world `{walk.world}`"] += len(walk)
    versions = ", ".join(f"{name} {number}" for name, number in software_versions().items())
    return "\n".join(
        [
            "# Labelled pictures of drones",
            "",
            f"{len(labels)} frames of {vehicle.name} (model {vehicle.hash[:8]}), seed "
            f"{plan.seed}. Every label is computed from the state that the "
            "picture shows.",
            "",
            "| frames | from |",
            "|---:|---|",
            *(f"| {count} | {name} |" for name, count in sources.items()),
            "",
            "| pictures | of |",
            "|---:|---|",
            *(f"| {count} | {name} |" for name, count in sorted(pictures.items())),
            "",
            "| boxes | of |",
            "|---:|---|",
            *(f"| {count} | {name} |" for name, count in objects.most_common()),
            "",
            _LAYOUT,
            "Drawn by MuJoCo's renderer: not photographs. Rotors do not turn; there is no motion "
            "blur. The plan's cameras have what lens distortion, noise and readout their file "
            "tells.",
            "",
            f"Software: {versions}.",
            "",
            "## plan.toml",
            "",
            "```toml",
            plan.text.strip(),
            "```",
            "",
        ]
    )


_LAYOUT: Final = """\
| file | content |
|---|---|
| `rgb/CAMERA/FRAME.png` | colours |
| `depth/CAMERA/FRAME.npy`, `.png` | m along the axis, float32; mm, 16 bits, 0 beyond 65.535 m |
| `segmentation/CAMERA/FRAME.png` | numbers of objects, 16 bits; `labels` has their names |
| `flow/CAMERA/FRAME.npy` | pixels right and down since the pose before, float32 |
| `labels/FRAME.json` | source, time, poses (MuJoCo's frame, m), lenses, boxes and masks |
| `coco.json` | boxes and masks of all objects, as COCO has them |
| `poses/SEQUENCE_CAMERA_DRONE.txt` | camera to world, 3 × 4 by rows, a line for each frame |
| `calib.txt` | projections, 3 × 4 by rows, for points of a camera's frame |
| `lerobot/` | Parquet and MP4, as LeRobot has them |
| `contact.png` | some frames to look at |
"""


def _write_json(path: Path, content: Any) -> None:
    write_whole(path, (json.dumps(content, separators=(",", ":")) + "\n").encode())

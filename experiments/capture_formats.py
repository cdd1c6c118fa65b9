"""A capture's folder for those who read it: COCO, KITTI-like poses, LeRobot's layout, a sheet of
pictures to look at, a datasheet. All is made anew from the pictures and the labels of the frames.
"""

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from ..agents.checkpoints import software_versions
from ..models.vehicle import Vehicle
from .capture import read_labels, write_whole
from .capture_lerobot import write_lerobot
from .viewpoints import Plan, Walk

_SHOWN: Final = 8  # frames on the contact sheet
_THUMB: Final = 160  # pixels: width of a picture on it


def write_formats(plan: Plan, walks: Sequence[Walk], folder: Path) -> None:
    """Write all of them. Raises `OSError`."""
    labels = read_labels(folder)
    _write_json(folder / "coco.json", coco(labels))
    _write_kitti(folder, labels)
    write_lerobot(folder, plan, walks)
    _write_sheet(folder, labels)
    write_whole(folder / "README.md", datasheet(plan, walks, labels).encode())


def category(name: str) -> str:
    """Kind of an object: its name without the numbers that tell it from its like."""
    return re.sub(r"_\d+\b", "", name)


# ---- COCO


def coco(labels: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The objects in all segmentation pictures, as COCO's object detection has them.

    A picture is named by its colours where there are any, else by its objects.
    """
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    kinds: dict[str, int] = {}
    for frame in labels:
        names = {
            (one["camera"], one["drone"]): one["files"][-1]
            for one in frame["pictures"]
            if one["kind"] == "rgb"
        }
        for one in frame["pictures"]:
            if one["kind"] != "segmentation":
                continue
            size = {"width": one["width"], "height": one["height"]}
            file = names.get((one["camera"], one["drone"]), one["files"][-1])
            images.append({"id": len(images) + 1, "file_name": file, **size})
            for thing in one["objects"]:
                kind = category(thing["name"])
                annotations.append(
                    {
                        "id": len(annotations) + 1,
                        "image_id": len(images),
                        "category_id": kinds.setdefault(kind, len(kinds) + 1),
                        "bbox": thing["box"],
                        "area": thing["area"],
                        "iscrowd": 1,  # which is how COCO marks run lengths
                        "segmentation": {
                            "size": [one["height"], one["width"]], "counts": thing["runs"]
                        },
                        "object": thing["name"],
                    }
                )  # fmt: skip
    categories = [{"id": number, "name": name} for name, number in kinds.items()]
    return {"images": images, "annotations": annotations, "categories": categories}


# ---- KITTI


def _by_camera(labels: Sequence[Mapping[str, Any]]) -> dict[tuple[str, str], list[dict[str, Any]]]:
    """Pictures of each camera of each drone, one for each frame, in their order."""
    found: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for frame in labels:
        seen = set()
        for one in frame["pictures"]:
            key = one["camera"], one["drone"]
            if key not in seen:
                seen.add(key)
                found.setdefault(key, []).append(one)
    return found


def _write_kitti(folder: Path, labels: Sequence[Mapping[str, Any]]) -> None:
    """poses/CAMERA.txt: [R | t] from the camera to the world, 12 numbers for each frame; calib.txt:
    the projection of each camera.
    """
    (folder / "poses").mkdir(exist_ok=True)
    projections = {}
    for (camera, drone), pictures in _by_camera(labels).items():
        lines = []
        for one in pictures:
            rotation, translation = np.array(one["rotation"]).T, np.array(one["translation"])
            matrix = np.column_stack((rotation, -rotation @ translation))
            lines.append(" ".join(f"{value:.9g}" for value in matrix.ravel()))
        write_whole(folder / "poses" / f"{camera}_{drone}.txt", ("\n".join(lines) + "\n").encode())
        matrix = np.column_stack((np.array(pictures[0]["matrix"]), np.zeros(3)))
        projections[camera] = " ".join(f"{value:.9g}" for value in matrix.ravel())
    text = "".join(f"P_{camera}: {numbers}\n" for camera, numbers in projections.items())
    write_whole(folder / "calib.txt", text.encode())


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
            path = folder / one["files"][0]
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
    Image.fromarray(np.vstack(rows)).save(folder / "contact.png")


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
| `labels/FRAME.json` | pose (MuJoCo's frame, m), lenses, objects with boxes and masks |
| `coco.json` | boxes and masks of all objects, as COCO has them |
| `poses/CAMERA_DRONE.txt`, `calib.txt` | camera to world, 3 × 4 by rows, and K, as KITTI has them |
| `lerobot/` | Parquet and MP4, as LeRobot has them |
| `contact.png` | some frames to look at |
"""


def _write_json(path: Path, content: Any) -> None:
    write_whole(path, (json.dumps(content, separators=(",", ":")) + "\n").encode())

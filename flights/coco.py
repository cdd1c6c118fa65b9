"""The objects of a capture in COCO's format of object detection."""

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..agents.checkpoints import write_whole
from ..models.vehicle import Vehicle
from ..rendering.camera_model import NOTHING, objects_of
from .viewpoints import Plan, PoseSequence

Labels = Mapping[str, Any]
"""The labels of one frame: the content of its JSON file."""


def write_coco(
    plan: Plan, sequences: Sequence[PoseSequence], labels: Sequence[Labels], file: Path
) -> None:
    """Write the objects of all segmentation pictures. Raises `OSError`."""
    content = coco(labels, _categories(plan, sequences))
    text = json.dumps(content, separators=(",", ":")) + "\n"
    write_whole(file, text.encode())


def category(name: str) -> str:
    """Kind of an object: its name without numbers, as forest/tree of forest/tree_12."""
    return re.sub(r"_\d+\b", "", name)


def _categories(plan: Plan, sequences: Sequence[PoseSequence]) -> list[str]:
    """Sorted kinds of all objects of the scenes, seen or not."""
    vehicle = Vehicle.load(plan.vehicle)
    kinds = set[str]()
    for drones, world, marks, payload in {sequence.stage for sequence in sequences}:
        names = objects_of(vehicle, drones, world, marks, payload=payload)
        kinds.update(map(category, names))
    return sorted(kinds - {NOTHING})


def coco(labels: Sequence[Labels], categories: Sequence[str]) -> dict[str, Any]:
    """COCO's tables: images with their time and sequence, annotations and categories.

    An image is named by the colours of its camera in the same size, or else by its segmentation.
    """
    numbers = {kind: number for number, kind in enumerate(categories, 1)}
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for frame in labels:
        colours = {
            _identity(picture): next(iter(picture["files"]))
            for picture in frame["pictures"]
            if picture["kind"] == "rgb"
        }
        for picture in frame["pictures"]:
            if picture["kind"] != "segmentation":
                continue
            (file,) = picture["files"]
            image = {
                "id": len(images) + 1,
                "file_name": colours.get(_identity(picture), file),
                "width": picture["width"],
                "height": picture["height"],
                "sequence": frame["sequence"],
                "time": frame["time"],
            }
            images.append(image)
            for thing in picture["objects"]:
                annotation = {
                    "id": len(annotations) + 1,
                    "image_id": image["id"],
                    "category_id": numbers[category(thing["name"])],
                    "bbox": thing["box"],
                    "area": thing["area"],
                    "iscrowd": 0,
                    "segmentation": {
                        "size": [picture["height"], picture["width"]],
                        "counts": thing["runs"],
                    },
                    "object": thing["name"],
                }
                annotations.append(annotation)
    kinds = [{"id": number, "name": name} for name, number in numbers.items()]
    return {"images": images, "annotations": annotations, "categories": kinds}


def _identity(picture: Labels) -> tuple[Any, ...]:
    """Camera, drone and size, which the pictures of one view share."""
    return tuple(picture[key] for key in ("camera", "drone", "width", "height"))

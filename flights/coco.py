"""The objects of a capture in COCO's format of object detection."""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..agents.checkpoints import write_whole
from ..models.vehicle import Vehicle
from ..rendering.camera_model import NOTHING, objects_of
from .viewpoints import Plan, PoseSequence

Labels = dict[str, Any]
"""The labels of one frame or picture: an object of JSON."""
_SAME_VIEW = ("camera", "drone", "width", "height")


def write_coco(
    plan: Plan, sequences: Sequence[PoseSequence], frames: Sequence[Labels], file: Path
) -> None:
    """Write the objects of all segmentation pictures, with the labels of all frames.

    The categories are the kinds of all objects of the scenes, seen or not. Raises `OSError`.
    """
    vehicle = Vehicle.load(plan.vehicle)
    kinds = set[str]()
    stages = {(one.drones, one.scene, one.marks, one.payload is not None) for one in sequences}
    for drones, scene, marks, payload in stages:
        names = objects_of(vehicle, drones, scene, marks, payload=payload)
        kinds.update(map(category, names))
    categories = {kind: number for number, kind in enumerate(sorted(kinds - {NOTHING}), 1)}
    images: list[Labels] = []
    annotations: list[Labels] = []
    for frame in frames:
        colors: dict[tuple[object, ...], str] = {}
        for picture in frame["pictures"]:
            if picture["kind"] == "rgb":
                (file_name,) = picture["files"]
                colors[_view(picture)] = file_name
        for picture in frame["pictures"]:
            if picture["kind"] != "segmentation":
                continue
            # An image is named by the colours of its camera in the same size, if there are any.
            (own,) = picture["files"]
            image = {
                "id": len(images) + 1,
                "file_name": colors.get(_view(picture), own),
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
        "images": images,
        "annotations": annotations,
        "categories": [{"id": number, "name": name} for name, number in categories.items()],
    }
    write_whole(file, json.dumps(content, separators=(",", ":")).encode() + b"\n")


def category(name: str) -> str:
    """Kind of an object: its name without numbers, as forest/tree of forest/tree_12."""
    return re.sub(r"_\d+\b", "", name)


def _view(picture: Labels) -> tuple[object, ...]:
    """Camera, drone and size, which the pictures of one view share."""
    return tuple(picture[key] for key in _SAME_VIEW)

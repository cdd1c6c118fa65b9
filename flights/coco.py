"""The objects of a capture in COCO's format of object detection."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..models.files import write_whole

Labels = dict[str, Any]
"""The labels of one frame or picture: an object of JSON."""
_SAME_VIEW = ("camera", "drone", "width", "height")


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
    write_whole(file, json.dumps(content, separators=(",", ":")).encode() + b"\n")


def category(name: str) -> str:
    """Kind of an object: its name without numbers, as forest/tree of forest/tree_12."""
    return re.sub(r"_\d+\b", "", name)


def _view(picture: Labels) -> tuple[object, ...]:
    """Camera, drone and size, which the pictures of one view share."""
    return tuple(picture[key] for key in _SAME_VIEW)

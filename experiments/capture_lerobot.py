"""LeRobot's layout of a captured data set: Parquet, MP4 and statistics, version 2.1.

An episode is a flight of one drone, or the random places of a source.
"""

import json
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from ..models.cameras import View
from ..models.errors import require
from .capture import picture_name, write_whole
from .viewpoints import Plan, Walk

_VERSION: Final = "v2.1"
_STATE: Final = ("x", "y", "z", "qw", "qx", "qy", "qz")
_VIDEO: Final = "observation.images."
_NUMBERS: Final = ("frame_index", "episode_index", "index", "task_index")


def write_lerobot(folder: Path, plan: Plan, walks: Sequence[Walk]) -> None:
    """Write `lerobot/`. Raises `OSError`.

    Where all poses are of flights with the same actions, a frame has what was flown from there, and
    the last of a flight, from which nothing was, is left out.
    """
    pyarrow: Any = require("pyarrow", "dataset", "LeRobot's layout")
    from pyarrow import parquet

    from ..rendering.film import QUALITY, write_film

    root, cameras = folder / "lerobot", [view for view in plan.views() if view.kind == "rgb"]
    shutil.rmtree(root, ignore_errors=True)
    for name in ("meta", "data/chunk-000", "videos/chunk-000"):
        (root / name).mkdir(parents=True)
    named = {walk.components for walk in walks}
    components = named.pop() if len(named) == 1 else ()
    tasks = list(dict.fromkeys(walk.name for walk in walks))
    first = index = 0
    episodes: list[dict[str, Any]] = []
    statistics: list[dict[str, Any]] = []
    for walk in walks:
        drones = walk.position.shape[1]
        for drone in range(drones):
            columns = _columns(walk, drone, bool(components))
            count, number = len(columns["observation.state"]), len(episodes)
            columns |= {
                "timestamp": (np.arange(count) / plan.fps).astype(np.float32),
                "frame_index": np.arange(count),
                "episode_index": np.full(count, number),
                "index": np.arange(index, index + count),
                "task_index": np.full(count, tasks.index(walk.name)),
            }
            told = {name: _spread(values) for name, values in columns.items()}
            table = pyarrow.table({name: list(values) for name, values in columns.items()})
            episode = f"chunk-000/episode_{number:06}"
            parquet.write_table(table, root / "data" / f"{episode}.parquet")
            for view in cameras:
                chunk, _, file = episode.partition("/")
                video = root / "videos" / chunk / f"{_VIDEO}{view.name}" / f"{file}.mp4"
                video.parent.mkdir(exist_ok=True)
                pictures = _Pictures(
                    folder / picture_name("rgb", view.name, first + i, drone, drones, "png")
                    for i in range(count)
                )
                write_film(video, pictures, plan.fps, quality=QUALITY)
                told[f"{_VIDEO}{view.name}"] = pictures.spread()
            episodes.append({"episode_index": number, "tasks": [walk.name], "length": count})
            statistics.append({"episode_index": number, "stats": told})
            index += count
        first += len(walk)
    info = _info(plan, cameras, components, episodes, len(tasks))
    write_whole(root / "meta" / "info.json", (json.dumps(info) + "\n").encode())
    named_tasks = [{"task_index": i, "task": task} for i, task in enumerate(tasks)]
    for name, rows in {
        "episodes": episodes, "episodes_stats": statistics, "tasks": named_tasks
    }.items():  # fmt: skip
        text = "".join(json.dumps(row) + "\n" for row in rows)
        write_whole(root / "meta" / f"{name}.jsonl", text.encode())


def _columns(walk: Walk, drone: int, acts: bool) -> dict[str, np.ndarray]:
    """State, time and action of a drone, a row for each frame."""
    states = np.concatenate((walk.position[:, drone], walk.quaternion[:, drone]), axis=1)
    columns = {"observation.state": states.astype(np.float32), "time": walk.times}
    if not acts or walk.actions is None:
        return columns
    flown = ~np.isnan(walk.actions[:, drone]).any(axis=1)
    columns["action"] = walk.actions[:, drone].astype(np.float32)
    return {name: values[flown] for name, values in columns.items()}


class _Pictures:
    """Pictures of files, one after the other, and the spread of their colours."""

    def __init__(self, paths: Iterable[Path]) -> None:
        self._paths = paths
        self._each: list[np.ndarray] = []

    def __iter__(self) -> Iterator[np.ndarray]:
        from PIL import Image

        for path in self._paths:
            with Image.open(path) as image:
                picture = np.asarray(image.convert("RGB"))
            share = picture.reshape(-1, 3) / 255
            means = share.mean(axis=0), (share**2).mean(axis=0)
            self._each.append(np.array((share.min(axis=0), share.max(axis=0), *means)))
            yield picture

    def spread(self) -> dict[str, Any]:
        """As `_spread`, of each colour, 0 to 1, shape (3, 1, 1)."""
        low, high, mean, square = np.array(self._each).transpose(1, 0, 2)
        middle = mean.mean(axis=0)
        deviation = np.sqrt(np.maximum(square.mean(axis=0) - middle**2, 0.0))
        told = {"min": low.min(axis=0), "max": high.max(axis=0), "mean": middle, "std": deviation}
        return {
            **{name: values.reshape(3, 1, 1).tolist() for name, values in told.items()},
            "count": [len(self._each)],
        }


def _spread(values: np.ndarray) -> dict[str, Any]:
    """Statistics of a column, of each number by itself."""
    rows = values.reshape(len(values), -1).astype(np.float64)
    told = {"min": rows.min(axis=0), "max": rows.max(axis=0), "mean": rows.mean(axis=0)}
    told["std"] = rows.std(axis=0)
    return {**{name: row.tolist() for name, row in told.items()}, "count": [len(rows)]}


def _info(
    plan: Plan,
    cameras: Sequence[View],
    components: Sequence[str],
    episodes: Sequence[Mapping[str, Any]],
    tasks: int,
) -> dict[str, Any]:
    """LeRobot's meta/info.json."""
    features: dict[str, Any] = {
        "observation.state": {"dtype": "float32", "shape": [len(_STATE)], "names": list(_STATE)},
        "time": {"dtype": "float64", "shape": [1], "names": None},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
        **{name: {"dtype": "int64", "shape": [1], "names": None} for name in _NUMBERS},
    }
    if components:
        names = list(components)
        features["action"] = {"dtype": "float32", "shape": [len(names)], "names": names}
    for view in cameras:
        features[f"{_VIDEO}{view.name}"] = {
            "dtype": "video", "shape": list(view.shape), "names": ["height", "width", "channel"],
            "info": {"video.fps": plan.fps, "video.codec": "h264", "video.pix_fmt": "yuv420p",
                     "video.is_depth_map": False, "has_audio": False},
        }  # fmt: skip
    return {
        "codebase_version": _VERSION,
        "robot_type": plan.vehicle or "paper",
        "total_episodes": len(episodes),
        "total_frames": sum(one["length"] for one in episodes),
        "total_tasks": tasks,
        "total_videos": len(episodes) * len(cameras),
        "total_chunks": 1,
        "chunks_size": max(len(episodes), 1000),
        "fps": plan.fps,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/"
        "episode_{episode_index:06d}.mp4",
        "features": features,
    }

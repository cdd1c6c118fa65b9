"""LeRobot's layout of a captured data set: Parquet, MP4 and statistics, version 2.1.

An episode is a flight of one drone. Random places are no flight, and are not in it.
"""

import io
import json
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from ..agents.checkpoints import write_whole
from ..models.cameras import View
from ..models.errors import expect, require
from .capture import picture_name, takers
from .viewpoints import Plan, Walk

_VERSION: Final = "v2.1"
_STATE: Final = ("x", "y", "z", "qw", "qx", "qy", "qz")
_VIDEO: Final = "observation.images."
_NUMBERS: Final = ("frame_index", "episode_index", "index", "task_index")


def write_lerobot(folder: Path, plan: Plan, walks: Sequence[Walk]) -> None:
    """Write `lerobot/`. Raises `OSError`.

    A frame has the action that was flown from there; the end of a flight, from which none was, is
    left out. All flights have the same actions. Raises `InputError` where a file is in the way.
    """
    pyarrow: Any = require("pyarrow", "dataset", "LeRobot's layout")
    from pyarrow import parquet

    from ..rendering.film import QUALITY, write_film

    root, cameras = folder / "lerobot", [view for view in plan.views() if view.kind == "rgb"]
    right = not root.is_symlink() and (root.is_dir() or not root.exists())
    expect(right, str(root), "a folder, or none", "a file or a link")
    shutil.rmtree(root, ignore_errors=True)
    flights = [walk for walk in walks if walk.actions is not None]
    if not flights:
        return
    for name in ("meta", "data/chunk-000", "videos/chunk-000"):
        (root / name).mkdir(parents=True)
    components = flights[0].components
    tasks = list(dict.fromkeys(walk.name for walk in flights))
    first = index = 0
    episodes: list[dict[str, Any]] = []
    statistics: list[dict[str, Any]] = []
    for walk in walks:
        drones = walk.position.shape[1]
        for drone in range(drones if walk.actions is not None else 0):
            columns = _columns(walk, drone)
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
            data = io.BytesIO()
            parquet.write_table(table, data)
            write_whole(root / "data" / f"{episode}.parquet", data.getvalue())
            for view in cameras:
                chunk, _, file = episode.partition("/")
                video = root / "videos" / chunk / f"{_VIDEO}{view.name}" / f"{file}.mp4"
                video.parent.mkdir(exist_ok=True)
                taker = min(drone, takers(view, drones) - 1)
                pictures = _Pictures(
                    folder / picture_name(view, first + i, taker, drones, "png")
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


def _columns(walk: Walk, drone: int) -> dict[str, np.ndarray]:
    """State, action and time of a drone, a row for each frame."""
    assert walk.actions is not None
    states = np.concatenate((walk.position[:, drone], walk.quaternion[:, drone]), axis=1)
    actions = walk.actions[:, drone].astype(np.float32)
    columns = {"observation.state": states.astype(np.float32), "action": actions}
    flown = ~np.isnan(actions).any(axis=1)
    return {name: values[flown] for name, values in {**columns, "time": walk.times}.items()}


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

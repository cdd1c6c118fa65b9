"""Curves of a training for TensorBoard: which updates are written, and how little of it."""

import math
import time
from pathlib import Path
from typing import Any

from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter

_POINTS = 200  # of each curve: the width of a chart, and less than 1 MB for all
_LEAST = 100  # env steps between two points: in short runs more would cost time
_PREFIX = "events.out.tfevents."


class ScalarWriter:
    """Writes numbers by name at the first update, then at the first after so many env steps.

    So many are a two hundredth of the run, and at least 100: curves of agents that update at
    different times have points near the same env steps. Each begin or resume makes an event file.
    TensorBoard is told to forget points beyond `behind`: a process that was killed has lost them.
    """

    def __init__(self, folder: Path, env_steps: int, *, behind: int = 0) -> None:
        self._every = max(math.ceil(env_steps / _POINTS), _LEAST)
        self._last = behind or -1
        self._written: int | None = None
        folder.mkdir(parents=True, exist_ok=True)
        # Not TensorFlow's or torch's writer: they name a file by the clock, and TensorBoard reads
        # files in the order of their names. After the clock went back it would skip the new one.
        number = len(list(folder.glob(f"{_PREFIX}*")))
        name = f"{_PREFIX}{number:010}.rotorgram"
        self._file = RecordWriter(open(folder / name, "xb"))  # noqa: SIM115  until `close`
        self.flush = self._file.flush
        self.close = self._file.close
        self._add(file_version="brain.Event:2")
        # TensorBoard drops what it has read from this step on. One of its two readers skips the
        # first such mark of a folder: so a fresh training has one too.
        self._add(step=behind + 1, session_log=SessionLog(status=SessionLog.START))

    def due(self, env_steps: int, *, last: bool = False) -> bool:
        """Asked at every update: whether to write at it; at the last, if it is not written yet."""
        due = env_steps // self._every > self._last // self._every
        self._last = env_steps
        return due or (last and self._written != env_steps)

    def write(self, env_steps: int, numbers: dict[str, float]) -> None:
        """Write finite numbers as one event: a sixth of what so many `add_scalar` take."""
        values = [Summary.Value(tag=tag, simple_value=number) for tag, number in numbers.items()]
        self._add(step=env_steps, summary=Summary(value=values))
        self._written = env_steps

    def _add(self, **content: Any) -> None:
        event = Event(wall_time=time.time(), **content)
        self._file.write(event.SerializeToString())

"""Curves of a training for TensorBoard: which updates are written, and how little of it."""

import math
from pathlib import Path
from typing import Final

from tensorboard.compat.proto.event_pb2 import (
    Event,
    SessionLog,
)
from tensorboard.compat.proto.summary_pb2 import Summary
from torch.utils.tensorboard import FileWriter

__all__ = ["ScalarWriter"]

_POINTS: Final = 200  # of each curve: what a chart is wide, and less than 1 MB for all
_LEAST: Final = 100  # env steps from one point to the next: in short runs they would cost time


class ScalarWriter:
    """Writes numbers by name at the first update, then at the first after so many env steps.

    So many are a two hundredth of the run, and at least 100: curves of agents that update at
    different times have points near the same env steps.

    Args:
        folder: For the event files, one for each time that the training was begun or resumed.
        env_steps: Of the whole run.
        behind: Env steps flown before. What the folder holds from beyond them, which were lost
            with a process that was killed, TensorBoard is told to forget.
    """

    def __init__(self, folder: Path, env_steps: int, *, behind: int = 0) -> None:
        self._every = max(math.ceil(env_steps / _POINTS), _LEAST)
        self._last = behind
        self._begins = not behind
        self._written: int | None = None
        self._file = FileWriter(str(folder))
        # TensorBoard drops what it has read from this step on. One of its two readers skips the
        # first such mark of a folder: so a fresh training has one too.
        start = SessionLog(status=SessionLog.START)
        self._file.add_event(Event(session_log=start), step=behind + 1)

    def due(self, env_steps: int, *, last: bool = False) -> bool:
        """Whether the update at so many env steps is one to write; of the last, if it is not yet.

        To be asked at every update.
        """
        due = self._begins or env_steps // self._every > self._last // self._every
        self._begins, self._last = False, env_steps
        return due or (last and self._written != env_steps)

    def write(self, env_steps: int, numbers: dict[str, float]) -> None:
        """Write finite numbers as one event: a sixth of what so many `add_scalar` take."""
        values = [Summary.Value(tag=tag, simple_value=value) for tag, value in numbers.items()]
        self._file.add_summary(Summary(value=values), env_steps)
        self._written = env_steps

    def flush(self) -> None:
        """Have all that was written in the file."""
        self._file.flush()

    def close(self) -> None:
        """Have it in the file, and close it."""
        self._file.close()

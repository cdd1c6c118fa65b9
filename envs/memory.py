"""The memory of a task."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np


class Memory:
    """What a task remembers of its episodes: arrays by name, shape (W, A, ...).

    `Task.begin` makes the names, and `Task.update_memory` changes their values; elsewhere they are
    read alone. A number stands for all drones. Numbers become float64, truth values stay. The loop
    keeps the values of drones that do not fly.
    """

    __slots__ = ("__dict__", "_phase")
    _phase: str

    def __init__(self) -> None:
        object.__setattr__(self, "_phase", "begin")

    def __setattr__(self, name: str, value: object) -> None:
        """Raises `AttributeError` where a task may not change its memory."""
        if self._phase == "closed":
            raise AttributeError(
                f"memory.{name}: expected to be set in begin() or update_memory(), "
                "got an assignment elsewhere"
            )
        if self._phase == "update" and name not in vars(self):
            raise AttributeError(f"memory.{name}: expected a value from begin() first, got none")
        array: Any = value if hasattr(value, "dtype") else np.asarray(value)
        if array.dtype.kind != "b":
            array = array.astype(np.float64, copy=False)
        if not array.ndim:
            vars(self)[name] = array.item()
            return
        array = array.view()
        array.setflags(write=False)
        vars(self)[name] = array

    def expand(self, shape: tuple[int, ...]) -> None:
        """Make arrays of shape (W, A) of numbers that stand for all drones."""
        arrays = vars(self)
        for name, value in arrays.items():
            if not np.ndim(value):
                arrays[name] = np.full(shape, value)

    @contextmanager
    def open(self, phase: str) -> Iterator[None]:
        """Let a task change its memory: in the phase `begin`, or `update`."""
        object.__setattr__(self, "_phase", phase)
        try:
            yield
        finally:
            object.__setattr__(self, "_phase", "closed")

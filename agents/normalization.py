"""Running mean and scale of observations."""

from collections.abc import Mapping

import numpy as np

from .networks import Normalise, check_shapes

_LEAST = 0.01
"""Least deviation to divide by: what hardly changes is not blown up."""


class Moments(Normalise):
    """Mean and variance of all rows so far, in float64 (Chan, Golub, LeVeque 1979, Eq. 2.1).

    Attributes:
        mean: float32, shape (n,); 0 before the first row.
        scale: 1 / standard deviation, float32, shape (n,); 1 before the first row.
    """

    def __init__(self, size: int) -> None:
        self._count = np.zeros(())
        self._mean = np.zeros(size)
        self._squares = np.zeros(size)
        self._set()

    def add(self, rows: np.ndarray) -> None:
        """Take rows into account, shape (B, n)."""
        rows = rows.astype(np.float64)
        mean = rows.mean(axis=0)
        count = self._count + len(rows)
        step = mean - self._mean
        within = ((rows - mean) ** 2).sum(0)
        between = step**2 * self._count * len(rows) / count
        self._squares += within + between
        self._mean += step * len(rows) / count
        self._count = count
        self._set()

    def arrays(self) -> dict[str, np.ndarray]:
        """Its state."""
        names = {"count": self._count, "mean": self._mean, "squares": self._squares}
        return {name: np.array(array) for name, array in names.items()}

    def load(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over a state. Raises `ValueError` unless it is whole."""
        size = self._mean.shape
        check_shapes("observations", arrays, {"count": (), "mean": size, "squares": size})
        self._count = arrays["count"].copy()
        self._mean = arrays["mean"].copy()
        self._squares = arrays["squares"].copy()
        self._set()

    def _set(self) -> None:
        deviation = np.sqrt(self._squares / max(float(self._count), 1.0))
        scale = 1 / np.maximum(deviation, _LEAST) if self._count else np.ones_like(deviation)
        self.mean = self._mean.astype(np.float32)
        self.scale = scale.astype(np.float32)

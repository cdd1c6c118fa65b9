"""Running mean and scale of observations."""

import numpy as np

from .networks import Floats

_LEAST = 0.01
"""Least deviation to divide by: what hardly changes is not blown up."""


class Moments:
    """(x - mean) · scale, by mean and deviation of all rows so far.

    They are kept in float64 (Chan, Golub, LeVeque 1979, Eq. 2.1).

    Attributes:
        mean: float32, shape (n,); 0 before the first row.
        scale: 1 / standard deviation, float32, shape (n,); 1 before the first row.
        state: Number of rows, mean and sum of squares, by name. Call `refresh` after a change.
    """

    def __init__(self, size: int) -> None:
        self._count = np.zeros(())
        self._mean = np.zeros(size)
        self._squares = np.zeros(size)
        self.state = {"count": self._count, "mean": self._mean, "squares": self._squares}
        self.refresh()

    def forward(self, inputs: Floats) -> Floats:
        """Observations, shape (..., n), shifted and scaled."""
        return (inputs - self.mean) * self.scale

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
        self._count[...] = count
        self.refresh()

    def refresh(self) -> None:
        """Compute mean and scale from the state."""
        deviation = np.sqrt(self._squares / max(float(self._count), 1.0))
        scale = 1 / np.maximum(deviation, _LEAST) if self._count else np.ones_like(deviation)
        self.mean = self._mean.astype(np.float32)
        self.scale = scale.astype(np.float32)

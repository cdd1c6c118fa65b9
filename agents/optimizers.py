"""Adam, and the length of a gradient."""

import math

import numpy as np

from .layers import ByName, Floats, Weights


class Adam:
    """Kingma and Ba 2015, Algorithm 1, with their constants.

    Attributes:
        state: All that it keeps between two steps, by name: a checkpoint writes it in place. The
            sums of the gradients and of their squares, weighted by powers of the constants, are
            the article's moments without the factors 0.1 and 0.001, which the step takes on.
    """

    def __init__(self, weights: Weights, epsilon: float) -> None:
        self._weights = weights
        self._epsilon = epsilon
        self._sums = np.zeros_like(weights.values)
        self._squares = np.zeros_like(weights.values)
        self._scratch = np.empty_like(weights.values)
        self._count = np.zeros((), np.int64)
        self.state: ByName = {"sums": self._sums, "squares": self._squares, "steps": self._count}

    @property
    def steps(self) -> int:
        """Steps so far."""
        return int(self._count)

    def step(self, rate: float, scales: Floats | None = None) -> None:
        """Move the weights against their gradients, each times its scale, float32, shape (P,)."""
        self._count += 1
        steps = self.steps
        slopes = self._weights.slopes
        change = self._scratch
        self._sums *= 0.9
        self._sums += slopes
        self._squares *= 0.999
        np.multiply(slopes, slopes, out=change)
        self._squares += change
        of_sums = 0.1 / (1 - 0.9**steps)
        of_roots = math.sqrt(0.001 / (1 - 0.999**steps))
        np.sqrt(self._squares, out=change)
        change += self._epsilon / of_roots
        np.divide(self._sums, change, out=change)
        change *= rate * of_sums / of_roots
        if scales is not None:
            change *= scales
        values = self._weights.values
        values -= change


def clip_norm(slopes: Floats, most: float) -> None:
    """Scale a gradient down to a norm of at most so much."""
    norm = math.sqrt(float(slopes.dot(slopes)))
    if norm > most:
        slopes *= most / norm

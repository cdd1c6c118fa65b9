"""Adam, and the length of a gradient."""

import math

import numpy as np

from .networks import ByName, Floats, Weights


class Adam:
    """Kingma and Ba 2015, Algorithm 1, with their constants and torch's order of operations.

    Attributes:
        state: All that it keeps between two steps, by name: a checkpoint writes it in place.
    """

    def __init__(self, weights: Weights, epsilon: float = 1e-8) -> None:
        self._weights = weights
        self._epsilon = epsilon
        self._first = np.zeros_like(weights.values)
        self._second = np.zeros_like(weights.values)
        self._count = np.zeros((), np.int64)
        self.state: ByName = {
            "first": self._first,
            "second": self._second,
            "steps": self._count,
        }

    @property
    def steps(self) -> int:
        """Steps so far."""
        return int(self._count)

    def step(self, rate: float | Floats) -> None:
        """Move the weights against their gradients; rates may differ, float32, shape (P,)."""
        self._count += 1
        slopes = self._weights.slopes
        self._first += 0.1 * (slopes - self._first)
        self._second *= 0.999
        self._second += (0.001 * slopes) * slopes
        scale = np.sqrt(self._second)
        scale /= math.sqrt(1 - 0.999**self.steps)
        scale += self._epsilon
        np.divide(self._first, scale, out=scale)
        scale *= rate / (1 - 0.9**self.steps)
        self._weights.values[...] -= scale


def clip_norm(slopes: Floats, most: float) -> float:
    """Scale a gradient down to a norm of at most so much; the norm that it had."""
    norm = math.sqrt(float(slopes.dot(slopes)))
    if norm > most:
        slopes *= most / norm
    return norm

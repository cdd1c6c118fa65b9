"""Adam, and the length of a gradient."""

import math
from collections.abc import Mapping

import numpy as np

from .networks import Floats, Weights, check_shapes


class Adam:
    """Kingma and Ba 2015, Algorithm 1, with their constants and torch's order of operations."""

    def __init__(self, weights: Weights, epsilon: float = 1e-8) -> None:
        self._weights = weights
        self._epsilon = epsilon
        self.first = np.zeros_like(weights.values)
        self.second = np.zeros_like(weights.values)
        self.steps = 0

    def step(self, rate: float | Floats) -> None:
        """Move the weights against their gradients; rates may differ, float32, shape (P,)."""
        self.steps += 1
        slopes = self._weights.slopes
        self.first += 0.1 * (slopes - self.first)
        self.second *= 0.999
        self.second += (0.001 * slopes) * slopes
        scale = np.sqrt(self.second)
        scale /= math.sqrt(1 - 0.999**self.steps)
        scale += self._epsilon
        np.divide(self.first, scale, out=scale)
        scale *= rate / (1 - 0.9**self.steps)
        self._weights.values[...] -= scale

    def arrays(self) -> dict[str, np.ndarray]:
        """Its state."""
        return {
            "first": self.first.copy(),
            "second": self.second.copy(),
            "steps": np.array(self.steps),
        }

    def load(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over a state. Raises `ValueError` unless it is whole."""
        size = self.first.shape
        check_shapes("optimizer", arrays, {"first": size, "second": size, "steps": ()})
        self.first[...] = arrays["first"]
        self.second[...] = arrays["second"]
        self.steps = int(arrays["steps"])


def clip_norm(slopes: Floats, most: float) -> float:
    """Scale a gradient down to a norm of at most so much; the norm that it had."""
    norm = math.sqrt(float(slopes.dot(slopes)))
    if norm > most:
        slopes *= most / norm
    return norm

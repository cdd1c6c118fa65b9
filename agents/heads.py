"""Heads: from the outputs of a network to distributions of actions, and their derivatives."""

import math

import numpy as np
from numpy.random import Generator

from .config import LOG_STD
from .layers import Floats, Module, Weights


class Head(Module):
    """A distribution of actions by a network's outputs.

    This one has none: its policy flies the most likely action alone.
    """

    def initialise(self, log_std: float) -> None:
        """Set the weights."""

    def noise(self, rng: Generator, steps: int) -> Floats:
        """Randomness for `steps` rows of `sample`, drawn at once: shape (steps, k)."""
        raise NotImplementedError

    def sample(self, output: Floats, noise: Floats) -> Floats:
        """Actions, not clipped, from outputs and rows of `noise`, all (B, k); choices (B, 1)."""
        raise NotImplementedError

    def score(self, output: Floats, actions: Floats) -> tuple[Floats, float]:
        """Log-probabilities, shape (B,), of actions (k, B), and the mean entropy."""
        raise NotImplementedError

    def back(self, by_log_probability: Floats, by_entropy: float) -> Floats:
        """Derivatives of a loss by the outputs, from those by what `score` gave last.

        Sets the gradients of its own weights.
        """
        raise NotImplementedError

    def clamp(self) -> None:
        """Keep its weights where they are sensible."""


class Gaussian(Head):
    """The outputs are means; the standard deviation is a weight, the same in every state."""

    def __init__(self, size: int) -> None:
        self.shapes = {"log_std": (size,)}

    def bind(self, weights: Weights) -> None:
        self.log_std = weights.arrays["log_std"]
        self._by_log_std = weights.gradients["log_std"]
        size = self.log_std.size
        self._halves = np.full(size, 0.5, np.float32)
        self._constant = 0.5 * size * math.log(2 * math.pi)

    def initialise(self, log_std: float) -> None:
        self.log_std[...] = log_std

    def noise(self, rng: Generator, steps: int) -> Floats:
        noise = rng.standard_normal((steps, self.log_std.size), dtype=np.float32)
        noise *= np.exp(self.log_std)
        return noise

    def sample(self, output: Floats, noise: Floats) -> Floats:
        return np.add(output, noise, order="C")

    def score(self, output: Floats, actions: Floats) -> tuple[Floats, float]:
        errors = np.subtract(actions, output, order="C")
        self._by_output = errors * np.exp(-2 * self.log_std)[:, np.newaxis]
        self._squares = np.multiply(errors, self._by_output, out=errors)
        constant = self._constant + float(self.log_std.sum())
        entropy = constant + 0.5 * self.log_std.size
        return -constant - self._halves.dot(self._squares), entropy

    def back(self, by_log_probability: Floats, by_entropy: float) -> Floats:
        self._squares -= 1.0
        np.dot(self._squares, by_log_probability, out=self._by_log_std)
        self._by_log_std += by_entropy
        self._by_output *= by_log_probability
        return self._by_output

    def clamp(self) -> None:
        """Keep the standard deviation between e^-4 and e."""
        np.clip(self.log_std, LOG_STD.low, LOG_STD.high, out=self.log_std)


class Categorical(Head):
    """The outputs are logits of choices."""

    def __init__(self, size: int) -> None:
        self._size = size

    def noise(self, rng: Generator, steps: int) -> Floats:
        # The Gumbel trick: the largest of logits plus Gumbel noise is a categorical draw.
        return rng.gumbel(size=(steps, self._size)).astype(np.float32)

    def sample(self, output: Floats, noise: Floats) -> Floats:
        chosen: Floats = (output + noise).argmax(axis=1)[:, np.newaxis].astype(np.float32)
        return chosen

    def score(self, output: Floats, actions: Floats) -> tuple[Floats, float]:
        self._logs = output - output.max(axis=0)
        self._shares = np.exp(self._logs)
        total = self._shares.sum(axis=0)
        self._logs -= np.log(total)
        self._shares /= total
        self._entropy = -(self._shares * self._logs).sum(axis=0)
        self._chosen = actions[0].astype(int), np.arange(output.shape[1])
        return self._logs[self._chosen], float(self._entropy.mean())

    def back(self, by_log_probability: Floats, by_entropy: float) -> Floats:
        slope: Floats = -by_log_probability * self._shares
        slope[self._chosen] += by_log_probability
        slope -= by_entropy / slope.shape[1] * self._shares * (self._logs + self._entropy)
        return slope

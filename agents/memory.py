"""A gated recurrent unit: what a network remembers from one step to the next.

K. Cho et al. 2014, arXiv 1406.1078, in the form that torch and ONNX have: the candidate's share of
the state is summed first, and reset then.
"""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from .layers import Affine, Floats, Weights, orthogonal, sized

Mask = NDArray[np.bool_]
_LONGEST = 4.0
"""Largest initial bias of an update gate: its unit forgets by a factor e in 55 steps. Units have
biases from 0 to it, as Tallec and Ollivier 2018 (arXiv 1804.11188) spread them."""


@dataclass(frozen=True)
class Sequences:
    """S sequences of T rows, that a network with a memory reads one time after the other."""

    state: Floats
    """Before the first row, shape (..., H, S)."""
    begins: Mask
    """Before which rows an episode begins, and the state is 0: shape (T, S)."""
    kept: Mask
    """Rows to learn from, shape (T, S)."""

    def take(self, chosen: NDArray[np.int64]) -> "Sequences":
        """Some of the sequences."""
        state = self.state[..., chosen]
        return Sequences(state, self.begins[:, chosen], self.kept[:, chosen])


class GRU(Affine):
    """From inputs (..., 1 + n, B) to states (..., 1 + H, B).

    Gates: update z, reset r = sigmoid of sums over inputs and state; candidate
    c = tanh(W x + r · U h). The next state is c + z · (h - c).

    Attributes:
        sequences: What the rows of the next `forward` are; None: the next of those of `state`.
        state: Of B sequences, (H, B). Without `sequences` each `forward` takes it one row further;
            another number of rows begins anew.
        states: After each row of the last `forward`, (..., H, T, S).
    """

    sequences: Sequences | None = None

    def __init__(self, inputs: int, units: int) -> None:
        super().__init__(inputs, 3 * units)
        self.units = units
        self.shapes = {**self.shapes, "recurrent": (3 * units, units)}
        self.state = np.zeros((units, 0), np.float32)

    def bind(self, weights: Weights) -> None:
        super().bind(weights)
        self.recurrent = weights.arrays["recurrent"]
        self._by_recurrent = weights.gradients["recurrent"]

    def initialise(self, rng: Generator, gain: float) -> None:
        super().initialise(rng, gain)
        self.recurrent[...] = orthogonal(rng, self.recurrent.shape, gain)
        self.weight[: self.units, 0] = np.linspace(0.0, _LONGEST, self.units)

    def forget(self, drones: Mask) -> None:
        """Begin anew in these of the sequences of `state`, shape (B,)."""
        self.state[:, drones] = 0.0

    def forward(self, inputs: Floats) -> Floats:
        self._inputs = inputs
        count = inputs.shape[-1]
        given = self.sequences or self._next(count)
        self._begins = given.begins
        sums = np.matmul(self.weight, inputs)
        *lead, rows, _ = sums.shape
        by_time = sums.reshape(*lead, rows, *given.begins.shape)
        state = given.state
        states = []
        self._steps = []
        for step, begins in enumerate(given.begins):
            before = np.where(begins, 0.0, state)
            own = _thirds(by_time[..., step, :])
            recalled = _thirds(self.recurrent @ before)
            update = _sigmoid(own[0] + recalled[0])
            reset = _sigmoid(own[1] + recalled[1])
            candidate = np.tanh(own[2] + reset * recalled[2])
            state = candidate + update * (before - candidate)
            states.append(state)
            self._steps.append((before, recalled[2], update, reset, candidate))
        if self.sequences is None:
            self.state[...] = state
        self.states = np.stack(states, axis=-2)
        self._outputs = sized(self._outputs, *lead, 1 + self.units, count)
        self._outputs[..., 1:, :] = _flat(self.states)
        return self._outputs

    def learn(self, slope: Floats) -> None:
        by_states = slope.reshape(self.states.shape)
        transposed = self.recurrent.swapaxes(-1, -2)
        carried = np.zeros_like(by_states[..., 0, :])
        by_sums = []
        by_recalled = []
        for step in reversed(range(len(self._steps))):
            before, recalled, update, reset, candidate = self._steps[step]
            by_state = by_states[..., step, :] + carried
            by_candidate = by_state * (1 - update) * (1 - candidate * candidate)
            by_update = by_state * (before - candidate) * update * (1 - update)
            by_reset = by_candidate * recalled * reset * (1 - reset)
            gates = (by_update, by_reset)
            by_sums.append(np.concatenate((*gates, by_candidate), axis=-2))
            through = np.concatenate((*gates, by_candidate * reset), axis=-2)
            by_recalled.append(through)
            carried = by_state * update + transposed @ through
            carried *= ~self._begins[step]
        self._by_sums = _flat(np.stack(by_sums[::-1], axis=-2))
        super().learn(self._by_sums)
        befores = np.stack([step[0] for step in self._steps], axis=-2)
        through = _flat(np.stack(by_recalled[::-1], axis=-2))
        np.matmul(through, _flat(befores).swapaxes(-1, -2), out=self._by_recurrent)

    def back(self, slope: Floats) -> Floats:
        return super().back(self._by_sums)

    def _next(self, count: int) -> Sequences:
        """The next rows of the sequences of `state`."""
        if self.state.shape[-1] != count:
            self.state = np.zeros((self.units, count), np.float32)
        rows = np.zeros((1, count), bool)
        return Sequences(self.state, rows, rows)


def _flat(by_time: Floats) -> Floats:
    """From (..., n, T, S) to (..., n, T·S)."""
    return by_time.reshape(*by_time.shape[:-2], -1)


def _thirds(gates: Floats) -> list[Floats]:
    return np.split(gates, 3, axis=-2)


def _sigmoid(sums: Floats) -> Floats:
    found: Floats = 0.5 + 0.5 * np.tanh(0.5 * sums)
    return found

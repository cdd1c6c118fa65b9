"""The radio between the drones of a world: what each has heard last of each other."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...sim import Array, length
from ...sim.compile import once
from ...sim.random import RADIO, uniform, words_of
from ...sim.state import filled, pushed, some
from ..state import State
from .record import Floats, Mask, Record, Stage

if TYPE_CHECKING:
    from ..tasks.swarm import SwarmOptions

FORGOTTEN = 1.0  # A drone that was not heard for so long is no neighbour any more, s


@dataclass
class Radio(Stage):
    """Every drone sends its position and velocity in every step.

    A message arrives after a delay, at the drones within range then, unless it is lost. The
    receiver knows its age, and assumes that the sender flew on straight; after `FORGOTTEN` seconds
    it forgets the sender.

    Sets `State.neighbours` of the measured state: relative position, relative velocity and 1 of the
    nearest known drones; zeros if there are fewer.
    """

    arrays = ("said", "heard", "age", "keys", "silent")

    options: "SwarmOptions"
    """Of the task."""
    period: float
    """Time of a control step, s."""
    drones: int
    """Of a world."""
    ended: Callable[[State], Mask]
    """Gives the drones that have crashed: they are silent."""

    def begin(self, record: Record) -> None:
        """Each drone has heard where those in range start, at rest."""
        lots = record.draw.uniform(0.0, 1.0)
        position = record.start.position
        rest = np.concatenate((position, 0.0 * position), axis=-1)
        message = np.concatenate((rest, np.zeros_like(rest[..., :1])), axis=-1)
        record.said = filled(message, self.options.radio_delay + 1)
        record.heard = np.repeat(rest[:, None], self.drones, axis=1)
        record.age = np.where(self._in_range(position, position), 0.0, np.inf)
        keys = (lots * 2.0**32).astype(np.uint32)
        record.keys = np.stack((keys, 0 * keys), axis=-1)
        record.silent = np.zeros(record.shape, bool)

    def step(self, record: Record) -> None:
        """Send and receive, then observe."""
        flown = record.flown
        if some(flown):
            record.run(flown, [self._exchange])
        measured = record.measured
        measured.neighbours = self._nearest(record, measured.position, measured.velocity)

    def _exchange(self, record: Record) -> None:
        state = record.state
        options = self.options
        record.silent = record.silent | self.ended(state)
        parts = (state.position, state.velocity, record.silent[..., None])
        record.said = pushed(record.said, np.concatenate(parts, axis=-1))
        said = record.said[:, :, 0]
        arrives = self._in_range(state.position, said[..., :3]) & (said[:, None, :, 6] == 0)
        if options.radio_loss:
            steps = (record.steps - 1).astype(np.uint32)
            chances = uniform(words_of(record.keys, RADIO, 0, steps, self.drones))
            arrives = arrives & (chances >= options.radio_loss)  # (W, receiver, sender)
        record.heard = np.where(arrives[..., None], said[:, None, :, :6], record.heard)
        record.age = np.where(arrives, float(options.radio_delay), record.age + 1.0)

    def _nearest(self, record: Record, position: Floats, velocity: Floats) -> Floats:
        time = record.age * self.period
        known = (time <= FORGOTTEN) & ~np.eye(self.drones, dtype=bool)
        passed = np.where(known, time, 0.0)[..., None]
        heard = record.heard
        there = heard[..., :3] + heard[..., 3:] * passed - position[:, :, None]
        moves = heard[..., 3:] - velocity[:, :, None]
        numbers = np.concatenate((there, moves, np.ones_like(passed)), axis=-1)
        numbers = np.where(known[..., None], numbers, 0.0)
        distance = np.where(known, length(there), np.inf)
        rows = nearest_first(distance, numbers.reshape(*record.shape, -1))
        nearest = rows.reshape(numbers.shape)[:, :, : self.options.neighbours]
        neighbours = np.zeros_like(nearest, shape=(*record.shape, self.options.neighbours, 7))
        neighbours[:, :, : nearest.shape[2]] = nearest
        return neighbours

    def _in_range(self, receivers: Floats, senders: Floats) -> Array:
        apart = length(senders[:, None] - receivers[:, :, None])
        return apart <= self.options.radio_range


@once(vectors=1)
def nearest_first(distance: Floats, numbers: Floats) -> Floats:
    """Of distances (..., A) and A rows of numbers (..., 7 A), the rows of the nearest first."""
    rows = numbers.reshape(*distance.shape, 7)
    order = np.argsort(distance, axis=-1, kind="stable")[..., None]
    return np.take_along_axis(rows, order, axis=-2).reshape(numbers.shape)

"""Sensors that no array code computes, as rays and pictures: they measure after a step."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ..scenery import Scenery
from ..snapshots import Arrays, Snapshot, joined
from ..state import Array, ByName, chosen, filled, pushed, taken


class Moment(NamedTuple):
    """The state that a step ended in, as instruments see it: arrays of W worlds of A drones."""

    begun: Array
    """Drones that begin an episode, bool, (W, A)."""
    flown: Array
    """Drones that flew, bool, (W, A)."""
    scenery: Scenery
    keys: Array
    """Of random numbers, as `Random` has them."""
    episode: Array
    steps: Array
    """Control steps of each episode, (W, A)."""
    position: Array
    """World frame, m, (W, A, 3)."""
    quaternion: Array
    """From body to world frame, (W, A, 4)."""
    late: Array
    """Control steps by which an observation is late besides, (W, A)."""
    payload: Array = None
    """As of `WorldState`."""
    goal: Array = None
    """Where marks move with it, world frame, m, (W, A, 3)."""


class Instrument:
    """What measures the state that a step ended in.

    Args:
        every: Control steps between two readings, by the array that they are observed as.
        lag: Age of a reading when it is observed, control steps.
        latest: No observation is later than that besides.
    """

    def __init__(self, every: Mapping[str, int], lag: int, latest: int) -> None:
        self.every = every
        self._lag = lag
        self._steps = lag + latest + 1
        self._past: ByName = {}
        """The readings of the last steps, the oldest first, (W, A, steps, ...)."""

    @abstractmethod
    def read(self, moment: Moment, due: ByName) -> ByName:
        """New readings by array of the drones that are due, bool, (W, A); of others anything."""

    def measure(self, moment: Moment) -> None:
        """Take readings after a step."""
        due = {
            name: moment.begun | (moment.flown & (moment.steps % every == 0))
            for name, every in self.every.items()
        }
        for name, fresh in self.read(moment, due).items():
            past = self._past.get(name)
            held = fresh if past is None else chosen(due[name], fresh, past[:, :, -1])
            if past is None or self._steps == 1:
                self._past[name] = filled(held, self._steps)
                continue
            moved = chosen(moment.flown, pushed(past, held), past)
            self._past[name] = chosen(moment.begun, filled(held, self._steps), moved)

    def observed(self, late: Array) -> ByName:
        """What is observed by array, (W, A, ...); nothing before an episode."""
        if self._steps == 1:
            return {name: past[:, :, 0] for name, past in self._past.items()}
        return {name: taken(past, self._lag + late) for name, past in self._past.items()}

    def snapshot(self) -> Snapshot:
        """Copies by array."""
        return joined(self._past)

    def restore(self, arrays: Arrays) -> None:
        """Put a snapshot back."""
        self._past = {name: np.copy(arrays[name]) for name in self.every if name in arrays}

    def close(self) -> None:
        """Release threads and memory."""

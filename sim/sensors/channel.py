"""A sensor as it is sampled: rate, delay and dropout."""

import math
from statistics import NormalDist

import numpy as np

from ..snapshots import Kept
from ..state import Array, chosen, clip, component, kept
from ..world import World
from .base import Sensor, Values


class Channel(Kept):
    """Samples a sensor, given as its class and all its settings, every `period` s.

    A reading has one number more: 1 if it is new, 0 if the last reading was held.
    """

    arrays = ("_now", "_held")
    lists = ("_late",)

    def __init__(self, kind: type[Sensor], values: Values, world: World, period: float) -> None:
        self._every = values["every"]
        self._lag = values["lag"]
        self.interval = self._every * period
        self.sensor = kind(values, self.interval)
        self._low = np.array(self.sensor.low())
        self._high = np.array(self.sensor.high())
        self._world = world
        # One number more than the sensor takes decides whether a reading is lost.
        self._noise = world.random.noise(f"sensor {kind.name}", kind.columns + 1)
        dropout = values["dropout"]
        self._lost = NormalDist().inv_cdf(dropout) if dropout else -math.inf
        self._now: Array = 0.0
        self._held: Array = 0.0
        self._late: list[Array] = []  # those on their way, the oldest first

    @property
    def value(self) -> Array:
        """What is observed now, shape (W, A, k)."""
        return self._now[..., :-1]

    @property
    def fresh(self) -> Array:
        """1 where it was not observed before, and 0 elsewhere, shape (W, A)."""
        return component(self._now, -1)

    def begin(self, mask: Array) -> None:
        """First reading of the drones of a mask."""
        self.sensor.begin(mask, self._noise.normal(mask)[..., :-1])
        first = self._read(self._noise.normal(mask))
        self._held = chosen(mask, first, self._held)
        self._now = chosen(mask, _with(first, 1.0), self._now)
        old = _with(first, 0.0)
        self._late = [chosen(mask, old, late) for late in self._late or [old] * self._lag]

    def sample(self, mask: Array, steps: Array) -> None:
        """After a control step of the drones of a mask; `steps` counts those of each episode."""
        due = mask & (steps % self._every == 0)
        fresh = due
        if np.any(due):
            normal = self._noise.normal(due)
            fresh = due & (component(normal, -1) >= self._lost)
            self._held = chosen(fresh, self._read(normal), self._held)
        first, *rest = [*self._late, _with(self._held, fresh)]
        self._now = chosen(mask, first, self._now)
        self._late = list(kept(mask, rest, self._late))

    def _read(self, normal: Array) -> Array:
        """A reading within the sensor's bounds."""
        return clip(self.sensor.measure(self._world, normal[..., :-1]), self._low, self._high)


def _with(reading: Array, fresh: Array) -> Array:
    """A reading with one more number for each drone."""
    *lead, size = reading.shape
    both = np.empty((*lead, size + 1))
    both[..., :-1] = reading
    both[..., -1] = fresh
    return both

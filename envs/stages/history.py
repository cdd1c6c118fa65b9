"""Arrays of the last control steps: observations side by side, and observations that are late.

They have the shape (W, A, steps, *shape), the oldest step first.
"""

from dataclasses import dataclass, replace

import numpy as np

from ...sim import World
from ...sim.state import ByName, chosen, filled, pushed, taken
from ..spec import ArraySpec
from .record import Record, Stage


@dataclass
class History(Stage):
    """The last observations side by side, the oldest first.

    At the start of an episode all of them are the first one.
    """

    arrays = ("history",)

    steps: int
    """How many."""

    def step(self, record: Record) -> None:
        """A drone that begins fills its history with the present."""
        record.history = remembered(vars(record).get("history"), self.steps, record)
        record.observations = {
            name: rows.reshape(*record.shape, -1, *rows.shape[4:])
            for name, rows in record.history.items()
        }


@dataclass
class ObservationDelay(Stage):
    """An observation arrives late by a number of control steps that each episode draws.

    The first one of an episode arrives at once, and again until another one does.
    """

    arrays = ("past_observations",)

    world: World
    """Its parameter `observation_delay`, control steps."""
    longest: int
    """No delay is longer."""

    def step(self, record: Record) -> None:
        """A drone that begins fills its past with the present."""
        past = vars(record).get("past_observations")
        age = self.world.parameters["observation_delay"]
        record.past_observations = sent = remembered(past, self.longest + 1, record)
        record.observations = {name: taken(values, age) for name, values in sent.items()}


def with_history(array: ArraySpec, steps: int) -> ArraySpec:
    """The spec of `steps` values of an array, side by side along its first axis."""
    if steps == 1:
        return array
    length, *rest = array.shape or (1,)
    low, high = array.bounds()
    names = []
    for age in reversed(range(steps)):
        ago = f", {age} step{'s' * (age > 1)} ago" if age else ""
        names += [name + ago for name in array.components]
    return replace(
        array,
        shape=(steps * length, *rest),
        low=tuple(np.tile(low.ravel(), steps).tolist()),
        high=tuple(np.tile(high.ravel(), steps).tolist()),
        unit=array.unit if isinstance(array.unit, str) else array.unit * steps,
        components=tuple(names),
    )


def remembered(past: ByName | None, steps: int, record: Record) -> ByName:
    """The observations of `steps` steps, one step later; of drones that begin, the present ones."""
    arrays = {}
    for name, values in record.observations.items():
        if past is None:
            arrays[name] = filled(values, steps)
            continue
        arrays[name] = pushed(past[name], values)
        if record.begun is not None:
            arrays[name] = chosen(record.begun, filled(values, steps), arrays[name])
    return arrays

"""Arrays of the last control steps: observations side by side, and observations that are late.

They have the shape (W, A, steps, *shape), the oldest step first.
"""

from dataclasses import dataclass, replace

import numpy as np

from ...sim import World
from ...sim.state import Array, chosen, filled, pushed, taken
from ..spec import ArraySpec
from .record import Record, Stage

Values = np.ndarray


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
        past = vars(record).get("history", {})
        history = {}
        seen = {}
        for name, values in record.observations.items():
            history[name] = rows = later(past.get(name), values, self.steps, record)
            seen[name] = rows.reshape(*record.shape, -1, *rows.shape[4:])
        record.history = history
        record.observations = seen


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
        past = vars(record).get("past_observations", {})
        age = self.world.parameters["observation_delay"]
        sent = {}
        arrived = {}
        for name, values in record.observations.items():
            sent[name] = later(past.get(name), values, self.longest + 1, record)
            arrived[name] = taken(sent[name], age)
        record.past_observations = sent
        record.observations = arrived


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


def later(past: Values | None, values: Values, steps: int, record: Record) -> Array:
    """The past of `steps` steps, one step later; of drones that begin it is the present."""
    if past is None:
        return filled(values, steps)
    new = pushed(past, values)
    if record.begun is None:
        return new
    return chosen(record.begun, filled(values, steps), new)

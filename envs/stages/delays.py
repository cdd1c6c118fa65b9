"""Observations that are late."""

from ...sim import World
from .record import Record, Stage
from .ring import later, taken


class ObservationDelay(Stage):
    """An observation arrives late by a number of control steps that each episode draws.

    The first one of an episode arrives at once, and again until another one does.

    Args:
        world: Its parameter `observation_delay`, control steps.
        longest: No delay is longer.
    """

    arrays = ("past_observations",)

    def __init__(self, world: World, longest: int) -> None:
        self._world = world
        self._steps = longest + 1
        self._axis = len(world.shape)

    def step(self, record: Record) -> None:
        """A drone that begins fills its past with the present."""
        past = vars(record).get("past_observations", {})
        age = self._world.parameters["observation_delay"]
        sent = {}
        arrived = {}
        for name, values in record.observations.items():
            sent[name] = later(past.get(name), values, self._steps, record)
            arrived[name] = taken(sent[name], age, self._axis)
        record.past_observations = sent
        record.observations = arrived

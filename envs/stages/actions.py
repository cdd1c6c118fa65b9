"""Actions arrive, at once or late."""

from dataclasses import dataclass

import numpy as np

from ...sim import World
from ...sim.state import chosen, filled, pushed, taken
from .record import Floats, Record, Stage


@dataclass
class Receive(Stage):
    """The action of an agent arrives."""

    arrays = ("action",)

    neutral: Floats
    """Of a drone that begins, (W, A, k)."""

    def begin(self, record: Record) -> None:
        """No action yet."""
        record.action = record.received = self.neutral

    def step(self, record: Record) -> None:
        """At once, unless a later stage delays it."""
        record.action = record.received = record.sent.astype(np.float64)


@dataclass
class ActionDelay(Stage):
    """An action takes effect late by a number of control steps that each episode draws.

    While the link is out, no action arrives: the drone flies by the last one that did.
    """

    arrays = ("actions_sent",)

    world: World
    """Its parameter `action_delay`, control steps."""
    longest: int
    """No delay is longer."""
    neutral: Floats
    """Actions that are on their way when an episode begins, (W, A, k)."""

    def begin(self, record: Record) -> None:
        """Actions on their way change nothing."""
        record.actions_sent = filled(self.neutral, self.longest + 1)

    def step(self, record: Record) -> None:
        """The action that was sent as long ago as the delay."""
        parameters = self.world.parameters
        sent = pushed(record.actions_sent, record.received)
        if "link_hold" in parameters:
            sent = chosen(parameters["link_hold"] > 0, record.actions_sent, sent)
        record.actions_sent = sent
        record.received = taken(sent, parameters["action_delay"])

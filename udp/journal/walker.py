"""Joins the Commands and States of a session: each State with its cause."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..protocol.messages import FLY, Command, State
from ..protocol.party import first_seeds

if TYPE_CHECKING:
    from .reader import Session

Mask = NDArray[np.bool_]


class Transition(NamedTuple):
    """A State, and the Command or reset before it."""

    state: State
    command: Command | None
    """None: the first State of its session, or one whose Command is missing in the journal."""
    flown: Mask
    """Drones that took a step, shape (N,)."""
    resets: Mask
    """Drones that were reset, shape (N,)."""
    seeds: NDArray[np.uint64] | None
    """Of the drones that were reset, shape (N,). None: their generators went on."""

    @property
    def is_gap(self) -> bool:
        """Whether the Command before the State is missing."""
        return self.command is None and not self.resets.any()


class Walker:
    """Takes the messages of one session, and gives its transitions."""

    def __init__(self, session: "Session") -> None:
        self.session = session
        self._command: Command | None = None
        self._sequence: int | None = None

    def take(self, message: object) -> Transition | None:
        """The transition that a State completes; None for any other message."""
        if isinstance(message, Command):
            self._command = message
        if not isinstance(message, State):
            return None
        before = self._sequence
        self._sequence = message.sequence
        drones = self.session.num_envs
        nobody = np.zeros(drones, bool)
        if before is None:
            seeds = first_seeds(self.session.seed, drones)
            return Transition(message, None, nobody, ~nobody, seeds)
        command = self._command
        if command is None or not before == command.sequence == message.sequence - 1:
            return Transition(message, None, nobody, nobody, None)
        flown = np.asarray(command.orders == FLY)
        return Transition(message, command, flown, command.resets, command.seeds)

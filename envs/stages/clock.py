"""The clock: who flies and who begins in a step, and how far each episode is."""

import gymnasium as gym
import numpy as np

from ...models.errors import InputError, shortened
from ...sim.state import some
from .record import Mask, Record, Stage


class Clock(Stage):
    """Counts episodes and their control steps."""

    arrays = ("steps", "episodes", "out", "done", "waiting")

    def begin(self, record: Record) -> None:
        """A new episode."""
        record.steps = 0 * record.steps
        record.episodes = record.episodes + 1
        record.out = record.done = record.waiting = record.out & False

    def step(self, record: Record) -> None:
        """Another control step."""
        record.steps = record.steps + 1


def take(record: Record, resets: object, frozen: object) -> None:
    """Set who flies and who begins, from masks of shape (N,), or None.

    Raises:
        InputError: A mask is not one, or has some drones of a world.
        gymnasium.error.ResetNeeded: A drone would fly that waits for a reset.
    """
    begun = None if resets is None else mask_of(record, resets)
    idle = begun
    if frozen is not None:
        held = mask_of(record, frozen)
        idle = held if begun is None else begun | held
    flown = None
    if idle is not None and some(idle):
        flown = ~idle
    late = record.waiting if flown is None else record.waiting & flown
    if some(late):
        first = int(np.flatnonzero(late)[0])
        raise gym.error.ResetNeeded(f"step: expected a call of reset() for env {first} first")
    record.flown = flown
    record.begun = begun if begun is not None and some(begun) else None


def mask_of(record: Record, given: object) -> Mask:
    """A mask of shape (N,) as one of shape (W, A), the same for all drones of a world.

    Raises `InputError`.
    """
    expected = (record.out.size,)
    if not isinstance(given, np.ndarray) or (given.dtype, given.shape) != (np.bool_, expected):
        raise InputError(
            f"resets, frozen: expected bool of shape {expected}, got {shortened(given)}"
        )
    drones: Mask = given.reshape(record.shape)
    if not (drones == drones[:, :1]).all():
        raise InputError(
            f"resets, frozen: expected all {drones.shape[1]} drones of a world or none, "
            "got some of them"
        )
    return drones

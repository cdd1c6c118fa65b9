"""Rewards and ends of a step."""

from dataclasses import dataclass

import numpy as np

from ...models.errors import InputError
from ...sim.state import found
from .record import Floats, Mask, Record, Stage


@dataclass
class Ends(Stage):
    """Sums the terms of a reward. An episode ends by its task, or else by its length.

    A drone that does not fly, or whose own episode has ended, gets no reward and no end.
    """

    arrays = ("reward", "terminated", "truncated", "unfit")

    env_id: str
    """For errors."""
    episode_length: int
    """Control steps after which an episode is truncated."""

    def step(self, record: Record) -> None:
        """Raises `InputError` as `refuse_unfit`."""
        reward = sum(record.terms.values(), 0.0) + np.zeros(record.shape)
        terminated = np.zeros(record.shape, bool) | record.ended
        truncated = (record.steps >= self.episode_length) > terminated
        record.unfit = _unfit(record, reward)
        flying = ~record.out if record.flown is None else record.flown & ~record.out
        reward = np.where(flying | record.unfit, reward, 0.0)
        terminated = terminated & flying
        truncated = truncated & flying
        record.reward = reward
        refuse_unfit(record, self.env_id)
        record.terminated = terminated
        record.truncated = truncated
        record.end(terminated | truncated)


def refuse_unfit(record: Record, env_id: str) -> None:
    """Raise `InputError` for a reward or an observation that is not finite."""
    if not found(record.unfit):
        return
    first = int(np.flatnonzero(record.unfit)[0])
    for name, values in (*record.observations.items(), ("reward", record.reward)):
        numbers = np.reshape(values, (record.unfit.size, -1))[first]
        if not np.isfinite(numbers).all():
            raise InputError(
                f"{env_id}: expected finite numbers for {name}, got {numbers.tolist()} "
                f"for env {first}"
            )


def _unfit(record: Record, reward: Floats) -> Mask:
    """Drones with a reward or an observation that is not finite, (W, A)."""
    unfit: Mask = ~np.isfinite(reward)
    for values in record.observations.values():
        if values.dtype.kind == "f":
            numbers = values.reshape(*record.shape, -1)
            unfit = unfit | ~np.isfinite(numbers).all(axis=-1)
    return unfit

"""Rewards and ends of a step."""

import numpy as np

from ...models.errors import InputError
from ...sim.state import Array
from .record import Floats, Record, Stage, is_finite


class Ends(Stage):
    """Sums the terms of a reward. An episode ends by its task, or else by its length.

    A drone that does not fly, or whose own episode has ended, gets no reward and no end.

    Args:
        env_id: For errors.
        shape: (W, A), or () for a single drone.
        episode_length: Control steps after which an episode is truncated.
    """

    arrays = ("reward", "terminated", "truncated")

    def __init__(self, env_id: str, shape: tuple[int, ...], episode_length: int) -> None:
        self._env_id = env_id
        self._length = episode_length
        self._nobody = np.zeros(shape, bool)[()]
        self._zeros = np.zeros(shape)[()]

    def step(self, record: Record) -> None:
        """Raises `InputError` for a reward or an observation that is not finite."""
        total: Array = 0.0
        for term in record.terms.values():
            total = total + term
        reward = total + self._zeros
        terminated = self._nobody | record.ended
        truncated = (record.steps >= self._length) > terminated
        self._check(record, reward)
        flying = record.flown
        if record.out.any():
            flying = ~record.out if flying is None else flying & ~record.out
        if flying is not None:
            reward = np.where(flying, reward, 0.0)[()]
            terminated = terminated & flying
            truncated = truncated & flying
        record.reward = reward
        record.terminated = terminated
        record.truncated = truncated
        ends = terminated | truncated
        if ends.any():
            record.end(ends)

    def _check(self, record: Record, reward: Floats) -> None:
        for name, values in (*record.observations.items(), ("reward", reward)):
            if is_finite(values):
                continue
            rows = np.reshape(values, (self._nobody.size, -1))
            first = int(np.argmin(np.isfinite(rows).all(axis=1)))
            raise InputError(
                f"{self._env_id}: expected finite numbers for {name}, got "
                f"{rows[first].tolist()} for env {first}"
            )

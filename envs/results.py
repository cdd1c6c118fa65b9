"""What a step of a loop gives."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ..sim import Array, World
from .spec import EnvSpec
from .stages.record import Record
from .tasks.task import Task
from .telemetry import quantities_of


class Results:
    """What the last step gave to N drones: arrays that are new after each step.

    Attributes:
        num_envs: N.
        observations: By name, shape (N, *shape), of the declared dtypes.
        rewards: float64, shape (N,); 0 for a drone that did not fly.
        terminated, truncated: bool, shape (N,).
        done: bool, shape (N,): the world's episode has ended and the next has not begun.
        out: bool, shape (N,): its own has ended.
    """

    def __init__(self, task: Task, world: World, spec: EnvSpec, record: Record) -> None:
        self.task: Task = task
        self.world: World = world
        self.record: Record = record
        self.num_envs = record.out.size
        self._quantities = [quantity for quantity, _ in quantities_of(task)]
        self._arrays = {
            array.name: np.zeros((self.num_envs, *array.shape), array.dtype)
            for array in spec.observation
        }
        self._telemetry: dict[str, NDArray[np.float64]] | None = None
        self.take()

    def take(self) -> None:
        """New arrays of N drones, of the declared dtypes."""
        record = self.record
        count = self.num_envs
        self._telemetry = None
        observations = vars(record).get("observations", self._arrays)
        self.observations = {}
        for name, like in self._arrays.items():
            values = np.array(observations[name], like.dtype)
            self.observations[name] = values.reshape(like.shape)
        self.rewards = np.array(record.reward).reshape(count)
        self.terminated = np.array(record.terminated).reshape(count)
        self.truncated = np.array(record.truncated).reshape(count)
        self.take_ends()

    def take_ends(self) -> None:
        """Which episodes have ended."""
        self.done = np.array(self.record.done).reshape(self.num_envs)
        self.out = np.array(self.record.out).reshape(self.num_envs)

    @property
    def steps(self) -> NDArray[np.int64]:
        """Control steps of each running episode, shape (N,)."""
        return np.array(self.record.steps).reshape(self.num_envs)

    @property
    def terms(self) -> Mapping[str, Array]:
        """Terms of the last rewards by name, with the leading axes of the world."""
        return self.record.terms

    @property
    def reward_terms(self) -> dict[str, NDArray[np.float64]]:
        """Terms of the last rewards by name, each of shape (N,)."""
        return {name: self._per_drone(term) for name, term in self.record.terms.items()}

    @property
    def metrics(self) -> dict[str, NDArray[np.float64]]:
        """Metrics of the task by name, each of shape (N,)."""
        return {name: self._per_drone(value) for name, value in self.record.metrics.items()}

    @property
    def telemetry(self) -> dict[str, NDArray[np.float64]]:
        """By the names of `spec.telemetry`, float64, shape (N, *shape)."""
        if self._telemetry is None:
            self._telemetry = {one.name: one.values(self) for one in self._quantities}
        return self._telemetry

    def row(self) -> list[float]:
        """The telemetry of a single drone in a row."""
        row: list[float] = []
        for quantity in self._quantities:
            row += quantity.read(self).ravel().tolist()
        return row

    def _per_drone(self, values: Array) -> NDArray[np.float64]:
        if not np.ndim(values):  # one number for all drones
            return np.full(self.num_envs, values, np.float64)
        return np.array(values).reshape(self.num_envs)

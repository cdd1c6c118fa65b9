"""The task: the starts of episodes, its memory, observations, rewards and ends."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from typing import NoReturn

import numpy as np

from ...models.errors import InputError, shortened
from ...sim import InitialState, World
from ...sim.state import ByName, some
from ..tasks.task import Outcome, Task
from .record import Record, Stage


@dataclass
class Starts(Stage):
    """The task begins episodes: it draws their numbers and sets `record.start`.

    Raises `InputError` if it gives another thing.
    """

    task: Task
    world: World

    def begin(self, record: Record) -> None:
        """Other stages follow from the start."""
        record.draw = self.world.draw(record.begun)
        memory = self.task.memory
        with memory.open("begin"):
            start = self.task.begin(record.draw)
        memory.expand(record.shape)
        expected = (*record.shape, 3)
        got: object = type(start).__name__
        if isinstance(start, InitialState):
            got = tuple(getattr(start.position, "shape", ()))
        if got != expected:
            wanted = f"begin() to return an InitialState with a position of shape {expected}"
            refuse(self.task, wanted, got)
        record.start = start


@dataclass
class Remember(Stage):
    """The task changes its memory of the drones that flew."""

    task: Task

    def step(self, record: Record) -> None:
        """Before it observes."""
        if some(record.flown):
            record.run(record.flown, [self._update])

    def _update(self, record: Record) -> None:
        with self.task.memory.open("update"):
            self.task.update_memory(record.state)


@dataclass
class Judge(Stage):
    """Observations, terms of the reward, metrics and ends by the task."""

    arrays = ("observations", "terms", "metrics")

    task: Task
    _checked = False

    def step(self, record: Record) -> None:
        """Raises `InputError` if the task gives another thing than its specs say."""
        observations = self.task.observe(record.measured)
        outcome = self.task.outcome(record.state)
        if not self._checked:
            self._check(observations, outcome, record)
            self._checked = True
        record.observations = {
            array.name: observations[array.name]
            .reshape(*record.shape, *array.shape)
            .astype(array.dtype)
            for array in self.task.observation
        }
        record.terms = _of_each(outcome.reward, record)
        record.metrics = _of_each(outcome.metrics, record)
        record.ended = outcome.terminated

    def _check(self, observations: object, outcome: object, record: Record) -> None:
        task = self.task
        names = [array.name for array in task.observation]
        given = list(observations) if isinstance(observations, Mapping) else observations
        if not isinstance(observations, Mapping) or not observations.keys() >= set(names):
            refuse(task, f"observe() to return a dict of {names}", given)
        count = prod(record.shape)
        for array in task.observation:
            shape = tuple(getattr(observations[array.name], "shape", ()))
            if prod(shape) != count * array.size:
                expected = f"{array.name} of shape {array.shape} for each of {count} drones"
                refuse(task, f"observe() to return {expected}", f"an array of shape {shape}")
        if not isinstance(outcome, Outcome):
            refuse(task, "outcome() to return an Outcome", outcome)
        for metric in task.metrics:
            if metric.name not in outcome.metrics:
                refuse(task, f"the metric {metric.name!r}", list(outcome.metrics))
        if not any(np.ndim(term) for term in outcome.reward.values()):
            got = f"{outcome.reward}: make an array of it, as 1.0 + 0.0 * state.position[..., 2]"
            refuse(task, "a reward for each drone", got)
        kind = getattr(outcome.terminated, "dtype", type(outcome.terminated))
        if np.dtype(kind) != np.bool_:
            refuse(task, "terminated as truth values", outcome.terminated)


def refuse(task: Task, expected: str, got: object) -> NoReturn:
    """Raise `InputError` that names the task."""
    said = got if isinstance(got, str) else shortened(got)
    raise InputError(f"{task.config.env_id}: expected {expected}, got {said}")


def _of_each(numbers: ByName, record: Record) -> ByName:
    """Numbers of each drone, (W, A), where one stands for all."""
    return {name: np.broadcast_to(one, record.shape) for name, one in numbers.items()}

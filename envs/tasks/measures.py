"""What tasks in scenes measure of an episode: success, touch, speeds, clearance and time."""

import numpy as np

from ...models.files import read_own_toml
from ...sim import Array, length
from ..spec import Metric
from ..state import State
from .goal import FLIGHT_TIME
from .task import Task

_OWN = read_own_toml(__file__, "measures").items()
METRICS = (*[Metric(name=name, final=True, **row) for name, row in _OWN], FLIGHT_TIME)


def begin_measures(task: Task) -> None:
    """Set the memory of the measures, in `begin`."""
    memory = task.memory
    memory.path = memory.top = 0.0
    memory.least = np.inf


def update_measures(task: Task, state: State) -> None:
    """Add a step to the memory: the way that was flown, the top speed, what came nearest."""
    memory = task.memory
    speed = length(state.velocity)
    memory.path = memory.path + speed * task.control_period
    memory.top = np.maximum(memory.top, speed)
    memory.least = np.minimum(memory.least, state.clearance)


def measures_of(task: Task, state: State, success: Array) -> dict[str, Array]:
    """By the names of `METRICS`, each of shape (W, A); `success` is bool."""
    memory = task.memory
    time = np.maximum(state.time, task.control_period)
    return {
        "success": success * 1.0,
        "touched": state.touching * 1.0,
        "mean_speed": memory.path / time,
        "top_speed": memory.top,
        "least_clearance": np.minimum(memory.least, state.clearance),
        "flight_time": state.time,
    }

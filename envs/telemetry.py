"""The telemetry of a drone: each number is declared here, once."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..models.frames import attitudes_in_paper_frame, positions_in_paper_frame
from ..sim import PARAMETERS, Randomization
from ..sim.state import Array
from .spec import ArraySpec
from .tasks.task import Task

if TYPE_CHECKING:
    from .results import Results


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """A number or a vector of the telemetry: its spec, and how it is read of a loop."""

    spec: ArraySpec
    read: Callable[["Results"], Array]
    """Gives an array of shape (W, A, *shape), or () for a number of a single drone."""

    def values(self, loop: "Results") -> NDArray[np.float64]:
        """float64, shape (N, *shape)."""
        values = np.asarray(self.read(loop), np.float64)
        return values.reshape(loop.num_envs, *self.spec.shape)


def quantities_of(task: Task) -> tuple[Quantity, ...]:
    """What is told of each drone that flies a task, in the order in which it crosses the wire."""
    quantities = [_POSITION, _ATTITUDE, _thrust(task)]
    if drawn := Randomization(task.config.randomize, task.config.effects).names:
        quantities.append(_drawn(drawn))
    if task.config.effects.payload:
        quantities.append(_PAYLOAD)
    if type(task).goal is not Task.goal:
        quantities.append(_GOAL)
    if task.metrics:
        quantities.append(_metrics(task))
    return tuple(quantities)


def _quantity(
    name: str, components: tuple[str, ...], read: Callable[["Results"], Array], **rest: Any
) -> Quantity:
    spec = ArraySpec(
        name=name, shape=(len(components),), dtype="float64", components=components, **rest
    )
    return Quantity(spec=spec, read=read)


_POSITION = _quantity(
    "position",
    ("X", "Y", "Z"),
    lambda loop: positions_in_paper_frame(loop.record.state.position),
    unit="m",
    frame="paper",
)
_ATTITUDE = _quantity(
    "attitude",
    ("phi", "theta", "psi"),
    lambda loop: attitudes_in_paper_frame(loop.record.state.quaternion),
    unit="deg",
    frame="paper",
)
_PAYLOAD = _quantity(
    "payload",
    ("X_payload", "Y_payload", "Z_payload"),
    lambda loop: positions_in_paper_frame(loop.record.state.payload),
    unit="m",
    frame="paper",
)
_GOAL = _quantity(
    "goal",
    ("X_goal", "Y_goal", "Z_goal"),
    lambda loop: positions_in_paper_frame(loop.task.goal(loop.record.state)),
    unit="m",
    frame="paper",
)


def _thrust(task: Task) -> Quantity:
    """Bounds are those of the commands: a rotor whose efficiency is drawn may leave them."""
    vehicle = task.vehicle
    return _quantity(
        "thrust",
        tuple(f"F{rotor + 1}" for rotor in range(vehicle.num_rotors)),
        lambda loop: loop.record.state.thrust,
        unit="N",
        low=tuple(np.atleast_2d(vehicle.thrust_low).min(axis=0).tolist()),
        high=tuple(np.atleast_2d(vehicle.thrust_high).max(axis=0).tolist()),
    )


def _drawn(names: tuple[str, ...]) -> Quantity:
    def read(loop: "Results") -> Array:
        return np.stack([loop.world.parameters[name] for name in names], axis=-1)

    units = tuple(PARAMETERS[name].unit for name in names)
    return _quantity("drawn", tuple(f"drawn_{name}" for name in names), read, unit=units)


def _metrics(task: Task) -> Quantity:
    names = tuple(metric.name for metric in task.metrics)

    def read(loop: "Results") -> Array:
        metrics = loop.record.metrics
        zero = np.zeros(loop.record.shape)
        return np.stack([metrics[name] + zero for name in names], axis=-1)

    return _quantity("metrics", names, read, unit=tuple(metric.unit for metric in task.metrics))

"""The telemetry of a drone: each number is declared here, once.

World frame: z up. Body frame: x forward, y left, z up. SI units.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from ..sim import PARAMETERS, Randomization
from ..sim.state import Array, stack
from .spec import BODY, BODY_TO_WORLD, WORLD, ArraySpec, Bound
from .tasks.task import Task

if TYPE_CHECKING:
    from .results import Results

Names = tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """A vector of the telemetry. What depends on the task is a function of it."""

    name: str
    components: Names | Callable[[Task], Names]
    """A name for each number. Empty: the env does not have it, as when a feature is off."""
    unit: str | Names | Callable[[Task], Names] = ""
    frame: str = ""
    bounds: Callable[[Task], tuple[Bound, Bound]] = lambda task: (-np.inf, np.inf)
    read: Callable[["Results"], Array]
    """Gives an array of shape (W, A, n), or one that broadcasts to it; (n,) of a single drone."""

    def spec(self, task: Task) -> ArraySpec | None:
        """What crosses the wire; None where the task does not have it."""
        components = self.components(task) if callable(self.components) else self.components
        if not components:
            return None
        low, high = self.bounds(task)
        return ArraySpec(
            name=self.name,
            shape=(len(components),),
            dtype="float64",
            low=low,
            high=high,
            unit=self.unit(task) if callable(self.unit) else self.unit,
            frame=self.frame,
            components=components,
        )

    def values(self, loop: "Results") -> NDArray[np.float64]:
        """A new array, float64, shape (N, n)."""
        read = np.asarray(self.read(loop), np.float64)
        rows = np.broadcast_to(read, (*loop.record.shape, read.shape[-1]))
        return np.array(rows).reshape(loop.num_envs, -1)


def quantities_of(task: Task) -> list[tuple[Quantity, ArraySpec]]:
    """What a task's drones have, in the order in which it crosses the wire."""
    found = []
    for quantity in QUANTITIES:
        spec = quantity.spec(task)
        if spec is not None:
            found.append((quantity, spec))
    return found


def _rotors(task: Task) -> Names:
    return tuple(f"F{rotor + 1}" for rotor in range(task.vehicle.num_rotors))


def _thrust_bounds(task: Task) -> tuple[Bound, Bound]:
    """Those of the commands: a rotor whose efficiency is drawn may leave them."""
    low = np.atleast_2d(task.vehicle.thrust_low).min(axis=0)
    high = np.atleast_2d(task.vehicle.thrust_high).max(axis=0)
    return tuple(low.tolist()), tuple(high.tolist())


def _battery(loop: "Results") -> Array:
    effects = loop.world.effects
    assert effects is not None
    return stack([effects.rotors.charge, effects.rotors.voltage])


def _wind_names(task: Task) -> Names:
    effects = task.config.effects
    winds = ("wind_x", "wind_y", "wind_z")
    blows = effects.gusts > 0 or any(effects.wind)
    return winds if blows or not set(winds).isdisjoint(_drawn(task)) else ()


def _wind(loop: "Results") -> Array:
    effects = loop.world.effects
    assert effects is not None
    return stack(effects.wind)


def _drawn(task: Task) -> Names:
    return Randomization(task.config.randomize, task.config.effects).names


def _drawn_numbers(parameters: dict[str, Array]) -> Array:
    return stack([parameters[name] for name in PARAMETERS if name in parameters])


def _metric_names(task: Task) -> Names:
    return tuple(metric.name for metric in task.metrics)


QUANTITIES: Final = (
    Quantity(
        name="position",
        components=("x", "y", "z"),
        unit="m",
        frame=WORLD,
        read=lambda loop: loop.record.state.position,
    ),
    Quantity(
        name="attitude",
        components=("qw", "qx", "qy", "qz"),
        frame=BODY_TO_WORLD,
        read=lambda loop: loop.record.state.quaternion,
    ),
    Quantity(
        name="velocity",
        components=("vx", "vy", "vz"),
        unit="m/s",
        frame=WORLD,
        read=lambda loop: loop.record.state.velocity,
    ),
    Quantity(
        name="body_rates",
        components=("rate_x", "rate_y", "rate_z"),
        unit="rad/s",
        frame=BODY,
        read=lambda loop: loop.record.state.body_rates,
    ),
    Quantity(
        name="thrust",
        components=_rotors,
        unit="N",
        bounds=_thrust_bounds,
        read=lambda loop: loop.record.state.thrust,
    ),
    Quantity(
        name="battery",
        components=lambda task: ("charge", "voltage") if task.config.effects.battery else (),
        unit=("1", "V"),
        read=_battery,
    ),
    Quantity(
        name="wind",
        components=_wind_names,
        unit="m/s",
        frame=WORLD,
        read=_wind,
    ),
    Quantity(
        name="drawn",
        components=lambda task: tuple(f"drawn_{name}" for name in _drawn(task)),
        unit=lambda task: tuple(PARAMETERS[name].unit for name in _drawn(task)),
        read=lambda loop: _drawn_numbers(loop.world.parameters),
    ),
    Quantity(
        name="payload",
        components=lambda task: (
            ("payload_x", "payload_y", "payload_z") if task.config.effects.payload else ()
        ),
        unit="m",
        frame=WORLD,
        read=lambda loop: loop.record.state.payload,
    ),
    Quantity(
        name="goal",
        components=lambda task: (
            ("goal_x", "goal_y", "goal_z") if type(task).goal is not Task.goal else ()
        ),
        unit="m",
        frame=WORLD,
        read=lambda loop: loop.task.goal(loop.record.state),
    ),
    Quantity(
        name="metrics",
        components=_metric_names,
        unit=lambda task: tuple(metric.unit for metric in task.metrics),
        read=lambda loop: stack([loop.record.metrics[one.name] for one in loop.task.metrics]),
    ),
)
"""All of them, in the order in which they cross the wire."""

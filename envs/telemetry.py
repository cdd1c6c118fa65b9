"""The telemetry of a drone: each number is declared here, once.

World frame: z up. Body frame: x forward, y left, z up. SI units.
"""

from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING

import numpy as np

from ..sim import PARAMETERS
from ..sim.randomize import CHANGE
from ..sim.state import Array, ByName, stack
from .spec import BODY, BODY_TO_WORLD, WORLD, ArraySpec, Bound
from .tasks.task import Task

if TYPE_CHECKING:
    from .loop import Loop

Names = tuple[str, ...]


@dataclass(frozen=True)
class Quantity:
    """A vector of the telemetry."""

    name: str
    components: Names
    unit: str | Names
    read: Callable[["Loop"], Array]
    """Gives an array of shape (W, A, n), or one that broadcasts to it."""
    frame: str = ""
    low: Bound = -np.inf
    high: Bound = np.inf

    @property
    def spec(self) -> ArraySpec:
        """What crosses the wire."""
        return ArraySpec(
            name=self.name,
            shape=(len(self.components),),
            dtype="float64",
            low=self.low,
            high=self.high,
            unit=self.unit,
            frame=self.frame,
            components=self.components,
        )


def _of_state(name: str, components: Names, unit: str, frame: str, field: str = "") -> Quantity:
    return Quantity(name, components, unit, attrgetter(f"record.state.{field or name}"), frame)


POSE = (
    _of_state("position", ("x", "y", "z"), "m", WORLD),
    _of_state("attitude", ("qw", "qx", "qy", "qz"), "", BODY_TO_WORLD, "quaternion"),
    _of_state("velocity", ("vx", "vy", "vz"), "m/s", WORLD),
    _of_state("body_rates", ("rate_x", "rate_y", "rate_z"), "rad/s", BODY),
)
"""What every drone has."""


def quantities_of(task: Task) -> list[Quantity]:
    """What a task's drones have, in the order in which it crosses the wire."""
    effects = task.config.effects
    drawn = task.config.drawn.names
    quantities = [*POSE, _thrust(task)]
    if effects.battery:
        quantities.append(Quantity("battery", ("charge", "voltage"), ("1", "V"), _battery))
    winds = ("wind_x", "wind_y", "wind_z")
    blows = effects.gusts > 0 or any(effects.wind)
    if blows or not set(winds).isdisjoint(drawn):
        quantities.append(Quantity("wind", winds, "m/s", _wind, WORLD))
    if drawn:
        names = tuple(f"drawn_{name}" for name in drawn)
        units = tuple(PARAMETERS.get(name, CHANGE).unit for name in drawn)
        quantities.append(Quantity("drawn", names, units, _drawn))
    if effects.payload:
        names = ("payload_x", "payload_y", "payload_z")
        quantities.append(_of_state("payload", names, "m", WORLD))
    if len(task.config.scene.given_scenes) != 1:
        quantities.append(Quantity("layout", ("layout",), "", _layout))
    if type(task).goal is not Task.goal:
        quantities.append(Quantity("goal", ("goal_x", "goal_y", "goal_z"), "m", _goal, WORLD))
    if task.metrics:
        names = tuple(metric.name for metric in task.metrics)
        units = tuple(metric.unit for metric in task.metrics)
        quantities.append(Quantity("metrics", names, units, _metrics))
    return quantities


def telemetry_of(loop: "Loop") -> ByName:
    """What a loop's quantities are now, by name, (W, A, n)."""
    arrays = {}
    for one in loop.quantities:
        shape = (*loop.record.shape, len(one.components))
        arrays[one.name] = np.broadcast_to(one.read(loop), shape)
    return arrays


def _thrust(task: Task) -> Quantity:
    """Its bounds are those of the commands: a rotor whose efficiency is drawn may leave them."""
    vehicle = task.vehicle
    return Quantity(
        "thrust",
        tuple(f"F{rotor + 1}" for rotor in range(vehicle.num_rotors)),
        "N",
        attrgetter("record.state.thrust"),
        low=tuple(np.atleast_2d(vehicle.thrust_low).min(axis=0).tolist()),
        high=tuple(np.atleast_2d(vehicle.thrust_high).max(axis=0).tolist()),
    )


def _battery(loop: "Loop") -> Array:
    rotors = loop.world.effects.rotors
    return stack([rotors.charge, rotors.voltage])


def _wind(loop: "Loop") -> Array:
    return stack(loop.world.effects.wind)


def _drawn(loop: "Loop") -> Array:
    drawn = loop.world.parameters
    return stack([drawn[name] for name in loop.world.randomize.names])


def _layout(loop: "Loop") -> Array:
    """Seed of the layout of each world."""
    return stack((loop.world.scenery.seeds[:, None],))


def _goal(loop: "Loop") -> Array:
    return loop.task.goal(loop.record.state)


def _metrics(loop: "Loop") -> Array:
    metrics = loop.record.metrics
    return stack([metrics[metric.name] for metric in loop.task.metrics])

"""Tasks by env id with their options, and the spec of an env."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..models.errors import InputError
from ..models.fleet import Fleet, load_vehicles
from ..models.swarm import drone_names
from ..scenes import scenes_of
from ..sim import Controller
from ..sim.sensors import readings_of
from . import registry
from .spec import ArraySpec, Discrete, EnvSpec, canonical_id
from .stages.history import with_history
from .stages.pictures import arrays_of, objects_of_all, views_of
from .tasks.task import Task
from .telemetry import quantities_of


def make_task(
    env_id: str,
    options: Mapping[str, Any],
    vehicle: Path | str | None = None,
    shape: tuple[int, int] = (1, 1),
) -> Task:
    """The task of an env id with options by name, for W worlds of A drones. Raises `InputError`."""
    kind = registry.task_type(env_id)
    for name in ("setup", "begin", "observe", "outcome"):
        if getattr(kind, name) is getattr(Task, name):
            raise InputError(
                f"{env_id}: expected a task with a method {name}(), got {kind.__name__} without one"
            )
    checked = kind.Options.from_options(options)
    drones = shape[1]
    if type(drones) is not int or not kind.fewest <= drones <= kind.drones:
        several = f"{kind.fewest} to {kind.drones}" if kind.drones > kind.fewest else "1"
        raise InputError(f"drones: expected {several} with {canonical_id(env_id)}, got {drones!r}")
    craft = load_vehicles(vehicle, drones, linear_drag=checked.linear_drag)
    craft.substeps(checked.control_period)  # raises where they do not go together
    if checked.sensors and isinstance(craft, Fleet):
        raise InputError(
            f"sensors: expected none with several vehicles, got {', '.join(checked.sensors)}"
        )
    task = kind(checked, craft, shape)
    for name in ("controller", "observation"):
        if not hasattr(task, name):
            raise InputError(f"{env_id}: expected setup() to set self.{name}, it does not")
    return task


def spec_of(
    env_id: str, task: Task, drones: int = 1, pictures: tuple[ArraySpec, ...] | None = None
) -> EnvSpec:
    """The `EnvSpec` of a task's env with so many drones in a world, and with these pictures."""
    options = task.options
    observation = [with_history(array, options.history) for array in observed(task)]
    observation += _pictures(task, drones) if pictures is None else pictures
    return EnvSpec(
        env_id=env_id,
        options=options.to_options(),
        control_period=options.control_period,
        vehicle=task.vehicle.name,
        vehicle_hash=task.vehicle.hash,
        agents=drone_names(drones),
        observation=tuple(observation),
        action=_action(task.controller),
        telemetry=tuple(quantity.spec for quantity in quantities_of(task)),
        metrics=task.metrics,
        marks=task.marks,
    )


def observed(task: Task) -> tuple[ArraySpec, ...]:
    """What is observed of one moment: by the task, and by sensors."""
    options = task.options
    readings = readings_of(options.sensors, task.vehicle, options.control_period)
    return task.observation + tuple(ArraySpec(**reading._asdict()) for reading in readings)


def _action(controller: Controller) -> ArraySpec | Discrete:
    if controller.choices:
        return Discrete(n=controller.choices, components=controller.components)
    return ArraySpec(
        name="action",
        shape=(len(controller.low),),
        low=controller.low,
        high=controller.high,
        unit=getattr(controller, "units", ""),
        frame=getattr(controller, "frame", ""),
        components=controller.components,
    )


def _pictures(task: Task, drones: int) -> tuple[ArraySpec, ...]:
    """What cameras add to an observation; nothing is drawn."""
    if not task.options.cameras:
        return ()
    views = views_of(task, drones)
    if not any(view.kind == "segmentation" for view in views):
        return arrays_of(views, ())
    from ..rendering.seen import objects_of

    payload = bool(task.effects.get("payload"))
    objects = []
    for scene in scenes_of(task.options.world):
        objects.append(objects_of(task.vehicle, drones, scene, task.marks, payload=payload))
    return arrays_of(views, objects_of_all(objects))

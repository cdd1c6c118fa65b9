"""Tasks by env id with their options, and the spec of an env."""

from ..models.cameras import chosen_views
from ..models.errors import InputError
from ..models.swarm import drone_names
from ..sim import Controller
from ..sim.control import RotorThrust, rotor_constants
from ..sim.sensors import range_sensors_of, readings_of
from ..sim.sensors.instruments import Instrument
from ..sim.sensors.range_sensors import RangeSensor
from . import registry
from .config import EnvConfig
from .events import asks_of
from .pictures import Pictures, arrays_of, objects_of_all
from .spec import ArraySpec, Discrete, EnvSpec
from .stages.history import with_history
from .stages.measure import drawn_array
from .tasks.task import Task
from .telemetry import quantities_of


def make_task(config: EnvConfig, shape: tuple[int, int] = (1, 1)) -> Task:
    """The task of a config, for W worlds of A drones. Raises `InputError`."""
    task_class = registry.task_type(config.env_id)
    missing = ", ".join(sorted(task_class.__abstractmethods__))
    if missing:
        raise InputError(
            f"{config.env_id}: expected a task with the methods {missing}, "
            f"got {task_class.__name__} without them"
        )
    task = task_class(config, config.load_vehicle(), shape)
    if not hasattr(task, "observation"):
        raise InputError(f"{config.env_id}: expected setup() to set self.observation, it does not")
    if task.config is not config:
        _check_kept(config, task.config)
    return task


def _check_kept(config: EnvConfig, adjusted: EnvConfig) -> None:
    """Raise `InputError` if a task's `adjust` dropped or changed a setting of the user."""
    now = adjusted.keywords()
    for name, value in config.keywords().items():
        if isinstance(value, dict):
            value = {**now.get(name, {}), **value}
        if now.get(name) != value:
            raise InputError(
                f"{config.env_id}: expected adjust() to keep {name}, got {now.get(name)!r}"
            )


def spec_of(config: EnvConfig, task: Task) -> EnvSpec:
    """The `EnvSpec` of a config's env, whose task is made."""
    observation = [with_history(array, config.history) for array in observed(task)]
    observation += _pictures(task)
    if config.observe_drawn:
        observation.append(drawn_array(task.config.drawn))
    for sensor in range_sensors_in(task):
        array = ArraySpec(
            name=sensor.name,
            shape=sensor.shape,
            low=0.0,
            high=sensor.errors.reach,
            unit="m",
            frame=sensor.frame,
            axes=sensor.axes,
        )
        observation.append(array)
    constants = getattr(task.controller, "constants", {})
    if isinstance(task.controller, RotorThrust):
        constants = rotor_constants(task.vehicle, config.effects)
    return EnvSpec(
        env_id=config.env_id,
        options=config.flat_options(),
        control_period=task.control_period,
        vehicle=task.vehicle.name,
        vehicle_hash=task.vehicle.hash,
        config_digest=config.digest,
        agents=drone_names(config.drones),
        observation=tuple(sorted(observation, key=lambda array: array.privileged)),
        action=_action(task.controller),
        telemetry=tuple(quantity.spec for quantity in quantities_of(task)),
        metrics=task.metrics,
        constants={
            "gravity": task.vehicle.gravity,
            "radius": task.vehicle.radius,
            **constants,
        },
        marks=task.marks,
        asks=asks_of(config.events),
    )


def observed(task: Task) -> tuple[ArraySpec, ...]:
    """What is observed of one moment: by the task, and by sensors."""
    readings = readings_of(task.config.sensors, task.vehicle, task.control_period)
    return task.observation + tuple(ArraySpec(**reading) for reading in readings)


def range_sensors_in(task: Task) -> list[RangeSensor]:
    """Sensors with rays of a task's drones. Raises `InputError`."""
    config = task.config
    latest = config.drawn.most_steps("observation_delay")
    return range_sensors_of(config.sensors, task.control_period, latest, task.vehicle.radius)


def instruments_of(task: Task) -> list[Instrument]:
    """What measures after each step, in the order of the observation."""
    instruments: list[Instrument] = []
    if task.config.cameras:
        instruments.append(Pictures(task))
    return instruments + range_sensors_in(task)


def _action(controller: Controller) -> ArraySpec | Discrete:
    if controller.choices:
        return Discrete(choices=controller.choices, components=controller.components)
    return ArraySpec(
        name="action",
        shape=(len(controller.low),),
        low=controller.low,
        high=controller.high,
        unit=getattr(controller, "units", ""),
        frame=getattr(controller, "frame", ""),
        components=controller.components,
    )


def _pictures(task: Task) -> tuple[ArraySpec, ...]:
    """What cameras add to an observation; nothing is drawn."""
    config = task.config
    views = chosen_views(config.cameras, task.vehicle.cameras)
    if not any(view.kind == "segmentation" for view in views):
        return arrays_of(views, ())
    from ..rendering.cameras import drawn_model, objects_in

    payload = config.effects.payload > 0
    objects = []
    for scene in config.scene.given_scenes:
        model = drawn_model(task.vehicle, config.drones, scene, task.marks, payload=payload)
        objects.append(objects_in(model)[0])
    return arrays_of(views, objects_of_all(objects))

"""The list of a loop's stages, in its order; a feature that is off is not in it."""

import numpy as np

from ..sim import World
from ..sim.sensors import SENSOR_TYPES, Sensors
from .actions import Actions
from .specification import observed
from .stages.actions import ActionDelay, Receive
from .stages.clock import Clock
from .stages.ends import Ends
from .stages.events import Events
from .stages.flight import Control, Flight, StandStill
from .stages.history import History, ObservationDelay
from .stages.judge import Judge, Remember, Starts
from .stages.measure import Drawn, Measure, Readings, Sensing
from .stages.radio import Radio
from .stages.record import Stage
from .tasks.task import Task


class Pipeline:
    """Stages by region.

    A step has four regions: the clock, for all drones; flight, for those that fly; begin, for those
    whose episode begins; and from `Measure` on for both, together.

    Attributes:
        actions: Checks what an agent sends.
        stages: In the order in which an episode begins.
        fly: Steps of the drones that fly.
        begin: What all of them do when an episode begins.
        observe: Steps from `Measure` on.
        flight: One of the stages; of worlds whose physics is apart it has the parts that follow.
        before: `fly` before the physics.
        set_out, sense: `begin` before the physics, and after it.
    """

    def __init__(self, task: Task, world: World) -> None:
        config = task.config
        controller = task.controller
        period = task.control_period
        randomize = world.randomize
        look = lambda: world.state  # noqa: E731
        sensors = None
        if not config.sensors.keys().isdisjoint(SENSOR_TYPES):
            sensors = Sensors(config.sensors, world, period)
        if sensors is not None and config.estimated:
            look = sensors.seen
        self.actions = Actions(
            world.shape, (len(controller.low),), np.dtype(np.float32), controller.choices
        )
        neutral = self.actions.neutral()
        substeps = task.vehicle.substeps(period)
        # An estimate is computed once in a control step, and so is a thrust that follows from it.
        often = getattr(controller, "every_step", False) and not config.estimated
        held = 1 if often else substeps
        parts: list[Stage] = [Control(controller, look)]
        if world.shape[1] > 1 or "link_off" in randomize.names:
            vehicle = task.vehicle
            rest = np.clip(0.0, vehicle.thrust_low, vehicle.thrust_high)
            parts.append(StandStill(world, rest))

        flying: list[Stage] = [Receive(neutral)]
        if "action_delay" in randomize.names:
            flying.append(ActionDelay(world, randomize.most_steps("action_delay"), neutral))
        self.flight = flight = Flight(world, parts, substeps, held)
        flying += [Clock(), flight]

        events = [Events(task, world)] if config.events else []
        observing = self._observing(task, world, sensors)
        if "observation_delay" in randomize.names:
            longest = randomize.most_steps("observation_delay")
            observing.append(ObservationDelay(world, longest))
        if config.history > 1:
            observing.append(History(config.history))
        if config.observe_drawn:
            observing.append(Drawn(world))
        observing.append(Ends(config.env_id, task.episode_length))

        self.stages = [Starts(task, world), *flying, *events, *observing]
        self.fly = [*[stage.act for stage in events], *[stage.step for stage in flying]]
        self.observe = [stage.step for stage in (*observing, *events)]
        self.before = [*self.fly[:-1], flight.control]
        self.set_out = [one.begin for one in self.stages if not isinstance(one, Sensing)]
        self.sense = [one.begin for one in self.stages if isinstance(one, Sensing)]
        self.begin = [*self.set_out, flight.place, *self.sense]

    def _observing(self, task: Task, world: World, sensors: Sensors | None) -> list[Stage]:
        """From the measurement to the observation of the present."""
        config = task.config
        period = task.control_period
        stages: list[Stage] = [Measure(world, period)]
        if sensors is not None:
            stages.append(Sensing(sensors, replaces=config.estimated))
        stages.append(Remember(task))
        if task.has_radio:
            stages.append(Radio(task.options, period, config.drones, task.ended))
        stages.append(Judge(task))
        if sensors is not None:
            stages.append(Readings(sensors, observed(task) if config.estimated else ()))
        return stages

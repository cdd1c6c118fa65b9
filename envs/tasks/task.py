"""Base of tasks. One class serves every backend, one drone or thousands, in process or over UDP.

A task is written for arrays of W worlds and the A drones of each. It counts axes from the last
(`position[..., 2]`), uses operators, `stack` and NumPy's functions, and never changes an array in
place.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, ClassVar, Self

from ...models.errors import InputError, UnknownOption
from ...models.fields import check_fields, immutable
from ...scenes import SceneConfig
from ...sim import LEVELS, Array, Controller, Draw, InitialState, make_controller
from ..memory import Memory
from ..spec import ArraySpec, Mark, Metric
from ..state import State

if TYPE_CHECKING:
    from ...models.vehicle import Vehicle
    from ..config import EnvConfig

HORIZON = 100  # 1 / (1 - γ) of the largest discount, γ = 0.99: see `Task.crash`


@immutable
class TaskOptions:
    """Base of the options of a task: derive, add fields, and check them in `check`.

    Annotations say what they may be (see `models.fields`), and `check` what they have to do with
    each other. Numbers may be of any real type, NumPy's among them; they are kept as Python's.
    """

    def __post_init__(self) -> None:
        check_fields(self)
        self.check()

    def check(self) -> None:
        """Check options that depend on each other, each within its limits. Raises `InputError`."""

    def to_options(self) -> dict[str, Any]:
        """Every option by its name."""
        return {**vars(self)}

    @classmethod
    def from_options(cls, options: Mapping[str, Any], others: Sequence[str] = ()) -> Self:
        """Options by name. An unknown name raises `UnknownOption`, which names all: the options,
        and the `others` that are keywords of an env.
        """
        known = [field.name for field in fields(cls)]
        for name in options:
            if name not in known:
                names = ", ".join([*known, *others])
                # TorchRL looks for Python's own words, and tries again without the keyword.
                got = f"an unexpected keyword argument {name!r}"
                raise UnknownOption(f"options: expected some of {names}, got {got}")
        return cls(**options)


@dataclass(kw_only=True, slots=True)
class Outcome:
    """Result of a control step."""

    reward: dict[str, Array]
    """Terms by name, each of shape (W, A) or one number for all; their sum is the reward. One term
    at least has the shape."""
    terminated: Array
    """Whether the episode ends here for another reason than time, bool, shape (W, A)."""
    metrics: dict[str, Array]
    """By the names of `Task.metrics`, each of shape (W, A) or one number for all."""


class Task(ABC):
    """Base of all tasks: derive, as `examples/landing.py` does, and `register` it.

    Class attributes:
        Options: Dataclass of the task's options.
        metrics: Measures of how well it is done. The first is the headline.
        min_drones, max_drones: Drones of one world; the task separates their starts.
        actions: Action levels at which the task can be flown.
        action, control_period, episode_length: Defaults of an `EnvConfig`.
        defaults: Further ones: its fields `vehicle`, `sensors` and `backend`, where they are empty.
        has_radio: Whether drones hear each other: see `stages/radio.py`.
        worst_step: No step's reward is lower, but for terms that add up to a difference, as
            progress does.

    Attributes:
        config: The env's, with what `adjust` added.
        options: The task's own options.
        action, control_period, episode_length: Those of the config.
        vehicle: The vehicle of all drones, or a `Fleet`.
        shape: (W, A).
        memory: What lasts from step to step of an episode; nothing else does.
        controller: Turns actions into thrusts: that of the option `action`, unless `setup` sets
            another.
        observation: Specs of one drone's observation; set by `setup`.
        marks: What pictures show of the task besides the goal; set by `setup` where there is any.
    """

    Options: ClassVar[type[TaskOptions]] = TaskOptions
    metrics: ClassVar[tuple[Metric, ...]] = ()
    min_drones = 1
    max_drones = 1
    actions: ClassVar[tuple[str, ...]] = LEVELS
    defaults: ClassVar[Mapping[str, Any]] = {}
    has_radio = False
    worst_step = 0.0

    action = "rotors"
    control_period = 0.02
    """s; the default is that of Unity's `FixedUpdate`."""
    episode_length = 250
    """Control steps."""
    controller: Controller
    observation: tuple[ArraySpec, ...]
    marks: tuple[Mark, ...] = ()

    def __init__(self, config: "EnvConfig", vehicle: "Vehicle", shape: tuple[int, int]) -> None:
        self.config = config
        self.vehicle = vehicle
        self.shape = shape
        self.options: Any = type(self).Options.from_options(config.task)
        assert config.action
        assert config.control_period
        assert config.episode_length
        self.action = config.action
        self.control_period = config.control_period
        self.episode_length = config.episode_length
        self.memory: Any = Memory()
        period = self.control_period if config.estimated else vehicle.timestep
        of_level = make_controller(self.action, vehicle, period, config.effects)
        self.controller = of_level
        self.setup()
        self.config = self.adjust(config)
        vars(self)["_is_set_up"] = True
        task = type(self)
        ignored = self.controller is not of_level and task.actions is Task.actions
        if ignored and self.action != task.action:
            raise InputError(
                f"action: expected {task.action!r}, for the task has a controller of its own, "
                f"which no other flies, got {self.action!r}"
            )

    def __setattr__(self, name: str, value: object) -> None:
        """Raises `AttributeError` after `setup`: what changes belongs into `memory`."""
        if "_is_set_up" in vars(self):
            raise AttributeError(
                f"{type(self).__name__}.{name}: expected self.memory.{name} = ..., "
                f"got self.{name} = ... outside setup()"
            )
        super().__setattr__(name, value)

    def adjust(self, config: "EnvConfig") -> "EnvConfig":
        """The config with what the task adds to it, such as a payload; called after `setup`.

        It may add, and never drop. Raises `InputError` for what contradicts the task.
        """
        return config

    @classmethod
    def scene(cls, options: Any) -> SceneConfig:
        """What is flown in unless an `EnvConfig` names another scene."""
        return SceneConfig()

    @abstractmethod
    def setup(self) -> None:
        """Set `observation`, from `options` and `vehicle`.

        Raise `InputError` for an option that does not fit the vehicle. Attributes that are set here
        are constants.
        """

    @abstractmethod
    def begin(self, draw: Draw) -> InitialState:
        """Begin episodes: draw their numbers, shape (W, A, ...), and return the drones' starts.

        Give numbers for all drones: those that begin no episode keep their state and memory.
        """

    def update_memory(self, state: State) -> None:  # noqa: B027  # optional
        """Change the memory of episodes, such as gates that were passed. Optional.

        Called after a step, before `observe`. The memory of drones that did not fly is kept.
        """

    @abstractmethod
    def observe(self, state: State) -> dict[str, Array]:
        """Observations: an array (W, A, *shape) for each of `observation`, by its name.

        Called after every step and reset, and for frozen drones too: change nothing here or in
        `outcome`, which is called next. The loop copies the arrays and gives them their dtype; they
        have to lie within the bounds of their specs.
        """

    @abstractmethod
    def outcome(self, state: State) -> Outcome:
        """Reward, end and metrics, after every step and reset.

        After a reset the metrics count; reward and end of a drone that did not fly are left out.
        """

    def crash(self, crashed: Array) -> Array:
        """Reward of drones that crash, (W, A), and 0 of others: what the worst step would cost for
        ever, at discounts up to 0.99. If a crash cost less, a learner that cannot do the task yet
        would learn to crash soon.
        """
        return crashed * (HORIZON * self.worst_step) + 0.0  # no negative zeros

    def ended(self, state: State) -> Array:
        """Which drones have crashed, bool, (W, A): their radio is silent. Only with a radio."""
        raise NotImplementedError

    def goal(self, state: State) -> Array:
        """Positions of the goals, for pictures: world frame, m, shape (W, A, 3). Optional."""
        raise NotImplementedError

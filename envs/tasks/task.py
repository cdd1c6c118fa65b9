"""Base of tasks. One class serves every backend, one drone or thousands, in process or over UDP.

A task is written for arrays with any leading axes: W worlds and the A drones of each, or none for a
single drone. It counts axes from the last (`position[..., 2]`), uses operators, `stack` and NumPy's
functions, and never changes an array in place.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Self

from ...models import MOST_DRAG
from ...models.errors import expect
from ...models.fields import Choice, Limits, check, check_fields
from ...scenes import scenes_of
from ...sim import (
    LEVELS,
    Array,
    Controller,
    Draw,
    EffectOptions,
    InitialState,
    Randomization,
    WorldState,
    checked_sensors,
    make_controller,
)
from ..spec import ArraySpec, Mark, Metric

if TYPE_CHECKING:
    from ...models.vehicle import Vehicle

LONGEST_CONTROL_PERIOD: Final = 1.0  # Longest time between two actions, s
LONGEST_EPISODE: Final = 1 << 31  # Most control steps of an episode
LONGEST_HISTORY: Final = 1000  # Most observations side by side


@dataclass(frozen=True, kw_only=True)
class TaskOptions:
    """Options that every task has. A wrong one raises `InputError` with one sentence.

    Numbers may be of any real type, NumPy's among them; they are kept as Python's float and int.
    A task with options of its own derives from this: annotations say what they may be (see
    `models.fields`), and `check` what they have to do with each other.
    """

    episode_length: Annotated[int, Limits(1, LONGEST_EPISODE, "control steps", whole=True)] = 250
    """Control steps after which an episode is truncated."""
    action: str = "rotors"
    """What an action sets: one of `sim.LEVELS`."""
    control_period: Annotated[float, Limits(1e-6, LONGEST_CONTROL_PERIOD, "s")] = 0.02
    """Time between two actions, s: a multiple of the physics step, at most 1 s. The default is that
    of Unity's `FixedUpdate`."""
    history: Annotated[int, Limits(1, LONGEST_HISTORY, "observations", whole=True)] = 1
    """The agent observes the last so many observations side by side, the oldest first; at the start
    of an episode all are the first one."""
    linear_drag: Annotated[float, Limits(0.0, MOST_DRAG, "/s")] = 0.0
    """Acceleration of -linear_drag · velocity, 1/s, as Unity's `Rigidbody.drag`; at most 100. The
    force acts at the body's origin."""
    effects: Mapping[str, Any] = field(default_factory=dict, hash=False)
    """Effects by name, as `sim.EffectOptions` has them; none are on by default."""
    randomize: Mapping[str, Any] = field(default_factory=dict, hash=False)
    """What is drawn for each episode: names of `sim.PARAMETERS` to distributions, as texts."""
    sensors: Mapping[str, Any] = field(default_factory=dict, hash=False)
    """What the drone measures: by sensor its settings, or true. See `sim/sensors.py`."""
    cameras: tuple[str, ...] = ()
    """Pictures that are observed: cameras of the vehicle by name, also as NAME_KIND or
    NAME@WIDTHxHEIGHT. See `models/cameras.py`."""
    world: str = "plain"
    """What the pictures show around the drones: plain, airport, forest, warehouse or gates; the
    last three from a seed, as forest:3, or from one of several for each episode, as forest:0-7."""

    actions: ClassVar[tuple[str, ...]] = LEVELS
    """Levels that the task can be flown at; one with a controller of its own may name fewer."""
    hangs: ClassVar[bool] = False
    """Whether the task hangs a payload from the vehicle, so that `effects` may not."""

    def __post_init__(self) -> None:
        check_fields(self)
        check("action", Choice(self.actions), self.action)
        effects = EffectOptions.from_options(self.effects)
        hung = [name for name in ("payload", "cable") if self.hangs and name in self.effects]
        expected = "a payload that the options of the task describe"
        expect(not hung, "effects", expected, " and ".join(hung))
        object.__setattr__(self, "effects", effects.to_options())
        object.__setattr__(self, "sensors", checked_sensors(self.sensors))
        object.__setattr__(self, "cameras", _words(self.cameras))
        scenes_of(self.world)
        self.check()
        acting = replace(effects, payload=1.0) if self.hangs else effects
        drawn = Randomization(self.randomize, acting)
        object.__setattr__(self, "randomize", drawn.to_options())

    def check(self) -> None:
        """Check options that depend on each other, each within its limits. Raises `InputError`."""

    @property
    def ideal(self) -> bool:
        """Whether the vehicle flies as its model alone: no effects, nothing drawn."""
        return not (self.effects or self.randomize)

    @property
    def estimated(self) -> bool:
        """Whether controller and observation see the onboard estimate, once a control step."""
        return bool(self.sensors.get("observe") == "estimate")

    def to_options(self) -> dict[str, Any]:
        """Every option by its name, as a spec has them; of mappings those that are not empty, and
        of pictures those that there are.
        """
        told = {one.name: getattr(self, one.name) for one in fields(self)}
        unseen = () if self.cameras else ("cameras", "world")
        return {name: value for name, value in told.items() if value != {} and name not in unseen}

    @classmethod
    def from_options(cls, options: Mapping[str, Any]) -> Self:
        """Options by name. An unknown name raises `InputError`, which names those there are."""
        known = [field.name for field in fields(cls)]
        for name in options:
            expect(name in known, "options", f"some of {', '.join(known)}", f"{name!r}")
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


class Task:
    """Base of all tasks: derive, as `examples/landing.py` does, and `register` it.

    Class attributes:
        Options: Dataclass of the task's options.
        metrics: Measures of how well it is done. The first is the headline.
        choices: Names of draws that a reset's options may choose.
        drones: Most drones of one world, which it has to keep apart at the start.
        fewest: Least drones of one world.

    Attributes:
        options: As given.
        vehicle: As given.
        shape: (W, A), or () for a single drone.
        controller: Turns actions into thrusts: that of the option `action`, unless `setup` sets
            another.
        observation: Specs of one drone's observation; set by `setup`.
        marks: What pictures show of the task besides the goal; set by `setup` where there is any.
    """

    Options: ClassVar[type[TaskOptions]] = TaskOptions
    metrics: ClassVar[tuple[Metric, ...]] = ()
    choices: ClassVar[tuple[str, ...]] = ()
    drones: ClassVar[int] = 1
    fewest: ClassVar[int] = 1

    controller: Controller
    observation: tuple[ArraySpec, ...]
    marks: tuple[Mark, ...] = ()

    def __init__(self, options: Any, vehicle: "Vehicle", shape: tuple[int, ...] = ()) -> None:
        self.options, self.vehicle, self.shape = options, vehicle, shape
        self.controller = of_level = self._of_level()
        self.setup()
        ignored = self.controller is not of_level and options.actions is TaskOptions.actions
        usual = type(options).action
        right = not ignored or options.action == usual
        expect(right, "action", f"{usual!r}, for the task has a controller", repr(options.action))

    def _of_level(self) -> Controller:
        """The controller of the option `action`."""
        options = self.options
        period = options.control_period if options.estimated else self.vehicle.timestep
        return make_controller(options.action, self.vehicle, period, lag=self.lag)

    @property
    def effects(self) -> Mapping[str, Any]:
        """Effects on the drones by name: those of the options, and what the task adds."""
        told: Mapping[str, Any] = self.options.effects
        return told

    @property
    def lag(self) -> float:
        """Longest time constant of the rotors, s; 0 without the effect `motor_lag`."""
        told, lags = self.vehicle.coefficients.rotors, self.options.effects.get("motor_lag", False)
        times = (told.time_constant, told.time_constant_down) if lags else ()
        return max((time for time in times if time), default=0.0)

    def setup(self) -> None:
        """Set `observation`, from `options` and `vehicle`.

        Also set initial values of an episode's memory, as numbers: `self.target = 0.0`. Raise
        `InputError` for an option that does not fit the vehicle.
        """
        raise NotImplementedError

    def begin(self, mask: Array, draw: Draw) -> InitialState:
        """Begin episodes: draw their numbers, shape (W, A, ...), and return the drones' starts.

        The mask, bool, shape (W, A), has the worlds that begin one, in the first call all of them.
        Keep the values of the others: `np.where(mask, new, self.old)`.
        """
        raise NotImplementedError

    def remember(self, state: WorldState, mask: Array) -> None:
        """Change the memory of episodes, such as gates that were passed. Optional.

        Called after a step, before `observe`. The mask, bool, shape (W, A), has the drones that
        flew; keep the values of the others: `np.where(mask, new, self.old)`.
        """

    def observe(self, state: WorldState) -> dict[str, Array]:
        """Observations: an array (W, A, *shape) for each of `observation`, by its name.

        Called after every step and reset, and for frozen drones too: change nothing here or in
        `outcome`, which is called next. The loop copies the arrays and gives them their dtype; they
        have to lie within the bounds of their specs.
        """
        raise NotImplementedError

    def outcome(self, state: WorldState) -> Outcome:
        """Reward, end and metrics, after every step and reset.

        After a reset the metrics count; reward and end of a drone that did not fly are left out.
        """
        raise NotImplementedError

    def goal(self, state: WorldState) -> Array:
        """Positions of the goals, for pictures: world frame, m, shape (W, A, 3). Optional."""
        raise NotImplementedError


def _words(given: Any) -> tuple[str, ...]:
    """Words of a text with commas, or of several texts. Raises `InputError`."""
    texts = [given] if isinstance(given, str) else given
    right = isinstance(texts, list | tuple) and all(isinstance(one, str) for one in texts)
    expect(right, "cameras", "names, with commas between them", f"{given!r:.80}")
    return tuple(word for text in texts for word in text.replace(",", " ").split())

"""Worlds: what all backends have in common, and how they are made."""

import logging
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from .. import models
from ..models import Backend
from ..models.drawn import columns
from ..models.errors import InputError, NotCopied
from ..models.fields import immutable
from ..scenes import SceneConfig
from ..scenes.config import refuse_hidden
from .compile.llvm import trouble
from .effects import NO_EFFECTS, EffectOptions, Effects
from .random import CRAFT, RANDOMIZATION, START, Draw, Random
from .randomize import CHANGE, FIXED, PARAMETERS, Randomization, moved
from .snapshots import Arrays, Kept, Snapshot, joined, part_of
from .state import FAR, Array, ByName, InitialState, WorldState, chosen, clip, looked_up

if TYPE_CHECKING:
    from ..scenes.solids import Solids
    from .scenery import Scenery

_CLASSES = {"mujoco": "MujocoWorld", "rigid": "RigidWorld"}
"""Backends by name: a class in the module of that name in `backends`."""
_OF_ONE = {"num_threads": "mujoco", "dtype": "rigid"}
"""Arguments of `make_world` that only one backend has."""

MAX_WORLDS = 1 << 16  # Most worlds of a batch
CONTACT_CHECK = 0.02
"""Longest time between two checks for contact, s. A bounce of the paper's craft at full thrust
lasts longer, unless its skids dip less than half a millimetre."""

PLAIN = SceneConfig()

_LEVEL = np.array((1.0, 0.0, 0.0, 0.0))


class PhysicsError(RuntimeError):
    """The physics reported a bad state; the numbers after it are meaningless."""


@immutable
class Call:
    """A call of the physics within a step."""

    steps: int
    """Physics steps."""
    commands: bool
    """Whether thrusts are new before it."""
    pushes: bool
    """Whether they or effects are."""
    clears: bool
    """Whether it forgets earlier contacts."""
    looks: bool
    """Whether it looks for contacts at its end."""
    left: float
    """Share of the control step after it."""


class World(Kept, NotCopied):
    """W worlds of A drones; a seed gives the same draws on each backend, which sets `state`.

    Attributes:
        vehicle: The vehicle of every drone.
        shape: (W, A), the leading axes of all arrays.
        state: As the last step or reset left it.
        randomize: What is drawn for each episode.
        random: The counters of all random numbers; `seed` seeds them.
        drawn: Parameters that were drawn for each drone's episode, by name, shape (W, A).
        parameters: Those that are flown with: `change` may differ from the drawn ones.
        scenery: What stands around the drones.
        effects: What acts on drones besides gravity, contact and ideal rotors.
        acting: Mean thrust of each rotor over the last physics step, N, shape (W, A, R).
        wrench: Mean force and torque of the air over it, as of `Effects.step`; None: no air.
        load: The parameter of this name, for physics that is no array code; None: it never changes.
        bad: Drones with a state that is bad, where the physics is array code, bool, (W, A).
        outer: What other physics says, by name, in code that is being compiled; otherwise empty.
        asked: Names of what sensors asked of it.
    """

    is_apart: ClassVar[bool] = False
    """Whether the physics is code of its own, which cannot be compiled with the stages."""
    of_state: ClassVar[Sequence[str]] = WorldState.__slots__
    """Names of the state's arrays that a snapshot has."""
    arrays: ClassVar[tuple[str, ...]] = ("acting", "wrench")

    acting: Array
    wrench: Array
    load: Array = None

    def __init__(
        self,
        vehicle: "models.Vehicle",
        shape: tuple[int, ...],
        effects: EffectOptions,
        randomize: Randomization,
        scenery: "Scenery",
        dtype: str = "float64",
    ) -> None:
        self.vehicle = vehicle
        self.shape = shape
        self.scenery = scenery
        self.drawn: ByName = {}
        self.parameters: ByName = {}
        self._options = effects
        self.randomize = randomize
        self._drawn = randomize.names
        self.random = Random(shape)
        self.effects = Effects(vehicle, effects, self.random.noise, self._drawn)
        self._acts = self.effects.on_rotors or self.effects.on_body
        self._check = max(1, round(CONTACT_CHECK / vehicle.timestep))  # physics steps
        self.dtype = np.dtype(dtype)
        self.acting = self._nothing = np.zeros((*shape, vehicle.num_rotors), self.dtype)
        self.wrench = np.zeros((*shape, 6), self.dtype) if self.effects.on_body else None
        self.bad = self.acting[..., 0] > 0
        self.state = WorldState(command=self.acting, thrust=self.acting, touching=self.bad)
        self.outer: ByName = {}
        self.asked: set[str] = set()

    def draw(self, mask: Array) -> Draw:
        """Draws for the next start of the worlds of a mask, before their `reset`."""
        draw = Draw(self.random, START, mask, ahead=1)
        if self.scenery.openings.size:
            self.scenery.begin(self.random, mask, ahead=1)
            draw.openings = self.scenery.openings[:, None]
        draw.craft = self._craft(mask, ahead=1)
        return draw

    def reset(self, mask: Array, pose: InitialState) -> None:
        """Reset the worlds of the mask, bool, shape (W, A), to their rows of `pose`.

        Here and in all masks the drones of a world have the same truth value.
        """
        self.begin(mask, pose)
        self.place(mask)

    def step(self, thrust: Array, substeps: int, mask: Array | None = None) -> None:
        """Fly the worlds of the mask, None for all, for a control step of `substeps` physics steps.

        Thrusts in N, shape (W, A, R). A bad state raises `PhysicsError`, which names the worlds to
        be reset.
        """
        self.command(thrust, mask)
        for call in self.calls(substeps, substeps):
            if call.pushes:
                self.push(mask)
            self.fly(call, mask)

    def calls(self, substeps: int, held: int) -> list[Call]:
        """The calls of `fly` in a control step, in which each thrust is held for `held` of its
        physics steps.
        """
        often = self._acts or (self.scenery and not self.is_apart)
        at_once = 1 if often else min(self._check, held)
        calls = []
        for first in range(0, substeps, at_once):
            done = min(first + at_once, substeps)
            commands = first % held == 0
            calls.append(
                Call(
                    steps=done - first,
                    commands=commands,
                    pushes=commands or self._acts,
                    clears=first == 0,
                    looks=done % self._check == 0 or done % held == 0,
                    left=1.0 - done / substeps,
                )
            )
        return calls

    def begin(self, mask: Array, pose: InitialState) -> None:
        """The part of `reset` that is array code: what is drawn, and the state."""
        state = self.state
        rows = mask[..., None]
        self.random.begin(mask)
        self.scenery.begin(self.random, mask)
        craft = self._craft(mask)
        if craft is not None:
            state.craft = chosen(mask, self._typed(craft), state.craft)
        self._draw_parameters(mask)
        begun = self._begun(mask, pose)
        self._move(begun, mask)
        state.thrust = self._typed(begun["thrust"])
        state.command = np.where(rows, state.thrust, state.command)
        self._vary(self.parameters)
        thrust = self.effects.begin(mask, state, self.parameters)
        state.thrust = self._typed(np.where(rows, thrust, state.thrust))
        self.acting = np.where(rows, state.thrust, self.acting)
        self.wrench = None if self.wrench is None else np.where(rows, 0.0, self.wrench)

    def command(self, thrust: Array, mask: Array | None) -> None:
        """Take thrusts as of `step`."""
        state = self.state
        # One number for all rotors counts for each.
        state.command = chosen(mask, self._typed(thrust + self._nothing), state.command)

    def push(self, mask: Array | None) -> None:
        """Let effects act: sets `acting`, `wrench` and the state's thrust for a physics step."""
        state = self.state
        acting, end, wrench = self.effects.step(state, mask)
        if wrench is not None:
            self.wrench = chosen(mask, self._typed(wrench), self.wrench)
        if self.effects.on_rotors:
            state.thrust = chosen(mask, self._typed(end), state.thrust)
        else:
            state.thrust = state.command
            acting = self._limited(acting)
        self.acting = chosen(mask, self._typed(acting), self.acting)

    def change(self, changes: ByName) -> None:
        """Fly on with parameters that differ by this much from the drawn ones, by name, (W, A).

        They stay within their limits.
        """
        parameters = {**self.drawn}
        for name, change in changes.items():
            limits = PARAMETERS.get(name, CHANGE)
            parameters[name] = clip(parameters[name] + change, limits.low, limits.high)
        self._fly_with(parameters)

    def _fly_with(self, parameters: ByName) -> None:
        self.parameters = parameters
        self.effects.take(parameters, self.state.craft)
        self._vary(parameters)

    def acceleration(self) -> Array:
        """Of each body's origin at the present state and thrusts, world frame, m/s², (W, A, 3)."""
        raise NotImplementedError

    def below(self) -> Array:
        """Distance from each body's origin along its -z axis to the first surface, m, (W, A).

        Infinite where there is none. Geoms of the craft do not count; a payload is a surface.
        """
        raise NotImplementedError

    def clearance(self) -> Array:
        """Distance between a sphere of `Vehicle.radius` about each body's origin and the nearest
        solid but level ground, m, (W, A): at most `FAR`, and below 0 where it reaches into one.
        None where solids are hidden.
        """
        if self.scenery.hidden:
            return None
        if not self.scenery:
            return self._nothing[..., 0] + FAR
        return self.scenery.distance(self.state.position) - self.vehicle.radius

    def close(self) -> None:
        """Release threads and memory. The state keeps its numbers; nothing else can be called."""

    def snapshot(self) -> Snapshot:
        """Copies of all arrays that a later step depends on, by name."""
        state = {name: getattr(self.state, name) for name in self.of_state}
        own: ByName = {"state": state | self.hidden(), "parameters": self.drawn}
        return super().snapshot() | joined(own)

    def restore(self, arrays: Arrays) -> None:
        """Put a snapshot back; no step runs. No later bit differs from those that followed it."""
        arrays = {name: array.copy() for name, array in arrays.items()}
        super().restore(arrays)
        state = part_of(arrays, "state")
        for name in self.of_state:
            setattr(self.state, name, state.get(name))
        self.drawn = part_of(arrays, "parameters")
        self._fly_with({**self.drawn})
        self._put(state)

    def parts(self) -> Mapping[str, Kept]:
        """The counters, the effects and the scenery."""
        return {"random": self.random, "effects": self.effects, "scenery": self.scenery}

    def place(self, mask: Array) -> None:
        """The part of `reset` that is physics: take the state of the worlds of a mask."""
        raise NotImplementedError

    def fly(self, call: Call, mask: Array | None) -> None:
        """Physics steps of `step`, under `acting` and `wrench`."""
        raise NotImplementedError

    def refuse_bad(self, mask: Array | None) -> None:
        """Raise `PhysicsError` for drones of a mask that are `bad`."""

    def take(self) -> None:
        """Set the state's arrays that the physics changes, where it is no array code."""

    def told(self, *, asked: bool = True) -> ByName:
        """What such physics says now, by name, (W, A, ...), also of what a sensor asks."""
        return {}

    def hidden(self) -> ByName:
        """Arrays of such physics that a later step depends on and array code does not see."""
        return {}

    def _move(self, begun: ByName, mask: Array) -> None:
        """Set the state's motion, of which the worlds of the mask are new."""
        raise NotImplementedError

    def _vary(self, parameters: ByName) -> None:
        """Take drawn parameters that array code needs."""

    def _limited(self, thrust: Array) -> Array:
        """Thrusts within their limits, where the physics does not see to it."""
        return thrust

    def _typed(self, values: Array) -> Array:
        return values.astype(self.dtype, copy=False)

    def _put(self, arrays: Arrays) -> None:
        """Follow the state and the attributes that were put back, and put back what is hidden."""
        raise NotImplementedError

    def _craft(self, mask: Array, ahead: int = 0) -> Array:
        """The craft of the episodes of a mask, (W, A, k), from the vehicle's pool, if it is one."""
        table = getattr(self.vehicle, "table", None)
        if table is None:
            return None
        place = Draw(self.random, CRAFT, mask, ahead).uniform(0.0, len(table))
        return looked_up(table, np.floor(place))

    def _draw_parameters(self, mask: Array) -> None:
        """Draw the parameters of the worlds of a mask."""
        if self._drawn:
            draw = Draw(self.random, RANDOMIZATION, mask)
            for name, new in self.randomize.draw(draw).items():
                self.drawn[name] = chosen(mask, new, self.drawn.get(name))
                self.parameters[name] = chosen(mask, new, self.parameters.get(name))

    def _begun(self, mask: Array, pose: InitialState) -> ByName:
        """The pose's arrays by their names; those of the state for worlds out of the mask."""
        usual: ByName = {
            "position": 0.0,
            "quaternion": _LEVEL,
            "velocity": 0.0,
            "body_rates": 0.0,
            "thrust": self.vehicle.hover_thrust,
        }
        if self.state.craft is not None:
            usual["thrust"] = columns(self.state.craft)["share"] * self.vehicle.gravity
        begun = {}
        for name, default in usual.items():
            given = getattr(pose, name)
            begun[name] = default if given is None else given
        for name, start in moved(begun, self.parameters).items():
            begun[name] = np.where(mask[..., None], start, getattr(self.state, name))
        return begun


def check_world(
    vehicle: "models.Vehicle",
    backend: Backend,
    effects: EffectOptions,
    randomize: Randomization,
    settings: Mapping[str, Any],
    hidden: Sequence[str],
) -> None:
    """Refuse by name what the backend cannot honour. Raises `InputError`.

    `hidden`: names as of `scenery.solids_around`.
    """
    if backend != "mujoco":
        refuse_hidden(hidden, f"the backend {backend}")
    if backend == "mujoco" and hasattr(vehicle, "table"):
        raise InputError(
            "vehicle: expected one with the backend mujoco, as drawn:7, got a pool of craft, "
            f"{vehicle.name}"
        )
    if getattr(vehicle, "members", ()):
        if backend != "mujoco":
            raise InputError(
                f"vehicle: expected one with the backend {backend}, got {vehicle.name}"
            )
        acting = (*effects.to_options(), *randomize.names)
        refused = [name for name in acting if name != "linear_drag"]
        if refused:
            raise InputError(
                "effects and randomize: expected none with several vehicles, "
                f"got {', '.join(refused)}"
            )
    for name, value in settings.items():
        if _OF_ONE.get(name, backend) != backend:
            raise InputError(f"{name}: expected none with the backend {backend}, got {value!r}")


def make_world(
    vehicle: "models.Vehicle",
    num_worlds: int,
    backend: Backend = "mujoco",
    *,
    drones: int = 1,
    effects: EffectOptions = NO_EFFECTS,
    randomize: Randomization = FIXED,
    scene: SceneConfig = PLAIN,
    thrown: "Solids | None" = None,
    **settings: Any,
) -> World:
    """W worlds of `drones` drones each, in layouts of a scene, and what is thrown in each.

    Settings are `num_threads` of `mujoco`, `dtype` of `rigid`, and `compiled` of both: false for
    NumPy, None for compiled code where llvmlite can make it. Raises `InputError`.
    """
    if not (type(num_worlds) is int and 1 <= num_worlds <= MAX_WORLDS):
        raise InputError(f"num_envs: expected 1 to {MAX_WORLDS}, got {num_worlds!r}")
    from .scenery import Scenery, solids_around  # it imports MuJoCo

    own, hidden = solids_around(vehicle, scene)
    check_world(vehicle, backend, effects, randomize, settings, hidden)
    wanted = settings.pop("compiled", None)
    reason = "" if wanted is False else trouble()
    if wanted and reason:
        raise InputError(f"compiled: expected false where nothing compiles ({reason}), got true")
    if reason:
        tell_once(f"NumPy flies, which is slower: {reason}")
    if backend == "rigid":
        settings["compiled"] = wanted is not False and not reason
    module = import_module(f".backends.{backend}", __package__)
    cls = getattr(module, _CLASSES[backend])
    scenery = Scenery(scene, own, num_worlds, hidden, thrown)
    world: World = cls(
        vehicle, num_worlds, drones=drones, effects=effects, randomize=randomize,
        scenery=scenery, **settings,
    )  # fmt: skip
    return world


@cache
def tell_once(warning: str) -> None:
    """Log a warning, once in a process."""
    logging.getLogger(__name__).warning(warning)

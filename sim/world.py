"""Worlds: one interface for all backends."""

from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, Protocol

from ..models import BACKENDS, MAX_DRONES, Backend
from ..models.errors import expect, require
from .effects import EffectOptions
from .random import Draw, Noise
from .randomize import CENTER, Randomization
from .state import Array, InitialState, WorldState

if TYPE_CHECKING:
    import mujoco

    from ..models.vehicle import Vehicle

_WORLDS: Final = {"mujoco": "MujocoWorld", "rigid": "make_rigid", "warp": "WarpWorld"}
_PACKAGES: Final = {  # and the extra that has them
    "mujoco": ("", ()),
    "rigid": ("train", ("torch",)),
    "warp": ("gpu", ("torch", "warp", "mujoco_warp")),
}
_SETTINGS: Final = {
    "mujoco": ("num_threads",),
    "rigid": ("device", "dtype", "compiled", "tensors"),
    "warp": ("device",),
}

MAX_WORLDS: Final = 1 << 16  # Most worlds of a batch
CONTACT_CHECK: Final = 0.02
"""Longest time between two checks for contact, s. A bounce of the paper's craft at full thrust
lasts longer, unless its skids dip less than half a millimetre."""


class PhysicsError(RuntimeError):
    """The physics reported a bad state; the numbers after it are meaningless."""


class World(Protocol):
    """W worlds of A drones.

    Attributes:
        vehicle: The vehicle of every drone.
        shape: (W, A), the leading axes of all arrays; () for a single drone.
        state: As the last step or reset left it.
        parameters: What was drawn for each drone's episode, by name, shape (W, A).
        xp: Namespace of the array API standard for the state's arrays.
    """

    vehicle: "Vehicle"
    shape: tuple[int, ...]
    state: WorldState
    parameters: dict[str, Array]
    xp: Any

    def reset(self, mask: Array, pose: InitialState) -> None:
        """Reset the worlds of the mask, bool, shape (W, A), to their rows of `pose`.

        Here and in all masks the drones of a world have the same truth value.
        """

    def step(
        self, thrust: Array, substeps: int, mask: Array | None = None, *, again: bool = False
    ) -> None:
        """Fly the worlds of the mask, None for all, for so many physics steps with these thrusts.

        Thrusts in N, shape (W, A, R). Where it goes on `again` after a step with the same mask, the
        state's `touching` counts from that step on. A bad state raises `PhysicsError`, which names
        the worlds to be reset.
        """

    def seed(self, mask: Array, seeds: Sequence[int | None] | Array) -> None:
        """Seed the streams of the worlds of a mask, seeds (W,); None leaves its stream."""

    def checked(self, actions: Array, width: int, choices: int, flown: Array | None) -> Array:
        """Actions as this backend's arrays, shape (N, k), where those are not NumPy's.

        They are out of so many choices, or numbers where `choices` is 0; those of drones that are
        not `flown`, bool, shape (N,), are ignored. Raises `InputError`.
        """

    def draw(self, mask: Array, chosen: Any = None) -> Draw:
        """A `Draw` for the worlds of the mask; `chosen` as in `random.NumpyDraw`."""

    def acceleration(self) -> Array:
        """Of each body's origin at the present state and thrusts, world frame, m/s², (W, A, 3)."""

    def below(self) -> Array:
        """Distance from each body's origin along its -z axis to the first surface, m, (W, A).

        Infinite where there is none. Geoms of the craft do not count; a payload is a surface.
        """

    def noise(self, size: int, use: int | tuple[int, ...]) -> Noise:
        """So many normal numbers of each drone in every step; `seed` seeds their streams too.

        `use` as of `random.Streams`.
        """

    def close(self) -> None:
        """Release threads and memory. The state keeps its numbers; nothing else can be called."""


def contact_check(timestep: float) -> int:
    """Physics steps between two checks for contact."""
    return max(1, round(CONTACT_CHECK / timestep))


def flown_model(
    vehicle: "Vehicle", drones: int, effects: EffectOptions, drawn: Sequence[str]
) -> "mujoco.MjModel":
    """The model of a world: the vehicle's, or one with more crafts, with a payload or for a drawn
    center of mass.
    """
    movable = bool(set(drawn) & set(CENTER))
    if drones > 1:
        from ..models.fleet import members_of  # which imports MuJoCo
        from ..models.swarm import swarm_model

        load = effects.payload * drones
        crafts = members_of(vehicle, drones)
        return swarm_model(crafts, movable=movable, payload=load, cable=effects.cable)
    if effects.payload:
        return vehicle.with_payload(effects.payload, effects.cable)
    return vehicle.with_movable_center() if movable else vehicle.model


def check_hung(height: float, least: float) -> None:
    """Refuse a start at which the payload would hang in the ground. Raises `InputError`."""
    expected = f"a height over {least:.4g} m, for the payload on its cable"
    expect(height > least, "start", expected, f"{height:.4g} m")


def make_world(
    vehicle: "Vehicle",
    num_worlds: int,
    backend: Backend = "mujoco",
    *,
    drones: int = 1,
    effects: EffectOptions | None = None,
    randomize: Randomization | None = None,
    **settings: Any,
) -> World:
    """W worlds of so many drones each; `warp` has one alone.

    Settings are `num_threads` of `mujoco`, `device` of the others, `dtype`, `compiled` and
    `tensors` of `rigid`: without the last it has NumPy arrays.

    Raises:
        InputError: The backend, the number or a setting is not what it should be.
        MissingPackage: The backend's package is not installed.
    """
    expect(backend in BACKENDS, "backend", " or ".join(BACKENDS), f"{backend!r}")
    for name, count, most in ("num_envs", num_worlds, MAX_WORLDS), ("drones", drones, MAX_DRONES):
        expect(type(count) is int and 1 <= count <= most, name, f"1 to {most}", f"{count!r}")
    if drones > 1:
        expect(backend != "warp", "drones", f"1 with the backend {backend}", f"{drones}")
    if getattr(vehicle, "members", ()):
        expect(backend == "mujoco", "vehicle", f"one with the backend {backend}", vehicle.name)
        acting = [
            *(effects or EffectOptions()).to_options(),
            *(randomize.names if randomize else ()),
        ]
        expected = "none with several vehicles"
        expect(not acting, "effects and randomize", expected, ", ".join(acting))
    known = _SETTINGS[backend]
    those = f"{' or '.join(known)}, the setting{'s' * (len(known) > 1)} of the backend {backend}"
    for name, value in settings.items():
        expect(name in known, name, those, f"{name}={value!r}")
    if drones > 1:
        settings["drones"] = drones
    extra, packages = _PACKAGES[backend]
    for package in packages if settings.get("tensors", True) else ():
        require(package, extra, f"the backend {backend}")
    module = import_module(f".backends.{backend}", __package__)
    world: World = getattr(module, _WORLDS[backend])(
        vehicle, num_worlds, effects=effects, randomize=randomize, **settings
    )
    return world

"""The physical examination of a multirotor: numbers and flights against mechanics.

Each check compares a measured number with an equation of mechanics, or with a plausible range.
`rules.toml` has a table for each: the equation, the limits, their source, and what a failure means.
A file that flying refuses is refused here by the same sentence.

World frame: z up. Body frame: x forward, y left, z up. SI units and radians throughout.
"""

import copy
import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from mujoco import MjData, MjModel
from numpy.typing import NDArray

from .fields import check_names, immutable
from .files import read_own_toml
from .mjcf import vehicle_spec
from .vehicle import Vehicle

Array = NDArray[np.float64]

_MAX_STEPS = 4000  # of a flight: tiny physics steps shorten it
_HEIGHT = 1000.0  # m: flights begin here, and none reaches the floor
_SPIN = np.array((1.0, 2.0, 3.0)) / math.sqrt(14)  # an axis that is no axis of symmetry
_FASTEST_TURN = math.radians(2000)  # rad/s: the range of common gyroscopes (Bosch BMI088)

_THRUSTS = mujoco.mjtDisableBit.mjDSBL_ACTUATION
_CONTACTS = mujoco.mjtDisableBit.mjDSBL_CONTACT
_EXACT = 1e-9  # tolerance where the integrator is exact: the rounding errors of a flight
_RELATIVE = 1e-6  # of the torque of a thrust at the arm: less is none
_TURN = 8.0  # rad: length of a tumbling flight


@dataclass(frozen=True)
class Rule:
    """How a number is judged."""

    equation: str
    """What the number is, or what it has to equal."""
    source: str
    """Of the equation, or of the limits."""
    meaning: str
    """What it means if the check fails."""
    low: float = 0.0
    """Least value that passes."""
    high: float = 0.0
    """Largest value that passes."""
    unit: str = ""
    """Of the numbers; empty for pure numbers."""


@immutable
class Check(Rule):
    """One line of the examination; its limits may be those of the craft."""

    name: str
    measured: float
    """NaN where it could not be measured: such a check fails."""
    expected: float | None = None
    """What `measured` is compared with; None for a range."""

    @property
    def tolerance(self) -> float | None:
        """Half the width of the limits around `expected`; None for a range."""
        return None if self.expected is None else (self.high - self.low) / 2

    @property
    def passed(self) -> bool:
        """Whether the measured value is within its limits; NaN never is."""
        return self.low <= self.measured <= self.high


_RULES = read_own_toml(__file__, "rules")
RULES = {name: Rule(**row) for name, row in _RULES.items()}
"""Every check by its name; {} stands for a rotor, an axis or a group."""


def _judged(
    key: str, measured: float, *of: str, expected: float | None = None, tolerance: float = 0.0
) -> Check:
    """A check by its row of `RULES`; limits around `expected` replace those of the row."""
    values = dict(vars(RULES[key]))
    values["meaning"] = values["meaning"].format(*of)
    if expected is not None:
        values["low"] = expected - tolerance
        values["high"] = expected + tolerance
    name = key.format(*of)
    return Check(**values, name=name, measured=float(measured), expected=expected)


def failed(checks: Iterable[Check]) -> list[Check]:
    """Those that failed: `assert not failed(examine("my_drone.xml", "hover"))`."""
    return [check for check in checks if not check.passed]


# ---- flights -------------------------------------------------------------------------------------


Checks = Iterator[Check]


class _Craft:
    """A vehicle, and the model of its file in vacuum, which has no drag but the file's own."""

    def __init__(self, given: Vehicle | Path | str | None) -> None:
        path = given.path if isinstance(given, Vehicle) else given
        self.vehicle = Vehicle.load(path)
        self.model = vehicle_spec(self.vehicle.path).compile()
        self.model.opt.density = 0.0  # in air there is no closed form
        self.model.opt.viscosity = 0.0
        self.model.opt.wind = 0.0
        self.moments: Array = np.linalg.eigvalsh(self.vehicle.inertia)
        places = np.array([rotor.position for rotor in self.vehicle.rotors])
        apart = places - self.vehicle.center_of_mass
        self.arm = max(float(np.linalg.norm(apart[:, :2], axis=1).mean()), 1e-12)

    def at_rest(self, *disabled: mujoco.mjtDisableBit) -> tuple[MjModel, MjData]:
        """A copy of the model with some features off, and the craft level, at rest, at `_HEIGHT`.

        Without actuation there is no thrust, not even the least.
        """
        model = copy.copy(self.model)
        for bit in disabled:
            model.opt.disableflags |= bit
        data = MjData(model)
        data.qpos[:] = (0.0, 0.0, _HEIGHT, 1.0, 0.0, 0.0, 0.0)
        return model, data

    def tumbled(self, turn: float, step: float, steps: int) -> Array:
        """Attitude after so many physics steps, s, of tumbling at a rate, rad/s."""
        model, data = self.at_rest(_THRUSTS, _CONTACTS)
        model.opt.gravity = 0.0
        model.opt.timestep = step
        data.qvel[3:] = turn * _SPIN
        data.qfrc_applied[3] = 0.05 * self.moments[0] * turn**2  # a sphere turns exactly without
        _fly(model, data, steps * step)
        return np.array(data.qpos[3:])


class _Warned(Exception):
    """MuJoCo warned of something in a flight."""


def _fly(model: MjModel, data: MjData, seconds: float) -> float:
    """Step for `seconds`, a whole number of steps, `_MAX_STEPS` at most; the time flown, s.

    Raises `_Warned`: MuJoCo resets bad states silently otherwise.
    """
    steps = round(min(max(seconds / model.opt.timestep, 1), _MAX_STEPS))
    mujoco.mj_step(model, data, nstep=steps)
    kinds = zip(mujoco.mjtWarning.__members__, data.warning, strict=False)
    warned = [kind.removeprefix("mjWARN_") for kind, warning in kinds if warning.number]
    if warned:
        raise _Warned(", ".join(warned))
    return float(steps * model.opt.timestep)


# ---- the groups of checks ------------------------------------------------------------------------


def _gravity(craft: _Craft) -> Checks:
    yield _judged("gravity: size", craft.vehicle.gravity)


def _units(craft: _Craft) -> Checks:
    arm = craft.arm
    vehicle = craft.vehicle
    inertia = vehicle.mass * arm**2
    reaction = float(np.mean([math.hypot(*rotor.reaction) for rotor in vehicle.rotors]))
    yield _judged("units: mass / arm³", vehicle.mass / arm**3)
    yield _judged("units: arm", arm)
    yield _judged("units: smallest moment / (mass arm²)", craft.moments[0] / inertia)
    yield _judged("units: largest moment / (mass arm²)", craft.moments[2] / inertia)
    yield _judged("units: reaction / arm", reaction / arm)
    radius = vehicle.coefficients["rotors.radius"]
    if radius is None:
        return
    yield _judged("units: reaction / rotor radius", reaction / radius)
    yield _judged("units: rotor radius / arm", radius / arm)
    coefficient = vehicle.coefficients["rotors.thrust_coefficient"]
    if coefficient is not None:
        fastest = math.sqrt(float(vehicle.thrust_high.max()) / coefficient)
        yield _judged("units: tip speed", radius * fastest)


def _allocation(craft: _Craft) -> Checks:
    thrust, *torques = craft.vehicle.allocation
    size = float(np.linalg.norm(thrust))
    along = thrust / size
    apart = [row - (row @ along) * along for row in torques]  # without a change of thrust
    least = _RELATIVE * craft.arm * size
    rows = np.array([row / max(float(np.linalg.norm(row)), least) for row in apart])
    yield _judged("allocation: torques apart from each other", np.linalg.eigvalsh(rows @ rows.T)[0])


def _turns(craft: _Craft) -> Checks:
    rotors = craft.vehicle.rotors
    reactions = np.array([np.dot(rotor.reaction, rotor.axis) for rotor in rotors])
    sizes = np.abs(reactions)
    total = float(sizes.sum())
    share = float(reactions.sum()) / total if total > 0 else math.nan
    # The wrong sign of one of R rotors gives 2 / R more; an odd R has 1 / R by itself.
    half = 1.5 if len(rotors) % 2 else 1.0
    tolerance = half / len(rotors)
    yield _judged("turns: yaw of equal thrusts", share, expected=0, tolerance=tolerance)
    median = float(np.median(sizes)) or math.nan
    for rotor, size in zip(rotors, sizes, strict=True):
        yield _judged("turns: reaction of {} / median", size / median, rotor.name)


def _hover(craft: _Craft) -> Checks:
    vehicle = craft.vehicle
    most = float(vehicle.allocation[0] @ vehicle.thrust_high)
    yield _judged("hover: thrust to weight", most / (vehicle.mass * vehicle.gravity))
    margin = float((vehicle.thrust_high / vehicle.hover_thrust).min())
    yield _judged("hover: margin of the tightest rotor", margin)


def _free_fall(craft: _Craft) -> Checks:
    model, data = craft.at_rest(_THRUSTS, _CONTACTS)
    seconds = _fly(model, data, 2.0)
    depth = craft.vehicle.gravity * seconds**2 / 2
    fallen = _HEIGHT - float(data.qpos[2])
    tolerance = _EXACT * max(1.0, depth)
    yield _judged("free fall: depth", fallen, expected=depth, tolerance=tolerance)


def _physics_step(craft: _Craft) -> Checks:
    """Attitudes after tumbling as fast as full torque turns the craft in 0.1 s."""
    vehicle = craft.vehicle
    fastest = max(vehicle.turning((1.0, 0.0, 0.0)), vehicle.turning((0.0, 1.0, 0.0)))
    turn = min(max(0.1 * fastest, 1.0), _FASTEST_TURN)
    step = vehicle.timestep
    steps = round(min(max(_TURN / turn / step, 1), _MAX_STEPS / 2))
    one = craft.tumbled(turn, step, steps)
    other = craft.tumbled(turn, step / 2, 2 * steps)
    apart = min(math.dist(one, other), math.dist(one, -other), 2.0)
    angle = 4 * math.asin(apart / 2)
    yield _judged("physics step: error of attitude", math.degrees(angle) / (steps * step))


def _floor(craft: _Craft) -> Checks:
    rest = craft.vehicle.rest_height
    model, data = craft.at_rest(_THRUSTS)
    data.qpos[2] = rest + 0.05
    _fly(model, data, 2.0)
    yield _judged("floor: height at rest", data.qpos[2], expected=rest, tolerance=1e-3)


GROUPS = {
    "gravity": _gravity,
    "units": _units,
    "allocation": _allocation,
    "turns": _turns,
    "hover": _hover,
    "free fall": _free_fall,
    "physics step": _physics_step,
    "floor": _floor,
}
"""Every group of checks, in the order of the table."""


def examine(vehicle: Vehicle | Path | str | None = None, *groups: str) -> list[Check]:
    """The checks of some of `GROUPS`, or of all, on a vehicle or its file; None: the paper's.

    A warning of MuJoCo in a flight ends its group with a check that fails. Raises `InputError` for
    a file that `Vehicle.load` refuses, and for a group that does not exist.
    """
    check_names(groups, GROUPS, "groups")
    craft = _Craft(vehicle)
    checks: list[Check] = []
    with _silence():
        for name in groups or GROUPS:
            try:
                checks.extend(GROUPS[name](craft))
            except _Warned as warning:
                checks.append(_judged("{}: warnings", math.nan, name, str(warning), expected=0))
    return checks


@contextmanager
def _silence() -> Iterator[None]:
    """Keep MuJoCo's warnings from the console: they become checks."""
    before = mujoco.MjLogConfig.get()
    quiet = mujoco.MjLogConfig.get()
    quiet.logto_console = False
    quiet.set()
    try:
        yield
    finally:
        before.set()

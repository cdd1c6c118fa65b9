"""The physical examination of anyone's multirotor: flights and numbers against mechanics.

Nothing is compared with a vehicle that we know. A check holds a measured value to a closed form, or
to a plausible range whose source it names. `examine` runs them all; each `check_...` is one group
of them and takes a `Vehicle`, the path of a vehicle's file, or an `ExaminedModel`, which is a file
read once. A file that flying refuses is examined all the same, as long as it is a free body with
actuators: a fault becomes a check that fails, and every reason is told at once.

World frame: z up. Body frame: x forward, y left, z up. SI units and radians throughout.
"""

import copy
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property, wraps
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .coefficients import Coefficients
from .errors import InputError
from .library import find_vehicle
from .vehicle import (
    Rotor,
    Vehicle,
    allocate,
    compile_vehicle,
    find_rest_height,
    mass_properties,
    read_coefficients,
    read_rotor,
    rotor_faults,
    rotor_name,
    trim_thrust,
)

Array = NDArray[np.float64]

_MAX_STEPS: Final = 4000  # of a flight: tiny physics steps shorten it
_MAX_STEP: Final = 10.0  # s: every flight diverges there, but no number overflows
_STEPS_AT_ONCE: Final = 1000  # Ctrl-C waits for no more
_HEIGHT: Final = 1000.0  # m: flights begin here, and none reaches the floor
_CONTROL: Final = 0.02  # s: period of the random thrusts
_SPIN: Final = (1.0, 2.0, 3.0)  # rad/s: tumbling begins about no axis of symmetry
_SPEED: Final = (2.0, -1.0, 3.0)  # m/s
_FASTEST_TURN: Final = math.radians(2000)  # rad/s: the range of common gyroscopes (Bosch BMI088)

_EXACT: Final = 1e-9  # tolerance where the integrator is exact: the rounding errors of a flight
_TRUNCATION: Final = 1e-6  # where RK4 truncates: 2e-9 for the paper's vehicle, 1e-2 for Euler
_ROUNDED: Final = 1e-5  # what the six digits of a file leave
_ATTITUDE: Final = math.radians(0.01)  # rad: error of a second that a physics step may make
_TURN, _COARSE = 8.0, 0.05  # rad: a tumbling flight, and a step of the coarsest of three
_DEPTH: Final = 1e-3  # m: error of a free fall of a second that a physics step may make
_SETTLED: Final = 0.01  # relative: drag that acts once a step, against its closed form

_MECHANICS: Final = "rigid-body mechanics"
_MODEL: Final = "compiled model"


@dataclass(frozen=True)
class Range:
    """Plausible values of a number that tells wrong units."""

    low: float
    high: float
    unit: str
    source: str


# docs/physics.md has the vehicles behind the published values.
RANGES: Final = {
    "mass / arm³": Range(1, 2000, "kg/m³", "published vehicles: 7 to 432"),
    "arm": Range(0.02, 5, "m", "published vehicles: 0.04 to 1.41"),
    "smallest moment / (mass arm²)": Range(0.02, 5, "", "published vehicles: 0.13 to 0.49"),
    "largest moment / (mass arm²)": Range(0.02, 5, "", "published vehicles: 0.25 to 1.38"),
    "reaction / arm": Range(0.005, 2, "", "published vehicles: 0.035 to 0.79"),
    "reaction / rotor radius": Range(0.02, 3, "", "published vehicles: 0.12 to 1.09"),
    "rotor radius / arm": Range(0.05, 1.5, "", "published vehicles: 0.28 to 0.59"),
    "tip speed": Range(10, 340, "m/s", "below the speed of sound; published: 53 to 150"),
    "terminal velocity": Range(
        2, 200, "m/s", "0.25 to 2,500 kg per m² of front, drag coefficient 1"
    ),
}
"""Plausible values by the name of the check."""
THRUST_TO_WEIGHT: Final = Range(1.2, 20, "", "published vehicles: 1.95 to 10.2")
GRAVITY: Final = Range(1.3, 25, "m/s²", "NASA's fact sheets: Titan 1.35, Earth 9.8, Jupiter 24.8")


@dataclass(frozen=True, kw_only=True)
class Check:
    """One line of the examination."""

    name: str
    measured: float
    """NaN where it could not be measured: such a check fails."""
    low: float
    """Least value that passes."""
    high: float
    """Largest value that passes."""
    unit: str
    """Of the numbers; empty for pure numbers."""
    source: str
    """Of the expected value or of the limits."""
    meaning: str
    """A sentence: what it means if the check fails."""
    expected: float | None = None
    """Closed form that `measured` is compared with; None for a range."""
    note: str = ""
    """What else was found, to print with the measured value."""

    @property
    def tolerance(self) -> float | None:
        """Half the width of the limits around `expected`; None for a range."""
        return None if self.expected is None else (self.high - self.low) / 2

    @property
    def passed(self) -> bool:
        """Whether the measured value is within its limits; NaN never is."""
        return self.low <= self.measured <= self.high

    def report(self) -> dict[str, Any]:
        """For JSON: the fields by name, `tolerance` and `passed`; None for what is not finite."""
        told = vars(self) | {"tolerance": self.tolerance, "passed": self.passed}
        return {
            key: None if isinstance(value, float) and not math.isfinite(value) else value
            for key, value in told.items()
        }


def _near(
    name: str, measured: float, expected: float, unit: str, source: str, meaning: str,
    tolerance: float = _EXACT, **more: Any,
) -> Check:  # fmt: skip
    """A check that compares."""
    low = float(expected - tolerance)
    high = float(expected + tolerance)
    return Check(name=name, measured=float(measured), low=low, high=high, unit=unit,
                 source=source, meaning=meaning, expected=float(expected), **more)  # fmt: skip


def _within(name: str, measured: float, limits: Range, meaning: str, **more: Any) -> Check:
    """A check that wants a range."""
    return Check(name=name, measured=float(measured), low=float(limits.low),
                 high=float(limits.high), unit=limits.unit, source=limits.source,
                 meaning=meaning, **more)  # fmt: skip


def failed(checks: Iterable[Check]) -> list[Check]:
    """Those that failed: `assert not failed(check_hover("my_drone.xml"))`."""
    return [check for check in checks if not check.passed]


# ---- what a file says ----------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class ExaminedModel:
    """A vehicle's file, read for the examination; flying may refuse it."""

    path: Path
    refusal: str
    """Why `Vehicle.load` refuses it; empty if it does not."""
    model: mujoco.MjModel
    """Without air, in which there is no closed form, and with a physics step of 10 s at most."""
    mass: float
    """kg."""
    center: Array
    """Center of mass, body frame, shape (3,), m."""
    inertia: Array
    """About the center of mass, body axes, shape (3, 3), kg·m²."""
    written: tuple[tuple[str, Array], ...]
    """Body and principal moments (3,), kg·m², of each inertia that the file writes out."""
    gravity: float
    """Size of the gravitational acceleration, m/s²."""
    rotors: tuple[Rotor, ...]
    """Empty if an actuator is no rotor."""
    faults: tuple[tuple[str, str], ...]
    """Name of an actuator, and why it is no rotor."""
    trim: Array
    """Thrusts that would carry the level craft, whatever the rotors' limits are, (R,), N."""
    linear_drag: float
    """1/s."""
    timestep: float
    """Physics step of the file, s."""
    coefficients: Coefficients | str
    """Or why they cannot be read."""
    rest_height: float
    """As `Vehicle.rest_height`; NaN if it touches something at any height."""

    @classmethod
    def read(cls, vehicle: "ModelLike" = None) -> "ExaminedModel":
        """Read a vehicle's file, None for the paper's; a vehicle does not change.

        Raises `InputError` for a file that is no free body with actuators.
        """
        if isinstance(vehicle, ExaminedModel):
            return vehicle
        drag = vehicle.linear_drag if isinstance(vehicle, Vehicle) else 0.0
        given = vehicle.path if isinstance(vehicle, Vehicle) else vehicle
        path = find_vehicle(given)
        refusal = ""
        try:
            Vehicle.load(given)
        except InputError as error:
            refusal = str(error)
        written: list[tuple[str, Array]] = []
        if not path.is_file():
            raise InputError(refusal)
        _, _, model, data = compile_vehicle(path, lambda spec: written.extend(_mend(spec)))
        mass, center, inertia = mass_properties(model, data)
        names = [rotor_name(model, index) for index in range(model.nu)]
        faults = [
            (name, f"expected {expected}" + (f", got {got}" if got else ""))
            for index, name in enumerate(names)
            for expected, got in rotor_faults(model, index)
        ]
        rotors = () if faults else tuple(read_rotor(model, data, i) for i in range(model.nu))
        gravity = max(float(np.linalg.norm(model.opt.gravity)), 1e-9)  # it divides
        trim = np.zeros(0)
        if rotors:
            trim = trim_thrust(rotors, allocate(rotors, center), mass * gravity)
        coefficients: Coefficients | str
        try:
            coefficients = read_coefficients(model)
        except InputError as error:
            coefficients = str(error)
        try:
            rest = find_rest_height(model, data)
        except InputError:
            rest = math.nan
        model.opt.density = model.opt.viscosity = 0.0
        model.opt.wind = 0.0
        timestep = float(model.opt.timestep)
        model.opt.timestep = min(timestep, _MAX_STEP)
        return cls(
            path=path, refusal=refusal, model=model, mass=mass, center=center, inertia=inertia,
            written=tuple(written), gravity=gravity, rotors=rotors, faults=tuple(faults),
            trim=trim, linear_drag=drag, coefficients=coefficients, timestep=timestep,
            rest_height=rest,
        )  # fmt: skip

    @cached_property
    def mass_matrix(self) -> Array:
        """Of the free joint, at rest and level, from its answers to forces and torques, (6, 6)."""
        data = self.ready()
        rest = self.acceleration(data)
        answers = []
        for wrench in np.eye(6):
            data.qfrc_applied[:] = wrench
            answers.append(self.acceleration(data) - rest)
        return np.asarray(np.linalg.pinv(np.array(answers).T))

    @cached_property
    def convergence(self) -> "Convergence":
        """How the error of its attitude falls with the physics step."""
        return _converge(self)

    @property
    def allocation(self) -> Array:
        """As `Vehicle.allocation`, (4, R)."""
        return allocate(self.rotors, self.center)

    @property
    def thrust_low(self) -> Array:
        """Least thrust of each rotor, (R,), N."""
        return np.array([rotor.low for rotor in self.rotors])

    @property
    def thrust_high(self) -> Array:
        """Largest thrust of each rotor, (R,), N."""
        return np.array([rotor.high for rotor in self.rotors])

    @property
    def weight(self) -> float:
        """N."""
        return self.mass * self.gravity

    @property
    def arm(self) -> float:
        """Mean horizontal distance of the rotors from the center of mass, m."""
        places = [np.array(rotor.position)[:2] - self.center[:2] for rotor in self.rotors]
        return max(float(np.mean([np.hypot(*place) for place in places])), 1e-12)

    @property
    def moments(self) -> Array:
        """Principal moments of inertia, ascending, (3,), kg·m²."""
        return np.asarray(np.linalg.eigvalsh(self.inertia))

    def falling(self, contact: bool = False, **options: Any) -> mujoco.MjModel:
        """A copy of the model without thrusts, not even the least, and with other `opt` fields."""
        model = copy.copy(self.model)
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
        if not contact:
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        for name, value in options.items():
            setattr(model.opt, name, value)
        return model

    def ready(self, thrust: ArrayLike = 0.0, model: mujoco.MjModel = None) -> Any:
        """New `MjData`: level, at rest, at `_HEIGHT`; thrusts in N, one for all rotors or (R,)."""
        data = mujoco.MjData(self.model if model is None else model)
        data.qpos[:] = (0.0, 0.0, _HEIGHT, 1.0, 0.0, 0.0, 0.0)
        if self.rotors:
            data.ctrl[:] = np.asarray(thrust) / [rotor.newtons for rotor in self.rotors]
        return data

    def acceleration(self, data: Any) -> Array:
        """Of the free joint: (6,), m/s², rad/s²."""
        mujoco.mj_forward(self.model, data)
        return np.array(data.qacc)


ModelLike = Vehicle | ExaminedModel | Path | str | None
"""A vehicle, a file read once, what `Vehicle.load` takes, or None for the paper's vehicle."""


def _mend(spec: mujoco.MjSpec) -> Iterator[tuple[str, Array]]:
    """Principal moments that the file writes out, by body; impossible ones become possible.

    MuJoCo refuses some of them, and sets negative ones to zero. The moments of a sphere take their
    place, so that what else is wrong can be found.
    """
    if spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE:
        return
    for body in spec.bodies:
        if not body.explicitinertial:
            continue
        moments = np.sort(np.array(body.inertia, np.float64))
        if np.isfinite(body.fullinertia[0]):
            xx, yy, zz, xy, xz, yz = body.fullinertia
            full = np.array(((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)))
            moments = np.asarray(np.linalg.eigvalsh(full))
        yield body.name or "a body without a name", moments
        if not (moments[0] > 0 and moments[0] + moments[1] >= moments[2] * (1 - _TRUNCATION)):
            body.fullinertia = [math.nan, 0, 0, 0, 0, 0]
            body.inertia = np.full(3, max(float(np.abs(moments).mean()), 1e-12))


class _Warned(Exception):
    """MuJoCo warned of something in a flight."""


def _fly(model: mujoco.MjModel, data: Any, seconds: float) -> float:
    """Step for `seconds`, a whole number of steps, `_MAX_STEPS` at most; the time flown, s.

    Raises `_Warned`: MuJoCo resets bad states silently otherwise.
    """
    steps = left = round(min(max(seconds / model.opt.timestep, 1), _MAX_STEPS))
    while left > 0:
        mujoco.mj_step(model, data, nstep=min(left, _STEPS_AT_ONCE))
        left -= _STEPS_AT_ONCE
        _expect_no_warning(data)
    return float(steps * model.opt.timestep)


def _expect_no_warning(data: Any) -> None:
    kinds = zip(mujoco.mjtWarning.__members__, data.warning, strict=False)
    told = [kind.removeprefix("mjWARN_") for kind, warning in kinds if warning.number]
    if told:
        raise _Warned(", ".join(told))


CHECKS: Final[list[Callable[[ModelLike], list[Check]]]] = []
"""Every group of checks, in the order of the table."""


def _group(part: Callable[[ExaminedModel], Iterator[Check]]) -> Callable[[ModelLike], list[Check]]:
    """A public group of checks. A warning of MuJoCo in its flights ends it, as a failed check."""

    @wraps(part)
    def group(vehicle: ModelLike = None) -> list[Check]:
        checks = []
        config = mujoco.MjLogConfig.get()
        quiet = mujoco.MjLogConfig.get()
        quiet.logto_console = False  # a warning becomes a check
        quiet.set()
        try:
            for check in part(ExaminedModel.read(vehicle)):
                checks.append(check)
        except _Warned as warning:
            name = part.__name__.removeprefix("check_").replace("_", " ")
            meaning = f"MuJoCo warned of {warning}: the flight diverged and measures nothing"
            checks.append(_near(f"{name}: warnings", math.nan, 0, "", "MuJoCo", meaning))
        finally:
            config.set()
        return checks

    group.__annotations__ = {"vehicle": ModelLike, "return": list[Check]}
    CHECKS.append(group)
    return group


def examine(vehicle: ModelLike = None) -> list[Check]:
    """Run every check on a vehicle or the path of its file; nothing changes.

    Checks that need rotors are left out if an actuator is no rotor, and those of drag if the file
    has none. Raises `InputError` for a file that is no free body with actuators.
    """
    craft = ExaminedModel.read(vehicle)
    return [check for group in CHECKS for check in group(craft)]


# ---- what a file may say -------------------------------------------------------------------------


@_group
def check_accepted(craft: ExaminedModel) -> Iterator[Check]:
    """Whether `--vehicle` takes the file, and its coefficients can be read."""
    name = "accepted by --vehicle"
    source = "rotorgram.models.Vehicle.load"
    yield _near(name, not craft.refusal, 1, "", source,
                craft.refusal or "it cannot fly here", 0)  # fmt: skip
    wrong = craft.coefficients if isinstance(craft.coefficients, str) else ""
    yield _near("coefficients: faults", bool(wrong), 0, "", "limits in models/coefficients.py",
                wrong or "effects and sensors cannot read them", 0)  # fmt: skip


@_group
def check_actuators(craft: ExaminedModel) -> Iterator[Check]:
    """Every actuator is a rotor: a limited thrust at a site of the body, gain times control."""
    for index in range(craft.model.nu):
        name = rotor_name(craft.model, index)
        faults = [fault for actuator, fault in craft.faults if actuator == name]
        meaning = "; ".join(faults) or "it is no rotor: checks of rotors were left out"
        yield _near(f"actuator {name}: faults", len(faults), 0, "", _MODEL, meaning, 0)


@_group
def check_gravity(craft: ExaminedModel) -> Iterator[Check]:
    """Gravity points down and has the size of a world with an atmosphere."""
    down = -float(craft.model.opt.gravity[2]) / craft.gravity
    yield _near("gravity: part along -z", down, 1, "", "world frame: z up",
                "gravity does not point down: check its sign and axis")  # fmt: skip
    yield _within("gravity: size", craft.gravity, GRAVITY,
                  "no world with an atmosphere has it: in cm/s², or in units of g?")  # fmt: skip


@_group
def check_inertia(craft: ExaminedModel) -> Iterator[Check]:
    """Inertia of a body that can exist, and mass and inertia as forces and torques meet them."""
    bodies = [*craft.written, ("the whole craft", craft.moments)]
    name, moments = min(bodies, key=lambda one: one[1][0] / max(abs(one[1][2]), 1e-300))
    ratio = moments[0] / max(abs(moments[2]), 1e-300)
    yield _within("inertia: smallest / largest moment", ratio,
                  Range(1e-6, 1, "", "a body with an extent has positive moments"),
                  f"the inertia of {name} is not positive definite: no body has it")  # fmt: skip
    name, moments = min(bodies, key=lambda one: (one[1][0] + one[1][1]) / max(one[1][2], 1e-300))
    ratio = (moments[0] + moments[1]) / max(moments[2], 1e-300)
    yield _within("inertia: triangle inequality", ratio,
                  Range(1 - _TRUNCATION, math.inf, "", "two moments sum up to the third or more"),
                  f"the moments of {name} belong to no body: the largest exceeds the sum of the "
                  "others")  # fmt: skip
    matrix = craft.mass_matrix
    mass = craft.mass
    center = craft.center
    answer = float(np.trace(matrix[:3, :3])) / 3
    yield _near("mass against a force of 1 N", answer, mass, "kg", _MODEL,
                "a force moves it like another mass: armature of the free joint",
                _TRUNCATION * mass)  # fmt: skip
    about = craft.inertia + mass * (center @ center * np.eye(3) - np.outer(center, center))
    off = float(np.abs(matrix[3:, 3:] - about).max())
    yield _near("inertia against torques of 1 N·m: error", off, 0, "kg·m²", _MODEL,
                "a torque turns it like another inertia: armature of the free joint",
                _TRUNCATION * float(np.abs(about).max()))  # fmt: skip


_MEANINGS: Final = {
    "mass / arm³": "mass in grams, or lengths not in metres?",
    "arm": "lengths in millimetres or centimetres?",
    "smallest moment / (mass arm²)": "inertia in other units, or the arm's?",
    "largest moment / (mass arm²)": "inertia in kg·mm² or g·m², or the arm's unit?",
    "reaction / arm": "reaction not in N·m per newton, or none?",
    "reaction / rotor radius": "reaction not in N·m per newton, or the radius not in metres?",
    "rotor radius / arm": "radius not in metres, or a diameter?",
    "tip speed": "thrust coefficient of revolutions per minute or per second?",
}


@_group
def check_units(craft: ExaminedModel) -> Iterator[Check]:
    """Ratios that no multirotor has unless a unit is wrong."""
    if not craft.rotors:
        return
    arm, inertia = craft.arm, craft.mass * craft.arm**2
    reaction = float(np.mean([np.linalg.norm(rotor.reaction) for rotor in craft.rotors]))
    values = {
        "mass / arm³": craft.mass / arm**3,
        "arm": arm,
        "smallest moment / (mass arm²)": craft.moments[0] / inertia,
        "largest moment / (mass arm²)": craft.moments[2] / inertia,
        "reaction / arm": reaction / arm,
    }
    if isinstance(craft.coefficients, Coefficients):
        rotors = craft.coefficients.rotors
        if rotors.radius is not None:
            values["reaction / rotor radius"] = reaction / rotors.radius
            values["rotor radius / arm"] = rotors.radius / arm
            if rotors.thrust_coefficient is not None:
                fastest = math.sqrt(float(craft.thrust_high.max()) / rotors.thrust_coefficient)
                values["tip speed"] = rotors.radius * fastest
    for name, value in values.items():
        meaning = f"no published vehicle comes near: {_MEANINGS[name]}"
        yield _within(f"units: {name}", value, RANGES[name], meaning)


# ---- rotors --------------------------------------------------------------------------------------


@_group
def check_rotors(craft: ExaminedModel) -> Iterator[Check]:
    """Each rotor pushes where its site and gear say, and upwards."""
    if not craft.rotors:
        return
    rest = craft.acceleration(craft.ready(craft.thrust_low))
    for index, rotor in enumerate(craft.rotors):
        thrust = np.where(np.arange(len(craft.rotors)) == index, rotor.high, craft.thrust_low)
        answer = craft.acceleration(craft.ready(thrust)) - rest
        pushed = craft.mass_matrix @ answer / (rotor.high - rotor.low)
        expected = np.append(rotor.axis, np.cross(rotor.position, rotor.axis) + rotor.reaction)
        off = float(np.abs(pushed - expected).max())
        yield _near(f"effect of {rotor.name}: error per newton", off, 0, "", _MODEL,
                    "it gives another force or torque than its site and gear: force limits?",
                    _TRUNCATION * float(np.abs(expected).max()))  # fmt: skip
        how = "pushes the craft down, as if upside down" if rotor.axis[2] < 0 else "is tilted"
        limits = Range(0.5, 1 + _EXACT, "", "60° of tilt: ours; Neo of RotorS: 5°")
        yield _within(f"lift of {rotor.name}", rotor.axis[2], limits,
                      f"{rotor.name} {how}: are its angles in the compiler's unit?")  # fmt: skip


@_group
def check_allocation(craft: ExaminedModel) -> Iterator[Check]:
    """Thrust and the torques about x, y and z can be commanded, each without the others."""
    if not craft.rotors:
        return
    allocation = craft.allocation
    sizes = np.linalg.norm(allocation, axis=1)
    arm = max(craft.arm, float(sizes[1:3].max()) / max(sizes[0], 1e-300))
    absent = sizes < _TRUNCATION * np.array((1, arm, arm, arm)) * max(sizes[0], 1e-300)
    rows = np.where(absent[:, None], 0.0, allocation / np.where(sizes > 0, sizes, 1)[:, None])
    values = np.linalg.svd(rows, compute_uv=False)
    rank = int((values > 1e-6).sum())
    source = "thrust and three torques, each without the others"
    yield _near("allocation: rank", rank, 4, "", source,
                "thrust and torques cannot be commanded apart from each other", 0)  # fmt: skip
    apart = rows - np.outer(rows @ rows[0], rows[0])  # each torque without a change of thrust
    lengths = np.linalg.norm(apart, axis=1)
    names = ("thrust", "roll", "pitch", "yaw")
    for one, other in ((3, 1), (3, 2), (1, 2)):
        both = lengths[one] * lengths[other]
        shared = abs(float(apart[one] @ apart[other])) / both if both > 1e-9 else math.nan
        lack = [names[axis] for axis in (one, other) if lengths[axis] <= 1e-9]
        meaning = f"{names[one]} signs follow the pattern of {names[other]}: none without the other"
        if lack:
            meaning = f"no rotor gives a torque of {' or '.join(lack)} at constant thrust"
        limit = Range(0, 0.9, "", "size of the cosine of their rows: ours")
        yield _within(f"allocation: {names[one]} apart from {names[other]}", shared, limit, meaning)
    condition = float(values[0] / values[3]) if len(values) == 4 and values[3] > 1e-9 else math.inf
    yield _within("allocation: condition", condition,
                  Range(1, 20, "", "of rows of length 1: ours; 1 for a symmetric quadcopter"),
                  "some torque takes far more thrust than the others")  # fmt: skip


@_group
def check_turns(craft: ExaminedModel) -> Iterator[Check]:
    """Reactions cancel at equal thrusts; a rotor that turns like both its neighbours is named."""
    if not craft.rotors:
        return
    reactions = np.array([np.dot(rotor.reaction, rotor.axis) for rotor in craft.rotors])
    number = len(reactions)
    total = float(np.abs(reactions).sum())
    share = float(reactions.sum()) / total if total > 0 else math.nan
    most = 1.5 / number if number % 2 else 1 / number  # a wrong sign of R rotors gives 2 / R more
    yield _near("turns: yaw of equal thrusts", share, 0, "", "half of what one wrong sign gives",
                "more rotors turn one way than the other: check the signs of the reactions"
                if total > 0 else "no rotor has a reaction",
                most)  # fmt: skip
    sizes = np.abs(reactions) / (float(np.median(np.abs(reactions))) or math.nan)
    surplus = np.sign(share) if abs(share) > most else 0.0
    places = np.array([rotor.position for rotor in craft.rotors]) - craft.center
    around = np.argsort(np.arctan2(places[:, 1], places[:, 0]), kind="stable").tolist()
    for index, rotor in enumerate(craft.rotors):
        at = around.index(index)
        beside = {around[at - 1], around[(at + 1) % number]} - {index}
        alike = sum(bool(reactions[one] * reactions[index] > 0) for one in beside)
        most_alike = 1 if np.sign(reactions[index]) == surplus else 2
        yield _within(f"turns: neighbours like {rotor.name}", alike,
                      Range(0, most_alike, "", "neighbours turn against each other"),
                      f"{rotor.name} turns like both its neighbours, and the turns do not cancel: "
                      "the sign of its reaction is wrong")  # fmt: skip
        yield _within(f"turns: reaction of {rotor.name} / median", sizes[index],
                      Range(0.2, 5, "", "ours: rotors of one craft are alike"),
                      f"{rotor.name} has another reaction than the others")  # fmt: skip


@_group
def check_hover(craft: ExaminedModel) -> Iterator[Check]:
    """The rotors can carry the level craft, with a margin, each within its limits."""
    if not craft.rotors:
        return
    most = float(craft.allocation[0] @ craft.thrust_high) / craft.weight
    yield _within("hover: thrust to weight", most, THRUST_TO_WEIGHT,
                  "too weak to hover and climb" if most < THRUST_TO_WEIGHT.low else
                  "no vehicle is so strong: thrust in millinewtons or grams?")  # fmt: skip
    for rotor, newtons in zip(craft.rotors, craft.trim.tolist(), strict=True):
        share = 100 * newtons * rotor.axis[2] / craft.weight
        limits = Range(max(rotor.low, _EXACT * craft.weight), rotor.high, "N", "limits of the file")
        yield _within(f"hover: thrust of {rotor.name}", newtons, limits,
                      f"{rotor.name} would carry {newtons:.4g} N and has {rotor.low:g} to "
                      f"{rotor.high:g} N: too weak, a center of mass off the rotors' center, or "
                      "a wrong sign", note=f"{share:.3g} % of weight")  # fmt: skip
    margin = float(np.min(craft.thrust_high / np.maximum(craft.trim, 1e-300)))
    yield _within("hover: margin of the tightest rotor", margin,
                  Range(1.1, math.inf, "", "ours: largest thrust over that of hover"),
                  "a rotor has nothing left to control with while the craft hovers")  # fmt: skip


@_group
def check_trim(craft: ExaminedModel) -> Iterator[Check]:
    """With the thrusts of the hover, within limits, the craft neither accelerates nor turns."""
    if not craft.rotors:
        return
    thrust = np.clip(craft.trim, craft.thrust_low, craft.thrust_high)
    answer = craft.acceleration(craft.ready(thrust))
    torque = craft.mass_matrix[3:, 3:] @ answer[3:] / (craft.weight * craft.arm)
    for name, value, meaning in (
        ("sideways", np.hypot(*answer[:2]) / craft.gravity, "it drifts sideways: rotors lean"),
        ("vertical", abs(answer[2]) / craft.gravity, "it sinks or climbs: thrusts are limited"),
    ):
        yield _near(f"trim: {name} acceleration / g", value, 0, "", _MECHANICS, meaning,
                    _ROUNDED)  # fmt: skip
    yield _near("trim: torque / (weight arm)", float(np.linalg.norm(torque)), 0, "",
                _MECHANICS, "it turns in level hover: the thrusts that balance it do not exist "
                "within the limits", _ROUNDED)  # fmt: skip


# ---- flights -------------------------------------------------------------------------------------


def _turned(data: Any, vector: Array) -> Array:
    """A vector of the body frame in the world frame, (3,)."""
    turned = np.zeros(3)
    mujoco.mju_rotVecQuat(turned, vector, data.qpos[3:])
    return turned


@_group
def check_free_fall(craft: ExaminedModel) -> Iterator[Check]:
    """Depth of a fall of two seconds without thrust: g t² / 2."""
    model = craft.falling()
    data = craft.ready(model=model)
    seconds = _fly(model, data, 2.0)
    expected = craft.gravity * seconds**2 / 2
    yield _near("free fall: depth", _HEIGHT - float(data.qpos[2]), expected, "m", _MECHANICS,
                "it does not fall as a body does: gravity, damping of the joint, or an integrator "
                "that is not exact for a constant force (use RK4)",
                _EXACT * max(1.0, expected))  # fmt: skip


@_group
def check_momentum(craft: ExaminedModel) -> Iterator[Check]:
    """Five seconds of tumbling without forces: momenta and energy are conserved."""
    model = craft.falling(gravity=np.zeros(3))
    before = craft.ready(model=model)
    after = craft.ready(model=model)
    for data in (before, after):
        data.qvel[:] = (*_SPEED, *_SPIN)
    _fly(model, after, 5.0)
    velocity = []
    spin = []
    energy = []
    for data in (before, after):
        rates = np.array(data.qvel[3:])
        velocity.append(data.qvel[:3] + _turned(data, np.cross(rates, craft.center)))
        spin.append(_turned(data, craft.inertia @ rates))
        energy.append(craft.mass * velocity[-1] @ velocity[-1] + rates @ craft.inertia @ rates)
    cause = "damping, friction or armature of the joint, or the integrator (use RK4)"
    for name, pair in (("linear", velocity), ("angular", spin)):
        change = float(np.linalg.norm(pair[1] - pair[0]) / np.linalg.norm(pair[0]))
        yield _near(f"{name} momentum: change in 5 s", change, 0, "", _MECHANICS,
                    f"{name} momentum is not conserved: {cause}", _TRUNCATION)  # fmt: skip
    yield _near("energy: change in 5 s", energy[1] / energy[0] - 1, 0, "", _MECHANICS,
                f"energy is not conserved: {cause}", _TRUNCATION)  # fmt: skip


@dataclass(frozen=True)
class Convergence:
    """Error of the attitude in tumbling flight, over the physics step."""

    turn: float
    """Rate at which it tumbles, rad/s."""
    order: float
    """Power of the step to which the error is proportional."""
    error: float
    """Error of a second at a step that turns it by `_COARSE`, rad."""
    fall: float
    """Error of the depth of a free fall of a second, in proportion to the step, m per s of step."""

    def at(self, step: float) -> float:
        """Error of a second at a step (s), rad."""
        return float(self.error * (step * self.turn / _COARSE) ** max(self.order, 0.1))

    def step(self, error: float) -> float:
        """Step that makes an error (rad) in a second, s."""
        return _COARSE / self.turn * float((error / self.error) ** (1 / max(self.order, 0.1)))


def _converge(craft: ExaminedModel) -> Convergence:
    """Fly one tumbling turn at a step, at its half and at its quarter."""
    turn = float(np.linalg.norm(_SPIN))
    if craft.rotors:
        ends = craft.allocation[1:3] * np.stack((craft.thrust_low, craft.thrust_high))[:, None]
        torque = ends.max(axis=0).sum(axis=1)  # of roll and of pitch
        fastest = float((torque / np.diag(craft.inertia)[:2]).max())
        turn = min(max(0.1 * fastest, 1.0), _FASTEST_TURN)
    spin = turn * np.array(_SPIN) / np.linalg.norm(_SPIN)
    reached = []
    for half in range(3):
        step = _COARSE / turn / 2**half
        model = craft.falling(gravity=np.zeros(3), timestep=step)
        data = craft.ready(model=model)
        data.qvel[3:] = spin
        data.qfrc_applied[3] = 0.05 * craft.moments[0] * turn**2  # a sphere turns exactly without
        _fly(model, data, _TURN / turn)
        reached.append(np.array(data.qpos[3:]))
    coarse, fine = (
        4 * math.asin(min(math.dist(a, b), math.dist(a, -b), 2) / 2)
        for a, b in (reached[:2], reached[1:])
    )
    order = math.log2(coarse / fine) if coarse > 0 and fine > 0 else 0.0
    whole = coarse / (1 - 0.5 ** max(order, 0.1)) / (_TURN / turn)
    depths = []
    for step in (0.01, 0.005):
        model = craft.falling(timestep=step)
        data = craft.ready(model=model)
        _fly(model, data, 1.0)
        depths.append(float(data.qpos[2]))
    fall = 2 * abs(depths[0] - depths[1]) / 0.01
    return Convergence(turn, order, max(whole, 1e-300), fall)


@_group
def check_integrator(craft: ExaminedModel) -> Iterator[Check]:
    """Observed order of the integrator: how fast its error falls with the step."""
    found = craft.convergence
    yield _within("integrator: observed order", found.order,
                  Range(3.5, 5, "", "steps that turn it by 0.05, 0.025 and 0.0125 rad"),
                  "its error falls slowly with the step: Euler and the implicit ones have order 1; "
                  "use RK4", note=str(mujoco.mjtIntegrator(craft.model.opt.integrator).name)
                  .removeprefix("mjINT_"))  # fmt: skip


def recommended_step(vehicle: ModelLike = None) -> tuple[float, str]:
    """Physics step, s, and what bounds it.

    The cost of a second falls with the step, so it is the largest of 1, 2 and 5 times a power of
    ten that is at most each of: the step whose error of attitude is 0.01° in a second of tumbling,
    from the measured error and order (the craft turns as fast as full torque turns it in 0.1 s, at
    most 2000 °/s); the step at which a free fall of a second is 1 mm off; half the time constant
    of its contacts; the time constant of its motors.
    """
    craft = ExaminedModel.read(vehicle)
    bounds = {"error of attitude of 0.01° a second": craft.convergence.step(_ATTITUDE)}
    if craft.convergence.fall > _TRUNCATION:
        bounds["error of a free fall of 1 mm a second"] = _DEPTH / craft.convergence.fall
    colliding = (craft.model.geom_contype | craft.model.geom_conaffinity) != 0
    times = craft.model.geom_solref[colliding, 0]
    if (times > 0).any():
        bounds["half the time constant of contacts"] = float(times[times > 0].min()) / 2
    if isinstance(craft.coefficients, Coefficients) and craft.coefficients.rotors.time_constant:
        lags = (craft.coefficients.rotors.time_constant,
                craft.coefficients.rotors.time_constant_down or math.inf)  # fmt: skip
        bounds["time constant of the motors"] = min(lags)
    why, most = min(bounds.items(), key=lambda bound: bound[1])
    most = min(max(most, 1e-9), 1.0) * (1 + _EXACT)
    power = 10.0 ** math.floor(math.log10(most))
    best = max(digit * power for digit in (1, 2, 5) if digit * power <= most)
    return float(f"{best:.6g}"), why


@_group
def check_physics_step(craft: ExaminedModel) -> Iterator[Check]:
    """The physics step is at most the recommended one, and long enough to be flown."""
    step, why = recommended_step(craft)
    error = math.degrees(craft.convergence.at(min(craft.timestep, _MAX_STEP)))
    yield _within("physics step", craft.timestep,
                  Range(1e-5, step * (1 + _EXACT), "s", f"recommended: {why}"),
                  f"too long for this craft, or shorter than any flight needs: {step:g} s is the "
                  "longest that is accurate", note=f"{error:.3g}° a second")  # fmt: skip


@_group
def check_terminal_velocity(craft: ExaminedModel) -> Iterator[Check]:
    """A level fall with the drag of the file, against its closed form; nothing without drag.

    m v' = m g - c₁ v - c₂ v² ends at the v where the right side is 0.
    """
    if isinstance(craft.coefficients, str):
        return
    drag = craft.coefficients.drag
    linear = craft.linear_drag + (drag.linear[2] if drag.linear else 0.0) / craft.mass
    square = (drag.quadratic[2] if drag.quadratic else 0.0) / craft.mass
    if linear == square == 0.0:
        return
    root = math.sqrt(linear**2 + 4 * square * craft.gravity)
    final = 2 * craft.gravity / (linear + root)
    model = craft.falling(gravity=np.array((0.0, 0.0, -craft.gravity)))
    data = craft.ready(model=model)
    data.qvel[2] = -final / 2
    step = float(model.opt.timestep)
    for _ in range(round(min(10 * final / craft.gravity / step, _MAX_STEPS))):
        speed = -float(data.qvel[2])
        force = craft.mass * (linear + square * abs(speed)) * speed
        data.qfrc_applied[2] = force
        mujoco.mj_step(model, data)
    _expect_no_warning(data)
    # Closed form from half the final speed on: u = v + a / 2b, u' = r² / 4b - b u².
    seconds = float(data.time)
    if square > 0:
        shift = linear / (2 * square)
        scale = root / (2 * square)
        phase = math.atanh((final / 2 + shift) / scale)
        expected = scale * math.tanh(root * seconds / 2 + phase) - shift
    else:
        expected = final * (1 - math.exp(-linear * seconds) / 2)
    yield _near("terminal velocity: long fall", -float(data.qvel[2]), expected, "m/s",
                "closed form of linear and quadratic drag", "drag does not settle: the physics "
                "step is too long for it", _SETTLED * expected,
                note=f"{final:.4g} m/s in the end")  # fmt: skip
    yield _within("units: terminal velocity", final, RANGES["terminal velocity"],
                  "no craft falls at this speed: drag not in N s/m or N s²/m²?")  # fmt: skip


# ---- the ground, and random thrusts --------------------------------------------------------------


@_group
def check_floor(craft: ExaminedModel) -> Iterator[Check]:
    """In the air it touches nothing; dropped by 5 cm it comes to rest on the floor."""
    data = craft.ready()
    mujoco.mj_forward(craft.model, data)
    yield _near("contacts in free flight", data.ncon, 0, "", "level, 1000 m above the floor",
                "it touches itself or something that reaches up there", 0)  # fmt: skip
    rest = craft.rest_height
    model = craft.falling(contact=True)
    if math.isnan(rest):
        yield _near("floor: height at rest", rest, 0, "m", _MODEL,
                    "it touches something at any height: itself, or a wall")  # fmt: skip
        return
    data = craft.ready(model=model)
    data.qpos[2] = rest + 0.05
    _fly(model, data, 2.0)
    falls = "it falls through the floor: no geom of it collides" if rest == 0.0 else ""
    yield _near("floor: height at rest", float(data.qpos[2]), rest, "m", _MODEL,
                falls or "it sinks into the floor, tips over, or does not fall", 1e-3)  # fmt: skip
    for name, values, unit, most in (
        ("speed", data.qvel[:3], "m/s", 1e-3), ("turning", data.qvel[3:], "rad/s", 1e-2),
    ):  # fmt: skip
        yield _near(f"floor: {name} at rest", float(np.linalg.norm(values)), 0, unit, _MECHANICS,
                    falls or "it does not come to rest on the floor in 2 s", most)  # fmt: skip


@_group
def check_random_control(craft: ExaminedModel) -> Iterator[Check]:
    """Two seconds of random thrusts within the limits, from 1 m above the floor: no warning."""
    if not craft.rotors:
        return
    dice = np.random.default_rng(0)
    data = craft.ready()
    data.qpos[2] = 1.0 + (0.0 if math.isnan(craft.rest_height) else craft.rest_height)
    step = float(craft.model.opt.timestep)
    substeps = max(1, min(round(_CONTROL / step), _MAX_STEPS // 100))
    newtons = np.array([rotor.newtons for rotor in craft.rotors])
    told = ""
    try:
        for _ in range(round(2.0 / _CONTROL)):
            data.ctrl[:] = dice.uniform(craft.thrust_low, craft.thrust_high) / newtons
            _fly(craft.model, data, substeps * step)
    except _Warned as warning:
        told = str(warning)
    yield _near("random thrusts: warnings", bool(told), 0, "", "MuJoCo, seed 0",
                f"MuJoCo warned of {told or 'something'}: the simulation diverges", 0)  # fmt: skip

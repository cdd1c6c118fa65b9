"""A vehicle: one free body with rotors, of a file; all else is derived from its compiled model.

Rotors are actuators that push at a site of the body, along an axis and with a reaction about it.
Body frame: that of the free body, x forward, y left, z up; SI units.
"""

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from hashlib import blake2b
from pathlib import Path
from typing import Self

import mujoco
import numpy as np
from mujoco import MjData, MjModel, MjSpec

from . import MAX_DRAG
from .cameras import Camera, own_cameras, read_cameras
from .coefficients import PREFIX, Coefficients
from .errors import InputError, one_line
from .fields import Limits, check, immutable
from .library import find_vehicle
from .matrices import inverse, product, right_inverse, settled
from .mjcf import asset_files, level_data, vehicle_spec
from .vehicle_file import inertia_matrix, model_of, read_vehicle_file

Array = np.ndarray

_LEAST_TIMESTEP = 1e-5  # s: a control step of 0.02 s then takes a hundredth of a second
_MAX_TIMESTEP = 1.0  # s: that of the longest control step
_FIRST_HEIGHT = 6.0  # m: where most craft touch nothing
_MAX_HEIGHT = 1e4  # m: above it no craft may touch anything
_MAX_MASS = 1e9  # kg: its squares overflow nowhere
_RELATIVE = 1e-9  # of a hover's torques and forces: what rounding leaves
_ROUNDED = 1e-5  # of the weight, sideways: what a file's six digits leave

PAYLOAD = "rotorgram/payload"
"""Name of a payload's body."""


@immutable
class Rotor:
    """One rotor of a vehicle."""

    name: str
    position: tuple[float, float, float]
    """Point at which its thrust acts, body frame, m."""
    axis: tuple[float, float, float]
    """Unit vector of its thrust, body frame."""
    reaction: tuple[float, float, float]
    """Torque besides that of its position, body frame, N·m per newton of thrust."""
    low: float
    """Least thrust, N."""
    high: float
    """Largest thrust, N."""
    newtons: float
    """Thrust per unit of its actuator's control, N."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Vehicle:
    """A vehicle over level ground, as `Vehicle.load` gives it."""

    path: Path
    name: str
    """Name of the model."""
    hash: str
    """32 hexadecimal characters: the same file and drag, the same hash. See `Vehicle.load`."""
    model: MjModel
    """Vehicle and ground, compiled without visual elements. Do not change it."""
    linear_drag: float
    """Acceleration of -linear_drag · velocity, 1/s, by a force at the body's origin."""
    mass: float
    """kg."""
    gravity: float
    """Downward acceleration of a free fall, m/s²."""
    center_of_mass: Array
    """Body frame, shape (3,), m."""
    inertia: Array
    """About the center of mass, body axes, shape (3, 3), kg·m²."""
    rotors: tuple[Rotor, ...]
    thrust_low: Array
    """Least thrust of each rotor, shape (R,), N."""
    thrust_high: Array
    """Largest thrust of each rotor, shape (R,), N."""
    allocation: Array
    """Effect of one newton of each rotor, shape (4, R): thrust along body z (N), and torque about
    body x, y and z at the center of mass (N·m)."""
    hover_thrust: Array
    """Thrusts at which the level craft neither moves nor turns, all above 0, shape (R,), N."""
    radius: float
    """Of a sphere about the body's origin that holds all that can collide, m."""
    rest_height: float
    """Height of the body's origin when it touches level ground, m."""
    coefficients: Coefficients
    """What effects and sensors need."""
    file_cameras: tuple[Camera, ...] = ()
    """The cameras of the file."""

    @classmethod
    def load(cls, path: Path | str | None = None, *, linear_drag: float = 0.0) -> "Vehicle":
        """The vehicle of a file, MJCF or TOML, or of the library by its name; None is the paper's.

        Raises `InputError` if there is none. The same path and drag (1/s, as Unity's
        `Rigidbody.drag`, 0 to 100) give the same object until the file changes.

        Its `hash` is BLAKE2b over the MJCF of vehicle and scene with includes resolved, as
        `MjSpec.to_xml()` writes it, the drag as a little-endian float64, the bytes of mesh and
        height field files, and what a TOML file tells. Comments, sources, layout and folder do not
        enter; numbers do, those of TOML with all digits, others to the six that MuJoCo writes.
        """
        file = find_vehicle(path)
        # No negative zero.
        drag = check("linear_drag", Limits(0.0, MAX_DRAG, "/s"), linear_drag) + 0.0
        try:
            changed = tuple(one.stat().st_mtime_ns for one in (file, model_of(file)))
        except OSError as error:
            raise InputError(f"vehicle: cannot read {path}: {error.strerror}") from None
        return _load(file, drag, changed)

    @property
    def num_rotors(self) -> int:
        """R."""
        return len(self.rotors)

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras of the file, and ours where it has none of their names."""
        names = {camera.name for camera in self.file_cameras}
        ours = own_cameras(self.radius, self.rest_height)
        return self.file_cameras + tuple(one for one in ours if one.name not in names)

    @property
    def timestep(self) -> float:
        """Physics step, s."""
        return float(self.model.opt.timestep)

    @property
    def max_acceleration(self) -> float:
        """Largest vertical acceleration of the level craft, up or down, m/s²."""
        ends = self.allocation[0] * (self.thrust_low, self.thrust_high)
        most = ends.max(axis=0).sum()
        least = ends.min(axis=0).sum()
        return float(max(most / self.mass - self.gravity, self.gravity - least / self.mass))

    def turning(self, axis: Sequence[float] | Array) -> float:
        """Largest angular acceleration about an axis through the center of mass, rad/s².

        The axis is a unit vector in the body frame, shape (3,), and its sign matters. The craft is
        at rest, and what its rotors do to the other axes and to its height does not count.
        """
        turned = product(inverse(self.inertia), self.allocation[1:])
        per_newton = product(np.array([axis]), turned)
        return float((per_newton * (self.thrust_low, self.thrust_high)).max(axis=0).sum())

    def substeps(self, period: float) -> int:
        """Physics steps in a control period of so many seconds. Raises `InputError`."""
        ratio = period / self.timestep
        is_whole = abs(ratio - round(ratio)) < 1e-9 * max(ratio, 1.0)
        if ratio <= 0.5 or not is_whole:
            raise InputError(
                f"control_period: expected a positive multiple of the physics step of "
                f"{self.timestep:g} s, which is the timestep in the vehicle's file, got {period!r}"
            )
        return round(ratio)

    def __deepcopy__(self, memo: object) -> Self:
        """Itself: it never changes."""
        return self

    def __reduce__(self) -> tuple[object, ...]:
        """Loaded again from its file."""
        return partial(Vehicle.load, linear_drag=self.linear_drag), (str(self.path),)


def _compile(path: Path) -> tuple[MjSpec, str, MjModel, MjData]:
    """A file's spec, its text, its model, and the vehicle level at the origin. Raises
    `InputError`.
    """
    try:
        spec = vehicle_spec(path)
        spec.comment = ""
        text = spec.to_xml()
        model = spec.compile()
        _check_flyable(model)
        data = level_data(model)
        mujoco.mj_forward(model, data)
    except InputError:
        raise
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        reason = one_line(error)
        kind = "a vehicle" if path.suffix.lower() == ".toml" else "an MJCF file"
        raise InputError(f"vehicle: expected {kind}, got {path.name}: {reason}") from None
    return spec, text, model, data


def payload_radius(mass: float) -> float:
    """Radius of a ball of water of such a mass, m."""
    return float((3 * mass / (4 * math.pi * 1000.0)) ** (1 / 3))


def owners(model: MjModel) -> Array:
    """Number of the craft to which each body belongs, -1 if none, shape (B,)."""
    owner = np.full(model.nbody, -1)
    for body in model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE].tolist():
        if model.body(body).name != PAYLOAD:
            owner[model.body_rootid == body] = owner.max() + 1
    return owner


def craft_geoms(model: MjModel) -> Array:
    """Which geoms are those of the first free body, and of what is welded to it."""
    geoms: Array = owners(model)[model.geom_bodyid] == 0
    return geoms


def radius_of(model: MjModel, geoms: Array) -> float:
    """Of a sphere about the body's origin that holds some geoms, bool, (geoms,), m."""
    reach = np.linalg.norm(level_data(model).geom_xpos, axis=1) + model.geom_rbound
    return float(reach[geoms].max(initial=1e-3))


def can_touch(model: MjModel, others: Array) -> Array:
    """Which geoms may collide with one of others, bool, (geoms,)."""
    types = np.bitwise_or.reduce(model.geom_contype[others])
    affinities = np.bitwise_or.reduce(model.geom_conaffinity[others])
    pairs = (model.geom_contype & affinities) | (model.geom_conaffinity & types)
    return np.asarray(pairs != 0)


def body_axes(model: MjModel) -> Array:
    """Axes of each body in the frame of its craft's free body, as columns, (B, 3, 3)."""
    axes: Array = level_data(model).xmat.reshape(-1, 3, 3).copy()
    return axes


def _check_flyable(model: MjModel) -> None:
    """Raise `InputError` unless a model is one free body with actuators that can be stepped."""
    for owner in (model, model.opt):
        for name in dir(owner):
            value = getattr(owner, name)
            if isinstance(value, float | Array) and not np.isfinite(value).all():
                raise InputError(f"vehicle: expected finite numbers, got others in {name}")
    heaviest = float(model.body_mass.max())
    if heaviest > _MAX_MASS:
        raise InputError(f"vehicle: expected a mass of at most {_MAX_MASS:g} kg, got {heaviest:g}")
    free = int((model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).sum())
    if (free, model.njnt) != (1, 1):
        raise InputError(
            "vehicle: expected one free body and no other joints, "
            f"got {free} free of {model.njnt} joints"
        )
    if not model.nu:
        raise InputError("vehicle: expected at least one rotor, an actuator at a site, got none")
    mass = float(model.body_subtreemass[model.jnt_bodyid[0]])
    gravity = model.opt.gravity
    falls = mass > 0 and gravity[2] < 0 and not gravity[:2].any()
    if not falls:
        raise InputError(
            "vehicle: expected a mass > 0 and gravity along -z, "
            f"got {mass:g} kg and {gravity.tolist()} m/s²"
        )
    step = model.opt.timestep
    if not _LEAST_TIMESTEP <= step <= _MAX_TIMESTEP:
        raise InputError(
            f"vehicle: expected a physics step of at least {_LEAST_TIMESTEP:g} s and at most "
            f"{_MAX_TIMESTEP:g} s, got {step:g}"
        )


@lru_cache(maxsize=32)
def _load(path: Path, drag: float, changed: tuple[int, ...]) -> Vehicle:
    del changed  # a file that was written anew is another key
    spec, text, model, data = _compile(path)
    gravity = -float(model.opt.gravity[2])
    body = int(model.jnt_bodyid[0])
    mass = float(model.body_subtreemass[body])
    center = settled(data.subtree_com[body])
    inertia = inertia_matrix(data.crb[body, :6])
    cameras = read_cameras(spec, model, data)
    rotors = tuple(_read_rotor(model, data, index) for index in range(model.nu))
    columns = []
    for rotor in rotors:
        arm = np.array(rotor.position) - center
        torque = np.cross(arm, rotor.axis) + rotor.reaction
        columns.append((rotor.axis[2], *torque))
    allocation = np.array(columns).T
    model.dof_damping[0:3] = drag * mass
    own = craft_geoms(model)
    model.geom_group[:] = own  # what rays do not see
    solid = own & (model.geom_contype | model.geom_conaffinity > 0)
    return Vehicle(
        path=path,
        name=str(spec.modelname),
        hash=_hash(spec, text, path, drag),
        model=model,
        linear_drag=drag,
        mass=mass,
        gravity=gravity,
        center_of_mass=center,
        inertia=settled(inertia, inertia.max()),
        rotors=rotors,
        thrust_low=np.array([rotor.low for rotor in rotors]),
        thrust_high=np.array([rotor.high for rotor in rotors]),
        allocation=allocation,
        hover_thrust=_hover(rotors, allocation, mass * gravity),
        radius=float(settled(radius_of(model, solid))),
        rest_height=_find_rest_height(model, data),
        coefficients=_read_coefficients(model),
        file_cameras=cameras,
    )


def _read_coefficients(model: MjModel) -> Coefficients:
    """Those among the custom numerics of a model. Raises `InputError` for a wrong one."""
    numbers = {}
    for index in range(model.nnumeric):
        numeric = model.numeric(index)
        if numeric.name.startswith(PREFIX):
            values = numeric.data.tolist()
            name = numeric.name.removeprefix(PREFIX)
            numbers[name] = values[0] if len(values) == 1 else values
    return Coefficients.read(numbers)


def _read_rotor(model: MjModel, data: MjData, index: int) -> Rotor:
    """The rotor of an actuator; `data` is at the origin and level. Raises `InputError`."""
    one = model.actuator(index)
    name = one.name or f"rotor{index + 1}"
    site, reference = one.trnid.tolist()
    force = one.gear[:3]
    torque = one.gear[3:]
    size = math.hypot(*force)
    newtons = size * float(one.gainprm[0])
    at_site = one.trntype == mujoco.mjtTrn.mjTRN_SITE
    is_plain = not (one.gaintype or one.biastype or one.dyntype)  # fixed, none and none are 0
    forces = one.ctrlrange * one.gainprm[0]
    limited = np.clip(forces, *one.forcerange)
    fault = ""
    if not at_site or model.body_rootid[model.site_bodyid[site]] != model.jnt_bodyid[0]:
        fault = f"rotor {name} to be an actuator at a site of the body, got another"
    elif reference >= 0:
        fault = f"rotor {name} to act without a reference site, got one"
    elif not is_plain or model.actuator_delay[index] > 0:
        fault = f"the thrust of rotor {name} to be gain times control, got another law"
    elif newtons == 0.0:
        fault = f"rotor {name} to have a force (gear times gain), got 0 N"
    elif not one.ctrllimited:
        fault = f"rotor {name} to have a thrust with limits (ctrlrange), got none"
    elif one.forcelimited and (limited != forces).any():
        fault = f"rotor {name} to have no forcerange narrower than its thrusts, got one"
    if fault:
        raise InputError(f"vehicle: expected {fault}")
    turn = data.site_xmat[site].reshape(3, 3)
    turned = product(np.array((force, torque)), turn.T) * math.copysign(1 / size, newtons)
    axis, reaction = (settled(one, float(abs(one).max()) or 1.0).tolist() for one in turned)
    low, high = sorted((one.ctrlrange * abs(newtons)).tolist())
    return Rotor(
        name=name,
        position=tuple(settled(data.site_xpos[site]).tolist()),
        axis=tuple(axis),
        reaction=tuple(reaction),
        low=low,
        high=high,
        newtons=abs(newtons),
    )


def _hover(rotors: tuple[Rotor, ...], allocation: Array, weight: float) -> Array:
    """Thrusts that carry the weight without a torque or a sideways force, shape (R,), N.

    Equal, or the least that do. Raises `InputError` if there are none above 0 and within the
    rotors' limits.
    """
    wanted = np.array((weight, 0.0, 0.0, 0.0))
    sideways = np.array([rotor.axis[:2] for rotor in rotors]).T
    scale = weight * max(1e-3, float(np.abs(allocation[1:]).max()))
    total = float(allocation[0].sum())
    thrust = np.full(len(rotors), weight / total if total > 0 else 0.0)
    if np.abs(allocation @ thrust - wanted).max() > _RELATIVE * scale:
        thrust = weight * right_inverse(allocation)[:, 0]
    if np.abs(sideways @ thrust).max() > _ROUNDED * weight:
        thrust = weight * right_inverse(np.vstack((allocation, sideways)))[:, 0]
    turns = np.abs(allocation @ thrust - wanted).max() > 1e-6 * scale
    if turns or np.abs(sideways @ thrust).max() > _ROUNDED * weight:
        raise InputError(
            "vehicle: expected rotors that can carry the level craft without a torque or a "
            "sideways force, got ones that cannot"
        )
    for rotor, newtons in zip(rotors, thrust.tolist(), strict=True):
        if not newtons > _RELATIVE * weight:
            raise InputError(
                f"vehicle: expected rotor {rotor.name} to carry a part of the weight of the level "
                f"craft, got {newtons:.4g} N"
            )
        if not rotor.low <= newtons < rotor.high:
            raise InputError(
                f"vehicle: expected rotor {rotor.name} to carry its share of the weight, "
                f"{newtons:.4g} N, within its limits, got {rotor.low:g} to {rotor.high:g} N"
            )
    return thrust


def _find_rest_height(model: MjModel, data: MjData) -> float:
    """Height at which the level body first touches anything, by bisection; 0 if it never does.

    Raises `InputError` if it touches something at any height, like a wall.
    """
    low = 0.0
    high = _FIRST_HEIGHT
    if not _touches(model, data, low):
        return 0.0
    while _touches(model, data, high):
        high *= 2
        if high > _MAX_HEIGHT:
            raise InputError(
                "vehicle: expected a craft that is free above the ground, "
                f"got one that touches something at {high:.0f} m"
            )
    while high - low > 1e-10 * high:
        middle = (low + high) / 2
        if _touches(model, data, middle):
            low = middle
        else:
            high = middle
    return round(high, 9)


def _touches(model: MjModel, data: MjData, height: float) -> bool:
    data.qpos[2] = height
    mujoco.mj_fwdPosition(model, data)
    return bool(data.ncon > 0)


def _hash(spec: MjSpec, text: str, path: Path, drag: float) -> str:
    digest = blake2b(text.encode() + b"\0" + struct.pack("<d", drag), digest_size=16)
    if path.suffix.lower() == ".toml":
        digest.update(read_vehicle_file(path).content.encode())
    for file in asset_files(spec, model_of(path).parent):
        digest.update(file.read_bytes())
    return digest.hexdigest()

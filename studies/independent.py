"""Our flights beside an independent solution of the same equations.

    python studies/independent.py [--out FILE.csv]

flies every vehicle for 10 s at physics steps from 10 to 1 ms and writes the table that
`docs/independent.md` shows, in some minutes.

Ours: the backend `mujoco`. Theirs: the Newton-Euler equations about the center of mass, written
here from the numbers that `Vehicle` derives, with quaternions; scipy's `solve_ivp` integrates them
from one change of thrust to the next (DOP853, relative tolerance 1e-12). Nothing of MuJoCo and
nothing of `sim/effects` is in them.

The flight begins level and high, moving and turning. Every 20 ms the thrusts change: all rotors
together by up to 30 % of hover, and each by a share of its own. Nothing steers, so the craft
tumbles: the rotors' own shares are so large that it turns about as fast as a gyroscope of 2000 °/s
can measure, or 30 % where that is less.
"""

import copy
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from measuring import options, table, write_rows
from numpy.typing import NDArray
from rotorgram.models import QUAD_XML, InputError, Vehicle
from rotorgram.sim import EffectOptions, InitialState, make_world
from scipy.integrate import solve_ivp

Floats = NDArray[np.float64]

ROOT: Final = Path(__file__).parent.parent
RESULTS: Final = ROOT / "docs" / "results" / "independent"
STEPS: Final = (0.01, 0.005, 0.002, 0.001)
"""Physics steps compared, s; each divides the control period."""
WIND: Final = (3.0, -2.0, 1.0)  # m/s
EFFECTS: Final[dict[str, dict[str, object]]] = {
    "none": {},
    "motor lag": {"motor_lag": True},
    "body drag": {"body_drag": True},
    "rotor drag": {"rotor_drag": True},
    "drag in wind": {"body_drag": True, "wind": WIND},
    "all": {"motor_lag": True, "body_drag": True, "rotor_drag": True, "wind": WIND},
}
"""Those whose equations are smooth; a vehicle flies with the ones that it has coefficients for."""
MAX_M = 1e-3
MAX_DEG = 0.01
"""The targets: largest distance and angle between both flights."""

CONTROL: Final = 0.02  # s
SECONDS: Final = 10.0
_VARIED: Final = 0.3
_AGILE: Final = 20.0  # rad/s²: standard deviation of the angular acceleration about any axis
_SEED: Final = 7
_HEIGHT: Final = 2000.0  # m: nothing is touched
VELOCITY: Final = (1.0, 2.0, 3.0)  # m/s
SPIN: Final = (0.5, -0.4, 0.3)  # rad/s


@dataclass(frozen=True)
class Row:
    """One vehicle, with some effects, at one physics step."""

    vehicle: str
    """Folder of the library, or name of the file."""
    effects: str
    """Key of `EFFECTS`."""
    step_ms: float
    """Physics step, ms."""
    of_file: int
    """1 if it is the step of the vehicle's file."""
    fastest_rad_s: float
    """Largest body rate of the flight, rad/s."""
    fastest_m_s: float
    """Largest speed of the flight, m/s."""
    position_m: float
    """Largest distance between both flights, at the body's origin, m."""
    attitude_deg: float
    """Largest angle between both attitudes, degrees."""

    @property
    def within(self) -> bool:
        """Whether both targets are met."""
        return self.position_m <= MAX_M and self.attitude_deg <= MAX_DEG


@dataclass(frozen=True)
class Flight:
    """States at each of T control steps, the start among them."""

    position: Floats
    """Of the body's origin, world frame, m, shape (T, 3)."""
    quaternion: Floats
    """From body to world frame, scalar first, shape (T, 4)."""
    rates: Floats
    """Body frame, rad/s, shape (T, 3)."""

    @property
    def fastest(self) -> tuple[float, float]:
        """Largest body rate, rad/s, and largest speed, m/s."""
        speeds = np.linalg.norm(np.diff(self.position, axis=0), axis=1) / CONTROL
        return float(np.linalg.norm(self.rates, axis=1).max()), float(speeds.max())

    def apart(self, other: "Flight") -> tuple[float, float]:
        """Largest distance, m, and largest angle, degrees, between both."""
        distance = np.linalg.norm(self.position - other.position, axis=1)
        signs = np.sign(np.sum(self.quaternion * other.quaternion, axis=1))
        chord = np.linalg.norm(self.quaternion - signs[:, None] * other.quaternion, axis=1)
        angle = np.degrees(4 * np.arcsin(np.minimum(chord / 2, 1.0)))
        return float(distance.max()), float(angle.max())


def vehicles() -> dict[str, Vehicle]:
    """`quad.xml`, those of the library and those of the tests, by name, without MuJoCo's air."""
    files = {"quad": QUAD_XML}
    files |= {path.parent.name: path for path in sorted(QUAD_XML.parent.glob("*/*/vehicle.toml"))}
    files |= {path.stem: path for path in sorted((ROOT / "tests" / "data").glob("*.xml"))}
    return {name: _airless(Vehicle.load(path)) for name, path in files.items()}


def at_step(vehicle: Vehicle, step: float) -> Vehicle:
    """The vehicle with another physics step, s."""
    model = copy.copy(vehicle.model)
    model.opt.timestep = step
    return replace(vehicle, model=model)


def thrusts(vehicle: Vehicle, seconds: float = SECONDS, seed: int = _SEED) -> Floats:
    """Thrust of each rotor in each control period, N, shape (T, R)."""
    periods = round(seconds / CONTROL)
    dice = np.random.default_rng(seed)
    hover = vehicle.hover_thrust
    torques = vehicle.allocation[1:]
    spins = np.linalg.norm(np.linalg.solve(vehicle.inertia, torques * hover), axis=1)
    own = min(_VARIED, math.sqrt(3) * _AGILE / float(spins.max()))
    varied = dice.uniform(-_VARIED, _VARIED, (periods, 1))
    varied = varied + dice.uniform(-own, own, (periods, vehicle.num_rotors))
    return np.clip(hover * (1 + varied), vehicle.thrust_low, vehicle.thrust_high)


def ours(vehicle: Vehicle, commands: Floats, effects: Mapping[str, object]) -> Flight:
    """The flight of the backend `mujoco` at the vehicle's physics step."""
    world = make_world(vehicle, 1, effects=EffectOptions(**effects))
    state = world.state
    start = InitialState(
        position=np.array([[(0.0, 0.0, _HEIGHT)]]),
        velocity=np.array([[VELOCITY]]),
        body_rates=np.array([[SPIN]]),
    )
    world.reset(np.ones((1, 1), bool), start)
    flown = []
    for command in (None, *commands):
        if command is not None:
            world.step(command, vehicle.substeps(CONTROL))
            assert not state.touching
        now = (state.position, state.quaternion, state.body_rates)
        flown.append([x[0, 0].copy() for x in now])
    world.close()
    return Flight(*(np.array(part) for part in zip(*flown, strict=True)))


def independent(
    vehicle: Vehicle, commands: Floats, effects: Mapping[str, object], tolerance: float = 1e-12
) -> Flight:
    """The flight by `solve_ivp` of `Equations`."""
    equations = Equations(vehicle, effects)
    center = vehicle.center_of_mass
    # Position and velocity of the center of mass, quaternion, body rates, roots of the thrusts. The
    # position counts from the start of each control period: it stays small, so its error too.
    y = np.concatenate(
        (
            (0.0, 0.0, 0.0),
            np.array(VELOCITY) + np.cross(SPIN, center),
            (1.0, 0.0, 0.0, 0.0),
            SPIN,
            np.sqrt(vehicle.hover_thrust),
        )
    )
    at = np.array((0.0, 0.0, _HEIGHT)) + center
    flown = []
    for command in (None, *commands):
        if command is not None:
            end = solve_ivp(
                equations.derivative, (0.0, CONTROL), y, "DOP853", args=(command,),
                rtol=tolerance, atol=1e-3 * tolerance,
            )  # fmt: skip
            assert end.success, end.message
            y = end.y[:, -1].copy()
            at = at + y[:3]
            y[:3] = 0.0
            y[6:10] /= np.linalg.norm(y[6:10])
        flown.append((at - rotation(y[6:10]) @ center, y[6:10].copy(), y[10:13].copy()))
    return Flight(*(np.array(part) for part in zip(*flown, strict=True)))


class Equations:
    """The Newton-Euler equations of a vehicle about its center of mass, with some effects."""

    def __init__(self, vehicle: Vehicle, effects: Mapping[str, object]) -> None:
        told = vehicle.coefficients
        rotors = vehicle.rotors
        self.effects = effects
        self.mass = vehicle.mass
        self.inertia = vehicle.inertia
        self.inverse = np.linalg.inv(vehicle.inertia)
        self.weight = np.array((0.0, 0.0, -vehicle.mass * vehicle.gravity))
        self.axis = np.array([r.axis for r in rotors])
        self.arm = np.array([r.position for r in rotors]) - vehicle.center_of_mass
        self.reaction = np.array([r.reaction for r in rotors])
        self.wind = np.array(effects.get("wind", (0.0, 0.0, 0.0)))
        if "motor_lag" in effects:
            self.rise = told["rotors.time_constant"]
            self.fall = told["rotors.time_constant_down"] or self.rise
        if "body_drag" in effects:
            self.linear = np.array(told["drag.linear"] or (0.0, 0.0, 0.0))
            self.quadratic = np.array(told["drag.quadratic"] or (0.0, 0.0, 0.0))
        if "rotor_drag" in effects:
            self.k = told["rotors.thrust_coefficient"]
            self.drag = told["rotors.drag"] or 0.0
            self.inflow = told["rotors.inflow"] or 0.0
            self.lift = told["rotors.lift"] or 0.0

    def derivative(self, _: float, y: Floats, command: Floats) -> Floats:
        """Of the position and velocity of the center of mass, quaternion, body rates, and roots."""
        velocity = y[3:6]
        q = y[6:10]
        rates = y[10:13]
        root = y[13:]
        turn = rotation(q)
        thrust = command
        change = np.zeros_like(root)
        if "motor_lag" in self.effects:
            wanted = np.sqrt(command)
            thrust = root * root
            change = (wanted - root) / np.where(wanted > root, self.rise, self.fall)
        force = thrust[:, None] * self.axis  # of each rotor, body axes
        torque = thrust @ self.reaction
        body = np.zeros(3)
        air = turn.T @ (velocity - self.wind)
        if "body_drag" in self.effects:
            body = -(self.linear + self.quadratic * math.sqrt(air @ air)) * air
        if "rotor_drag" in self.effects:
            hub = air + cross(rates, self.arm)
            along = np.sum(hub * self.axis, axis=1)[:, None] * self.axis
            plane = hub - along
            speed = np.sqrt(thrust / self.k)[:, None]
            lift = self.lift * np.sum(plane * plane, axis=1)[:, None] * self.axis
            force = force + lift - speed * (self.drag * plane + self.inflow * along)
        torque = torque + cross(self.arm, force).sum(axis=0)
        acceleration = (turn @ (force.sum(axis=0) + body) + self.weight) / self.mass
        spin = self.inverse @ (torque - cross(rates, self.inertia @ rates))
        w = q[0]
        x, y_, z = q[1:]
        a, b, c = 0.5 * rates
        turning = (
            -x * a - y_ * b - z * c,
            w * a + y_ * c - z * b,
            w * b + z * a - x * c,
            w * c + x * b - y_ * a,
        )
        return np.concatenate((velocity, acceleration, turning, spin, change))


def rotation(q: Floats) -> Floats:
    """Matrix from body to world axes of a quaternion of any length, shape (3, 3)."""
    w, x, y, z = q
    s = 2 / (q @ q)
    return np.array(
        (
            (1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)),
            (s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x)),
            (s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y)),
        )
    )


def cross(a: Floats, b: Floats) -> Floats:
    """As NumPy's, in a fifth of its time."""
    a0, a1, a2, b0, b1, b2 = (v[..., i] for v in (a, b) for i in range(3))
    return np.stack((a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0), axis=-1)


def compare(
    name: str,
    vehicle: Vehicle,
    effects: Iterable[str] = EFFECTS,
    steps: Iterable[float] = STEPS,
    seconds: float = SECONDS,
) -> list[Row]:
    """Fly a vehicle both ways, with each of the effects that it has coefficients for."""
    rows = []
    commands = thrusts(vehicle, seconds)
    for words in effects:
        chosen = EFFECTS[words]
        truth = None
        for step in sorted({*steps, vehicle.timestep}, reverse=True):
            try:
                flown = ours(at_step(vehicle, step), commands, chosen)
            except InputError:  # it has no coefficients for them, or the step is too long for them
                continue
            truth = truth or independent(vehicle, commands, chosen)
            own = int(step == vehicle.timestep)
            numbers = (float(f"{x:.4g}") for x in (*truth.fastest, *flown.apart(truth)))
            rows.append(Row(name, words, step * 1e3, own, *numbers))
    return rows


def order(rows: Sequence[Row]) -> float:
    """Observed order of the error of position: that of the finest two steps above rounding."""
    seen = sorted((row.step_ms, row.position_m) for row in rows if row.position_m > 1e-8)
    (fine, less), (coarse, more) = seen[:2]
    return math.log(more / less) / math.log(coarse / fine)


def markdown(rows: Sequence[Row]) -> str:
    """The table, in Markdown: each vehicle with each effect at the step of its file."""
    head = (
        "vehicle",
        "effects",
        "turns, rad/s",
        "flies, m/s",
        "step, ms",
        "off the path, m",
        "off the attitude, °",
        "order",
        "within 1 mm and 0.01° at",
    )
    lines = []
    for row in rows:
        if not row.of_file:
            continue
        alike = [r for r in rows if (r.vehicle, r.effects) == (row.vehicle, row.effects)]
        enough = [r.step_ms for r in alike if r.within]
        most = f"{max(enough):g}" if enough else "less than 1"
        errors = (f"{row.position_m:.1e}", f"{row.attitude_deg:.1e}")
        speeds = (f"{row.fastest_rad_s:.1f}", f"{row.fastest_m_s:.0f}", f"{row.step_ms:g}")
        order_seen = f"{order(alike):.1f}"
        lines.append((row.vehicle, row.effects, *speeds, *errors, order_seen, f"{most} ms"))
    return table(head, lines)


def _airless(vehicle: Vehicle) -> Vehicle:
    """Without MuJoCo's own air: the equations here have none."""
    model = copy.copy(vehicle.model)
    model.opt.density = model.opt.viscosity = 0.0
    return replace(vehicle, model=model)


def _main() -> None:
    args = options(__doc__, out=RESULTS / "flights.csv").parse_args()
    rows = []
    for name, vehicle in vehicles().items():
        rows += compare(name, vehicle)
    write_rows(args.out, rows)
    print(markdown(rows))


if __name__ == "__main__":
    _main()

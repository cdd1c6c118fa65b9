"""Policies from one simulator in another: RAPTOR in ours, ours in rl-tools' simulator.

    pip install 'rotorgram[raptor]' l2f    # which needs a C++ compiler
    python studies/sim_to_sim.py [--flights 200] [--vehicles crazyflie2 ...] [--again universal]

writes `docs/results/sim_to_sim.json` with three parts, and `sim_to_sim.csv.gz` with every flight.
`--page` prints the tables of `docs/pilots.md` from that file; `--again` flies cells of one pilot
alone, and keeps all else.

**Agreement**: how far l2f and our backends are apart after the same motor commands, recorded from a
flight of RAPTOR, all at steps of 1 ms. l2f, which has single precision, gets mass, inertia, rotors,
thrust and lag from our vehicle; the square root of a thrust is its motors' speed, as in ours.

**Cells**: every quadcopter of the library flown by `geometric`, PPO, RAPTOR and `universal`, on the
backends `rigid` and `mujoco` and in l2f, from the same starts of `Hover-v0`. l2f takes the place of
the physics alone: task, observation and crashes are ours. PPO is trained on `rigid`, with the
task's tuned preset, seed 0. Motor lag is on where the vehicle has a time constant.

**Alone**: RAPTOR in l2f without any code of ours between them: l2f's observation, RAPTOR's motor
commands. First with the rotors of each craft by their corners, whatever way they turn; then with
the craft turned as `agents/raptor.py` says; then with one number of a craft varied, which shows its
limits. Starts are those of `Hover-v0`; a crash is a distance of 3 m or a tilt of 90° within 5 s.

`error` is the mean distance over the last quarter of a flight without a crash, m.
"""

import csv
import gzip
import io
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import astuple
from pathlib import Path
from typing import Any, NamedTuple, Self
from unittest import mock

import l2f
import numpy as np
from foundation_policy import Raptor as Policy
from independent import Flight
from measuring import RESULTS, options, table, write
from rotorgram.agents import find_controller, load
from rotorgram.agents.raptor import layout
from rotorgram.cli._env import UNIVERSAL
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.config import EnvConfig
from rotorgram.flights.trajectories import Trajectory, fly_episodes
from rotorgram.models import Vehicle
from rotorgram.models.library import LIBRARY
from rotorgram.sim import Array
from rotorgram.sim.backends import rigid
from rotorgram.sim.backends.rigid import RigidWorld
from rotorgram.sim.rotations import to_world
from rotorgram.sim.world import Call
from rotorgram.training.statistics import share_interval

TASK = "rotorgram/Hover-v0"
VEHICLES = ["crazyflie2", "crazyflie_brushless", "hummingbird", "skydio_x2", "paper"]
AGENTS = ("geometric", "ppo", "raptor", "universal")
SIMULATORS = ("rigid", "mujoco", "l2f")
SECONDS = 5.0
PERIOD = 0.01  # s, between RAPTOR's actions
STEP = 0.001  # s, of l2f: the Hummingbird's lag is 5 ms
BAND = 3.0  # m
WORLDS = 50
QUICK = 0.05  # s: a time constant that is never used, of rotors without lag
SEED = 0  # of the trainings
VARIED: Mapping[str, Sequence[float]] = {
    "lag": (0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3),
    "thrust_to_weight": (1.2, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0),
    "mass": (0.5, 0.75, 1.0, 1.25, 1.5),
    "agility": (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 4.0, 8.0),
    "scale": (0.5, 1.0, 2.0, 4.0, 8.0, 16.0),
}
"""Of flights alone: seconds; largest thrust over weight; times the vehicle's mass, at its thrust;
times its torque over inertia; times its lengths, at its density, thrust over weight and lag."""

Row = dict[str, Any]
Values = dict[str, Any]


class Flown(NamedTuple):
    """One flight."""

    crashed: bool
    error: float


# ---- l2f with a vehicle of ours


class Craft(NamedTuple):
    """What l2f needs of a vehicle, body frame, SI units."""

    mass: float
    gravity: float
    inertia: Array
    positions: Array
    """Of the rotors, from the center of mass, shape (4, 3)."""
    axes: Array
    reactions: Array
    curve: Array
    """Thrust at a throttle of 0 to 1, c₀, c₁, c₂, N."""
    rising: float
    """Time constants of the throttle, s; 0: none."""
    falling: float

    @classmethod
    def of(cls, vehicle: Vehicle, *, lag: bool) -> "Craft":
        """Of a vehicle, whose throttle is the square root of the share of the largest thrust."""
        rotors = vehicle.rotors
        rise = vehicle.coefficients["rotors.time_constant"] if lag else 0.0
        fall = vehicle.coefficients["rotors.time_constant_down"] if lag else 0.0
        return cls(
            mass=vehicle.mass,
            gravity=vehicle.gravity,
            inertia=vehicle.inertia,
            positions=np.array([rotor.position for rotor in rotors]) - vehicle.center_of_mass,
            axes=np.array([rotor.axis for rotor in rotors]),
            reactions=np.array([rotor.reaction for rotor in rotors]),
            curve=np.array((0.0, 0.0, float(vehicle.thrust_high[0]))),
            rising=rise,
            falling=fall or rise,
        )

    def turned(self, order: Sequence[int], turn: complex) -> "Craft":
        """With its rotors in another order, in a frame turned about z by e^(iθ)."""
        c = turn.real
        s = turn.imag
        frame = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))
        rows = (self.positions, self.axes, self.reactions)
        positions, axes, reactions = (row[list(order)] @ frame for row in rows)
        inertia = frame.T @ self.inertia @ frame
        return self._replace(positions=positions, axes=axes, reactions=reactions, inertia=inertia)

    @property
    def thrust_to_weight(self) -> float:
        """Largest thrust over weight."""
        return 4 * float(self.curve.sum()) / (self.mass * self.gravity)

    @property
    def agility(self) -> float:
        """Torque of two rotors at full thrust over the inertia about x, rad/s²."""
        arms = np.sort(np.abs(self.positions[:, 1]))[-2:]
        return float(arms.sum() * self.curve.sum() / self.inertia[0, 0])

    @property
    def hover(self) -> float:
        """Throttle of a hover."""
        share = np.array((*self.curve[:0:-1], self.curve[0] - self.mass * self.gravity / 4))
        return float(max(np.roots(share).real))

    def varied(self, name: str, value: float) -> "Craft":
        """With one of `VARIED` changed."""
        if name == "lag":
            return self._replace(rising=value, falling=value)
        if name == "thrust_to_weight":
            # The torques of the rotors over the inertia stay.
            share = value / self.thrust_to_weight
            return self._replace(curve=self.curve * share, inertia=self.inertia * share)
        if name == "mass":
            return self._replace(mass=self.mass * value)
        if name == "agility":
            return self._replace(inertia=self.inertia / value)
        return self._replace(
            mass=self.mass * value**3,
            inertia=self.inertia * value**5,
            positions=self.positions * value,
            reactions=self.reactions * value,
            curve=self.curve * value**3,
        )


class Simulator:
    """l2f with one craft."""

    def __init__(self, craft: Craft, step: float, count: int) -> None:
        self.craft = craft
        self.device = l2f.Device()
        self.rng = l2f.Rng()
        self.env = l2f.Environment()
        self.parameters = l2f.Parameters()
        l2f.initialize_environment(self.device, self.env)
        l2f.initialize_rng(self.device, self.rng, 0)
        l2f.initial_parameters(self.device, self.env, self.parameters)
        told = json.loads(l2f.parameters_to_json(self.device, self.env, self.parameters))
        told["dynamics"] = dynamics(craft)
        told["integration"] = {"dt": step}
        l2f.parameters_from_json(self.device, self.env, json.dumps(told), self.parameters)
        self.states = [l2f.State() for _ in range(count)]
        for state in self.states:
            l2f.initial_state(self.device, self.env, self.parameters, state)
        self._next = l2f.State()
        l2f.initial_state(self.device, self.env, self.parameters, self._next)

    def fly(self, state: Any, throttles: Array, steps: int = 1) -> None:
        """Advance one state by some steps at throttles, shape (4,)."""
        if not self.craft.rising:
            state.rpm = throttles
        action = 2.0 * throttles - 1.0
        for _ in range(steps):
            l2f.step(self.device, self.env, self.parameters, state, action, self._next, self.rng)
            state.assign(self._next)


def dynamics(craft: Craft) -> Values:
    """The part `dynamics` of l2f's parameters."""
    sizes = np.linalg.norm(craft.reactions, axis=1)
    return {
        "rotor_positions": craft.positions.tolist(),
        "rotor_thrust_directions": craft.axes.tolist(),
        "rotor_torque_directions": (craft.reactions / sizes[:, None]).tolist(),
        "rotor_thrust_coefficients": [craft.curve.tolist()] * 4,
        "rotor_torque_constants": sizes.tolist(),
        "rotor_time_constants_rising": [craft.rising or QUICK] * 4,
        "rotor_time_constants_falling": [craft.falling or QUICK] * 4,
        "mass": craft.mass,
        "gravity": [0.0, 0.0, -craft.gravity],
        "J": craft.inertia.tolist(),
        "J_inv": np.linalg.inv(craft.inertia).tolist(),
        "hovering_throttle_relative": craft.hover,
        "action_limit": {"min": 0.0, "max": 1.0},
    }


class L2fWorld(RigidWorld):
    """Worlds of one drone in which l2f is the physics, with the motor lag of l2f."""

    def __init__(self, vehicle: Vehicle, num_worlds: int, **settings: Any) -> None:
        super().__init__(vehicle, num_worlds, **settings)
        assert vehicle.linear_drag == 0.0
        assert self.shape[1] == 1
        craft = Craft.of(vehicle, lag=self._options.motor_lag)
        self._steps = round(vehicle.timestep / STEP)
        self._simulator = Simulator(craft, STEP, num_worlds)

    def push(self, mask: Array | None) -> None:
        """Nothing but l2f acts."""

    def place(self, mask: Array) -> None:
        """As `World.place`."""
        center = self.vehicle.center_of_mass
        state = self.state
        position = state.position + to_world(state.quaternion, center)
        swung = to_world(state.quaternion, np.cross(state.body_rates, center))
        throttles = np.sqrt(state.thrust / self.vehicle.thrust_high)
        for world in np.flatnonzero(mask[:, 0]).tolist():
            one = self._simulator.states[world]
            one.position = position[world, 0]
            one.orientation = state.quaternion[world, 0]
            one.linear_velocity = (state.velocity + swung)[world, 0]
            one.angular_velocity = state.body_rates[world, 0]
            one.rpm = throttles[world, 0]
        super().place(mask)

    def fly(self, call: Call, mask: Array | None) -> None:
        """As `World.fly`."""
        high = self.vehicle.thrust_high
        throttles = np.sqrt(np.clip(self.state.command / high, 0.0, 1.0))
        motion = self.motion.copy()
        thrust = self.state.thrust.copy()
        flown = range(self.shape[0]) if mask is None else np.flatnonzero(mask[:, 0]).tolist()
        for world in flown:
            one = self._simulator.states[world]
            self._simulator.fly(one, throttles[world, 0], call.steps * self._steps)
            parts = (one.position, one.orientation, one.linear_velocity, one.angular_velocity)
            motion[world, 0] = np.concatenate(parts)
            thrust[world, 0] = high * np.square(one.rpm)
        center = self.vehicle.center_of_mass
        turn = motion[..., 3:7]
        swung = to_world(turn, np.cross(motion[..., 10:], center))
        rows = np.array(flown)
        motion[rows, :, :3] -= to_world(turn, center + 0.0 * motion[..., :3])[rows]
        motion[rows, :, 7:10] -= swung[rows]
        self.state.thrust = thrust
        self._show(motion)
        self._look(mask, looks=call.looks, clears=call.clears, left=call.left)


@contextmanager
def simulator(name: str) -> Iterator[Values]:
    """Options of an env that is stepped by one of `SIMULATORS`."""
    if name == "mujoco":
        yield {"backend": "mujoco"}
    elif name == "rigid":
        yield {"backend": "rigid", "dtype": "float64"}
    else:
        with mock.patch.object(rigid, "RigidWorld", L2fWorld):
            yield {"backend": "rigid", "dtype": "float64", "compiled": False}


# ---- flights


def lag_of(vehicle: str) -> bool:
    """Whether a vehicle has a time constant."""
    return Vehicle.load(vehicle).coefficients["rotors.time_constant"] is not None


def config_of(vehicle: str, **settings: object) -> EnvConfig:
    """Of Hover for 5 s, with lag where the vehicle has it."""
    effects = {"motor_lag": True} if lag_of(vehicle) else {}
    config = EnvConfig.from_keywords(TASK, vehicle=vehicle, effects=effects, **settings)
    return config.changed(episode_length=round(SECONDS / config.control_period))


def trained(vehicle: str, folder: Path) -> Any:
    """The checkpoint of PPO, trained with the tuned preset of the task."""
    words = [
        "ppo",
        "--preset",
        "tuned",
        "--env",
        TASK,
        "--vehicle",
        vehicle,
        "--no-udp",
        "--seed",
        str(SEED),
    ]
    words += ["--effects", "motor_lag"] if lag_of(vehicle) else []
    command = [sys.executable, "-m", "rotorgram.cli", "train", *words, "--out", str(folder)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return load(folder / "checkpoint.safetensors")


def flights_of(vehicle: str, agent: str, where: str, ppo: Any, count: int) -> list[Trajectory]:
    """Evaluation episodes, the same starts for all."""
    if agent == "universal":
        make, needed = load(UNIVERSAL).policy, {"action": "wrench", "frame": "body"}
    elif agent == "ppo":
        make, needed = ppo.policy, {}
    else:
        make, needed = find_controller(agent), find_controller(agent).options
    with simulator(where) as backend:
        config = config_of(vehicle, **needed, **backend)
        with closing(LocalVectorEnv(config, min(WORLDS, count), autoreset_mode="Disabled")) as env:
            return fly_episodes(env, make(env.env_spec), count, "final")


def flown_of(flight: Trajectory) -> Flown:
    """Crash and error of a flight."""
    distance = np.linalg.norm(flight.telemetry["goal"] - flight.telemetry["position"], axis=1)
    return Flown(flight.ending == "terminated", float(distance[-len(distance) // 4 :].mean()))


def row_of(flights: Iterable[Flown]) -> Row:
    """Crashes with Wilson's interval, and error of what did not crash."""
    several = list(flights)
    crashes = sum(one.crashed for one in several)
    errors = [one.error for one in several if not one.crashed]
    row: Row = {
        "flights": len(several),
        "crashes": crashes,
        "interval": [round(end, 4) for end in share_interval(crashes, len(several))],
    }
    if errors:
        row["error_median"] = round(float(np.median(errors)), 4)
        row["error_95"] = round(float(np.quantile(errors, 0.95)), 4)
    return row


# ---- the same motor commands


def finer(vehicle: str, folder: Path) -> str:
    """A copy of a vehicle of the library whose physics step is `STEP`."""
    copy = shutil.copytree(LIBRARY / vehicle, folder / vehicle)
    file = copy / "vehicle.toml"
    lines = file.read_text(encoding="utf-8").splitlines()
    kept = [line for line in lines if not line.startswith("timestep")]
    file.write_text("\n".join((f"timestep = {STEP}", *kept)), encoding="utf-8")
    return str(file)


def agreement(vehicle: str) -> Row:
    """How far l2f and `mujoco` are from `rigid` after commands of a flight of RAPTOR there."""
    raptor = find_controller("raptor")
    with simulator("rigid") as backend:
        config = config_of(vehicle, **raptor.options, **backend)
        with closing(LocalVectorEnv(config, 1, autoreset_mode="Disabled")) as env:
            pilot = raptor(env.env_spec)
            observation, _ = env.reset(seed=7)
            pilot.reset()
            actions = []
            for _ in range(config.episode_length):
                actions.append(pilot.act(observation[0])[None])
                observation = env.step(actions[-1])[0]
    motions = {name: _replayed(vehicle, raptor.options, name, actions) for name in SIMULATORS}
    found: Row = {}
    for name in ("mujoco", "l2f"):
        for seconds in (1, 5):
            steps = round(seconds / PERIOD)
            pair = (motions[where] for where in ("rigid", name))
            ours, theirs = (Flight(*(rows[:steps] for rows in astuple(one))) for one in pair)
            position, attitude = ours.apart(theirs)
            found[f"{name}, {seconds} s"] = {"position_m": position, "attitude_deg": attitude}
    return found


def _replayed(
    vehicle: str, needed: Mapping[str, object], where: str, actions: Sequence[Array]
) -> Flight:
    """The flight in a simulator."""
    with simulator(where) as backend:
        config = config_of(vehicle, **needed, **backend, flight_band=1e3)
        with closing(LocalVectorEnv(config, 1, autoreset_mode="Disabled")) as env:
            env.reset(seed=7)
            told = []
            for action in actions:
                env.step(action)
                state = env.loop.world.state
                rows = (state.position, state.quaternion, state.body_rates)
                told.append(np.concatenate([row[0, 0] for row in rows]))
    rows = np.array(told, np.float64)
    return Flight(rows[:, :3], rows[:, 3:7], rows[:, 7:])


# ---- RAPTOR and l2f alone


def starts_of(vehicle: str, count: int) -> Array:
    """Of Hover, from the goal, with quaternions, (count, 7): of evaluation episodes."""
    config = config_of(vehicle, backend="rigid", dtype="float64", episode_length=1)
    with closing(LocalVectorEnv(config, min(WORLDS, count), autoreset_mode="Disabled")) as env:
        flights = fly_episodes(env, None, count, "final")
    pose = np.array([flight.pose[0] for flight in flights])
    pose[:, :3] -= [flight.telemetry["goal"][0] for flight in flights]
    return pose


def alone(craft: Craft, starts: Array, turn: complex = 1.0 + 0.0j) -> list[Flown]:
    """Flights of RAPTOR in l2f, which has the craft as RAPTOR has it: motors by their corners.

    Where its frame is turned, starts and goal are seen from there.
    """
    simulator = Simulator(craft, PERIOD, len(starts))
    for state, pose in zip(simulator.states, starts, strict=True):
        x, y, z = pose[:3]
        place = complex(x, y) / turn
        w, i, j, k = pose[3:]
        side = complex(i, j) / turn
        state.position = np.array((place.real, place.imag, z))
        state.orientation = np.array((w, side.real, side.imag, k))
        state.rpm = np.full(4, craft.hover)
    policy = Policy()
    policy.reset()
    observation = l2f.Observation()
    steps = round(SECONDS / PERIOD)
    distances = np.zeros((steps, len(starts)))
    crashed = np.zeros(len(starts), bool)
    for step in range(steps):
        inputs = []
        for state in simulator.states:
            l2f.observe(
                simulator.device, simulator.env, simulator.parameters, state, observation,
                simulator.rng,
            )  # fmt: skip
            inputs.append(observation.observation)
        seen = np.array(inputs)
        motors = np.clip(policy.evaluate_step(seen[:, :22]), -1.0, 1.0)
        for state, throttles in zip(simulator.states, 0.5 + 0.5 * motors, strict=True):
            simulator.fly(state, throttles)
        positions = np.array([state.position for state in simulator.states])
        turns = np.array([state.orientation for state in simulator.states])
        distances[step] = np.linalg.norm(positions, axis=1)
        upright = 1.0 - 2.0 * (turns[:, 1] ** 2 + turns[:, 2] ** 2)
        crashed |= (distances[step] > BAND) | (upright < 0.0)
    errors = distances[-steps // 4 :].mean(axis=0)
    return [Flown(bool(c), float(e)) for c, e in zip(crashed, errors, strict=True)]


CORNERS = (1 - 1j, -1 - 1j, -1 + 1j, 1 + 1j)
"""Signs of x and y of RAPTOR's motors, x + iy."""


def by_corners(craft: Craft) -> Craft:
    """With its rotors in RAPTOR's order, whatever way they turn."""
    places = [complex(*np.sign(position[:2])) for position in craft.positions]
    return craft.turned([places.index(corner) for corner in CORNERS], 1.0 + 0.0j)


# ---- what is written


class Result:
    """The file of figures, and that of flights, written after each part."""

    def __init__(self, out: Path, count: int) -> None:
        self._out = out
        self._told: dict[str, Any] = {"flights": count, "agreement": {}}
        self._flights: list[tuple[object, ...]] = []

    @classmethod
    def without(cls, out: Path, agent: str) -> Self:
        """That of the files, without the cells of a pilot."""
        told = json.loads(out.read_text(encoding="utf-8"))
        self = cls(out, told["flights"])
        told["cells"] = [row for row in told["cells"] if row["agent"] != agent]
        self._told = told
        text = gzip.decompress(out.with_suffix(".csv.gz").read_bytes()).decode()
        rows = [tuple(row) for row in csv.reader(text.splitlines()[1:])]
        self._flights = [row for row in rows if row[0] != "cells" or row[1].split()[1] != agent]
        return self

    def agree(self, vehicle: str, row: Row) -> None:
        """Add how far the simulators are apart."""
        self._told["agreement"][vehicle] = row
        self.write()

    def add(self, part: str, names: Mapping[str, object], flights: Sequence[Flown]) -> None:
        """Add a row of a part, and its flights."""
        row = {**names, **row_of(flights)}
        self._told.setdefault(part, []).append(row)
        key = " ".join(str(value) for value in names.values())
        for number, flight in enumerate(flights):
            error = "" if flight.crashed else f"{flight.error:.4f}"
            self._flights.append((part, key, number, int(flight.crashed), error))
        print(part, key, row["crashes"], row.get("error_median"), flush=True)
        self.write()

    def write(self) -> None:
        """Write both files."""
        write(self._out, self._told)
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(("part", "row", "flight", "crashed", "error"))
        writer.writerows(self._flights)
        packed = gzip.compress(text.getvalue().encode(), mtime=0)
        self._out.with_suffix(".csv.gz").write_bytes(packed)


def told(row: Row) -> str:
    """A cell of the page: crashes and error."""
    crashes = f"{row['crashes']} crashed" if row["crashes"] else ""
    error = f"{100 * row['error_median']:.2g} cm" if "error_median" in row else ""
    return ", ".join(word for word in (crashes, error) if word)


def page(result: Mapping[str, Any]) -> str:
    """The tables of the page, of the file."""
    cells = {(r["vehicle"], r["agent"], r["simulator"]): told(r) for r in result["cells"]}
    vehicles = list(result["agreement"])
    head = ["vehicle", "pilot", *(f"`{name}`" for name in SIMULATORS)]
    rows = [
        [f"`{vehicle}`", f"`{agent}`", *(cells[vehicle, agent, where] for where in SIMULATORS)]
        for vehicle in vehicles
        for agent in AGENTS
    ]
    flown = {(r["vehicle"], r["motors"]): told(r) for r in result["alone"]}
    apart = [
        [
            f"`{vehicle}`",
            f"{1000 * result['agreement'][vehicle]['l2f, 1 s']['position_m']:.2f} mm",
            f"{1000 * result['agreement'][vehicle]['l2f, 5 s']['position_m']:.1f} mm",
            flown[vehicle, "corners"],
            flown[vehicle, "turned"],
        ]
        for vehicle in vehicles
    ]
    alone_head = ["vehicle", "l2f − `rigid`, 1 s", "5 s", "by corners", "by turns"]
    return table(head, rows) + "\n\n" + table(alone_head, apart)


def fly_cells(result: Result, vehicles: Sequence[str], agents: Sequence[str], count: int) -> None:
    """Add the cells of some pilots."""
    for name in vehicles:
        with tempfile.TemporaryDirectory() as folder:
            ppo = trained(name, Path(folder) / "ppo") if "ppo" in agents else None
            for agent in agents:
                for where in SIMULATORS:
                    keys = {"vehicle": name, "agent": agent, "simulator": where}
                    flights = flights_of(name, agent, where, ppo, count)
                    result.add("cells", keys, [flown_of(flight) for flight in flights])


def main() -> None:
    out = RESULTS / "sim_to_sim.json"
    parser = options(__doc__, flights=200, vehicles=VEHICLES, out=out, page=False,
                     again="")  # fmt: skip
    args = parser.parse_args()
    if args.page:
        print(page(json.loads(args.out.read_text(encoding="utf-8"))))
        return
    if args.again:
        result = Result.without(args.out, args.again)
        fly_cells(result, args.vehicles, [args.again], args.flights)
        return
    result = Result(args.out, args.flights)
    for name in args.vehicles:
        with tempfile.TemporaryDirectory() as folder:
            result.agree(name, agreement(finer(name, Path(folder))))
        vehicle = Vehicle.load(name)
        craft = Craft.of(vehicle, lag=lag_of(name))
        starts = starts_of(name, args.flights)
        order, turn = layout(*vehicle.allocation[1:])
        turned = craft.turned(order, turn)
        corners = alone(by_corners(craft), starts)
        result.add("alone", {"vehicle": name, "motors": "corners"}, corners)
        flights = alone(turned, starts, turn)
        result.add("alone", {"vehicle": name, "motors": "turned"}, flights)
        if name not in ("crazyflie2", "paper"):
            continue
        for number, values in VARIED.items():
            for value in values:
                other = turned.varied(number, value)
                keys = {
                    "vehicle": name,
                    "varied": number,
                    "value": value,
                    "thrust_to_weight": round(other.thrust_to_weight, 3),
                    "agility": round(other.agility, 1),
                }
                if other.thrust_to_weight > 1.05:
                    result.add("varied", keys, alone(other, starts, turn))
    fly_cells(result, args.vehicles, AGENTS, args.flights)
    print(page(json.loads(args.out.read_text(encoding="utf-8"))))


if __name__ == "__main__":
    main()

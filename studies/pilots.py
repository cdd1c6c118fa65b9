"""Pilots side by side: flight stacks, our controllers and policies, RAPTOR, on the same flights.

    python studies/pilots.py --betaflight PATH --crazyflie PATH --ardupilot PATH [--vehicle NAME]
        [--seeds 5] [--tasks Waypoints Tracking] [--cases wind ...] [--only NAME ...]
        [--film film.mp4]

Each pilot flies the same starts of each task in calm air, and with each of the events of `CASES`.
Policies are PPO, trained here on the task in calm air. Stacks whose program is not given, and
RAPTOR without its package, are left out and named. Rows that are there already are kept; those of
`--only` are flown anew. The film shows the first flights of Tracking in wind that are flown.
Energy is the electrical one of the vehicle's file, power times thrust^1.5.

Of Tracking, `error` is the root mean square of the distance from where the craft should be, m; of
Waypoints that from the next point when the flight ended, 0 where all were passed, and `seconds` is
the time until then. Intervals are at 95 %: Wilson's of survivals, a bootstrap of the others.
"""

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from contextlib import closing
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from measuring import RESULTS, options, write
from rotorgram.agents import find_controller, load
from rotorgram.agents.policies import Policy
from rotorgram.autopilots import find_stack
from rotorgram.autopilots.seat import Seat, Start, seated
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.spec import EnvSpec
from rotorgram.flights.filming import Film, FilmTrack, film
from rotorgram.flights.trajectories import Flights, Trajectory, fly_episodes
from rotorgram.models import Vehicle
from rotorgram.training.statistics import share_interval

NOISE = 0.05  # m, of a position
WIND = 5.0  # m/s
FORCE = 1.0  # N, for 0.02 s
AT = 1.0  # s
NOISY: Mapping[str, object] = {
    "imu": {"gyro_noise": 0.0, "accelerometer_noise": 0.0},
    "motion_capture": {"noise": NOISE, "angle_noise": 0.0},
    "estimate": True,
    "observe": "estimate",
}
TASKS = ["Waypoints", "Tracking"]
CASES: Mapping[str, list[dict[str, object]]] = {
    "calm": [],
    "wind": [{"kind": "wind", "at": AT, "velocity": [WIND, 0.0, 0.0]}],
    "kick": [{"kind": "kick", "at": AT, "impulse": [0.0, 0.02 * FORCE, 0.0]}],
    "rotor": [{"kind": "rotor", "at": AT, "rotor": 1, "share": 0.8}],
    "noise": [],
}
STACKS = {
    "betaflight": ("betaflight", "angle"),
    "crazyflie-pid": ("crazyflie", "pid"),
    "crazyflie-mellinger": ("crazyflie", "mellinger"),
    "ardupilot": ("ardupilot", "guided"),
}
CONTROLLERS = ("geometric", "raptor")
PILOTS: tuple[str, ...] = (*CONTROLLERS, "ppo", *STACKS)
RESAMPLES = 10_000

Row = dict[str, Any]
MakePilot = Callable[[EnvSpec], Policy]


class Case(NamedTuple):
    """A task, the vehicle, and what happens in flight."""

    task: str
    vehicle: str
    name: str

    def config(self, **settings: object) -> EnvConfig:
        """Of the env, with further settings."""
        events = {"events": CASES[self.name]} if CASES[self.name] else {}
        effects = {"motor_lag": True, "rotor_drag": True}
        fixed = {"vehicle": self.vehicle, "effects": effects, **events}
        return EnvConfig.from_keywords(f"rotorgram/{self.task}-v0", **fixed, **settings)

    @property
    def is_noisy(self) -> bool:
        """Whether positions have noise."""
        return self.name == "noise"


def of_stack(case: Case, name: str, program: Path) -> tuple[EnvConfig, MakePilot]:
    """The env of a stack, and its seat."""
    kind, mode = STACKS[name]
    stack = find_stack(kind)
    config = seated(case.config(), stack.rate)
    if case.is_noisy:
        gps = {"noise": NOISE, "vertical_noise": NOISE, "velocity_noise": NOISE}
        config = config.changed(sensors={**config.sensors, "gps": gps})
    start = Start(config, config.load_vehicle(), mode, program.absolute())
    return config, lambda spec: Seat(spec, start, stack.make)


def of_ours(
    case: Case, settings: Mapping[str, object], make: MakePilot
) -> tuple[EnvConfig, MakePilot]:
    """The env of a controller or a policy, which fly by an estimate where positions have noise."""
    sensors = NOISY if case.is_noisy else {}
    config = case.config(**settings, sensors=sensors)
    usual = case.config()
    if config.control_period != usual.control_period:
        seconds = usual.episode_length * usual.control_period
        config = config.changed(episode_length=round(seconds / config.control_period))
    return config, make


def trained(task: str, vehicle: str, folder: Path) -> MakePilot:
    """PPO, trained with the tuned preset of the task."""
    words = (
        "ppo",
        "--preset",
        "tuned",
        "--env",
        f"rotorgram/{task}-v0",
        "--vehicle",
        vehicle,
        "--no-udp",
    )
    words = (*words, "--effects", "motor_lag", "rotor_drag", "--out", str(folder))
    command = [sys.executable, "-m", "rotorgram.cli", "train", *words]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return load(folder / "checkpoint.safetensors").policy


def flown(config: EnvConfig, make: MakePilot, seeds: int) -> Flights:
    """Evaluation episodes."""
    with closing(LocalVectorEnv(config, 1, autoreset_mode="Disabled")) as env:
        pilot = make(env.env_spec)
        return [fly_episodes(env, pilot, 1, "final", seed)[0] for seed in range(seeds)]


def measured(flight: Trajectory, vehicle: Vehicle) -> Row:
    """Of one flight."""
    row = flight.telemetry
    period = flight.spec.control_period
    away = np.linalg.norm(row["goal"] - row["position"], axis=1)
    power = vehicle.coefficients["rotors.power"] or np.nan
    watts = power * (np.maximum(row["thrust"], 0.0) ** 1.5).sum(axis=1)
    is_course = flight.spec.headline is not None and flight.spec.headline.final
    passed = is_course and flight.headline[-1] == 0.0
    error = 0.0 if passed else away[-1] if is_course else np.sqrt((away**2).mean())
    survived = flight.ending == "truncated" or passed
    return {
        "survived": bool(survived),
        "passed": bool(passed),
        "error": round(float(error), 4),
        "seconds": round(len(flight) * period, 3),
        "watts": round(float(watts.mean()), 3),
    }


def means(rows: list[Row]) -> Row:
    """Of flights, with intervals."""
    rng = np.random.default_rng(0)
    survived = sum(row["survived"] for row in rows)
    found: Row = {
        "flights": len(rows),
        "survived": survived,
        "survived_interval": [round(x, 3) for x in share_interval(survived, len(rows))],
        "passed": sum(row["passed"] for row in rows),
    }
    for name in ("error", "seconds", "watts"):
        values = np.array([row[name] for row in rows])
        resampled = rng.choice(values, (RESAMPLES, len(values))).mean(axis=1)
        found[name] = round(float(values.mean()), 4)
        found[f"{name}_interval"] = np.percentile(resampled, [2.5, 97.5]).round(4).tolist()
    return found


class Pilots:
    """The pilots that can fly here, by name."""

    def __init__(self, programs: Mapping[str, Path | None], vehicle: str, folder: Path) -> None:
        self._programs = programs
        self._vehicle = vehicle
        self._folder = folder
        self._policies: dict[str, MakePilot] = {}

    @property
    def missing(self) -> list[str]:
        """Names of those that cannot."""
        stacks = [name for name, (kind, _) in STACKS.items() if self._programs[kind] is None]
        return stacks + ["raptor"] * (find_spec("foundation_policy") is None)

    def of(self, name: str, case: Case) -> tuple[EnvConfig, MakePilot]:
        """The env that a pilot flies in, and the pilot."""
        if name in STACKS:
            program = self._programs[STACKS[name][0]]
            if program is None:
                raise ValueError(f"{name}: expected a program")
            return of_stack(case, name, program)
        if name in CONTROLLERS:
            kind = find_controller(name)
            return of_ours(case, kind.options, kind)
        if case.task not in self._policies:
            self._policies[case.task] = trained(case.task, self._vehicle, self._folder / case.task)
        return of_ours(case, {}, self._policies[case.task])


def shown(result: Mapping[str, Row], vehicle: str, tasks: list[str]) -> None:
    """The figure: a bar for each pilot and case, with its interval; crosses where one was lost."""
    import matplotlib.pyplot as plt
    from matplotlib.patches import Patch

    figure, axes = plt.subplots(len(tasks), 1, figsize=(9, 3.2 * len(tasks) + 0.6), squeeze=False)
    for axis, task in zip(axes[:, 0], tasks, strict=True):
        what = "seconds" if task == "Waypoints" else "error"
        for place, pilot in enumerate(PILOTS):
            for number, case in enumerate(CASES):
                row = result.get(f"{task} {case} {pilot}")
                if row is None:
                    continue
                x = number + (place - (len(PILOTS) - 1) / 2) / (len(PILOTS) + 1)
                whole = row["survived"] == row["flights"]
                height = (
                    row[what]
                    if whole and (task != "Waypoints" or row["passed"] == row["flights"])
                    else np.nan
                )
                low, high = row[f"{what}_interval"]
                if np.isnan(height):
                    axis.plot(x, 0.0, "x", color=f"C{place}", clip_on=False)
                    continue
                axis.bar(x, height, 1 / (len(PILOTS) + 1), color=f"C{place}")
                axis.vlines(x, low, high, color="0.3", linewidth=1)
        axis.set_ylim(bottom=0.0)
        axis.set_xticks(range(len(CASES)), list(CASES))
        axis.set_ylabel("time to the last point, s" if what == "seconds" else "rms error, m")
        axis.set_title(f"{task}-v0 on {vehicle}; ×: a flight crashed, or points were left")
    handles = [Patch(color=f"C{place}") for place in range(len(PILOTS))]
    figure.legend(handles, PILOTS, loc="lower center", ncols=4, frameon=False)
    figure.tight_layout(rect=(0, 0.08, 1, 1))
    figure.savefig("docs/images/pilots.svg", metadata={"Date": None})


def main() -> None:
    parser = options(
        __doc__, betaflight=Path, crazyflie=Path, ardupilot=Path, vehicle="crazyflie2", seeds=5,
        tasks=TASKS, cases=list(CASES), only=["all"], film=Path,
        out=RESULTS / "pilots.json",
    )  # fmt: skip
    args = parser.parse_args()
    unknown = {*args.tasks, *args.cases}.difference(TASKS, CASES)
    if unknown:
        parser.error(f"expected tasks of {TASKS} and cases of {list(CASES)}, got {sorted(unknown)}")
    vehicle = Vehicle.load(args.vehicle)
    programs = {name: getattr(args, name) for name in ("betaflight", "crazyflie", "ardupilot")}
    kept: dict[str, Row] = {}
    if args.out.exists():
        kept = json.loads(args.out.read_text(encoding="utf-8"))["rows"]
    tracks = []
    with tempfile.TemporaryDirectory() as folder:
        pilots = Pilots(programs, args.vehicle, Path(folder))
        print("not here:", ", ".join(pilots.missing) or "none")
        for task, name, pilot in product(args.tasks, args.cases, PILOTS):
            case = Case(task, args.vehicle, name)
            key = f"{task} {name} {pilot}"
            wanted = pilot in args.only or (args.only == ["all"] and key not in kept)
            if pilot in pilots.missing or not wanted:
                continue
            flights = flown(*pilots.of(pilot, case), args.seeds)
            rows = [measured(one, vehicle) for one in flights]
            kept[key] = means(rows) | {"each": rows}
            print(key, {one: kept[key][one] for one in ("survived", "passed", "error", "seconds")})
            write(args.out, {"vehicle": args.vehicle, "rows": kept})
            if args.film and task == "Tracking" and name == "wind":
                tracks.append(FilmTrack(name=pilot, trajectories=flights[:1]))
    shown(kept, vehicle.name, args.tasks)
    if tracks:
        film(args.film, tracks, Film(width=1280, height=720, vehicle=args.vehicle))


if __name__ == "__main__":
    main()

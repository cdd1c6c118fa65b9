"""Betaflight in lock-step: errors, a roll step, repeated hashes, speed, and policies of ours.

    python studies/betaflight.py --program PATH [--only SECTION] [--out FILE]

writes `docs/results/betaflight.json`, which `docs/autopilots.md` shows, in some minutes. The
program is Betaflight's SITL. A section that is measured anew replaces the old one in the file.
"""

import json
import math
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from measuring import RESULTS, options, write
from numpy.typing import NDArray
from rotorgram.agents import load
from rotorgram.agents.policies import Observation
from rotorgram.autopilots import find_stack
from rotorgram.autopilots.seat import Seat, Start, seated
from rotorgram.autopilots.sticks import Pilot
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec
from rotorgram.envs.vector import LocalVectorEnv
from rotorgram.flights.trajectories import Trajectory, fly_episodes
from rotorgram.models import BACKENDS
from rotorgram.models.library import vehicle_names
from rotorgram.training.metrics import steady_state

VEHICLE: Final = "hummingbird"
EFFECTS: Final = {"motor_lag": True}
WIND: Final = math.sqrt(1.0 / 0.005)
"""Wind that pushes the vehicle with 1 N: its drag is 0.005 N s²/m², m/s."""
SEEDS: Final = range(5)
EPISODES: Final = 4
STEP: Final = 200.0
"""Roll rate, °/s, asked for from `BEGINS` to `ENDS`, s."""
BEGINS, ENDS = 0.05, 0.40
Numbers = dict[str, float]


def config_of(env: str, vehicle: str = VEHICLE, **settings: object) -> EnvConfig:
    """The env of a flight."""
    return EnvConfig.from_keywords(f"rotorgram/{env}-v0", vehicle=vehicle, **settings)


def flown(
    program: Path, config: EnvConfig, mode: str, episodes: int = 1, pilot: Pilot | None = None
) -> list[Trajectory]:
    """Flights of Betaflight. Raises an error if a step was not in lock-step."""
    stack = find_stack("betaflight")
    seated_config = seated(config, stack.rate)
    start = Start(seated_config, config.load_vehicle(), mode, program, policy=pilot)
    with closing(LocalVectorEnv(seated_config, 1, autoreset_mode="Disabled")) as env:
        seat = Seat(env.env_spec, start, stack.make)
        flights = fly_episodes(env, seat, episodes, "final")
    if seat.tally.late or seat.tally.faults:
        raise RuntimeError(f"not in lock-step: {seat.tally}")
    return flights


def error(flight: Trajectory) -> float:
    """Mean distance from the goal in the last second, cm."""
    away = flight.telemetry["goal"] - flight.telemetry["position"]
    last = round(1.0 / flight.spec.control_period)
    return round(100.0 * float(np.linalg.norm(away[-last:], axis=1).mean()), 2)


def waypoints(program: Path) -> dict[str, object]:
    """Error at a waypoint, calm, and in a wind of 1 N with the noise of the vehicle's IMU."""
    windy = {"body_drag": True, "wind": (WIND, 0.0, 0.0)}
    noisy = config_of("Hover", effects={**EFFECTS, **windy}, sensors={"imu": True})
    calm = config_of("Hover", effects=EFFECTS)
    found: dict[str, object] = {}
    for mode in ("angle", "acro"):
        found[mode] = {
            "calm, cm": error(flown(program, calm, mode)[0]),
            "1 N of wind and noise, cm": error(flown(program, noisy, mode)[0]),
        }
    return found


class RollStep:
    """Asks for a roll rate, a share of the largest, for a while."""

    def __init__(self, share: float, period: float) -> None:
        self._share = share
        self._period = period
        self._steps = 0

    def reset(self) -> None:
        """Begin anew."""
        self._steps = 0

    def act(self, observation: Observation) -> NDArray[np.float32]:
        """Action of the level `rates`."""
        now = self._steps * self._period
        self._steps += 1
        asked = self._share if BEGINS <= now < ENDS else 0.0
        return np.array((0.0, asked, 0.0, 0.0), np.float32)


def roll_step(program: Path) -> Numbers:
    """Rate after a step, from 0.2 s on, and the time from 10 to 90 % of it."""
    period = 0.01
    rates = config_of("Hover", action="rates", control_period=period, episode_length=60,
                      effects=EFFECTS, start_tilt=0.0)  # fmt: skip
    spec = env_spec(rates)
    share = math.radians(STEP) / float(spec.action_scale[1])
    pilot = Pilot(RollStep(share, period), spec, matches=False)
    flight = flown(program, rates, "acro", pilot=pilot)[0]
    first, last = (round(t / flight.spec.control_period) for t in (BEGINS, ENDS))
    rate = np.degrees(flight.telemetry["body_rates"][first:last, 0])
    rise = np.argmax(rate > 0.9 * STEP) - np.argmax(rate > 0.1 * STEP)
    held = rate[200:]
    return {
        "mean, °/s": round(float(held.mean()), 1),
        "deviation, °/s": round(float(held.std()), 1),
        "10 to 90 %, ms": round(1000.0 * int(rise) * flight.spec.control_period),
        "overshoot, %": round(100.0 * (float(rate.max()) / STEP - 1.0), 1),
    }


def vehicles(program: Path) -> dict[str, object]:
    """Time of four points, and the error of a hover, of each vehicle of the library."""
    found: dict[str, object] = {}
    for name in vehicle_names():
        modes: dict[str, object] = {}
        has_lag = config_of("Hover", name).load_vehicle().coefficients["rotors.time_constant"]
        effects = EFFECTS if has_lag else {}
        for mode in ("angle", "acro"):
            course = flown(program, config_of("Waypoints", name, effects=effects), mode)[0]
            left, seconds = course.telemetry["metrics"][-1].tolist()
            hover = error(flown(program, config_of("Hover", name, effects=effects), mode)[0])
            modes[mode] = {"points left": left, "course, s": round(seconds, 2), "hover, cm": hover}
        found[name] = modes
        print(name, modes, flush=True)
    return found


def trained(level: str, seed: int, folder: Path) -> Path:
    """The checkpoint of a training."""
    out = folder / f"{level}-{seed}"
    if not out.exists():
        words = ("train", "ppo", "--preset", "tuned", "--env", "rotorgram/Hover-v0", "--vehicle",
                 VEHICLE, "--action", level, "--effects", "motor_lag", "--seed", str(seed),
                 "--out", str(out))  # fmt: skip
        command = [sys.executable, "-m", "rotorgram", *words]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return out / "checkpoint.safetensors"


def measured(flights: list[Trajectory]) -> dict[str, float | None]:
    """Mean error and share of crashes."""
    held = [steady_state(np.abs(one.headline[1:])) for one in flights if not one.terminated]
    mean = round(100.0 * float(np.mean(held)), 1) if held else None
    return {"error, cm": mean, "crashes": (len(flights) - len(held)) / len(flights)}


def policies(program: Path, folder: Path) -> dict[str, object]:
    """Policies of five trainings on our loops, flown on our loops and on Betaflight's."""
    found: dict[str, object] = {}
    for level, mode in (("rates", "acro"), ("attitude", "angle")):
        rows: dict[str, object] = {}
        for seed in SEEDS:
            checkpoint = load(trained(level, seed, folder))
            assert checkpoint.env is not None
            policy = checkpoint.policy()
            config = checkpoint.env
            with closing(LocalVectorEnv(config, 1, autoreset_mode="Disabled")) as env:
                ours = measured(fly_episodes(env, policy, EPISODES, "final"))
            row = {"ours": ours}
            for name, matches in (("Betaflight's, as fast", True), ("Betaflight's own", False)):
                pilot = Pilot(policy, checkpoint.spec, matches)
                row[name] = measured(flown(program, config, mode, EPISODES, pilot))
            rows[str(seed)] = row
            print(level, seed, rows[str(seed)], flush=True)
        found[level] = rows
    return found


def repeated(program: Path) -> dict[str, object]:
    """Hash of a flight in three fresh processes, and the speed of four flights on each backend.

    The speed is the time of the program's clock, from its start to the end of the flight, over the
    time that passed.
    """
    words = ("fly", "betaflight", "--program", str(program), "--vehicle", VEHICLE, "--env",
             "rotorgram/Waypoints-v0", "--effects", "motor_lag")  # fmt: skip
    hashes = []
    for _ in range(3):
        done = subprocess.run([sys.executable, "-m", "rotorgram", *words],
                              capture_output=True, text=True, check=True)  # fmt: skip
        (found,) = re.findall(r"^hash\s+(\w+)", done.stdout, re.MULTILINE)
        hashes.append(found)
    speeds = {}
    for backend in BACKENDS:
        config = config_of("Waypoints", effects=EFFECTS, backend=backend)
        flown(program, config, "angle")  # compiles, and configures the program
        began = time.perf_counter()
        flights = flown(program, config, "angle", 4)
        wall = time.perf_counter() - began
        speeds[backend] = round(sum(one.seconds + 8.5 for one in flights) / wall, 1)
    return {"hashes": hashes, "equal": len(set(hashes)) == 1, "times real time": speeds}


def main() -> None:
    args = options(
        __doc__, "program", program=Path, only="", out=RESULTS / "betaflight.json"
    ).parse_args()
    result = json.loads(args.out.read_text()) if args.out.exists() else {}
    program = args.program.absolute()
    with tempfile.TemporaryDirectory() as folder:
        sections: dict[str, Callable[[], object]] = {
            "waypoints": partial(waypoints, program),
            "roll_step": partial(roll_step, program),
            "repeated": partial(repeated, program),
            "vehicles": partial(vehicles, program),
            "policies": partial(policies, program, Path(folder)),
        }
        for name in [args.only] if args.only else sections:
            result[name] = sections[name]()
            print(name, json.dumps(result[name], ensure_ascii=False), flush=True)
            write(args.out, result)


if __name__ == "__main__":
    main()

"""How well ArduCopter flies our vehicles: waypoints, hover, wind, the same bits, speed.

`python studies/ardupilot.py --program PATH` writes `docs/results/ardupilot.json`, which
`docs/autopilots.md` shows. The program is its SITL. Each waypoint counts as reached within the
radius that stands with it. `times real time` counts the flight alone, and all of the program's
clock from its start on. It takes four minutes on two idle cores.
"""

import subprocess
import sys
import time
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from measuring import RESULTS, options, write
from rotorgram.agents.policies import Observation
from rotorgram.autopilots import find_stack
from rotorgram.autopilots.ardupilot import ArduPilot
from rotorgram.autopilots.reading import Floats, Order, Reading
from rotorgram.autopilots.seat import MakeStack, Seat, Stack, Start, seated
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.vector import LocalVectorEnv
from rotorgram.flights.trajectories import Trajectory, fly_episodes

WIND: Final = {"wind": (5.0, 0.0, 0.0), "gusts": 5.0}
DRAG: Final = {
    "skydio_x2": {},
    "paper": {},
    "hummingbird": {"body_drag": True, "rotor_drag": True},
    "crazyflie2": {"body_drag": True, "motor_lag": True},
    "crazyflie_brushless": {"body_drag": True, "motor_lag": True},
    "heavy_hexa": {"body_drag": True, "motor_lag": True},
}
"""Effects in wind; those without have no drag in their file."""
CALM_RADIUS, WIND_RADIUS = 0.1, 0.3  # m
LAST: Final = 3.0  # s of a hover that count
REPEATS: Final = 3


@dataclass
class Clock:
    """Of the steps of one program."""

    made: float
    first: float = 0.0
    """Wall time of the first step of the flight, s."""
    last: float = 0.0
    steps: int = 0
    flown: int = 0

    def speeds(self, rate: float) -> dict[str, float]:
        """Times real time."""
        return {
            "flight": round(self.flown / rate / (self.last - self.first), 1),
            "with the start": round(self.steps / rate / (self.last - self.made), 1),
        }


class Timed:
    """A stack with a clock."""

    def __init__(self, stack: Stack, clock: Clock) -> None:
        self._stack = stack
        self._clock = clock

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stack, name)

    def step(self, reading: Reading, order: Order | None, observation: Observation) -> Floats:
        clock = self._clock
        if order is not None and not order.stands and not clock.first:
            clock.first = time.perf_counter()
        throttles = self._stack.step(reading, order, observation)
        clock.last = time.perf_counter()
        clock.steps += 1
        clock.flown += clock.first > 0.0
        return throttles


def fly(program: Path, env: str, vehicle: str, **keywords: object) -> tuple[Trajectory, Clock]:
    rate = find_stack("ardupilot").rate
    config = seated(EnvConfig.from_keywords(env, vehicle=vehicle, **keywords), rate)
    start = Start(config, config.load_vehicle(), "guided", program)
    clock = Clock(time.perf_counter())
    make: MakeStack = lambda start: Timed(ArduPilot(start), clock)  # noqa: E731
    with closing(LocalVectorEnv(config, 1, autoreset_mode="Disabled")) as opened:
        seat = Seat(opened.env_spec, start, make)
        (flight,) = fly_episodes(opened, seat, 1, "final")
        seat.close()
    if seat.tally.late or seat.tally.faults:
        raise SystemExit(f"{vehicle}: expected a flight in lock-step, got {seat.tally}")
    return flight, clock


def figures(program: Path, vehicle: str, radius: float, effects: dict[str, object]) -> object:
    """Of four waypoints and of a hover."""
    rate = find_stack("ardupilot").rate
    long = {"effects": effects, "episode_length": 1500}
    flight, clock = fly(program, "rotorgram/Waypoints-v0", vehicle, radius=radius, **long)
    left, seconds = flight.telemetry["metrics"][-1].tolist()
    hover, _ = fly(program, "rotorgram/Hover-v0", vehicle, effects=effects, episode_length=500)
    off = np.linalg.norm(hover.pose[:, :3] - hover.telemetry["goal"], axis=1)
    last = off[hover.times > hover.seconds - LAST]
    return {
        "radius, m": radius,
        "waypoints reached": 4 - int(left),
        "on the stand, s": round((clock.steps - clock.flown) / rate, 2),
        "time, s": round(seconds, 2),
        "hover, mean, m": round(float(last.mean()), 3),
        "hover, largest, m": round(float(last.max()), 3),
        "times real time": clock.speeds(rate),
    }


def digest(program: Path, vehicle: str) -> str:
    """Hash of a flight in a process of its own."""
    words = ["fly", "ardupilot", "--program", program, "--vehicle", vehicle]
    command = [sys.executable, "-m", "rotorgram.cli", *words, "--env", "rotorgram/Waypoints-v0"]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return said.split("hash")[1].strip()


def main(program: Path, vehicles: list[str], output: Path) -> None:
    program = program.absolute()
    found = {}
    for vehicle in vehicles:
        row = {"calm": figures(program, vehicle, CALM_RADIUS, {})}
        if DRAG[vehicle]:
            effects = {**DRAG[vehicle], **WIND}
            row["wind of 5 m/s with gusts"] = figures(program, vehicle, WIND_RADIUS, effects)
        row["hashes"] = [digest(program, vehicle) for _ in range(REPEATS)]
        found[vehicle] = row
        print(vehicle, row, flush=True)
    write(output, {"command": "python studies/ardupilot.py --program PATH", "vehicles": found})


if __name__ == "__main__":
    parser = options(
        __doc__, "program", program=Path, vehicles=list(DRAG), output=RESULTS / "ardupilot.json"
    )
    main(**vars(parser.parse_args()))

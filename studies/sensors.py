"""Allan deviation of the simulated gyroscope, and what each sensor costs.

    python studies/sensors.py [--out FOLDER]

writes `allan.csv`, `allan.png` and `cost.json`, which `docs/sensors.md` shows, in some minutes.
Gyroscope: 32 drones at rest for 1,000 s, read at 50 Hz, the three axes of
all together. Cost: processor time of a control step of 0.02 s, the least of several rounds.
"""

import json
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import numpy as np
import rotorgram.envs  # noqa: F401
from matplotlib.figure import Figure
from measuring import RESULTS, in_turns, options, write_rows
from rotorgram.models import Vehicle
from rotorgram.sim import InitialState, make_world
from rotorgram.sim.sensors import Sensors, checked_sensors

IRIS: Final = {
    "gyro_noise": 1.8665e-4, "gyro_walk": 3.8785e-5, "gyro_bias": 0.0087,
    "accelerometer_noise": 1.86e-3, "accelerometer_walk": 6e-3, "accelerometer_bias": 0.196,
}  # fmt: skip
"""PX4's model of the Iris quadcopter for Gazebo Classic (iris.sdf)."""

COSTS: Final = {
    "none": {},
    "imu": {"imu": IRIS},
    "magnetometer": {"magnetometer": {"noise": 0.3}},
    "barometer": {"barometer": {"noise": 0.78}},
    "rangefinder": {"rangefinder": {"noise": 0.02, "limit": 10.0}},
    "gps, 10 Hz, 0.1 s late": {
        "gps": {"noise": 1.0, "vertical_noise": 2.0, "velocity_noise": 0.1}
        | {"rate": 10, "delay": 0.1}
    },
    "motion_capture": {"motion_capture": {"noise": 1e-3, "angle_noise": 1e-3}},
    "imu, barometer, estimate": {
        "imu": IRIS, "barometer": {"noise": 0.78}, "estimate": True, "observe": "estimate"
    },
}  # fmt: skip
DRONES: Final = (1, 1024)
_PERIOD = 0.02
_SAMPLES = 50_000
_WORLDS = 32
_ROUNDS: Final = 7
_ENV: Final = "rotorgram/Hover-v0"


def gyroscope() -> np.ndarray:
    """Readings at rest, less the bias that each drone has when it is switched on, (samples, n)."""
    world = make_world(Vehicle.load(), _WORLDS, num_threads=1)
    every = np.ones((_WORLDS, 1), bool)
    sensors = Sensors(checked_sensors({"imu": IRIS | {"gyro_bias": 0.0}}), world, _PERIOD)
    world.random.seed(every, range(_WORLDS))
    world.reset(every, InitialState(position=np.tile((0.0, 0.0, 5.0), (_WORLDS, 1, 1))))
    sensors.begin(every)
    readings = np.empty((_SAMPLES, _WORLDS * 3))
    for step, row in enumerate(readings, 1):
        row[:] = sensors.readings["imu"][..., :3].ravel()
        sensors.sample(every, step)
    return readings


@dataclass(frozen=True)
class Deviation:
    """Overlapping Allan deviation at an averaging time, beside its closed form."""

    tau_s: float
    simulated_rad_s: float
    closed_form_rad_s: float
    ratio: float


def allan(rates: np.ndarray) -> list[Deviation]:
    """Deviations at averaging times that double, for rates of shape (samples, n)."""
    angle = np.concatenate((np.zeros((1, rates.shape[1])), rates.cumsum(axis=0)))
    rows = []
    for power in range(int(math.log2(_SAMPLES / 4)) + 1):
        m = 2**power
        second = (angle[2 * m :] - 2 * angle[m:-m] + angle[: -2 * m]) / m
        found = math.sqrt(0.5 * float(np.mean(second**2)))
        expected = math.hypot(*lines(m * _PERIOD))
        rows.append(Deviation(m * _PERIOD, found, expected, found / expected))
    return rows


def lines(time: float) -> tuple[float, float]:
    """Allan deviation of the white noise and of the bias's walk over a time, rad/s."""
    return IRIS["gyro_noise"] / math.sqrt(time), IRIS["gyro_walk"] * math.sqrt(time / 3)


def draw(rows: list[Deviation], path: Path) -> None:
    """The figure."""
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.subplots()
    times = np.array([row.tau_s for row in rows])
    white, walk = np.array([lines(time) for time in times]).T
    axes.loglog(times, white, "--", color="#56B4E9", label="white noise, N / √τ")
    axes.loglog(times, walk, "--", color="#E69F00", label="walk of the bias, K √(τ / 3)")
    axes.loglog(times, np.hypot(white, walk), color="#555555", label="both")
    axes.loglog(
        times, [row.simulated_rad_s for row in rows], "o", color="#D55E00", label="simulated"
    )
    axes.set_ylim(0.5 * np.hypot(white, walk).min(), 2 * white.max())
    axes.set(xlabel="averaging time τ, s", ylabel="Allan deviation, rad/s")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=110)


def costs() -> dict[str, dict[str, float]]:
    """Processor time of a control step of all drones, µs, by drones and by sensor."""
    return {str(drones): _costs(drones) for drones in DRONES}


def _costs(drones: int) -> dict[str, float]:
    envs = {name: _env(drones, sensors) for name, sensors in COSTS.items()}
    steps = 1000 if drones == 1 else 20
    times = in_turns(envs, _ROUNDS, lambda env: _time(env, steps))
    return {name: round(min(seconds) * 1e6, 1) for name, seconds in times.items()}


def _env(drones: int, sensors: dict[str, Any]) -> Any:
    options = {"sensors": sensors, "episode_length": 1 << 30, "flight_band": 1e4}
    options |= {"start_tilt": 0.0, "start_heading": 0.0}
    if drones == 1:
        env = gym.make(_ENV, disable_env_checker=True, **options).unwrapped
    else:
        env = gym.make_vec(_ENV, num_envs=drones, num_threads=1, **options)
    env.reset(seed=0)
    return env


def _time(env: Any, steps: int) -> float:
    still = np.zeros(env.action_space.shape, np.float32)
    begun = time.process_time()
    for _ in range(steps):
        env.step(still)
    return (time.process_time() - begun) / steps


def main() -> None:
    folder = options(__doc__, out=RESULTS / "sensors").parse_args().out
    rows = allan(gyroscope())
    write_rows(folder / "allan.csv", rows)
    draw(rows, folder / "allan.png")
    (folder / "cost.json").write_text(json.dumps(costs(), indent=1) + "\n")


if __name__ == "__main__":
    main()

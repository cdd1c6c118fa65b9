"""Envs of every task at every level, on every backend and with every feature, and a flight of them.

`python tests/contracts.py` writes `data/oracle.json` anew, after a change of numbers that is meant.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import rotorgram.envs  # noqa: F401
from numpy.typing import NDArray
from rotorgram.envs import Loop, registry
from rotorgram.envs.config import EnvConfig
from rotorgram.models import QUAD_XML, Vehicle

DATA = Path(__file__).parent / "data"
ORACLE = DATA / "oracle.json"
TABLES: dict[str, Any] = json.loads((DATA / "envs.json").read_text())
"""Rows of the parametrized tests of envs/, by the tests' names."""
TASKS = sorted(name for name in gym.registry if name.startswith("rotorgram/"))
HOVER = "rotorgram/Hover-v0"
ELEVATION = "rotorgram/Elevation-v0"
FORMATION = "rotorgram/Formation-v0"
FILES = {"quad": QUAD_XML}
FILES |= {path.stem: path for path in sorted(DATA.glob("*.xml"))}
FILES |= {path.parent.name: path for path in sorted(QUAD_XML.parent.glob("*/*/vehicle.toml"))}
STORM = {"wind": (4.0, -3.0, 6.0), "gusts": 8.0}
WORLDS = 3
STEPS = 24
LENGTH = 9
"""Control steps of an episode."""


@dataclass(frozen=True)
class Case:
    """An env: a task and keywords of its config."""

    env_id: str
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def drones(self) -> int:
        """Of one world."""
        task = registry.task_type(self.env_id)
        usual = max(2, task.min_drones) if task.max_drones > 1 else 1
        return int(self.options.get("drones", usual))

    def config(self, **more: Any) -> EnvConfig:
        """Of short episodes."""
        options = {"episode_length": LENGTH, "drones": self.drones, **self.options, **more}
        return EnvConfig.from_keywords(self.env_id, **options)


RICH: dict[str, Any] = {
    "vehicle": "crazyflie2",
    "effects": {
        "motor_lag": True,
        "battery": True,
        "body_drag": True,
        "rotor_drag": True,
        "ground_effect": True,
        **STORM,
    },
    "sensors": {
        "imu": True,
        "motion_capture": {"noise": 0.001, "angle_noise": 0.01, "delay": 0.04},
    },
    "history": 3,
    "randomize": {
        "mass": "uniform(0.9, 1.1)",
        "action_delay": "choice(0, 1, 2)",
        "observation_delay": "choice(0, 1, 2)",
    },
}
ESTIMATE = {"imu": True, "estimate": True, "observe": "estimate"}
DRAWN = {
    "inertia": "uniform(0.8, 1.2)", "center_x": "uniform(-0.001, 0.001)",
    "thrust_1": "uniform(0.9, 1.0)", "time_constant": "uniform(0.8, 1.2)",
    "wind_x": "uniform(-1, 1)", "body_drag": "uniform(0.5, 1.5)",
}  # fmt: skip
SENSORS = {
    "imu": {"gyro_noise": 1e-3, "accelerometer_noise": 0.01, "gyro_bias": 0.01},
    "barometer": {"noise": 1.0, "walk": 0.1}, "magnetometer": {"noise": 0.3},
    "gps": {
        "rate": 10.0, "delay": 0.04, "dropout": 0.2, "noise": 0.5, "vertical_noise": 1.0,
        "velocity_noise": 0.1,
    },
    "motion_capture": {"noise": 0.001, "angle_noise": 0.01},
    "rangefinder": {"noise": 0.01, "limit": 4.0}, "estimate": True,
}  # fmt: skip
SWARM: dict[str, Any] = {"vehicle": "crazyflie2", "randomize": DRAWN}
SWARM["effects"] = {**RICH["effects"], "downwash": True}
RACER: dict[str, Any] = {"vehicle": DATA / "racer.xml", "randomize": DRAWN, "sensors": SENSORS}
RACER["effects"] = {**RICH["effects"], "thrust_curve": True, "efficiency": (1.0, 0.9, 1.0, 0.95)}
WEAK = {"battery": True, "thrust_curve": True, "payload": 0.05, "cable": 0.4}
CHARGED = {"battery_charge": "uniform(0, 1)", "thrust": "0.9", "payload": "uniform(0.5, 1.5)"}
LOSSY = {"drones": 3, "radio_loss": 0.3, "radio_delay": 2, "radio_range": 30.0, "neighbours": 2}
FEATURES = {
    "rich": Case(HOVER, RICH),
    "rich, rigid": Case(HOVER, {**RICH, "backend": "rigid"}),
    "all": Case(HOVER, RACER),
    "all, NumPy": Case(HOVER, {**RACER, "backend": "rigid", "compiled": False, "dtype": "float64"}),
    "all, attitude": Case(HOVER, {**RACER, "action": "attitude"}),
    "no lag": Case(HOVER, {**RACER, "effects": WEAK, "randomize": CHARGED}),
    "swarm": Case(FORMATION, SWARM),
    "swarm, rigid": Case(FORMATION, {**SWARM, "backend": "rigid"}),
    "estimate": Case(HOVER, {"vehicle": "crazyflie2", "sensors": ESTIMATE}),
    "discrete": Case(ELEVATION, {"action_type": "discrete", "observation": "error", "history": 4}),
    "late": Case(HOVER, {"randomize": {"observation_delay": "uniform(0, 0.07)"}, "history": 2}),
    "lossy radio": Case(FORMATION, LOSSY),
    "lossy radio, rigid": Case(FORMATION, {**LOSSY, "backend": "rigid"}),
    "line": Case("rotorgram/Landing-v0", {"motion": "line"}),
    "snap": Case("rotorgram/Tracking-v0", {"trajectory": "snap"}),
    "pictures": Case(HOVER, {"cameras": "front@16x16,front_depth@24x18,down_segmentation@16x12"}),
    "two laps": Case("rotorgram/Racing-v0", {"track": "dive", "laps": 2}),
}


def short(env_id: str) -> str:
    """Name of a task, without namespace and version."""
    return env_id.removeprefix("rotorgram/").removesuffix("-v0")


def _levels() -> dict[str, Case]:
    """Each task at each of its levels; on `rigid` two levels of all tasks, and all of Hover."""
    cases = {}
    for env_id in TASKS:
        task = registry.task_type(env_id)
        name = short(env_id)
        for level in task.actions:
            cases[f"{name}, {level}"] = Case(env_id, {"action": level})
            on_rigid = env_id == HOVER or level in (*task.actions[:1], task.action)
            if on_rigid and name not in ("Cable", "PayloadHover"):
                options = {"action": level, "backend": "rigid"}
                cases[f"{name}, {level}, rigid"] = Case(env_id, options)
    return cases


def effects_of(file: Path) -> dict[str, Any]:
    """All effects that a vehicle has coefficients for; in a storm, if it feels air."""
    vehicle = Vehicle.load(file)
    rotors = vehicle.coefficients.rotors
    drag = vehicle.coefficients.drag
    battery = vehicle.coefficients.battery
    known = {
        "motor_lag": rotors.time_constant,
        "thrust_curve": rotors.curve,
        "battery": battery.full and battery.capacity and rotors.power,
        "body_drag": drag.linear or drag.quadratic,
        "rotor_drag": rotors.thrust_coefficient and (rotors.drag or rotors.inflow or rotors.lift),
        "ground_effect": rotors.radius,
    }
    effects: dict[str, Any] = {name: True for name, value in known.items() if value}
    if effects.keys() & {"body_drag", "rotor_drag"}:
        effects |= STORM
    share = (0.9, *(1.0 for _ in vehicle.rotors[1:]))
    return {**effects, "efficiency": share, "payload": 0.1 * vehicle.mass, "cable": 0.5}


def stormy(env_id: str, file: Path) -> Case:
    """A vehicle with all its effects and a mass that is drawn."""
    effects = effects_of(file)
    if "Payload" in env_id:  # it hangs one itself
        del effects["payload"], effects["cable"]
    drawn = {"mass": "uniform(0.9, 1.1)"}
    return Case(env_id, {"vehicle": file, "effects": effects, "randomize": drawn})


def _vehicles() -> dict[str, Case]:
    """Each task with a third of the vehicles, each vehicle with a third of the tasks."""
    alone = [env_id for env_id in TASKS if registry.task_type(env_id).min_drones == 1]
    cases = {}
    for row, env_id in enumerate(alone):
        for column, (name, file) in enumerate(FILES.items()):
            if (row + column) % 3 == 0:
                case = stormy(env_id, file)
                cases[f"{short(env_id)}, {name}"] = Case(env_id, {**case.options, "drones": 1})
    return cases


LEVELS = _levels()
VEHICLES = _vehicles()
CASES = LEVELS | FEATURES | VEHICLES


def actions_of(loop: Loop, seed: int = 7) -> Iterator[NDArray[np.float32]]:
    """Random actions, shape (N, k), sometimes at their bounds."""
    dice = np.random.default_rng(seed)
    controller = loop.task.controller
    shape = (loop.num_envs, len(controller.low))
    while True:
        if controller.choices:
            yield dice.integers(0, controller.choices, shape).astype(np.float32)
        else:
            yield (0.5 * dice.normal(size=shape)).clip(-1, 1).astype(np.float32)


def bits(values: Any) -> Any:
    """Values in which each bit counts."""
    if isinstance(values, dict):
        return {name: bits(value) for name, value in values.items()}
    if isinstance(values, tuple):
        return [bits(value) for value in values]
    array = np.asarray(values)
    return array.dtype.str, array.shape, array.tobytes()


def results(loop: Loop, rows: Any = ...) -> dict[str, Any]:
    """What a step gave to some drones."""
    flags = {name: getattr(loop, name) for name in ("rewards", "terminated", "truncated", "out")}
    groups = (flags, loop.observations, loop.telemetry, loop.metrics, loop.reward_terms)
    return {f"{i} {name}": x[rows] for i, group in enumerate(groups) for name, x in group.items()}


def measured(case: Case) -> dict[str, float]:
    """A few numbers of a flight: sums of observations and rewards."""
    loop = Loop(case.config(cameras=()), WORLDS)  # no driver's pictures
    rows = loop.num_envs
    actions = actions_of(loop)
    loop.advance(next(actions), np.ones(rows, bool), range(rows))
    seen = total = 0.0
    for _ in range(12):
        loop.advance(next(actions), loop.done if loop.done.any() else None)
        seen += sum(float(np.abs(array).sum()) for array in loop.observations.values())
        total += float(loop.rewards.sum())
    loop.close()
    return {"observations": float(f"{seen:.4g}"), "rewards": float(f"{total:.4g}")}


if __name__ == "__main__":
    numbers = {name: measured(case) for name, case in CASES.items()}
    rows = [f"{json.dumps(name)}: {json.dumps(row)}" for name, row in numbers.items()]
    ORACLE.write_text("{\n" + ",\n".join(rows) + "\n}\n")

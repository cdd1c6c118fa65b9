"""A batch flies as its drones alone: some reset, some held, some ended, with every feature on."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rotorgram.envs import LocalVectorEnv
from rotorgram.sim import LEVELS

N = 4
STEPS = 30
LENGTH = 11
EFFECTS = {
    "motor_lag": True, "thrust_curve": True, "battery": True, "body_drag": True,
    "rotor_drag": True, "ground_effect": True, "wind": (2.0, -1.0, 0.5), "gusts": 3.0,
    "efficiency": (1.0, 0.9, 1.0, 0.95),
}  # fmt: skip
DRAWN = {
    "mass": "uniform(0.8, 1.2)", "thrust_1": "uniform(0.9, 1.0)",
    "action_delay": "uniform(0, 3)", "observation_delay": "uniform(0, 3)",
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
RACER = {"vehicle": Path(__file__).parents[1] / "data" / "racer.xml"}
FEATURES: dict[str, dict[str, Any]] = {
    "plain": {},
    "all": {
        **RACER, "effects": EFFECTS, "sensors": SENSORS, "randomize": DRAWN, "history": 2,
    },
    "estimate": {**RACER, "sensors": {**SENSORS, "observe": "estimate"}, "action": "attitude"},
    **{level: {"action": level, **RACER} for level in LEVELS},
}  # fmt: skip
TASKS = ("Hover", "Landing", "Racing", "Recovery")
BACKENDS: dict[str, dict[str, Any]] = {
    "mujoco": {"backend": "mujoco"},
    "rigid": {"backend": "rigid"},
    "rigid, NumPy": {"backend": "rigid", "compiled": False, "dtype": "float64"},
}
ARRAYS = ("rewards", "terminated", "truncated", "done", "out")


def seen(env: LocalVectorEnv) -> dict[str, np.ndarray]:
    """Copies of all results of a step."""
    observations = env.observations
    if not isinstance(observations, dict):
        observations = {"observation": observations}
    results = dict(observations) | {name: getattr(env, name) for name in ARRAYS}
    return {name: np.array(values) for name, values in (results | env.telemetry).items()}


CASES = [
    (task, backend, name) for task in TASKS for backend in BACKENDS for name in ("plain", "all")
]
CASES += [("Hover", "mujoco", name) for name in ("estimate", *LEVELS)]
CASES += [("PayloadHover", "mujoco", name) for name in ("plain", "all")]


@pytest.mark.parametrize(("task", "backend", "feature"), CASES)
def test_a_batch_equals_its_drones_alone(task: str, backend: str, feature: str) -> None:
    options = {
        "autoreset_mode": "Disabled",
        "episode_length": LENGTH,
        **BACKENDS[backend],
        **FEATURES[feature],
    }
    batch = LocalVectorEnv(f"rotorgram/{task}-v0", N, **options)
    singles = [LocalVectorEnv(f"rotorgram/{task}-v0", 1, **options) for _ in range(N)]
    dice = np.random.default_rng(2)
    resets = np.ones(N, bool)
    frozen = np.zeros(N, bool)
    ends = 0
    for step in range(STEPS):
        actions = dice.uniform(-0.6, 0.6, batch.action_space.shape).astype(np.float32)
        seeds = dice.integers(0, 1000, N).tolist() if step % 2 == 0 else None
        batch.advance(actions, resets, seeds, frozen)
        together = seen(batch)
        for i, single in enumerate(singles):
            one = slice(i, i + 1)
            own = None if seeds is None else seeds[one]
            single.advance(actions[one], resets[one], own, frozen[one])
            for name, values in seen(single).items():
                assert together[name][one].tobytes() == values.tobytes(), (step, i, name)
        ends += int(batch.done.sum())
        resets = batch.done | (dice.random(N) < 0.1)
        frozen = ~resets & (dice.random(N) < 0.1)
    assert ends >= 3
    for env in (batch, *singles):
        env.close()

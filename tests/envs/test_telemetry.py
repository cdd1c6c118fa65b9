"""Telemetry: what there is where a feature is on, and a number that is added in one place."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from contracts import rows_of, spec_with
from remotes import flying
from rotorgram.cli import main
from rotorgram.envs import telemetry
from rotorgram.envs.telemetry import Quantity
from rotorgram.envs.vector import LocalVectorEnv

HOVER = "rotorgram/Hover-v0"
USUAL = ["position", "attitude", "velocity", "body_rates", "thrust"]
BREEZE: dict[str, Any] = {"body_drag": True, "wind": (1.0, -2.0, 0.5)}


@rows_of("what is off has no telemetry", "options, more")
def test_what_is_off_has_no_telemetry(options: dict[str, Any], more: list[str]) -> None:
    spec = spec_with(HOVER, vehicle="crazyflie2", **options)
    names = [array.name for array in spec.telemetry]
    assert names == [*USUAL, *more, "goal", "metrics"]


def test_numbers_are_those_of_the_world() -> None:
    """Fault 63: velocity, rates, battery and wind, with z up."""
    effects = BREEZE | {"battery": True, "motor_lag": True}
    env = LocalVectorEnv(HOVER, 3, vehicle="crazyflie2", effects=effects)
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.tile(np.float32([0.1, 0.0, 0.0, 0.0]), (3, 1)))
    state = env.loop.world.state
    told = env.telemetry
    assert told["position"].tolist() == state.position[:, 0].tolist()
    assert told["attitude"].tolist() == state.quaternion[:, 0].tolist()
    assert told["velocity"].tolist() == state.velocity[:, 0].tolist()
    assert told["body_rates"].tolist() == state.body_rates[:, 0].tolist()
    assert told["wind"].tolist() == [[1.0, -2.0, 0.5]] * 3
    charge, voltage = told["battery"].T
    assert ((charge > 0.99) & (charge < 1.0)).all()
    assert ((voltage > 3.0) & (voltage < 4.2)).all()
    kept = told["position"].copy()
    told["position"][:] = 0.0  # a copy of the user's own
    assert state.position[:, 0].tolist() == kept.tolist()


def test_gusts_change_the_wind_and_a_snapshot_brings_it_back() -> None:
    env = gym.make(HOVER, vehicle="crazyflie2", effects={"body_drag": True, "gusts": 5.0})
    own: Any = env.unwrapped
    env.reset(seed=0)
    winds = []
    for step in range(4):
        if step == 2:
            kept = own.snapshot()
        *_, info = env.step(np.zeros(4, np.float32))
        winds.append([info[f"wind_{axis}"] for axis in "xyz"])
    assert len({tuple(wind) for wind in winds}) == 4
    own.restore(kept)
    for wind in winds[2:]:
        *_, info = env.step(np.zeros(4, np.float32))
        assert [info[f"wind_{axis}"] for axis in "xyz"] == wind


def test_a_number_is_added_in_one_place(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One record: spec, `info`, wire, journal, log and plot have it."""
    speed = Quantity(
        name="speed",
        components=("speed",),
        unit="m/s",
        read=lambda loop: np.linalg.norm(loop.record.state.velocity, axis=-1, keepdims=True),
    )
    monkeypatch.setattr(telemetry, "POSE", (*telemetry.POSE, speed))
    monkeypatch.chdir(tmp_path)
    action = np.full(4, 0.1, np.float32)
    env: Any = gym.make(HOVER)
    env.reset(seed=1)
    *_, here = env.step(action)
    velocity = [here[name] for name in ("vx", "vy", "vz")]
    assert here["speed"] == pytest.approx(np.linalg.norm(velocity))
    assert env.unwrapped.env_spec.telemetry[4].unit == "m/s"
    with flying(HOVER, record=tmp_path / "flight.mcap") as pair:
        pair.remote.reset(seed=1)
        *_, there = pair.remote.step(action)
    assert there["speed"] == here["speed"]
    assert main(["log", "flight.mcap"]) == 0
    head, _, last = Path("flight.csv").read_text().splitlines()
    assert float(last.split(",")[head.split(",").index("speed [m/s]")]) == here["speed"]
    assert main(["plot", "flight.mcap", "--out", "flight.svg"]) == 0
    assert "speed (m/s)" in Path("flight.svg").read_text()

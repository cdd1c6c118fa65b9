"""A crash costs at least what the worst step would cost for ever (fault 40)."""

import tomllib
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from contracts import rows_of
from rotorgram.cli import main
from rotorgram.envs import LocalVectorEnv, registry
from rotorgram.envs.tasks.task import HORIZON

from flights import Shares, state_of, task_of

PRESETS = Path(__file__).parents[2] / "agents" / "presets.toml"
ELEVATION = "rotorgram/Elevation-v0"  # as the paper has it
TASKS = [name for name in gym.registry if name.startswith("rotorgram/") and name != ELEVATION]
TELESCOPING = {"progress", "approach"}  # They add up to a difference, however long it takes.


def test_the_horizon_is_that_of_the_largest_discount() -> None:
    content = tomllib.loads(PRESETS.read_text())
    tables = [*content["preset"], *content["settings"].values()]
    largest = max(table.get("gamma", 0.0) for table in tables)
    assert 1 / (1 - largest) == pytest.approx(HORIZON)


@pytest.mark.parametrize("env_id", TASKS)
def test_a_crash_costs_what_the_worst_step_would_cost_for_ever(env_id: str) -> None:
    task = registry.task_type(env_id)
    drones = task.min_drones
    env = LocalVectorEnv(env_id, 24 * drones, drones=drones, action="rotors")
    env.reset(seed=0)
    dice = np.random.default_rng(0)
    state = env.loop.world.state
    crashes = 0
    for step in range(60):
        if step % 20 == 0:  # some spin and race off
            state.body_rates[::2] = dice.uniform(-60, 60, state.body_rates[::2].shape)
            state.velocity[::3] = dice.uniform(-60, 60, state.velocity[::3].shape)
        env.step(dice.uniform(-1, 1, env.action_space.shape).astype(np.float32))
        terms = env.loop.told()()[1]
        crash = terms.pop("termination")
        lasting = sum(term for name, term in terms.items() if name not in TELESCOPING)
        assert np.min(lasting) >= task.worst_step - 1e-9
        crashed = crash < 0
        crashes += int(crashed.sum())
        assert crash[crashed] == pytest.approx(HORIZON * task.worst_step)
    assert crashes


def test_wide_starts_are_learned(tmp_path: Path) -> None:
    """With a crash that cost 20, PPO learned to crash after 13 steps."""
    words = ["train", "ppo", "--preset", "tuned", "--env", "rotorgram/Hover-v0"]
    wide = ["--env.start-band", "2", "--env.flight-band", "6", "--env-steps", "200000"]
    assert main([*words, *wide, "--out", str(tmp_path / "run")]) == 0
    last = pd.read_csv(tmp_path / "run" / "episodes.csv").tail(100)
    assert last["length"].mean() > 240


@rows_of("contact and a tilt above 90 degrees end a flight", "change, crashed", ids=str)
@pytest.mark.parametrize("name", ["Hover", "Landing", "PayloadHover", "Tracking"])
def test_contact_and_a_tilt_above_90_degrees_end_a_flight(
    name: str, change: dict[str, Any], crashed: bool
) -> None:
    task = task_of(f"rotorgram/{name}-v0")
    loads = {"payload": (0.0, 0.0, 4.0), "payload_velocity": (0.0, 0.0, 0.0)}
    task.begin(Shares(*[0.5] * 7))
    place = task.place(state_of(**loads)) + np.array((0.0, 0.0, 0.5))
    outcome = task.outcome(state_of(**{"position": place, **loads, **change}))
    assert bool(outcome.terminated) == crashed

"""Folders of a comparison, made up: for the tests of figures, report and page."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from rotorgram.envs.spec import ArraySpec, EnvSpec, Metric
from rotorgram.training.metrics import Headline, overshoot, settling_time, steady_state
from rotorgram.training.results import (
    EPISODE_COLUMNS,
    EVALUATION_COLUMNS,
    RUN_COLUMNS,
    step_schema,
)

PERIOD = 0.05
ERROR = Metric(name="elevation_error", unit="m", symbol="E", settled=0.05, held=0.1, signed=True)
GATES = Metric(name="gates_passed", unit="", goal="high", held=3.0)
DELAYS = {"vpg": 0.15, "a2c": 0.3, "sb3-a2c": 0.25}
FLOORS = {"vpg": 0.06, "a2c": 0.02, "sb3-a2c": 0.015, "pid": 0.004}


def spec_of(metric: Metric = ERROR, low: float = -np.inf, length: int = 100) -> EnvSpec:
    """A spec whose headline is the metric, of values from `low` on."""
    metrics = ArraySpec(
        name="metrics", shape=(1,), dtype="float64", low=low, components=(metric.name,)
    )
    return EnvSpec(
        env_id="rotorgram/Elevation-v0",
        options={"target": 10.0, "episode_length": length},
        control_period=PERIOD,
        vehicle="quad",
        observation=(ArraySpec(name="observation", shape=(3,)),),
        action=ArraySpec(name="action", shape=(1,), low=-1.0, high=1.0),
        telemetry=(metrics,),
        metrics=(metric,),
    )


HEADLINE = Headline.of(spec_of())


def flight(skill: float, agent: str, length: int, rng: np.random.Generator) -> np.ndarray:
    """E over an episode of an agent of some skill (0 to 1): damped, or drifting away."""
    time = np.arange(length) * PERIOD
    start = rng.uniform(-4, 4)
    damped = start * np.exp(-time * (0.3 + 1.2 * skill)) * np.cos(time * 1.3)
    lost = (1 - skill) * rng.normal() * 2 * time / time[-1]
    noise = rng.normal(size=length) * FLOORS.get(agent, 0.01) * (1 + 8 * (1 - skill))
    return damped + lost + noise


def synthetic_folder(
    folder: Path,
    agents: Sequence[str] = ("vpg", "a2c", "sb3-a2c", "pid"),
    seeds: int = 3,
    env_steps: int = 2000,
    length: int = 100,
    snapshots: int = 5,
) -> Path:
    """Write results with the shapes of learning: `env_steps` per run, all by chance."""
    rng = np.random.default_rng(1)
    episodes: list[dict[str, Any]] = []
    evaluations: list[dict[str, Any]] = []
    steps: list[dict[str, Any]] = []
    trained = [agent for agent in agents if agent != "pid"]
    for agent in agents:
        for seed in range(seeds):
            rate = rng.uniform(0.8, 1.25)
            if agent in trained:
                _train(agent, seed, rate, env_steps, length, rng, episodes, steps)
            marks = np.linspace(0, env_steps, snapshots) if agent in trained else [0]
            for mark in marks:
                final = mark == marks[-1]
                skill = 1.0 if agent == "pid" else _skill(agent, rate * mark / env_steps)
                _evaluate(agent, seed, int(mark), skill, length, rng, evaluations, steps, final)
    runs = [
        (agent, seed, env_steps, env_steps / 2500, 2500.0 + seed)
        for agent in trained
        for seed in range(seeds)
    ]
    _write(folder, agents, seeds, env_steps, length, episodes, evaluations, steps, runs)
    return folder


def _skill(agent: str, progress: float) -> float:
    return float(1 / (1 + np.exp(-(progress - DELAYS.get(agent, 0.2)) * 25)))


def _train(agent, seed, rate, env_steps, length, rng, episodes, steps):  # type: ignore[no-untyped-def]
    begin = number = 0
    while begin < env_steps:
        skill = _skill(agent, rate * begin / env_steps)
        flown = min(length if rng.random() < 0.3 + skill else length // 3, env_steps - begin)
        errors = flight(skill, agent, max(2, flown), rng)[:flown]
        steps.append(
            {"agent": agent, "seed": seed, "phase": "train", "episode": number}
            | {"step": np.arange(begin, begin + flown) + 1, "elevation_error": errors}
        )
        begin += flown
        if flown < length and begin >= env_steps:
            break  # the end of training cut the episode: it is not recorded
        episodes.append(
            dict.fromkeys(EPISODE_COLUMNS, 0)
            | {"agent": agent, "seed": seed, "episode": number, "first_step": begin - flown}
            | {"last_step": begin}
            | {"length": flown, "return": float(np.sum(1 - np.minimum(np.abs(errors), 3)))}
            | {"elevation_error": float(np.abs(errors).mean()), "truncated": flown == length}
            | {"terminated": flown < length, "seconds": begin / 2500}
        )
        number += 1


def _evaluate(agent, seed, mark, skill, length, rng, evaluations, steps, final):  # type: ignore[no-untyped-def]
    for episode in range(3):
        errors = flight(skill, agent, length, rng)
        evaluations.append(
            {"agent": agent, "seed": seed, "env_steps": mark, "seconds": mark / 2500}
            | {"episode": episode, "length": length, "return": float(np.sum(1 - np.abs(errors)))}
            | {"start": float(errors[0]), "elevation_error": steady_state(np.abs(errors))}
            | {"overshoot": overshoot(errors), "terminated": False}
            | {"settling_time": settling_time(errors, PERIOD, 0.05)}
        )
        if final:
            steps.append(
                {"agent": agent, "seed": seed, "phase": "evaluation", "episode": episode}
                | {"step": np.arange(1, length + 1), "elevation_error": errors}
            )


def _write(folder, agents, seeds, env_steps, length, episodes, evaluations, steps, runs):  # type: ignore[no-untyped-def]
    folder.mkdir(parents=True, exist_ok=True)
    settings = {"learning_rate": 1e-3, "anneal": True, "hidden": [64, 64]}
    config = {
        "created": "2025-01-02T03:04:05+00:00",
        "command": "rotorgram compare --seeds 3 <folder>",
        "preset": "tuned",
        "seeds": list(range(seeds)),
        "env_steps": env_steps,
        "num_envs": 1,
        "spec": json.loads(spec_of(length=length).to_json()),
        "vehicle": None,
        "bounds": {"time-optimal": 95.0},
        "agents": dict.fromkeys(agents, settings),
        "versions": {"rotorgram": "0.1.0", "mujoco": "4.0.0"},
        "machine": {"platform": "Linux", "processor": "some <processor>", "cores": 2},
    }
    (folder / "config.json").write_text(json.dumps(config))
    for name, rows, columns in (
        ("episodes.csv", episodes, EPISODE_COLUMNS),
        ("evaluations.csv", evaluations, EVALUATION_COLUMNS),
    ):
        own = [
            "elevation_error" if column in ("mean_size", "steady") else column for column in columns
        ]
        pd.DataFrame(rows, columns=own).to_csv(folder / name, index=False)
    pd.DataFrame(runs, columns=list(RUN_COLUMNS)).to_csv(folder / "runs.csv", index=False)
    frame = pd.concat([pd.DataFrame(part) for part in steps])
    schema = step_schema("elevation_error")
    table = pa.Table.from_pandas(
        frame.assign(reward=0.0, thrust=49.0)[schema.names], schema, preserve_index=False
    )
    pq.write_table(table, folder / "steps.parquet")

"""Folders of a study, made up: for the tests of figures, tables and page."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rotorgram.envs.spec import ArraySpec, EnvSpec, Metric
from rotorgram.training.metrics import (
    Headline,
    measure_run,
    overshoot,
    settling_time,
    steady_state,
)
from rotorgram.training.results import COLUMNS, join_parts, write_config, write_part
from rotorgram.training.settings import Row, Study

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


def study_of(agents: Sequence[str], seeds: int = 3, **settings: Any) -> Study:
    """The paper's comparison of some agents."""
    rows = tuple(Row(agent=agent, name=agent, env_steps=2000) for agent in agents)
    return Study(**{"rows": rows, "kind": "paper", "seeds": seeds, "keep_steps": True, **settings})


def synthetic_folder(
    folder: Path,
    agents: Sequence[str] = ("vpg", "a2c", "sb3-a2c", "pid"),
    seeds: int = 3,
    env_steps: int = 2000,
    length: int = 100,
    snapshots: int = 5,
    study: Study | None = None,
) -> Path:
    """Write results with the shapes of learning: `env_steps` per run, all by chance."""
    rng = np.random.default_rng(1)
    study = study or study_of(agents, seeds)
    folder.mkdir(parents=True, exist_ok=True)
    specs = dict.fromkeys([row.name for row in study.rows], spec_of(length=length))
    write_config(folder, "rotorgram compare --seeds 3 <folder>", study, specs)
    for row, seed in study.runs().values():
        rate = rng.uniform(0.8, 1.25)
        marks = [0] if row.controller else np.linspace(0, env_steps, snapshots).astype(int)
        evaluations = []
        steps = []
        for mark in marks:
            progress = rate * mark / env_steps
            skill = 1.0 if row.controller else _skill(row.agent, progress)
            _evaluate(row.agent, int(mark), skill, length, rng, evaluations, steps)
        flown = pd.concat(steps[-3:])
        tables = {"evaluations": pd.DataFrame(evaluations), "steps": flown}
        if not row.controller:
            tables["episodes"], trained = _train(row.agent, rate, env_steps, length, rng)
            tables["steps"] = pd.concat([trained, flown])
        named = tables["evaluations"].assign(row=row.name, seed=seed)
        last = int(marks[-1])
        times = {"env_steps": last, "seconds": last / 2500, "steps_per_second": 2500.0 + seed}
        if row.controller:
            times["steps_per_second"] = np.nan
        tables["runs"] = pd.DataFrame([times | measure_run(named, HEADLINE)])
        write_part(folder, row, seed, tables)
    join_parts(folder)
    return folder


def _skill(agent: str, progress: float) -> float:
    return float(1 / (1 + np.exp(-(progress - DELAYS.get(agent, 0.2)) * 25)))


def _steps(phase: str, episode: int, first: int, errors: np.ndarray) -> pd.DataFrame:
    return pd.DataFrame({
        "phase": phase, "episode": episode, "step": np.arange(first, first + len(errors)) + 1,
        "value": errors.astype(np.float32), "reward": np.float32(0), "thrust": np.float32(49),
    })  # fmt: skip


def _train(
    agent: str, rate: float, env_steps: int, length: int, rng: np.random.Generator
) -> tuple[pd.DataFrame, pd.DataFrame]:
    begin = number = 0
    episodes: list[dict[str, Any]] = []
    steps: list[pd.DataFrame] = []
    while begin < env_steps:
        skill = _skill(agent, rate * begin / env_steps)
        flown = min(length if rng.random() < 0.3 + skill else length // 3, env_steps - begin)
        errors = flight(skill, agent, max(2, flown), rng)[:flown]
        steps.append(_steps("train", number, begin, errors))
        begin += flown
        if flown < length and begin >= env_steps:
            break  # the end of training cut the episode: it is not recorded
        episodes.append({
            "episode": number, "first_step": begin - flown, "last_step": begin, "length": flown,
            "return": float(np.sum(1 - np.minimum(np.abs(errors), 3))),
            "mean_size": float(np.abs(errors).mean()), "truncated": flown == length,
            "terminated": flown < length, "seconds": begin / 2500,
        })  # fmt: skip
        number += 1
    return pd.DataFrame(episodes, columns=list(COLUMNS["episodes"][2:])), pd.concat(steps)


def _evaluate(
    agent: str,
    mark: int,
    skill: float,
    length: int,
    rng: np.random.Generator,
    evaluations: list[dict[str, Any]],
    steps: list[pd.DataFrame],
) -> None:
    for episode in range(3):
        errors = flight(skill, agent, length, rng)
        evaluations.append({
            "env_steps": mark, "seconds": mark / 2500, "episode": episode, "length": length,
            "return": float(np.sum(1 - np.abs(errors))), "start": float(errors[0]),
            "steady": steady_state(np.abs(errors)), "overshoot": overshoot(errors),
            "settling_time": settling_time(errors, PERIOD, 0.05), "terminated": False,
        })  # fmt: skip
        steps.append(_steps("evaluation", episode, 0, errors))

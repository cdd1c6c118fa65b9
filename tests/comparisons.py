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
from rotorgram.training.results import write_config, write_run
from rotorgram.training.settings import Row, Study

PERIOD = 0.05
ERROR = Metric(name="elevation_error", unit="m", symbol="E", settled=0.05, held=0.1, signed=True)
GATES = Metric(name="gates_passed", unit="", goal="high", held=3.0)


def spec_of(metric: Metric = ERROR, low: float = -np.inf, length: int = 100) -> EnvSpec:
    """A spec whose headline is the metric, of values from `low` on."""
    metrics = ArraySpec(
        name="metrics", shape=(1,), dtype="float64", low=low, components=(metric.name,)
    )
    observation = ArraySpec(name="observation", shape=(3,))
    action = ArraySpec(name="action", shape=(1,), low=-1.0, high=1.0)
    return EnvSpec(
        env_id="rotorgram/Elevation-v0",
        options={"target": 10.0, "episode_length": length},
        control_period=PERIOD,
        vehicle="quad",
        observation=(observation,),
        action=action,
        telemetry=(metrics,),
        metrics=(metric,),
    )


HEADLINE = Headline.of(spec_of())


def flight(length: int, rng: np.random.Generator) -> np.ndarray:
    """E over an episode: a damped swing from a random start, with noise."""
    time = np.arange(length) * PERIOD
    swing = rng.uniform(-4, 4) * np.exp(-time) * np.cos(1.3 * time)
    return swing + 0.01 * rng.normal(size=length)


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
    study: Study | None = None,
) -> Path:
    """Write results of `env_steps` for each run, made up of random flights."""
    rng = np.random.default_rng(1)
    study = study or study_of(agents, seeds)
    folder.mkdir(parents=True, exist_ok=True)
    specs = dict.fromkeys([row.name for row in study.rows], spec_of(length=length))
    write_config(folder, "rotorgram compare --seeds 3 <folder>", study, specs)
    for row, seed in study.runs().values():
        trained = not row.controller
        marks = [0, env_steps // 2, env_steps] if trained else [0]
        evaluations, steps = _evaluated(marks, length, rng)
        tables = {"evaluations": evaluations, "steps": steps}
        if trained:
            tables["episodes"], flown = _trained(env_steps, length, rng)
            tables["steps"] = pd.concat([flown, steps])
        rate = 2500.0 + seed if trained else np.nan
        times = {"env_steps": marks[-1], "seconds": marks[-1] / 2500, "steps_per_second": rate}
        named = evaluations.assign(row=row.name, seed=seed)
        tables["runs"] = pd.DataFrame([times | measure_run(named, HEADLINE)])
        write_run(folder, row, seed, tables)
    return folder


def _steps(phase: str, episode: int, first: int, errors: np.ndarray) -> pd.DataFrame:
    step = np.arange(first, first + len(errors)) + 1
    value = errors.astype(np.float32)
    return pd.DataFrame({"phase": phase, "episode": episode, "step": step, "value": value})


def _trained(
    env_steps: int, length: int, rng: np.random.Generator
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Training episodes and their steps."""
    episodes = []
    steps = []
    for number, begin in enumerate(range(0, env_steps - length + 1, length)):
        errors = flight(length, rng)
        steps.append(_steps("train", number, begin, errors))
        sizes = np.abs(errors)
        rewards = 1 - np.minimum(sizes, 3)
        episodes.append({
            "episode": number, "first_step": begin, "last_step": begin + length, "length": length,
            "return": float(rewards.sum()), "truncated": True, "mean_size": float(sizes.mean()),
            "terminated": False, "seconds": begin / 2500,
        })  # fmt: skip
    return pd.DataFrame(episodes), pd.concat(steps)


def _evaluated(
    marks: Sequence[int], length: int, rng: np.random.Generator
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Three evaluation episodes of each snapshot, and the steps of the last snapshot's."""
    rows = []
    for mark in marks:
        steps = []
        for episode in range(3):
            errors = flight(length, rng)
            steps.append(_steps("evaluation", episode, 0, errors))
            sizes = np.abs(errors)
            rewards = 1 - sizes
            rows.append({
                "env_steps": mark, "seconds": mark / 2500, "episode": episode, "length": length,
                "return": float(rewards.sum()),
                "steady": steady_state(sizes), "overshoot": overshoot(errors),
                "settling_time": settling_time(errors, PERIOD, 0.05), "terminated": False,
            })  # fmt: skip
    return pd.DataFrame(rows), pd.concat(steps)

"""Writing the records of a comparison: see `records` for the files and their columns."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from ..agents.episodes import Episode, EpisodeLog
from .evaluate import Flight
from .records import (
    EPISODE_COLUMNS,
    EPISODES_FILE,
    EVALUATION_COLUMNS,
    EVALUATIONS_FILE,
    RUN_COLUMNS,
    RUNS_FILE,
    STEP_SCHEMA,
    STEPS_FILE,
)

__all__ = ["RecordWriter", "RunRecord", "episode_row", "flight_steps", "training_steps"]


@dataclass(frozen=True, kw_only=True)
class RunRecord:
    """What one run leaves behind."""

    agent: str
    seed: int

    episodes: list[dict[str, Any]]
    """Rows of `episodes.csv`, without agent and seed."""
    evaluations: list[dict[str, Any]]
    """Rows of `evaluations.csv`, without agent and seed."""
    run: dict[str, Any] | None
    """Row of `runs.csv`, without agent and seed; None if nothing was trained."""
    steps: list[pa.Table]
    """Tables of `steps.parquet`."""
    model_hash: str


class RecordWriter:
    """Collects what runs leave behind; the step rows go to disk as they come."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._steps = pq.ParquetWriter(folder / STEPS_FILE, STEP_SCHEMA, compression="zstd")
        self._records: list[RunRecord] = []
        self.model_hash = ""

    def add(self, record: RunRecord) -> None:
        """Take a run."""
        for table in record.steps:
            self._steps.write_table(table)
        record.steps.clear()
        self._records.append(record)
        self.model_hash = record.model_hash

    def finish(self) -> None:
        """Write the tables, sorted, whatever the order in which the runs ended."""
        self._steps.close()
        records = sorted(self._records, key=lambda r: (r.agent, r.seed))
        rows: dict[str, list[dict[str, Any]]] = {
            EPISODES_FILE: [],
            EVALUATIONS_FILE: [],
            RUNS_FILE: [],
        }
        for record in records:
            label = {"agent": record.agent, "seed": record.seed}
            rows[EPISODES_FILE] += [{**label, **row} for row in record.episodes]
            rows[EVALUATIONS_FILE] += [{**label, **row} for row in record.evaluations]
            if record.run:
                rows[RUNS_FILE].append({**label, **record.run})
        columns = {
            EPISODES_FILE: EPISODE_COLUMNS,
            EVALUATIONS_FILE: EVALUATION_COLUMNS,
            RUNS_FILE: RUN_COLUMNS,
        }
        for name, content in rows.items():
            frame = pd.DataFrame(content, columns=list(columns[name]))
            frame.to_csv(self._folder / name, index=False)


def episode_row(episode: Episode) -> dict[str, Any]:
    """An episode as a row of `episodes.csv`, without agent and seed."""
    return {"return" if k == "total_reward" else k: v for k, v in asdict(episode).items()}


def training_steps(agent: str, log: EpisodeLog) -> pa.Table:
    """Every env step of a training."""
    lengths = [episode.length for episode in log.episodes]
    rest = log.env_steps - sum(lengths)
    return _steps(
        agent,
        log.run_seed,
        "train",
        episodes=np.repeat(np.arange(len(lengths) + 1), [*lengths, rest]),
        errors=np.asarray(log.errors),
        rewards=np.asarray(log.rewards),
        thrusts=np.asarray(log.thrusts),
    )


def flight_steps(agent: str, seed: int, flights: list[Flight]) -> list[pa.Table]:
    """Every env step of evaluation flights."""
    return [
        _steps(
            agent,
            seed,
            "evaluation",
            episodes=np.full(len(flight.errors), episode),
            errors=flight.errors,
            rewards=flight.rewards,
            thrusts=flight.thrusts,
        )
        for episode, flight in enumerate(flights)
    ]


def _steps(
    agent: str,
    seed: int,
    phase: str,
    *,
    episodes: np.ndarray,
    errors: np.ndarray,
    rewards: np.ndarray,
    thrusts: np.ndarray,
) -> pa.Table:
    count = len(episodes)
    columns = {
        "agent": [agent] * count,
        "seed": np.full(count, seed),
        "phase": [phase] * count,
        "episode": episodes,
        "step": np.arange(1, count + 1),
        "error": errors,
        "reward": rewards.astype(np.float32),
        "thrust": thrusts,
    }
    arrays = [pa.array(columns[f.name]).cast(f.type) for f in STEP_SCHEMA]
    return pa.Table.from_arrays(arrays, schema=STEP_SCHEMA)

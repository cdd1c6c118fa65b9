"""Writing the records of a comparison: see `records` for the files and their columns."""

import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

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

__all__ = ["RunRecord", "episode_row", "flight_steps", "join_parts", "training_steps"]

_TABLES: Final = {
    EPISODES_FILE: EPISODE_COLUMNS,
    EVALUATIONS_FILE: EVALUATION_COLUMNS,
    RUNS_FILE: RUN_COLUMNS,
}


@dataclass(frozen=True, kw_only=True)
class RunRecord:
    """What one run leaves behind."""

    agent: str
    seed: int
    episodes: list[dict[str, Any]]
    """Rows of `episodes.csv`, without agent and seed."""
    evaluations: list[dict[str, Any]]
    """Rows of `evaluations.csv`, without agent and seed."""
    runs: list[dict[str, Any]]
    """Its row of `runs.csv`, without agent and seed; none if nothing was trained."""
    steps: list[pa.Table]
    """Tables of `steps.parquet`."""

    def write(self, parts: Path) -> None:
        """Write a part: a folder that is there whole or not at all."""
        part = parts / f"{self.agent}-seed{self.seed}"
        unfinished = part.with_name(f".{part.name}")
        unfinished.mkdir(parents=True)
        label = {"agent": self.agent, "seed": self.seed}
        for name, columns in _TABLES.items():
            rows = [{**label, **row} for row in getattr(self, name.removesuffix(".csv"))]
            table = pd.DataFrame(rows, columns=list(columns))
            table.to_csv(unfinished / name, index=False)
        pq.write_table(pa.concat_tables(self.steps), unfinished / STEPS_FILE, compression="zstd")
        unfinished.rename(part)


def join_parts(parts: Path, folder: Path) -> None:
    """Make the tables of a comparison out of the parts of its runs, and remove these."""
    names = sorted(p.name for p in parts.iterdir() if not p.name.startswith("."))
    for table in _TABLES:
        lines = [(parts / name / table).read_text().splitlines(keepends=True) for name in names]
        body = [line for part in lines for line in part[1:]]
        (folder / table).write_text("".join([lines[0][0], *body]))
    with pq.ParquetWriter(folder / STEPS_FILE, STEP_SCHEMA, compression="zstd") as writer:
        for name in names:
            writer.write_table(pq.read_table(parts / name / STEPS_FILE, schema=STEP_SCHEMA))
    # Whole or not at all: a half-removed part would look like one to go on with.
    shutil.rmtree(parts.rename(parts.with_name(f".{parts.name}")))


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

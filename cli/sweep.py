"""`rotorgram sweep`, and `rotorgram report` of a sweep."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd
from rich import box
from rich.console import Console
from rich.table import Table

from ..experiments.errors import RunsFailed
from ..experiments.sweep import (
    SWEEP_FILE,
    SweepConfig,
    missing_runs,
    read_sweep_config,
    read_sweep_runs,
    write_sweep_table,
)
from ..experiments.sweep import sweep as run_sweep
from .inputs import new_folder, parse_changes, refuse_settings
from .workers import WORKERS, command_line, showing, workers

if TYPE_CHECKING:
    from .training import Sweep

__all__ = ["parse_grid", "report", "sweep"]


def sweep(command: "Sweep") -> int:
    """Train, evaluate and print the table."""
    if command.resume:
        folder = command.resume
        config = _resumed(command, folder)
    else:
        config = SweepConfig(
            algorithm=command.algorithm,
            grid=parse_grid(word for words in command.grid for word in words),
            preset=command.preset,
            seeds=command.seeds,
            env_steps=command.env_steps,
            num_envs=command.num_envs,
            episodes=command.episodes,
            env=command.env.checked(),
            **workers(command),
        )
        folder = new_folder(command.out, f"sweep-{config.algorithm}")
    try:
        with showing(f"sweep {config.algorithm}", command, folder) as progress:
            run_sweep(config, folder, command_line(), progress)
    except RunsFailed:  # which a point may well do for good: the others are to be seen
        report(folder)
        raise
    report(folder)
    return 0


def _resumed(command: "Sweep", folder: Path) -> SweepConfig:
    config = replace(read_sweep_config(folder), **workers(command))
    if config.algorithm != command.algorithm:
        raise ValueError(
            f"resume: expected a sweep of {command.algorithm}, "
            f"{folder} holds one of {config.algorithm}"
        )
    refuse_settings(command, folder, free=("algorithm", "resume", *WORKERS))
    if not missing_runs(config, read_sweep_runs(folder, config)):
        raise ValueError(
            f"resume: expected an interrupted sweep, {folder} is finished; "
            f"show it with: rotorgram report {folder}"
        )
    return config


def parse_grid(words: Iterable[str]) -> dict[str, tuple[Any, ...]]:
    """Values by the name of their hyperparameter. Raises `ValueError`."""
    grid: dict[str, tuple[Any, ...]] = {}
    for word in words:
        name, equals, values = word.partition("=")
        if not equals:
            raise ValueError(f"grid: expected NAME=VALUE,VALUE,…, got {word!r}")
        if name in grid:
            raise ValueError(f"grid: expected each name once, got {name} twice")
        grid[name] = tuple(parse_changes((f"{name}={v}",))[name] for v in values.split(","))
    return grid


def report(folder: Path) -> None:
    """Write `sweep.csv` from the folder's files, and print it."""
    config = read_sweep_config(folder)
    results = write_sweep_table(config, folder)
    Console(width=100).print(_table(results, config))
    print(f"{results['seeds'].sum()} of {len(config.runs())} runs done")
    band = f"{config.env.flight_band:g} m"
    print(
        f"ranked by the worst seed: steady |E| + share of crashed episodes × flight band ({band})"
    )
    print(f"table: {folder / SWEEP_FILE}")


def _table(results: pd.DataFrame, config: SweepConfig) -> Table:
    table = Table(box=box.SIMPLE_HEAD)
    for name in config.grid:
        table.add_column(name.replace("_", "\n"), overflow="fold")
    for heading in (
        "Steady |E|,\nworst (m)", "median\n(m)", "Return,\nmedian", "Settled", "Crashed",
        "Seeds", "Training\n(s)", "Env\nsteps/s",
    ):  # fmt: skip
        table.add_column(heading, justify="right")
    for row in results.to_dict("records"):
        table.add_row(
            *(str(row[name]) for name in config.grid),
            f"{row['worst_error']:.3g}",
            f"{row['median_error']:.3g}",
            f"{row['return']:.0f}",
            f"{row['settled']} of {row['episodes']}",
            str(row["crashed"]),
            str(row["seeds"]),
            f"{row['seconds']:.1f}",
            f"{row['steps_per_second']:,.0f}",
        )
    return table

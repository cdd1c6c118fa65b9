"""`rotorgram sweep`: train an algorithm over a grid of hyperparameters."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, UseAppendAction, arg

from ..agents import AlgorithmName
from ..flights.executors import WorkersConfig
from ..models.errors import expect
from ..training.settings import SweepConfig
from ._flags import parse_value, refuse_settings
from ._runs import RESUMED, RunsFlags, command_line, report_sweep, runs_folder


@dataclass(frozen=True, kw_only=True)
class Sweep(RunsFlags):
    """Train an algorithm over a grid of hyperparameters, every point on the same seeds.

    Every run has a simulator process and a socket pair of its own. Ctrl-C keeps the runs that are
    done; --resume flies the others.
    """

    algorithm: Positional[AlgorithmName]
    grid: UseAppendAction[
        Annotated[tuple[tuple[str, ...], ...], arg(metavar="NAME=VALUE,... ...")]
    ] = ()
    """Values to try, such as learning_rate=0.003,0.01 steps_per_update=64,256: every combination
    is a point."""
    seeds: int = 3
    """Number of seeds, the same for every point; 30 or more before one is called the best."""
    first_seed: int = 1000
    """The first of them: by default none that a comparison uses."""

    def run(self) -> int:
        """Sweep, and print the table."""
        from ..flights.executors import RunsFailed
        from ..training.sweep import sweep

        if self.resume:
            config = self._resumed(self.resume)
        else:
            grid = parse_grid(word for words in self.grid for word in words)
            config = SweepConfig(**self.settings(SweepConfig) | {"grid": grid})
        name = f"sweep {config.algorithm}"
        try:
            with runs_folder(name, self) as (folder, progress):
                sweep(config, folder, command_line(), progress)
        except RunsFailed:  # the other points are reported all the same
            report_sweep(folder)
            raise
        report_sweep(folder)
        return 0

    def _resumed(self, folder: Path) -> SweepConfig:
        from ..training.sweep import missing_runs, read_sweep_config, read_sweep_runs

        config = replace(read_sweep_config(folder), **self.settings(WorkersConfig))
        others = f"a sweep of {self.algorithm}, {folder} holds one of {config.algorithm}"
        expect(config.algorithm == self.algorithm, "resume", others)
        refuse_settings(self, folder, free=RESUMED)
        advice = f"show it with: rotorgram report {folder}"
        wanted = f"an interrupted sweep, {folder} is finished; {advice}"
        expect(missing_runs(config, read_sweep_runs(folder, config)), "resume", wanted)
        return config


def parse_grid(words: Iterable[str]) -> dict[str, tuple[Any, ...]]:
    """Values by the name of their hyperparameter. Raises `InputError`."""
    grid: dict[str, tuple[Any, ...]] = {}
    for word in words:
        name, equals, values = word.partition("=")
        expect(equals, "grid", "NAME=VALUE,VALUE,…", repr(word))
        expect(name not in grid, "grid", "each name once", f"{name} twice")
        grid[name] = tuple(map(parse_value, values.split(",")))
    return grid

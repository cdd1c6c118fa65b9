"""`rotorgram benchmark`: train and evaluate the rows of the baselines board, and write its page."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from ..flights.executors import WorkersConfig
from ..models.errors import expect
from ._flags import refuse_settings
from ._runs import RESUMED, FolderFlags, command_line, report_board, runs_folder


@dataclass(frozen=True, kw_only=True)
class Benchmark(FolderFlags, WorkersConfig):
    """Train and evaluate agents on tasks with vehicles over the same seeds, and write the page.

    Every run has a simulator process and a socket pair of its own. Ctrl-C keeps the runs that are
    done; --resume flies the others.
    """

    rows: Positional[Annotated[Path | None, arg(metavar="FILE")]] = None
    """TOML file of rows. Default: those of docs/baselines.md."""
    seeds: int | None = None
    """Number of seeds, the same for every row. Default: the file's, or 10."""
    first_seed: int | None = None
    """The first of them. Default: the file's, or 5000, which no other command uses."""
    env_steps: int | None = None
    """Env steps of every training, for a short look. Default: each row's own."""
    page: Path | None = None
    """Markdown page to write. Default: baselines.md in the folder."""

    def run(self) -> int:
        """Train, evaluate, write the page."""
        from ..flights.executors import RunsFailed
        from ..training.benchmark import (
            BOARD,
            benchmark,
            missing_seeds,
            read_board,
            read_rows_file,
        )

        if self.resume:
            refuse_settings(self, self.resume, free=("page", *RESUMED))
            board = read_board(self.resume)
            advice = f"write its page with: rotorgram report {self.resume}"
            wanted = f"an interrupted board, {self.resume} is finished; {advice}"
            expect(missing_seeds(board.config, board.seeds), "resume", wanted)
            config = replace(board.config, **self.settings(WorkersConfig))
        else:
            changes = {name: getattr(self, name) for name in ("seeds", "first_seed")}
            given = {name: value for name, value in changes.items() if value is not None}
            config = read_rows_file(self.rows or BOARD, **given, **self.settings(WorkersConfig))
            if self.env_steps is not None:
                rows = (replace(row, env_steps=self.env_steps) for row in config.rows)
                config = replace(config, rows=tuple(rows))
        with runs_folder("benchmark", self) as (folder, progress):
            try:
                benchmark(config, folder, command_line(), progress)
            except RunsFailed:  # the other rows are reported all the same
                report_board(folder, self.page)
                raise
        report_board(folder, self.page)
        return 0

"""`rotorgram benchmark`: train and evaluate the rows of the baselines board."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from ..training.settings import BOARD, Study
from ._flags import BackendOfPreset
from ._study import StudyFlags


class Benchmark(StudyFlags):
    """Train and evaluate agents on tasks with vehicles over the same seeds, and report them.

    Ctrl-C keeps the runs that are done; --resume flies the others.
    """

    kinds = ("benchmark",)

    rows: Positional[Annotated[Path | None, arg(metavar="FILE")]] = None
    """TOML file of rows. Default: those of docs/baselines.md."""
    backend: BackendOfPreset = None
    """What steps the drones in training: mujoco, or rigid (without contact, fast)."""

    def study(self) -> Study:
        """The rows of the file, by default on seeds that no other command uses."""
        study = Study.from_toml(
            self.rows or BOARD, {"seeds": 10, "first_seed": 5000, "snapshots": 20}
        )
        settings = {"kind": "benchmark", **self.given_of_study()}
        rows = tuple(map(self.changed, study.rows))
        return replace(study, rows=rows, **settings)

"""What `compare`, `sweep` and `benchmark` share: flags, resuming, the report."""

import logging
import shlex
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from ..agents import is_controller
from ..envs.config import EnvConfig
from ..flights.executors import RunsFailed, WorkersConfig
from ..models.errors import InputError, NoOpenGL, require
from ..training.settings import Row, Study
from ._flags import Options, Words
from ._training import TrainingFlags, folder_to_write

if TYPE_CHECKING:
    from ..training.results import Results

_RESUMED = ("jobs", "runner", "address", "film")
"""Flags that a resumed command may be given: they change no number."""
_OF_ROWS = ("preset", "env_steps", "num_envs", "backend")
_OF_STUDIES = ("seeds", "first_seed", "snapshots", "episodes")


class StudyFlags(TrainingFlags, WorkersConfig):
    """A command that trains and evaluates many runs, and reports them."""

    kinds: ClassVar[Words] = ()
    """Kinds of the studies that the command writes."""

    seeds: int | None = None
    """Number of seeds, the same for all."""
    first_seed: int | None = None
    """The first of them."""
    snapshots: int | None = None
    """Policies kept during each training, for the learning curves."""
    episodes: int | None = None
    """Evaluation episodes of each final policy. Default: 200 over all seeds, 20 at least."""
    film: bool = True
    """Whether the agents are filmed side by side for the report, where there is OpenGL."""

    @property
    def words(self) -> str:
        """The command without flags."""
        return type(self).__name__.lower()

    def study(self) -> Study:
        """The study that the flags describe. Raises `InputError`."""
        raise NotImplementedError

    def run(self) -> None:
        """Fly the study, or what is missing of one; report."""
        require("matplotlib", "report", "a report")  # before hours of training
        workers = WorkersConfig(**self.settings(WorkersConfig))
        if self.resume:
            self._fly(self._resumed(self.resume), self.resume, workers)
            return
        study = self.study()
        with folder_to_write(self.out, self.words.replace(" ", "-")) as folder:
            self._fly(study, folder, workers)

    def _fly(self, study: Study, folder: Path, workers: WorkersConfig) -> None:
        from ..training.study import run_study
        from ._progress import bars

        command = shlex.join(["rotorgram", *sys.argv[1:]])
        try:
            with bars() as progress:
                run_study(study, folder, workers, command, progress)
        except BaseException as error:
            if any(folder.iterdir()) and not isinstance(error, InputError):
                print(self.go_on_with(self.words, folder, "runner", "address"))
            if isinstance(error, RunsFailed):  # the others are reported all the same
                report(folder, film=False)
            raise
        report(folder, self.film)

    def _resumed(self, folder: Path) -> Study:
        from ..training.results import Results

        results = Results.read(folder)
        if results.study.kind not in self.kinds:
            raise InputError(
                f"resume: expected a folder of rotorgram {self.words}, {folder} holds a "
                f"{results.study.kind}"
            )
        self.refuse_settings(folder, _RESUMED)
        return results.study

    # ---- parts of a study

    def given_of_study(self) -> Options:
        """Settings of the study that were given."""
        values = self._given(_OF_STUDIES)
        if "seeds" in values:
            values.setdefault("episodes", 0)  # as many as the seeds need
        return values

    def _given(self, names: Words) -> Options:
        return {name: getattr(self, name) for name in names if name in self.given}

    def new_row(self, agent: str, name: str, changes: Options, env: EnvConfig) -> Row:
        """A row of an agent, with the settings that were given."""

        if is_controller(agent):
            return Row(agent=agent, name=name, env=env)
        backend = env.backend.name
        settings: Options = {"env_steps": 200_000, "num_envs": env.drones, "backend": backend}
        settings |= self._given(_OF_ROWS)
        return Row(agent=agent, name=name, env=env, set=changes, **settings)

    def changed(self, row: Row) -> Row:
        """A row of a file with what the flags change: of all rows."""

        changes = {**row.set, **self.changes()}
        env = row.env
        if "env" in self.given and self.env_id != env.env_id:
            env = EnvConfig.from_keywords(self.env_id, vehicle=env.vehicle, drones=env.drones)
        env = env.changed(**self._given(("vehicle", "drones")), **self.options)
        name = "" if row.name == row.default_name else row.name
        if row.controller:
            return replace(row, name=name, env=env)
        return replace(row, name=name, env=env, set=changes, **self._given(_OF_ROWS))


def report(folder: Path, film: bool) -> None:
    """Write figures, film and report from the folder's files, and print the tables."""
    from rich.console import Console
    from rich.markdown import Markdown

    from ..training.report import PAGE_FILE, VIDEO_FILE, write_report
    from ..training.results import Results
    from ..training.tables import markdown

    results = Results.read(folder)
    video = folder / VIDEO_FILE
    table = write_report(results)
    Console(width=100).print(Markdown(markdown(results, table)))
    # Only now: if the film fails, there is a report.
    if film and results.study.kind in ("paper", "compare") and not video.exists():
        _film(results, video)
        if video.exists():
            write_report(results)
    print(f"{len(results.runs)} of {len(results.study.runs())} runs done")
    print(f"report: {folder / PAGE_FILE}")


def _film(results: "Results", out: Path) -> None:
    """Film a study; where that cannot be, such as without OpenGL, the log says why."""
    try:
        from ..training.films import film_study
        from ._progress import bars

        with bars() as progress:
            film_study(results, out, partial(progress, out.name))
    except (OSError, InputError, ImportError, NoOpenGL) as error:
        logging.getLogger(__name__).info("no film of the agents: %s", error)

"""What `compare`, `sweep` and `benchmark` share: flags, resuming, the report."""

import logging
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final

from tyro.conf import UseAppendAction, arg

from ..agents.presets import PresetName
from ..flights.executors import RunsFailed, WorkersConfig
from ..flights.folders import FolderBusy
from ..models.errors import InputError
from ._flags import BackendFlags, folder_to_write, go_on_with, named_value, refuse_settings

if TYPE_CHECKING:
    from ..envs.config import EnvConfig
    from ..training.results import Results
    from ..training.settings import Row, Study

_RESUMED: Final = ("jobs", "runner", "address", "resume", "film", "page")
"""Flags that a resumed command may be given: they change no number."""
_OF_ROWS: Final = ("preset", "env_steps", "num_envs", "backend")
_OF_STUDIES: Final = ("seeds", "first_seed", "snapshots", "episodes")


@dataclass(frozen=True, kw_only=True)
class StudyFlags(BackendFlags, WorkersConfig):
    """A command that trains and evaluates many runs, and reports them."""

    kinds: ClassVar[tuple[str, ...]] = ()
    """Kinds of the studies that the command writes."""

    set: UseAppendAction[Annotated[tuple[tuple[str, ...], ...], arg(metavar="NAME=VALUE …")]] = ()
    """Changes to the preset of every agent: gamma=0.99 hidden=[64,64]."""
    preset: PresetName = "tuned"
    """Hyperparameters: the paper's (of vpg and a2c), or ours."""
    env_steps: int | None = None
    """Env steps of each training, of all its drones together."""
    num_envs: int | None = None
    """Drones that fly at the same time, in lock-step, in each training."""
    seeds: int | None = None
    """Number of seeds, the same for all."""
    first_seed: int | None = None
    """The first of them."""
    snapshots: int | None = None
    """Policies kept during each training, for the learning curves."""
    episodes: int | None = None
    """Evaluation episodes of each final policy. Default: 200 over all seeds, 20 at least."""
    out: Path | None = None
    """Folder to write; it must not exist. Default: runs/COMMAND-TIME."""
    resume: Path | None = None
    """Folder of an interrupted command to go on with; it keeps its settings."""
    address: Annotated[str | None, arg(metavar="ray://HOST:PORT")] = None
    """The Ray cluster. Default: the one that this machine is part of."""
    film: bool = True
    """Whether the agents are filmed side by side for the report, where there is OpenGL."""
    page: Path | None = None
    """Markdown page to write besides the report."""

    @property
    def words(self) -> str:
        """The command without flags."""
        return type(self).__name__.lower()

    def study(self) -> "Study":
        """The study that the flags describe. Raises `InputError`."""
        raise NotImplementedError

    def run(self) -> int:
        """Fly the study, or what is missing of one; report."""
        from ..models.errors import require

        require("matplotlib", "report", "a report")  # before hours of training
        workers = WorkersConfig(jobs=self.jobs, runner=self.runner, address=self.address)
        if self.resume:
            return self._fly(self._resumed(self.resume), self.resume, workers)
        study = self.study()
        with folder_to_write(self.out, self.words.replace(" ", "-")) as folder:
            return self._fly(study, folder, workers)

    def _fly(self, study: "Study", folder: Path, workers: WorkersConfig) -> int:
        from ..training.study import run_study
        from ._progress import bars

        command = shlex.join(["rotorgram", *sys.argv[1:]])
        try:
            with bars() as progress:
                run_study(study, folder, command, progress, workers)
        except BaseException as error:
            if any(folder.iterdir()) and not isinstance(error, FolderBusy):
                print(go_on_with(self, self.words, folder, "runner", "address"))
            if isinstance(error, RunsFailed):  # the others are reported all the same
                report(folder, page=self.page, film=False)
            raise
        report(folder, page=self.page, film=self.film)
        return 0

    def _resumed(self, folder: Path) -> "Study":
        from ..training.results import Results

        results = Results.read(folder)
        if results.study.kind not in self.kinds:
            raise InputError(
                f"resume: expected a folder of rotorgram {self.words}, {folder} holds a "
                f"{results.study.kind}"
            )
        refuse_settings(self, folder, free=("algorithm", *_RESUMED))
        if results.finished:
            raise InputError(
                f"resume: expected an interrupted study, {folder} is finished; draw its report "
                f"with: rotorgram report {folder}"
            )
        return results.study

    # ---- parts of a study

    def env_config(self) -> "EnvConfig":
        """The env of the flags."""
        from ..envs.config import EnvConfig

        return EnvConfig.from_keywords(
            self.env_id, vehicle=self.vehicle, drones=self.drones, **self.options
        )

    def changes(self) -> dict[str, Any]:
        """Changes to the preset by name, of `--set`."""
        return dict(named_value("set", word) for words in self.set for word in words)

    def given_of_study(self) -> dict[str, Any]:
        """Settings of the study that were given."""
        values = {name: getattr(self, name) for name in _OF_STUDIES}
        values = {name: value for name, value in values.items() if value is not None}
        if "seeds" in values:
            values.setdefault("episodes", 0)  # as many as the seeds need
        return values

    def given_of_rows(self) -> dict[str, Any]:
        """Settings of rows that were given, but for the env and the changes."""
        for name in ("env_steps", "num_envs"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise InputError(f"{name}: expected 1 or more, got {value}")
        return {name: getattr(self, name) for name in _OF_ROWS if name in self.given}

    def changed(self, rows: Sequence["Row"]) -> tuple["Row", ...]:
        """Rows of a file with what the flags change: of all of them."""
        return tuple(self._changed(row) for row in rows)

    def _changed(self, row: "Row") -> "Row":
        from ..envs.config import EnvConfig

        settings = self.given_of_rows()
        env = row.env
        if "env" in self.given:
            kept = {"vehicle": env.vehicle, "drones": env.drones}
            env = EnvConfig.from_keywords(self.env_id, **kept)
        named = {name: getattr(self, name) for name in ("vehicle", "drones") if name in self.given}
        env = env.changed(**named, **self.options)
        name = "" if row.name == row.default_name else row.name
        if row.controller:
            return replace(row, name=name, env=env)
        changes = {**row.set, **self.changes()}
        return replace(row, name=name, env=env, set=changes, **settings)


def report(folder: Path, *, page: Path | None = None, film: bool = True) -> None:
    """Write figures, film and report from the folder's files, and print the tables."""
    from rich.console import Console

    from ..training.report import PAGE_FILE, VIDEO_FILE, write_report
    from ..training.results import Results
    from ..training.tables import terminal_tables

    results = Results.read(folder)
    table = write_report(results, page)
    console = Console(width=100)
    for shown in terminal_tables(results, table):
        console.print(shown)
    # Only now: if the film fails, there is a report.
    if film and results.study.kind in ("paper", "compare") and _film(results, folder / VIDEO_FILE):
        write_report(results, page)
    print(f"{len(results.runs)} of {len(results.study.runs())} runs done")
    if page:
        print(f"page: {page}")
    print(f"report: {folder / PAGE_FILE}")


def _film(results: "Results", out: Path) -> bool:
    """Whether a new film was written; without OpenGL or FFmpeg the log says why not."""
    if out.exists() or len({row.task for row in results.study.rows}) > 1:
        return False
    try:
        from ..training.films import film_study
        from ._progress import frame_bar

        with frame_bar(out.name) as on_frame:
            return film_study(results, out, on_frame)
    except (OSError, InputError, ImportError) as error:
        logging.getLogger(__name__).info("no film of the agents: %s", error)
        return False

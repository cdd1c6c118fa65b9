"""How a policy flies where the world is not as in its training: crashes and errors under each
perturbation of `envs/perturbations.toml`, at three sizes, alone and all together.
"""

from collections.abc import Mapping, Sequence
from contextlib import closing
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from pandas import DataFrame

from ..agents import find_controller, is_controller, load
from ..envs import registry
from ..envs.config import EnvConfig
from ..envs.perturbations import PERTURBATIONS, check, perturbed, together, with_cases
from ..envs.vector import LocalVectorEnv
from ..flights.crowd import fly_crowd
from ..flights.executors import OnProgress, Tell, WorkersConfig, open_executor, run_jobs
from ..flights.palette import agent_color, agent_label
from ..flights.trajectories import evaluation_seed
from ..models.errors import InputError
from ..models.fields import immutable
from .metrics import Headline
from .statistics import share_interval

MOST = 4096
"""Drones that fly at the same time."""
NOMINAL, TOGETHER = "nominal", "together"
"""Names of the flights without any, and with all."""

Table = Mapping[str, Any]


@immutable
class Cell:
    """A perturbation of one size: the env that it flies in, and what is drawn there."""

    row: str
    """Name in `PERTURBATIONS`, or `NOMINAL` or `TOGETHER`."""
    size: float
    config: EnvConfig
    drawn: Table

    @property
    def label(self) -> str:
        """As tables have it: "wind 5 m/s"."""
        if self.row not in PERTURBATIONS:
            return NOMINAL if self.row == NOMINAL else f"all together, {self.size:g} of 3"
        about = PERTURBATIONS[self.row]
        return f"{about['label']} {self.size:g} {about['unit']}".rstrip()


@immutable
class Job:
    """Cells of one env, and who flies them."""

    pilot: str
    """Path of a checkpoint, or a controller."""
    cells: tuple[Cell, ...]
    flights: int
    """Of each cell."""
    own_task: str | None
    """As of an `EnvConfig`: a worker has to import it."""


def cells_of(config: EnvConfig) -> tuple[list[Cell], dict[str, str]]:
    """The cells of an env, and of each row that it cannot fly the sentence that says why."""
    cells = [Cell(row=NOMINAL, size=0.0, config=config, drawn={})]
    refused = {}
    for name, about in PERTURBATIONS.items():
        found = []
        try:
            for size in about["sizes"]:
                changed, drawn = perturbed(config, name, size)
                found.append(Cell(row=name, size=size, config=changed, drawn=drawn))
            check(changed)
        except InputError as error:
            refused[name] = str(error)
        else:
            cells += found
    whole = {name: about for name, about in PERTURBATIONS.items() if "together" in about}
    for number in range(3):
        sizes = {name: about["sizes"][number] for name, about in whole.items()}
        widest, drawn, _ = together(config, sizes)
        cells.append(Cell(row=TOGETHER, size=number + 1, config=widest, drawn=drawn))
    return cells, refused


def jobs_of(pilot: str, cells: Sequence[Cell], flights: int) -> list[Job]:
    """One for each env; cells that draw nothing have one of their own, or are told from others by
    what these draw.
    """
    envs: list[list[Cell]] = []
    for cell in cells:
        same = [own for own in envs if own[0].config == cell.config]
        same = [own for own in same if cell.drawn or any(one.drawn for one in own)]
        if same:
            same[0].append(cell)
        else:
            envs.append([cell])
    return [
        Job(pilot=pilot, cells=tuple(own), flights=flights, own_task=own[0].config.own_task)
        for own in envs
    ]


def fly(jobs: Sequence[Job], workers: WorkersConfig, on_progress: OnProgress) -> DataFrame:
    """Fly all cells: a row for each drone of each flight, with the columns of `fly_crowd`, and
    `pilot`, `row` and `size`. Raises `RunsFailed`.
    """
    frames: list[DataFrame] = []
    named = {f"{job.pilot}: {job.cells[0].label}": job for job in jobs}
    with open_executor(workers, len(named), on_progress) as executor:
        run_jobs(executor, _fly, named, lambda _, frame: frames.append(frame), on_progress)
    return pd.concat(frames, ignore_index=True)


def _fly(job: Job, tell: Tell) -> DataFrame:
    """In a worker: episodes until each cell has its flights, the same number of each."""
    if job.own_task:
        registry.load(job.own_task)
    config = with_cases(job.cells[0].config, [cell.drawn for cell in job.cells])
    cells = len(job.cells)
    share = PERTURBATIONS.get(job.cells[0].row, {}).get("sample", 1.0)
    flights = ceil(share * job.flights)
    worlds = min(ceil(1.1 * flights * cells) + 20 * (cells > 1), MOST // config.drones)
    wanted = flights * config.drones
    frames: list[DataFrame] = []
    with closing(LocalVectorEnv(config, worlds * config.drones, autoreset_mode="Disabled")) as env:
        policy = policy_of(job.pilot, env)
        least = 0
        while least < wanted:
            first = len(frames) * worlds
            seeds = [evaluation_seed(first + number, "final") for number in range(worlds)]
            frames.append(DataFrame(fly_crowd(env, policy, seeds)))
            flown = pd.concat(frames, ignore_index=True)
            least = int(np.bincount(flown["case"], minlength=cells).min())
            tell(min(least, wanted), wanted, job.cells[0].label)
        headline = Headline.of(env.env_spec)
    kept = flown.groupby("case").head(wanted)
    rows = [job.cells[case].row for case in kept["case"]]
    sizes = [job.cells[case].size for case in kept["case"]]
    crashed = _crashed(kept, headline)
    told = {"pilot": job.pilot, "row": rows, "size": sizes, "crashed": crashed}
    return kept.drop(columns="case").assign(**told)


def policy_of(pilot: str, env: LocalVectorEnv) -> Any:
    """Who flies an env, by the name of a controller or the path of a checkpoint. Raises
    `InputError`.
    """
    if is_controller(pilot):
        return find_controller(pilot)(env.env_spec)
    return load(Path(pilot)).policy(env.env_spec)


def _crashed(flown: DataFrame, headline: Headline) -> "pd.Series[bool]":
    """Which flights crashed."""
    return headline.crashed(flown.assign(steady=flown["last"]) if headline.final else flown)


def table_of(flown: DataFrame, cells: Sequence[Cell]) -> DataFrame:
    """Of each cell, in their order, and each pilot: flights, crashes, the ends `low` and `high` of
    Wilson's interval of their share, and the `median` and the 95th percentile `p95` of the steady
    headline metric of those that did not crash.
    """
    pilots = flown["pilot"].unique()
    groups = dict(list(flown.groupby(["pilot", "row", "size"])))
    lines = []
    for cell in cells:
        for pilot in pilots:
            own = groups.get((pilot, cell.row, cell.size))
            if own is None:  # what this pilot cannot fly
                continue
            crashes = int(own["crashed"].sum())
            low, high = share_interval(crashes, len(own))
            whole = own.loc[~own["crashed"], "steady"]
            line = {"row": cell.row, "size": cell.size, "label": cell.label, "pilot": pilot}
            line |= {"flights": len(own), "crashes": crashes, "low": low, "high": high}
            lines.append(line | {"median": whole.median(), "p95": whole.quantile(0.95)})
    return DataFrame(lines)


def text_of(table: DataFrame, title: str, headline: Headline) -> str:
    """The table for a terminal."""
    pilots = table["pilot"].unique()
    unit = headline.unit
    lines = [title, f"crashes, % of flights (95 % interval), and {headline.size_symbol}, {unit}"]
    width = table["label"].str.len().max()
    lines.append(" " * width + "".join(f"  {Path(pilot).name[-24:]:>25}" for pilot in pilots))
    for label, own in table.groupby("label", sort=False):
        words = f"{label:{width}}"
        for pilot in pilots:
            text = "–"
            for line in own[own["pilot"] == pilot].itertuples():
                share = 100 * line.crashes / line.flights
                ends = f"({100 * line.low:.1f}-{100 * line.high:.1f})"
                text = f"{share:5.1f} {ends:>12} {line.median:6.3g}"
            words += f"  {text:>25}"
        lines.append(words)
    return "\n".join(lines)


def draw(table: DataFrame, title: str) -> Figure:
    """Crashes of each row, a column for each pilot; the larger a perturbation, the darker."""
    pilots = table["pilot"].unique()
    rows = list(table["row"].unique())
    figure = Figure(figsize=(4 + 3.5 * len(pilots), 1.2 + 0.32 * len(rows)), dpi=110)
    axes = figure.subplots(1, len(pilots), sharey=True, squeeze=False)[0]
    labels = [_row_label(row) for row in rows]
    for axis, pilot in zip(axes, pilots, strict=True):
        for place, row in enumerate(rows):
            own = table[(table["pilot"] == pilot) & (table["row"] == row)]
            for number, line in enumerate(own.itertuples()):
                height = place + 0.22 * (number - (len(own) - 1) / 2)
                alpha = 0.35 + 0.65 * number / max(len(own) - 1, 1)
                style = {"color": agent_color(pilot), "alpha": alpha}
                axis.plot([100 * line.low, 100 * line.high], [height, height], lw=1.5, **style)
                axis.plot(100 * line.crashes / line.flights, height, "o", ms=4, **style)
        axis.set_xscale("symlog", linthresh=1.0)
        axis.set_xlim(-0.05, 105)
        axis.set_xticks([0, 1, 10, 100], ["0", "1", "10", "100"])
        axis.set_title(agent_label(pilot), fontsize=9)
        axis.set_xlabel("crashes, % of flights")
        axis.grid(axis="x", alpha=0.3)
    axes[0].set_yticks(range(len(rows)), labels)
    axes[0].set_ylim(len(rows) - 0.4, -0.6)
    figure.suptitle(title, fontsize=10)
    figure.set_layout_engine("constrained")
    return figure


def _row_label(row: str) -> str:
    about = PERTURBATIONS.get(row)
    if about is None:
        return "all together" if row == TOGETHER else row
    sizes = ", ".join(f"{size:g}" for size in about["sizes"])
    return f"{about['label']} {sizes} {about['unit']}".rstrip()

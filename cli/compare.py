"""`rotorgram compare`: train several agents over the same seeds and steps, and report."""

from dataclasses import dataclass, replace
from pathlib import Path

from ..models.errors import InputError, require
from ._flags import AlgorithmName, PresetName
from ._inputs import refuse_settings
from ._runs import RESUMED, RunsFlags, command_line, report_comparison, runs_folder

__all__ = ["Compare"]


@dataclass(frozen=True, kw_only=True)
class Compare(RunsFlags):
    """Train VPG, A2C and SB3's A2C over the same seeds and steps, and report.

    Every run has a simulator process and a socket pair of its own. Writes one folder: results,
    checkpoints, figures and report.html.
    """

    agents: tuple[AlgorithmName, ...] = ("vpg", "a2c", "sb3-a2c")
    """Algorithms to train; the PID flies beside them."""
    preset: PresetName = "tuned"
    """Hyperparameters: the paper's, or ours."""
    seeds: int = 5
    """Number of seeds, the same for every agent. Fewer than 5 decide no claim."""
    first_seed: int = 0
    """The first of them."""
    env_steps: int = 200_000
    """Env steps of each training; a learning rate that falls, falls over all of them."""
    num_envs: int = 1
    """Drones of each training that fly at the same time, in lock-step. Env steps count all."""
    snapshots: int = 10
    """Policies kept during each training, for the learning curves."""
    episodes: int = 20
    """Evaluation episodes of each final policy."""
    film: bool = True
    """Whether the agents are filmed side by side for the report, where there is OpenGL."""
    out: Path | None = None
    """Folder to write; it must not exist. Default: runs/compare-TIME."""
    resume: Path | None = None
    """Folder of an interrupted comparison to go on with; it keeps its settings."""

    def run(self) -> int:
        """Compare, report, print the table."""
        for module in ("matplotlib", "jinja2"):  # before hours of training
            require(module, "report", "a comparison's report")
        from ..experiments.compare import PARTS, compare, read_compare_config
        from ..experiments.settings import CompareConfig

        if self.resume:
            refuse_settings(self, self.resume, free=("film", *RESUMED))
            config = replace(read_compare_config(self.resume), **self.workers())
            if not (self.resume / PARTS).is_dir():
                raise InputError(
                    f"resume: expected an interrupted comparison, {self.resume} is finished; "
                    f"draw its report with: rotorgram report {self.resume}"
                )
        else:
            config = CompareConfig(
                agents=self.agents,
                seeds=self.seeds,
                first_seed=self.first_seed,
                env_steps=self.env_steps,
                num_envs=self.num_envs,
                preset=self.preset,
                env_id=self.env_id,
                options=self.options,
                vehicle=self.vehicle,
                snapshots=self.snapshots,
                episodes=self.episodes,
                **self.workers(),
            )
        with runs_folder("compare", self, self.resume, self.out) as (folder, progress):
            compare(config, folder, command_line(), progress)
        report_comparison(folder, film=self.film)
        return 0

"""Commands that train: one run, the same seeds for several agents, a grid; and their reports."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

from ..agents.presets import AlgorithmName, PresetName
from .base import AgentCommand, Command, EnvOptions

__all__ = ["Compare", "Report", "RunsCommand", "Sweep", "Train"]


@dataclass(frozen=True, kw_only=True)
class Train(AgentCommand):
    """Train an agent: the UDP server.

    Starts a simulator process of its own, or waits for one with --listen. Ctrl-C stops at the next
    update with everything written; --resume goes on to the same numbers.
    """

    algorithm: Positional[AlgorithmName]
    """vpg, a2c or sb3-a2c."""
    preset: PresetName = "tuned"
    """Hyperparameters: the paper's, or ours."""
    set: UseAppendAction[Annotated[tuple[tuple[str, ...], ...], arg(metavar="NAME=VALUE …")]] = ()
    """Changes to the preset, such as gamma=0.99 steps_per_update=64."""
    seed: int = 0
    """Seed of weights, actions and episodes."""
    env_steps: int = 200_000
    """Env steps to train for."""
    num_envs: int = 1
    """Drones that fly at the same time, in lock-step. Env steps count all of them."""
    num_simulators: int = 1
    """With --listen: simulators to wait for, each with its share of the drones."""
    out: Path | None = None
    """Folder to write to. Default: runs/ALGORITHM-seedSEED-TIME."""
    resume: Path | None = None
    """Folder of a training to go on with; its own settings hold."""
    store_every: float = 10.0
    """Seconds between two checkpoints; what is flown after the last one is flown again."""
    env: EnvOptions = field(default_factory=EnvOptions)

    def run(self) -> int:
        """Train, store, and say where."""
        from .train import train

        return train(self)


@dataclass(frozen=True, kw_only=True)
class RunsCommand(Command):
    """A command of many runs, which may fly on many machines."""

    jobs: int | None = None
    """Runs at a time. Default: one for each core of this machine, or of the cluster."""
    backend: Literal["loky", "ray"] = "loky"
    """loky: processes of this machine. ray: a Ray cluster (pip install 'rotorgram[ray]')."""
    address: Annotated[str | None, arg(metavar="ray://HOST:PORT")] = None
    """The Ray cluster. Default: the one that this machine is part of."""


@dataclass(frozen=True, kw_only=True)
class Compare(RunsCommand):
    """Train VPG, A2C and SB3's A2C over the same seeds and steps, and report.

    Every run has a simulator process and a socket pair of its own. Writes one folder: records,
    checkpoints, figures and report.html.
    """

    agents: tuple[AlgorithmName, ...] = ("vpg", "a2c", "sb3-a2c")
    """Algorithms to train; the PID flies beside them."""
    preset: PresetName = "tuned"
    """Hyperparameters: the paper's, or ours."""
    seeds: int = 5
    """Seeds 0 ... SEEDS - 1, the same for every agent. Fewer than 5 decide no claim."""
    env_steps: int = 200_000
    """Env steps of each training; a learning rate that falls, falls over all of them."""
    snapshots: int = 10
    """Policies kept during each training, for the learning curves."""
    episodes: int = 20
    """Evaluation episodes of each final policy."""
    film: bool = True
    """Whether the agents are filmed side by side for the report, where there is OpenGL."""
    out: Path | None = None
    """Folder to write; it must not exist. Default: runs/compare-TIME."""
    resume: Path | None = None
    """Folder of an interrupted comparison to go on with; its own settings hold."""
    env: EnvOptions = field(default_factory=EnvOptions)

    def run(self) -> int:
        """Compare, report, print the table."""
        from .compare import compare

        return compare(self)


@dataclass(frozen=True, kw_only=True)
class Sweep(RunsCommand):
    """Train an algorithm over a grid of hyperparameters, every point on the same seeds.

    Every run has a simulator process and a socket pair of its own. Ctrl-C keeps the runs that are
    done; --resume flies the others.
    """

    algorithm: Positional[AlgorithmName]
    """vpg, a2c or sb3-a2c."""
    grid: UseAppendAction[
        Annotated[tuple[tuple[str, ...], ...], arg(metavar="NAME=VALUE,... ...")]
    ] = ()
    """Values to try, such as learning_rate=0.003,0.01 steps_per_update=64,256: every combination
    is a point."""
    preset: PresetName = "tuned"
    """Hyperparameters that the grid does not name: the paper's, or ours."""
    seeds: int = 3
    """Seeds 0 ... SEEDS - 1, the same for every point."""
    env_steps: int = 200_000
    """Env steps of each training, of all its drones together."""
    num_envs: int = 1
    """Drones that fly at the same time, in lock-step, in each training."""
    episodes: int = 20
    """Evaluation episodes of each final policy."""
    out: Path | None = None
    """Folder to write; it must not exist. Default: runs/sweep-ALGORITHM-TIME."""
    resume: Path | None = None
    """Folder of an interrupted sweep to go on with; its own settings hold."""
    env: EnvOptions = field(default_factory=EnvOptions)

    def run(self) -> int:
        """Sweep, and print the table."""
        from .sweep import sweep

        return sweep(self)


@dataclass(frozen=True, kw_only=True)
class Report(Command):
    """Draw a comparison's figures, table and report again from its files, or a sweep's table."""

    folder: Positional[Path]
    """Folder that `rotorgram compare` or `rotorgram sweep` wrote."""
    film: bool = True
    """Whether a comparison's agents are filmed, where that was not done and there is OpenGL."""

    def run(self) -> int:
        """Write what is drawn from the files, and print the table."""
        from ..experiments.sweep import is_sweep

        if is_sweep(self.folder):
            from .sweep import report as report_sweep

            report_sweep(self.folder)
        else:
            from .compare import report

            report(self.folder, film=self.film)
        return 0

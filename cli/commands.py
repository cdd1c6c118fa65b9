"""Commands as frozen dataclasses: a field is a flag, its docstring the help.

Heavy imports stay inside `run`: a simulator starts without torch, an agent without MuJoCo.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, UseAppendAction, arg

from ..agents.presets import AlgorithmName, PresetName
from .base import AgentCommand, Command, EnvOptions
from .inputs import load_policy, remote_env
from .wire import MakeKey, RelayFaults, Replay, Sim

__all__ = ["COMMANDS", "user_errors"]


def user_errors() -> tuple[type[Exception], ...]:
    """Errors that are one sentence to the user. A bug of ours is not among them."""
    from ..agents.episodes import ResumeError
    from ..experiments.errors import RunsFailed
    from ..rendering.gl import NoOpenGL

    return (ValueError, OSError, ResumeError, RunsFailed, NoOpenGL)


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
class Serve(AgentCommand):
    """Fly simulators that come, one after the other, with a trained policy or the PID."""

    policy: Positional[str]
    """Checkpoint, folder of a training, or pid."""
    listen: Annotated[str | None, arg(metavar="HOST:PORT")] = "127.0.0.1:8001"
    """Address to wait at."""
    episodes: int | None = None
    """End after so many episodes. Default: go on until Ctrl-C."""
    env: EnvOptions = field(default_factory=EnvOptions)

    def run(self) -> int:
        """Fly episode after episode."""
        from ..experiments.evaluate import evaluation_seed, fly

        if self.episodes is not None and self.episodes < 1:
            raise ValueError(f"episodes: expected at least 1, got {self.episodes}")
        policy, config = load_policy(self.policy, self.env.checked())
        episode = 0
        with remote_env(config, self) as env:
            while self.episodes is None or episode < self.episodes:
                with _until_it_leaves():
                    flight = fly(env, policy, evaluation_seed(episode))
                    print(
                        f"episode {episode}: return {flight.rewards.sum():.1f}, "
                        f"last |E| {abs(flight.errors[-1]):.3f} m",
                        flush=True,
                    )
                    episode += 1
        return 0


@contextmanager
def _until_it_leaves() -> Iterator[None]:
    """A simulator that leaves is no error to an agent that waits for the next."""
    from ..udp import LinkError

    try:
        yield
    except LinkError as error:
        print(error, flush=True)


@dataclass(frozen=True, kw_only=True)
class Evaluate(AgentCommand):
    """Measure a trained policy or the PID over episodes without exploration."""

    policy: Positional[str]
    """Checkpoint, folder of a training, or pid."""
    episodes: int = 20
    """Episodes to fly, from seeds that no training uses."""
    env: EnvOptions = field(default_factory=EnvOptions)
    """With a checkpoint: changes to the options that it was trained with."""

    def run(self) -> int:
        """Fly and print the means."""
        import numpy as np

        from ..experiments.evaluate import evaluation_row, fly_episodes

        if self.episodes < 1:
            raise ValueError(f"episodes: expected at least 1, got {self.episodes}")
        policy, config = load_policy(self.policy, self.env.checked())
        with remote_env(config, self) as env:
            flights = fly_episodes(env, policy, self.episodes)
        rows = [evaluation_row(f, k, config.control_period) for k, f in enumerate(flights)]
        settled = [r["settling_time"] for r in rows if not np.isnan(r["settling_time"])]
        crashes = sum(r["terminated"] for r in rows)
        settling = f"{np.mean(settled):.2f} s" if settled else "never"
        print(f"policy            {self.policy}")
        print(f"episodes          {len(rows)}, {crashes} terminated")
        print(f"return            {np.mean([r['return'] for r in rows]):.1f}")
        print(f"steady-state |E|  {np.mean([r['steady_error'] for r in rows]):.4f} m")
        print(f"settling to 5 cm  {settling} ({len(settled)} of {len(rows)} episodes)")
        print(f"overshoot         {np.mean([r['overshoot'] for r in rows]):.3f} m")
        return 0


@dataclass(frozen=True, kw_only=True)
class View(Command):
    """Look at flights, in real time or slower: in a window, or on a page for browsers.

    Keys: space pauses, the arrow to the right takes one step, - and + change the speed.
    """

    what: Positional[str]
    """Checkpoint, folder of a training, pid, random, or a journal (.mcap)."""
    web: bool = False
    """Serve a page for browsers, for a machine without a display."""
    port: int = 8080
    """TCP port of the page, on this machine's loopback; 0 takes the first free one."""
    world: Literal["airport", "plain"] = "airport"
    """What is around the drone."""
    speed: float = 1.0
    """1 is real time, from 1/16 to 8."""
    episodes: int | None = None
    """End after so many episodes. Default: go on until it is closed."""
    env: EnvOptions = field(default_factory=EnvOptions)
    """With a checkpoint: changes to the options that it was trained with."""

    def run(self) -> int:
        """Fly and show, episode after episode."""
        from .view import view

        return view(self)


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
    """Film the agents side by side for the report. Without OpenGL there is no film."""
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

    def run(self) -> int:
        """Write what is drawn from the files, and print the table."""
        from ..experiments.sweep import is_sweep

        if is_sweep(self.folder):
            from .sweep import report
        else:
            from .compare import report
        report(self.folder)
        return 0


@dataclass(frozen=True, kw_only=True)
class Render(Command):
    """Film flights: a policy's, or those of a journal; several side by side.

    Needs no display. Exit status 2 where there is no OpenGL.
    """

    what: Positional[tuple[str, ...]]
    """Checkpoint, folder of a training, pid, random, or a journal (.mcap). Policies fly evaluation
    episodes without exploration."""
    out: Path
    """film.mp4, film.gif, picture.png, or a folder for pictures 0001.png and so on. It must not
    exist."""
    camera: Literal["chase", "front", "side", "top", "onboard"] = "chase"
    """From where. Front and side stand still, the others follow."""
    episode: int = 0
    """The first episode: of an evaluation, or of those in the journal."""
    episodes: int = 1
    """How many."""
    size: str = "1280x720"
    """WIDTHxHEIGHT of the picture with all its panes, pixels."""
    fps: float = 25.0
    """Pictures per second."""
    speed: float = 1.0
    """Seconds of flight per second of film: 0.25 is slow motion."""
    at: float | None = None
    """One picture, at this time of the first episode, s. Without it a .png is the last one."""
    world: Literal["airport", "plain"] = "airport"
    """Where it flies, to look at; what is flown is the same."""
    overlay: bool = True
    """Numbers and error curves on the picture."""
    fast: bool = False
    """Without shadows and smooth edges: several times as fast where software draws."""
    names: tuple[str, ...] = ()
    """Titles, once for each flight. Default: what it is."""
    session: int | None = None
    """With a journal: which session, as rotorgram replay counts them. Default: the first that
    flew."""
    drone: int = 0
    """With a journal: which drone of the session."""
    env: EnvOptions = field(default_factory=EnvOptions)
    """With a checkpoint: changes to the options that it was trained with. No use to a journal."""

    def run(self) -> int:
        """Fly or read, draw, and say where."""
        from .render import render

        return render(self)


@dataclass(frozen=True, kw_only=True)
class CheckModel(Command):
    """Examine a quadcopter model: mass, inertia, hover, free fall, torques, momentum, contact."""

    xml: Positional[Path | None] = None
    """MJCF file. Default: the model that every simulation here uses."""

    def run(self) -> int:
        """Print every check; exit status 1 if one fails."""
        import mujoco
        from rich.console import Console
        from rich.table import Table

        from ..models import load_model
        from ..models.checks import examine

        if self.xml is not None and not self.xml.is_file():
            raise ValueError(f"xml: no file {self.xml}")
        model = load_model() if self.xml is None else mujoco.MjModel.from_xml_path(str(self.xml))
        checks = examine(model)
        table = Table("", "check", "expected", "measured - expected", "tolerance", "source")
        for check in checks:
            table.add_row(
                "[green]ok" if check.passed else "[red]FAILED",
                check.name,
                f"{check.expected:.7g} {check.unit}",
                f"{check.measured - check.expected:.1e}",
                f"{check.tolerance:.0e}",
                check.source,
            )
        Console().print(table)
        failed = sum(not check.passed for check in checks)
        print(f"{len(checks) - failed} of {len(checks)} checks passed")
        return 1 if failed else 0


@dataclass(frozen=True, kw_only=True)
class Bench(Command):
    """Measure what bounds a training on this machine, from raw physics to an update."""

    rounds: int = 7
    """Turns of every layer, besides one to warm up; medians count."""
    seconds: float = 0.5
    """Length of a turn."""
    out: Path | None = None
    """Folder to write to. Default: runs/bench-TIME."""

    def run(self) -> int:
        """Measure, print and draw."""
        from .bench import bench

        return bench(self)


COMMANDS: dict[str, Any] = {
    "sim": Sim,
    "train": Train,
    "serve": Serve,
    "evaluate": Evaluate,
    "view": View,
    "compare": Compare,
    "sweep": Sweep,
    "report": Report,
    "render": Render,
    "bench": Bench,
    "check-model": CheckModel,
    "key": MakeKey,
    "relay": RelayFaults,
    "replay": Replay,
}

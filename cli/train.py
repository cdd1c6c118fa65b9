"""`rotorgram train`: one run with a progress bar, checkpoints, and Ctrl-C that loses nothing."""

import io
import json
import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pandas as pd

from ..agents import A2CConfig, preset
from ..agents.checkpoints import load, software_versions, write_whole
from ..agents.episodes import Episode
from ..envs import ElevationConfig
from ..experiments.training import Run, Training, is_finished
from .inputs import CHECKPOINT, new_folder, parse_changes, refuse_settings, remote_env
from .progress import bars
from .scalars import ScalarWriter

if TYPE_CHECKING:
    from .training import Train

__all__ = ["train"]

EPISODES: Final = "episodes.csv"
_NOT_KEPT: Final = ("listen", "num_simulators", "key_file", "insecure", "record", "store_every")
_UPDATE_WITHIN: Final = 0.7  # s
_SHOW_EVERY: Final = 0.2  # s
_LEAST_STEPS: Final = 16  # of each drone for an update of A2C
_LEAST_UPDATES: Final = 30  # of VPG


def train(command: "Train") -> int:
    """Train by the command's settings, or by those of the folder to resume."""
    if not (math.isfinite(command.store_every) and command.store_every > 0):
        raise ValueError(f"store-every: expected seconds > 0, got {command.store_every}")
    if command.resume:
        return _resume(command, command.resume)
    run = Run(
        algorithm=command.algorithm,
        config=preset(
            command.algorithm,
            command.preset,
            **parse_changes(word for words in command.set for word in words),
        ),
        env=command.env.checked(),
        seed=command.seed,
        env_steps=command.env_steps,
        num_envs=command.num_envs,
    )
    if advice := _advice(run):
        print(f"note: {advice}", flush=True)
    folder = new_folder(command.out, f"{run.algorithm}-seed{run.seed}")
    with remote_env(run.env, command, run.num_envs, command.num_simulators) as env:
        training = Training(run, env)
        _write_config(training, folder)
        return _train(training, folder, command)


def _advice(run: Run) -> str:
    """What to set where the other settings leave too little for so many drones; or nothing."""
    drones, config = run.num_envs, run.config
    if drones == 1:
        return ""
    if isinstance(config, A2CConfig):
        steps = config.rollout_size(drones) // drones
        if steps >= _LEAST_STEPS:
            return ""
        better = 2 * _LEAST_STEPS * drones
        return (
            f"an update has {steps} steps of each of {drones} drones, and {run.algorithm} learns "
            f"little from fewer than {_LEAST_STEPS}: try --set steps_per_update={better}, a higher "
            f"learning_rate, and --env-steps {100 * better} or more"
        )
    whole = -(-config.episodes_per_update // drones) * drones * run.env.episode_length
    updates = run.env_steps // whole
    if updates >= _LEAST_UPDATES:
        return ""
    return (
        f"{run.env_steps:,} env steps of {drones} drones may be as few as {updates} updates, and "
        f"vpg learns little from fewer than {_LEAST_UPDATES}: try --env-steps "
        f"{_LEAST_UPDATES * whole} or more, or fewer drones"
    )


def _resume(command: "Train", folder: Path) -> int:
    kept = load(folder / CHECKPOINT)
    if kept.algorithm != command.algorithm:
        raise ValueError(
            f"resume: expected a training of {command.algorithm}, "
            f"{folder} holds one of {kept.algorithm}"
        )
    refuse_settings(command, folder, free=("algorithm", "resume", *_NOT_KEPT))
    episodes = _read_episodes(folder / EPISODES, kept.position.episode)
    if is_finished(kept):
        print(f"already trained {kept.position.env_steps:,} of {kept.env_steps:,} env steps")
        print(f"checkpoint: {folder / CHECKPOINT}")
        return 0
    options = ElevationConfig.from_options(kept.env)
    with remote_env(options, command, kept.num_envs, command.num_simulators) as env:
        return _train(Training.resume(kept, env, episodes), folder, command)


def _train(training: Training, folder: Path, command: "Train") -> int:
    before = training.log.env_steps
    go_on = f"go on with: rotorgram train {training.run.algorithm} --resume {folder}"
    if command.listen:
        go_on += f" --listen {command.listen}"
        if command.num_simulators > 1:
            go_on += f" --num-simulators {command.num_simulators}"
        go_on += f" --key-file {command.key_file}" if command.key_file else ""
        go_on += " --insecure" if command.insecure else ""
    keeper = _Keeper(training, folder, command.store_every)
    try:
        with _stop_at_update() as stop, _showing(training) as show:

            def on_update() -> bool:
                show()
                stopping = stop.reached()
                keeper.keep(now=stopping)
                return not stopping

            finished = training.train(on_update)
            if finished:
                stop.reached()
                keeper.keep(now=True, last=True)
    except BaseException:  # a full disk and SIGTERM too
        with suppress(OSError):
            keeper.close()
        if (folder / CHECKPOINT).exists():
            print(go_on)
        raise
    keeper.close()
    flown = training.log.env_steps - before
    what = ("trained" if flown else "already trained") if finished else "stopped after"
    print(f"{what} {training.log.env_steps:,} of {training.run.env_steps:,} env steps")
    if flown:
        print(f"{training.log.env_steps / training.log.seconds:,.0f} env steps per second")
    print(f"checkpoint: {folder / CHECKPOINT}" if finished else go_on)
    return 0 if finished else 130


class _Keeper:
    """Stores a training at its first update, then every so many seconds, and when told to.

    The numbers for TensorBoard are written by env steps, not by the clock, so that those of a
    training that was stopped and resumed stand at the same steps as those of an unbroken one.
    """

    def __init__(self, training: Training, folder: Path, every: float) -> None:
        self._training = training
        self._folder = folder
        self._every = every
        self._due = 0.0
        self._scalars = ScalarWriter(
            folder / "tensorboard", training.run.env_steps, behind=training.log.env_steps
        )

    def keep(self, *, now: bool, last: bool = False) -> None:
        at = self._training.log.env_steps
        if self._scalars.due(at, last=last):
            self._scalars.write(at, self._training.scalars())
        if now or time.monotonic() >= self._due:
            # First the rest: a checkpoint takes the episodes and the curves that end before it.
            self._write_episodes()
            self._scalars.flush()
            self._training.store(self._folder / CHECKPOINT)
            self._due = time.monotonic() + self._every

    def close(self) -> None:
        """Write what does not need an update to be whole."""
        self._write_episodes()
        self._scalars.close()

    def _write_episodes(self) -> None:
        rows = [asdict(episode) for episode in self._training.log.episodes]
        table = pd.DataFrame(rows, columns=[f.name for f in fields(Episode)])
        write_whole(self._folder / EPISODES, table.to_csv(index=False).encode())


def _read_episodes(path: Path, count: int) -> list[Episode]:
    """The first so many episodes. Raises `ValueError`."""
    try:
        table = pd.read_csv(io.BytesIO(path.read_bytes()))
        episodes = [
            Episode(**{str(k): v for k, v in row.items()}) for row in table.to_dict("records")
        ]
        whole = len({episode.episode for episode in episodes[:count]}) == count
    except (FileNotFoundError, TypeError, ValueError):
        whole = False
    if not whole:
        raise ValueError(f"{path}: expected the {count} episodes before the checkpoint")
    return episodes[:count]


def _write_config(training: Training, folder: Path) -> None:
    hello = getattr(training.env, "hello", None)
    content = {
        **asdict(training.run),
        "model_hash": hello.model_hash if hello else "",
        "versions": software_versions(),
    }
    write_whole(folder / "config.json", (json.dumps(content, indent=2) + "\n").encode())


@contextmanager
def _showing(training: Training) -> Iterator[Callable[[], None]]:
    """A function that shows the progress, unless it was shown a moment ago."""
    name = f"{training.run.algorithm} seed {training.run.seed}"
    due = 0.0
    with bars() as progress:

        def show() -> None:
            nonlocal due
            if time.monotonic() >= due:
                state = training.progress()
                progress(name, state.env_steps, state.total, state.words())
                due = time.monotonic() + _SHOW_EVERY

        yield show
        due = 0.0
        show()


@contextmanager
def _stop_at_update() -> "Iterator[_Stop]":
    """Ctrl-C and termination ask to stop at the next update.

    If none comes soon, since no simulator answers for example, or if asked again, it stops at once.
    """
    stop = _Stop()
    handlers = {signal.SIGINT: stop.ask, signal.SIGTERM: stop.ask}
    if hasattr(signal, "setitimer"):
        handlers[signal.SIGALRM] = stop.ask
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield stop
    finally:
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, 0)
        for number, handler in before.items():
            signal.signal(number, handler)


class _Stop:
    def __init__(self) -> None:
        self.asked = False

    def reached(self) -> bool:
        """Whether to stop at this update. There is time to write then."""
        if self.asked and hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, 0)
        return self.asked

    def ask(self, *_: object) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
        print("stopping at the next update; Ctrl-C again stops now", flush=True)
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, _UPDATE_WITHIN)

"""`rotorgram train`: one run with a progress bar, checkpoints, and Ctrl-C that loses nothing."""

import io
import json
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pandas as pd

from ..agents import preset
from ..agents.checkpoints import load, software_versions, write_whole
from ..agents.episodes import Episode
from ..envs import ElevationConfig
from ..experiments.training import Run, Training
from ..udp import LinkError
from .inputs import CHECKPOINT, new_folder, parse_changes, refuse_settings, remote_env
from .progress import bars

if TYPE_CHECKING:
    from .commands import Train

__all__ = ["train"]

EPISODES: Final = "episodes.csv"
_STORE_EVERY: Final = 10.0  # s
_SHOW_EVERY: Final = 0.2  # s


def train(command: "Train") -> int:
    """Train by the command's settings, or by those of the folder to resume."""
    if command.resume:
        return _resume(command, command.resume)
    run = Run(
        algorithm=command.algorithm,
        config=preset(command.algorithm, command.preset, **parse_changes(command.set)),
        env=command.env.checked(),
        seed=command.seed,
        env_steps=command.env_steps,
    )
    folder = new_folder(command.out, f"{run.algorithm}-seed{run.seed}")
    with remote_env(run.env, command.listen, command.insecure) as env:
        training = Training(run, env)
        _write_config(training, folder)
        return _train(training, folder)


def _resume(command: "Train", folder: Path) -> int:
    kept = load(folder / CHECKPOINT)
    if kept.algorithm != command.algorithm:
        raise ValueError(
            f"resume: expected a training of {command.algorithm}, "
            f"{folder} holds one of {kept.algorithm}"
        )
    refuse_settings(command, folder, free=("algorithm", "resume", "listen", "insecure"))
    episodes = _read_episodes(folder / EPISODES, kept.position.episode)
    options = ElevationConfig.from_options(kept.env)
    with remote_env(options, command.listen, command.insecure) as env:
        return _train(Training.resume(kept, env, episodes), folder)


def _train(training: Training, folder: Path) -> int:
    before = training.log.env_steps
    go_on = f"go on with: rotorgram train {training.run.algorithm} --resume {folder}"
    try:
        with _stop_at_update() as stop, _showing(training) as show:
            keeper = _Keeper(training, folder)

            def on_update() -> bool:
                show()
                stopping = stop.asked
                keeper.keep(now=stopping)
                return not stopping

            finished = training.train(on_update)
            if finished:
                keeper.keep(now=True)
    except LinkError:
        if (folder / CHECKPOINT).exists():
            print(go_on)
        raise
    flown = training.log.env_steps - before
    what = ("trained" if flown else "already trained") if finished else "stopped after"
    print(f"{what} {training.log.env_steps:,} of {training.run.env_steps:,} env steps")
    if flown:
        print(f"{training.log.env_steps / training.log.seconds:,.0f} env steps per second")
    print(f"checkpoint: {folder / CHECKPOINT}" if finished else go_on)
    return 0 if finished else 130


class _Keeper:
    """Stores a training at its first update, then every ten seconds, and when told to."""

    def __init__(self, training: Training, folder: Path) -> None:
        self._training = training
        self._folder = folder
        self._due = 0.0

    def keep(self, *, now: bool) -> None:
        if now or time.monotonic() >= self._due:
            rows = [asdict(episode) for episode in self._training.log.episodes]
            table = pd.DataFrame(rows, columns=[f.name for f in fields(Episode)])
            # First the episodes: a checkpoint takes those that ended before it.
            write_whole(self._folder / EPISODES, table.to_csv(index=False).encode())
            self._training.store(self._folder / CHECKPOINT)
            self._due = time.monotonic() + _STORE_EVERY


def _read_episodes(path: Path, count: int) -> list[Episode]:
    """The first so many episodes. Raises `ValueError`."""
    try:
        table = pd.read_csv(io.BytesIO(path.read_bytes()))
        episodes = [
            Episode(**{str(k): v for k, v in row.items()}) for row in table.to_dict("records")
        ]
        whole = [e.episode for e in episodes[:count]] == list(range(count))
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
    """Ctrl-C and termination ask to stop at the next update; asked again, it stops at once."""
    stop = _Stop()
    before = {number: signal.signal(number, stop.ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class _Stop:
    def __init__(self) -> None:
        self.asked = False

    def ask(self, *_: object) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
        print("stopping at the next update; Ctrl-C again stops now", flush=True)

"""`rotorgram train`: one run with a progress bar, checkpoints, and Ctrl-C that loses nothing."""

import json
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pandas as pd

from ..agents import preset
from ..agents.checkpoints import load, software_versions
from ..agents.episodes import Episode
from ..envs import ElevationConfig
from ..experiments.training import Run, Training
from .inputs import new_folder, parse_changes, remote_env
from .progress import bars

if TYPE_CHECKING:
    from .commands import Train

__all__ = ["train"]

CHECKPOINT: Final = "checkpoint.safetensors"
EPISODES: Final = "episodes.csv"
_STORE_EVERY: Final = 10.0  # s


def train(command: "Train") -> int:
    """Train by the command's settings, or by those of the folder to resume."""
    if command.resume:
        folder = command.resume
        kept = load(folder / CHECKPOINT)
        if kept.algorithm != command.algorithm:
            raise ValueError(
                f"resume: expected a training of {command.algorithm}, "
                f"{folder} holds one of {kept.algorithm}"
            )
        with remote_env(
            ElevationConfig.from_options(kept.env), command.listen, command.insecure
        ) as env:
            before = kept.position.episode
            episodes = [e for e in _read_episodes(folder / EPISODES) if e.episode < before]
            return _train(Training.resume(folder / CHECKPOINT, env, episodes), folder)
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
        folder.mkdir(parents=True)
        _write_config(training, folder)
        return _train(training, folder)


def _train(training: Training, folder: Path) -> int:
    name = f"{training.run.algorithm} seed {training.run.seed}"
    stored = time.monotonic()
    with _stop_at_update() as stop, bars() as progress:

        def on_update() -> bool:
            nonlocal stored
            state = training.progress()
            progress(name, state.env_steps, state.total, state.words())
            if stop() or time.monotonic() - stored > _STORE_EVERY:
                _store(training, folder)
                stored = time.monotonic()
            return not stop()

        finished = training.train(on_update)
        if finished:
            _store(training, folder)
    rate = training.log.env_steps / training.log.seconds
    what = "trained" if finished else "stopped after"
    print(f"{what} {training.log.env_steps:,} env steps, {rate:,.0f} per second")
    print(f"checkpoint: {folder / CHECKPOINT}")
    if not finished:
        print(f"go on with: rotorgram train {training.run.algorithm} --resume {folder}")
        return 130
    return 0


def _store(training: Training, folder: Path) -> None:
    pd.DataFrame([asdict(e) for e in training.log.episodes]).to_csv(folder / EPISODES, index=False)
    training.store(folder / CHECKPOINT)


def _read_episodes(path: Path) -> list[Episode]:
    try:
        rows = pd.read_csv(path).to_dict("records")
        return [Episode(**{str(k): v for k, v in row.items()}) for row in rows]
    except (FileNotFoundError, pd.errors.EmptyDataError):
        return []
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: expected the episodes of a training: {error}") from None


def _write_config(training: Training, folder: Path) -> None:
    kept = training.run
    hello = getattr(training.env, "hello", None)
    content = {
        **asdict(kept),
        "model_hash": hello.model_hash if hello else "",
        "versions": software_versions(),
    }
    (folder / "config.json").write_text(json.dumps(content, indent=2) + "\n")


@contextmanager
def _stop_at_update() -> "Iterator[_Stop]":
    """Ctrl-C asks to stop at the next update; a second one interrupts at once."""
    stop = _Stop()
    before = signal.signal(signal.SIGINT, stop.ask)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, before)


class _Stop:
    def __init__(self) -> None:
        self._asked = False

    def __call__(self) -> bool:
        return self._asked

    def ask(self, *_: object) -> None:
        if self._asked:
            raise KeyboardInterrupt
        self._asked = True

"""`rotorgram train`: one run with a progress bar, checkpoints, and Ctrl-C that loses nothing."""

import csv
import io
import json
import math
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from threading import Timer
from typing import TYPE_CHECKING

from tyro.conf import Positional

from ..agents import (
    AlgorithmName,
    Episode,
    find_algorithm,
    find_preset,
    load,
    preset,
    store,
)
from ..agents.checkpoints import Checkpoint, software_versions, write_whole
from ..flights.folders import locked
from ..models.errors import InputError, require
from ..training.settings import Run
from ._flags import AgentFlags, BackendOfPreset, Options
from ._training import TrainingFlags, folder_to_write

if TYPE_CHECKING:
    from ..training.training import Training

EPISODES = "episodes.csv"
_WIRE = ("env", "vehicle", "listen", "num_simulators", "key_file", "insecure")
_FREE = (*_WIRE, "record", "store_every", "env_steps")
"""Flags that a resumed training may be given."""
_UPDATE_WITHIN = 2.0  # s


@dataclass(frozen=True, kw_only=True)
class Train(AgentFlags, TrainingFlags):
    """Train an agent: the UDP server.

    Starts a simulator process of its own, or waits for one with --listen. Ctrl-C stops at the next
    update with everything written; --resume goes on to the same numbers (sb3-… start anew), or to
    more env steps, by --env-steps.
    """

    algorithm: Positional[AlgorithmName]
    """What learns: docs/algorithms/ has a page on each."""
    backend: BackendOfPreset = "mujoco"
    """What steps the drones: mujoco, or rigid (without contact, fast)."""
    preset_of: str | None = None
    """Id of the task with the preset. Default: the one that is trained, or that it derives from."""
    seed: int = 0
    """Seed of weights, actions and episodes."""
    num_simulators: int = 1
    """With --listen: simulators to wait for, each with its share of the drones."""
    store_every: float = 10.0
    """Seconds between two checkpoints; a resumed training flies again from the last one."""

    def run(self) -> int:
        """Train by these settings, or by those of the folder to resume."""
        require("tensorboard", "train", "training")
        if self.algorithm.startswith("sb3-"):
            require("torch", "train", self.algorithm)
        if not 0 < self.store_every < math.inf:
            raise InputError(f"store-every: expected seconds > 0, got {self.store_every}")
        return self._resume(self.resume) if self.resume else self._begin()

    def _begin(self) -> int:
        from ..training.training import Training, config_of
        from ._env import remote_env

        task = self.preset_of or self.env_id
        base = find_preset(self.algorithm, self.preset, task)
        if not base.fits:
            if self.preset_of:
                raise InputError(
                    f"preset-of: expected a task with a preset of {self.algorithm}, got {task}"
                )
            defaults = base.config == type(base.config)()
            got = "the defaults of its config" if defaults else f"that of {base.env_id}"
            print(
                f"note: there is no preset of {self.algorithm} for {task}, nor for a task that it "
                f"derives from: it gets {got}; --preset-of ID names another",
                flush=True,
            )
        config = preset(self.algorithm, self.preset, task, **self.changes())
        backend = self.backend if "backend" in self.given else base.backend
        env_config = self.env_config(backend=backend)  # it refuses wrong drones
        whole_worlds = max(base.num_envs // self.drones, 1) * self.drones
        run = Run(
            env=env_config,
            algorithm=self.algorithm,
            config=config,
            seed=self.seed,
            env_steps=self.env_steps or base.env_steps,
            num_envs=self.num_envs or whole_worlds,
        )
        opened = remote_env(
            self,
            required=bool(self.options) or "env" in self.given,
            num_envs=run.num_envs,
            num_simulators=self.num_simulators,
            backend=backend,
        )
        name = f"{run.algorithm}-seed{run.seed}"
        with folder_to_write(self.out, name) as folder, opened as env, locked(folder):
            spec = env.env_spec  # of the simulator that came
            if self.listen is not None:
                run = replace(run, env=config_of(spec, backend, self.vehicle))
            training = Training(run, env)
            about = {"vehicle_hash": spec.vehicle_hash, "versions": software_versions()}
            _write_json(folder / "config.json", run.to_dict() | about)
            return self._train(training, folder)

    def _resume(self, folder: Path) -> int:
        from ..training.training import Training, is_finished
        from ._env import CHECKPOINT, fitted, remote_env

        with locked(folder):
            kept = load(folder / CHECKPOINT)
            if kept.algorithm != self.algorithm:
                raise InputError(
                    f"resume: expected a training of {self.algorithm}, "
                    f"{folder} holds one of {kept.algorithm}"
                )
            self.refuse_settings(folder, _FREE)
            if "env" in self.given and self.env_id != kept.env_id:
                raise InputError(f"resume: expected --env {kept.env_id}, got {self.env}")
            if self.env_steps is not None:
                kept = _extended(kept, folder, self.env_steps)
            if is_finished(kept):
                flown = kept.position.env_steps
                print(f"already trained {flown:,} of {kept.env_steps:,} env steps")
                print(f"checkpoint: {folder / CHECKPOINT}")
                return 0
            for name, (then, now) in kept.other_versions().items():
                print(f"note: {name} was {then} and is {now}: the numbers may differ", flush=True)
            opened = remote_env(
                fitted(self, kept),
                num_envs=kept.num_envs,
                num_simulators=self.num_simulators,
                backend=kept.backend,
            )
            with opened as env:
                return self._train(Training.resume(kept, env), folder)

    def _train(self, training: "Training", folder: Path) -> int:
        from ._env import CHECKPOINT
        from ._progress import bars

        if not find_algorithm(self.algorithm).resumes:
            stopped = "it starts anew" if self.resume else "--resume starts it anew"
            print(f"note: {self.algorithm} keeps no state of a training: {stopped}", flush=True)
        go_on = self.go_on_with(f"train {self.algorithm}", folder, *_WIRE)
        keeper = _Keeper(training, folder, self.store_every)
        try:
            with _stop_at_update() as stop_is_asked, bars() as progress:

                def on_update() -> bool:
                    stopping = stop_is_asked()
                    keeper.keep(now=stopping)
                    return not stopping

                name = f"{training.run.algorithm} seed {training.run.seed}"
                finished = training.train(on_update, lambda *now: progress(name, *now))
                if finished:
                    stop_is_asked()
                    keeper.keep(now=True, last=True)
        except BaseException:  # a full disk and SIGTERM too
            with suppress(OSError):
                keeper.close()
            if (folder / CHECKPOINT).exists():
                print(go_on)
            raise
        keeper.close()
        flown = training.log.env_steps
        what = "trained" if finished else "stopped after"
        print(f"{what} {flown:,} of {training.run.env_steps:,} env steps")
        print(f"{flown / training.log.seconds:,.0f} env steps per second")
        print(f"checkpoint: {folder / CHECKPOINT}" if finished else go_on)
        return 0 if finished else 128 + signal.SIGINT


def _extended(kept: Checkpoint, folder: Path, env_steps: int) -> Checkpoint:
    """The checkpoint with more env steps to fly; `config.json` gets their number too."""
    if env_steps < kept.env_steps:
        raise InputError(
            f"env_steps: expected {kept.env_steps} or more, to which {folder} is to be "
            f"trained, got {env_steps}"
        )
    file = folder / "config.json"
    content = json.loads(file.read_text(encoding="utf-8"))
    _write_json(file, {**content, "env_steps": env_steps})
    return replace(kept, env_steps=env_steps)


def _write_json(file: Path, content: Options) -> None:
    write_whole(file, (json.dumps(content, indent=2) + "\n").encode())


class _Keeper:
    """Stores a training at its first update, then every so many seconds, and when told to.

    Numbers for TensorBoard are written by env steps, not by the clock: a training that was resumed
    has them at the same steps as an unbroken one.
    """

    def __init__(self, training: "Training", folder: Path, every: float) -> None:
        from ._scalars import ScalarWriter

        self._training = training
        self._folder = folder
        self._every = every
        self._due = 0.0
        total = training.run.env_steps
        behind = training.log.env_steps
        self._scalars = ScalarWriter(folder / "tensorboard", total, behind=behind)

    def keep(self, *, now: bool, last: bool = False) -> None:
        from ._env import CHECKPOINT

        at = self._training.log.env_steps
        if self._scalars.due(at, last=last):
            self._scalars.write(at, self._training.scalars())
        if now or time.monotonic() >= self._due:
            # First the rest: a checkpoint takes the curves that end before it.
            self._write_episodes()
            self._scalars.flush()
            store(self._training.checkpoint(), self._folder / CHECKPOINT)
            self._due = time.monotonic() + self._every

    def close(self) -> None:
        """Write logs; they may end between two updates."""
        self._write_episodes()
        self._scalars.close()

    def _write_episodes(self) -> None:
        text = io.StringIO()  # pandas would take longer to import than a short training takes
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([field.name for field in fields(Episode)])
        for episode in self._training.log.episodes:
            writer.writerow("" if value != value else value for value in vars(episode).values())
        write_whole(self._folder / EPISODES, text.getvalue().encode())


@contextmanager
def _stop_at_update() -> Iterator[Callable[[], bool]]:
    """Ctrl-C and termination ask to stop at an update: a function that tells there whether to.

    Asked again, or if no update comes soon (no simulator answers), it stops at once.
    """
    asked = False
    # As another Ctrl-C would: it ends a wait for a simulator too.
    timer = Timer(_UPDATE_WITHIN, os.kill, (os.getpid(), signal.SIGINT))
    timer.daemon = True

    def ask(*_: object) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True
        with suppress(OSError):  # standard output may take no more
            print("stopping at the next update; Ctrl-C again stops now", flush=True)
        timer.start()

    def reached() -> bool:
        if asked:  # there is time to write now
            timer.cancel()
        return asked

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield reached
    finally:
        timer.cancel()
        for number, handler in before.items():
            signal.signal(number, handler)

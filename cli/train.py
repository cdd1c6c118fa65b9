"""`rotorgram train`: one run with a progress bar, checkpoints, and Ctrl-C that loses nothing."""

import csv
import io
import json
import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from tyro.conf import Positional, UseAppendAction, arg

from ..agents import (
    NETWORK_FIELDS,
    AlgorithmName,
    Episode,
    find_algorithm,
    find_preset,
    load,
    preset,
    store,
)
from ..agents.checkpoints import Checkpoint, software_versions, write_whole
from ..agents.presets import PresetName
from ..envs.config import EnvConfig
from ..flights.folders import locked
from ..models.errors import InputError, require
from ..training.settings import Run
from ._flags import (
    AgentFlags,
    BackendFlags,
    BackendOfPreset,
    check_count,
    folder_to_write,
    go_on_with,
    named_value,
    refuse_settings,
)

if TYPE_CHECKING:
    from ..training.training import Training

EPISODES: Final = "episodes.csv"
_FREE: Final = ("resume", "listen", "num_simulators", "key_file", "insecure", "record",
                "store_every", "env", "vehicle", "env_steps")  # fmt: skip
"""Flags that a resumed training may be given."""
_UPDATE_WITHIN: Final = 2.0  # s


@dataclass(frozen=True, kw_only=True)
class Train(AgentFlags, BackendFlags):
    """Train an agent: the UDP server.

    Starts a simulator process of its own, or waits for one with --listen. Ctrl-C stops at the next
    update with everything written; --resume goes on to the same numbers (sb3-… start anew).
    """

    algorithm: Positional[AlgorithmName]
    """vpg, a2c, ppo, ippo, mappo, sb3-a2c, sb3-ppo or sb3-sac."""
    preset: PresetName = "tuned"
    """Hyperparameters: the paper's (of vpg and a2c), or ours, which may depend on the task."""
    backend: BackendOfPreset = "mujoco"
    """What steps the drones: mujoco, or rigid (without contact, fast)."""
    preset_of: str | None = None
    """Id of the task with the preset. Default: the one that is trained, or that it derives from."""
    set: UseAppendAction[Annotated[tuple[tuple[str, ...], ...], arg(metavar="NAME=VALUE …")]] = ()
    """Changes to the preset, such as gamma=0.99 steps_per_update=64."""
    seed: int = 0
    """Seed of weights, actions and episodes."""
    env_steps: int | None = None
    """Env steps to train for. Default: those of the preset. With --resume, a larger number
    extends a training; a decreasing learning rate then decreases over all of them."""
    num_envs: int | None = None
    """Drones that fly at the same time, in lock-step. Env steps count all of them. Default: those
    of the preset."""
    num_simulators: int = 1
    """With --listen: simulators to wait for, each with its share of the drones."""
    out: Path | None = None
    """Folder to write to. Default: runs/ALGORITHM-seedSEED-TIME."""
    start_from: Path | None = None
    """Checkpoint, or folder of a training, with whose networks to begin: the next stage of a
    curriculum. Their sizes and the normalisation are the checkpoint's."""
    resume: Path | None = None
    """Folder of a training to go on with; it keeps its settings."""
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

        check_count("drones", self.drones)
        start, told = self._start()
        changes = {name: start.config[name] for name in NETWORK_FIELDS} if start else {}
        changes |= dict(named_value("set", word) for words in self.set for word in words)
        task = self.preset_of or self.env_id
        base = find_preset(self.algorithm, self.preset, task)
        config = preset(self.algorithm, self.preset, task, **changes)
        if not base.fits:
            print(
                f"note: there is no preset of {self.algorithm} for {task}, nor for a task that it "
                f"derives from: it gets that of {base.env_id}; --preset-of ID names another",
                flush=True,
            )
        named: dict[str, Any] = {"num_envs": self.num_envs, "env_steps": self.env_steps}
        named["backend"] = self.backend if "backend" in self.given else None
        chosen = {name: getattr(base, name) if n is None else n for name, n in named.items()}
        if self.num_envs is None:  # whole worlds
            chosen["num_envs"] = max(base.num_envs // self.drones, 1) * self.drones
        backend = chosen.pop("backend")
        env_config = EnvConfig.from_keywords(
            self.env_id, vehicle=self.vehicle, drones=self.drones, backend=backend, **self.options
        )
        run = Run(env=env_config, algorithm=self.algorithm, config=config, seed=self.seed, **chosen)
        required = bool(self.options) or "env" in self.given
        with (
            folder_to_write(self.out, f"{run.algorithm}-seed{run.seed}") as folder,
            self._env(self.env_id, self.options, required=required, num_envs=run.num_envs,
                      drones=self.drones, backend=backend) as env,
            locked(folder),
        ):  # fmt: skip
            spec = env.env_spec  # of the simulator that came
            if self.listen is not None:
                run = replace(run, env=config_of(spec, backend, self.vehicle))
            training = Training(run, env, start=start)
            about = {"vehicle_hash": spec.vehicle_hash, "versions": software_versions()}
            content = json.dumps({**run.to_dict(), **told, **about}, indent=2) + "\n"
            write_whole(folder / "config.json", content.encode())
            return self._train(training, folder)

    def _start(self) -> tuple[Checkpoint | None, dict[str, Any]]:
        """The checkpoint to start from, and what `config.json` has of it."""
        from ._env import CHECKPOINT

        if not (path := self.start_from):
            return None, {}
        file = path / CHECKPOINT if path.is_dir() else path
        kept = load(file)
        checksum = sha256(file.read_bytes()).hexdigest()
        return kept, {"start_from": {"file": str(file), "sha256": checksum}}

    def _resume(self, folder: Path) -> int:
        from ..training.training import Training, is_finished
        from ._env import CHECKPOINT, chosen_vehicle

        with locked(folder):
            kept = load(folder / CHECKPOINT)
            if kept.algorithm != self.algorithm:
                raise InputError(
                    f"resume: expected a training of {self.algorithm}, "
                    f"{folder} holds one of {kept.algorithm}"
                )
            refuse_settings(self, folder, free=("algorithm", *_FREE))
            if "env" in self.given and self.env_id != kept.env_id:
                raise InputError(f"resume: expected --env {kept.env_id}, got {self.env}")
            if self.env_steps is not None:
                kept = self._extended(kept, folder)
            if is_finished(kept):
                flown = kept.position.env_steps
                print(f"already trained {flown:,} of {kept.env_steps:,} env steps")
                print(f"checkpoint: {folder / CHECKPOINT}")
                return 0
            for name, (then, now) in kept.other_versions().items():
                print(f"note: {name} was {then} and is {now}: the numbers may differ", flush=True)
            again = replace(self, vehicle=chosen_vehicle(self, kept))
            with again._env(kept.env_id, kept.options, required=True, num_envs=kept.num_envs,
                            drones=len(kept.spec.agents), backend=kept.backend) as env:  # fmt: skip
                return self._train(Training.resume(kept, env), folder)

    def _extended(self, kept: Checkpoint, folder: Path) -> Checkpoint:
        """The checkpoint with more env steps to fly; `config.json` gets their number too."""
        env_steps = self.env_steps or 0
        if env_steps < kept.env_steps:
            raise InputError(
                f"env_steps: expected {kept.env_steps} or more, to which {folder} is to be "
                f"trained, got {env_steps}"
            )
        file = folder / "config.json"
        content = {**json.loads(file.read_text(encoding="utf-8")), "env_steps": env_steps}
        write_whole(file, (json.dumps(content, indent=2) + "\n").encode())
        return replace(kept, env_steps=env_steps)

    def _env(self, env_id: str, options: dict[str, Any], **settings: Any) -> Any:
        """The env of the training, over the wire."""
        from ._env import remote_env

        return remote_env(self, env_id, options, num_simulators=self.num_simulators, **settings)

    def _train(self, training: "Training", folder: Path) -> int:
        from ._env import CHECKPOINT
        from ._progress import bars

        if not find_algorithm(self.algorithm).resumes:
            stopped = "it starts anew" if self.resume else "--resume starts it anew"
            print(f"note: {self.algorithm} keeps no state of a training: {stopped}", flush=True)
        flags = ("env", "vehicle", "listen", "num_simulators", "key_file", "insecure")
        go_on = go_on_with(self, f"train {self.algorithm}", folder, *flags)
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
    timers = hasattr(signal, "setitimer")

    def set_timer(seconds: float) -> None:
        if timers:
            signal.setitimer(signal.ITIMER_REAL, seconds)

    def ask(*_: object) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True
        with suppress(OSError):  # standard output may take no more
            print("stopping at the next update; Ctrl-C again stops now", flush=True)
        set_timer(_UPDATE_WITHIN)

    def reached() -> bool:
        if asked:  # there is time to write now
            set_timer(0)
        return asked

    numbers = [signal.SIGINT, signal.SIGTERM, *([signal.SIGALRM] if timers else [])]
    before = {number: signal.signal(number, ask) for number in numbers}
    try:
        yield reached
    finally:
        set_timer(0)
        for number, handler in before.items():
            signal.signal(number, handler)

"""What `rotorgram train` does: a training, its folder, and Ctrl-C that loses nothing."""

import csv
import io
import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from threading import Timer
from typing import TYPE_CHECKING

from ..agents import Checkpoint, Episode, find_algorithm, find_preset, load, preset, store
from ..agents.presets import usual_preset
from ..envs.autoreset import AdvancingVectorEnv
from ..envs.config import BackendConfig, EnvConfig
from ..envs.perturbations import for_training
from ..flights.folders import locked
from ..models import Backend, InputError
from ..models.errors import require
from ..models.files import other_versions, software_versions, write_json, write_whole
from ..training.settings import Run
from ..training.training import Training, config_of, is_finished
from ._env import CHECKPOINT, fitted, local_env, remote_env
from ._flags import DEFAULT_ENV
from ._mavlink import mavlink_out
from ._progress import bars
from ._scalars import ScalarWriter
from ._training import flags_of, folder_to_write

if TYPE_CHECKING:
    from .train import Train

EPISODES = "episodes.csv"
_WIRE = ("env", "vehicle", "udp", "listen", "num_simulators", "key_file", "insecure")
_FREE = (*_WIRE, "record", "mavlink", "store_every", "env_steps")
"""Flags that a resumed training may be given."""
_IMPLY_UDP = ("listen", "num_simulators", "key_file", "insecure", "record")
_OF_THE_PAPER = ("vpg", "a2c", "sb3-a2c")
"""Over UDP on the paper's task."""
_UPDATE_WITHIN = 2.0  # s


def begin(command: "Train") -> int:
    """A new training; the exit status."""
    # Packages that are missing are named before it trains, or waits.
    require("safetensors", "train", "writing checkpoints")
    _ = find_algorithm(command.algorithm).agent
    task = command.preset_of or command.env_id
    name = command.preset or usual_preset(command.algorithm, task)
    if command.listen is not None and name == "robust":
        if command.preset:
            raise InputError("preset: expected tuned with --listen: the simulator has the env")
        name = "tuned"
    base = find_preset(command.algorithm, name, task)
    if not base.fits:
        if command.preset_of:
            raise InputError(
                f"preset-of: expected a task with a preset of {command.algorithm}, got {task}"
            )
        defaults = base.config == type(base.config)()
        got = "the defaults of its config" if defaults else f"that of {base.env_id}"
        print(
            f"note: there is no preset of {command.algorithm} for {task}, nor for a task that it "
            f"derives from: it gets {got}; --preset-of ID names another"
        )
    config = preset(command.algorithm, name, task, **command.changes())
    backend = command.backend or base.backend
    flown = command.env_config(backend=backend)  # it refuses wrong drones
    chosen = "episode_length" in command.options or command.listen is not None
    if base.episode_length and not chosen:
        flown = flown.changed(episode_length=base.episode_length)
        command = replace(command, options=flown.flat_options())
        print(f"note: preset {name}: episodes of {base.episode_length} control steps")
    if base.perturbations:
        flown, refused = for_training(flown, base.perturbations)
        for perturbation, sentence in refused.items():
            print(f"note: preset robust: not drawn: {perturbation}: {sentence}")
        command = replace(command, options=flown.flat_options())
    run = Run(
        env=flown,
        algorithm=command.algorithm,
        config=config,
        seed=command.seed,
        env_steps=command.env_steps or base.env_steps,
        num_envs=command.num_envs or base.whole_worlds(command.drones),
    )
    required = bool(command.options) or "env" in command.given
    opened = _opened(command, run.num_envs, backend, required=required)
    folder_name = f"{run.algorithm}-seed{run.seed}"
    with folder_to_write(command.out, folder_name) as folder, opened as env, locked(folder):
        spec = env.env_spec  # of the simulator that came
        if command.listen is not None:
            run = replace(run, env=config_of(spec, backend, command.vehicle))
        training = Training(run, env)
        about = {"vehicle_hash": spec.vehicle_hash, "versions": software_versions()}
        write_json(folder / "config.json", run.to_dict() | about)
        return _train(command, training, folder)


def resume(command: "Train", folder: Path) -> int:
    """The training of a folder; the exit status."""
    with locked(folder):
        kept = load(folder / CHECKPOINT)
        if kept.algorithm != command.algorithm:
            raise InputError(
                f"resume: expected a training of {command.algorithm}, "
                f"{folder} holds one of {kept.algorithm}"
            )
        command.refuse_settings(folder, _FREE)
        if "env" in command.given and command.env_id != kept.env_id:
            raise InputError(f"resume: expected --env {kept.env_id}, got {command.env}")
        if command.env_steps is not None:
            kept = _extended(kept, folder, command.env_steps)
        if is_finished(kept):
            print(f"already trained {kept.position.env_steps:,} of {kept.env_steps:,} env steps")
            print(f"checkpoint: {folder / CHECKPOINT}")
            return 0
        for name, (then, now) in other_versions(kept.versions).items():
            if name in kept.versions:
                print(f"note: {name} was {then} and is {now}: the numbers may differ")
        backend = kept.env.backend if kept.env else kept.backend
        with _opened(fitted(command, kept), kept.num_envs, backend) as env:
            return _train(command, Training.resume(kept, env), folder)


def _opened(
    command: "Train",
    num_envs: int,
    backend: Backend | BackendConfig | None,
    *,
    required: bool = True,
) -> AbstractContextManager[AdvancingVectorEnv]:
    """The env of a training, in this process or over UDP."""
    of_paper = command.algorithm in _OF_THE_PAPER and command.env_id == DEFAULT_ENV
    implied = sorted(command.given.intersection(_IMPLY_UDP))
    by_wire = command.udp if "udp" in command.given else of_paper or bool(implied)
    if implied and not by_wire:
        raise InputError(
            f"udp: expected --no-udp without flags of the wire, got {flags_of(implied)}"
        )
    if by_wire:
        return remote_env(
            command,
            required=required,
            num_envs=num_envs,
            num_simulators=command.num_simulators,
            backend=backend,
        )
    return local_env(command, num_envs, backend)


def _train(command: "Train", training: Training, folder: Path) -> int:
    if not find_algorithm(command.algorithm).resumes:
        stopped = "it starts anew" if command.resume else "--resume starts it anew"
        print(f"note: {command.algorithm} keeps no state of a training: {stopped}")
    if command.listen is None:
        _note_lag(training.run.env)
    go_on = command.go_on_with(f"train {command.algorithm}", folder, *_WIRE)
    keeper = _Keeper(training, folder, command.store_every)
    try:
        env = training.env
        shown = mavlink_out(command, env.env_spec)
        with _stop_at_update() as stop_is_asked, bars() as progress, shown as env.observer:

            def on_update() -> bool:
                stopping = stop_is_asked()
                keeper.keep(now=bool(stopping))
                return not stopping

            name = f"{training.run.algorithm} seed {training.run.seed}"
            finished = training.train(on_update, lambda *now: progress(name, *now))
            if finished:
                stop_is_asked()
                keeper.keep(now=True, last=True)
    except BaseException:  # a full disk and SIGTERM too
        with suppress(OSError):
            keeper.write_episodes()
            keeper.scalars.close()
        if (folder / CHECKPOINT).exists():
            print(go_on)
        raise
    keeper.scalars.close()
    flown = training.log.env_steps
    what = "trained" if finished else "stopped after"
    print(f"{what} {flown:,} of {training.run.env_steps:,} env steps")
    print(f"{flown / training.log.seconds:,.0f} env steps per second")
    print(f"checkpoint: {folder / CHECKPOINT}" if finished else go_on)
    return 0 if finished else 128 + stop_is_asked()


def _note_lag(env: EnvConfig) -> None:
    """Tell if the vehicle's rotors lag, and those of the training do not."""
    vehicle = env.load_vehicle()
    lag = vehicle.coefficients["rotors.time_constant"]
    if lag and not env.effects.motor_lag:
        print(
            f"note: the rotors of {vehicle.name} follow with a time constant of {lag:g} s, "
            "those of this training at once: --effects motor_lag trains for the craft itself"
        )


def _extended(kept: Checkpoint, folder: Path, env_steps: int) -> Checkpoint:
    """The checkpoint with more env steps to fly; `config.json` gets their number too."""
    if env_steps < kept.env_steps:
        raise InputError(
            f"env_steps: expected {kept.env_steps} or more, to which {folder} is to be "
            f"trained, got {env_steps}"
        )
    file = folder / "config.json"
    content = json.loads(file.read_text(encoding="utf-8"))
    write_json(file, {**content, "env_steps": env_steps})
    return replace(kept, env_steps=env_steps)


@dataclass
class _Keeper:
    """Stores a training at its first update, then every so many seconds, and when told to.

    Numbers for TensorBoard are written by env steps, not by the clock: a training that was resumed
    has them at the same steps as an unbroken one.
    """

    training: Training
    folder: Path
    every: float
    due: float = 0.0
    """When it is stored next, by the monotonic clock, s."""

    def __post_init__(self) -> None:
        training = self.training
        self.scalars = ScalarWriter(
            self.folder / "tensorboard", training.run.env_steps, behind=training.log.env_steps
        )

    def keep(self, *, now: bool, last: bool = False) -> None:
        at = self.training.log.env_steps
        if self.scalars.due(at, last=last):
            self.scalars.write(at, self.training.scalars())
        if now or time.monotonic() >= self.due:
            # First the rest: a checkpoint takes the curves that end before it.
            self.write_episodes()
            self.scalars.flush()
            store(self.training.checkpoint(), self.folder / CHECKPOINT)
            self.due = time.monotonic() + self.every

    def write_episodes(self) -> None:
        """Write all episodes that have ended; the last may end between two updates."""
        text = io.StringIO()  # pandas would take longer to import than a short training takes
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([field.name for field in fields(Episode)])
        for episode in self.training.log.episodes:
            writer.writerow("" if value != value else value for value in vars(episode).values())
        write_whole(self.folder / EPISODES, text.getvalue().encode())


@contextmanager
def _stop_at_update() -> Iterator[Callable[[], int]]:
    """Ctrl-C and termination ask to stop at an update: a function that tells there by which signal.

    Asked again, or if no update comes soon (no simulator answers), it stops at once.
    """
    asked = 0
    # As another Ctrl-C would: it ends a wait for a simulator too.
    timer = Timer(_UPDATE_WITHIN, os.kill, (os.getpid(), signal.SIGINT))
    timer.daemon = True

    def ask(number: int, _: object) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = number
        with suppress(OSError):  # standard output may take no more
            print("stopping at the next update; Ctrl-C again stops now")
        timer.start()

    def reached() -> int:
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

"""Flags of commands that train, the folder that they write, and resuming."""

import shlex
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import chain
from pathlib import Path

from ..agents.presets import PresetName
from ..flights.folders import LOCK, new_folder
from ..models import InputError
from ._flags import Count, EnvFlags, NamedValues, Options, Words, parse_value


class TrainingFlags(EnvFlags):
    """A command that trains."""

    set: NamedValues = ()
    """Changes to the preset of every agent: gamma=0.99 hidden=[64,64]."""
    preset: PresetName | None = None
    """Hyperparameters: the paper's (of vpg and a2c), tuned ones, which may depend on the task, or
    robust ones, which draw starts, craft and air anew in each episode. Default: robust of train
    where the task has it, tuned elsewhere."""
    env_steps: Count | None = None
    """Env steps of each training, of all its drones together. Default of train: the preset's."""
    num_envs: Count | None = None
    """Drones that fly at the same time, in lock-step, in each training. Default of train: the
    preset's, in whole worlds."""
    out: Path | None = None
    """Folder to write; it must not exist. Default: one in runs, named by the command and the time.
    """
    resume: Path | None = None
    """Folder of an interrupted command to go on with; it keeps its settings."""

    def changes(self) -> Options:
        """Changes to the preset by name, of `--set`. Raises `InputError`."""
        changes = {}
        for word in chain.from_iterable(self.set):
            name, equals, value = word.partition("=")
            if not equals:
                raise InputError(f"set: expected NAME=VALUE, got {word!r}")
            changes[name] = parse_value(value)
        return changes

    def refuse_settings(self, folder: Path, free: Words) -> None:
        """Raises `InputError` if a setting but the free ones was given: a resumed run keeps its
        own.
        """
        names = sorted(self.given.difference(free, ("algorithm", "resume")))
        if names:
            raise InputError(
                f"resume: expected the settings of {folder}, got others by {flags_of(names)}"
            )

    def go_on_with(self, words: str, folder: Path, *flags: str) -> str:
        """The line that tells how to resume, with those of the flags that were given."""
        line: list[object] = ["rotorgram", *words.split(), "--resume", folder]
        for flag in flags:
            if flag not in self.given:
                continue
            name = flag.replace("_", "-")
            value = getattr(self, flag)
            if isinstance(value, bool):
                line.append(f"--{name}" if value else f"--no-{name}")
            else:
                line += [f"--{name}", value]
        return f"go on with: {shlex.join(map(str, line))}"


def flags_of(names: Iterable[str]) -> str:
    """The flags of some fields, as they are typed."""
    return ", ".join(f"--{name.replace('_', '-')}" for name in names)


@contextmanager
def folder_to_write(out: Path | None, name: str) -> Iterator[Path]:
    """A new folder, by default named by the time; removed if the block fails before it writes."""
    folder = new_folder(out, name)
    try:
        yield folder
    except BaseException:
        with suppress(OSError):  # it holds something
            if {file.name for file in folder.iterdir()} == {LOCK}:
                (folder / LOCK).unlink()
            folder.rmdir()
        raise

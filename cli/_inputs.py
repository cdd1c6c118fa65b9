"""Checks of flags: addresses, counts, folders, and the settings that a resumed run keeps."""

import shlex
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ..models.errors import InputError
from ._flags import Command


def parse_address(text: str) -> tuple[str, int]:
    """HOST:PORT as a pair. Raises `InputError`."""
    host, _, port = text.rpartition(":")
    if not (host and port.isascii() and port.isdecimal() and int(port) <= 65535):
        raise InputError(f"address: expected HOST:PORT with a port up to 65535, got {text!r}")
    return host, int(port)


def check_count(name: str, value: int | None) -> None:
    """Raises `InputError` for a number that is given and less than 1."""
    if value is not None and value < 1:
        raise InputError(f"{name}: expected at least 1, got {value}")


@contextmanager
def folder_to_write(out: Path | None, name: str) -> Iterator[Path]:
    """A new folder for the block, by default named by the time. A block that fails before it has
    written anything leaves none. Raises `InputError` if `out` exists.
    """
    from ..experiments.folders import new_folder

    folder = new_folder(out, name)
    try:
        yield folder
    except BaseException:
        with suppress(OSError):  # it holds something
            folder.rmdir()
        raise


def refuse_settings(command: Command, folder: Path, *, free: tuple[str, ...]) -> None:
    """Raises `InputError` if a setting but the free ones was given, if only its default: the run in
    the folder that the command resumes keeps its own.
    """
    if changed := sorted(name for name in command.given if name not in free):
        flags = ", ".join("--" + name.replace("_", "-") for name in changed)
        raise InputError(f"resume: expected the settings of {folder}, got others by {flags}")


def go_on_with(command: Command, words: str, folder: Path, *flags: str) -> str:
    """The line that tells how to resume: of the flags those that were given."""
    line: list[Any] = ["rotorgram", *words.split(), "--resume", folder]
    for flag in flags:
        if flag in command.given:
            value = getattr(command, flag)
            line += [f"--{flag.replace('_', '-')}", *([] if value is True else [value])]
    return f"go on with: {shlex.join(map(str, line))}"

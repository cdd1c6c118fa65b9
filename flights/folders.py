"""Folders of runs: made by one process, written by one process."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from itertools import count
from pathlib import Path

from ..models import InputError

LOCK = ".lock"
"""File in a folder that its writer holds locked."""


def new_folder(out: Path | None, name: str, runs: Path = Path("runs")) -> Path:
    """Make the folder to write to: `out`, or one in `runs`, named by the command and the time; if
    that name is taken, `-2`, `-3`… is added.

    Raises `InputError` if `out` exists, or the place allows no folder.
    """
    stem = f"{name}-{datetime.now():%Y%m%d-%H%M%S}"
    for number in count(1):
        folder = out or runs / (stem if number == 1 else f"{stem}-{number}")
        try:
            folder.parent.mkdir(parents=True, exist_ok=True)
            folder.mkdir()  # atomic: of two processes one succeeds
            break
        except OSError as error:
            if not (isinstance(error, FileExistsError) and Path(error.filename) == folder):
                words = f"out: cannot make {error.filename}: {error.strerror}"
                raise InputError(words) from None
            if out:
                raise InputError(f"out: expected a new folder, {out} exists already") from None
    return folder


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold a folder's lock, a file in it that stays; the lock ends with its process.

    Raises `InputError` if another process holds it, or it cannot be written.
    """
    try:
        file = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except FileNotFoundError:
        raise InputError(f"{folder}: expected a folder, there is none") from None
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from None
    try:
        if not _try_lock(file):
            raise InputError(f"{folder}: expected a folder that no other process writes to")
        yield
    finally:
        os.close(file)


def _try_lock(file: int) -> bool:
    try:
        if os.name == "nt":
            import msvcrt

            msvcrt.locking(file, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True

"""Folders of runs: made by one process, written by one process."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Final

from ..models.errors import InputError

__all__ = ["LOCK_FILE", "locked", "new_folder"]

LOCK_FILE: Final = ".lock"
"""Its holder writes to the folder. The file stays; the lock ends with its process."""


def new_folder(out: Path | None, name: str, runs: Path = Path("runs")) -> Path:
    """Make the folder to write to.

    Args:
        out: Where; None: a folder named by the time. Of two processes that ask for one of the same
            second, the second gets a number behind it.
        name: Of the command; part of the folder's name.
        runs: Where folders named by the time are made.

    Raises:
        InputError: `out` exists, or the place allows no folder.
    """
    if out is not None:
        _make(out)
        return out
    stem, number = f"{name}-{datetime.now():%Y%m%d-%H%M%S}", 1
    while True:
        folder = runs / (stem if number == 1 else f"{stem}-{number}")
        if not folder.exists():
            try:
                _make(folder)
            except _Exists:
                pass
            else:
                return folder
        number += 1


class _Exists(InputError):
    pass


def _make(folder: Path) -> None:
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"out: cannot make {folder.parent}: {error.strerror}") from None
    try:
        folder.mkdir()  # atomic: of two processes one succeeds
    except FileExistsError:
        raise _Exists(f"out: expected a new folder, {folder} exists already") from None
    except OSError as error:
        raise InputError(f"out: cannot make {folder}: {error.strerror}") from None


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold a folder's lock; a crash releases it.

    Raises:
        InputError: Another process holds it, or the folder cannot be written.
    """
    try:
        file = os.open(folder / LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
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

"""Folders of runs: made by one process, written by one process."""

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from itertools import count
from pathlib import Path

from ..models import InputError

LOCK = ".lock"
"""File in a folder that its writer holds locked."""


def new_folder(out: Path | None, name: str) -> Path:
    """Make the folder to write to: `out`, or one in the folder `runs` here, named by the command
    and the time; if that name is taken, `-2`, `-3`… is added.

    Raises `InputError` if `out` exists, or the place allows no folder.
    """
    stem = f"{name}-{datetime.now():%Y%m%d-%H%M%S}"
    for number in count(1):
        folder = out or Path("runs") / (stem if number == 1 else f"{stem}-{number}")
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
    import fcntl  # of Unix

    try:
        file = (folder / LOCK).open("ab")
    except FileNotFoundError:
        raise InputError(f"{folder}: expected a folder, there is none") from None
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputError(
                f"{folder}: expected a folder that no other process writes to"
            ) from None
        yield

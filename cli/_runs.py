"""What commands of many runs have in common: who flies them, and how to go on with them."""

import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from ..experiments.progress import OnProgress
from .progress import bars

if TYPE_CHECKING:
    from .training import RunsCommand

__all__ = ["WORKERS", "command_line", "showing", "workers"]

WORKERS: Final = ("jobs", "backend", "address")
"""Flags that change no number: whoever resumes may set them anew."""


def workers(command: "RunsCommand") -> dict[str, Any]:
    """What the flags say of who flies: fields of `WorkersConfig`."""
    return {name: getattr(command, name) for name in WORKERS}


def command_line() -> str:
    """What the user typed."""
    return shlex.join(["rotorgram", *sys.argv[1:]])


@contextmanager
def showing(name: str, command: "RunsCommand", folder: Path) -> Iterator[OnProgress]:
    """What shows the progress of runs; of runs that did not all end well, how to go on with them.

    Args:
        name: Of the command that flies them.
        command: Says where.
        folder: That the runs write to.
    """
    try:
        with bars() as progress:
            yield progress
    except BaseException:
        where = f" --backend {command.backend}" if command.backend != "loky" else ""
        where += f" --address {command.address}" if command.address else ""
        if folder.exists():
            print(f"go on with: rotorgram {name} --resume {folder}{where}")
        raise

"""New files, whole or not at all. Imports the standard library alone."""

from contextlib import suppress
from pathlib import Path


def write_new(path: Path, text: str) -> None:
    """Write a new file in UTF-8. Raises `OSError`, which names it; then it is not there."""
    file = path.open("xb")
    try:
        with file:
            file.write(text.encode())
    except BaseException as error:
        with suppress(OSError):
            path.unlink()
        if isinstance(error, OSError):
            raise OSError(error.errno, error.strerror, str(path)) from None
        raise

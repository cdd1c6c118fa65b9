"""New files, whole or not at all. Imports the standard library alone."""

from contextlib import suppress
from pathlib import Path

from .errors import InputError


def write_new(path: Path, content: str | bytes) -> None:
    """Write a new file, a text in UTF-8. Raises `OSError`, which names it; then it is not there."""
    file = path.open("xb")
    try:
        with file:
            file.write(content.encode() if isinstance(content, str) else content)
    except BaseException as error:
        with suppress(OSError):
            path.unlink()
        if isinstance(error, OSError):
            raise OSError(error.errno, error.strerror, str(path)) from None
        raise


def check_new_file(out: Path, *endings: str) -> None:
    """Raises `InputError` unless it is the name of a new file with one of these endings."""
    if out.suffix.lower() not in endings:
        raise InputError(f"out: expected a file that ends in {' or '.join(endings)}, got {out}")
    if out.exists():
        raise InputError(f"out: expected the name of a new file, got {out}, which exists")
    if not out.absolute().parent.is_dir():
        raise InputError(f"out: expected a folder that exists for it, got {out}")

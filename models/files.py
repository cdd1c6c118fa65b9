"""TOML files, new files, files of packages, and the versions of software that files note.

Imports the standard library alone.
"""

import json
import os
import platform
import shutil
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

from .errors import InputError

MAX_BYTES = 1_000_000
"""Largest size of a TOML file, which is read within a few seconds."""


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """Tables of a TOML file.

    Raises `InputError`, whose sentence begins with `what`, or `OSError` where it cannot be read.
    """
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise InputError(f"{what}: expected a TOML file of at most {MAX_BYTES} bytes, got {size}")
    return parse_toml(path.read_bytes(), what, path.name)


def parse_toml(content: str | bytes, what: str, name: str = "a text") -> dict[str, Any]:
    """Tables of the content of a TOML file. Raises `InputError`, as `read_toml`."""
    try:
        return tomllib.loads(content if isinstance(content, str) else content.decode())
    except RecursionError:
        reason = "tables or lists, too many in each other"
    except ValueError as error:
        reason = str(error)
    raise InputError(f"{what}: expected a TOML file, got {name}: {reason}")


def read_own_toml(module: str, name: str) -> dict[str, Any]:
    """Tables of a file of ours beside a module: `read_own_toml(__file__, "rules")`."""
    return read_toml(Path(module).parent / f"{name}.toml", name)


@contextmanager
def removed_on_error(path: Path, target: Path | None = None) -> Iterator[None]:
    """Remove half a file or folder after an error.

    An `OSError` names the target if there is one, else this path unless it names another file.
    """
    try:
        yield
    except BaseException as error:
        with suppress(OSError):
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
        if isinstance(error, OSError) and (target or not error.filename):
            reason = error.strerror or str(error)
            raise OSError(error.errno, reason, str(target or path)) from None
        raise


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file, a text in UTF-8.

    After a crash at any moment, `path` holds the old one or the new one. Two processes may write it
    at the same time. `OSError` names the file.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{os.urandom(4).hex()}.tmp")
    with removed_on_error(temporary, path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(temporary, "xb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)


def write_json(path: Path, content: object) -> None:
    """Write a value as JSON, as `write_whole`."""
    write_whole(path, json.dumps(content, indent=2) + "\n")


def check_new_file(out: Path, *endings: str) -> None:
    """Raises `InputError` unless it is the name of a new file with one of these endings."""
    if out.suffix.lower() not in endings:
        raise InputError(f"out: expected a file that ends in {' or '.join(endings)}, got {out}")
    if out.exists():
        raise InputError(f"out: expected the name of a new file, got {out}, which exists")
    if not out.absolute().parent.is_dir():
        raise InputError(f"out: expected a folder that exists for it, got {out}")


def find_in_package(name: str, folder: Path) -> Path | None:
    """The file of "package://PACKAGE/FILE" in a folder or above it, with PACKAGE or without."""
    inside = Path(name.removeprefix("package:").lstrip("/"))
    ways = (inside, Path(*inside.parts[1:]))
    places = (up / way for up in (folder, *folder.parents) for way in ways)
    return next((place for place in places if place.is_file()), None)


@cache
def software_versions() -> dict[str, str]:
    """Versions of the installed packages that the numbers depend on."""
    from importlib.metadata import PackageNotFoundError, version  # slow to import

    versions = {"python": platform.python_version()}
    for name in ("rotorgram", "mujoco", "gymnasium", "numpy", "torch", "stable-baselines3"):
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    return versions


def other_versions(then: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """Software that has another version now: its version then and now, "none" where it is not."""
    now = software_versions()
    pairs = {name: (then.get(name, "none"), now.get(name, "none")) for name in {**then, **now}}
    return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}

"""Vehicles' files as content: a config carries them to where the files themselves are not."""

import base64
import os
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory

import mujoco

from .errors import InputError, shortened
from .library import find_vehicle
from .mjcf import asset_files, read_spec
from .vehicle_file import model_of

MAX_BYTES = 1 << 26
"""Largest size of all files of a vehicle."""

Bundle = tuple[tuple[str, str], ...]
"""Pairs of a relative path with slashes and a file's bytes in base64; the vehicle's own first."""


def read_bundle(vehicle: Path | str) -> Bundle:
    """A vehicle's file, and all files that it names by relative paths. Raises `InputError`."""
    path = find_vehicle(vehicle)
    try:
        files = list(dict.fromkeys([path, *_with_assets(path)]))
        size = sum(file.stat().st_size for file in files)
        if size > MAX_BYTES:
            raise InputError(f"vehicle: expected files of at most {MAX_BYTES} bytes, got {size}")
        contents = [base64.b64encode(file.read_bytes()).decode() for file in files]
    except OSError as error:
        raise InputError(f"vehicle: cannot read {vehicle}: {error.strerror}") from None
    # The name of its folder may be the vehicle's.
    root = Path(os.path.commonpath([file.parent for file in files])).parent
    names = [file.relative_to(root).as_posix() for file in files]
    return tuple(zip(names, contents, strict=True))


def checked_bundles(given: Mapping[str, Bundle]) -> dict[str, Bundle]:
    """Bundles of JSON, or of a config. Raises `InputError`."""
    try:
        bundles = {word: tuple(map(_checked, pairs)) for word, pairs in given.items()}
    except (AttributeError, TypeError, ValueError):
        bundles = {"": ()}
    if not all(bundles.values()):
        raise InputError(
            "files: expected relative paths and contents in base64 of each vehicle, "
            f"got {shortened(given)}"
        )
    return bundles


def unpacked(vehicle: str, bundle: Bundle) -> Path:
    """Path of a vehicle with these files: its own path if it has the same files today."""
    try:
        if read_bundle(vehicle) == bundle:
            return Path(vehicle)
    except InputError:
        pass  # it is missing here, or has changed
    return Path(written(bundle).name, bundle[0][0])


@lru_cache(maxsize=32)
def written(bundle: Bundle) -> TemporaryDirectory[str]:
    """A folder with the files, as long as this process needs it."""
    folder = TemporaryDirectory(prefix="rotorgram-", ignore_cleanup_errors=True)
    for name, content in bundle:
        path = Path(folder.name, name)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(base64.b64decode(content))
    return folder


def _checked(pair: tuple[str, str]) -> tuple[str, str]:
    """A relative path that stays in its folder, on every system, and base64. Raises `ValueError`
    or `TypeError` for another pair.
    """
    name, content = pair
    path = PurePosixPath(name)
    base64.b64decode(content, validate=True)
    leaves = path.is_absolute() or ".." in path.parts or not {"\\", ":", "\0"}.isdisjoint(name)
    if leaves or not path.parts:
        raise ValueError
    return name, content


def _with_assets(vehicle: Path) -> list[Path]:
    """The MJCF or URDF file of a vehicle, and the files that it names and that are there.

    Absolute paths are left out: they are the same elsewhere, or MuJoCo names them there.
    """
    model = model_of(vehicle)
    try:
        if model.suffix.lower() == ".urdf":
            return [model, *asset_files(read_spec(vehicle), model.parent)]
        names = mujoco.mju_getXMLDependencies(os.path.relpath(model))
    except (ValueError, mujoco.FatalError):  # the reader of the model says what is wrong
        return [model]
    # Without `..`, and with links as they are: the files keep their places to each other.
    files = [Path(os.path.abspath(name)) for name in sorted(names) if not os.path.isabs(name)]
    return [file for file in files if file.is_file()]

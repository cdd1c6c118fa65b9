"""Vehicles' files as content: a config carries them to where the files themselves are not."""

import base64
import os
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory

import mujoco

from .errors import InputError, shortened
from .files import find_in_package
from .library import find_vehicle
from .mjcf import read_xml
from .vehicle_file import model_of

MAX_BYTES = 1 << 26
"""Largest size of all files of a vehicle."""

Bundle = tuple[tuple[str, str], ...]
"""Pairs of a relative path with slashes and a file's bytes in base64; the vehicle's own first."""


def read_bundle(vehicle: Path | str) -> Bundle:
    """A vehicle's file, and all files that it names by relative paths. Raises `InputError`."""
    path = find_vehicle(vehicle)
    try:
        files = list(dict.fromkeys([path, *_with_assets(model_of(path))]))
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


def checked_bundles(given: object) -> dict[str, Bundle]:
    """Bundles of JSON, or of a config. Raises `InputError`."""
    if not isinstance(given, Mapping):
        raise InputError(f"files: expected those of each vehicle, got {shortened(given)}")
    return {str(word): _checked(pairs) for word, pairs in given.items()}


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


def _checked(given: object) -> Bundle:
    if not isinstance(given, list | tuple) or not given:
        raise InputError(f"files: expected a list of paths and contents, got {shortened(given)}")
    for pair in given:
        if not _is_file(pair):
            raise InputError(f"files: expected a relative path and base64, got {shortened(pair)}")
    return tuple((name, content) for name, content in given)


def _is_file(pair: object) -> bool:
    """Whether it is base64 behind a relative path that stays in its folder, on every system."""
    if not isinstance(pair, list | tuple):
        return False
    try:
        name, content = pair
        path = PurePosixPath(name)
        base64.b64decode(content, validate=True)
    except (TypeError, ValueError):
        return False
    inside = bool(path.parts) and not path.is_absolute() and ".." not in path.parts
    return inside and not {"\\", ":", "\0"} & set(name)


def _with_assets(model: Path) -> list[Path]:
    """An MJCF or URDF file, and the files that it names and that are there.

    Absolute paths are left out: they are the same elsewhere, or MuJoCo names them there.
    """
    if model.suffix.lower() == ".urdf":
        return [model, *_meshes(model)]
    try:
        names = mujoco.mju_getXMLDependencies(os.path.relpath(model))
    except mujoco.FatalError:  # MuJoCo says what is wrong when it reads the model
        return [model]
    # Without `..`, and with links as they are: the files keep their places to each other.
    files = [Path(os.path.abspath(name)) for name in sorted(names) if not os.path.isabs(name)]
    return [file for file in files if file.is_file()]


def _meshes(urdf: Path) -> Iterator[Path]:
    """The meshes of a URDF file, by the rules of MuJoCo and of URDF's packages."""
    elements = list(read_xml(urdf).iter())
    folders = [urdf.parent / element.get("meshdir", "") for element in elements]
    for name in filter(None, (element.get("filename") for element in elements)):
        if name.startswith("package://"):
            found = [find_in_package(name, urdf.parent)]
        else:  # MuJoCo strips the folders
            found = [folder / way for folder in folders for way in (name, Path(name).name)]
        for file in found:
            if file is not None and file.is_file() and not os.path.isabs(name):
                yield Path(os.path.abspath(file))
                break

"""Vehicles' files as content: a config carries them to where the files themselves are not."""

import base64
import os
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

from .errors import InputError, shortened
from .files import find_in_package
from .library import find_vehicle
from .mjcf import read_xml
from .vehicle_file import model_of

MAX_BYTES = 1 << 26
"""Largest size of all files of a vehicle."""
_DIRECTORIES = ("meshdir", "texturedir", "assetdir")

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
    return Path(_written(bundle).name, bundle[0][0])


@lru_cache(maxsize=32)
def _written(bundle: Bundle) -> TemporaryDirectory[str]:
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


def _is_file(pair: Any) -> bool:
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
    """An MJCF or URDF file, what it includes, and its meshes, height fields and textures.

    Absolute paths are left out: they are the same elsewhere, or MuJoCo names them there.
    """
    folder = model.parent
    parts = [model]
    elements = list(read_xml(model).iter())
    for element in elements:
        inner = _normal(folder / element.get("file", ""))
        if element.tag in ("include", "model") and inner.is_file() and inner not in parts:
            parts.append(inner)
            elements += read_xml(inner).iter()
    folders = [folder]
    for element in elements:
        folders += [folder / element.get(name, "") for name in _DIRECTORIES]
    for element in elements:
        for name, text in element.items():
            if name.startswith("file") and text and not Path(text).is_absolute():
                parts += _found(text, folders)
    return parts


def _found(text: str, folders: Sequence[Path]) -> list[Path]:
    """The file of an asset, by the rules of MuJoCo and of URDF's packages; or none."""
    if text.startswith("package://"):
        file = find_in_package(text, folders[0])
        return [] if file is None else [_normal(file)]
    ways = [text, Path(text).name]  # MuJoCo strips the folders of a URDF file
    candidates = [_normal(folder / way) for folder in folders for way in ways]
    return [path for path in candidates if path.is_file()][:1]


def _normal(path: Path) -> Path:
    """Without `..`, and with links as they are: the files keep their places to each other."""
    return Path(os.path.normpath(path))

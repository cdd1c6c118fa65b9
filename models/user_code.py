"""A class in a user's own file, `FILE.py:CLASS`.

Names come from a command line or a study's file, which are the user's own. A name of a checkpoint,
a journal or a peer never comes here.
"""

import sys
import traceback
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

from .errors import InputError, one_line


def names_class(words: str) -> bool:
    """Whether words name a class in a file, rather than something that is known by its name."""
    file, _, name = words.rpartition(":")
    return name.endswith(".py") or (file.endswith(".py") and name.isidentifier())


def load_class(option: str, words: str) -> type:
    """The class that `FILE.py:CLASS` names. The file is run once.

    Raises `InputError`, whose sentence begins with the option: there is no such file or class, or
    the file fails.
    """
    file, _, name = words.rpartition(":")
    if not file.endswith(".py"):
        raise InputError(f"{option}: expected FILE.py:CLASS, got {words}")
    if not Path(file).is_file():
        raise InputError(f"{option}: expected a file of Python, got none: {Path(file).absolute()}")
    kind = getattr(_module(option, Path(file).resolve()), name, None)
    if not isinstance(kind, type):
        raise InputError(f"{option}: expected a class of {file}, got {name!r}")
    return kind


def _module(option: str, path: Path) -> ModuleType:
    """The module of a file, under its path, for several folders may have files of one name."""
    key = str(path)
    if key in sys.modules:
        return sys.modules[key]
    spec = spec_from_file_location(key, path)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[key] = module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:  # of the user's code, any
        del sys.modules[key]
        lines = [
            at.lineno for at in traceback.extract_tb(error.__traceback__) if at.filename == key
        ]
        place = f", line {lines[-1]}" if lines else ""
        raise InputError(
            f"{option}: {path.name} fails: {type(error).__name__}: {one_line(error)}{place}"
        ) from error
    return module

"""Where a vehicle's file is: a path, or the bare name of a vehicle that comes with the package."""

import os
from collections.abc import Sequence
from pathlib import Path

from . import QUAD_XML
from .errors import InputError, shortened

LIBRARY = Path(__file__).parent / "vehicles"
"""One folder for each vehicle: `NAME/vehicle.toml`."""


def vehicle_names() -> list[str]:
    """Bare names of the vehicles that come with the package, sorted."""
    return sorted(file.parent.name for file in LIBRARY.glob("*/vehicle.toml"))


def words_of(option: str, given: object) -> tuple[str, ...]:
    """Names or files, from a text with commas between them or from several such texts.

    None gives an empty tuple. Raises `InputError`, whose sentence begins with the option.
    """
    if given is None:
        return ()
    texts: Sequence[object] = given if isinstance(given, list | tuple) else (given,)
    if not all(isinstance(text, str | Path) for text in texts):
        raise InputError(
            f"{option}: expected names, with commas between them, got {shortened(given)}"
        )
    words: list[str] = []
    for text in map(str, texts):
        if os.path.exists(text):
            words.append(text)
        else:
            words += [word.strip() for word in text.split(",")]
    return tuple(words)


def is_drawn(word: str) -> bool:
    """Whether a word stands for a drawn craft, as `drawn:7`, or for a pool of them."""
    return word == "drawn" or word.startswith("drawn:")


def is_pool(word: str) -> bool:
    """Whether a word stands for a pool of drawn craft, as `drawn` and `drawn:0-999`."""
    return word == "drawn" or (is_drawn(word) and "-" in word)


def is_of_the_library(vehicle: str) -> bool:
    """Whether a word stands for a vehicle that comes with the package, and for no file."""
    return (vehicle in vehicle_names() or is_drawn(vehicle)) and not os.path.isfile(vehicle)


def find_vehicle(vehicle: Path | str | None) -> Path:
    """The absolute path of a vehicle's file; None is the paper's. Raises `InputError`."""
    if vehicle is None:
        return QUAD_XML.resolve()
    word = str(vehicle)
    if is_drawn(word) and not os.path.isfile(word):
        from .drawn import drawn_file  # it imports MuJoCo

        return drawn_file(word)
    if is_of_the_library(word):
        return (LIBRARY / word / "vehicle.toml").resolve()
    path = Path(word)
    # A name with an ending that is not there is refused by whoever reads it.
    is_no_file = path.suffix == "" or "\0" in word or os.path.lexists(word)
    if not isinstance(vehicle, str | Path) or (is_no_file and not os.path.isfile(word)):
        known = ", ".join(vehicle_names())
        raise InputError(
            f"vehicle: expected a file, or one of {known} or drawn:NUMBER, got {word!r:.300}"
        )
    if path.suffix.lower() == ".urdf":
        raise InputError(
            "vehicle: expected a TOML file that names the rotors, with [model] and "
            f"file = {path.name!r}, got the URDF file itself"
        )
    return path.resolve()

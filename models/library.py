"""Where a vehicle's file is: a path, or the bare name of a vehicle that comes with the package."""

from pathlib import Path
from typing import Final

from . import QUAD_XML
from .errors import InputError, shortened

__all__ = ["LIBRARY", "find_vehicle", "vehicle_names"]

LIBRARY: Final = Path(__file__).parent / "vehicles"
"""One folder for each vehicle: `NAME/vehicle.toml`."""


def vehicle_names() -> list[str]:
    """Bare names of the vehicles that come with the package, sorted."""
    return sorted(file.parent.name for file in LIBRARY.glob("*/vehicle.toml"))


def find_vehicle(vehicle: Path | str | None) -> Path:
    """The absolute path of a vehicle's file; None is the paper's. Raises `InputError`."""
    if vehicle is None:
        return QUAD_XML.resolve()
    if not (isinstance(vehicle, str | Path) and 0 < len(str(vehicle)) <= 1000):
        raise InputError(
            "vehicle: expected the path of a file, of 1 to 1000 characters, "
            f"got {shortened(vehicle)}"
        )
    path = Path(vehicle)
    word = str(vehicle)
    if word in vehicle_names() and not path.is_file():
        return (LIBRARY / word / "vehicle.toml").resolve()
    if path.suffix == "" and path.name == word and not path.exists():
        known = ", ".join(vehicle_names())
        raise InputError(f"vehicle: expected a file, or one of {known}, got {word!r}")
    if not (path.is_file() or not (path.exists() or path.is_symlink())):
        raise InputError(
            "vehicle: expected a file, "
            f"got {word}, which is a folder, a device or a link to nothing"
        )
    urdf = path.suffix.lower() == ".urdf"
    wanted = f"a TOML file that names the rotors, with [model] and file = {path.name!r}"
    if urdf:
        raise InputError(f"vehicle: expected {wanted}, got the URDF file itself")
    return path.resolve()

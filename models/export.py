"""A vehicle's file as MJCF for MuJoCo alone."""

import os
from pathlib import Path

from .errors import InputError
from .files import check_new_file, write_whole
from .library import find_vehicle
from .mjcf import read_spec
from .vehicle import Vehicle
from .vehicle_file import model_of


def export_mjcf(vehicle: Path | str, out: Path) -> None:
    """Write a vehicle's MJCF to a new file, with the six digits of MuJoCo. Raises `InputError`."""
    check_new_file(out, ".xml")
    path = find_vehicle(vehicle)
    Vehicle.load(path)  # refuses what cannot fly
    spec = read_spec(path)
    spec.modelfiledir = str(out.resolve().parent)
    for key in ("meshdir", "texturedir"):
        folder = model_of(path).parent / getattr(spec, key)
        setattr(spec, key, os.path.relpath(folder, spec.modelfiledir))
    try:
        text = spec.to_xml()
    except (ValueError, RuntimeError) as error:
        raise InputError(f"vehicle: expected a model that MuJoCo can write, got {error}") from None
    write_whole(out, text)

"""A vehicle's file as MJCF for MuJoCo alone."""

import os
from pathlib import Path
from xml.etree import ElementTree

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
    try:
        root = ElementTree.fromstring(read_spec(path).to_xml())
    except (ValueError, RuntimeError) as error:
        raise InputError(f"vehicle: expected a model that MuJoCo can write, got {error}") from None
    for compiler in root.iter("compiler"):  # folders of meshes and textures, as seen from `out`
        for key in ("meshdir", "texturedir"):
            folder = model_of(path).parent / compiler.get(key, "")
            compiler.set(key, os.path.relpath(folder, out.resolve().parent))
    text = ElementTree.tostring(root, encoding="unicode") + "\n"
    write_whole(out, text)

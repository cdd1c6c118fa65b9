"""Users' files that describe a scene: TOML and MJCF. Imports MuJoCo."""

import base64
import struct
from pathlib import Path

import mujoco
import numpy as np
from mujoco import MjSpec, mjtGeom

from ..models.bundle import written
from ..models.errors import InputError, one_line
from ..models.files import read_toml
from ..models.mjcf import check_sizes, switch_off_log_file
from .config import SceneConfig
from .fields import check_points
from .geoms import geoms_of
from .kernels import KINDS
from .obstacles import SIZES, Obstacle, obstacles_in, to_content
from .solids import Solids

_HELD = (*KINDS, "ellipsoid")
_GREY = (0.5, 0.5, 0.5, 1.0)  # of a geom without a colour of its own


def read_scene_file(path: Path) -> str:
    """Obstacles of a TOML or MJCF file, as the text of a TOML file.

    Raises `InputError`, which names the file and what of it is wrong.
    """
    try:
        if not path.is_file():
            got = "another thing" if path.exists() else "none"
            raise InputError(f"expected a file, got {got}")
        if path.suffix.lower() == ".toml":
            return to_content(obstacles_in(read_toml(path, "file")))
        return to_content(_of_mjcf(path))
    except InputError as error:
        raise InputError(f"scene: {path}: {error}") from None
    except OSError as error:
        raise InputError(f"scene: cannot read {path}: {error.strerror}") from None


def path_of(scene: SceneConfig) -> str:
    """A file of the content of a scene: its own if that has the same content today."""
    own = Path(scene.name)
    try:
        if scene.content in ("", read_scene_file(own)):
            return scene.name
    except InputError:
        pass  # it is missing here, or has changed
    name = f"{own.stem}.toml"
    data = base64.b64encode(scene.content.encode()).decode()
    return str(Path(written(((name, data),)).name, name))


def _of_mjcf(path: Path) -> tuple[Obstacle, ...]:
    """What stands still and can touch."""
    check_sizes(path, "file")
    switch_off_log_file()
    try:
        spec = MjSpec.from_file(str(path))
        for field in spec.hfields:
            if field.file:
                file = Path(field.file).name if spec.strippath else field.file
                _check_picture(path.parent / spec.meshdir / file)
        _keep_solids(spec)
        model = spec.compile()
    except InputError:
        raise
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        raise InputError(f"expected MJCF that MuJoCo reads, got: {one_line(error)}") from None
    moves = model.body_weldid[model.geom_bodyid] != 0
    if moves.any():
        name = model.geom(int(moves.argmax())).name or "one without a name"
        raise InputError(f"expected geoms that stand still, got {name}, which moves")
    solids = Solids.of_model(model)
    labels = {geom.id: geom.classname.name for geom in spec.geoms}
    rows = geoms_of(solids, len(solids))
    return tuple(
        Obstacle(
            kind=KINDS[kind],
            size=tuple(rows["geom_size"][i, : SIZES[KINDS[kind]]].tolist()),
            position=tuple(solids.centers[i].tolist()),
            heights=() if solids.grids[i] is None else solids.grids[i].round(5),
            quaternion=tuple(rows["geom_quat"][i].tolist()),
            color=tuple(model.geom_rgba[i, :3].astype(float).round(4).tolist()),
            label="" if labels[i] == "main" else labels[i],
        )
        for i, kind in enumerate(solids.kinds.tolist())
    )


def _check_picture(path: Path) -> None:
    """Refuse heights of another file than a small PNG, before MuJoCo reads it. Raises
    `InputError`.
    """
    header = b""
    if path.is_file():
        with path.open("rb") as file:
            header = file.read(24)
    if header[12:16] != b"IHDR":
        raise InputError(f"expected heights from a PNG beside the scene's file, got {path.name}")
    columns, rows = struct.unpack(">II", header[16:])
    check_points(rows, columns, path.name)


def _keep_solids(spec: MjSpec) -> None:
    """Delete all of a spec but geoms that can touch, and give these the colour of their material.

    Raises `InputError` for what no backend holds as a primitive.
    """
    if spec.flexes:
        raise InputError(f"expected geoms, got the flex {spec.flexes[0].name}")
    for part in (*spec.pairs, *spec.tendons, *spec.sensors, *spec.actuators, *spec.equalities):
        spec.delete(part)
    spec.compiler.boundmass = spec.compiler.boundinertia = 1.0  # of bodies that lose their geoms
    for geom in list(spec.geoms):
        if not geom.contype | geom.conaffinity:
            spec.delete(geom)
            continue
        shape = mjtGeom(geom.type).name.removeprefix("mjGEOM_").lower()
        if shape not in _HELD or geom.meshname:
            expected = ", ".join(_HELD)
            raise InputError(f"expected {expected}, got {geom.name or 'a geom'}, a {shape}")
        material = spec.material(geom.material) if geom.material else None
        if material is not None and np.allclose(geom.rgba, _GREY):
            geom.rgba = material.rgba
        geom.material = ""
    for part in (*spec.materials, *spec.textures, *spec.meshes, *spec.skins):
        spec.delete(part)

"""Users' files that describe a scene: TOML and MJCF. Imports MuJoCo."""

import base64
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
from mujoco import MjData, MjModel, MjsHField, MjSpec, mjtGeom

from ..models.bundle import written
from ..models.errors import InputError, one_line
from ..models.files import read_toml
from ..models.mjcf import MAX_BYTES, check_sizes, switch_off_log_file
from .config import SceneConfig
from .fields import check_points
from .obstacles import HULL, Obstacle, obstacles_in, to_content
from .solids import obstacle_of

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


def _of_mjcf(path: Path) -> Iterator[Obstacle]:
    """What stands still and can touch; the hulls of meshes are found one by one."""
    check_sizes(path, "file")
    switch_off_log_file()
    try:
        spec = MjSpec.from_file(str(path))
        _keep_solids(spec)
        _check_assets(spec, path.parent.absolute() / spec.meshdir)
        model = spec.compile()
    except InputError:
        raise
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        raise InputError(f"expected MJCF that MuJoCo reads, got: {one_line(error)}") from None
    moves = model.body_weldid[model.geom_bodyid] != 0
    if moves.any():
        name = model.geom(int(moves.argmax())).name or "one without a name"
        raise InputError(f"expected geoms that stand still, got {name}, which moves")
    is_mesh = model.geom_type == mjtGeom.mjGEOM_MESH
    data = MjData(model)
    mujoco.mj_kinematics(model, data)
    for geom in sorted(spec.geoms, key=lambda one: one.id):
        i = geom.id
        one = _hull(model, data, i) if is_mesh[i] else obstacle_of(model, data, i)
        color = tuple(model.geom_rgba[i, :3].astype(float).round(4).tolist())
        label = geom.classname.name
        yield replace(one, color=color, label="" if label == "main" else label)


def _hull(model: MjModel, data: MjData, geom: int) -> Obstacle:
    """The convex hull of a mesh, as MuJoCo found it."""
    mesh = model.geom_dataid[geom]
    graph = model.mesh_graph[model.mesh_graphadr[mesh] :]
    count = graph[0]
    chosen = model.mesh_vertadr[mesh] + graph[2 + count : 2 + 2 * count]
    turned = model.mesh_vert[chosen] @ data.geom_xmat[geom].reshape(3, 3).T
    place = tuple(data.geom_xpos[geom].tolist())
    return Obstacle(kind=HULL, vertices=turned.round(6).tolist(), position=place)


def _check_assets(spec: MjSpec, folder: Path) -> None:
    """Check the files of height fields and meshes, before MuJoCo reads them and no others. Raises
    `InputError`.
    """
    total = 0
    for asset in (*spec.hfields, *spec.meshes):
        if not asset.file:
            continue
        path = folder / (Path(asset.file).name if spec.strippath else asset.file)
        total += path.stat().st_size if path.is_file() else MAX_BYTES + 1
        if total > MAX_BYTES:
            expected = f"files beside the scene's, of at most {MAX_BYTES} bytes in all"
            raise InputError(f"expected {expected}, got {path.name}")
        if isinstance(asset, MjsHField):
            _check_picture(path)
        asset.file = str(path)
    spec.strippath = False


def _check_picture(path: Path) -> None:
    """Refuse heights of another file than a small PNG. Raises `InputError`."""
    with path.open("rb") as file:
        header = file.read(24)
    if header[12:16] != b"IHDR":
        raise InputError(f"expected heights from a PNG, got {path.name}")
    columns, rows = struct.unpack(">II", header[16:])
    check_points(rows, columns, path.name)


def _keep_solids(spec: MjSpec) -> None:
    """Delete all of a spec but geoms that can touch, and give these the colour of their material.

    Raises `InputError` for a flex or a plugin.
    """
    for part in (*spec.flexes, *spec.plugins):
        raise InputError(f"expected geoms alone, got the flex or plugin {part.name}")
    for part in (*spec.pairs, *spec.tendons, *spec.sensors, *spec.actuators, *spec.equalities):
        spec.delete(part)
    spec.compiler.boundmass = spec.compiler.boundinertia = 1.0  # of bodies that lose their geoms
    for geom in list(spec.geoms):
        if not geom.contype | geom.conaffinity:
            spec.delete(geom)
            continue
        material = spec.material(geom.material) if geom.material else None
        if material is not None and np.allclose(geom.rgba, _GREY):
            geom.rgba = material.rgba
        geom.material = ""
    used = {geom.meshname for geom in spec.geoms}
    unused = [mesh for mesh in spec.meshes if mesh.name not in used]
    for part in (*spec.materials, *spec.textures, *unused, *spec.skins):
        spec.delete(part)

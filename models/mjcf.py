"""Specs of vehicles' files: read, bounded in size, with level ground, several craft in one."""

import math
import os
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import mujoco
from mujoco import MjData, MjsBody, MjSpec, mjtGeom

from .craft import craft_spec, free_bodies
from .errors import InputError
from .files import read_own_toml
from .vehicle_file import read_vehicle_file

MAX_ELEMENTS = 10_000  # of a file, each as often as it is repeated: seconds to compile
MAX_BYTES = 1 << 23  # of a file: it is parsed in a second
MAX_MEMORY = 1 << 30  # bytes of MJCF's attribute `memory`
MAX_NUMBERS = 1 << 26  # of all height fields, textures, numerics and sensors: 0.5 GB
_LARGEST = read_own_toml(__file__, "mjcf")
"""Largest attributes of elements. But for `size`, their product is a number of numbers."""
_REPEATED = ("replicate", "composite", "flexcomp")
_UNITS = "KMGTPE"  # each is 1024 times the one before


def read_spec(path: Path) -> MjSpec:
    """The spec of a vehicle's file alone. Raises `InputError`, or `ValueError` if it is no MJCF."""
    if path.suffix.lower() == ".toml":
        file = read_vehicle_file(path)
        return craft_spec(file, None if file.model is None else read_spec(file.model))
    check_sizes(path, "vehicle")
    switch_off_log_file()
    return MjSpec.from_file(str(path))


def vehicle_spec(path: Path) -> MjSpec:
    """A vehicle's file over level ground, without visual elements."""
    spec = read_spec(path)
    add_ground(spec)
    spec.compiler.discardvisual = True
    return spec


def asset_files(spec: MjSpec, folder: Path) -> list[Path]:
    """Files of meshes and height fields that are there, of a model in a folder."""
    assets = (*spec.meshes, *spec.hfields)
    files = [folder / spec.meshdir / asset.file for asset in assets if asset.file]
    return [Path(os.path.abspath(file)) for file in files if file.is_file()]


def has_ground(spec: MjSpec) -> bool:
    return any(geom.type == mjtGeom.mjGEOM_PLANE for geom in spec.worldbody.geoms)


def add_ground(spec: MjSpec) -> None:
    """Add a plane at z = 0 to a spec without a plane."""
    if has_ground(spec):
        return
    ground = MjSpec()  # of its own: the defaults of the vehicle's file are not the ground's
    plane = mjtGeom.mjGEOM_PLANE
    ground.worldbody.add_geom(name="ground", type=plane, size=(0.0, 0.0, 0.5))
    attach(spec, ground, "rotorgram/")


def attach(spec: MjSpec, own: MjSpec, prefix: str) -> None:
    """Add all of a spec, which keeps its own defaults, to another one, with a prefix of names."""
    own.visual, own.stat = spec.visual, spec.stat  # MuJoCo warns if they differ
    spec.attach(own, prefix=prefix, frame=spec.worldbody.add_frame())


def delete_obstacles(spec: MjSpec) -> None:
    """Delete all but craft and level ground of a spec: a scene stands in their place."""
    crafts = {body.name for body in free_bodies(spec)}
    for geom in list(spec.worldbody.geoms):
        is_level = geom.pos[2] == 0.0 and list(geom.quat) == [1.0, 0.0, 0.0, 0.0]
        if geom.type != mjtGeom.mjGEOM_PLANE or not is_level:
            spec.delete(geom)
    for body in list(spec.worldbody.bodies):
        if body.name not in crafts:
            spec.delete(body)


def swarm_spec(vehicles: Sequence[Path], names: Sequence[str]) -> tuple[MjSpec, list[MjsBody]]:
    """One spec with a craft of each vehicle's file, and the free bodies of the craft.

    Parts have the name of their craft and a slash before theirs. Options and all else are those of
    the first vehicle.
    """
    spec = read_spec(vehicles[0])
    spec.delete(free_bodies(spec)[0])
    _delete_targeting_cameras(spec)
    crafts = []
    for path, name in zip(vehicles, names, strict=True):
        own = read_spec(path)  # it must outlive the attachment: its craft is a part of it
        own.option.timestep = spec.option.timestep
        own.option.gravity = spec.option.gravity
        _delete_targeting_cameras(own)
        craft = spec.worldbody.add_frame().attach_body(free_bodies(own)[0], f"{name}/", "")
        crafts.append(craft)
    return spec, crafts


def _delete_targeting_cameras(spec: MjSpec) -> None:
    """Delete the cameras that turn to a body: bodies have other names in a swarm."""
    modes = mujoco.mjtCamLight.mjCAMLIGHT_TARGETBODY, mujoco.mjtCamLight.mjCAMLIGHT_TARGETBODYCOM
    for camera in list(spec.cameras):
        if camera.mode in modes:
            spec.delete(camera)


def level_data(model: mujoco.MjModel) -> MjData:
    """All free bodies of a model level at the origin, and where that places the others."""
    data = MjData(model)
    data.qpos.reshape(-1, 7)[:] = (0, 0, 0, 1, 0, 0, 0)
    mujoco.mj_kinematics(model, data)
    return data


def switch_off_log_file() -> None:
    """Keep MuJoCo from writing MUJOCO_LOG.TXT; a log file of another name stays on."""
    config = mujoco.MjLogConfig.get()
    if config.logto_file and config.logfile == "MUJOCO_LOG.TXT":
        config.logto_file = False
        config.set()


# ---- the size of what a file describes


def check_sizes(path: Path, what: str) -> None:
    """Raise `InputError` if a file, with what it includes, has too many or too large parts.

    `what` is the first word of its sentence.

    MuJoCo allocates their memory while it reads, and aborts the process if there is too little.
    """
    _check_file(path, what)
    seen = {path}
    total = 0
    numbers = 0
    waiting = [(read_xml(path), 1, [path])]
    while waiting:
        element, times, around = waiting.pop()
        if element.tag in _REPEATED:
            counts = filter(str.isdecimal, element.get("count", "").split())
            times *= math.prod(map(int, counts))
        elif element.tag in ("include", "model"):
            inner = path.parent / element.get("file", "")
            if inner in around:
                _refuse(what, "files that do not include themselves", str(inner))
            if inner not in seen:
                _check_file(inner, what)
                seen.add(inner)
                waiting.append((read_xml(inner), times, [*around, inner]))
        total += times
        numbers += times * _numbers(element, what)
        if total > MAX_ELEMENTS:
            _refuse(what, f"at most {MAX_ELEMENTS} elements", f"{total} or more")
        if numbers > MAX_NUMBERS:
            expected = f"at most {MAX_NUMBERS} numbers of assets and sensors"
            _refuse(what, expected, f"{numbers} or more")
        waiting += [(child, times, around) for child in element]


def _numbers(element: ElementTree.Element, what: str) -> int:
    """How many numbers MuJoCo allocates for an asset, an actuator or a sensor, at least 1.

    Raises `InputError` for an attribute of any element that is too large.
    """
    numbers = 1
    for name, most in (_LARGEST.get(element.tag, {}) | _LARGEST["any"]).items():
        text = element.get(name, "1")
        number = _whole(text)
        if number > most:
            _refuse(what, f"a {name} of at most {most} in <{element.tag}>", text)
        if element.tag != "size":
            numbers *= max(1, number)
    memory = element.get("memory", "0").strip().upper()
    size = _whole(memory.rstrip(_UNITS))
    if size << 10 * (_UNITS.find(memory[-1:]) + 1) > MAX_MEMORY:
        _refuse(what, f"a memory of at most {MAX_MEMORY >> 30}G", memory)
    return numbers


def _whole(text: str) -> int:
    """The largest number of a text, rounded down; 0 of another text, which MuJoCo refuses."""
    try:
        return int(max(map(float, text.split()), default=0.0))
    except (ValueError, OverflowError):
        return 0


def _refuse(what: str, expected: str, got: str) -> None:
    raise InputError(f"{what}: expected {expected}, got {got:.80}")


def _check_file(path: Path, what: str) -> None:
    """Raise `InputError` for what would be read without an end."""
    if path.exists() and not path.is_file():
        _refuse(what, "files", str(path))
    if path.is_file() and path.stat().st_size > MAX_BYTES:
        _refuse(what, f"files of at most {MAX_BYTES} bytes", str(path))


def read_xml(path: Path) -> ElementTree.Element:
    """The root of a file, an empty element if there is none: MuJoCo says what is wrong."""
    try:
        return ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError):
        return ElementTree.Element("")

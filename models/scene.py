"""The scene around a vehicle: what its file lacks of ground, sky and light; a visual airport."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

import mujoco
import numpy as np

from . import AIRPORT_XML, QUAD_XML, SCENE_XML, parse_world
from .errors import expect
from .scenery import SCENERIES
from .vehicle_file import read_vehicle_file

AIRPORT_PREFIX: Final = "airport/"  # Of all names that `attach_airport` adds
SCENE_PREFIX: Final = "scene/"  # Of all names that `build_scene` adds
_MOST_HEIGHTS: Final = 4096  # Rows and columns of a height field: 16.8 million points, 0.3 GB
_MOST_ELEMENTS: Final = 10_000  # Of a file, each as often as it is repeated: seconds to compile
_REPEATED: Final = ("replicate", "composite", "flexcomp")
_GROUNDS: Final = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
_SKY: Final = mujoco.mjtTexture.mjTEXTURE_SKYBOX
_HIDDEN_GROUP: Final = 3  # viewers and renderers draw groups 0 to 2 unless told otherwise
_NEAR, _FAR = 0.25, 1200.0  # m: where drawing begins and ends; the hills lie within

# The depth of a directional light's shadow map spans the whole of _FAR, and a map of finer pixels
# than 12 mm (1024 over the 12 m around the craft) speckles flat ground at this span.
_SHADOW_PIXELS: Final = 1024
_ROUNDNESS: Final = 40  # slices of a cylinder: the pad's ring is seen from near
_HAZE: Final = 0.1  # of the distance to the horizon
_HAZE_COLOUR: Final = (0.80, 0.88, 0.96, 1.0)  # the sky's colour where it meets the ground


def build_scene(
    vehicle: Path | str | None = None, world: str = "plain", *, visual: bool = True
) -> mujoco.MjSpec:
    """A vehicle's file, None for the paper's, with ground, sky and light, to be compiled.

    The world is one of `WORLDS`, or NAME:SEED for one that is made from a seed. Without visual
    elements the physics is faster and the same, bit for bit. Raises `InputError` if there is no
    such world, a height field is too large or a TOML file is wrong; `ValueError` if an MJCF file
    is.
    """
    name, seed = parse_world(world)
    spec = read_spec(Path(vehicle if vehicle is not None else QUAD_XML))
    has_ground = any(geom.type in _GROUNDS for geom in spec.worldbody.geoms)
    if visual or not has_ground:
        _attach_scene(spec, ground=not has_ground)
    if name == "airport":
        attach_airport(spec)
    elif visual and name in SCENERIES:
        SCENERIES[name](spec, seed)
    spec.compiler.discardvisual = not visual
    return spec


def build_swarm(
    vehicles: Sequence[Path], names: Sequence[str], world: str = "plain", *, visual: bool = True
) -> mujoco.MjSpec:
    """One world with a craft of each vehicle's file, to be compiled.

    The parts of a craft have its name and a slash before theirs. Ground, sky, light and options are
    those of the first vehicle. Raises as `build_scene`.
    """
    spec = build_scene(vehicles[0], world, visual=visual)
    spec.delete(free_body(spec))
    _drop_targets(spec)
    for path, name in zip(vehicles, names, strict=True):
        attach_craft(spec, path, f"{name}/")
    return spec


def attach_craft(spec: mujoco.MjSpec, vehicle: Path, prefix: str, place: Any = (0, 0, 0)) -> None:
    """Add a file's craft, its names with a prefix; step and gravity are those of the scene."""
    own = read_spec(vehicle)  # as long as it has a name, its craft lives
    own.option.timestep, own.option.gravity = spec.option.timestep, spec.option.gravity
    _drop_targets(own)
    spec.worldbody.add_frame(pos=place).attach_body(free_body(own), prefix, "")


def _drop_targets(spec: mujoco.MjSpec) -> None:
    """Delete the cameras that turn to a body, whose name becomes another in a swarm."""
    modes = mujoco.mjtCamLight.mjCAMLIGHT_TARGETBODY, mujoco.mjtCamLight.mjCAMLIGHT_TARGETBODYCOM
    for camera in list(spec.cameras):
        if camera.mode in modes:
            spec.delete(camera)


def free_body(spec: mujoco.MjSpec) -> mujoco.MjsBody:
    """The first body with a free joint: the craft of a vehicle's spec."""
    free = mujoco.mjtJoint.mjJNT_FREE
    return next(body for body in spec.bodies if any(j.type == free for j in body.joints))


def read_spec(path: Path) -> mujoco.MjSpec:
    """The spec of a vehicle's file alone. Raises `InputError`, or `ValueError` if it is no MJCF."""
    if path.suffix.lower() == ".toml":
        file = read_vehicle_file(path)
        return file.build(None if file.model is None else read_spec(file.model))
    _check_size(path)
    switch_off_log_file()
    return mujoco.MjSpec.from_file(str(path))


def _attach_scene(spec: mujoco.MjSpec, *, ground: bool) -> None:
    """Add the sky and the sun of `SCENE_XML` unless `spec` has its own, and its ground if asked."""
    scene = mujoco.MjSpec.from_file(str(SCENE_XML))
    source, target = (scene, spec) if ground else (spec, scene)  # both alike: MuJoCo warns if not
    target.visual, target.stat = source.visual, source.stat
    if not ground:
        scene.delete(scene.geom("floor"))
    if any(texture.type == _SKY for texture in spec.textures):
        scene.delete(scene.texture("sky"))
    if spec.worldbody.lights:
        scene.delete(scene.light("sun"))
    spec.attach(scene, prefix=SCENE_PREFIX, frame=spec.worldbody.add_frame())


def _check_size(path: Path) -> None:
    """Raise `InputError` if a file, with what it includes, has too many or too large parts.

    MuJoCo allocates their memory while it reads, and aborts the process if there is too little.
    """
    seen, total, waiting = {path}, 0, [(_root(path), 1)]
    while waiting:
        element, times = waiting.pop()
        if element.tag in ("hfield", "texture"):
            sides = [element.get(side, "0") for side in ("nrow", "ncol", "width", "height")]
            large = any(side.isdecimal() and int(side) > _MOST_HEIGHTS for side in sides)
            most = f"at most {_MOST_HEIGHTS} × {_MOST_HEIGHTS} points"
            got = " × ".join(side for side in sides if side != "0")
            expect(not large, "vehicle", f"a height field or texture of {most}", got)
        elif element.tag in _REPEATED:
            times *= math.prod(int(n) for n in element.get("count", "").split() if n.isdecimal())
        elif element.tag == "include":
            inner = path.parent / element.get("file", "")
            if inner not in seen:
                seen.add(inner)
                waiting.append((_root(inner), times))
        total += times
        expected = f"at most {_MOST_ELEMENTS} elements"
        expect(total <= _MOST_ELEMENTS, "vehicle", expected, f"{total} or more")
        waiting += [(child, times) for child in element]


def _root(path: Path) -> ElementTree.Element:
    try:
        return ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError):
        return ElementTree.Element("")  # MuJoCo says what is wrong with it


def switch_off_log_file() -> None:
    """Keep MuJoCo from writing MUJOCO_LOG.TXT; a log file of another name stays on."""
    config = mujoco.MjLogConfig.get()
    if config.logto_file and config.logfile == "MUJOCO_LOG.TXT":
        config.logto_file = False
        config.set()


def attach_airport(spec: mujoco.MjSpec) -> None:
    """Put the airport of `AIRPORT_XML` around the scene `spec`, in place; compile `spec` yourself.

    The origin of the world becomes the centre of a pad on the apron; +x points along runway 09, z
    up, metres. The scene moves bit for bit as without it: its geoms collide with nothing, and only
    a rangefinder would see them. `spec.compiler.discardvisual` drops them all.

    Planes of the world body at z = 0 still carry what stands on them, but only geom group 3 draws
    them. Sky, haze, shadow map, and the near and far end of drawing become the airport's. Raises
    `InputError` if the scene has an airport already, `ValueError` if it does not compile.
    """
    ours = any(geom.name.startswith(AIRPORT_PREFIX) for geom in spec.geoms)
    expect(not ours, "spec", "a scene without an airport", "one that has it")
    scene = spec.copy()
    scene.compiler.discardvisual = False
    model = scene.compile()
    for geom, compiled in zip(spec.geoms, scene.geoms, strict=True):
        if _is_ground(model, compiled.id):
            geom.group = _HIDDEN_GROUP
    for texture in list(spec.textures):
        if texture.type == _SKY:
            spec.delete(texture)
    # See as far as the hills, and keep the scale that the scene has without them: MuJoCo measures
    # the ends of drawing, shadows and the free camera's first distance in extents of the scene.
    stat, visual = model.stat, spec.visual
    spec.stat.extent, spec.stat.center, spec.stat.meansize = stat.extent, stat.center, stat.meansize
    visual.map.znear, visual.map.zfar = _NEAR / stat.extent, _FAR / stat.extent
    visual.map.haze = _HAZE
    visual.rgba.haze = _HAZE_COLOUR
    visual.quality.shadowsize = min(visual.quality.shadowsize, _SHADOW_PIXELS)
    visual.quality.numslices = max(visual.quality.numslices, _ROUNDNESS)
    airport = mujoco.MjSpec.from_file(str(AIRPORT_XML))
    spec.attach(airport, prefix=AIRPORT_PREFIX, frame=spec.worldbody.add_frame())


def _is_ground(model: mujoco.MjModel, geom: int) -> bool:
    """Whether a geom is a plane of the world body at z = 0 that faces up."""
    if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_PLANE or model.geom_bodyid[geom] != 0:
        return False
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    return bool(np.isclose(rotation[8], 1.0) and model.geom_pos[geom, 2] == 0.0)

"""Add a scene to a vehicle's spec: what it lacks of ground, sky and light, and all around it."""

from pathlib import Path

from mujoco import MjModel, MjSpec

from ..models import QUAD_XML
from ..models.mjcf import attach, delete_obstacles, has_ground, read_spec
from . import AIRPORT_XML, SCENE_XML
from .config import SceneConfig, parse_scene
from .geoms import add_geoms, add_hulls
from .looks import PICTURED, SKY, add_parts
from .obstacles import obstacles_of
from .solids import Solids, is_ground

SCENE_PREFIX = "scene/"  # of all names that `add_scene` adds for the plain scene
_NEAR = 0.25  # m: nearest distance that is drawn
_FAR = 1200.0  # m: furthest distance at the airport; the hills lie within
_SEEDED_FAR = 400.0  # m: that of the scenes of a seed
HIDDEN_GROUP = 3  # viewers draw groups 0 to 2 unless the user asks for others

# The depth of a directional light's shadow map spans the whole of _FAR, and a map of finer pixels
# than 12 mm (1024 over the 12 m around the craft) speckles flat ground at this span.
_SHADOW_PIXELS = 1024
_HAZE = 0.1  # of the distance to the horizon
_HAZE_COLOUR = (0.80, 0.88, 0.96, 1.0)  # the sky's colour where it meets the ground


def build_scene(vehicle: Path | str | None = None, scene: str | SceneConfig = "plain") -> MjSpec:
    """A vehicle's file, None for the paper's, in one of `SCENES`, to be compiled.

    Raises `InputError` if there is no such scene or the file is wrong, `ValueError` if MuJoCo
    cannot read it.
    """
    spec = read_spec(Path(vehicle if vehicle is not None else QUAD_XML))
    add_scene(spec, scene)
    return spec


def add_scene(spec: MjSpec, scene: str | SceneConfig = "plain") -> None:
    """Add a single scene to the spec of one or several craft, in place, for pictures.

    The craft move bit for bit as without it. Raises `InputError`.
    """
    chosen = parse_scene(scene)
    if chosen.is_file:
        delete_obstacles(spec)
    _add_plain(spec)
    if chosen.is_file:
        _add_obstacles(spec, chosen.embedded().content)
    elif chosen.name == "airport":
        _add_airport(spec)
    elif chosen.is_seeded:
        # In place of the spec's sky, lights and the look of its level ground.
        _clear(spec, _SEEDED_FAR, 20)
        for light in spec.worldbody.lights:
            light.active = False
        add_parts(spec, chosen)
    spec.compiler.discardvisual = False


def move_geoms(model: MjModel, scene: str | SceneConfig, time: float) -> None:
    """Put the geoms of a scene in a model where its solids are at a time of an episode, s."""
    chosen = parse_scene(scene)
    if not chosen.type.moves:
        return
    solids = Solids.of_scene(chosen)
    moving = solids[solids.moves].at(time)
    geoms = [model.geom(name).id for name in moving.names]
    model.geom_pos[geoms] = moving.centers


def _add_obstacles(spec: MjSpec, content: str) -> None:
    """Add the obstacles of a file, which collide with nothing. Level ground is there already, and
    hides what reaches no higher.
    """
    obstacles = obstacles_of(content)
    solids = Solids.of_obstacles(obstacles)
    geoms = add_geoms(spec, solids, solids.names, PICTURED)
    for geom, one, stands in zip(geoms, obstacles, solids.stands, strict=False):  # hulls are last
        geom.rgba = (*one.color, 1.0)
        if not stands:
            spec.delete(geom)
    add_hulls(spec, content, PICTURED)


def _add_plain(spec: MjSpec) -> None:
    """Add ground, sky and sun of `SCENE_XML`, each unless the spec has its own."""
    scene = MjSpec.from_file(str(SCENE_XML))
    if has_ground(spec):
        scene.delete(scene.geom("floor"))
    else:
        spec.visual = scene.visual
        spec.stat = scene.stat
    if any(texture.type == SKY for texture in spec.textures):
        scene.delete(scene.texture("sky"))
    if spec.worldbody.lights:
        scene.delete(scene.light("sun"))
    attach(spec, scene, SCENE_PREFIX)


def _add_airport(spec: MjSpec) -> None:
    """Put the airport of `AIRPORT_XML` around a scene.

    The origin of the world becomes the centre of a pad on the apron; +x points along runway 09.
    Sky, haze, shadow map, and the near and far end of drawing become the airport's. Its geoms
    collide with nothing.
    """
    _clear(spec, _FAR, 40)  # the camera comes near to the pad's ring
    visual = spec.visual
    visual.map.haze = _HAZE
    visual.rgba.haze = _HAZE_COLOUR
    visual.quality.shadowsize = min(visual.quality.shadowsize, _SHADOW_PIXELS)
    attach(spec, MjSpec.from_file(str(AIRPORT_XML)), "airport/")


def _clear(spec: MjSpec, far: float, slices: int) -> None:
    """Hide level ground, delete the sky, set the furthest distance that is drawn, m, and into how
    many slices cylinders are cut.

    The scale of the spec stays as it is without more: MuJoCo measures distances, shadows and the
    free camera's first distance in extents of the model.
    """
    scene = spec.copy()
    scene.compiler.discardvisual = False
    model = scene.compile()
    for geom, compiled in zip(spec.geoms, scene.geoms, strict=True):
        if is_ground(model, compiled.id):
            geom.group = HIDDEN_GROUP
    for texture in list(spec.textures):
        if texture.type == SKY:
            spec.delete(texture)
    stat = spec.stat
    visual = spec.visual
    stat.extent = model.stat.extent
    stat.center = model.stat.center
    stat.meansize = model.stat.meansize
    visual.map.znear = _NEAR / model.stat.extent
    visual.map.zfar = far / model.stat.extent
    visual.quality.numslices = max(visual.quality.numslices, slices)

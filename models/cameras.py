"""Cameras of a vehicle's file: where they sit, what they take, how often; their kinds of pictures.

An MJCF file has them as its cameras, with `resolution`, `fovy` and `output`; the rate, for which
MJCF has no word, is a custom text: "rotorgram/cameras.NAME.rate". A TOML file has a table
`[[cameras]]` for each. A file without a `front` or a `down` gets ours.
"""

import math
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Annotated, Any

import mujoco
import numpy as np
from mujoco import MjData, MjModel, MjSpec

from .coefficients import PREFIX
from .errors import InputError, shortened
from .fields import Direction, Limits, Text, check_fields, immutable

OUTPUTS = {
    "rgb": mujoco.mjtCamOutBit.mjCAMOUT_RGB,
    "depth": mujoco.mjtCamOutBit.mjCAMOUT_DEPTH,
    "segmentation": mujoco.mjtCamOutBit.mjCAMOUT_SEG,
}
"""Kinds of pictures, and their bits in an MJCF file. `rgb`: uint8, 3 channels. `depth`: float32, m,
along the camera's axis. `segmentation`: int32, a number for each object."""
_DTYPES = {"rgb": "uint8", "depth": "float32", "segmentation": "int32"}
FARTHEST = 1000.0
"""Where drawing ends, and the depth where nothing is seen, m."""
MAX_PIXELS = 4096  # of a side
_TEXTS = PREFIX + "cameras."
_MAX_LETTERS = 64  # of a name
_NAME = Text(rf"[^\W\d]\w{{,{_MAX_LETTERS - 1}}}", f"up to {_MAX_LETTERS} letters, digits and _")
_RESOLUTION = Limits(1, MAX_PIXELS, "pixel", whole=True, count=2)
_DEFAULT_RESOLUTION = (64, 64)
_KINDS = Text("|".join(OUTPUTS), f"some of {', '.join(OUTPUTS)}", several=True)

ORIGIN = (0.0, 0.0, 0.0)
AHEAD = (1.0, 0.0, 0.0)
UP = (0.0, 0.0, 1.0)
_Vector = tuple[float, float, float]
Place = Annotated[_Vector, Limits(-100.0, 100.0, "m", count=3)]
Axis = Annotated[_Vector, Direction(-1e3, 1e3, "1", count=3)]


@immutable
class Camera:
    """A camera of a vehicle, or of its world: a table of a TOML file."""

    name: Annotated[str, _NAME]
    position: Annotated[_Vector, Limits(-1e4, 1e4, "m", count=3)] = ORIGIN
    """In the body frame, or the world's if it stands there, m."""
    look: Axis = AHEAD
    """Direction in which it looks, in the same frame."""
    up: Axis = UP
    """Direction of the picture's upper edge, in the same frame."""
    fovy: Annotated[float, Limits(1e-3, 3.0, "rad")] = math.pi / 2
    """Vertical field of view, rad."""
    resolution: Annotated[tuple[int, int], _RESOLUTION] = _DEFAULT_RESOLUTION
    """Width and height, pixels."""
    rate: Annotated[float, Limits(1e-3, 1.0, "1")] = 1.0
    """Pictures per control step, 1 over a whole number."""
    kinds: Annotated[tuple[str, ...], _KINDS] = ("rgb",)
    """What it takes: some of `OUTPUTS`."""
    stands: bool = False
    """Whether it stands in the world; else a drone carries it."""

    def __post_init__(self) -> None:
        check_fields(self, f"camera {self.name}.")
        steps = 1 / self.rate
        if abs(steps - self.every) > 1e-6 * steps:
            raise InputError(
                f"camera {self.name}.rate: expected 1 over a whole number of control steps, "
                f"got {self.rate}"
            )

    @property
    def every(self) -> int:
        """Control steps from one picture to the next."""
        return round(1 / self.rate)

    @property
    def words(self) -> str:
        """Where it is, where it looks and how it sees."""
        place = " ".join(f"{one:.4g}" for one in self.position)
        look = " ".join(f"{one:.4g}" for one in self.look)
        where = "the world" if self.stands else "the body"
        angle = f"{math.degrees(self.fovy):.4g} degrees high"
        words = f"at ({place}) m in {where}, looks along ({look}), {angle}"
        return words + (f", every {self.every} steps" if self.every > 1 else "")


@immutable
class View:
    """Pictures of one kind by one camera: an array of an observation."""

    camera: Camera
    kind: str

    @property
    def name(self) -> str:
        """That of the camera, and of the kind unless it is `rgb`."""
        return self.camera.name + ("" if self.kind == "rgb" else f"_{self.kind}")

    @property
    def shape(self) -> tuple[int, int, int]:
        """Rows from the top, columns from the left, channels."""
        width, height = self.camera.resolution
        channels = 3 if self.kind == "rgb" else 1
        return height, width, channels

    @property
    def dtype(self) -> str:
        """`uint8`, `float32` or `int32`."""
        return _DTYPES[self.kind]


def chosen_views(words: Sequence[str], cameras: Iterable[Camera]) -> tuple[View, ...]:
    """The pictures that words choose: CAMERA, all its kinds; CAMERA_KIND; with @WIDTHxHEIGHT behind
    it in another size. Raises `InputError`.
    """
    known = {camera.name: camera for camera in cameras}
    views: dict[str, View] = {}
    for word in words:
        text, at, size = word.partition("@")
        name, _, kind = text.rpartition("_")
        if text in known:
            camera = known[text]
            kinds = camera.kinds
        elif name in known and kind in OUTPUTS:
            camera = known[name]
            kinds = (kind,)
        else:
            raise InputError(
                f"cameras: expected some of {', '.join(known)}, each with "
                f"_{', _'.join(OUTPUTS)} behind it or not, got {shortened(word)}"
            )
        if at:
            resolution = read_size(f"cameras: {text}@", size, 1, MAX_PIXELS)
            camera = replace(camera, resolution=resolution)
        for one in kinds:
            view = View(camera=camera, kind=one)
            if views.setdefault(view.name, view) != view:
                raise InputError(
                    f"cameras: expected each picture in one size, got {view.name!r} in two"
                )
    return tuple(views.values())


def read_size(name: str, text: str, least: int, most: int) -> tuple[int, int]:
    """Width and height of a text WIDTHxHEIGHT, pixels. Raises `InputError`."""
    match = re.fullmatch(r"([0-9]{1,4})x([0-9]{1,4})", text)
    width, height = map(int, match.groups()) if match else (0, 0)
    if min(width, height) < least or max(width, height) > most:
        raise InputError(
            f"{name}: expected WIDTHxHEIGHT of {least} to {most} pixels each, got {shortened(text)}"
        )
    return width, height


# ---- of a file


def read_cameras(spec: MjSpec, model: MjModel, data: MjData) -> tuple[Camera, ...]:
    """Cameras of a vehicle's spec, the model that it gave, and the level craft at the origin.

    Raises `InputError`.

    One that follows the craft but does not turn with it, as MuJoCo's mode `trackcom`, counts as
    standing in the world. Left out: those without a name of letters, digits and _, those that turn
    to a target, and those without perspective.
    """
    texts = {text.name: text.data for text in spec.texts if text.name.startswith(_TEXTS)}
    found = []
    modes = mujoco.mjtCamLight
    perspective = mujoco.mjtProjection.mjPROJ_PERSPECTIVE
    targets = modes.mjCAMLIGHT_TARGETBODY.value, modes.mjCAMLIGHT_TARGETBODYCOM.value
    for number in range(model.ncam):
        one = model.camera(number)
        usable = one.name.isidentifier() and len(one.name) <= _MAX_LETTERS
        usable = usable and model.cam_projection[number] == perspective.value
        if not usable or one.mode in targets:
            continue
        focal = model.cam_intrinsic[number, :2].tolist()
        if model.cam_sensorsize[number].any() and not min(focal) > 0:
            raise InputError(f"camera {one.name}: expected a focal length above 0, got {focal}")
        resolution = model.cam_resolution[number].tolist()
        if resolution == [1, 1]:  # MJCF's default
            resolution = _DEFAULT_RESOLUTION
        rate: Any = texts.pop(f"{_TEXTS}{one.name}.rate", "1")
        with suppress(ValueError):  # a camera's rate is a number
            rate = float(rate)
        output = int(model.cam_output[number])
        axes = data.cam_xmat[number].reshape(3, 3)
        mine = model.body_rootid[one.bodyid[0]] == model.jnt_bodyid[0]
        found.append(
            Camera(
                name=one.name,
                position=_vector(data.cam_xpos[number]),
                look=_vector(-axes[:, 2]),
                up=_vector(axes[:, 1]),
                fovy=math.radians(one.fovy[0]),
                resolution=resolution,
                rate=rate,
                kinds=tuple(kind for kind, bit in OUTPUTS.items() if output & bit) or ("rgb",),
                stands=bool(not mine or one.mode != modes.mjCAMLIGHT_FIXED.value),
            )
        )
    for name in texts:
        raise InputError(f"{name}: expected a camera of that name and a key that it can have")
    return tuple(found)


def place_cameras(model: MjModel, data: MjData) -> None:
    """Put bodies, cameras and lights where the positions of the joints have them."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)  # the body that cameras and lights follow
    mujoco.mj_camlight(model, data)


def _vector(values: np.ndarray) -> _Vector:
    with np.errstate(over="ignore"):
        x, y, z = (float(round(one, 9)) + 0.0 for one in values)
    return x, y, z


# ---- ours


def own_cameras(radius: float, rest_height: float) -> tuple[Camera, ...]:
    """The cameras that every vehicle has unless its file has others of their names.

    `front` looks ahead from the front of the sphere about the craft, whose radius is in m, `down`
    straight down from a quarter of the height of its body above its landing gear.
    """
    down = (0.0, 0.0, -1.0)
    place = (0.0, 0.0, -0.75 * rest_height)
    return (
        Camera(name="front", position=(radius, 0.0, 0.0)),
        Camera(name="down", position=place, look=down, up=AHEAD),
    )


def place_camera(spec: MjSpec, body: mujoco.MjsBody, camera: Camera, prefix: str = "") -> None:
    """Add a camera to a body of a spec, its name with a prefix; its rate is a custom text."""
    right = np.cross(camera.look, camera.up)
    body.add_camera(
        name=prefix + camera.name,
        pos=camera.position,
        xyaxes=np.concatenate((right, np.cross(right, camera.look))),
        fovy=math.degrees(camera.fovy),
        resolution=camera.resolution,
        output=sum(int(OUTPUTS[kind]) for kind in camera.kinds),
    )
    if camera.every > 1:
        spec.add_text(name=f"{_TEXTS}{camera.name}.rate", data=repr(1 / camera.every))

"""An OpenGL context that needs no window."""

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import TYPE_CHECKING, Any
from weakref import finalize

from ..models.errors import NoOpenGL, one_line, shortened

if TYPE_CHECKING:
    import mujoco
    import numpy as np

Lines = Sequence[tuple[str, str]]
"""Names and values that are written on a picture."""

_LARGE = 480  # pixels: higher pictures have large letters
_ROOM = 10_000  # geoms beyond those of the model
_SAMPLES = 4  # of every pixel, for smooth edges; software has no more
_LIBRARIES = ("egl", "osmesa", "cgl", "glfw", "disable")
_HIDDEN = "ROTORGRAM_GL"
"""Keeps `MUJOCO_GL` as the user set it while `hidden_gl_setting` hides it from MuJoCo. An
environment variable, so that the processes that this one starts know it too."""


_opened: set[int] = set()
"""Ids of the processes that have opened OpenGL: this one, and those that it was forked from."""


@contextmanager
def hidden_gl_setting() -> Iterator[None]:
    """Let MuJoCo be imported without an OpenGL, whatever `MUJOCO_GL` names.

    Otherwise MuJoCo imports one, which takes a tenth of a second, and raises where that fails.
    """
    hidden = {_HIDDEN: _wanted(), "MUJOCO_GL": "disable"}
    before = {name: os.environ[name] for name in hidden if name in os.environ}
    os.environ |= hidden
    try:
        yield
    finally:
        for name in hidden:
            del os.environ[name]
        os.environ |= before


def offscreen_context(width: int, height: int) -> Any:
    """A context of MuJoCo's for pictures of so many pixels, not current yet. Raises `NoOpenGL`.

    `MUJOCO_GL` decides if it is set (egl, osmesa, glfw). Otherwise it is EGL on Linux, and the
    system's own elsewhere.
    """
    _refuse_forked()
    _opened.add(os.getpid())
    name = _library()
    reason = "MUJOCO_GL switches it off"
    if name != "disable":
        try:
            context = import_module(f"mujoco.{name}").GLContext(width, height)
            with context.as_current():
                return context
        except Exception as error:  # each library fails in a way of its own
            words = one_line(error) or type(error).__name__
            if isinstance(error, AttributeError):  # PyOpenGL's way to say so
                words = "its library is not installed"
            reason = f"{name}: {words:.200}"
    raise NoOpenGL(
        "OpenGL: expected EGL (on Debian and Ubuntu: apt-get install libegl1 libgl1-mesa-dri), "
        f"got none ({reason})"
    )


def _is_forked() -> bool:
    """Whether from a process that draws: here OpenGL would wait for threads that do not exist."""
    return not _opened <= {os.getpid()}


def _refuse_forked() -> None:
    if _is_forked():
        raise NoOpenGL(
            "OpenGL: expected a process that was started anew, got one that was forked from one "
            "that draws; multiprocessing's start method 'spawn' starts it anew"
        )


def columns(lines: Lines) -> tuple[str, str]:
    """The two columns of MuJoCo's overlay."""
    names, values = zip(*lines, strict=True)
    return "\n".join(names), "\n".join(values)


class Offscreen:
    """MuJoCo's drawing of a model without a window, from any thread, in pictures of up to a size.

    `fine` draws smooth edges and shadows. Raises `NoOpenGL`.

    Attributes:
        scene: What `draw` draws.
    """

    def __init__(self, model: "mujoco.MjModel", width: int, height: int, *, fine: bool) -> None:
        import mujoco

        self._model = model
        model.vis.global_.offwidth = width
        model.vis.global_.offheight = height
        model.vis.quality.offsamples = _SAMPLES if fine else 0
        self.scene = mujoco.MjvScene(model, model.ngeom + _ROOM)
        self.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW.value] = fine
        self._option = mujoco.MjvOption()
        font = mujoco.mjtFontScale.mjFONTSCALE_100
        buffer = mujoco.mjtFramebuffer.mjFB_OFFSCREEN
        self._gl: Any = offscreen_context(width, height)
        try:
            with self._gl.as_current():
                self._context = mujoco.MjrContext(model, font.value)
                mujoco.mjr_setBuffer(buffer.value, self._context)
        except mujoco.FatalError as error:  # an OpenGL that is too old
            self._gl.free()
            raise NoOpenGL(f"OpenGL: expected one that MuJoCo can draw with, got {error}") from None
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR.value
        self._freed = finalize(self, _free, self._gl, self._context)
        self._freed.atexit = False

    def current(self) -> Any:
        """Keep OpenGL with this thread for a block: `draw` in it is faster."""
        if not self._freed.alive:
            raise NoOpenGL("OpenGL: expected cameras that are open, got closed ones")
        _refuse_forked()
        return self._gl.as_current()

    def update(self, data: "mujoco.MjData", camera: "mujoco.MjvCamera") -> None:
        """Fill the scene with the model in a state, seen from a camera."""
        import mujoco

        every = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, data, self._option, None, camera, every, self.scene)

    def draw(
        self, pixels: "np.ndarray", depth: "np.ndarray | None" = None, lines: Lines = ()
    ) -> None:
        """Draw the scene into arrays of one size, the lowest row first: colours, uint8 (H, W, 3),
        and OpenGL's depth, float32 (H, W), 1 near and 0 far. Lines are written over it.
        """
        import mujoco

        rect = mujoco.MjrRect(0, 0, pixels.shape[1], pixels.shape[0])
        try:
            with self.current():
                mujoco.mjr_render(rect, self.scene, self._context)
                if lines:
                    is_large = rect.height > _LARGE
                    font = mujoco.mjtFont.mjFONT_BIG if is_large else mujoco.mjtFont.mjFONT_NORMAL
                    corner = mujoco.mjtGridPos.mjGRID_TOPLEFT
                    mujoco.mjr_overlay(font, corner, rect, *columns(lines), self._context)
                mujoco.mjr_readPixels(pixels, depth, rect, self._context)
        except (mujoco.FatalError, RuntimeError) as error:  # the driver was restarted
            raise NoOpenGL(f"OpenGL: expected a context to draw with, lost it: {error}") from None

    def close(self) -> None:
        """Free it. A second call does nothing."""
        self._freed()


def _free(gl: Any, context: "mujoco.MjrContext") -> None:
    """Free both while this OpenGL is current.

    MuJoCo's context frees objects by their numbers, in whatever OpenGL is current. Where Python
    collects garbage, that may be another one.
    """
    if _is_forked():  # it is the other process's
        return
    with gl.as_current():
        context.free()
    gl.free()


def _wanted() -> str:
    return os.environ.get(_HIDDEN, os.environ.get("MUJOCO_GL", "")).lower().strip()


def _library() -> str:
    wanted = _wanted()
    if not wanted:
        return {"linux": "egl", "darwin": "cgl"}.get(sys.platform, "glfw")
    if wanted not in _LIBRARIES:
        raise NoOpenGL(f"MUJOCO_GL: expected egl, osmesa, glfw or disable, got {shortened(wanted)}")
    return wanted

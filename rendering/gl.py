"""An OpenGL context that needs no window."""

import ctypes.util
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any, Final

from ..models.errors import NoOpenGL

_OFF: Final = ("disable", "disabled", "off", "false", "0")
_ON: Final = ("enable", "enabled", "on", "true", "1", "glfw", "glx", "wgl")
_LIBRARIES: Final = {"egl": "EGL", "osmesa": "OSMesa", "cgl": "OpenGL"}
_HIDDEN: Final = "ROTORGRAM_GL"
"""Keeps `MUJOCO_GL` as the user set it while `hidden_gl_setting` hides it from MuJoCo. An
environment variable, so that the processes that this one starts know it too."""


@contextmanager
def hidden_gl_setting() -> Iterator[None]:
    """Let MuJoCo be imported without an OpenGL, also where `MUJOCO_GL` names one that is not there.

    Otherwise MuJoCo imports one, which takes a tenth of a second, and raises where that fails.
    """
    before, wanted = dict(os.environ), _wanted()
    library = _LIBRARIES.get(wanted, "")
    if wanted in (*_OFF, *_ON) or (library and ctypes.util.find_library(library)):
        yield
        return
    os.environ[_HIDDEN], os.environ["MUJOCO_GL"] = wanted, "disable"
    try:
        yield
    finally:
        for name in (_HIDDEN, "MUJOCO_GL"):
            os.environ.pop(name)
            os.environ.update({name: before[name]} if name in before else {})


def offscreen_context(width: int, height: int) -> Any:
    """A context of MuJoCo's for pictures of so many pixels, not current yet. Raises `NoOpenGL`.

    `MUJOCO_GL` decides if it is set (egl, osmesa, glfw). Otherwise it is EGL on Linux, or a hidden
    window where there is a display and no EGL; elsewhere the system's own.
    """
    reasons = []
    for name in _candidates():
        try:
            context = import_module(f"mujoco.{name}").GLContext(width, height)
            with context.as_current():
                return context
        except Exception as error:  # each library fails in a way of its own
            words = " ".join(str(error).split()) or type(error).__name__
            if isinstance(error, AttributeError):  # PyOpenGL's way to say so
                words = "its library is not installed"
            reasons.append(f"{name}: {words:.200}")
    raise NoOpenGL(
        "OpenGL: expected EGL (on Debian and Ubuntu: apt-get install libegl1 libgl1-mesa-dri), "
        f"got none ({'; '.join(reasons) or 'MUJOCO_GL switches it off'})"
    )


def _wanted() -> str:
    return os.environ.get(_HIDDEN, os.environ.get("MUJOCO_GL", "")).lower().strip()


def _candidates() -> tuple[str, ...]:
    wanted = _wanted()
    if wanted in _OFF:
        return ()
    if wanted in _LIBRARIES:
        return (wanted,)
    if wanted in _ON:
        return ("glfw",)
    if wanted:
        raise NoOpenGL(f"MUJOCO_GL: expected egl, osmesa, glfw or disable, got {wanted!r:.80}")
    if sys.platform != "linux":
        return ("cgl", "glfw") if sys.platform == "darwin" else ("glfw",)
    # Without a display GLFW writes warnings of its own; it has nothing to offer there.
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return ("egl", "glfw") if display else ("egl",)

"""An OpenGL context that needs no window."""

import os
import sys
from importlib import import_module
from typing import Any, Final

__all__ = ["NoOpenGL", "offscreen_context"]

_OFF: Final = ("disable", "disabled", "off", "false", "0")


class NoOpenGL(RuntimeError):
    """There is no OpenGL to draw with. The sentence names what to install."""

    exit_status = 2
    """Of a command that had to draw."""


def offscreen_context(width: int, height: int) -> Any:
    """A context of MuJoCo's for pictures of so many pixels, to be made current by whoever draws.

    `MUJOCO_GL` decides where it is set (egl, osmesa, glfw; MuJoCo itself reads it once, when it is
    imported). Otherwise it is EGL on Linux, with a display or without; a window that is hidden
    where there is a display and no EGL; elsewhere the system's own.

    Raises:
        NoOpenGL: None of them works.
    """
    reasons = []
    for name in _candidates():
        try:
            context = import_module(f"mujoco.{name}").GLContext(width, height)
            with context.as_current():
                pass
        except Exception as error:  # each library fails in a way of its own
            reasons.append(f"{name}: {_why(error)}")
        else:
            return context
    raise NoOpenGL(
        "OpenGL: expected EGL (on Debian and Ubuntu: apt-get install libegl1 libgl1-mesa-dri), "
        f"got none ({'; '.join(reasons) or 'MUJOCO_GL switches it off'})"
    )


def _why(error: Exception) -> str:
    if isinstance(error, AttributeError):  # PyOpenGL's way to say so
        return "its library is not installed"
    words = " ".join(str(error).split()) or type(error).__name__
    return f"{words:.200}"


def _candidates() -> tuple[str, ...]:
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip()
    if wanted in _OFF:
        return ()
    if wanted in ("egl", "osmesa", "cgl"):
        return (wanted,)
    if wanted:  # MuJoCo's other words all mean this one
        return ("glfw",)
    if sys.platform == "darwin":
        return ("cgl", "glfw")
    if sys.platform != "linux":
        return ("glfw",)
    # Without a display GLFW writes warnings of its own; it has nothing to offer there.
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return ("egl", "glfw") if display else ("egl",)

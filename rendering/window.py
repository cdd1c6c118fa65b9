"""A window on this machine's display: MuJoCo's passive viewer."""

import atexit
import os
import sys
import threading
import warnings
from collections.abc import Callable
from typing import Any, Literal

import mujoco

from ..models.errors import NoOpenGL
from .gl import columns
from .stage import Stage

Press = Literal["pause", "step"]
"""Effect of a key."""
KEYS: dict[int, Press] = {
    32: "pause",  # space
    262: "step",  # arrow to the right
}
"""GLFW's keys. MuJoCo's passive viewer uses none of them."""
_HELP = [("space", "pause"), ("right arrow", "one step")]
_INSTEAD = "make a film instead (rotorgram render)"


class Window:
    """A stage in a window; `press` gets the effects of keys. Raises `NoOpenGL`."""

    def __init__(self, stage: Stage, press: Callable[[Press], None]) -> None:
        viewer = _viewer()
        self._stage = stage
        self._press = press
        others = set(threading.enumerate())
        try:
            self._handle = viewer.launch_passive(
                stage.model,
                stage.data,
                key_callback=self._on_key,
                show_left_ui=False,
                show_right_ui=False,
            )
        except RuntimeError as error:  # on macOS windows belong to the main thread
            raise NoOpenGL(
                f"window: expected mjpython -m rotorgram.cli in place of rotorgram, got {error}; "
                f"or {_INSTEAD}"
            ) from None
        self._threads = set(threading.enumerate()) - others
        # If it is never closed: MuJoCo's thread must have ended before GLFW does.
        atexit.register(self.close)

    def show(self) -> None:
        """Draw the stage as it is now, with its numbers over it."""
        handle = self._handle
        with handle.lock():
            self._stage.follow(handle.cam)
            handle.user_scn.ngeom = 0
            self._stage.decorate(handle.user_scn)
        top = mujoco.mjtGridPos.mjGRID_TOPLEFT
        bottom = mujoco.mjtGridPos.mjGRID_BOTTOMLEFT
        font = mujoco.mjtFontScale.mjFONTSCALE_100
        texts = [(font, top, *columns(self._stage.lines)), (font, bottom, *columns(_HELP))]
        handle.set_texts(texts)
        handle.sync()

    def is_running(self) -> bool:
        """Whether it is open."""
        return bool(self._handle.is_running())

    def close(self) -> None:
        """Close it, and wait for the thread that draws it: Python must not end before."""
        self._handle.close()
        for thread in self._threads:
            thread.join(timeout=10)
        atexit.unregister(self.close)

    def _on_key(self, key: int) -> None:
        if key in KEYS:
            self._press(KEYS[key])


def _viewer() -> Any:
    """MuJoCo's module. Raises `NoOpenGL` first: without a display MuJoCo would wait forever."""
    on_x = sys.platform == "linux"
    if on_x and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise NoOpenGL(f"window: expected a display, got none (DISPLAY is not set): {_INSTEAD}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # GLFW's; the sentence below says what is wrong
            import glfw
            from mujoco import viewer

            if on_x:
                window = None
                if glfw.init():
                    glfw.window_hint(glfw.VISIBLE, glfw.FALSE)
                    window = glfw.create_window(16, 16, "", None, None)
                    glfw.default_window_hints()
                if not window:
                    raise RuntimeError("none that OpenGL can draw on")
                glfw.destroy_window(window)
    except (ImportError, RuntimeError) as error:
        raise NoOpenGL(f"window: expected a display, got {error}: {_INSTEAD}") from None
    return viewer

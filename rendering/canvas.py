"""Draws a stage into arrays of pixels, without a window."""

from contextlib import AbstractContextManager
from typing import Any

import mujoco
import numpy as np

from ..models.errors import expect
from .gl import NoOpenGL, offscreen_context
from .stage import Camera, Stage

_ROOM = 10_000  # geoms
_SAMPLES = 4  # of every pixel, for smooth edges; software has no more


class Canvas(AbstractContextManager["Canvas"]):
    """Pictures of a stage, all of one size in pixels. Raises `NoOpenGL` or `InputError`.

    `fast` is without shadows and smooth edges, which take most of the time where software draws.
    """

    def __init__(
        self, stage: Stage, width: int = 640, height: int = 480, *, fast: bool = False
    ) -> None:
        for name, pixels in (("width", width), ("height", height)):
            expect(16 <= pixels <= 8192, name, "16 to 8192 pixels", f"{pixels}")
        self.stage, self.width, self.height = stage, width, height
        self._gl: Any = offscreen_context(width, height)
        model = stage.model
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        model.vis.quality.offsamples = 0 if fast else _SAMPLES
        font, buffer = mujoco.mjtFontScale.mjFONTSCALE_100, mujoco.mjtFramebuffer.mjFB_OFFSCREEN
        try:
            with self._gl.as_current():  # and then no more, so that any thread may draw
                self._context = mujoco.MjrContext(model, font.value)
                mujoco.mjr_setBuffer(buffer.value, self._context)
        except mujoco.FatalError as error:  # an OpenGL that is too old
            self._gl.free()
            raise NoOpenGL(f"OpenGL: expected one that MuJoCo can draw with, got {error}") from None
        self._scene = mujoco.MjvScene(model, _ROOM)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW.value] = not fast
        self._option, self._rect = mujoco.MjvOption(), mujoco.MjrRect(0, 0, width, height)

    def draw(self, camera: Camera = "chase", stage: Stage | None = None) -> np.ndarray:
        """The stage, or a twin of it, as it is now: a new array, uint8, (height, width, 3)."""
        stage = stage or self.stage
        if stage.model is not self.stage.model:
            raise ValueError("stage: expected the canvas's own or a twin of it, got another")
        model, data, scene = stage.model, stage.data, self._scene
        view, every = stage.camera(camera), mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(model, data, self._option, None, view, every, scene)
        for light in scene.lights[: scene.nlight]:
            if light.headlight and camera == "top":  # it would add itself to the sun
                light.diffuse[:] = 0.0
        # From on board, at the goal, its disc would fill the lower half.
        stage.decorate(scene, goals=camera != "onboard")
        pixels = np.empty((self.height, self.width, 3), np.uint8)
        try:
            with self._gl.as_current():
                mujoco.mjr_render(self._rect, scene, self._context)
                mujoco.mjr_readPixels(pixels, None, self._rect, self._context)
        except (mujoco.FatalError, RuntimeError) as error:  # the driver was restarted
            raise NoOpenGL(f"OpenGL: expected a context to draw with, lost it: {error}") from None
        return np.ascontiguousarray(pixels[::-1])  # OpenGL's first row is the lowest

    def close(self) -> None:
        """Free the context. A second call does nothing."""
        if self._gl is not None:
            with self._gl.as_current():
                self._context.free()
            self._gl.free()
            self._gl = None

    def __exit__(self, *_: object) -> None:
        self.close()

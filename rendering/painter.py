"""Gymnasium's render modes: one picture, one for each of many craft, or a window."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from .canvas import Canvas
from .live import MOST_DRONES, LiveView, open_surface
from .moment import Moment
from .pace import Pace
from .stage import Stage

__all__ = ["Painter"]

_ONE: Final = (480, 360)
_OF_MANY: Final = (240, 180)


class Painter:
    """Draws for the `render` of an env. Opens nothing before the first call.

    Args:
        mode: `rgb_array`, or `human`.
        drones: Craft of the env.
        control_period: Time between two moments, s: a window shows them in real time.
        vehicle: MJCF file of the craft; None is the paper's.
    """

    def __init__(
        self, mode: str, drones: int, control_period: float, vehicle: Path | str | None = None
    ) -> None:
        self._mode, self._drones, self._period = mode, drones, control_period
        self._vehicle = vehicle
        self._canvas: Canvas | None = None
        self._view: LiveView | None = None
        self._shown: Sequence[Moment] = ()

    def pictures(self, moments: Sequence[Moment]) -> tuple[np.ndarray, ...] | None:
        """A picture of each craft, uint8 of shape (height, width, 3); None with `human`.

        Raises:
            NoOpenGL: No OpenGL works here, or there is no display.
        """
        if self._mode == "human":
            self._show(moments[:MOST_DRONES])
            return None
        if self._canvas is None:
            one = self._drones == 1
            stage = Stage(vehicle=self._vehicle, trail=one)
            self._canvas = Canvas(stage, *(_ONE if one else _OF_MANY))
        return tuple(self._draw(self._canvas, moment) for moment in moments)

    def close(self) -> None:
        """Close the canvas or the window."""
        for opened in (self._canvas, self._view):
            if opened is not None:
                opened.close()
        self._canvas = self._view = None

    def _draw(self, canvas: Canvas, moment: Moment) -> np.ndarray:
        canvas.stage.show(moment)
        return canvas.draw("chase")

    def _show(self, moments: Sequence[Moment]) -> None:
        if self._view is None:
            stage = Stage(drones=len(moments), vehicle=self._vehicle)
            pace = Pace(self._period)
            surface = open_surface("window", stage, pace)
            self._view = LiveView(stage, surface, pace, of=self._drones)
        if moments != self._shown:  # `step` shows by itself, and a script may ask once more
            self._shown = moments
            self._view.draw_in_time(*moments)

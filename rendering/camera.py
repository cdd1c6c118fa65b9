"""Where an onlooker looks from, until he looks from elsewhere."""

from typing import Final

import mujoco

from .stage import Stage

__all__ = ["Aim"]

_FAR: Final = 2.0
"""Change of the targets' elevation, m, that the camera follows."""


class Aim:
    """Looks at the targets from behind, once; afterwards it only follows where they go.

    It follows no craft: the picture stands still, and what moves in it flies.
    """

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._elevation: float | None = None

    def apply(self, camera: mujoco.MjvCamera) -> bool:
        """Turn a free camera where it should look; whether that was necessary."""
        moments = self._stage.moments
        target = sum(moment.target for moment in moments) / len(moments)
        if self._elevation is not None and abs(target - self._elevation) < _FAR:
            return False
        if self._elevation is None:
            chase = self._stage.camera("chase")
            for name in ("azimuth", "elevation", "distance"):
                setattr(camera, name, getattr(chase, name))
            camera.lookat[:2] = chase.lookat[:2]
        camera.lookat[2] = self._elevation = target
        return True

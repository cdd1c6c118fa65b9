"""Pictures of flights, drawn without a window or in a viewer.

Importing this package imports none of its modules and no OpenGL: training never draws.
"""

from typing import TYPE_CHECKING

from .. import import_when_used
from ..models.errors import NoOpenGL

if TYPE_CHECKING:
    from .stage import CAMERAS, Camera, Canvas, Moment, Stage

__all__ = ["CAMERAS", "Camera", "Canvas", "Moment", "NoOpenGL", "Stage"]

__getattr__ = import_when_used(__name__)

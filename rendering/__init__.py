"""Pictures of flights, drawn without a window or in a viewer.

Importing this package imports none of its modules and no OpenGL: training never draws.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from ..models.errors import NoOpenGL

if TYPE_CHECKING:
    from .stage import CAMERAS, Camera, Canvas, MetricValue, Moment, Stage

__all__ = [
    "CAMERAS", "Camera", "Canvas", "MetricValue", "Moment", "NoOpenGL", "Stage",
]  # fmt: skip


def __getattr__(name: str) -> object:
    """Import names on first use (PEP 562)."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(".stage", __name__), name)

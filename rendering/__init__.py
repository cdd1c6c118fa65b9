"""Pictures of flights: the world as it is looked at, drawn without a window or in a viewer.

Nothing here is imported before something is to be drawn: training never touches OpenGL. Importing
the package alone imports none of its modules.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from .canvas import Canvas
    from .gl import NoOpenGL
    from .moment import Moment
    from .stage import CAMERAS, WORLDS, Camera, Stage, World

__all__ = ["CAMERAS", "WORLDS", "Camera", "Canvas", "Moment", "NoOpenGL", "Stage", "World"]

_MODULES: Final = {"Canvas": "canvas", "NoOpenGL": "gl", "Moment": "moment"}


def __getattr__(name: str) -> Any:
    """Import what is asked for on first use (PEP 562)."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_MODULES.get(name, 'stage')}", __name__), name)

"""The vehicle: its MJCF, its numbers, how to load it, its physical examination, and its world.

Importing this package, or `constants`, does not import MuJoCo: the agent's side of the wire needs
the numbers and has no simulator. `load_model`, `model_hash` and `attach_airport` import it when
first asked for.
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from .loading import load_model, model_hash
    from .world import attach_airport

__all__ = ["AIRPORT_XML", "QUAD_XML", "SCENE_XML", "attach_airport", "load_model", "model_hash"]

QUAD_XML: Final = Path(__file__).parent / "quad.xml"
"""The vehicle alone."""

SCENE_XML: Final = Path(__file__).parent / "scene.xml"
"""The vehicle with floor, sky and light: what `load_model` loads."""

AIRPORT_XML: Final = Path(__file__).parent / "airport.xml"
"""An airport to look at: what `attach_airport` puts around a scene."""

_HOMES: Final = {"attach_airport": "world", "load_model": "loading", "model_hash": "loading"}


def __getattr__(name: str) -> Any:
    """Import `attach_airport`, `load_model`, `model_hash` and MuJoCo on first use (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_HOMES[name]}", __name__), name)

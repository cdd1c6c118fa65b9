"""The vehicle: its MJCF, its numbers, how to load it, and its physical examination.

Importing this package, or `constants`, does not import MuJoCo: the agent's side of the wire needs
the numbers and has no simulator. `load_model` and `model_hash` import it when first asked for.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from .loading import load_model, model_hash

__all__ = ["QUAD_XML", "SCENE_XML", "load_model", "model_hash"]

QUAD_XML: Final = Path(__file__).parent / "quad.xml"
"""The vehicle alone."""

SCENE_XML: Final = Path(__file__).parent / "scene.xml"
"""The vehicle with floor, sky and light: what `load_model` loads."""


def __getattr__(name: str) -> Any:
    """Import `load_model` and `model_hash`, and with them MuJoCo, on first use (PEP 562)."""
    if name not in ("load_model", "model_hash"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from . import loading

    return getattr(loading, name)

"""Tasks: start, observation, reward, end and metrics of an episode."""

from importlib import import_module
from typing import Any

__all__ = [
    "Cable", "Crossing", "Elevation", "Escort", "Formation", "Hover", "Landing", "PayloadHover",
    "Racing", "Recovery", "Tracking", "Waypoints",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import a task on first use (PEP 562)."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = "payload_hover" if name == "PayloadHover" else name.lower()
    return getattr(import_module(f".{module}", __name__), name)

"""Tasks: start, observation, reward, end and metrics of an episode."""

from ... import import_when_used

__all__ = [
    "Cable", "Crossing", "Dodge", "Elevation", "Escort", "Forest", "Formation", "Gates", "Hover",
    "Landing", "PayloadHover", "Racing", "Recovery", "Tracking", "Warehouse", "Waypoints",
]  # fmt: skip

_modules = {name: f".{name.lower()}" for name in __all__} | {"PayloadHover": ".payload_hover"}
_modules |= dict.fromkeys(("Crossing", "Escort", "Formation"), ".swarm")
__getattr__ = import_when_used(__name__, _modules)

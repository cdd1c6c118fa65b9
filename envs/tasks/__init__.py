"""Tasks: start, observation, reward, end and metrics of an episode."""

from ... import import_when_used

__all__ = [  # noqa: RUF022  in the order in which their ids are listed
    "Elevation", "Hover", "Waypoints", "Tracking", "Racing", "Landing", "Recovery", "PayloadHover",
    "Formation", "Crossing", "Escort", "Cable", "Forest", "Dodge", "Warehouse", "Gates",
]  # fmt: skip

_modules = {name: f".{name.lower()}" for name in __all__} | {"PayloadHover": ".payload_hover"}
_modules |= dict.fromkeys(("Crossing", "Escort", "Formation"), ".swarm")
__getattr__ = import_when_used(__name__, _modules)

"""Tasks: start, observation, reward, end and metrics of an episode."""

from ... import import_when_used

__all__ = [  # noqa: RUF022  in the order in which their ids are listed
    "Elevation", "Hover", "Waypoints", "Tracking", "Racing", "Landing", "Recovery", "PayloadHover",
    "Formation", "Crossing", "Escort", "Cable", "Forest", "Dodge", "Warehouse", "Gates",
]  # fmt: skip

_modules = {name: f".{name.lower()}" for name in __all__}
_modules |= dict.fromkeys(("Crossing", "Escort", "Formation"), ".swarm")
_modules |= dict.fromkeys(("PayloadHover", "Cable"), ".payload")
_modules |= {"Dodge": ".hover", "Gates": ".racing", "Warehouse": ".forest"}
__getattr__ = import_when_used(__name__, _modules)

"""Tasks: start, observation, reward, end and metrics of an episode."""

from typing import TYPE_CHECKING

from ... import import_when_used

if TYPE_CHECKING:
    from .cable import Cable
    from .elevation import Elevation
    from .hover import Hover
    from .landing import Landing
    from .payload_hover import PayloadHover
    from .racing import Racing
    from .recovery import Recovery
    from .swarm import Crossing, Escort, Formation
    from .tracking import Tracking
    from .waypoints import Waypoints

__all__ = [
    "Cable", "Crossing", "Elevation", "Escort", "Formation", "Hover", "Landing", "PayloadHover",
    "Racing", "Recovery", "Tracking", "Waypoints",
]  # fmt: skip

__getattr__ = import_when_used(__name__)

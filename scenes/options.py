"""Options of scenes that are drawn from a seed: derive from `SceneOptions`, add fields with rules.

Imports the standard library and models/fields.py alone.
"""

from typing import Annotated, ClassVar, Literal

from ..models.errors import InputError
from ..models.fields import Limits, check_fields, immutable

CLEARANCE = 8.0
"""Of our scenes the `room`, m."""
MAX_DRAWN = 512
"""Most parts of a layout, unless the options of its scene state another number."""
Size = Annotated[tuple[float, float], Limits(4.0, 400.0, "m", count=2)]
"""Along x and y, m."""
_LEAST_SIDE = 10.0  # m


@immutable
class SceneOptions:
    """None at all."""

    def __post_init__(self) -> None:
        check_fields(self, "scene.")
        self.check()

    def check(self) -> None:
        """Check options that depend on each other, each within its limits. Raises `InputError`."""

    @property
    def most(self) -> int:
        """Upper bound of the number of parts of a layout."""
        return MAX_DRAWN

    @property
    def room(self) -> float:
        """Half the width of the square about the z axis that a layout keeps free up to 20 m, m."""
        return CLEARANCE


@immutable
class Clear(SceneOptions):
    """Of a scene that has room for craft either in its middle or at its ends."""

    size: Size
    """Of the scene."""
    clear: Literal["middle", "ends"] = "middle"
    """Where there is room: 8 m about the z axis, or 2 m about the middles of both ends in x."""
    least: ClassVar[float] = 24.0
    """Of the longer side, around a middle that is clear, m."""

    def check(self) -> None:
        """As `SceneOptions.check`."""
        narrowest, widest = sorted(self.size)
        if narrowest < _LEAST_SIDE:
            expected = f"sides of at least {_LEAST_SIDE:g} m"
            raise InputError(f"scene: expected {expected}, got {narrowest:g} m")
        if self.clear == "middle" and widest < self.least:
            expected = f"a size of {self.least:g} m or more, or clear=ends"
            raise InputError(f"scene: expected {expected}, got a size of {widest:g} m")

    @property
    def room(self) -> float:
        """As `SceneOptions.room`."""
        return 0.0 if self.clear == "ends" else CLEARANCE

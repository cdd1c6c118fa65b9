"""Commands that measure the simulation itself: is the model right, and how fast is each layer?"""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from .base import Command

__all__ = ["Bench", "CheckModel"]


@dataclass(frozen=True, kw_only=True)
class CheckModel(Command):
    """Examine a quadcopter model: mass, inertia, hover, free fall, torques, momentum, contact."""

    xml: Positional[Path | None] = None
    """MJCF file. Default: the model that every simulation here uses."""

    def run(self) -> int:
        """Print every check; exit status 1 if one fails."""
        from .check_model import check_model

        return check_model(self)


@dataclass(frozen=True, kw_only=True)
class Bench(Command):
    """Measure what bounds a training on this machine, from raw physics to an update."""

    rounds: int = 7
    """Turns of every layer, besides one to warm up; medians count."""
    seconds: float = 0.5
    """Length of a turn."""
    out: Path | None = None
    """Folder to write to. Default: runs/bench-TIME."""

    def run(self) -> int:
        """Measure, print and draw."""
        from .bench import bench

        return bench(self)

"""Scenes around vehicles: ground, sky, light, an airport, and three that are drawn from a seed.

Pictures show them; physics does not know them. Importing this package does not import MuJoCo.
"""

import re
from pathlib import Path
from typing import TYPE_CHECKING

from .. import import_when_used
from ..models.errors import InputError, shortened

if TYPE_CHECKING:
    from .build import add_scene, build_scene
    from .rays import Rays
    from .solids import Layouts, Solids

__all__ = ["Layouts", "Rays", "Solids", "add_scene", "build_scene"]

SCENE_XML = Path(__file__).parent / "scene.xml"
"""Ground, sky and light of the scene `plain`."""
AIRPORT_XML = Path(__file__).parent / "airport.xml"
"""The airport."""
SCENES = ("plain", "airport", "forest", "warehouse", "gates")
SEEDED_SCENES = SCENES[2:]
"""Those that are drawn from a seed."""
MAX_SEEDS = 64
"""Seeds of a scene among which episodes choose."""


def seeds_of(text: str) -> tuple[str, range]:
    """Name of a scene, and the seeds of which each episode has one; none: it has no seed.

    Of NAME, NAME:SEED or NAME:FIRST-LAST. Raises `InputError`.
    """
    pattern = r"(\w+)(?::([0-9]{1,9})(?:-([0-9]{1,9}))?)?"
    found = re.fullmatch(pattern, text) if isinstance(text, str) else None
    name, first, last = found.groups() if found else ("", None, None)
    seeds = range(int(first), int(last or first) + 1) if first else range(0)
    several = name in SEEDED_SCENES and 1 <= len(seeds) <= MAX_SEEDS
    if name not in SCENES or (first and not several):
        names = " or ".join(map(repr, SCENES))
        raise InputError(
            f"scene: expected {names}, the last three with up to {MAX_SEEDS} seeds or none, as "
            f"'forest:3' or 'forest:0-7', got {shortened(text)}"
        )
    return name, seeds


def scenes_of(text: str) -> tuple[str, ...]:
    """The scenes of which each episode has one. Raises `InputError`."""
    name, seeds = seeds_of(text)
    return tuple(f"{name}:{seed}" for seed in seeds) or (name,)


def parse_scene(text: str) -> tuple[str, int]:
    """Name and seed of a single scene: NAME, or NAME:SEED. Raises `InputError`."""
    name, seeds = seeds_of(text)
    if len(seeds) > 1:
        raise InputError(f"scene: expected one, got {text}")
    return name, max(seeds, default=0)


__getattr__ = import_when_used(__name__)

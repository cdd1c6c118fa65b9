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

__all__ = [
    "AIRPORT_XML", "MAX_SEEDS", "SCENES", "SCENE_XML", "SEEDED_SCENES", "add_scene",
    "build_scene", "parse_scene", "scenes_of",
]  # fmt: skip

SCENE_XML = Path(__file__).parent / "scene.xml"
"""Ground, sky and light of the scene `plain`."""
AIRPORT_XML = Path(__file__).parent / "airport.xml"
"""The airport."""
SCENES = ("plain", "airport", "forest", "warehouse", "gates")
SEEDED_SCENES = SCENES[2:]
"""Those that are drawn from a seed."""
MAX_SEEDS = 64
"""Seeds of a scene among which episodes choose."""


def parse_scene(text: str) -> tuple[str, int]:
    """Name and seed of a scene: NAME, or NAME:SEED of one with a seed. Raises `InputError`."""
    found = re.fullmatch(r"(\w+)(:[0-9]{1,9})?", text) if isinstance(text, str) else None
    name, seed = found.groups() if found else ("", None)
    if name not in SCENES or (seed and name not in SEEDED_SCENES):
        names = " or ".join(map(repr, SCENES))
        raise InputError(
            f"scene: expected {names}, the last three with a seed or not, as 'forest:3', "
            f"got {shortened(text)}"
        )
    return name, int(seed[1:]) if seed else 0


def scenes_of(text: str) -> tuple[str, ...]:
    """The scenes of which each episode has one: those of NAME:FIRST-LAST, or the one of the text.

    Raises `InputError`.
    """
    if not isinstance(text, str) or "-" not in text:
        parse_scene(text)
        return (text,)
    found = re.fullmatch(r"(\w+):([0-9]{1,9})-([0-9]{1,9})", text)
    name, first, last = found.groups() if found else ("", 0, 0)
    seeds = range(int(first), int(last) + 1)
    if name not in SEEDED_SCENES or not 1 <= len(seeds) <= MAX_SEEDS:
        names = ", ".join(map(repr, SEEDED_SCENES))
        raise InputError(
            f"scene: expected one of {names} with up to {MAX_SEEDS} seeds, as 'forest:0-7', "
            f"got {shortened(text)}"
        )
    return tuple(f"{name}:{seed}" for seed in seeds)


__getattr__ = import_when_used(__name__)

"""Scenes by name: ours, and those that users register."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from ..models.errors import InputError, shortened
from .options import SceneOptions

if TYPE_CHECKING:
    from .generators import Draft

MAX_SOLIDS = 10_000
"""Most primitives of a scene."""


@dataclass(frozen=True, kw_only=True)
class SceneType:
    """What draws the layouts of a scene, and how they look."""

    draw: "Callable[[Draft], None] | None" = None
    """Adds the parts of a layout to a `Draft`, all of them from its stream of random numbers."""
    materials: Mapping[str, Any] = field(default_factory=dict)
    """Looks by name, as in `materials.toml`."""
    options: type[SceneOptions] = SceneOptions
    """Options of a layout, and what follows from them."""
    moves: bool = False
    """Whether some of its solids move."""


SCENES: dict[str, SceneType] = {"plain": SceneType(), "airport": SceneType()}
"""Scenes by name."""


def register(name: str, scene: SceneType) -> None:
    """Make a scene with layouts from seeds known by a name. Registering again replaces it.

    Raises `InputError` if the name is not made of small letters, digits and underscores, or is that
    of a scene without seeds.
    """
    is_free = name not in SCENES or name in seeded_scenes()
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name) or not is_free:
        raise InputError(f"scene: expected a name such as my_scene, got {shortened(name)}")
    if scene.draw is None:
        raise InputError(f"scene: expected {name} to have a function that draws it, got none")
    SCENES[name] = scene


def seeded_scenes() -> tuple[str, ...]:
    """Names of the scenes that are drawn from a seed."""
    return tuple(name for name, scene in SCENES.items() if scene.draw)

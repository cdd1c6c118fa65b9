"""Scenes around vehicles: ground, sky, light, an airport, those that are drawn from a seed, and
those of users' files.

What pictures show of them is solid. Importing this package does not import MuJoCo.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from .. import import_when_used
from .config import SceneConfig, parse_scene
from .generators import Draft
from .options import SceneOptions
from .registry import SCENES, SceneType, register, seeded_scenes

if TYPE_CHECKING:
    from .build import add_scene, build_scene
    from .rays import Rays
    from .solids import Layouts, Solids

__all__ = [
    "SCENES", "Draft", "Layouts", "Rays", "SceneConfig", "SceneOptions", "SceneType", "Solids",
    "add_scene", "build_scene", "parse_scene", "register", "seeded_scenes",
]  # fmt: skip

SCENE_XML = Path(__file__).parent / "scene.xml"
"""Ground, sky and light of the scene `plain`."""
AIRPORT_XML = Path(__file__).parent / "airport.xml"
"""The airport."""
HALL_XML = Path(__file__).parent / "hall.xml"
"""Walls, windows, roof, lamps and racks of the warehouse."""
__getattr__ = import_when_used(__name__)

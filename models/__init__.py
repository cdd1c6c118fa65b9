"""Vehicles: MJCF files, the numbers derived from them, the scene around them, an examination.

Importing this package does not import MuJoCo: `Vehicle`, `build_scene` and `attach_airport` do so
on first use.
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

from .errors import InputError, MissingPackage, expect

if TYPE_CHECKING:
    from .scene import attach_airport, build_scene
    from .vehicle import Rotor, Vehicle

__all__ = [
    "AIRPORT_XML", "BACKENDS", "MAX_DRONES", "MOST_DRAG", "QUAD_XML", "SCENE_XML", "SEEDED_WORLDS",
    "WORLDS", "Backend", "InputError", "MissingPackage", "Rotor", "Vehicle", "attach_airport",
    "build_scene", "parse_world", "scenes_of",
]  # fmt: skip

QUAD_XML: Final = Path(__file__).parent / "quad.xml"
"""The paper's vehicle."""
SCENE_XML: Final = Path(__file__).parent / "scene.xml"
"""Ground, sky and light, which `build_scene` puts around a vehicle."""
AIRPORT_XML: Final = Path(__file__).parent / "airport.xml"
"""The airport that `attach_airport` adds around a scene. It is visual only."""
Backend = Literal["mujoco", "rigid", "warp"]
"""What steps vehicles. `mujoco`: threads of this machine, float64. `rigid`: the rigid body alone,
no contact, in compiled C or in torch. `warp`: MuJoCo Warp, float32. Tensors of the last two take a
GPU if there is one."""
BACKENDS: Final[tuple[Backend, ...]] = get_args(Backend)
WORLDS: Final = ("plain", "airport", "forest", "warehouse", "gates")
"""Surroundings of the vehicle, which pictures show and physics does not know."""
SEEDED_WORLDS: Final = WORLDS[2:]
"""Those that are made from a seed."""
MOST_SCENES: Final = 64
"""Most seeds of a world from which episodes get theirs."""
MAX_DRONES: Final = 1024
"""Most drones of a world."""
MOST_DRAG: Final = 100.0
"""Largest linear drag, 1/s. RK4 at 10 ms is within 0.1 % there, and unstable above 278 /s."""


def parse_world(text: str) -> tuple[str, int]:
    """Name and seed of a world: NAME, or NAME:SEED of one that is made from a seed. Raises
    `InputError`.
    """
    name, colon, number = text.partition(":") if isinstance(text, str) else ("", "", "")
    expected = f"{' or '.join(map(repr, WORLDS))}, the last three with a seed or not, as 'forest:3'"
    seed = int(number) if number.isascii() and number.isdecimal() and len(number) < 10 else -1
    right = name in WORLDS and (not colon or (name in SEEDED_WORLDS and seed >= 0))
    expect(right, "world", expected, repr(text))
    return name, max(seed, 0)


def scenes_of(text: str) -> tuple[str, ...]:
    """The worlds of which an episode gets one: one by seed of NAME:FIRST-LAST, or the one named."""
    name, _, numbers = text.partition(":") if isinstance(text, str) else (text, "", "")
    first, dash, last = numbers.partition("-")
    if not dash:
        parse_world(text)
        return (text,)
    try:
        low, high = (parse_world(f"{name}:{end}")[1] for end in (first, last))
    except InputError:
        low, high = 0, -1
    names = ", ".join(map(repr, SEEDED_WORLDS))
    expected = f"one of {names} with up to {MOST_SCENES} seeds, as 'forest:0-7'"
    expect(0 <= high - low < MOST_SCENES, "world", expected, repr(text))
    return tuple(f"{name}:{seed}" for seed in range(low, high + 1))


def __getattr__(name: str) -> Any:
    """Import on first use the names that need MuJoCo (PEP 562)."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = ".vehicle" if name in ("Rotor", "Vehicle") else ".scene"
    return getattr(import_module(home, __name__), name)

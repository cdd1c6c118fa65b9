"""Vehicles: MJCF and TOML files, the numbers derived from them, an examination.

Importing this package does not import MuJoCo: `Vehicle` does so on first use.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

from .. import import_when_used
from .errors import InputError, MissingPackage

if TYPE_CHECKING:
    from .vehicle import Vehicle

__all__ = [
    "BACKENDS", "MAX_DRAG", "MAX_DRONES", "QUAD_XML", "Backend", "InputError", "MissingPackage",
    "Vehicle",
]  # fmt: skip

QUAD_XML = Path(__file__).parent / "quad.xml"
"""The paper's vehicle."""
Backend = Literal["mujoco", "rigid"]
"""What steps vehicles. `mujoco`: threads of this machine, float64. `rigid`: the rigid body alone,
no contact, in NumPy or compiled."""
BACKENDS = get_args(Backend)
MAX_DRONES = 1024
"""Most drones of a world."""
MAX_DRAG = 100.0
"""Largest linear drag, 1/s. RK4 at 10 ms is within 0.1 % there, and unstable above 278 /s."""

__getattr__ = import_when_used(__name__)

"""Numbers that the paper gives for its vehicle, and no others (Drones 2023, 7, 225, section 2.2).

Code takes a vehicle's numbers from `Vehicle`, which reads the compiled model. These serve the
examination of the paper's vehicle and its documentation.
"""

from typing import Final

MASS: Final = 20.0
"""Mass, kg."""
GRAVITY: Final = 9.8
"""Gravitational acceleration, m/s²: 9.8, not 9.81."""
NUM_ROTORS: Final = 4
MAX_THRUST: Final = 100.0
"""Largest thrust of one rotor, N."""
SIDE: Final = 2.0
"""Side of the square at whose corners the rotors stand, m."""

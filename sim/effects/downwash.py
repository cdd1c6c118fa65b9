"""The air that other drones of a world blow down: a turbulent jet below each.

L. Bauersfeld, K. Muller, D. Ziegler, F. Coletti and D. Scaramuzza, "Robotics meets Fluid Dynamics:
A Characterization of the Induced Airflow below a Quadrotor as a Turbulent Jet", IEEE Robotics and
Automation Letters 2025, arXiv 2403.13321, measured below hovering drones of several sizes.
"""

import math

import numpy as np

from ... import models
from ...models import InputError
from ..rotations import body_z
from ..state import Array, WorldState, clip, length, square_root, total

DECAY = 10.11
"""B_d: velocity on the axis over that at the rotors in hover, times the distance from the jet's
origin in lengths of the craft. It and the two below are those that the authors of GADEN, a gas
simulator, use with the paper's equations; we could not read the paper's own table."""
SPREAD = 0.07668
"""S: radius at which the velocity has halved, over the distance from the jet's origin."""
ORIGIN = -5.817
"""s₀: of the jet, in lengths below the craft."""
NEAR = 2.5
"""Lengths below the craft from which on the flow is a jet, by the paper. Nearer, the jets of single
rotors merge; there we take the profile of this distance, with a speed that grows from 0 beside the
rotors in proportion to the distance below them."""
DENSITY = 1.225
"""Of the air at sea level (ICAO standard atmosphere, ISO 2533), kg/m³."""


class Downwash:
    """The jets of all drones of W worlds.

    With T the thrust of a craft, R the radius of its n rotors and l its length, the largest
    distance between two rotors, the air moves along the craft's -z axis, at the distance s below it
    and r from that axis, with

        U = sqrt(T / (2 ρ n π R²)),  V = U B_d / (s / l - s₀) / (1 + (√2 - 1) (r / h)²)²,

    and h = l S (s / l - s₀). Jets of several drones add up: our choice. Raises `InputError` for
    a vehicle without `rotors.radius`, or with a single rotor, which has no length.
    """

    def __init__(self, vehicle: "models.Vehicle") -> None:
        (radius,) = vehicle.coefficients.need("rotors.radius", "downwash")
        places = np.array([rotor.position for rotor in vehicle.rotors])
        self.length = float(length(places[:, None] - places).max())
        if not self.length > 0:
            raise InputError("vehicle: expected two rotors or more, for downwash, got one")
        self._area = vehicle.num_rotors * math.pi * radius * radius

    def velocity(self, thrust: Array, below: Array, beside: Array) -> Array:
        """Speed of the air in a jet, m/s.

        Thrust of the craft, N; distances below it and from its axis, m; all of one shape.
        """
        hover = square_root(thrust / (2 * DENSITY * self._area))
        depth = below / self.length
        share = clip(depth / NEAR, 0.0, 1.0)
        away = clip(depth, NEAR, math.inf) - ORIGIN
        half = self.length * SPREAD * away
        ratio = beside / half
        spread = 1 + (math.sqrt(2) - 1) * ratio * ratio
        return share * hover * DECAY / away / (spread * spread)

    def air(self, state: WorldState) -> list[Array]:
        """Velocity of the air at each drone by the jets of the others, world frame, m/s: three of
        shape (W, A).
        """
        down = -body_z(state.quaternion)  # of each jet
        offset = state.position[:, :, None] - state.position[:, None]  # to a drone, from a jet
        below = total(offset * down[:, None])
        beside = square_root(total(offset * offset) - below * below)
        thrust = total(state.thrust)[:, None] + 0.0 * below
        speed = self.velocity(thrust, below, beside)
        # A drone's own jet has the depth 0.
        return [total(speed * down[:, None, :, axis]) for axis in range(3)]

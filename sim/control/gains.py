"""Gains and ranges of the control loops, derived from the vehicle alone.

One number decides all gains. In the small, rotors that follow with a lag L, a rate loop, an
attitude loop, a velocity loop and a position loop make one chain, with the characteristic
polynomial

    L s⁵ + s⁴ + kᵣ s³ + kᵣ kₐ s² + kᵣ kₐ kᵥ s + kᵣ kₐ kᵥ kₚ.

With 5 p L = 1 it is L (s + p)⁵, five poles at one place and no overshoot, for

    kᵣ = 2 p,  kₐ = p,  kᵥ = p / 2,  kₚ = p / 5.

L is the lag of the rotors and the time between two looks at the state. Rotors give no more than an
angular acceleration α from hover: an attitude error of 1 rad asks for kᵣ kₐ · 1 rad = 2 p², which
must not be more. So

    p = min(1 / (5 L), sqrt(α / 2 rad)).

Yaw has a p of its own, by the same rule from its own α.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Self

import numpy as np

from ... import models
from ...models import InputError
from ...models.fields import immutable
from ...models.matrices import right_inverse
from ..elementary import atan2, cos, expm1, sin
from ..state import Array, total

LEAD = 3.0
"""Rotors are driven to follow this many times faster than their own lag."""
SURPLUS = 0.75
"""Share of the thrust beyond the weight that holds the height at the largest tilt."""
MAX_TILT = math.radians(60.0)
BRAKING = 2.0
"""Distance in which half the largest acceleration stops the craft from its largest speed, m."""
LEAST_ROOM = 0.05
"""Least room for torques around hover, of the range of thrust: a craft may hover at its least."""


@immutable
class Gains:
    """What the loops need to know of a vehicle. Axes are x, y, z of the body."""

    rate: tuple[float, float, float]
    """kᵣ: angular acceleration per error of the rate about each axis, 1/s."""
    attitude: float
    """kₐ: rate of roll and pitch per error of the thrust axis, 1/s."""
    heading: float
    """Yaw rate per error of the heading, 1/s."""
    velocity: float
    """kᵥ: acceleration per error of the velocity, 1/s."""
    position: float
    """kₚ: velocity per error of the position, 1/s."""
    period: float
    """Time between two looks at the state, s."""
    lag: float
    """Time constant of the rotors, s."""
    lead: float
    """Change of a rotor's command per wanted change of its thrust; 1 without a lag."""
    most_rate: tuple[float, float, float]
    """Range of a body rate about each axis, rad/s: what α stops within a quarter of a turn."""
    most_tilt: float
    """Largest tilt that a level asks for, rad."""
    most_acceleration: tuple[float, float]
    """Largest acceleration that the velocity loop asks for, horizontal and downwards, m/s²."""
    most_lift: float
    """The same upwards, m/s²: all the thrust beyond the weight."""
    most_velocity: tuple[float, float]
    """Range of the velocity, horizontal and vertical, m/s."""
    most_offset: tuple[float, float]
    """Offset at which the position loop asks for the largest velocity, horizontal and vertical, m.
    """
    lowest: float
    """Least and largest collective thrust, N, with the shares of a hover."""
    highest: float
    mix: tuple[tuple[float, float, float], ...]
    """Of each rotor the collective thrust that its share of a torque stands for, 1/m: torques about
    x, y, z, N·m, times this give what is added to the collective thrust, N."""
    share: tuple[float, ...]
    """Of each rotor, of the collective thrust, at hover."""

    @classmethod
    def of(cls, vehicle: "models.Vehicle", period: float, lag: float = 0.0) -> Self:
        """Gains of a vehicle. Raises `InputError` if its rotors cannot roll, pitch and yaw it.

        `period` is the time between two looks at the state, s, and `lag` the time constant of the
        rotors, s.
        """
        # The rank does not depend on the craft's size.
        size = np.abs(vehicle.allocation).max(axis=1, keepdims=True).clip(1e-12)
        rank = int(np.linalg.matrix_rank(vehicle.allocation / size))
        if rank != 4:
            raise InputError(
                "vehicle: expected a vehicle whose rotors roll, pitch and yaw it, for this action, "
                f"got {vehicle.name}, an allocation of rank {rank}"
            )
        gravity = vehicle.gravity
        weight = vehicle.mass * gravity
        share = vehicle.hover_thrust / weight
        mix = right_inverse(vehicle.allocation)[:, 1:] / share[:, np.newaxis]
        lowest = float((vehicle.thrust_low / share).max())
        highest = float((vehicle.thrust_high / share).min())
        room = max(min(highest - weight, weight - lowest), LEAST_ROOM * (highest - lowest))
        torques = total(mix[:, np.newaxis] * vehicle.inertia)
        alpha = room / np.abs(torques).max(axis=0)
        answer = max(lag / LEAD, period) if lag > 0 else 0.0
        fastest = 1 / (5 * (answer + period))
        p = min(fastest, math.sqrt(min(alpha[0], alpha[1]) / 2))
        yaw = min(fastest, math.sqrt(alpha[2] / 2))
        surplus = highest - weight
        cosine = weight / (weight + SURPLUS * surplus)
        tilt = min(atan2(math.sqrt(1 - cosine * cosine), cosine), MAX_TILT)
        level = gravity * sin(tilt) / cos(tilt)
        most = level, min(SURPLUS * surplus / vehicle.mass, gravity / 2)
        speeds = tuple(math.sqrt(a * BRAKING) for a in most)
        offsets = tuple(max(v / (p / 5), 2 * BRAKING) for v in speeds)
        return cls(
            rate=(2 * p, 2 * p, 2 * yaw),
            attitude=p,
            heading=yaw,
            velocity=p / 2,
            position=p / 5,
            period=period,
            lag=lag,
            lead=lead_of(lag, period) if lag > 0 else 1.0,
            most_rate=tuple(np.sqrt(math.pi * alpha).tolist()),
            most_tilt=tilt,
            most_acceleration=most,
            most_lift=surplus / vehicle.mass,
            most_velocity=(speeds[0], speeds[1]),
            most_offset=(offsets[0], offsets[1]),
            lowest=lowest,
            highest=highest,
            mix=tuple(map(tuple, mix.tolist())),
            share=tuple(share.tolist()),
        )


def lead_of(lag: Array, period: float) -> Array:
    """Change of a rotor's command per wanted change of its thrust, for a lag above 0, s: it then
    follows `LEAD` times faster. A step is exact: 1 - exp(-t / time).
    """
    answer = np.maximum(lag / LEAD, period)
    return expm1(-period / answer) / expm1(-period / lag)


def shared_ranges(several: Sequence[Gains]) -> list[Gains]:
    """Gains of several vehicles with the smallest ranges, so that actions mean the same to all."""
    names = ("most_rate", "most_velocity", "most_offset")
    least: dict[str, Any] = {
        name: tuple(np.min([getattr(one, name) for one in several], axis=0).tolist())
        for name in names
    }
    least["most_tilt"] = min(one.most_tilt for one in several)
    least["position"] = min(one.position for one in several)
    return [replace(one, **least) for one in several]

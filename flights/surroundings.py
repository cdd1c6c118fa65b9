"""Measures of flights among solids: time, speeds, clearance, and how hard their layouts are."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..models import InputError
from ..scenes import SceneConfig, Solids
from .trajectories import Floats, Trajectory

_SIDE = 40.0
"""Width of the square about the z axis that counts of a scene without a size, m."""


class Passage(NamedTuple):
    """Means over the flights of an evaluation in a scene."""

    touched: float
    """Share of the flights that terminated within the way of one control step of a solid."""
    time: float
    """s"""
    mean_speed: float
    """Of the way that was flown, m/s."""
    top_speed: float
    """m/s"""
    least_clearance: float
    """Between the sphere about the craft and the nearest solid but level ground, m."""
    traversability: float
    """Of the layouts, as of `Solids.traversability`."""

    @classmethod
    def of(cls, flights: Sequence[Trajectory]) -> "Passage | None":
        """None where there are no solids, or they are not known here, or the telemetry lacks
        position or velocity.
        """
        try:
            rows = [_measured(one) for one in flights if one.telemetry.keys() >= _NEEDED]
        except InputError:  # the scene's file is elsewhere
            return None
        known = np.array([row for row in rows if row])
        if not known.size:
            return None
        return cls(*known.mean(axis=0).tolist())


_NEEDED = {"position", "velocity"}


def _measured(flight: Trajectory) -> tuple[float, ...]:
    """The numbers of a `Passage`; none without solids."""
    scene = flight.scene
    solids = Solids.of_layout(scene, scene.seed)
    if not len(solids):
        return ()
    radius = flight.spec.constant("radius", "evaluate")
    position = flight.telemetry["position"]
    speed = np.linalg.norm(flight.telemetry["velocity"], axis=1)
    clearance = _distances(solids, position, flight.spec.control_period) - radius
    ends_near = clearance[-1] < speed[-2:].max() * flight.spec.control_period
    mean = speed[1:].mean() if len(flight) else 0.0
    hard = _traversability(solids, scene, radius, position[0, 2])
    touched = float(flight.terminated and ends_near)
    return touched, flight.seconds, mean, speed.max(), clearance.min(), hard


def _distances(solids: Solids, position: Floats, period: float) -> Floats:
    """Of a flight to the nearest solid after each control step, m."""
    if not solids.moves.any():
        return solids.distance(position)
    now = [solids.at(step * period).distance(place) for step, place in enumerate(position)]
    return np.array(now)


def _traversability(solids: Solids, scene: SceneConfig, radius: float, height: float) -> float:
    """Of a layout at a height."""
    half = np.array(scene.size or (_SIDE, _SIDE)) / 2
    low, high = (*-half, height), (*half, height)
    return solids.traversability(radius, low, high)

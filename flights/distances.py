"""Distances between the drones of one world, from origin to origin."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def nearest(position: Floats) -> Floats:
    """Distance of each drone to the nearest other, m, shape (T, A); nan where there is none.

    Positions have the shape (T, A, 3), m; those of a drone that does not fly are nan.
    """
    found = np.full(position.shape[:2], np.inf)
    for drone in range(position.shape[1]):
        apart = np.linalg.norm(position - position[:, drone, None], axis=-1)
        apart[:, drone] = np.inf
        found[:, drone] = np.where(np.isnan(apart), np.inf, apart).min(axis=1)
    return np.where(np.isfinite(found), found, np.nan)


def least(position: Floats) -> Floats:
    """Least distance between two of the drones, m, shape (T,), of positions as of `nearest`."""
    apart = nearest(position)
    lowest = np.where(np.isnan(apart), np.inf, apart).min(axis=1)
    return np.where(np.isfinite(lowest), lowest, np.nan)

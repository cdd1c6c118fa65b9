"""A cascade that flies any vehicle from what the flight tasks observe; it shows that they can be
done.

An acceleration gives a thrust and its direction; the shortest rotation to it and the body rates
give a torque, with the same gains for 27 g and 20 kg; the pseudo-inverse of the allocation gives
the rotors. It never learns, and knows the vehicle.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from rotorgram.models import Vehicle


class Pilot:
    """Actions of the level `rotors` from observations of shape (N, 15 + R or more)."""

    def __init__(self, vehicle: Vehicle, stiffness: float = 49.0, damping: float = 14.0) -> None:
        self.vehicle = vehicle
        self.stiffness = stiffness
        self.damping = damping
        self._mix = np.linalg.pinv(vehicle.allocation)
        turns = [vehicle.turning(axis) for axis in np.eye(3)]
        self._most = np.array((turns[0], turns[1], 0.5 * turns[2]))
        lift = float(vehicle.allocation[0] @ vehicle.thrust_high) / vehicle.mass
        self.most = min(0.8 * (lift - vehicle.gravity), 2 * vehicle.gravity)  # acceleration, m/s²
        self._up = vehicle.thrust_high - vehicle.hover_thrust
        self._down = vehicle.hover_thrust - vehicle.thrust_low

    def act(self, observation: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
        """Actions, float32, (N, R), for accelerations in the frame of the observation, (N, 3)."""
        vehicle = self.vehicle
        seen = observation.astype(np.float64)
        nose = seen[:, 6:9]
        axis = seen[:, 9:12]
        rates = seen[:, 12:15]
        to_world = np.stack((nose, np.cross(axis, nose), axis), axis=2)
        wanted = acceleration + np.array((0.0, 0.0, vehicle.gravity))
        size = np.linalg.norm(wanted, axis=1, keepdims=True)
        cosine = np.sum(axis * wanted, axis=1, keepdims=True) / size
        across = np.einsum("nji,nj->ni", to_world, np.cross(axis, wanted / size))
        sine = np.linalg.norm(across, axis=1, keepdims=True)
        # From upside down any way round is as good: about x.
        way = np.where(sine > 1e-3, across / np.maximum(sine, 1e-9), (1.0, 0.0, 0.0))
        tilt = np.arctan2(sine, cosine) * way
        yaw = np.where(cosine > 0.7, np.arctan2(nose[:, 1:2], nose[:, :1]), 0.0)
        turn = self.stiffness * tilt - self.damping * rates
        turn -= np.concatenate((0 * tilt[:, :2], 5 * yaw), axis=1)
        turn = np.clip(turn, -self._most, self._most)
        force = vehicle.mass * size * np.maximum(cosine, 0.0)
        thrust = np.concatenate((force, turn @ vehicle.inertia), axis=1) @ self._mix.T
        extra = thrust - vehicle.hover_thrust
        return np.clip(np.where(extra > 0, extra / self._up, extra / self._down), -1, 1).astype(
            np.float32
        )


def fly(
    env: Any,
    pilot: Pilot,
    wanted: Callable[[np.ndarray], np.ndarray],
    seed: int = 0,
    of_body: tuple[int, ...] | None = None,
) -> np.ndarray:
    """Metrics after each step, (steps, N, metrics): until all have ended, and who has ended rests.

    `wanted` gives accelerations from observations. Where these are in the body frame, `of_body`
    names their further vectors, and both see what `leveled` makes of them.
    """
    env.reset(seed=seed)
    metrics = []
    while not env.done.all():
        seen = env.observations.astype(np.float64)
        if of_body is not None:
            seen = leveled(seen, of_body)
        actions = pilot.act(seen, wanted(seen))
        env.advance(actions, None, None, env.done)
        metrics.append(env.telemetry["metrics"].copy())
    return np.array(metrics)


def leveled(seen: np.ndarray, further: tuple[int, ...]) -> np.ndarray:
    """Observations in the body frame, (N, 12 + R or more), as those of a level frame that turns
    with the craft, (N, 15 + R or more).

    `further` are the columns at which vectors after the thrusts begin.
    """
    up = seen[:, 6:9]
    nose, axis = np.broadcast_to(np.eye(3)[[0, 2], np.newaxis], (2, *up.shape))
    forward = nose - up * up[:, :1]
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    to_level = np.stack((forward, np.cross(up, forward), up), axis=1)
    seen = seen.copy()
    for first in (0, 3, *further):
        vectors = seen[:, first : first + 3]
        vectors[...] = np.einsum("nij,nj->ni", to_level, vectors)
    axes = np.einsum("nij,knj->kni", to_level, np.stack((nose, axis)))
    return np.hstack((seen[:, :6], *axes, seen[:, 9:]))


def limited(vectors: np.ndarray, most: float) -> np.ndarray:
    """Vectors, (N, 3), none longer than `most`."""
    sizes = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors * np.minimum(1.0, most / np.maximum(sizes, 1e-12))

"""RAPTOR: a policy of others that infers the craft which it flies.

J. Eschmann, D. Albani, G. Loianno, "RAPTOR: A Foundation Policy for Quadrotor Control", 2025. Its
package (MIT) has the weights and their forward pass:

    pip install foundation-policy h5py
    rotorgram evaluate examples/raptor.py:Raptor --env rotorgram/Hover-v0 --vehicle crazyflie2 \\
        --effects motor_lag
"""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from rotorgram.agents.layers import Floats
from rotorgram.agents.policies import Observation, flat
from rotorgram.autopilots.reading import Propellers
from rotorgram.envs import EnvSpec
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.spec import component_names
from rotorgram.models import InputError, Vehicle
from rotorgram.models.library import vehicle_names

CORNERS = ((1, -1), (-1, -1), (-1, 1), (1, 1))
"""Signs of x and y of its motors: front right, rear right, rear left, front left."""
REACH = 1.0
"""Furthest that a goal is shown, m: it was trained on steps of about that size."""
FASTEST = 2.0
"""Largest velocity relative to the goal's that it is shown, m/s."""
_VECTORS = ("goal - position", "velocity", "thrust axis", "nose", "body rate")
_REFERENCE = "reference velocity"


class Raptor:
    """Flies a quadcopter to the goal of a task, as its authors' example does: position, attitude,
    velocity, body rates and the last action in, four motor commands out, at 100 Hz.

    A motor command of -1 to 1 is a throttle of 0 to 1. Raises `InputError` for an env that lacks
    what it needs.
    """

    options: ClassVar[Mapping[str, object]] = {"action": "rotors", "control_period": 0.01}

    def __init__(self, spec: EnvSpec) -> None:
        try:
            from foundation_policy import Raptor as Policy
        except ImportError:
            raise InputError(
                "raptor: expected its package; install it: pip install foundation-policy h5py"
            ) from None
        self._spec = spec
        names = [name for array in spec.observation for name in component_names(array)]
        for vector in _VECTORS:
            if f"{vector} x" not in names:
                raise InputError(f"raptor: expected the observation '{vector} x', got none")
        known = [vector for vector in (*_VECTORS, _REFERENCE) if f"{vector} x" in names]
        self._at = {v: [names.index(f"{v} {axis}") for axis in "xyz"] for v in known}
        vehicle = vehicle_of(spec)
        config = EnvConfig.from_keywords(spec.env_id, **spec.options)
        places = [np.sign(rotor.position[:2]).astype(int).tolist() for rotor in vehicle.rotors]
        if sorted(places) != sorted(map(list, CORNERS)):
            raise InputError(f"raptor: expected a rotor in each corner, got {vehicle.name}")
        self._order = [places.index(list(corner)) for corner in CORNERS]
        self._propellers = Propellers(config, vehicle)
        self._hover = vehicle.hover_thrust
        self._above = vehicle.thrust_high - vehicle.hover_thrust
        self._below = vehicle.hover_thrust - vehicle.thrust_low
        self._policy = Policy()
        self.reset()

    def reset(self) -> None:
        """Forget the last episode, and the craft."""
        self._policy.reset()
        self._last = np.zeros(4)

    def act(self, observation: Observation) -> Floats:
        """Action of the level `rotors`, float32, shape (4,)."""
        numbers = flat(observation, self._spec).astype(np.float64)
        seen = {name: numbers[at] for name, at in self._at.items()}
        nose, up = seen["nose"], seen["thrust axis"]
        axes = np.stack((nose, np.cross(up, nose), up), axis=1)
        position = np.clip(-seen["goal - position"], -REACH, REACH)
        velocity = seen["velocity"] - seen.get(_REFERENCE, 0.0)
        velocity = np.clip(velocity, -FASTEST, FASTEST)
        told = (position, axes.ravel(), velocity, seen["body rate"], self._last)
        (motors,) = self._policy.evaluate_step(np.concatenate(told)[None])
        self._last = np.clip(motors, -1.0, 1.0)
        throttles = np.zeros(4)
        throttles[self._order] = 0.5 + 0.5 * self._last
        over = self._propellers.commands(throttles) - self._hover
        action: Floats = np.where(over > 0.0, over / self._above, over / self._below)
        return action.astype(np.float32)


def vehicle_of(spec: EnvSpec) -> Vehicle:
    """The vehicle of the library that an env flies. Raises `InputError` for another."""
    drag = spec.options.get("effects", {}).get("linear_drag", 0.0)
    for name in vehicle_names():
        vehicle = Vehicle.load(name, linear_drag=drag)
        if vehicle.hash == spec.vehicle_hash:
            return vehicle
    raise InputError(f"raptor: expected a vehicle of the library, got {spec.vehicle_text}")

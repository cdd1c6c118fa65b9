"""A hand-tuned PID controller: the classical baseline of `Elevation-v0`."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from ..envs.spec import EnvSpec
from ..models.errors import InputError
from .layers import Floats
from .policies import Array, Observation

ENV_ID = "rotorgram/Elevation-v0"
GRAVITY = 9.8  # m/s²: the paper's
PROPORTIONAL = 9.0  # 1/s²: closed-loop natural frequency of 3 rad/s
DERIVATIVE = 5.4  # 1/s: damping ratio 0.9
INTEGRAL = 1.0  # 1/s³: there is no steady load to remove here; an unknown mass would be one
INTEGRAL_BAND = 0.02  # m: the integral grows only this near the target, against windup
SHARES = {"increment": 0.05, "offset": 0.2}
"""Thrust per unit of action over the rotors' largest, where the option `thrust_scale` is None."""


class PID:
    """Wanted acceleration from E, its rate and its integral; then the thrust that gives it.

    Needs the full observation and continuous actions. It derives the vehicle's numbers from the
    spec: the bounds of the rotors' thrust in the telemetry, N, over those in the observation,
    relative to hover, give the thrust at hover, and that over g the mass that a rotor carries.
    Raises `InputError` for another env, or where options or telemetry lack what it needs.
    """

    options: ClassVar[Mapping[str, object]] = {}
    """Options of the env that it needs."""
    many = True

    def __init__(self, spec: EnvSpec) -> None:
        options = spec.options
        if spec.env_id != ENV_ID:
            raise InputError(
                f"pid: expected the env {ENV_ID}, got {spec.env_id}: "
                "geometric flies tasks with a goal"
            )
        modes = f"{options['observation']!r} and {options['action_type']!r}"
        if modes != "'full' and 'continuous'":
            raise InputError(
                f"pid: expected observation='full' and action_type='continuous', got {modes}"
            )
        telemetry = {array.name: array for array in spec.telemetry}
        if "thrust" not in telemetry:
            raise InputError(f"pid: expected the telemetry thrust, got {sorted(telemetry)}")
        highest = telemetry["thrust"].bounds()[1]
        most_over_hover = float(spec.observation[0].bounds()[1][2])
        self._hover = float(highest[0]) / (1 + most_over_hover)
        self._increment = options["action"] == "increment"
        share = SHARES[options["action"]]
        self._scale = options["thrust_scale"] or share * float(highest.max())
        self._period = spec.control_period
        self._name = spec.observation[0].name
        self.reset()

    def reset(self) -> None:
        """Forget the integral."""
        self._integral: Array = np.zeros(())

    def act(self, observation: Observation) -> Floats:
        """Change of thrust, or thrust over hover, as the env's action, float32, shape (1,)."""
        own = observation[self._name] if isinstance(observation, Mapping) else observation
        # The newest of a history.
        error, rate, thrust = np.moveaxis(own[..., -3:].astype(np.float64), -1, 0)
        near = np.abs(error) < INTEGRAL_BAND
        self._integral = self._integral + np.where(near, error, 0.0) * self._period
        acceleration = PROPORTIONAL * error + DERIVATIVE * rate + INTEGRAL * self._integral
        wanted = acceleration * self._hover / GRAVITY
        if self._increment:
            wanted = wanted - thrust * self._hover
        action: Floats = np.clip(wanted / self._scale, -1.0, 1.0)[..., None].astype(np.float32)
        return action

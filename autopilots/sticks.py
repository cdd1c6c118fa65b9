"""Sticks of a remote control: what a policy asks for, down to the attitude or the body rates.

The policy is one of ours, of a level from `rates` to `position`. Without one, `geometric` flies to
the goal. The loops of the level turn its action into what a flight controller takes as sticks.
"""

import copy
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from ..agents.geometric import Geometric
from ..agents.policies import Observation, Policy
from ..envs.config import EnvConfig
from ..envs.registry import env_spec
from ..envs.spec import EnvSpec
from ..models import InputError, Vehicle
from ..sim.control import make_controller
from ..sim.control.cascade import Attitude, Rates, tilt_of
from ..sim.rotations import axes_of
from .reading import Floats, Reading

PERIOD = 0.01
"""Time between two positions of the sticks without a policy, s."""
LAG = 0.02
"""Least lag of rotors for which its loops are made, s: a flight controller makes up for half."""


class Pilot(NamedTuple):
    """A policy of ours that moves the sticks."""

    policy: Policy
    spec: EnvSpec
    """Of the env that it was trained in."""
    matches: bool = True
    """Whether the rate loops are to be as fast as those of that env."""


class StickPilot:
    """What a pilot asks for with its sticks: an attitude, or body rates where it is `acro`.

    Attributes:
        period: Time between two positions of the sticks, s.
        acro: Whether its demands are body rates; always so with a policy of the level `rates`.
        gains: Of its loops.
    """

    def __init__(
        self, config: EnvConfig, vehicle: Vehicle, pilot: Pilot | None, acro: bool
    ) -> None:
        """Raises `InputError` for a policy that cannot fly so."""
        if pilot is None:
            level = "position"
            spec = env_spec(config.changed(action=level, control_period=PERIOD))
            lag = max(vehicle.coefficients["rotors.time_constant"] or 0.0, LAG)
            loops = make_controller(level, vehicle, PERIOD + lag / 2)
        else:
            spec = pilot.spec
            level = str(spec.options["action"])
            loops = make_controller(level, vehicle, vehicle.timestep, config.effects)
        if not isinstance(loops, Rates):
            raise InputError(
                "policy: expected one of the levels rates, attitude, velocity or position, "
                f"got {level}"
            )
        if pilot is None:
            constants = {**spec.constants, **loops.constants}
            self._policy: Policy = Geometric(replace(spec, constants=constants))
        else:
            other = set(spec.observation).difference(env_spec(config).observation)
            if other:
                names = ", ".join(f"{one.name} of shape {one.shape}" for one in other)
                raise InputError(
                    f"policy: expected one that observes what {config.env_id} shows here, "
                    f"got {spec.env_id} with {names}"
                )
            self._policy = copy.deepcopy(pilot.policy)
        self._policy.reset()
        self.period = spec.control_period
        self.acro = acro or not isinstance(loops, Attitude)
        self.gains = loops.gains
        self._loops = loops

    def held(self, weight: float, reading: Reading) -> Floats:
        """Demands of a craft on its stand, so that no loop winds up there."""
        if self.acro:
            return np.array((weight, 0.0, 0.0, 0.0))
        nose, _, up = axes_of(reading.quaternion)
        return np.array((weight, *tilt_of(up, nose), 0.0))

    def demands(self, reading: Reading, observation: Observation) -> Floats:
        """Collective thrust, N, with roll and pitch, rad, and yaw rate, rad/s, or with body rates,
        rad/s; shape (4,).
        """
        action = np.asarray(self._policy.act(observation), np.float64)
        state: Any = SimpleNamespace(quaternion=reading.quaternion, velocity=reading.velocity)
        loops = self._loops
        if self.acro:
            collective, rates = loops.demands(action, state)
            return np.array((collective, *rates))
        assert isinstance(loops, Attitude)
        axes = axes_of(reading.quaternion)
        collective, axis, yaw_rate = loops.aimed(action, axes, state)
        return np.array((collective, *tilt_of(axis, axes[0]), yaw_rate))

"""Effects: what acts on a drone besides gravity, contact and ideal rotors (no lag, no losses).

Each is off by default, and a world without effects computes the same bits as if there were none.
Each is computed once per physics step: the thrust of each rotor from its command, and a force and a
torque from the motion through the air, all as means over the step. Coefficients are those of the
vehicle's file (`Vehicle.coefficients`).

Where the air is concerned, the motion is extrapolated to the middle of the step, so that the error
is of second order in the step. Sums over rotors and axes are written out, since a drone has to get
the same bits alone and in a batch.
"""

from collections.abc import Callable, Mapping

from ... import models
from ...models import InputError
from ..random import GUSTS, Noise
from ..rotations import Parts, add
from ..snapshots import Kept
from ..state import Array, ByName, WorldState, stack
from .air import AirEffects
from .downwash import Downwash
from .gusts import NUMBERS, Gusts
from .options import NO_EFFECTS, PUSH, EffectOptions
from .rotors import RotorEffects

__all__ = ["NO_EFFECTS", "EffectOptions", "Effects"]


class Effects(Kept):
    """The effects on W worlds, in the order in which they act.

    Attributes:
        on_rotors: Whether the thrust of a rotor may differ from its command.
        on_body: Whether there is a force or a torque besides the rotors'.
        rotors: From commands to thrusts.
        air: From the motion to a force and a torque.
    """

    def __init__(
        self,
        vehicle: "models.Vehicle",
        options: EffectOptions,
        noise: Callable[[str, int], Noise],
        drawn: tuple[str, ...] = (),
    ) -> None:
        """`noise`: that of the world. `drawn`: names of the randomised parameters in `factors`."""
        self.rotors = RotorEffects(vehicle, options)
        scaled = [name for name in drawn if name.startswith("thrust")]
        for name in scaled:
            if name not in ("thrust", *self.rotors.names):
                count = vehicle.num_rotors
                raise InputError(f"{name}: expected one of the {count} rotors of the vehicle")
        self.on_rotors = self.rotors.acts or bool(scaled)
        self.air = AirEffects(vehicle, options)
        self._is_pushed = not set(PUSH).isdisjoint(drawn)
        self.on_body = self.air.acts or self._is_pushed
        self._mean_wind = options.wind
        blows = options.gusts or options.downwash or any(options.wind)
        if blows and not (options.body_drag or options.rotor_drag):
            raise InputError(
                "effects: expected body_drag or rotor_drag, on which wind acts, got neither"
            )
        self._downwash = Downwash(vehicle) if options.downwash else None
        self._gusts: Gusts | None = None
        if options.gusts:
            self._gusts = Gusts(options.gusts, options.wind, vehicle.timestep)
            self._noise = noise(GUSTS, NUMBERS)

    def begin(self, mask: Array, state: WorldState, factors: ByName) -> Array:
        """Begin episodes of the worlds of a mask, bool, (W, A), at their rows of `state`.

        Factors of the drawn parameters by name, (W, A), for all worlds. Returns the thrusts of the
        worlds that begin, (W, A, R), N.
        """
        self.take(factors, state.craft)
        thrust = state.thrust
        if self.on_rotors:
            thrust = self.rotors.begin(mask, thrust, factors)
        if self.on_body:
            self.air.begin(mask, state)
        if self._gusts is not None:
            height = state.position[..., 2]
            normal = self._noise.normal(mask)
            self._gusts.begin(mask, height, normal, factors.get("gusts", 1.0))
        return thrust

    @property
    def wind(self) -> Parts:
        """Velocity of the air without downwash, world frame, m/s: x, y, z.

        Each has the shape (W, A), or is one number for all.
        """
        if self._gusts is None:
            return self._wind
        return add(self._wind, self._gusts.velocity)

    def take(self, factors: ByName, craft: Array = None) -> None:
        """Take factors as of `begin`, and the numbers of drawn craft, `WorldState.craft`."""
        if self.on_rotors:
            self.rotors.take(factors, craft)
        if self.on_body:
            self.air.take(factors)
        if self._is_pushed:
            self._push = stack([factors.get(name, 0.0) for name in PUSH])
        both = zip(self._mean_wind, "xyz", strict=True)
        self._wind = [mean + factors.get(f"wind_{axis}", 0.0) for mean, axis in both]

    def parts(self) -> Mapping[str, Kept | None]:
        """Rotors, air, and gusts."""
        return {"rotors": self.rotors, "air": self.air, "gusts": self._gusts}

    def step(self, state: WorldState, mask: Array | None) -> tuple[Array, Array, Array | None]:
        """Advance the worlds of a mask, None for all, by a physics step, from `state` on.

        Returns the mean thrust of each rotor over the step and its thrust at the end, N, (W, A, R).
        Third, (W, A, 6) or None, the force (world frame, N) and the torque about the body's origin
        (body frame, N·m).
        """
        mean = end = state.command
        root = None
        if self.on_rotors:
            mean, end, root = self.rotors.step(state.command, mask)
        if not self.air.acts:
            return mean, end, self._push if self._is_pushed else None
        if self._gusts is not None:
            self._gusts.step(mask, self._noise.normal(mask))
        wind = self.wind
        if self._downwash is not None and state.position.shape[1] > 1:
            wind = add(wind, self._downwash.air(state))
        wrench = self.air.step(state, mean, root, wind, mask)
        return mean, end, wrench + self._push if self._is_pushed else wrench

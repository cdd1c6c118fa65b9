"""From the command of a rotor to its thrust: throttle, curve, battery, lag, efficiency."""

import numpy as np

from ... import models
from ...models import InputError
from ...models.drawn import columns
from ..elementary import expm1, polynomial
from ..snapshots import Kept
from ..state import Array, ByName, chosen, clip, square_root, stack, total
from .options import EffectOptions


class RotorEffects(Kept):
    """Rotors of W worlds.

    The chain, once in every physics step: a command in newtons is a throttle u, as if thrust were
    proportional to it; the curve, where it is on, gives the thrust at u and full voltage; the
    battery scales it by (voltage / full voltage)²; the square root of the thrust, which is
    proportional to the rotor's speed, follows with the time constant, exactly over the step; the
    efficiency scales what the rotor then gives.

    The terminal voltage V = E - resistance · power / V, with E the open-circuit voltage. With lag
    the power is that of the rotors' speeds. Without it the power is that at V, power · (V / full)³,
    and V solves both equations. An empty battery stays at its empty voltage.

    Attributes:
        acts: Whether an effect is on.
        names: Of the drawn factors of each rotor's thrust.
        charge: Of the battery, share, shape (W, A).
        voltage: At its terminals, V, shape (W, A).
    """

    arrays = ("charge", "voltage", "_roots")
    charge: Array = None
    voltage: Array = None
    _roots: Array = None
    """Of the thrusts, proportional to the rotors' speeds."""

    def __init__(self, vehicle: "models.Vehicle", options: EffectOptions) -> None:
        self._options = options
        self.acts = bool(
            options.motor_lag or options.thrust_curve or options.battery or options.efficiency
        )
        self._step = vehicle.timestep
        coefficients = vehicle.coefficients
        self._limits = vehicle.thrust_low, vehicle.thrust_high
        if options.motor_lag:
            (rise,) = coefficients.need("rotors.time_constant", "motor_lag")
            fall = coefficients["rotors.time_constant_down"]
            self._times = [rise] if fall in (None, rise) else [rise, fall]
        if options.thrust_curve:
            (curve,) = coefficients.need("rotors.curve", "thrust_curve")
            self._curve = (0.0, *curve[::-1])
            most = max(polynomial(i / 100, self._curve) for i in range(101))
            ends = sum(curve)
            if not (abs(ends - 1) < 1e-3 and most < 1 + 1e-3):
                raise InputError(
                    "rotors.curve: expected a curve that ends at the largest thrust, c₀ + c₁ + ... "
                    f"= 1, and is no higher, got an end of {ends:.4g}, and up to {most:.4g}"
                )
        if options.battery:
            names = "battery.full battery.empty battery.capacity battery.resistance rotors.power"
            numbers = coefficients.need(names, "battery")
            self._full, self._empty, capacity, self._resistance, self._watts = numbers
            self._coulombs = 3600 * capacity
            if self._empty > self._full:
                raise InputError(
                    f"battery.empty: expected at most battery.full, {self._full:g} V, "
                    f"got {self._empty:g} V"
                )
        one_way = options.motor_lag or options.thrust_curve or options.battery
        if one_way and (vehicle.thrust_low < 0).any():
            raise InputError(
                "vehicle: expected rotors that push one way only, for motor_lag, thrust_curve and "
                "battery, got a thrust below 0"
            )
        share = options.efficiency
        count = vehicle.num_rotors
        if share and len(share) != count:
            raise InputError(
                f"effects.efficiency: expected {count} numbers, one for each rotor, got {share}"
            )
        self.names = [f"thrust_{number}" for number in range(1, count + 1)]

    def begin(self, mask: Array, thrust: Array, factors: ByName) -> Array:
        """Start the rotors at the speeds that these thrusts need; factors as of `take`.

        Returns the thrusts that they give, (W, A, R), N.
        """
        thrust = thrust.astype(np.float64)
        self._roots = chosen(mask, square_root(thrust), self._roots)
        if self._options.battery:
            charge = factors.get("battery_charge", 1.0) + 0.0 * thrust[..., 0]
            self.charge = chosen(mask, charge, self.charge)
            self.voltage = chosen(mask, self._terminal(), self.voltage)
        return self._scaled(thrust)

    def take(self, factors: ByName, craft: Array = None) -> None:
        """Take the factors of drawn parameters, (W, A), by name, and the numbers of drawn craft."""
        options = self._options
        self._scales: list[Array] = []
        if options.efficiency:
            self._scales.append(np.array(options.efficiency))
        if "thrust" in factors:
            self._scales.append(factors["thrust"][..., None])
        if factors.keys() & set(self.names):
            self._scales.append(stack([factors.get(name, 1.0) for name in self.names]))
        if options.motor_lag:
            times = self._times if craft is None else [columns(craft)["lag"]]
            if "time_constant" in factors:
                times = [time * factors["time_constant"][..., None] for time in times]
            self._answers = [self._answer(time) for time in times]

    def step(self, command: Array, mask: Array | None) -> tuple[Array, Array, Array | None]:
        """Advance by a physics step: mean thrusts over it, and those at its end, (W, A, R), N.

        Third, the mean of their square roots over it, which is proportional to the mean speed; None
        where the thrusts do not change over it.
        """
        options = self._options
        low, high = self._limits
        target = clip(command, low, high)
        if options.thrust_curve:
            target = high * clip(polynomial(target / high, self._curve), 0.0, 1.0)
        if options.battery:
            if not options.motor_lag:
                self.voltage = chosen(mask, self._loaded(target), self.voltage)
            share = self.voltage / self._full
            target = target * (share * share)[..., None]
        mean = end = target
        middle = None
        if options.motor_lag:
            mean, roots, middle = self._follow(square_root(target))
            end = roots * roots
            self._roots = chosen(mask, roots, self._roots)
        if options.battery:
            used = self._power(mean) / self.voltage * (self._step / self._coulombs)
            left = clip(self.charge - used, 0.0, 1.0)
            self.charge = chosen(mask, left, self.charge)
            if options.motor_lag:
                self.voltage = self._terminal()
        if middle is not None:
            for scale in self._scales:
                middle = middle * square_root(scale)
        return self._scaled(mean), self._scaled(end), middle

    def _scaled(self, thrust: Array) -> Array:
        """Thrusts after the efficiency and the drawn factors."""
        for scale in self._scales:
            thrust = thrust * scale
        return thrust

    def _answer(self, time: Array) -> tuple[Array, Array, Array]:
        """Of exp(-t / time) over a physics step: 1 - its end, its mean, the mean of its square."""
        ratio = self._step / time
        gone = -expm1(-ratio)
        return gone, gone / ratio, gone * (2 - gone) / (2 * ratio)

    def _follow(self, wanted: Array) -> tuple[Array, Array, Array]:
        """Roots that follow `wanted` over a step: their mean square, their end and their mean."""
        off = self._roots - wanted
        gone, first, second = self._answers[0]
        if len(self._answers) == 2:
            rises = off < 0
            pairs = zip(*self._answers, strict=True)
            gone, first, second = (np.where(rises, up, down + 0.0 * off) for up, down in pairs)
        # The square of: wanted + off · exp(-t / time).
        mean = wanted * wanted + off * (2 * wanted * first + off * second)
        return mean, self._roots - off * gone, wanted + off * first

    def _open_voltage(self) -> Array:
        return self._empty + (self._full - self._empty) * self.charge

    def _loaded(self, target: Array) -> Array:
        """Voltage where the rotors give `target` · (voltage / full)² at once."""
        opened = self._open_voltage()
        drop = self._resistance * self._power(target) / (self._full * self._full * self._full)
        return 2 * opened / (1 + square_root(1 + 4 * drop * opened))

    def _terminal(self) -> Array:
        """Voltage at the rotors' speeds; half the open one if they need more than there is."""
        opened = self._open_voltage()
        power = self._power(self._roots * self._roots)
        rest = opened * opened - 4 * self._resistance * power
        return 0.5 * (opened + square_root(rest))

    def _power(self, thrust: Array) -> Array:
        """Electrical power of all rotors, W, shape (W, A)."""
        return self._watts * total(thrust * square_root(thrust))

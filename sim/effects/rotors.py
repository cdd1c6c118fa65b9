"""From the command of a rotor to its thrust: throttle, curve, battery, lag, efficiency."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from ...models.errors import expect
from ..state import Array, clip, component, constant, each
from .options import EffectOptions

if TYPE_CHECKING:
    from ...models.vehicle import Vehicle


class RotorEffects:
    """Rotors of W worlds.

    The chain, once in every physics step: a command in newtons is a throttle u, as if thrust were
    proportional to it; the curve, where it is on, gives the thrust at u and full voltage; the
    battery scales it by (voltage / full voltage)²; the square root of the thrust, which is
    proportional to the rotor's speed, follows with the time constant, exactly over the step; the
    efficiency scales what the rotor then gives.

    Attributes:
        charge: Of the battery, share, shape (W, A).
        voltage: At its terminals, V, shape (W, A).
    """

    def __init__(self, vehicle: "Vehicle", options: EffectOptions, xp: Any) -> None:
        self._vehicle, self._options, self._xp = vehicle, options, xp
        self._step = vehicle.timestep
        told = vehicle.coefficients
        self._low, self._high = vehicle.thrust_low, vehicle.thrust_high
        if options.motor_lag:
            (rise,) = told.need("rotors.time_constant", "motor_lag")
            fall = told.rotors.time_constant_down
            self._times = rise, rise if fall is None else fall
        if options.thrust_curve:
            (self._curve,) = told.need("rotors.curve", "thrust_curve")
            most = max(_polynomial(self._curve, i / 100) for i in range(101))
            expected = (
                "a curve that ends at the largest thrust, c₀ + c₁ + ... = 1, and is no higher"
            )
            ends = sum(self._curve)
            right = abs(ends - 1) < 1e-3 and most < 1 + 1e-3
            expect(right, "rotors.curve", expected, f"an end of {ends:.4g}, and up to {most:.4g}")
        if options.battery:
            names = "battery.full battery.empty battery.capacity battery.resistance rotors.power"
            self._battery = told.need(names, "battery")
            expect(self._battery[1] <= self._battery[0], "battery", "empty at most full")
        if options.motor_lag or options.thrust_curve or options.battery:
            pushes = bool((vehicle.thrust_low >= 0).all())
            expected = "rotors that push one way only, for motor_lag, thrust_curve and battery"
            expect(pushes, "vehicle", expected, "a thrust below 0")
        share, count = options.efficiency, vehicle.num_rotors
        right = len(share) in (0, count)
        expect(right, "effects: efficiency", f"{count} numbers, one for each rotor", f"{share}")
        self._factors: dict[str, Array] = {}
        self._root: Array = None  # of the thrust, proportional to the rotor's speed
        self.charge: Array = None
        self.voltage: Array = None

    def begin(self, mask: Array, thrust: Array, factors: dict[str, Array]) -> None:
        """Begin with rotors that give such thrusts, (W, A, R); factors (W, A) by parameter."""
        xp, chosen = self._xp, mask[..., None]
        self._factors = factors
        root = xp.sqrt(clip(thrust, 0.0, math.inf))
        self._root = root if self._root is None else xp.where(chosen, root, self._root)
        if self._options.battery:
            charge = factors.get("battery_charge", 1.0) + 0.0 * component(thrust, 0)
            self.charge = charge if self.charge is None else xp.where(mask, charge, self.charge)
            self.voltage = self._terminal(self._open_voltage(), self._root)

    def step(self, command: Array, mask: Array | None) -> tuple[Array, Array]:
        """Advance by a physics step: mean thrusts over it, and those at its end, (W, A, R), N."""
        xp, options, factors = self._xp, self._options, self._factors
        low, high = (constant(x, command) for x in (self._low, self._high))
        target = clip(command, low, high)
        if options.thrust_curve:
            target = high * clip(_polynomial(self._curve, target / high), 0.0, 1.0)
        if options.battery:
            full, capacity = self._battery[0], self._battery[2]
            share = self.voltage / full
            target = target * each(share * share)
        mean = end = target
        if options.motor_lag:
            root, wanted = self._root, xp.sqrt(target)
            off, h = root - wanted, self._step
            time = xp.where(off < 0, self._times[0], self._times[1])
            if "time_constant" in factors:
                time = time * each(factors["time_constant"])
            ratio = h / time
            decay = xp.exp(-ratio)
            # Of w² with w = wanted + off · exp(-t / time), over the step.
            first, second = (1 - decay) / ratio, (1 - decay * decay) / (2 * ratio)
            mean = wanted * wanted + off * (2 * wanted * first + off * second)
            root = wanted + off * decay
            end = root * root
        else:
            root = xp.sqrt(target) if options.battery else None
        if options.battery:
            power = self._power(mean)
            charge = self.charge - power / self.voltage * (self._step / (3600 * capacity))
            charge = clip(charge, 0.0, 1.0)
            self.charge = charge if mask is None else xp.where(mask, charge, self.charge)
        if root is not None:
            keep = self._root if mask is not None else None
            self._root = root if mask is None else xp.where(mask[..., None], root, keep)
        if options.battery:
            self.voltage = self._terminal(self._open_voltage(), self._root)
        for factor in self._scales(command):
            mean, end = mean * factor, end * factor
        return mean, end

    def _scales(self, like: Array) -> list[Array]:
        scales = []
        if self._options.efficiency:
            scales.append(constant(np.array(self._options.efficiency), like))
        if "thrust" in self._factors:
            scales.append(each(self._factors["thrust"]))
        return scales

    def _open_voltage(self) -> Array:
        full, empty = self._battery[:2]
        return empty + (full - empty) * self.charge

    def _terminal(self, opened: Array, root: Array) -> Array:
        """V of: V = opened - resistance · power / V; half of `opened` where there is none."""
        rest = opened * opened - 4 * self._battery[3] * self._power(root * root)
        return 0.5 * (opened + self._xp.sqrt(clip(rest, 0.0, math.inf)))

    def _power(self, thrust: Array) -> Array:
        """Electrical power of all rotors, W, shape (W, A)."""
        return self._battery[4] * total(thrust * self._xp.sqrt(clip(thrust, 0.0, math.inf)))


def total(values: Array) -> Array:
    """Sum over the last axis, one after the other: the same bits alone and in a batch."""
    result = component(values, 0)
    for index in range(1, values.shape[-1]):
        result = result + component(values, index)
    return result


def _polynomial(coefficients: tuple[float, ...], x: Any) -> Any:
    result = coefficients[-1]
    for c in coefficients[-2::-1]:
        result = result * x + c
    return result

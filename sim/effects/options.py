"""Which effects are on."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from numbers import Real
from typing import Any, Final, Self

from ...models import MAX_DRAG
from ...models.errors import InputError

MAX_WIND: Final = 100.0  # m/s


@dataclass(frozen=True, kw_only=True)
class EffectOptions:
    """Which effects are on. A wrong option raises `InputError` with one sentence.

    Numbers and lists of numbers may be of any real type; they are kept as floats and tuples.
    """

    motor_lag: bool = False
    """Rotor speed follows its command with a time constant (`rotors.time_constant`)."""
    thrust_curve: bool = False
    """Thrust over throttle is the polynomial `rotors.curve`; otherwise it is proportional."""
    battery: bool = False
    """Thrust falls with the square of the voltage, which sags under load and with the charge."""
    body_drag: bool = False
    """Linear and quadratic drag of the body (`drag.linear`, `drag.quadratic`)."""
    rotor_drag: bool = False
    """Drag, inflow and lift of rotors in moving air (`rotors.drag`, `inflow` and `lift`)."""
    ground_effect: bool = False
    """More thrust near the ground, after Cheeseman and Bennett (`rotors.radius`)."""
    downwash: bool = False
    """Air that the other drones of the world blow down (`rotors.radius`); it acts as wind does."""
    wind: tuple[float, ...] = (0.0, 0.0, 0.0)
    """Velocity of the air: x, y, z in MuJoCo's world frame, m/s."""
    gusts: float = 0.0
    """Dryden turbulence for this wind speed at a height of 20 feet (6 m), m/s."""
    efficiency: tuple[float, ...] = ()
    """Share of its thrust that each rotor gives, 0 to 1; empty: all of it."""
    payload: float = 0.0
    """Mass that hangs on a cable from the body's origin, kg. Several drones of a world carry one
    ball together, of so much for each."""
    cable: float = 1.0
    """Length of each cable, m."""
    linear_drag: float = 0.0
    """Acceleration of -linear_drag · velocity, 1/s, as Unity's `Rigidbody.drag`; at most 100. The
    force acts at the body's origin."""

    def __post_init__(self) -> None:
        for name in ("motor_lag", "thrust_curve", "battery", "body_drag", "rotor_drag"):
            self._check(name, "true or false", type(getattr(self, name)) is bool)
        for name in ("ground_effect", "downwash"):
            self._check(name, "true or false", type(getattr(self, name)) is bool)
        self._keep("linear_drag", 0.0, MAX_DRAG, "/s", 1)
        self._keep("wind", -MAX_WIND, MAX_WIND, "m/s", 3)
        self._keep("efficiency", 0.0, 1.0, "for each rotor")
        self._keep("gusts", 0.0, MAX_WIND, "m/s", 1)
        self._keep("payload", 0.0, 1e4, "kg", 1)
        self._keep("cable", 0.05, 100.0, "m", 1)

    def _keep(self, name: str, low: float, high: float, unit: str, count: int = 0) -> None:
        given = getattr(self, name)
        number = "a number" if count == 1 else f"{count or ''} numbers".strip()
        try:
            listed = [given] if count == 1 else list(given)
        except TypeError:
            listed = [None]
        right = count in (0, len(listed)) and all(_is_number(x, low, high) for x in listed)
        self._check(name, f"{number} from {low:g} to {high:g} {unit}", right)
        numbers = tuple(float(x) for x in listed)
        object.__setattr__(self, name, numbers[0] if count == 1 else numbers)

    def _check(self, name: str, expected: str, right: bool) -> None:
        if not right:
            raise InputError(
                f"effects: {name}: expected {expected}, got {getattr(self, name)!r:.80}"
            )

    @classmethod
    def from_options(cls, options: Any) -> Self:
        """Options by name. An unknown name raises `InputError`, which names those there are."""
        known = ", ".join(one.name for one in fields(cls))
        if not isinstance(options, Mapping):
            raise InputError(
                f"effects: expected a mapping from names to values, got {options!r:.80}"
            )
        for name in options:
            if name not in known.split(", "):
                raise InputError(f"effects: expected some of {known}, got {name!r:.300}")
        return cls(**options)

    def to_options(self) -> dict[str, Any]:
        """The reverse of `from_options`: those that differ from their default."""
        return {
            one.name: getattr(self, one.name)
            for one in fields(self)
            if getattr(self, one.name) != one.default
        }

    @property
    def wind_blows(self) -> bool:
        """Whether the air moves."""
        return self.gusts > 0 or self.downwash or any(self.wind)


def _is_number(value: Any, low: float, high: float) -> bool:
    real = isinstance(value, Real) and not isinstance(value, bool)
    return real and low <= value <= high

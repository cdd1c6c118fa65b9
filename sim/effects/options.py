"""Which effects are on."""

from typing import Annotated

from ...models import MAX_DRAG
from ...models.fields import Limits, check_fields, immutable

MAX_WIND = 100.0  # m/s
PUSH = ("push_x", "push_y", "push_z", "twist_x", "twist_y", "twist_z")
"""Names of a force at a body's origin, world frame, N, and a torque, body frame, N·m."""


@immutable
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
    wind: Annotated[tuple[float, ...], Limits(-MAX_WIND, MAX_WIND, "m/s", count=3)] = (
        0.0,
        0.0,
        0.0,
    )
    """Velocity of the air: x, y, z in MuJoCo's world frame, m/s."""
    gusts: Annotated[float, Limits(0.0, MAX_WIND, "m/s")] = 0.0
    """Dryden turbulence for this wind speed at a height of 20 feet (6 m), m/s."""
    efficiency: Annotated[
        tuple[float, ...], Limits(0.0, 1.0, "for each rotor", count=0, least=0)
    ] = ()
    """Share of its thrust that each rotor gives, 0 to 1; empty: all of it."""
    payload: Annotated[float, Limits(0.0, 1e4, "kg")] = 0.0
    """Mass that hangs on a cable from the body's origin, kg. Several drones of a world carry one
    ball together, with this mass for each drone."""
    cable: Annotated[float, Limits(0.05, 100.0, "m")] = 1.0
    """Length of each cable, m."""
    linear_drag: Annotated[float, Limits(0.0, MAX_DRAG, "/s")] = 0.0
    """Acceleration of -linear_drag · velocity, 1/s, as Unity's `Rigidbody.drag`; at most 100. The
    force acts at the body's origin."""

    def __post_init__(self) -> None:
        check_fields(self, "effects.")

    def to_options(self) -> dict[str, object]:
        """Options by name that differ from their default."""
        given = vars(self).items()
        return {name: value for name, value in given if value != getattr(EffectOptions, name)}


NO_EFFECTS = EffectOptions()

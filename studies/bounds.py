"""Bounds of the elevation task: nearly the largest return, and that of hovering in place.

**Time-optimal.** From rest at the start to rest on the target in the least time that
gravity and the action's limits allow. For a double integrator, and for one whose acceleration has a
limited change per step, that is bang-bang control: everything towards the target up to one moment,
everything against it up to a second, and, where the change of thrust is limited, everything back to
hover. The two moments follow from the two conditions at the end, no speed and no distance, by
bisection within bisection. They may lie inside a control step; that step gets the mean action.
The thrust is exact, the model is free of noise and the first step already knows the target: an
agent comes near this return and does not exceed it by more than what one control step is worth.

**Hover.** The thrust stays at hover: E stays what it was at the start.
"""

from collections.abc import Callable
from typing import Final

import numpy as np
import numpy.typing as npt
from rotorgram.agents.pid import SHARES
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.tasks.elevation import ElevationOptions
from rotorgram.envs.tasks.goal import ERROR_SCALE
from rotorgram.envs.tasks.racing import RacingOptions, read_track
from rotorgram.envs.tasks.recovery import Recovery, RecoveryOptions
from rotorgram.envs.tasks.waypoints import WaypointsOptions
from rotorgram.models.vehicle import Vehicle

_HALVINGS: Final = 24
RECOVERY: Final = "rotorgram/Recovery-v0"

Floats = npt.NDArray[np.float64]


def elevation_bounds(config: EnvConfig, vehicle: Vehicle, starts: Floats) -> dict[str, float]:
    """Mean returns of the two flights by name, over episodes that start at E in m, shape (n,)."""
    options = ElevationOptions.from_options(config.task)
    steps = config.episode_length or 0
    period = config.control_period or 0.0
    # Largest accelerations up and down, m/s², and the largest change of one in a control step.
    up = float(vehicle.thrust_high.sum()) / vehicle.mass - vehicle.gravity
    down = vehicle.gravity - float(vehicle.thrust_low.sum()) / vehicle.mass
    newtons = options.thrust_scale or SHARES[config.action or ""] * float(vehicle.thrust_high.max())
    change = vehicle.num_rotors * newtons / vehicle.mass
    if config.action == "offset":
        up = min(up, change)
        down = min(down, change)
        change = np.inf
    rising = starts > 0
    towards = np.where(rising, up, down)
    against = np.where(rising, down, up)
    drag = config.effects.linear_drag
    left = bang_bang(np.abs(starts), steps, period, towards, against, change, drag)
    return {
        "time-optimal": float(elevation_reward(left).sum(axis=1).mean()),
        "hover": float(steps * elevation_reward(starts).mean()),
    }


def elevation_reward(errors: Floats) -> Floats:
    """(s - |E|) / (s + |E|) for E in m; same shape."""
    sizes = np.abs(errors)
    return np.asarray((ERROR_SCALE - sizes) / (ERROR_SCALE + sizes))


def bang_bang(
    distance: Floats, steps: int, period: float, towards: Floats, against: Floats,
    change: float = np.inf, drag: float = 0.0,
) -> Floats:  # fmt: skip
    """Distance left after each control step of the time-optimal flight between two rests, m, shape
    (n, steps), for a distance to go, m, shape (n,), 0 or more, and the period of a step, s.

    The largest accelerations, m/s², shape (n,), are those towards the goal and away from it;
    `change` is the largest change of one from step to step, m/s². Drag is linear, 1/s.
    """
    limits = towards, against, change, drag, period
    # More than enough, also for limited changes of the acceleration, and a speed that drag limits.
    weakest = float(np.minimum(towards, against).min())
    furthest = float(distance.max(initial=0.0))
    seconds = 3 * np.sqrt(furthest / weakest) + 2 * furthest * drag / weakest
    seconds += 0.0 if np.isinf(change) else 5 * np.cbrt(furthest * period / change)
    horizon = 4 + int(seconds / period)
    longest = np.full(len(distance), float(horizon))

    def braked(first: Floats) -> Floats:
        """The second moment for a first one: so that the speed is 0 at the end."""
        return _bisected(lambda two: _flown(first, two, horizon, *limits)[1] > 0, first, longest)

    def falls_short(first: Floats) -> npt.NDArray[np.bool_]:
        return _flown(first, braked(first), horizon, *limits)[0][:, -1] < distance

    first = _bisected(falls_short, np.zeros(len(distance)), longest)
    way, _ = _flown(first, braked(first), max(horizon, steps), *limits)
    return np.asarray(distance[:, None] - way[:, :steps])


def _bisected(
    too_low: Callable[[Floats], npt.NDArray[np.bool_]], low: Floats, high: Floats
) -> Floats:
    low = low.copy()
    high = high.copy()
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        below = too_low(middle)
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return low


def _flown(
    first: Floats, second: Floats, steps: int, towards: Floats, against: Floats, change: float,
    drag: float, period: float,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Way after each step, m, shape (n, steps), and the last speed, m/s, for two moments in steps.

    Flight starts at rest with no acceleration. From the second moment on the acceleration returns
    to 0, and the speed that is left is that of the moment in which it has.
    """
    decay = np.exp(-drag * period)
    gain = period if drag == 0 else (1 - decay) / drag
    drift = period**2 / 2 if drag == 0 else (period - gain) / drag
    way, speed, acceleration = (np.zeros(len(first)) for _ in range(3))
    ways = np.empty((len(first), steps))
    for step in range(steps):
        one = np.clip(first - step, 0.0, 1.0)
        two = np.clip(second - step, 0.0, 1.0) - one
        if np.isinf(change):
            acceleration = one * towards - two * against
        else:
            acceleration = np.clip(acceleration + change * (one - two), -against, towards)
            back = change * (1.0 - one - two)
            acceleration += np.clip(-acceleration, -back, back)
        way = way + speed * gain + acceleration * drift
        speed = speed * decay + acceleration * gain
        ways[:, step] = way
    return ways, speed


def landing_time(height: float, sink: float, vehicle: Vehicle) -> float:
    """Least time to come down from rest and to arrive with a climb rate of no less than -sink, s.

    Bang-bang control of the height alone (m, m/s): no craft that keeps its thrust from pointing
    downwards falls faster than gravity, or brakes with more than all of its thrust upright. From
    the two conditions at the end, way and speed, follows the speed v at which braking begins:
    v² / 2a + (v² - sink²) / 2b = height. Where v is not above `sink`, the fall takes all the time.
    """
    lift = float(vehicle.thrust_high @ vehicle.allocation[0]) / vehicle.mass
    fall = vehicle.gravity - min(0.0, float(vehicle.thrust_low.sum()) / vehicle.mass)
    brake = lift - vehicle.gravity
    if sink * sink >= 2 * fall * height:
        return float(np.sqrt(2 * height / fall))
    speed = np.sqrt((2 * height * brake + sink * sink) * fall / (fall + brake))
    return float(speed / fall + (speed - sink) / brake)


def least_height_lost(
    tilt: Floats, climb: Floats, rate: Floats, turn: float, lift: tuple[float, float],
    gravity: float, step: float = 1e-3,
) -> Floats:  # fmt: skip
    """Height that a thrown craft loses at least before it rises again, m, shape (n,).

    It begins with a tilt (rad), a climb rate (m/s) and a rate of its tilt (rad/s), shape (n,) each.
    Its tilt cannot become smaller than under its largest angular acceleration `turn` (rad/s²)
    from the start on, tilt - |rate| t - turn t² / 2, which does not even stop at upright; and at
    each moment the vertical thrust is at most that of the tilt, of accelerations between the two
    of `lift` (m/s²). Both are bounds for themselves; together no flight reaches them. Gyroscopic
    torques are left out. Integrated in steps of so many seconds.
    """
    low, high = lift
    speed = np.array(climb, float)
    height = np.zeros(len(tilt))
    lowest = height
    for count in range(round(60.0 / step)):
        # The vertical thrust of the best tilt within the step: that of its end.
        time = (count + 1) * step
        upright = np.cos(np.clip(tilt - np.abs(rate) * time - turn * time * time / 2, 0.0, np.pi))
        acceleration = np.maximum(low * upright, high * upright) - gravity
        height = height + speed * step + acceleration * step * step / 2
        speed = speed + acceleration * step
        lowest = np.minimum(lowest, height)
        if (speed >= 0).all() and (acceleration >= 0).all():
            break
    return -lowest


def recovery_bounds(
    options: RecoveryOptions, vehicle: Vehicle, count: int = 4096
) -> dict[str, float]:
    """Means over the starts of `Recovery-v0`, of so many that are drawn, always the same.

    `turn_upright`: least time from the tilt to upright, both at rest, by bang-bang control about
    one axis with the largest angular acceleration a, 2 sqrt(tilt / a), s. `height_lost`: see
    `least_height_lost`, m.
    """
    dice = np.random.default_rng(0)
    angles = np.radians(np.arange(360.0))
    axes = np.stack((np.cos(angles), np.sin(angles), 0.0 * angles), axis=1)
    turn = max(map(vehicle.turning, axes)) / float(np.cos(np.radians(0.5)))  # between the axes
    config = EnvConfig.from_keywords(RECOVERY, **options.to_options())
    most = Recovery(config, vehicle, (1, 1)).spin
    rates = dice.uniform(-most, most, (count, 3))
    tilt = np.arccos(dice.uniform(-1.0, 1.0, count))
    climb = dice.uniform(0.0, options.start_speed, count) * dice.uniform(-1.0, 1.0, count)
    low, high = (
        float(ends @ vehicle.allocation[0]) / vehicle.mass
        for ends in (vehicle.thrust_low, vehicle.thrust_high)
    )
    spin = np.hypot(*rates.T[:2])
    lost = least_height_lost(tilt, climb, spin, turn, (low, high), vehicle.gravity)
    return {
        "turn_upright": float(np.mean(2 * np.sqrt(tilt / turn))),
        "height_lost": float(lost.mean()),
    }


def payload_time(distance: float, share: float, vehicle: Vehicle) -> float:
    """Least time in which craft and payload get from rest to rest so far aside, at one height, s.

    Their common center of mass, of (1 + share) times the vehicle's mass, has the acceleration a of
    all thrust less what carries the weight: a² = lift² - g². Bang-bang: 2 sqrt(distance / a).
    """
    mass = (1 + share) * vehicle.mass
    lift = float(vehicle.thrust_high @ vehicle.allocation[0]) / mass
    return float(2 * np.sqrt(distance / np.sqrt(lift * lift - vehicle.gravity**2)))


def course_time(points: Floats, radii: Floats, lift: float, gravity: float) -> float:
    """No flight is shorter from rest to within each point's radius, one after the other, s.

    The first of the points, shape (n + 1, 3), m, is the start; radii have shape (n,), m. Thrust
    over mass is at most `lift`, m/s², in any direction: along a unit vector u a craft accelerates
    by at most a = lift - gravity u_z, and against it by b = lift + gravity u_z. Seen along u it has
    to go at least from turn to turn, and its speed along u is 0 at each: that takes
    sqrt(2 d (1 / a + 1 / b)) for a way d, and the last way sqrt(2 d / a), as nothing stops it
    there. The bound is the largest of 288 directions u; a flight has to satisfy all of them at
    once, and to turn its thrust, so it takes longer. There is no wind.
    """
    around, up = np.meshgrid(np.radians(np.arange(0, 360, 10)), np.radians(np.arange(0, 80, 10)))
    units = np.stack((np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)), -1)
    return max(
        _time_along(points @ u, radii, lift - gravity * u[2], lift + gravity * u[2])
        for u in units.reshape(-1, 3)
    )


def _time_along(places: Floats, radii: Floats, up: float, down: float) -> float:
    """Least time along a line through intervals about places, by accelerations both ways."""
    turns = [float(places[0])]
    for place, radius in zip(places[1:].tolist(), radii.tolist(), strict=True):
        now = min(max(turns[-1], place - radius), place + radius)  # it goes no further than it must
        if len(turns) > 1 and (now - turns[-1]) * (turns[-1] - turns[-2]) >= 0:
            turns[-1] = now
        elif now != turns[-1]:
            turns.append(now)
    ways = np.diff(turns)
    forth = np.where(ways > 0, up, down)
    stop = np.where(np.arange(len(ways)) < len(ways) - 1, 1 / (up + down - forth), 0.0)
    return float(np.sqrt(2 * np.abs(ways) * (1 / forth + stop)).sum())


def waypoints_time(options: WaypointsOptions, vehicle: Vehicle, count: int = 64) -> float:
    """Mean `course_time` of the courses of `Waypoints-v0`, of so many that are drawn, s."""
    shares = np.random.default_rng(0).uniform(-1.0, 1.0, (count, options.points + 1, 3))
    courses = np.array(options.center) + shares * np.array(options.box)
    radii = np.full(options.points, options.radius)
    return float(np.mean([course_time(one, radii, *_limits(vehicle)) for one in courses]))


def racing_time(options: RacingOptions, vehicle: Vehicle) -> float:
    """`course_time` of a track of `Racing-v0` from its start, s, by the ball about each opening."""
    gates, start = read_track(options.track)
    gates = gates * options.laps
    points = np.array([start.position, *(gate.position for gate in gates)])
    radii = np.array([gate.size for gate in gates]) / np.sqrt(2)
    return course_time(points, radii, *_limits(vehicle))


def _limits(vehicle: Vehicle) -> tuple[float, float]:
    """Largest thrust over mass, and gravity, m/s²."""
    return float(vehicle.thrust_high @ vehicle.allocation[0]) / vehicle.mass, vehicle.gravity

"""The control loops: ranges and gains of the library, step responses, and what a level costs.

    python studies/control.py [--seconds 0.2] [--repeats 15] [--out FILE.json]

Steps begin at hover, and are flown by the level itself. Rise: from 10 % to 90 % of the step;
overshoot: share of the step; settled: the last time at which it is 5 % of the step away. The circle
is flown by the agent `geometric`: the root mean square of its distance from the goal in the third
lap. Costs: env steps per second of Hover-v0 over those of `rotors`; the levels take turns.

It takes about two minutes on two cores.
"""

import json
import math
import statistics
from collections.abc import Callable
from typing import Any

import numpy as np
from measuring import RESULTS, in_turns, medians, options, timed, write
from rotorgram.agents import Geometric
from rotorgram.envs import register
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.loop import Loop
from rotorgram.envs.state import State
from rotorgram.envs.tasks.hover import Hover
from rotorgram.models import QUAD_XML, Vehicle
from rotorgram.sim import (
    LEVELS,
    EffectOptions,
    InitialState,
    WorldState,
    cos,
    make_controller,
    make_world,
    sin,
    stack,
)
from rotorgram.sim.control.gains import Gains

HOVER = "rotorgram/Hover-v0"
CIRCLE = "Circle-v0"
FLOWN = ("paper", "crazyflie2", "heavy_hexa")
PERIOD, SPEED = 2 * math.pi, 1.0  # of a circle with a radius of 1 m: s, m/s


def lag_of(vehicle: Vehicle) -> float:
    """Time constant of the rotors, s; 0 where the file has none."""
    names = ("rotors.time_constant", "rotors.time_constant_down")
    return max(vehicle.coefficients[name] or 0.0 for name in names)


def gains_of(name: str) -> dict[str, object]:
    """Gains and ranges of a vehicle, with its motor lag if it has one."""
    vehicle = Vehicle.load(name)
    gains = Gains.of(vehicle, vehicle.timestep, lag_of(vehicle))
    names = (
        "rate attitude heading velocity position lead most_rate most_tilt most_velocity most_offset"
    )
    told = {one: np.round(getattr(gains, one), 4).tolist() for one in names.split()}
    return {"timestep": vehicle.timestep, "lag": lag_of(vehicle), **told}


def roll(state: WorldState) -> float:
    """Of a craft that has neither pitch nor heading, rad."""
    w, x, _, _ = state.quaternion.ravel().tolist()
    return 2 * math.atan2(x, w)


STEPS: dict[str, tuple[int, float, str, float, Callable[[WorldState], float]]] = {
    "rates": (1, 1.0, "rad/s", 1.0, lambda state: state.body_rates.item(0)),
    "attitude": (1, math.radians(10), "rad", 3.0, roll),
    "velocity": (0, 1.0, "m/s", 6.0, lambda state: state.velocity.item(0)),
    "position": (0, 1.0, "m", 10.0, lambda state: state.position.item(0)),
}
"""Of each level: number of the action, size, unit, time of the flight in s, and what it steps."""


def response(name: str, level: str) -> dict[str, float]:
    """Rise time, overshoot and settling time of a step from hover."""
    vehicle = Vehicle.load(name)
    index, size, _, time, read = STEPS[level]
    effects = EffectOptions(motor_lag=lag_of(vehicle) > 0)
    world = make_world(vehicle, 1, effects=effects)
    controller: Any = make_controller(level, vehicle, vehicle.timestep, effects)
    start = InitialState(position=np.array([[(0.0, 0.0, 1000.0)]]))
    world.reset(np.ones((1, 1), bool), start)
    unit = controller.constants["action_scale"][index]
    action = np.zeros(4)
    seen = []
    for _ in range(round(time / vehicle.timestep)):
        now = read(world.state)
        seen.append(now)
        action[index] = (size - now if level == "position" else size) / unit
        world.step(controller.thrust(action, world.state), 1)
    values = np.array(seen) / size
    step = vehicle.timestep
    low, high = (int((values >= share).argmax()) for share in (0.1, 0.9))
    outside = np.flatnonzero(np.abs(values - 1) > 0.05)
    return {
        "rise_s": round((high - low) * step, 3),
        "overshoot": round(max(0.0, float(values.max()) - 1), 4),
        "settled_s": round((int(outside[-1]) + 1) * step, 3),
    }


class Circle(Hover):
    """A goal that goes round a circle of 1 m at 1 m/s, 5 m high."""

    def goal(self, state: State) -> np.ndarray:
        """On the circle, at the time of the step."""
        angle = SPEED * state.time
        return stack((cos(angle), sin(angle), 5.0))


def tracking(name: str) -> float:
    """Root mean square of the distance from the goal on a circle in the third lap, m."""
    lags = {"motor_lag": True} if lag_of(Vehicle.load(name)) else {}
    options = {"action": "position", "episode_length": 1000, "effects": lags}
    loop = Loop(EnvConfig.from_keywords(CIRCLE, vehicle=name, **options))
    policy = Geometric(loop.spec)
    errors = []
    loop.advance(np.zeros(4), np.ones(1, bool), [0])
    for _ in range(round(3 * PERIOD / 0.02)):
        loop.advance(policy.act(loop.observations["observation"][0]))
        errors.append(float(loop.metrics["position_error"][0]))
    return round(math.sqrt(statistics.fmean(e * e for e in errors[round(2 * PERIOD / 0.02) :])), 4)


def cost(num_drones: int, seconds: float, repeats: int) -> dict[str, object]:
    """Env steps per second of each level, medians, and their ratios to `rotors`."""
    loops = {
        level: Loop(EnvConfig(env_id=HOVER, action=level, episode_length=10**6), num_drones)
        for level in LEVELS
    }

    def rate(loop: Loop) -> float:
        actions = np.zeros((num_drones, len(loop.task.controller.low)), np.float32)
        loop.advance(actions, np.ones(num_drones, bool), list(range(num_drones)))
        wall, _ = timed(lambda: loop.advance(actions, loop.done), seconds)
        return num_drones / wall

    rates = in_turns(loops, repeats, rate)
    for loop in loops.values():
        loop.close()
    ratios = {
        level: [one / base for one, base in zip(rates[level], rates["rotors"], strict=True)]
        for level in LEVELS
    }
    return {
        "steps_per_second": {level: round(rate) for level, rate in medians(rates).items()},
        "ratio_to_rotors": {level: round(one, 3) for level, one in medians(ratios).items()},
    }


def main() -> None:
    out = RESULTS / "control" / "control.json"
    args = options(__doc__, seconds=0.2, repeats=15, out=out).parse_args()
    register(CIRCLE, Circle)
    library = sorted(path.parent.name for path in QUAD_XML.parent.glob("*/*/vehicle.toml"))
    told = {
        "gains": {name: gains_of(name) for name in library},
        "responses": {n: {level: response(n, level) for level in STEPS} for n in FLOWN},
        "circle_m": {name: tracking(name) for name in FLOWN},
        "cost": {str(n): cost(n, args.seconds, args.repeats) for n in (1, 1024)},
    }
    write(args.out, told)
    print(json.dumps({key: told[key] for key in ("responses", "circle_m", "cost")}, indent=1))


if __name__ == "__main__":
    main()

"""What solid scenes and sight cost in a vector env: Forest-v0 on one core.

    taskset -c 0 python studies/forest_speed.py [--drones 1024] [--rounds 7] [--out FILE.json]

`contact_ns` is what a wood of about 60 primitives adds to the compiled code of a physics step of a
drone that flies at 3 m/s: looking for touch in it, and the clearance of each control step;
`physics_ns` is a physics step alone, the difference between 20 and 10 of them with held thrusts.
Steps per second are those of the public vector env with its depth of 6 x 32, new layouts and all,
at 3 m/s; beside it the same env with the depth camera of OpenGL, of 8 drones. In turns, medians.

It takes about three minutes.
"""

import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from measuring import RESULTS, in_turns, options, write
from rotorgram.envs import LocalVectorEnv

FOREST = "rotorgram/Forest-v0"
WOOD: dict[str, Any] = {"scene": "forest:0-63", "density": 0.033}
STEPS = 40


def env_of(drones: int, **keywords: Any) -> LocalVectorEnv:
    """An env whose drones have begun."""
    env = LocalVectorEnv(FOREST, drones, backend="rigid", **keywords)
    env.reset(seed=0)
    return env


class Timed:
    """Adds up the time of a function's calls."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        self.seconds = 0.0

    def __call__(self, *given: Any) -> None:
        began = time.perf_counter()
        self.function(*given)
        self.seconds += time.perf_counter() - began


def stepper(env: LocalVectorEnv, ahead: float) -> Callable[[], tuple[float, float]]:
    """Gives the time of a control step of a drone, s, flying ahead at a speed, m/s; and that of its
    compiled code.
    """
    actions = np.zeros(env.action_space.shape, np.float32)
    if ahead:
        actions[:, 0] = ahead / env.env_spec.action_scale[0]
    for _ in range(3 * STEPS):
        env.step(actions)

    machine = getattr(env.loop, "machine", lambda: None)()  # none where OpenGL draws
    code = Timed(getattr(machine, "_call", print))
    if machine:
        machine._call = code

    def seconds() -> tuple[float, float]:
        code.seconds = 0.0
        began = time.perf_counter()
        for _ in range(STEPS):
            env.step(actions)
        steps = STEPS * env.num_envs
        return (time.perf_counter() - began) / steps, code.seconds / steps

    return seconds


def main() -> None:
    args = options(
        __doc__, drones=1024, rounds=7, out=RESULTS / "performance" / "forest.json"
    ).parse_args()
    blind: dict[str, Any] = {"sensors": {}}
    held = {**blind, "scene": "plain", "action": "rotors"}
    envs = {
        "wood": env_of(args.drones, **WOOD, **blind),
        "plain": env_of(args.drones, scene="plain", **blind),
        "held": env_of(args.drones, **held),
        "held twice": env_of(args.drones, **held, control_period=0.1),
        "depth": env_of(args.drones),
        "OpenGL": env_of(
            8, scene="forest:0-7,density=0.1,size=34x16,clear=ends", cameras="front_depth@32x6",
            **blind,
        ),
    }  # fmt: skip
    solids = envs["wood"].loop.world.scenery.layouts.kinds.shape[1]
    flown = {name: stepper(env, 0.0 if "held" in name else 3.0) for name, env in envs.items()}
    times = in_turns(flown, args.rounds, lambda seconds: seconds())
    each = {name: statistics.median(whole for whole, _ in rows) for name, rows in times.items()}
    code = {name: statistics.median(inside for _, inside in rows) for name, rows in times.items()}
    substeps = envs["wood"].loop.pipeline.flight.substeps
    contact = (code["wood"] - code["plain"]) / substeps
    physics = (code["held twice"] - code["held"]) / substeps
    result = {
        "drones": args.drones,
        "most_solids": solids,
        "contact_ns": round(1e9 * contact, 1),
        "physics_ns": round(1e9 * physics, 1),
        "contact_over_physics": round(contact / physics, 2),
        "steps_per_second": {name: round(1 / each[name]) for name in ("plain", "depth", "OpenGL")},
        "depth_over_opengl": round(each["OpenGL"] / each["depth"]),
    }
    print(result)
    write(args.out, result)


if __name__ == "__main__":
    main()

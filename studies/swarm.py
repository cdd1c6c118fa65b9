"""Cost of a drone in a world of 2, 8, 32 and 100: physics alone, with the task, and over UDP.

    python studies/swarm.py [--drones 2 8 32 100] [--seconds 0.5] [--repeats 9] [--out FILE.json]

A step is one of 0.02 s of `rotorgram/Formation-v0` with the vehicle of the paper, two physics
steps, at hover. `apart` are as many worlds of one drone of `rotorgram/Hover-v0` in one batch. Cases
take turns within a repeat. It prints medians over the repeats, in microseconds for each drone and
control step. Over UDP the simulator is a process of its own, and the agent asks for a standstill.

It takes about two minutes on two cores.
"""

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from measuring import options, seconds_of, table, write
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.config import EnvConfig
from rotorgram.udp.spawn import spawn_simulator

ENV = "rotorgram/Formation-v0"
EPISODE = 100_000  # control steps: none ends while it is measured

Step = Callable[[], object]


def physics(drones: int, *, together: bool) -> Step:
    """A control step of a world, or of as many worlds of one drone."""
    env_id = ENV if together else "rotorgram/Hover-v0"
    kind = {"drones": drones} if together else {}
    env = LocalVectorEnv(env_id, drones, episode_length=EPISODE, **kind)
    env.reset(seed=0)
    world = env.loop.world
    substeps = env.loop.vehicle.substeps(env.control_period)
    thrust = np.broadcast_to(env.loop.vehicle.hover_thrust, world.state.thrust.shape)
    return lambda: world.step(thrust, substeps)


def advanced(env: Any, drones: int) -> Step:
    """A step of an env, of one drone or a vector env, with actions that ask for a standstill."""
    vector = hasattr(env, "num_envs")
    env.reset(seed=list(range(drones)) if vector else 0)
    actions = np.zeros((drones, 4) if vector else 4, np.float32)
    return (lambda: env.advance(actions)) if vector else (lambda: env.step(actions))


def measure(counts: list[int], seconds: float, repeats: int) -> dict[str, dict[str, float]]:
    """Microseconds for each drone and step, by case and number of drones."""
    with ExitStack() as opened:
        cases: dict[tuple[str, int], Step] = {}
        for drones in counts:
            options = {"episode_length": EPISODE}
            local = LocalVectorEnv(ENV, drones, drones=drones, autoreset_mode="Disabled", **options)
            pair = spawn_simulator(EnvConfig.from_keywords(ENV, drones=drones, **options))
            cases["apart", drones] = physics(drones, together=False)
            cases["one world", drones] = physics(drones, together=True)
            cases["with the task", drones] = advanced(local, drones)
            cases["over UDP", drones] = advanced(opened.enter_context(pair), drones)
        taken = seconds_of(cases, repeats, seconds)
    found: dict[str, dict[str, float]] = {}
    for (name, drones), time in taken.items():
        found.setdefault(name, {})[str(drones)] = round(time / drones * 1e6, 2)
    return found


def main() -> None:
    """Measure, print and write."""
    drones = (2, 8, 32, 100)
    args = options(__doc__, drones=drones, seconds=0.5, repeats=9, out=Path).parse_args()
    found = measure(args.drones, args.seconds, args.repeats)
    rows = [(name, *(f"{time:,.1f}" for time in row.values())) for name, row in found.items()]
    print(table(("µs for each drone and step", *map(str, args.drones)), rows))
    if args.out:
        write(args.out, {"microseconds": found})


if __name__ == "__main__":
    main()

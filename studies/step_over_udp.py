"""The time of one step of one drone over UDP, beside that of its env and of a raw echo.

    python studies/step_over_udp.py [--rounds 20]

The env, a blocking echo of the same sizes whose two processes share a core, and a `RemoteEnv` with
its simulator take turns of a moment; medians over the rounds count. Prints microseconds, and the
step as a multiple of env and echo together.

It takes about a few seconds on two cores.
"""

import time
from collections.abc import Callable
from contextlib import ExitStack

from measuring import in_turns, medians, options
from rotorgram.envs.config import EnvConfig
from rotorgram.training.bench import _echo, _env, _local
from rotorgram.udp.spawn import spawn_simulator

ENV_ID = "rotorgram/Elevation-v0"
TURN = 0.2  # s


def microseconds(run: Callable[[float], int]) -> float:
    """Of a step, the mean over a moment."""
    began = time.perf_counter()
    count = run(TURN)
    return 1e6 * (time.perf_counter() - began) / count


def main() -> None:
    rounds = options(__doc__, rounds=20).parse_args().rounds
    with ExitStack() as stack:
        runs = {
            "env": _local(stack, 1),
            "echo": _echo(stack),
            "step": _env(stack.enter_context(spawn_simulator(EnvConfig(env_id=ENV_ID)))),
        }
        median = medians(in_turns(runs, rounds, microseconds))
    for name, time_of_step in median.items():
        print(f"{name}: {time_of_step:.1f} µs")
    print(f"step ÷ (env + echo): {median['step'] / (median['env'] + median['echo']):.2f}")


if __name__ == "__main__":
    main()

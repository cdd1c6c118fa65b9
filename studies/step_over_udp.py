"""The time of one step of one drone over UDP, beside that of its env and of a raw echo.

    python studies/step_over_udp.py [--rounds 20]

The env, a blocking echo of the same sizes whose two processes share a core, and a `RemoteEnv` with
its simulator take turns of a moment; medians over the rounds count. Prints microseconds, and the
step as a multiple of env and echo together.
"""

import argparse
import statistics
import time
from contextlib import ExitStack

from rotorgram.envs.config import EnvConfig
from rotorgram.training.bench import _echo, _env, _local
from rotorgram.udp.spawn import spawn_simulator

ENV_ID = "rotorgram/Elevation-v0"
TURN = 0.2  # s


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=20)
    rounds = parser.parse_args().rounds
    with ExitStack() as stack:
        runs = {
            "env": _local(stack, 1),
            "echo": _echo(stack),
            "step": _env(stack.enter_context(spawn_simulator(EnvConfig(env_id=ENV_ID)))),
        }
        times: dict[str, list[float]] = {name: [] for name in runs}
        for _ in range(rounds):
            for name, run in runs.items():
                begin = time.perf_counter()
                count = run(TURN)
                times[name].append((time.perf_counter() - begin) / count)
    median = {name: 1e6 * statistics.median(seconds) for name, seconds in times.items()}
    for name, microseconds in median.items():
        print(f"{name}: {microseconds:.1f} µs")
    print(f"step ÷ (env + echo): {median['step'] / (median['env'] + median['echo']):.2f}")


if __name__ == "__main__":
    main()

"""The time of one step of one drone over UDP, beside that of its env and of a raw echo.

    python studies/step_over_udp.py [--rounds 20]

The env, a blocking echo of the same sizes whose two processes share a core, and a `RemoteEnv` with
its simulator take turns of a moment; medians over the rounds count. Prints microseconds, and the
step as a multiple of env and echo together.

It takes a few seconds on two cores.
"""

from contextlib import ExitStack

from measuring import in_turns, medians, options
from rotorgram.envs.config import EnvConfig
from rotorgram.training.bench import Step, local_env, rate_of, single_step, udp_echo
from rotorgram.udp.spawn import spawn_simulator

ENV_ID = "rotorgram/Elevation-v0"
TURN = 0.2  # s


def microseconds(step: Step) -> float:
    """Of a step, the mean over a moment."""
    return 1e6 / rate_of(step, TURN)


def main() -> None:
    rounds = options(__doc__, rounds=20).parse_args().rounds
    with ExitStack() as stack:
        runs = {
            "env": local_env(stack),
            "echo": udp_echo(stack),
            "step": single_step(stack.enter_context(spawn_simulator(EnvConfig(env_id=ENV_ID)))),
        }
        median = medians(in_turns(runs, rounds, microseconds))
    for name, time_of_step in median.items():
        print(f"{name}: {time_of_step:.1f} µs")
    print(f"step ÷ (env + echo): {median['step'] / (median['env'] + median['echo']):.2f}")


if __name__ == "__main__":
    main()

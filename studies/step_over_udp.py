"""The time of one step of one drone over UDP, beside that of its env and of a raw echo.

    python studies/step_over_udp.py [--rounds 20]

The env, a blocking echo of the same sizes whose two processes share a core, and a `RemoteEnv` with
its simulator take turns of a moment; medians over the rounds count. Prints microseconds, and the
step as a multiple of env and echo together.

It takes a few seconds on two cores.
"""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from bench import ENV_ID, Step, local_env, rate_of, single_step
from measuring import in_turns, medians, options
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec
from rotorgram.udp.layouts import layout_of
from rotorgram.udp.spawn import spawn_simulator

AT_ONCE = 64  # exchanges between two looks at the clock
TURN = 0.2  # s
ECHO = """
import socket, sys
sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
sock.bind(("127.0.0.1", 0))
print(sock.getsockname()[1], flush=True)
answer = bytes(int(sys.argv[1]))
while True:
    data, address = sock.recvfrom(65536)
    if not data:
        break
    sock.sendto(answer, address)
"""


def udp_echo(stack: ExitStack) -> Step:
    """A raw exchange of datagrams of the sizes of a State and a Command: two Python processes with
    blocking sockets, on one core, where a wake-up costs least.
    """
    layout = layout_of(env_spec(EnvConfig(env_id=ENV_ID)))
    words = [sys.executable, "-c", ECHO, str(layout.commands[False, False].size)]
    process = stack.enter_context(subprocess.Popen(words, stdout=subprocess.PIPE))
    assert process.stdout is not None
    address = ("127.0.0.1", int(process.stdout.readline()))
    message = bytes(layout.state.size)
    sock = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    sock.settimeout(1.0)
    stack.callback(sock.sendto, b"", address)

    def step() -> int:
        with one_core(process.pid):
            for _ in range(AT_ONCE):
                sock.sendto(message, address)
                sock.recvfrom(65536)
        return AT_ONCE

    return step


@contextmanager
def one_core(pid: int) -> Iterator[None]:
    """Keep this process and another one on one core during the block, where the system can.

    Two processes that answer each other sleep in turns. On two cores each answer waits until an
    idle core is awake, which takes four times as long as the exchange.
    """
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    cores = os.sched_getaffinity(0)
    for each in (0, pid):
        os.sched_setaffinity(each, {min(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


def microseconds(step: Step) -> float:
    """Of a step, the mean over a moment."""
    return 1e6 / rate_of(step, TURN)


def multiple(step: float, env: float, echo: float) -> float:
    """Time of a step as a multiple of the times of its env and an echo; at most 1.6 is wanted."""
    return step / (env + echo)


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
    print(f"step ÷ (env + echo): {multiple(**median):.2f}")


if __name__ == "__main__":
    main()

"""Flights between two machines over a bad network, on Linux: MTU, delay and loss of IP packets.

    sudo python studies/lossy_link.py [--drones 1024] [--mtu 1500] [--delay 0.001]
                                         [--loss 0 0.01 0.05 0.1] [--seconds 10] [--out FILE.json]

Agent and simulator run in network namespaces of their own. A TUN device in each is the only way
between them, and this program carries the IP packets from one to the other: it delays each, and
loses each with the given probability, fragments of large datagrams too. After the flight every
answer of the simulator is compared with the same flight in process, bit for bit. A control step is
one of physics, so that the link is what is measured.

It takes about ten minutes on two cores.
"""

import fcntl
import json
import os
import random
import select
import struct
import subprocess
import tempfile
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from measuring import RESULTS, launch, options, write
from rotorgram.udp.protocol.auth import write_key

AGENT_ADDRESS = "10.77.0.1"
SIMULATOR_ADDRESS = "10.77.0.2"
PORT = 8001

AGENT = """
import json, sys, time
from contextlib import closing
import numpy as np
from gymnasium.vector import AutoresetMode
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.loop import Loop
from rotorgram.udp import RemoteVectorEnv
drones, seconds, key, host, port = json.loads(sys.argv[1])
env_id, options = "rotorgram/Elevation-v0", {"control_period": 0.01}
rng = np.random.default_rng

def answer(env):
    return env.rewards.tobytes(), env.terminated.tobytes(), env.truncated.tobytes()

with closing(RemoteVectorEnv((host, port), env_id=env_id, num_envs=drones, key_file=key,
                             options=options, autoreset_mode=AutoresetMode.DISABLED,
                             connect=False)) as env:
    env.reset(seed=0)
    told = [(env.observations.tobytes(), *answer(env))]
    dice, began, spent = rng(0), time.perf_counter(), time.process_time()
    while time.perf_counter() - began < seconds:
        actions = dice.uniform(-1, 1, (drones, 1)).astype(np.float32)
        env.advance(actions, env.done.copy())
        told.append((env.observations.tobytes(), *answer(env)))
    seconds, spent = time.perf_counter() - began, time.process_time() - spent
    numbers = env.statistics.numbers()

loop = Loop(EnvConfig.from_keywords(env_id, **options), drones)
loop.advance(np.zeros((drones, 1), np.float32), np.ones(drones, bool),
             np.arange(drones, dtype=np.uint64), None)
dice, computed = rng(0), time.perf_counter()
for step, got in enumerate(told):
    (ours,) = loop.observations.values()
    assert got == (ours.tobytes(), *answer(loop)), f"step {step}: not the same bits"
    actions = dice.uniform(-1, 1, (drones, 1)).astype(np.float32)
    loop.advance(actions, loop.done.copy(), None, None)
computed = time.perf_counter() - computed
print(json.dumps({"steps": len(told) - 1, "seconds": seconds, "processor_seconds": spent,
                  "in_process_seconds": computed, "statistics": numbers}))
"""

SIMULATE = """
import json, sys
from rotorgram.udp import Simulator
drones, key, server, bind = json.loads(sys.argv[1])
with Simulator(server=tuple(server), bind=tuple(bind), num_envs=drones, key_file=key,
               control_period=0.01) as simulator:
    simulator.run()
"""


class Wire:
    """Carries packets between two TUN devices in a thread, until it is closed.

    Args:
        ends: File descriptors of the devices.
        loss: Probability that a packet is lost, 0 to 1.
        delay: Time that each is held, s.
    """

    def __init__(self, ends: tuple[int, int], loss: float, delay: float) -> None:
        self.packets = self.lost = 0
        self._ends = ends
        self._loss = loss
        self._delay = delay
        self._dice = random.Random(0).random
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._carry)
        self._thread.start()

    def close(self) -> None:
        self._closed.set()
        self._thread.join()

    def _carry(self) -> None:
        held: deque[tuple[float, int, bytes]] = deque()
        while not self._closed.is_set():
            wait = min(max(held[0][0] - time.perf_counter(), 0), 0.05) if held else 0.05
            for end in select.select(self._ends, [], [], wait)[0]:
                packet = os.read(end, 65_536)
                other = self._ends[end == self._ends[0]]
                self.packets += 1
                if self._dice() < self._loss:
                    self.lost += 1
                else:
                    held.append((time.perf_counter() + self._delay, other, packet))
            while held and held[0][0] <= time.perf_counter():
                _, end, packet = held.popleft()
                os.write(end, packet)


def run(*words: object) -> None:
    subprocess.run([str(word) for word in words], check=True)


def open_tun(name: str) -> int:
    tunsetiff = 0x400454CA
    tun_without_header = 0x1001
    end = os.open("/dev/net/tun", os.O_RDWR)
    fcntl.ioctl(end, tunsetiff, struct.pack("16sH22x", name.encode(), tun_without_header))
    return end


@contextmanager
def two_machines(mtu: int) -> Iterator[tuple[tuple[str, int], tuple[str, int]]]:
    """The name of the namespace and the device of the agent, and of the simulator."""
    made: list[tuple[str, int]] = []
    try:
        for number, address in enumerate((AGENT_ADDRESS, SIMULATOR_ADDRESS)):
            name = f"rg{os.getpid()}-{number}"
            run("ip", "netns", "add", name)
            end = open_tun(name)
            made.append((name, end))
            run("ip", "link", "set", name, "netns", name)
            inside = ("ip", "-n", name)
            run(*inside, "link", "set", name, "mtu", mtu, "txqueuelen", 10_000)
            run(*inside, "addr", "add", f"{address}/24", "dev", name)
            run(*inside, "link", "set", name, "up")
            run(*inside, "link", "set", "lo", "up")
        yield made[0], made[1]
    finally:
        for name, end in made:
            os.close(end)
            run("ip", "netns", "del", name)


def fly(drones: int, mtu: int, delay: float, loss: float, seconds: float) -> dict[str, object]:
    """The rate and counts of one flight. Raises `CalledProcessError` if it fails."""
    with tempfile.TemporaryDirectory() as folder, two_machines(mtu) as (here, there):
        key = str(Path(folder) / "key")
        write_key(Path(key))
        wire = Wire((here[1], there[1]), loss, delay)
        settings = [drones, seconds, key, AGENT_ADDRESS, PORT]
        agent = launch(AGENT, settings, "ip", "netns", "exec", here[0])
        server = (AGENT_ADDRESS, PORT)
        bind = (SIMULATOR_ADDRESS, 0)
        simulator = launch(SIMULATE, [drones, key, server, bind], "ip", "netns", "exec", there[0])
        try:
            out, _ = agent.communicate(timeout=seconds + 300)
            if agent.returncode == 0:
                simulator.wait(timeout=30)
        finally:
            for process in (agent, simulator):
                process.kill()
            wire.close()
        if agent.returncode:
            raise subprocess.CalledProcessError(agent.returncode, "the agent")
    told = json.loads(out)
    return {
        "drones": drones, "mtu": mtu, "delay": delay, "loss": loss, "steps": told["steps"],
        "steps_per_second": round(told["steps"] / told["seconds"], 1),
        "agent_processor_ms": round(1e3 * told["processor_seconds"] / told["steps"], 2),
        "in_process_steps_per_second": round(told["steps"] / told["in_process_seconds"], 1),
        "packets": wire.packets, "packets_lost": wire.lost, "agent": told["statistics"],
    }  # fmt: skip


def main() -> None:
    links = {"mtu": (1500, 576), "delay": 0.001, "loss": (0.0, 0.01, 0.05, 0.1)}
    out = RESULTS / "reliability" / "link.json"
    args = options(__doc__, drones=(1, 64, 1024), **links, seconds=10.0, out=out).parse_args()
    flights = []
    for drones in args.drones:
        for mtu in args.mtu:
            for loss in args.loss:
                one = fly(drones, mtu, args.delay, loss, args.seconds)
                flights.append(one)
                print(one, flush=True)
    write(args.out, {"flights": flights})


if __name__ == "__main__":
    main()

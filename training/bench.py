"""Env steps per second on this machine, from raw physics to a simulator over UDP.

Layers that are compared with each other are open at the same time and take turns to run for a
moment, in an order that changes from round to round. Ratios are made within a round, and their
medians count, so that a machine that slows down for a while slows all alike.
"""

import json
import os
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from ..agents.checkpoints import software_versions, write_whole
from ..envs.autoreset import AdvancingVectorEnv
from ..envs.config import EnvConfig
from ..envs.registry import env_spec
from ..envs.vector import LocalVectorEnv
from ..models.fields import Limits, check
from ..models.vehicle import Vehicle
from ..udp.layouts import layout_of
from ..udp.spawn import spawn_simulator
from .results import machine

ENV_ID = "rotorgram/Elevation-v0"
_PERIOD = 0.02  # s, of a control step
_STEPS_AT_ONCE = 64  # of one drone between two looks at the clock

Step = Callable[[], int]
"""Flies a step of all drones; the number of env steps that it made."""
Rates = Mapping[str, float]
"""Env steps per second, by layer."""


@dataclass(frozen=True, kw_only=True)
class Ratio:
    """A figure that follows from the rates of one round."""

    name: str
    of: Callable[[Rates], float]
    target: str
    """What it is to be, in words."""

    def value(self, layers: Sequence["Layer"]) -> float:
        """Median over the rounds."""
        names = [layer.name for layer in layers]
        rounds = zip(*(layer.rates for layer in layers), strict=True)
        return statistics.median(self.of(dict(zip(names, rates, strict=True))) for rates in rounds)


def _over(above: str, below: str, least: float) -> Ratio:
    return Ratio(name=f"{above} ÷ {below}", of=lambda r: r[above] / r[below], target=f"≥ {least:g}")


RATIOS = (
    Ratio(
        name="time of a step, UDP, 1 ÷ (env + UDP echo)",
        of=lambda r: (1 / r["UDP, 1"]) / (1 / r["env"] + 1 / r["UDP echo"]),
        target="≤ 1.6",
    ),
    _over("env", "mj_step", 0.2),
    _over("vector env, 1024", "Batch.step, 1024", 0.85),
    _over("UDP, 1024", "vector env, 1024", 0.8),
)
"""Figures of rates, with their targets."""

_ECHO = """
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


@dataclass(frozen=True, kw_only=True)
class Layer:
    """One measured layer."""

    name: str
    about: str
    drones: int
    rates: tuple[float, ...]
    """Env steps per second, of each round."""

    @property
    def rate(self) -> float:
        """Median, env steps per second."""
        return statistics.median(self.rates)


def bench(
    rounds: int, seconds: float, folder: Path, on_layer: Callable[[str, int, int], None]
) -> list[Layer]:
    """Measure every layer in turns of `seconds`, and write `bench.json` into `folder`.

    `on_layer` is called before each turn: name of the layer, turns done, turns in all. Raises
    `InputError`.
    """
    check("rounds", Limits(1, whole=True), rounds)
    check("seconds", Limits(0, 60, "s", above=True), seconds)
    turns = (rounds + 1) * len(_LAYERS)
    done = 0
    layers = []
    for single in (True, False):
        at_once = _STEPS_AT_ONCE if single else 1
        group = [layer for layer in _LAYERS if (layer[2] == 1) == single]
        rates: dict[str, list[float]] = {name: [] for name, *_ in group}
        with ExitStack() as stack:
            steps = {}
            for name, _, _, open_ in group:
                on_layer(f"opening {name}", done, turns)
                steps[name] = open_(stack)
            names = list(steps)
            for number in range(rounds + 1):
                for name in names:
                    on_layer(name, done, turns)
                    done += 1
                    rate = rate_of(steps[name], seconds, at_once)
                    if number:  # the first round warms up
                        rates[name].append(round(rate, 1))
                names.append(names.pop(0))
        for name, about, drones, _ in group:
            layers.append(Layer(name=name, about=about, drones=drones, rates=tuple(rates[name])))
    values = {
        ratio.name: {"value": round(ratio.value(layers), 3), "target": ratio.target}
        for ratio in RATIOS
    }
    content = {
        "rounds": rounds,
        "seconds": seconds,
        "layers": [asdict(layer) for layer in layers],
        "medians": {layer.name: layer.rate for layer in layers},
        "ratios": values,
        "machine": machine(),
        "versions": software_versions(),
    }
    write_whole(folder / "bench.json", (json.dumps(content, indent=2) + "\n").encode())
    return layers


def rate_of(step: Step, seconds: float, at_once: int = _STEPS_AT_ONCE) -> float:
    """Env steps per second over `seconds`, with `at_once` steps between looks at the clock."""
    start = time.perf_counter()
    now = start
    steps = 0
    while now < start + seconds:
        for _ in range(at_once):
            steps += step()
        now = time.perf_counter()
    return steps / (now - start)


# ---- the layers: each is opened for as long as the stack is


def _mj_step(_: ExitStack) -> Step:
    vehicle = Vehicle.load()
    model = vehicle.model
    substeps = vehicle.substeps(_PERIOD)
    data = mujoco.MjData(model)
    data.qpos[2] = 5.0
    data.ctrl[:] = vehicle.hover_thrust

    def step() -> int:
        mujoco.mj_step(model, data, substeps)
        return 1

    return step


def _batch_step(_: ExitStack) -> Step:
    vehicle = Vehicle.load()
    batch = Batch(vehicle.model, 1024)
    substeps = vehicle.substeps(_PERIOD)
    batch.qpos[:, 2] = 5.0
    batch.ctrl[:] = vehicle.hover_thrust

    def step() -> int:
        batch.step(nstep=substeps)
        return 1024

    return step


def _actions(*shape: int) -> Iterator[NDArray[np.float32]]:
    """Random actions near hover, the same ones again and again."""
    return cycle(np.random.default_rng(0).uniform(-0.1, 0.1, shape).astype(np.float32))


def local_env(stack: ExitStack) -> Step:
    """The single env in process."""
    env = stack.enter_context(closing(gym.make(ENV_ID, disable_env_checker=True).unwrapped))
    return single_step(env)


def single_step(env: gym.Env[Any, Any]) -> Step:
    """Steps of a single env with random actions; after an episode it is reset."""
    actions = _actions(4096, 1)
    env.reset(seed=0)

    def step() -> int:
        _, _, terminated, truncated, _ = env.step(next(actions))
        if terminated or truncated:
            env.reset()
        return 1

    return step


def _vector_step(env: AdvancingVectorEnv) -> Step:
    """Drones whose episode ended are reset by the next step, as in NEXT_STEP."""
    actions = _actions(16, env.num_envs, 1)
    env.reset(seed=0)

    def step() -> int:
        resets = env.done
        env.advance(next(actions), resets if resets.any() else None)
        return int((~resets).sum())

    return step


def udp_echo(stack: ExitStack) -> Step:
    """A raw exchange of datagrams of the sizes of a State and a Command: two Python processes with
    blocking sockets, on one core, where a wake-up costs least.
    """
    layout = layout_of(env_spec(EnvConfig(env_id=ENV_ID)))
    words = [sys.executable, "-c", _ECHO, str(layout.command.size)]
    process = stack.enter_context(subprocess.Popen(words, stdout=subprocess.PIPE))
    assert process.stdout is not None
    address = ("127.0.0.1", int(process.stdout.readline()))
    message = bytes(layout.state.size)
    sock = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    sock.settimeout(1.0)
    stack.callback(sock.sendto, b"", address)

    def step() -> int:
        with one_core(process.pid):
            for _ in range(_STEPS_AT_ONCE):
                sock.sendto(message, address)
                sock.recvfrom(65536)
        return _STEPS_AT_ONCE

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


def _remote(stack: ExitStack) -> Step:
    return single_step(stack.enter_context(spawn_simulator(EnvConfig(env_id=ENV_ID))))


def _vector(stack: ExitStack, drones: int) -> Step:
    return _vector_step(stack.enter_context(closing(LocalVectorEnv(ENV_ID, drones))))


def _remote_vector(stack: ExitStack, drones: int) -> Step:
    opened = spawn_simulator(EnvConfig(env_id=ENV_ID), num_envs=drones)
    return _vector_step(stack.enter_context(opened))


_LAYERS: Final[list[tuple[str, str, int, Callable[[ExitStack], Step]]]] = [
    ("mj_step", "mj_step with the substeps of one control step", 1, _mj_step),
    ("env", "the single env's step", 1, local_env),
    ("UDP echo", "blocking sockets of two processes on one core", 1, udp_echo),
    ("UDP, 1", "RemoteEnv and a simulator", 1, _remote),
    ("Batch.step, 1024", "mujoco.batch, the same substeps", 1024, _batch_step),
]
"""Name, what it is, drones, and how it is opened."""

for _n in (64, 1024, 4096):
    _LAYERS.append((f"vector env, {_n}", "the vector env", _n, partial(_vector, drones=_n)))
    _LAYERS.append((f"UDP, {_n}", "RemoteVectorEnv", _n, partial(_remote_vector, drones=_n)))

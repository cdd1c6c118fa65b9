"""The speed of each layer of a training on this machine, from raw physics to an update.

Layers of one drone, of many drones and of training are open at the same time, each group by
itself, and take turns to run for a moment, in an order that changes from round to round. Ratios are
made within a round, and their medians count, so that a machine that slows down for a while slows
all alike.

The parts of a lock-step exchange are layers too, each measured by itself; the links take the rest
of the time of a step.
"""

import copy
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
from itertools import cycle
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import mujoco
import numpy as np
from mujoco.batch import Batch

from ..agents import preset
from ..agents.checkpoints import software_versions, write_whole
from ..agents.policies import NetworkPolicy
from ..envs.config import EnvConfig
from ..envs.loop import Loop
from ..envs.registry import env_spec
from ..models.errors import expect
from ..models.vehicle import Vehicle
from ..udp.layouts import layout_of
from ..udp.protocol import binary
from ..udp.protocol.messages import Command, State
from ..udp.spawn import spawn_simulator
from .results import machine
from .settings import Run
from .training import Training

ENV_ID: Final = "rotorgram/Elevation-v0"
_PERIOD: Final = 0.02  # s, of a control step
_FINER_TIMESTEP: Final = 0.005  # s, for comparison

Slice = Callable[[float], int]
"""Runs for about so many seconds; how many env steps it made."""

Rates = Mapping[str, float]
"""Env steps per second, by layer."""


@dataclass(frozen=True, kw_only=True)
class Ratio:
    """A figure that follows from the rates of one round."""

    name: str
    of: Callable[[Rates], float]
    target: float | None = None
    at_most: bool = False  # whether less is better

    def value(self, layers: Sequence["Layer"]) -> float:
        """Median over the rounds."""
        rounds = zip(*(layer.rates for layer in layers), strict=True)
        names = [layer.name for layer in layers]
        return statistics.median(self.of(dict(zip(names, rates, strict=True))) for rates in rounds)

    @property
    def target_text(self) -> str:
        """The target, with its sign; empty without one."""
        sign = "≤" if self.at_most else "≥"
        return f"{sign} {self.target:g}" if self.target is not None else ""

    def reached(self, value: float) -> bool:
        """Whether a value is on the right side of the target."""
        target = value if self.target is None else self.target
        return value <= target if self.at_most else value >= target


def _over(above: str, below: str, target: float | None = None) -> Ratio:
    return Ratio(name=f"{above} ÷ {below}", of=lambda r: r[above] / r[below], target=target)


RATIOS: Final = (
    Ratio(
        name="time of a step, UDP, 1 ÷ (mj_step + UDP echo)",
        of=lambda r: (1 / r["UDP, 1"]) / (1 / r["mj_step"] + 1 / r["UDP echo"]),
        target=1.7,
        at_most=True,
    ),
    Ratio(
        name="time of a step, UDP, 1 ÷ (env + UDP echo)",
        of=lambda r: (1 / r["UDP, 1"]) / (1 / r["env"] + 1 / r["UDP echo"]),
        target=1.6,
        at_most=True,
    ),
    _over("Batch.step, 1024", "Batch.step at 5 ms, 1024", 1.9),
    _over("vector env, 1024", "Batch.step, 1024", 0.95),
    _over("env", "mj_step", 0.6),
    _over("UDP, 1024", "vector env, 1024", 0.92),
    _over("a2c, 64", "sb3-a2c, 64"),
    _over("a2c, 1", "sb3-a2c, 1"),
    _over("vector env, 4096", "vector env, 64"),
)
"""Figures of rates, with their targets."""

PARTS: Final = ("simulate", "encode State", "decode State", "decide", "encode Command",
                "decode Command", "UDP echo")  # fmt: skip
"""Layers of which a lock-step step of one drone consists: once each."""

_ECHO: Final = """
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
_STEPS_AT_ONCE: Final = 64  # between two looks at the clock


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
    """Measure every layer in turns of so many seconds, and write `bench.json` into `folder`.

    Told before each turn: name of the layer, turns done, turns in all. Raises `InputError`.
    """
    expect(rounds >= 1, "rounds", "at least 1", str(rounds))
    expect(0 < seconds <= 60, "seconds", "more than 0 and at most 60", str(seconds))
    rates: dict[str, list[float]] = {name: [] for name, *_ in _LAYERS}
    turns, done = (rounds + 1) * len(_LAYERS), 0
    for group in _GROUPS:
        with ExitStack() as stack:
            opened: list[tuple[str, Slice]] = []
            for name, _, _, open_ in group:
                on_layer(f"opening {name}", done, turns)
                opened.append((name, open_(stack)))
            for number in range(rounds + 1):
                first = number % len(opened)
                for name, run in opened[first:] + opened[:first]:
                    on_layer(name, done, turns)
                    start = time.perf_counter()
                    rate = run(seconds) / (time.perf_counter() - start)
                    done += 1
                    if number:  # the first round warms up
                        rates[name].append(round(rate, 1))
    layers = [
        Layer(name=name, about=about, drones=drones, rates=tuple(rates[name]))
        for name, about, drones, _ in _LAYERS
    ]
    values = {
        ratio.name: {"value": round(ratio.value(layers), 3), "target": ratio.target_text}
        for ratio in RATIOS
    }
    content = {
        "rounds": rounds,
        "seconds": seconds,
        "layers": [asdict(layer) for layer in layers],
        "medians": {layer.name: layer.rate for layer in layers},
        "ratios": values,
        "microseconds": {name: round(1e6 * seconds, 2) for name, seconds in parts_of(layers)},
        "machine": machine(),
        "versions": software_versions(),
    }
    write_whole(folder / "bench.json", (json.dumps(content, indent=2) + "\n").encode())
    return layers


def parts_of(layers: Sequence[Layer]) -> list[tuple[str, float]]:
    """Median time of each part of a lock-step step of one drone, of the rest and of all, s."""
    of = {layer.name: layer for layer in layers}
    whole = statistics.median(1 / rate for rate in of["UDP, 1"].rates)
    whole += 1 / of["decide"].rate  # the layer flies without a policy
    parts = [(name, 1 / of[name].rate) for name in PARTS]
    return [*parts, ("links", whole - sum(seconds for _, seconds in parts)), ("step", whole)]


# ---- the layers: each is opened for as long as the stack is, and gives a `Slice`


def _for_a_while(fly: Callable[[], int], prepare: Callable[[], object] = lambda: None) -> Slice:
    def run(seconds: float) -> int:
        prepare()
        until, steps = time.perf_counter() + seconds, 0
        while time.perf_counter() < until:
            steps += fly()
        return steps

    return run


def _again(
    call: Callable[[], Any], drones: int = 1, prepare: Callable[[], object] = lambda: None
) -> Slice:
    """Calls it, a step of so many drones, `_STEPS_AT_ONCE` times between two looks at the clock."""

    def fly() -> int:
        for _ in range(_STEPS_AT_ONCE):
            call()
        return drones * _STEPS_AT_ONCE

    return _for_a_while(fly, prepare)


def _mj_step(_: ExitStack) -> Slice:
    vehicle = Vehicle.load()
    model, substeps = vehicle.model, vehicle.substeps(_PERIOD)
    data = mujoco.MjData(model)

    def prepare() -> None:
        # Every turn begins in the air: how long it lasts must not matter.
        mujoco.mj_resetData(model, data)
        data.qpos[2], data.ctrl[:] = 5.0, vehicle.hover_thrust

    return _again(lambda: mujoco.mj_step(model, data, substeps), prepare=prepare)


def _batch_step(drones: int, timestep: float | None = None) -> Slice:
    vehicle = Vehicle.load()
    model = copy.deepcopy(vehicle.model)
    model.opt.timestep = timestep or model.opt.timestep
    batch, substeps = Batch(model, drones), round(_PERIOD / model.opt.timestep)

    def prepare() -> None:
        batch.reset()
        batch.qpos[:, 2], batch.ctrl[:] = 5.0, vehicle.hover_thrust

    def fly() -> int:
        batch.step(nstep=substeps)
        return drones

    return _for_a_while(fly, prepare)


def _actions(*shape: int) -> Iterator[Any]:
    """Random actions near hover, the same ones again and again."""
    return cycle(np.random.default_rng(0).uniform(-0.1, 0.1, shape).astype(np.float32))


def _local(stack: ExitStack, drones: int) -> Slice:
    one = drones == 1
    made: Any = gym.make(ENV_ID, disable_env_checker=True) if one else gym.make_vec(ENV_ID, drones)
    return _env(stack.enter_context(closing(made.unwrapped)))


def _env(env: Any) -> Slice:
    """Of a vector env, drones whose episode ended are reset by the next step, as in NEXT_STEP."""
    env.reset(seed=0)
    if hasattr(env, "num_envs"):
        actions = _actions(16, env.num_envs, 1)

        def fly() -> int:
            resets = env.done
            env.advance(next(actions), resets if resets.any() else None)
            return int((~resets).sum())

        return _for_a_while(fly)
    single = _actions(4096, 1)

    def step() -> None:
        _, _, terminated, truncated, _ = env.step(next(single))
        if terminated or truncated:
            env.reset()

    return _again(step)


def _simulate(stack: ExitStack) -> Slice:
    """The simulator's part between a Command and a State."""
    actions, everyone = _actions(_STEPS_AT_ONCE, 1, 1), np.ones(1, bool)
    loop = stack.enter_context(closing(Loop(EnvConfig(env_id=ENV_ID))))
    loop.advance(next(actions), everyone)

    def step() -> None:
        loop.advance(next(actions), everyone if loop.done[0] else None)
        loop.telemetry  # noqa: B018  # made when it is asked for

    return _again(step)


def _messages() -> tuple[Any, dict[str, State | Command]]:
    """The layout of one drone, and a State and a Command of it by name."""
    action = np.zeros((1, 1), np.float32)
    with closing(Loop(EnvConfig(env_id=ENV_ID))) as loop:
        loop.advance(action, np.ones(1, bool))
        state = State(
            session=1,
            sequence=2,
            time=0.02,
            observations=tuple(loop.observations.values()),
            telemetry=tuple(loop.telemetry.values()),
            **{name: getattr(loop, name) for name in ("rewards", "terminated", "truncated")},
        )
        command = Command(session=1, sequence=2, actions=action, orders=np.zeros(1, np.uint8))
        return layout_of(loop.spec, 1), {"State": state, "Command": command}


def _codec(name: str) -> Slice:
    layout, messages = _messages()
    what, kind = name.split()
    message = messages[kind]
    datagram = binary.encode(message, layout)
    if what == "encode":
        return _again(lambda: binary.encode(message, layout))
    return _again(lambda: binary.decode(datagram, layout))


def _echo(stack: ExitStack) -> Slice:
    """A blocking Python client and server on one core, which is the fastest way; datagrams of the
    sizes of a State and a Command."""
    layout, messages = _messages()
    sizes = {kind: len(binary.encode(one, layout)) for kind, one in messages.items()}
    words = [sys.executable, "-c", _ECHO, str(sizes["Command"])]
    process = stack.enter_context(subprocess.Popen(words, stdout=subprocess.PIPE))
    assert process.stdout is not None
    address, message = ("127.0.0.1", int(process.stdout.readline())), bytes(sizes["State"])
    sock = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    sock.settimeout(1.0)
    stack.callback(sock.sendto, b"", address)

    def exchange() -> None:
        sock.sendto(message, address)
        sock.recvfrom(65536)

    exchange_for = _again(exchange)

    def run(seconds: float) -> int:
        with one_core(process.pid):
            return exchange_for(seconds)

    return run


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


def _policy(drones: int) -> Slice:
    dice = np.random.default_rng(0)
    shapes: dict[str, Any] = {
        "layers.0.weight": (16, 3), "layers.0.bias": 16, "layers.1.weight": (1, 16),
        "layers.1.bias": 1, "log_std": 1,
    }  # fmt: skip
    weights = {name: dice.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
    policy = NetworkPolicy.load(weights, env_spec(EnvConfig(env_id=ENV_ID)), preset("vpg", "paper"))
    observations = dice.normal(size=(drones, 3)).astype(np.float32)
    noise = policy.draw_noise(dice, drones)
    return _again(lambda: policy.actions.to_envs(policy.sample(observations, noise)), drones)


def _training(stack: ExitStack, algorithm: str, drones: int) -> Slice:
    # With 64 drones: five steps of each for an update, as SB3's default has it; VPG an episode.
    batch = {"episodes_per_update": 64} if algorithm == "vpg" else {"steps_per_update": 64 * 5}
    changes: dict[str, Any] = {} if drones == 1 else batch
    config = preset(algorithm, "tuned", **changes)
    run = Run(algorithm=algorithm, config=config, seed=0, env_steps=10**9, num_envs=drones)
    env = stack.enter_context(spawn_simulator(run.flown, num_envs=drones))
    training = Training(run, env)

    def fly(seconds: float) -> int:
        until, before = time.perf_counter() + seconds, training.log.env_steps
        training.train(lambda: time.perf_counter() < until)
        return training.log.env_steps - before

    return fly


_MANY: Final = (64, 1024, 4096)
_CODEC: Final = ("encode State", "decode State", "encode Command", "decode Command")
_LAYERS: Final[list[tuple[str, str, int, Callable[[ExitStack], Slice]]]] = [
    ("mj_step", "a loop over mj_step, substeps of one control step", 1, _mj_step),
    ("env", "the single env's step", 1, lambda s: _local(s, 1)),
    ("Batch.step, 1024", "mujoco.batch, the same substeps", 1024, lambda _: _batch_step(1024)),
    ("Batch.step at 5 ms, 1024", "the same with physics steps of 5 ms", 1024,
     lambda _: _batch_step(1024, _FINER_TIMESTEP)),
    *((f"vector env, {n}", "the vector env", n, lambda s, n=n: _local(s, n)) for n in _MANY),
    ("UDP echo", "blocking sockets in Python on one core, datagrams of the same sizes", 1, _echo),
    *((f"UDP, {n}", f"Remote{'Vector' * (n > 1)}Env and a simulator", n,
       lambda s, n=n: _env(s.enter_context(spawn_simulator(EnvConfig(), num_envs=n))))
      for n in (1, *_MANY)),
    ("simulate", "physics, task and telemetry of one drone", 1, _simulate),
    *((name, "of one drone, binary", 1, lambda _, name=name: _codec(name)) for name in _CODEC),
    ("decide", "16 units, sampled", 1, lambda _: _policy(1)),
    ("policy, 1024", "16 units, sampled", 1024, lambda _: _policy(1024)),
    *((f"{a}, {n}", "training over UDP", n, lambda s, a=a, n=n: _training(s, a, n))
      for n in (1, 64) for a in ("vpg", "a2c", "sb3-a2c")),
]  # fmt: skip
"""Name, what it is, drones, and how it is opened."""
_GROUPS: Final = (
    [layer for layer in _LAYERS if layer[2] == 1 and "training" not in layer[1]],
    [layer for layer in _LAYERS if layer[2] > 1 and "training" not in layer[1]],
    [layer for layer in _LAYERS if "training" in layer[1]],
)
"""Those that are compared with each other are open together, and no others."""

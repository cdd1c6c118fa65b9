"""What bounds a training on this machine: the layers from raw physics to an update, side by side.

Every layer is open at the same time and they take turns to run for a moment, in an order that
changes from round to round. Ratios are made within a round, and their medians count, so that a
machine that slows down for a while slows all alike.
"""

import json
import platform
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import mujoco
import numpy as np
from joblib import cpu_count
from mujoco.batch import Batch

from ..agents import preset
from ..agents.checkpoints import software_versions, write_whole
from ..agents.policies import NetworkPolicy
from ..envs import ENV_ID, ElevationConfig, ElevationVectorEnv
from ..models import load_model
from ..models.constants import HOVER_THRUST
from ..udp import binary
from ..udp.fleet import describe
from .pairs import socket_pair
from .training import Run, Training

__all__ = ["RATIOS", "BenchConfig", "Layer", "bench", "layers_of", "ratio_of"]

Slice = Callable[[float], int]
"""Runs for about so many seconds; how many env steps it made."""

RATIOS: Final = (
    ("env", "mj_step"),
    ("vector env, 1024", "Batch.step, 1024"),
    ("UDP, 1", "UDP echo"),
    ("UDP, 1024", "vector env, 1024"),
    ("a2c, 64", "sb3-a2c, 64"),
    ("a2c, 1", "sb3-a2c, 1"),
    ("vector env, 4096", "vector env, 64"),
)
"""Pairs of layers whose rates are compared: numerator, denominator."""

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
_STEPS_AT_ONCE: Final = 64
"""Single steps between two looks at the clock."""


@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """How long to measure."""

    rounds: int = 7
    """Turns of every layer."""
    seconds: float = 0.5
    """Length of a turn, s."""

    def __post_init__(self) -> None:
        if self.rounds < 1:
            raise ValueError(f"rounds: expected at least 1, got {self.rounds}")
        if not 0 < self.seconds <= 60:
            raise ValueError(f"seconds: expected more than 0 and at most 60, got {self.seconds}")


@dataclass(frozen=True, kw_only=True)
class Layer:
    """One of the things measured."""

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
    config: BenchConfig, folder: Path, on_layer: Callable[[str, int, int], None]
) -> list[Layer]:
    """Measure every layer, and write `bench.json` into `folder`.

    Args:
        config: How long.
        folder: Made if it is not there.
        on_layer: Told before each turn: name of the layer, turns done, turns in all.
    """
    with ExitStack() as stack:
        opened: list[tuple[str, str, int, Slice]] = []
        rates: dict[str, list[float]] = {}
        for name, about, drones, open_ in _LAYERS:
            on_layer(f"opening {name}", 0, 1)
            opened.append((name, about, drones, stack.enter_context(open_())))
            rates[name] = []
        total, turn = (config.rounds + 1) * len(opened), 0
        for number in range(config.rounds + 1):
            first = number % len(opened)
            for name, _, _, run in opened[first:] + opened[:first]:
                on_layer(name, turn, total)
                start = time.perf_counter()
                steps = run(config.seconds)
                rate = steps / (time.perf_counter() - start)
                if number:  # the first round warms up
                    rates[name].append(round(rate, 1))
                turn += 1
    layers = [
        Layer(name=name, about=about, drones=drones, rates=tuple(rates[name]))
        for name, about, drones, _ in opened
    ]
    _write(layers, config, folder)
    return layers


def ratio_of(layers: list[Layer], numerator: str, denominator: str) -> float:
    """Median over the rounds of one layer's rate over another's."""
    of = {layer.name: layer.rates for layer in layers}
    pairs = zip(of[numerator], of[denominator], strict=True)
    return statistics.median(a / b for a, b in pairs)


def layers_of(folder: Path) -> list[Layer]:
    """What `bench` wrote. Raises `ValueError` if it is not there."""
    path = folder / "bench.json"
    try:
        content = json.loads(path.read_text())
        return [Layer(**{**layer, "rates": tuple(layer["rates"])}) for layer in content["layers"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: expected what rotorgram bench writes: {error!r}") from None


def _write(layers: list[Layer], config: BenchConfig, folder: Path) -> None:
    content = {
        **asdict(config),
        "layers": [asdict(layer) for layer in layers],
        "medians": {layer.name: layer.rate for layer in layers},
        "ratios": {f"{a} / {b}": round(ratio_of(layers, a, b), 3) for a, b in RATIOS},
        "machine": {
            "platform": platform.platform(),
            "processor": platform.machine(),
            "cores": cpu_count(),
        },
        "versions": software_versions(),
    }
    write_whole(folder / "bench.json", (json.dumps(content, indent=2) + "\n").encode())


# ---- the layers, each a context that gives a `Slice`


@contextmanager
def _mj_step() -> Iterator[Slice]:
    model = load_model(visual=False)
    data = mujoco.MjData(model)
    substeps = ElevationConfig().substeps

    def fly() -> int:
        # Every turn begins in the air: how long it lasts must not matter.
        for _ in range(_STEPS_AT_ONCE):
            mujoco.mj_step(model, data, substeps)
        return _STEPS_AT_ONCE

    def prepare() -> None:
        mujoco.mj_resetData(model, data)
        data.qpos[2], data.ctrl[:] = 5.0, HOVER_THRUST

    yield _for_a_while(fly, prepare)


@contextmanager
def _batch_step(drones: int) -> Iterator[Slice]:
    batch = Batch(load_model(visual=False), drones)
    substeps = ElevationConfig().substeps

    def prepare() -> None:
        batch.reset()
        batch.qpos[:, 2], batch.ctrl[:] = 5.0, HOVER_THRUST

    def fly() -> int:
        batch.step(nstep=substeps)
        return drones

    yield _for_a_while(fly, prepare)


@contextmanager
def _env() -> Iterator[Slice]:
    with closing(gym.make(ENV_ID, disable_env_checker=True).unwrapped) as env:
        yield _single(env)


@contextmanager
def _udp_single() -> Iterator[Slice]:
    with socket_pair(ElevationConfig()) as env:
        yield _single(env)


@contextmanager
def _vector_env(drones: int) -> Iterator[Slice]:
    with closing(ElevationVectorEnv(drones)) as env:
        yield _vector(env)


@contextmanager
def _udp_batch(drones: int) -> Iterator[Slice]:
    with socket_pair(ElevationConfig(), num_envs=drones) as env:
        yield _vector(env)


@contextmanager
def _echo() -> Iterator[Slice]:
    """A blocking Python client and server; datagrams of the sizes of a State and a Command."""
    with closing(gym.make(ENV_ID)) as env:
        hello = describe(env)
    state, command = binary.state_size(hello), binary.command_size(hello) - 8
    words = [sys.executable, "-c", _ECHO, str(command)]
    with subprocess.Popen(words, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        address, message = ("127.0.0.1", int(process.stdout.readline())), bytes(state)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            sock.settimeout(1.0)

            def fly() -> int:
                for _ in range(_STEPS_AT_ONCE):
                    sock.sendto(message, address)
                    sock.recvfrom(65536)
                return _STEPS_AT_ONCE

            try:
                yield _for_a_while(fly)
            finally:
                sock.sendto(b"", address)


@contextmanager
def _policy(drones: int) -> Iterator[Slice]:
    dice = np.random.default_rng(0)
    weights = {
        "hidden.weight": dice.normal(size=(16, 3)),
        "hidden.bias": np.zeros(16),
        "output.weight": dice.normal(size=(1, 16)),
        "output.bias": np.zeros(1),
        "log_std": np.zeros(1),
    }
    policy = NetworkPolicy({name: array.astype(np.float32) for name, array in weights.items()})
    observations = dice.normal(size=(drones, 3)).astype(np.float32)
    noise = policy.draw_noise(dice, drones)

    def fly() -> int:
        for _ in range(_STEPS_AT_ONCE):
            if drones == 1:
                policy.to_env(policy.sample(observations[0], noise[0]))
            else:
                policy.to_envs(policy.samples(observations, noise))
        return drones * _STEPS_AT_ONCE

    yield _for_a_while(fly)


@contextmanager
def _training(algorithm: str, drones: int) -> Iterator[Slice]:
    run = Run(
        algorithm=algorithm,
        config=preset(algorithm, "tuned", **({} if drones == 1 else _BATCH[algorithm])),
        env=ElevationConfig(),
        seed=0,
        env_steps=10**9,
        num_envs=drones,
    )
    with socket_pair(run.env, num_envs=drones) as env:
        training = Training(run, env)

        def fly(seconds: float) -> int:
            until, before = time.perf_counter() + seconds, training.log.env_steps
            training.train(lambda: time.perf_counter() < until)
            return training.log.env_steps - before

        yield fly


_BATCH: Final[dict[str, dict[str, Any]]] = {
    "vpg": {"episodes_per_update": 64},
    "a2c": {"steps_per_update": 64 * 5},
    "sb3-a2c": {"steps_per_update": 64 * 5},
}
"""With 64 drones: five steps of each for an update, as SB3's default has it; VPG an episode."""


def _single(env: Any) -> Slice:
    actions = np.random.default_rng(0).uniform(-0.1, 0.1, (4096, 1)).astype(np.float32)
    env.reset(seed=0)
    number = 0

    def fly() -> int:
        nonlocal number
        for _ in range(_STEPS_AT_ONCE):
            _, _, terminated, truncated, _ = env.step(actions[number % 4096])
            number += 1
            if terminated or truncated:
                env.reset()
        return _STEPS_AT_ONCE

    return _for_a_while(fly)


def _vector(env: Any) -> Slice:
    """Random actions; drones whose episode ended are reset by the next step, as in NEXT_STEP."""
    shape = env.num_envs, 1
    dice = np.random.default_rng(0)
    actions = [dice.uniform(-0.1, 0.1, shape).astype(np.float32) for _ in range(16)]
    env.reset(seed=0)
    number = 0

    def fly() -> int:
        nonlocal number
        resets = env.terminated | env.truncated
        env.advance(actions[number % 16], resets)
        number += 1
        return int((~resets).sum())

    return _for_a_while(fly)


def _for_a_while(fly: Callable[[], int], prepare: Callable[[], None] = lambda: None) -> Slice:
    def run(seconds: float) -> int:
        prepare()
        until, steps = time.perf_counter() + seconds, 0
        while time.perf_counter() < until:
            steps += fly()
        return steps

    return run


_MANY: Final = (64, 1024, 4096)
_LAYERS: Final[list[tuple[str, str, int, Callable[[], Any]]]] = [
    ("mj_step", "a loop over mj_step, substeps of one control step", 1, _mj_step),
    ("env", "ElevationEnv.step", 1, _env),
    ("Batch.step, 1024", "mujoco.batch, the same substeps", 1024, lambda: _batch_step(1024)),
    *((f"vector env, {n}", "ElevationVectorEnv", n, lambda n=n: _vector_env(n)) for n in _MANY),
    ("UDP echo", "blocking sockets in Python, datagrams of the same sizes", 1, _echo),
    ("UDP, 1", "RemoteEnv and a simulator", 1, _udp_single),
    *(
        (f"UDP, {n}", "RemoteVectorEnv and a simulator", n, lambda n=n: _udp_batch(n))
        for n in _MANY
    ),
    *((f"policy, {n}", "16 units, sampled", n, lambda n=n: _policy(n)) for n in (1, 1024)),
    *(
        (f"{a}, {n}", "training over UDP", n, lambda a=a, n=n: _training(a, n))
        for n in (1, 64)
        for a in ("vpg", "a2c", "sb3-a2c")
    ),
]
"""Name, what it is, drones, and how it is opened."""

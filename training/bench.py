"""Env steps per second on this machine, from raw physics to a simulator over UDP.

All layers are open at the same time and take turns to run for a moment; the median over the turns
counts, so that a machine that slows down for a while slows all alike.
"""

import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from ..envs.autoreset import AdvancingVectorEnv
from ..envs.config import EnvConfig
from ..envs.vector import LocalVectorEnv
from ..models.fields import Limits, check
from ..models.files import software_versions, write_json
from ..models.vehicle import Vehicle
from ..udp.spawn import spawn_simulator
from .results import machine

ENV_ID = "rotorgram/Elevation-v0"
_PERIOD = 0.02  # s, of a control step
_STEPS_AT_ONCE = 64  # of one drone between two looks at the clock
_DRONES = 1024

Step = Callable[[], int]
"""Flies a step of all drones; the number of env steps that it made."""


class Layer(NamedTuple):
    """What is measured."""

    name: str
    about: str
    drones: int
    start: Callable[[ExitStack], Step]
    """Opens it for as long as the stack is."""


def bench(
    rounds: int, seconds: float, folder: Path, on_layer: Callable[[str, int, int], None]
) -> dict[str, float]:
    """Measure every layer in turns of `seconds`, and write `bench.json` into `folder`.

    `on_layer` is called before each turn: name of the layer, turns done, turns in all. Returns the
    median rate of each layer, env steps per second. Raises `InputError`.
    """
    check("rounds", Limits(1, whole=True), rounds)
    check("seconds", Limits(0, 60, "s", above=True), seconds)
    turns = (rounds + 1) * len(LAYERS)
    done = 0
    rates: dict[str, list[float]] = {layer.name: [] for layer in LAYERS}
    with ExitStack() as stack:
        steps = {}
        for layer in LAYERS:
            on_layer(f"opening {layer.name}", done, turns)
            steps[layer.name] = layer.start(stack)
        for number in range(rounds + 1):
            for layer in LAYERS:
                on_layer(layer.name, done, turns)
                done += 1
                at_once = _STEPS_AT_ONCE if layer.drones == 1 else 1
                rate = rate_of(steps[layer.name], seconds, at_once)
                if number:  # the first round warms up
                    rates[layer.name].append(round(rate, 1))
    medians = {name: statistics.median(values) for name, values in rates.items()}
    content = {
        "rounds": rounds,
        "seconds": seconds,
        "rates": rates,
        "medians": medians,
        "machine": machine(),
        "versions": software_versions(),
    }
    write_json(folder / "bench.json", content)
    return medians


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


# ---- the layers


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
    batch = Batch(vehicle.model, _DRONES)
    substeps = vehicle.substeps(_PERIOD)
    batch.qpos[:, 2] = 5.0
    batch.ctrl[:] = vehicle.hover_thrust

    def step() -> int:
        batch.step(nstep=substeps)
        return _DRONES

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


def _remote(stack: ExitStack) -> Step:
    return single_step(stack.enter_context(spawn_simulator(EnvConfig(env_id=ENV_ID))))


def _vector(stack: ExitStack) -> Step:
    return _vector_step(stack.enter_context(closing(LocalVectorEnv(ENV_ID, _DRONES))))


def _remote_vector(stack: ExitStack) -> Step:
    opened = spawn_simulator(EnvConfig(env_id=ENV_ID), num_envs=_DRONES)
    return _vector_step(stack.enter_context(opened))


LAYERS = (
    Layer("mj_step", "substeps of one control step", 1, _mj_step),
    Layer("env", "the single env's step", 1, local_env),
    Layer("UDP, 1", "RemoteEnv and a simulator", 1, _remote),
    Layer("Batch.step, 1024", "mujoco.batch, the same substeps", _DRONES, _batch_step),
    Layer("vector env, 1024", "the vector env", _DRONES, _vector),
    Layer("UDP, 1024", "RemoteVectorEnv", _DRONES, _remote_vector),
)

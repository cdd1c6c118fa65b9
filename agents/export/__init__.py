"""A trained policy as one file that flies without rotorgram: ONNX or C; or an app of a firmware.

The file has the whole of `NetworkPolicy.act`: layers, activation, squashing, mapping to the env's
action, clipping to its bounds; or the choice of the largest output. The action is the deterministic
one. Every number is float32. What a policy remembers of an episode goes in and comes out.
"""

import json
from collections.abc import Iterable
from dataclasses import replace
from importlib import import_module

import numpy as np

from ...envs.config import EnvConfig
from ...envs.registry import env_spec
from ...models import Vehicle
from ...models.errors import InputError, require
from ...models.library import is_pool
from ..checkpoints import Checkpoint
from ..layers import Layer
from ..policies import NetworkPolicy, flat_size

FORMAT = 1
"""Version of the metadata and of the names in the files."""

TARGETS = {"onnx": "policy.onnx", "c": "rotorgram_policy.h"}
"""Name of the file of each target, by default."""

_LARGEST = 1e6
"""Largest weight: up to it four layers of 500 units have finite outputs."""
_SPEC = ("env_id", "options", "control_period", "vehicle", "vehicle_hash", "observation", "action")


def export(checkpoint: Checkpoint, target: str) -> bytes:
    """The content of the file. `target` is one of `TARGETS`.

    Raises `MissingPackage` where ONNX is asked for and not installed, and `InputError` for a policy
    that diverged: its weights are so large that its outputs may be no numbers.
    """
    if target == "onnx":
        require("onnx", "export", "--to onnx")
    module = import_module(f"{__name__}.{target}")
    return bytes(module.write(finite_policy(checkpoint), metadata(checkpoint)))


def on_vehicle(checkpoint: Checkpoint, vehicle: str) -> Checkpoint:
    """A policy of the level `wrench` on another craft, whose rotors lag if its file says how much.

    Raises `InputError`.
    """
    env = checkpoint.env
    if env is None or env.action != "wrench":
        raise InputError(
            "vehicle: expected a policy of the level wrench, whose actions mean the same to every "
            f"craft, got {env.action if env else 'one that does not know its env'}"
        )
    lags = Vehicle.load(vehicle).coefficients["rotors.time_constant"]
    effects = {**env.effects.to_options(), "motor_lag": bool(lags)}
    env = env.changed(vehicle=vehicle, effects=effects, randomize={}, observe_drawn=False).resolve()
    spec = env_spec(env)
    checkpoint.policy(spec)
    return replace(checkpoint, env=env, spec=spec)


def write_layers(writer: object, layers: Iterable[Layer]) -> None:
    """Call the writer's method of each layer's name, as `affine`.

    Raises `InputError` where there is none.
    """
    for layer in layers:
        name = type(layer).__name__
        write = getattr(writer, name.lower(), None)
        if write is None:
            expected = "affine layers, convolutions, a GRU, scaling, relu and tanh"
            raise InputError(f"export: expected {expected}, got {name}")
        write(layer)


def finite_policy(checkpoint: Checkpoint) -> NetworkPolicy:
    """The policy. Raises `InputError` for one that diverged."""
    policy = checkpoint.policy()
    largest = np.abs(policy.weights.values).max()
    if not largest <= _LARGEST:  # nan is not
        raise InputError(
            f"policy: expected weights of at most {_LARGEST:g}, got {largest:g}: training diverged"
        )
    return policy


def metadata(checkpoint: Checkpoint) -> dict[str, str]:
    """What a reader of the file must know, by name.

    `format`, `algorithm`, `seed`, `env_steps` (trained so far), and of the spec `env_id`,
    `options`, `control_period` (s), `vehicle`, `vehicle_hash`, `observation`, `action`; `inputs` is
    the length of the observation as the file takes it: all its arrays, one after the other; and
    `rotors`, which `rotors_of` has, where the checkpoint knows its vehicle. A value that is not a
    text is JSON.
    """
    spec = checkpoint.spec.for_actor()
    fields = json.loads(spec.to_json())
    facts = {
        "format": FORMAT,
        "algorithm": checkpoint.algorithm,
        "seed": checkpoint.seed,
        "env_steps": checkpoint.position.env_steps,
        "inputs": flat_size(spec),
        **{name: fields[name] for name in _SPEC},
    }
    env = checkpoint.env
    if env and len(env.vehicle) < 2 and not any(map(is_pool, env.vehicle)):
        facts["rotors"] = rotors_of(env)
    return {
        name: value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
        for name, value in facts.items()
    }


def rotors_of(env: EnvConfig) -> dict[str, list[float]]:
    """Numbers of the rotors of an env's one vehicle, as `c.ROTORS` lists them."""
    vehicle = env.load_vehicle()
    coefficients = vehicle.coefficients
    rise = coefficients["rotors.time_constant"] if env.effects.motor_lag else 0.0
    fall = coefficients["rotors.time_constant_down"] if env.effects.motor_lag else 0.0
    carried = 1.0 + env.task.get("payload_share", 0.0)
    reactions = [np.dot(rotor.reaction, rotor.axis) for rotor in vehicle.rotors]
    return {
        "hover": vehicle.hover_thrust.tolist(),
        "least": vehicle.thrust_low.tolist(),
        "largest": vehicle.thrust_high.tolist(),
        "initial": (carried * vehicle.hover_thrust).tolist(),
        "positions": [number for rotor in vehicle.rotors for number in rotor.position],
        "turns": (-np.sign(reactions)).astype(int).tolist(),
        "lags": [rise, fall or rise],
    }

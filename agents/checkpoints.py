"""Checkpoints: one safetensors file with weights, state, config, seed and versions.

Loading one runs no code from it. Writing one replaces the old file whole or not at all.
"""

import json
import os
import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from .episodes import Position
from .policies import NetworkPolicy
from .presets import PRESETS

__all__ = ["Checkpoint", "CheckpointError", "load", "software_versions", "store", "write_whole"]

FORMAT: Final = 1
_ACTOR: Final = "policy/"
_STATE: Final = "state/"
_POSITION: Final = "episode/"
_MALFORMED: Final = (KeyError, TypeError, ValueError, AttributeError, IndexError, RecursionError)
"""What reading a file of somebody else's making can raise."""


class CheckpointError(ValueError):
    """A file is missing, or is not a checkpoint of ours."""


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """A training at an update boundary."""

    algorithm: str
    config: dict[str, Any]
    """Hyperparameters."""
    env: dict[str, Any]
    """Options of the env."""
    seed: int
    env_steps: int
    """Env steps that the whole training is to have."""
    model_hash: str
    """Model of the simulator; empty where it told none."""
    actor: Mapping[str, np.ndarray]
    """Weights for `NetworkPolicy`."""
    state: Mapping[str, np.ndarray]
    """State of the agent."""
    position: Position
    """Where the run stands."""
    num_envs: int = 1
    """Drones that it trains with."""
    versions: dict[str, str] = field(default_factory=lambda: software_versions())

    def policy(self) -> NetworkPolicy:
        """The policy, ready to fly."""
        return NetworkPolicy(self.actor)


def software_versions() -> dict[str, str]:
    """Versions of what the numbers depend on."""
    names = ("rotorgram", "mujoco", "gymnasium", "numpy", "torch", "stable-baselines3")
    return {"python": platform.python_version(), **{name: version(name) for name in names}}


def store(checkpoint: Checkpoint, path: Path) -> None:
    """Write a checkpoint: after a crash at any moment, `path` holds the old one or the new one."""
    position = checkpoint.position
    arrays = {_ACTOR + name: value for name, value in checkpoint.actor.items()}
    arrays |= {_STATE + name: value for name, value in checkpoint.state.items()}
    here = asdict(position)
    arrays |= {_POSITION + k: v for k, v in here.items() if isinstance(v, np.ndarray)}
    meta = {
        "format": FORMAT,
        "algorithm": checkpoint.algorithm,
        "config": checkpoint.config,
        "env": checkpoint.env,
        "seed": checkpoint.seed,
        "env_steps": checkpoint.env_steps,
        "model_hash": checkpoint.model_hash,
        "versions": checkpoint.versions,
        "num_envs": checkpoint.num_envs,
        "position": {name: here[name] for name in ("episode", "env_steps", "seconds")},
    }
    data = save({k: np.asarray(v, order="C") for k, v in arrays.items()},
                metadata={"rotorgram": json.dumps(meta)})  # fmt: skip
    write_whole(path, data)


def load(path: Path) -> Checkpoint:
    """Read a checkpoint.

    Raises:
        CheckpointError: There is no such file, or it is not a checkpoint of this format.
    """
    if not path.is_file():
        raise CheckpointError(f"checkpoint: no file {path}")
    try:
        return _read(path)
    except OSError as error:
        raise CheckpointError(f"checkpoint: cannot read {path}: {error.strerror}") from None
    except (SafetensorError, *_MALFORMED) as error:
        raise CheckpointError(f"{path}: expected a rotorgram checkpoint: {error!r:.200}") from None


def _read(path: Path) -> Checkpoint:
    with safe_open(path, framework="numpy") as file:
        meta = json.loads((file.metadata() or {})["rotorgram"])
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    _expect(meta["format"] == FORMAT, f"format {FORMAT}", meta["format"])
    position = meta["position"]
    _expect(meta["algorithm"] in PRESETS, f"one of {sorted(PRESETS)}", meta["algorithm"])
    num_envs = meta.get("num_envs", 1)
    counts = meta["seed"], meta["env_steps"], num_envs, position["episode"], position["env_steps"]
    for count in counts:
        _expect(type(count) is int and count >= 0, "a whole number, 0 or more", count)
    seconds = position["seconds"]
    _expect(type(seconds) is float and 0 <= seconds < float("inf"), "seconds", seconds)
    for name, array in arrays.items():
        finite = array.dtype.kind != "f" or bool(np.isfinite(array).all())
        _expect(finite, f"finite numbers in {name}", "NaN or infinity")
    fields = ("algorithm", "config", "env", "seed", "env_steps", "model_hash", "versions")
    return Checkpoint(
        **{name: meta[name] for name in fields},
        actor=_part(arrays, _ACTOR),
        state=_part(arrays, _STATE),
        num_envs=num_envs,
        position=Position(**{**position, **_part(arrays, _POSITION)}),
    )


def _expect(ok: bool, expected: str, got: object) -> None:
    if not ok:
        raise ValueError(f"expected {expected}, got {got!r:.80}")


def _part(arrays: Mapping[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    return {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}


def write_whole(path: Path, data: bytes) -> None:
    """Write a file: after a crash at any moment, `path` holds the old one or the new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.tmp")
    with open(temporary, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)

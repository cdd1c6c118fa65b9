"""Checkpoints: one safetensors file with weights, state, config, spec, seed and versions.

A *policy alone*, without the state and the position of the training, is a small one: it flies, and
no training goes on from it.

Loading one runs no code from it. Writing one replaces the old file whole or not at all. A checksum
over all bytes of the file detects any damage.
"""

import hashlib
import json
import os
import platform
import re
import secrets
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

import numpy as np

from ..envs.spec import Discrete, EnvSpec
from ..models import BACKENDS, Backend
from ..models.errors import InputError, require
from .episodes import Episode, Position, ResumeError
from .policies import NetworkPolicy, flat_size
from .presets import preset
from .registry import ALGORITHMS

FORMAT: Final = 3
_GROUPS: Final = ("policy", "state", "position", "episodes")
_PLAIN: Final = ("algorithm", "config", "backend", "seed", "env_steps", "versions")
_POSITION: Final = ("actions", "observations", "numbers", "lengths", "first_steps")
_COLUMNS: Final[dict[str, type[np.generic]]] = {
    f.name: {int: np.int64, float: np.float64, bool: np.bool_}[f.type]  # type: ignore[index]
    for f in fields(Episode)
}
_CHECKSUM: Final = re.compile(rb'"sha256":"([0-9a-f]{64})"')
_MALFORMED: Final = (KeyError, TypeError, ValueError, AttributeError, IndexError, RecursionError)
"""Errors that reading a crafted file can raise."""


class CheckpointError(InputError):
    """A file is missing, is not a checkpoint of ours, or its parts do not fit together."""


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """A training at an update boundary."""

    algorithm: str
    config: dict[str, Any]
    """Hyperparameters."""
    spec: EnvSpec
    """Of the env: id, options, vehicle and shapes."""
    backend: Backend = "mujoco"
    """What stepped the env in training."""
    seed: int
    env_steps: int
    """Env steps that the whole training is to have."""
    actor: Mapping[str, np.ndarray]
    """Weights for `NetworkPolicy`."""
    state: Mapping[str, np.ndarray]
    """State of the agent."""
    position: Position
    versions: dict[str, str] = field(default_factory=lambda: software_versions())

    @property
    def env_id(self) -> str:
        """Id of the env."""
        return self.spec.env_id

    @property
    def options(self) -> dict[str, Any]:
        """Every option of the env."""
        return dict(self.spec.options)

    @property
    def num_envs(self) -> int:
        """Drones that it trains with; 0 of a policy alone."""
        return len(self.position.numbers)

    def policy_alone(self) -> "Checkpoint":
        """Without the state and the position, which only a training needs."""
        where = self.position
        position = _no_position(where.env_steps, where.seconds)
        return replace(self, state={}, position=position)

    def check_resumable(self) -> None:
        """Raises `ResumeError` for a policy alone."""
        if not self.num_envs:
            raise ResumeError("resume: expected the checkpoint of a training, got a policy alone")

    def policy(self, spec: EnvSpec | None = None) -> NetworkPolicy:
        """The policy, ready to fly that env or its own. Raises `InputError` if it does not fit."""
        squash = ALGORITHMS[self.algorithm].squashed
        config = preset(self.algorithm, "tuned", **self.config)
        return NetworkPolicy.load(self.actor, spec or self.spec, config, squash=squash)

    def other_versions(self) -> dict[str, tuple[str, str]]:
        """Software whose version was another: its version then and now."""
        now = software_versions()
        names = sorted({*self.versions, *now})
        pairs = {name: (self.versions.get(name, "none"), now.get(name, "none")) for name in names}
        return {name: pair for name, pair in pairs.items() if len({*pair}) > 1}


def software_versions() -> dict[str, str]:
    """Versions of the installed packages that the numbers depend on."""
    versions = {"python": platform.python_version()}
    for name in ("rotorgram", "mujoco", "gymnasium", "numpy", "torch", "stable-baselines3"):
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    return versions


def store(checkpoint: Checkpoint, path: Path) -> None:
    """Write a checkpoint: after a crash at any moment, `path` holds the old one or the new one.

    Raises `CheckpointError` where a number is not finite: training diverged. The old file stays.
    """
    where = checkpoint.position
    rows = checkpoint.position.episodes
    parts: dict[str, Mapping[str, Any]] = {
        "policy": checkpoint.actor,
        "state": checkpoint.state,
        "position": {name: getattr(where, name) for name in _POSITION},
        "episodes": {n: np.array([vars(row)[n] for row in rows], k) for n, k in _COLUMNS.items()},
    }
    groups = _GROUPS if checkpoint.num_envs else ("policy",)
    arrays = {
        f"{group}/{name}": np.array(value, order="C")
        for group in groups
        for name, value in parts[group].items()
    }
    for name, array in arrays.items():
        if not _is_finite(name, array):
            raise CheckpointError(f"checkpoint: training diverged, {name} is not finite")
    meta = {
        "format": FORMAT,
        **{name: getattr(checkpoint, name) for name in _PLAIN},
        "spec": checkpoint.spec.to_json(),
        "position": {"env_steps": where.env_steps, "seconds": where.seconds},
    }
    numpy = require("safetensors.numpy", "train", "writing checkpoints")
    text = {"rotorgram": json.dumps(meta), "sha256": "0" * 64}
    data: bytes = numpy.save(arrays, metadata=text)
    write_whole(path, _with_checksum(data, hashlib.sha256(data).hexdigest().encode()))


def load(path: Path) -> Checkpoint:
    """Read a checkpoint. Raises `CheckpointError` or `MissingPackage`."""
    numpy = require("safetensors.numpy", "train", "reading checkpoints")
    if not path.is_file():
        raise CheckpointError(f"checkpoint: expected a file, got {path}, where there is none")
    try:
        return _read(path.read_bytes(), numpy.load)
    except OSError as error:
        raise CheckpointError(f"checkpoint: cannot read {path}: {error.strerror}") from None
    except (require("safetensors", "train", "").SafetensorError, *_MALFORMED) as error:
        reason = " ".join(str(error).split())
        raise CheckpointError(f"{path}: expected a rotorgram checkpoint: {reason:.200}") from None


def _read(data: bytes, parse: Any) -> Checkpoint:
    told = _CHECKSUM.findall(data)[:1]
    _expect(bool(told), "a checksum", "none")
    found = hashlib.sha256(_with_checksum(data, b"0" * 64)).hexdigest().encode()
    _expect(told == [found], "a file without damage", "another checksum than it holds")
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    meta = json.loads(header["__metadata__"]["rotorgram"])
    _expect(meta["format"] == FORMAT, f"format {FORMAT}", meta["format"])
    arrays: dict[str, dict[str, np.ndarray]] = {group: {} for group in _GROUPS}
    for name, array in parse(data).items():
        _expect(_is_finite(name, array), f"finite numbers in {name}", "NaN or infinity")
        group, _, rest = name.partition("/")
        arrays[group][rest] = array
    meta.setdefault("backend", BACKENDS[0])
    _expect(meta["backend"] in BACKENDS, f"one of {BACKENDS}", meta["backend"])
    _expect(meta["algorithm"] in ALGORITHMS, f"one of {sorted(ALGORITHMS)}", meta["algorithm"])
    for name in ("config", "versions", "position"):
        _expect(isinstance(meta[name], dict), f"an object for {name}", meta[name])
    where = meta["position"]
    seconds = meta["position"]["seconds"]
    for count in (meta["seed"], meta["env_steps"], where["env_steps"]):
        _expect(type(count) is int and 0 <= count < 2**62, "a whole number, 0 or more", count)
    _expect(type(seconds) is float and 0 <= seconds < float("inf"), "seconds", seconds)
    spec = EnvSpec.from_json(meta["spec"])
    position = _no_position(where["env_steps"], seconds)
    if arrays["position"] or arrays["state"] or arrays["episodes"]:
        columns = arrays["episodes"]
        kinds = {name: column.dtype.type for name, column in columns.items()}
        _expect(kinds == _COLUMNS, f"columns {sorted(_COLUMNS)} of episodes", sorted(kinds))
        rows = zip(*(columns[name].tolist() for name in _COLUMNS), strict=True)
        episodes = tuple(Episode(**dict(zip(_COLUMNS, row, strict=True))) for row in rows)
        given: dict[str, Any] = {**arrays["position"]}
        position = replace(position, episodes=episodes, **given)
        _check_position(position, spec, meta["env_steps"])
    meta["config"].setdefault("network", "mlp")
    config = vars(preset(meta["algorithm"], "tuned", **meta["config"]))
    config = json.loads(json.dumps(config))  # a tuple is a list there
    _expect(config == meta["config"], f"a config of all of {sorted(config)}", meta["config"])
    plain = {name: meta[name] for name in _PLAIN}
    actor = arrays["policy"]
    state = arrays["state"]
    checkpoint = Checkpoint(**plain, spec=spec, actor=actor, state=state, position=position)
    checkpoint.policy()  # raises if it does not fit
    return checkpoint


def _no_position(env_steps: int, seconds: float) -> Position:
    """Of a policy alone: what the training had flown, and no drones."""
    none: dict[str, Any] = {name: np.zeros(0, np.int64) for name in _POSITION}
    return Position(env_steps=env_steps, seconds=seconds, **none)


def _with_checksum(data: bytes, checksum: bytes) -> bytes:
    return _CHECKSUM.sub(b'"sha256":"%s"' % checksum, data, count=1)


def _is_finite(name: str, array: np.ndarray) -> bool:
    # Without metrics the error of an episode is NaN, which is no divergence.
    allowed = name == "episodes/mean_size"
    return allowed or array.dtype.kind != "f" or bool(np.isfinite(array).all())


def _check_position(position: Position, spec: EnvSpec, total: int) -> None:
    """Shapes fit the env; env steps are those of the episodes."""
    count = len(position.numbers)
    longest = len(position.actions)
    action = spec.action
    drawn, kind = ((), "i") if isinstance(action, Discrete) else ((action.size,), "f")
    expected: dict[str, Any] = dict.fromkeys(_POSITION, ((count,), "i"))
    expected["actions"] = (longest, count, *drawn), kind
    expected["observations"] = (count, flat_size(spec)), "f"
    got = {n: (vars(position)[n].shape, vars(position)[n].dtype.kind) for n in _POSITION}
    _expect(got == expected and count > 0, f"a position of shapes {expected}", got)
    lengths = position.lengths
    steps = position.env_steps
    _expect(lengths.max() == longest, f"an episode of {longest} steps", lengths)
    ended = {episode.episode: episode.length for episode in position.episodes}
    running = zip(position.numbers.tolist(), lengths.tolist(), strict=True)
    flown = sum(ended.values()) + sum(length for number, length in running if number not in ended)
    _expect(flown == steps, f"env_steps of the episodes, {flown}", steps)
    _expect(steps < total + count, f"env_steps of {total} at most", steps)
    for name in ("numbers", "lengths", "first_steps"):
        least = vars(position)[name].min()
        _expect(least >= 0 or (not steps and least == -1), f"{name} of 0 or more", int(least))


def _expect(ok: bool, expected: str, got: object) -> None:
    if not ok:
        raise ValueError(f"expected {expected}, got {got!r:.80}")


def write_whole(path: Path, data: bytes) -> None:
    """Write a file: after a crash at any moment, `path` holds the old one or the new one.

    Two processes may write it at the same time. `OSError` names the file.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{secrets.token_hex(4)}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(temporary, "xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError):
            raise OSError(error.errno, error.strerror, str(path)) from None
        raise

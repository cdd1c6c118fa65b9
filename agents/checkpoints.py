"""Checkpoints: one safetensors file with weights, state, config, spec, seed and versions.

A *policy alone*, without the state and the position of the training, is a small one: it flies, and
no training goes on from it.

Loading one runs no code from it. Writing one replaces the old file whole or not at all. A checksum
over all bytes of the file detects any damage.
"""

import hashlib
import json
import re
from collections.abc import Callable, Iterator
from dataclasses import field, fields, replace
from itertools import starmap
from pathlib import Path
from typing import Any

import numpy as np

from ..envs.config import EnvConfig
from ..envs.spec import EnvSpec
from ..models import Backend
from ..models.errors import InputError, one_line, require, shortened
from ..models.fields import check_fields, immutable, mapping
from ..models.files import software_versions, write_whole
from .config import Config
from .episodes import Episode, Flown, Long, Position, ResumeError
from .layers import ByName, Parts, named, part_of
from .policies import NetworkPolicy
from .presets import preset

FORMAT = 6
_PLAIN = ("algorithm", "config", "backend", "seed", "env_steps", "versions")

_COLUMNS = {one.name: one.type for one in fields(Episode)}
_CHECKSUM = re.compile(rb'"sha256":"([0-9a-f]{64})"')


class CheckpointError(InputError):
    """A file is missing, is not a checkpoint of ours, or its parts do not fit together."""


@immutable
class Checkpoint:
    """A training at an update boundary."""

    algorithm: str
    config: dict[str, Any]
    """Hyperparameters."""
    spec: EnvSpec
    """Of the env: id, options, vehicle and shapes."""
    env: EnvConfig | None = None
    """The resolved config of the env; None where only its simulator has it."""
    backend: Backend = "mujoco"
    """What stepped the env in training."""
    seed: Long
    env_steps: Long
    """Env steps that the whole training is to have."""
    actor: Parts
    """Weights for `NetworkPolicy`."""
    state: ByName
    """State of the agent."""
    position: Position
    versions: dict[str, str] = field(default_factory=software_versions)

    @property
    def env_id(self) -> str:
        """Id of the env."""
        return self.spec.env_id

    @property
    def num_envs(self) -> int:
        """Drones that it trains with; 0 of a policy alone."""
        return len(self.position.flown.numbers) if self.position.flown else 0

    @property
    def hyperparameters(self) -> Config:
        """Those of `config`. Raises `InputError` for wrong ones."""
        return preset(self.algorithm, "tuned", **self.config)

    def policy_alone(self) -> "Checkpoint":
        """Without the state and the position, which only a training needs."""
        position = replace(self.position, flown=None, episodes=())
        return replace(self, state={}, position=position)

    def check_resumable(self) -> None:
        """Raises `ResumeError` for a policy alone."""
        if not self.num_envs:
            raise ResumeError("resume: expected the checkpoint of a training, got a policy alone")

    def policy(self, spec: EnvSpec | None = None) -> NetworkPolicy:
        """The policy, ready to fly that env or its own. Raises `InputError` if it does not fit."""
        if spec:
            _check_meaning(self.spec, spec)
        return NetworkPolicy.load(self.actor, spec or self.spec, self.hyperparameters)


def _check_meaning(own: EnvSpec, other: EnvSpec) -> None:
    """Raise `InputError` where numbers of the same shape mean something else in another env."""
    pairs = [*zip(own.observation, other.observation, strict=False), (own.action, other.action)]
    for ours, theirs in pairs:
        if getattr(ours, "shape", ()) != getattr(theirs, "shape", ()):
            continue  # the weights do not fit, which is refused later
        for what in ("frame", "components"):
            expected, got = (getattr(one, what, "") for one in (ours, theirs))
            if expected and got and expected != got:
                raise InputError(
                    f"policy: expected {ours.name} with the {what} {shortened(expected)}, on which "
                    f"it was trained, got {shortened(got)}"
                )


def store(checkpoint: Checkpoint, path: Path) -> None:
    """Write a checkpoint: after a crash at any moment, `path` holds the old one or the new one.

    Raises `CheckpointError` where a number is not finite: training diverged. The old file stays.
    """
    where = checkpoint.position
    arrays = named("policy/", checkpoint.actor)
    if where.flown:
        arrays |= named("state/", checkpoint.state)
        arrays |= named("position/", where.flown._asdict())
        for name, dtype in _COLUMNS.items():
            column = [getattr(episode, name) for episode in where.episodes]
            arrays[f"episodes/{name}"] = np.array(column, dtype)
    for name in _not_finite(arrays):
        raise CheckpointError(f"checkpoint: training diverged, {name} is not finite")
    arrays = {name: np.array(array, order="C") for name, array in arrays.items()}
    meta = {
        "format": FORMAT,
        **{name: getattr(checkpoint, name) for name in _PLAIN},
        "spec": checkpoint.spec.to_json(),
        "env": checkpoint.env.to_dict() if checkpoint.env else None,
        "position": {"env_steps": where.env_steps, "seconds": where.seconds},
    }
    numpy = require("safetensors.numpy", "train", "writing checkpoints")
    text = {"rotorgram": json.dumps(meta), "sha256": "0" * 64}
    data: bytes = numpy.save(arrays, metadata=text)
    write_whole(path, _with_checksum(data, hashlib.sha256(data).hexdigest().encode()))


def load(path: Path) -> Checkpoint:
    """Read a checkpoint. Raises `CheckpointError`, `MissingPackage`, or `OSError`: unreadable."""
    numpy = require("safetensors.numpy", "train", "reading checkpoints")
    from safetensors import SafetensorError

    if not path.is_file():
        raise CheckpointError(f"checkpoint: expected a file, got {path}, where there is none")
    try:
        return _read(path.read_bytes(), numpy.load)
    except InputError as error:
        raise CheckpointError(f"{path}: {error}") from None
    except (  # what reading a crafted file can raise
        SafetensorError,
        LookupError,
        TypeError,
        ValueError,
        AttributeError,
        RecursionError,
    ) as error:
        raise CheckpointError(
            f"{path}: expected a rotorgram checkpoint, got one with a wrong part "
            f"({one_line(error):.200})"
        ) from None


def _read(data: bytes, parse: Callable[[bytes], ByName]) -> Checkpoint:
    found = _CHECKSUM.search(data)
    checksum = hashlib.sha256(_with_checksum(data, b"0" * 64)).hexdigest().encode()
    if found is None or found[1] != checksum:
        raise InputError("expected a rotorgram checkpoint, got another file or a damaged one")
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])
    content = json.loads(header["__metadata__"]["rotorgram"])
    if content["format"] != FORMAT:
        raise InputError(
            f"expected a checkpoint of format {FORMAT}, got {shortened(content['format'])}"
        )
    spec = EnvSpec.from_json(content["spec"])
    env = EnvConfig.from_dict(content["env"]) if content["env"] else None
    arrays = parse(data)
    for name in _not_finite(arrays):
        raise InputError(f"expected finite numbers, got NaN or infinity in {name}")
    position = Position(**content["position"])
    check_fields(position, "position.")
    columns = part_of(arrays, "episodes/")
    if columns:  # a training, and no policy alone
        rows = zip(*(columns[name].tolist() for name in _COLUMNS), strict=True)
        flown = Flown(**part_of(arrays, "position/"))
        position = replace(position, episodes=tuple(starmap(Episode, rows)), flown=flown)
    checkpoint = Checkpoint(
        spec=spec,
        env=env,
        actor=part_of(arrays, "policy/"),
        state=part_of(arrays, "state/"),
        position=position,
        **{name: content[name] for name in _PLAIN},
    )
    check_fields(checkpoint)
    mapping(checkpoint.versions, "versions", "values by name")
    needed = vars(checkpoint.hyperparameters)
    if needed.keys() != checkpoint.config.keys():
        raise InputError(
            f"config: expected all of {', '.join(needed)}, got {shortened(checkpoint.config)}"
        )
    checkpoint.policy()  # raises if it does not fit
    return checkpoint


def _with_checksum(data: bytes, checksum: bytes) -> bytes:
    return _CHECKSUM.sub(b'"sha256":"%s"' % checksum, data, count=1)


def _not_finite(arrays: ByName) -> Iterator[str]:
    """Names of arrays that hold NaN or infinity."""
    for name, array in arrays.items():
        # Without metrics the error of an episode is NaN, which is no divergence.
        if name != "episodes/mean_size" and not np.isfinite(array).all():
            yield name

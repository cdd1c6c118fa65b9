"""What the commands make of their flags: addresses, policies, envs, folders."""

import json
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict, fields
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from ..envs import ElevationConfig

if TYPE_CHECKING:
    from ..agents.policies import Policy
    from ..udp import Address, RemoteEnv, RemoteVectorEnv
    from .base import AgentCommand

__all__ = [
    "CHECKPOINT",
    "load_policy",
    "new_folder",
    "parse_address",
    "parse_changes",
    "refuse_settings",
    "remote_env",
]

CHECKPOINT: Final = "checkpoint.safetensors"
_PATIENCE: Final = 30 * 24 * 3600.0  # s: who waits for a simulator is told to press Ctrl-C


def parse_address(text: str) -> "Address":
    """HOST:PORT as a pair. Raises `ValueError`."""
    host, _, port = text.rpartition(":")
    if not (host and port.isascii() and port.isdecimal() and int(port) <= 65535):
        raise ValueError(f"address: expected HOST:PORT with a port up to 65535, got {text!r}")
    return host, int(port)


def parse_changes(changes: Iterable[str]) -> dict[str, Any]:
    """`name=value` pairs of hyperparameters. Raises `ValueError`."""
    result = {}
    for change in changes:
        name, equals, value = change.partition("=")
        if not equals:
            raise ValueError(f"set: expected NAME=VALUE, got {change!r}")
        try:
            result[name] = json.loads(value.lower() if value in ("True", "False") else value)
        except json.JSONDecodeError:
            result[name] = value
    return result


def load_policy(name: str, env: ElevationConfig) -> "tuple[Policy, ElevationConfig]":
    """A policy by its checkpoint, its training's folder, or as `pid`; and the env that it flies.

    With a checkpoint, options that are not the default replace those that it was trained with.
    """
    if name == "pid":
        from ..agents.pid import PID

        return PID(env), env
    from ..agents.checkpoints import load

    path = Path(name)
    file = path / CHECKPOINT if path.is_dir() else path
    if not file.is_file():
        inside = f": look into {path / 'checkpoints'}" if (path / "checkpoints").is_dir() else ""
        raise ValueError(
            f"policy: expected pid, a checkpoint or the folder of a training, got {name}, where "
            f"there is no file {file}{inside}"
        )
    checkpoint = load(file)
    plain = asdict(ElevationConfig())
    changed = {k: v for k, v in asdict(env).items() if v != plain[k]}
    env = ElevationConfig.from_options({**checkpoint.env, **changed})
    policy, size = checkpoint.policy(), 3 if env.observation == "full" else 1
    if policy.observation_size != size:
        raise ValueError(
            f"{name}: expected a policy for {size} observations (--env.observation "
            f"{env.observation}), got one for {policy.observation_size}"
        )
    return policy, env


@contextmanager
def remote_env(
    config: ElevationConfig, command: "AgentCommand", num_envs: int = 1, num_simulators: int = 1
) -> "Iterator[Any]":
    """A remote env with a simulator of its own, or those that come to `command.listen`.

    One drone is a `RemoteEnv`, more are a `RemoteVectorEnv` without autoreset. At the end it tells
    what the wire was like.
    """
    if num_simulators > 1 and command.listen is None:
        raise ValueError(f"num-simulators: expected 1 without --listen, got {num_simulators}")
    with _connected(config, command, num_envs, num_simulators) as env:
        try:
            yield env
        finally:
            print(f"wire: {env.statistics}", flush=True)


@contextmanager
def _connected(
    config: ElevationConfig, command: "AgentCommand", num_envs: int, num_simulators: int
) -> "Iterator[RemoteEnv | RemoteVectorEnv]":
    if command.listen is None:
        from ..experiments.pairs import socket_pair

        if command.key_file or command.insecure:
            raise ValueError(
                "key-file, insecure: expected them with --listen, got them for a simulator of "
                "our own on this machine"
            )
        with socket_pair(config, num_envs=num_envs, record=command.record) as env:
            yield env
        return
    from ..udp import RemoteEnv, RemoteVectorEnv

    address = parse_address(command.listen)
    settings: dict[str, Any] = {
        "options": asdict(config),
        "connect": False,
        "connect_timeout": _PATIENCE,
        "key_file": command.key_file,
        "insecure": command.insecure,
        "record": command.record,
    }
    remote: RemoteEnv | RemoteVectorEnv
    if num_envs == num_simulators == 1:
        remote = RemoteEnv(address, **settings)
    else:
        remote = RemoteVectorEnv(
            address,
            num_envs=num_envs,
            num_simulators=num_simulators,
            autoreset_mode="Disabled",
            **settings,
        )
    with closing(remote):
        who = "a simulator" if num_simulators == 1 else f"{num_simulators} simulators"
        share = f" of {num_envs // num_simulators} drones" if num_envs > num_simulators else ""
        print(f"waiting for {who}{share} at {'{}:{}'.format(*remote.address)} (Ctrl-C ends)",
              flush=True)  # fmt: skip
        remote.connect()
        yield remote


def refuse_settings(command: Any, folder: Path, *, free: tuple[str, ...]) -> None:
    """Whoever resumes keeps the settings: `ValueError` if any field but the free ones was set."""
    plain = type(command)(**{name: getattr(command, name) for name in free})
    names = [f.name for f in fields(command)]
    if changed := [n for n in names if getattr(command, n) != getattr(plain, n)]:
        flags = ", ".join("--" + n.replace("_", "-") for n in changed)
        raise ValueError(f"resume: expected the settings of {folder}, got others by {flags}")


def new_folder(out: Path | None, name: str) -> Path:
    """The folder to write to; by default one named by the time."""
    folder = out or Path("runs") / f"{name}-{datetime.now():%Y%m%d-%H%M%S}"
    if folder.exists():
        raise ValueError(f"out: {folder} is there already; choose another folder")
    return folder

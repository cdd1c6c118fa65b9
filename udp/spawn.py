"""A remote env here, and its simulator in a process of its own."""

import atexit
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

from ..envs import registry
from ..envs.config import EnvConfig
from ..models import InputError
from .protocol.client import Address
from .protocol.errors import PeerClosed, PeerSilent
from .remote import RemoteEnv, RemoteVectorEnv
from .transport.agent import AgentSettings

Remote = RemoteEnv | RemoteVectorEnv
_COMMAND = (sys.executable, "-P", "-m", "rotorgram.udp")
_ANY = ("127.0.0.1", 0)
_START_TIMEOUT = 60.0
_ANSWER_TIMEOUT = 10.0
_STOP_TIMEOUT = 5.0
_POLL = 0.5


@contextmanager
def spawn_simulator(
    config: EnvConfig, *, num_envs: int | None = None, record: Path | None = None
) -> Iterator[Any]:
    """A connected remote env, on free ports of the loopback interface.

    The simulator ends with this process, however this one ends.

    Args:
        config: What is flown.
        num_envs: Drones of a `RemoteVectorEnv` without autoreset. None: those of one world, and a
            `RemoteEnv` for a single drone.
        record: MCAP file of the agent's journal.

    Raises:
        PeerClosed: The simulator did not start, or ended: its own sentence, or its last words.
        PeerSilent: The simulator runs and does not answer.
    """
    config = _importable(config)  # before a record is begun
    count = config.drones if num_envs is None else num_envs
    told = config.resolve() if config.has_rays else config  # with settings of the vehicle's file
    settings: AgentSettings = {
        "env_id": config.env_id,
        "options": told.flat_options(),
        "connect_timeout": _POLL,
        "timeout": _ANSWER_TIMEOUT,
        "record": record,
    }
    env: Remote
    if num_envs is None and count == 1:
        env = RemoteEnv(_ANY, connect=False, **settings)
    else:
        env = RemoteVectorEnv(
            _ANY, num_envs=count, autoreset_mode="Disabled", connect=False, **settings
        )
    with TemporaryFile("w+") as said:
        process = start_simulator(config, env.address, said, num_envs=count)
        try:
            _connect(env, process)
            yield env
        except PeerSilent as error:
            if process.poll() is None:
                raise
            said.seek(0)
            words = said.read().strip() or "it said nothing"
            _, own, sentence = words.rpartition("rotorgram simulator: ")
            if not own:
                sentence = f"the simulator ended with status {process.returncode}: {words}"
            raise PeerClosed(sentence) from error
        finally:
            env.close()
            try:
                process.communicate(timeout=_STOP_TIMEOUT)  # closes its standard input
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def start_simulator(
    config: EnvConfig, server: Address, stderr: IO[str] | None = None, **settings: object
) -> subprocess.Popen[bytes]:
    """A simulator in a process of its own, on a free port; it ends when its stdin is closed.

    `settings` are keyword arguments of `Simulator`.
    """
    config = _importable(config)
    # A second thread of torch makes small tensors slower, and takes the agent's core.
    around = {"OMP_NUM_THREADS": "1", **os.environ, "PYTHONSAFEPATH": "1"}
    # In a group of its own: a signal to ours is for the agent, which closes the exchange.
    process = subprocess.Popen(
        _COMMAND, stdin=subprocess.PIPE, stderr=stderr, env=around, process_group=0
    )
    arguments = {
        "config": config.to_dict(),
        "module": config.module,
        "server": server,
        "bind": _ANY,
        **settings,
    }
    assert process.stdin is not None
    with suppress(BrokenPipeError):  # it has ended: its exit status says so
        process.stdin.write(json.dumps(arguments).encode() + b"\n")
        process.stdin.flush()
    return process


def _importable(config: EnvConfig) -> EnvConfig:
    """The config with the content of its files. Raises `InputError` for a task that is not known
    here, or that the simulator's process cannot import.
    """
    if registry.task_type(config.env_id).__module__ == "__main__":
        raise InputError(
            "env: expected a task of a module, for the simulator's process to import, got "
            f"{config.env_id} of this program"
        )
    return config.embedded()


def _connect(env: Remote, process: subprocess.Popen[bytes]) -> None:
    """Wait for the simulator, as long as its process runs."""
    deadline = time.monotonic() + _START_TIMEOUT
    while True:
        try:
            return env.connect()
        except PeerSilent as error:
            if process.poll() is not None:
                raise
            if time.monotonic() > deadline:
                raise PeerSilent(
                    f"the simulator runs, and did not connect in {_START_TIMEOUT:g} s"
                ) from error


_cached: dict[tuple[EnvConfig, int | None], Remote] = {}
_open = ExitStack()
atexit.register(_open.close)


@contextmanager
def cached_simulator(config: EnvConfig, *, num_envs: int | None = None) -> Iterator[Any]:
    """As `spawn_simulator`, but the simulator stays open for the next use in this process.

    To start one takes as long as a short training. All are closed with the process, or if a block
    fails.
    """
    key = config, num_envs
    if key not in _cached:
        _cached[key] = _open.enter_context(spawn_simulator(config, num_envs=num_envs))
    try:
        yield _cached[key]
    except BaseException:
        _cached.clear()
        _open.close()
        raise

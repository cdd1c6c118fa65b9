"""A socket pair: an agent's remote env here and a simulator in a process of its own."""

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, Final

from ..envs import ElevationConfig
from ..udp import PeerClosed, PeerSilent, RemoteEnv, RemoteVectorEnv

__all__ = ["socket_pair"]

_START_TIMEOUT: Final = 60.0
_ANSWER_TIMEOUT: Final = 10.0
_STOP_TIMEOUT: Final = 5.0
_POLL: Final = 0.5


@contextmanager
def socket_pair(
    config: ElevationConfig, *, num_envs: int = 1, record: Path | None = None
) -> Iterator[Any]:
    """A connected remote env, on free ports of the loopback interface.

    The simulator ends with this process, however this one ends.

    Args:
        config: Options of the env.
        num_envs: Drones: one makes a `RemoteEnv`, more a `RemoteVectorEnv` without autoreset.
        record: MCAP file for the agent's journal.

    Raises:
        PeerClosed: The simulator did not start, or ended; the sentence holds what it said.
        PeerSilent: The simulator runs and does not answer.
    """
    options = asdict(config)
    settings: dict[str, Any] = {
        "options": options,
        "connect": False,
        "connect_timeout": _POLL,
        "timeout": _ANSWER_TIMEOUT,
        "record": record,
    }
    here = ("127.0.0.1", 0)
    env: RemoteEnv | RemoteVectorEnv
    if num_envs == 1:
        env = RemoteEnv(here, **settings)
    else:
        env = RemoteVectorEnv(here, num_envs=num_envs, autoreset_mode="Disabled", **settings)
    arguments = {"server": env.address, "bind": here, "num_envs": num_envs, **options}
    command = [sys.executable, "-m", "rotorgram.udp", json.dumps(arguments)]
    with TemporaryFile("w+") as said:
        process = subprocess.Popen(
            [*command, "--until-stdin-closes"], stdin=subprocess.PIPE, stderr=said
        )
        try:
            _connect(env, process)
            yield env
        except PeerSilent as error:
            if process.poll() is None:
                raise
            said.seek(0)
            words = said.read().strip() or "it said nothing"
            status = process.returncode
            raise PeerClosed(f"the simulator ended with status {status}: {words}") from error
        finally:
            env.close()
            _end(process)


def _connect(env: RemoteEnv | RemoteVectorEnv, process: subprocess.Popen[bytes]) -> None:
    """Wait for the simulator, as long as it lives."""
    deadline = time.monotonic() + _START_TIMEOUT
    while True:
        try:
            return env.connect()
        except PeerSilent:
            if process.poll() is not None or time.monotonic() > deadline:
                raise


def _end(process: subprocess.Popen[bytes]) -> None:
    """It was told to end; close the way back and take its exit status."""
    assert process.stdin is not None
    process.stdin.close()
    try:
        process.wait(_STOP_TIMEOUT)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()

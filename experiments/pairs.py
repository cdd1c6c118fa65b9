"""A socket pair: an agent's `RemoteEnv` here and a simulator in a process of its own."""

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from typing import Final

from ..envs import ElevationConfig
from ..udp import PeerSilent, RemoteEnv

__all__ = ["socket_pair"]

_START_TIMEOUT: Final = 60.0
_STOP_TIMEOUT: Final = 5.0
_POLL: Final = 0.5


@contextmanager
def socket_pair(config: ElevationConfig, codec: str = "binary") -> Iterator[RemoteEnv]:
    """A connected remote env, on free ports of the loopback interface.

    Raises:
        PeerSilent: The simulator did not come; the sentence holds what it said.
    """
    options = asdict(config)
    env = RemoteEnv(("127.0.0.1", 0), options=options, connect=False, connect_timeout=_POLL)
    arguments = {
        "server": env.address,
        "bind": ("127.0.0.1", 0),
        "codec": codec,
        **options,
    }
    process = subprocess.Popen(
        [sys.executable, "-m", "rotorgram.udp", json.dumps(arguments)],
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        _connect(env, process)
        yield env
    finally:
        env.close()
        try:
            process.wait(_STOP_TIMEOUT)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        assert process.stderr is not None
        process.stderr.close()


def _connect(env: RemoteEnv, process: subprocess.Popen[str]) -> None:
    """Wait for the simulator, as long as it lives."""
    deadline = time.monotonic() + _START_TIMEOUT
    while True:
        try:
            return env.connect()
        except PeerSilent:
            if process.poll() is not None or time.monotonic() > deadline:
                process.kill()
                said = process.communicate()[1].strip()
                raise PeerSilent(f"the simulator did not start: {said or 'no message'}") from None

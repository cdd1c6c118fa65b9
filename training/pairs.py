"""A socket pair: an agent's remote env here and a simulator in a process of its own."""

import atexit
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, Final

from ..models import Backend
from ..udp import PeerClosed, PeerSilent, RemoteEnv, RemoteVectorEnv
from .settings import EnvConfig

_START_TIMEOUT: Final = 60.0
_ANSWER_TIMEOUT: Final = 10.0
_STOP_TIMEOUT: Final = 5.0
_POLL: Final = 0.5


@contextmanager
def socket_pair(
    env_id: str = "rotorgram/Elevation-v0",
    options: Mapping[str, Any] | None = None,
    *,
    num_envs: int = 1,
    drones: int = 1,
    vehicle: str | Path | None = None,
    backend: Backend = "mujoco",
    record: Path | None = None,
) -> Iterator[Any]:
    """A connected remote env, on free ports of the loopback interface: of a task that is registered
    here, with a vehicle by file or name, or the paper's, on a backend. One drone makes a
    `RemoteEnv`, more make a `RemoteVectorEnv` without autoreset, with so many `drones` to a world.
    `record` is the MCAP file of the agent's journal.

    The simulator ends with this process, however this one ends.

    Raises:
        PeerClosed: The simulator did not start, or ended: its own sentence, or its last words.
        PeerSilent: The simulator runs and does not answer.
    """
    file = None if vehicle is None else str(vehicle)
    config = EnvConfig(
        env_id=env_id, options=options or {}, vehicle=file, backend=backend, drones=drones
    )
    settings: dict[str, Any] = {
        "env_id": env_id, "options": config.options, "connect": False, "connect_timeout": _POLL,
        "timeout": _ANSWER_TIMEOUT, "record": record,
    }  # fmt: skip
    here = ("127.0.0.1", 0)
    env: RemoteEnv | RemoteVectorEnv
    if num_envs == 1:
        env = RemoteEnv(here, **settings)
    else:
        env = RemoteVectorEnv(here, num_envs=num_envs, autoreset_mode="Disabled", **settings)
    arguments = {"server": env.address, "bind": here, "num_envs": num_envs, "env": env_id}
    arguments |= {"drones": drones} if drones > 1 else {}
    arguments |= {"vehicle": file, "backend": backend, "options": config.options}
    arguments |= {"module": config.module} if config.module else {}
    # -P: no folder of the working directory stands for the package.
    command = [sys.executable, "-P", "-m", "rotorgram.udp", json.dumps(arguments)]
    with TemporaryFile("w+") as said:
        # A second thread of torch makes small tensors slower, and takes the agent's core.
        around = {"OMP_NUM_THREADS": "1", **os.environ}
        process = subprocess.Popen(
            [*command, "--until-stdin-closes"], stdin=subprocess.PIPE, stderr=said, env=around
        )
        try:
            _connect(env, process)
            yield env
        except PeerSilent as error:
            if process.poll() is None:
                raise
            said.seek(0)
            words = said.read().strip() or "it said nothing"
            _, own, sentence = words.rpartition("rotorgram simulator: ")
            ended = f"the simulator ended with status {process.returncode}: "
            raise PeerClosed(sentence if own else ended + words) from error
        finally:
            env.close()
            try:
                process.communicate(timeout=_STOP_TIMEOUT)  # closes its standard input
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _connect(env: RemoteEnv | RemoteVectorEnv, process: subprocess.Popen[bytes]) -> None:
    """Wait for the simulator, as long as it lives."""
    deadline = time.monotonic() + _START_TIMEOUT
    while True:
        try:
            return env.connect()
        except PeerSilent as error:
            if process.poll() is not None:
                raise
            if time.monotonic() > deadline:
                said = f"the simulator runs, and did not connect in {_START_TIMEOUT:g} s"
                raise PeerSilent(said) from error


_shared: dict[str, tuple[Any, ExitStack]] = {}


@contextmanager
def shared_pair(**settings: Any) -> Iterator[Any]:
    """As `socket_pair` by keyword, but the pair stays open for the next run of this process.

    To start a simulator takes as long as a short training. A pair whose block fails is closed, the
    others by `close_shared_pairs`, or with the process.
    """
    key = json.dumps(settings, sort_keys=True)
    if key not in _shared:
        stack = ExitStack()
        _shared[key] = stack.enter_context(socket_pair(**settings)), stack
    env, stack = _shared[key]
    try:
        yield env
    except BaseException:
        _shared.pop(key)[1].close()
        raise


@atexit.register
def close_shared_pairs() -> None:
    """Close what `shared_pair` left open."""
    while _shared:
        _shared.popitem()[1][1].close()

"""Simulator processes, which may begin before it is known what they fly."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from tempfile import TemporaryFile
from typing import IO

# -P: no file of the working directory takes the place of a package.
_COMMAND = (sys.executable, "-P", "-m", "rotorgram.udp")

Started = tuple[subprocess.Popen[bytes], IO[str]]
"""A process that waits for its first line, and what it says on standard error."""

_waiting: list[Started] = []


def begin(stderr: IO[str] | None = None) -> subprocess.Popen[bytes]:
    """A process that waits for the first line of its standard input, and ends with that."""
    # A second thread of torch makes small tensors slower, and takes the agent's core.
    around = {"OMP_NUM_THREADS": "1", **os.environ, "PYTHONSAFEPATH": "1"}
    # In a group of its own: a signal to ours is for the agent, which closes the exchange.
    return subprocess.Popen(
        _COMMAND, stdin=subprocess.PIPE, stderr=stderr, env=around, process_group=0
    )


@contextmanager
def begun_early() -> Iterator[None]:
    """Within it a process waits that `started` gives: its imports run beside ours."""
    _waiting.append(started())
    try:
        yield
    finally:
        while _waiting:  # no simulator was made of it
            process, said = _waiting.pop()
            process.kill()
            process.communicate()
            said.close()


def started() -> Started:
    """One that began early, or a new one."""
    if _waiting:
        return _waiting.pop()
    said = TemporaryFile("w+")  # noqa: SIM115  closed by the caller
    return begin(said), said

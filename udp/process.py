"""Simulator processes, which may begin before it is known what they fly."""

import atexit
import os
import subprocess
import sys
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
    return subprocess.Popen(_COMMAND, stdin=subprocess.PIPE, stderr=stderr, env=around)


def begin_early() -> None:
    """Begin one that `started` gives: its imports, a third of a second, run beside ours."""
    _waiting.append(started())
    atexit.register(_end)


def _end() -> None:
    """End what no simulator was made of."""
    while _waiting:
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

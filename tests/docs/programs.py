"""Programs that the tests of pages run, and ports of their own."""

import subprocess
import sys
from pathlib import Path

from peers import plain_socket

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"


def rotorgram(*arguments: object) -> list[str]:
    """The command of a program of ours."""
    return [sys.executable, "-m", "rotorgram.cli", *map(str, arguments)]


def run(command: list[str], folder: Path) -> str:
    """What a program prints that has to succeed."""
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=110)
    assert done.returncode == 0, done.stderr
    return done.stdout


def free_port() -> int:
    with plain_socket() as sock:
        return int(sock.getsockname()[1])

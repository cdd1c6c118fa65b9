"""`rotorgram` in this process and in a process of its own, and words that it refuses."""

import shlex
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest
from rotorgram.cli import main

WRONG = tomllib.loads((Path(__file__).parent / "data" / "wrong_words.toml").read_text("utf-8"))
"""Pairs of wrong words and a part of the sentence that refuses them, by what they are."""

Capsys = pytest.CaptureFixture[str]
Process = subprocess.Popen[str]
started: list[Process] = []
"""What `start` has started."""


def write_program(path: Path, text: str) -> None:
    """A program of Python's, which runs in folders with spaces in their names too."""
    script = path.with_suffix(".py")
    script.write_text(text)
    path.write_text(f'#!/bin/sh\nexec "{sys.executable}" "{script}" "$@"\n')
    path.chmod(0o755)


def run(capsys: Capsys, *arguments: object) -> tuple[int, str, str]:
    """Exit status, standard output and standard error of a command."""
    try:
        status = main(list(map(str, arguments)))
    except SystemExit as end:
        status = int(end.code or 0)
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def output(capsys: Capsys, *arguments: object) -> str:
    """Standard output of a command that ends well."""
    status, out, err = run(capsys, *arguments)
    assert status == 0, err
    return out


def refused(capsys: Capsys, *arguments: object, status: int = 1, silent: bool = False) -> str:
    """The one sentence with which a command ends, `silent`: before it says anything else."""
    ended, out, err = run(capsys, *arguments)
    assert ended == status
    assert not (silent and out)
    assert err.startswith("rotorgram: ")
    assert err.count("\n") == 1
    return err


def words_of(line: str) -> list[str]:
    """Words of a line of a shell."""
    return shlex.split(line)


def start(*arguments: object) -> Process:
    """A command in a process of its own, in a terminal's process group of its own."""
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", "rotorgram.cli", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    started.append(process)
    return process


def wait_until(condition: Callable[[], object], process: Process, seconds: float = 60) -> None:
    """Wait for something that a process does."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)

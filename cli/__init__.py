"""The command `rotorgram`: one module for each command, imported when it is chosen.

Exit statuses: 0 done; 1 an error of the user, the other side or the system, in one sentence, or a
check that failed; 2 a wrong flag, no OpenGL for a command that draws, or a file to examine that is
no vehicle; 130 Ctrl-C; 141 standard output is closed; 143 SIGTERM. A bug of ours keeps its
traceback.
"""

import atexit
import gc
import io
import logging
import os
import re
import signal
import sys
from collections.abc import Sequence
from errno import ENOSPC, EPIPE
from importlib import import_module
from pathlib import Path
from shutil import get_terminal_size
from typing import TYPE_CHECKING, TypeGuard

from ..models.errors import printable
from ..models.files import read_own_toml

if TYPE_CHECKING:
    from ._flags import Command

_NAMES = read_own_toml(__file__, "commands")
COMMANDS: tuple[str, ...] = tuple(_NAMES["commands"])
"""Each is a class in the module of its name: `Sim` in `sim`, `CheckTask` in `check_task`."""

EXTRAS: dict[str, list[str]] = _NAMES["extras"]
"""Import names of the packages of each extra, as pyproject.toml lists them."""

_ABOUT = "A MuJoCo drone simulator that reinforcement-learning agents fly, in process or over UDP."


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; its exit status.

    An error of the user or the other side is one sentence on standard error. If ROTORGRAM_TRACEBACK
    is set, its traceback is printed instead.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    _prepare_streams()
    _show_log()
    # A terminated command says Close to the other side before it ends.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)
    # A second thread of NumPy's products loses on small networks, and takes the simulator's core.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Imports make many objects and no garbage: to look for it takes a tenth of a short command.
    gc.set_threshold(50_000)
    # At exit Python collects garbage: with torch half a second for nothing.
    atexit.register(gc.freeze)
    try:
        status = _run(words)
        sys.stdout.flush()
    except KeyboardInterrupt:
        print("rotorgram: interrupted", file=sys.stderr)
        return 128 + signal.SIGINT
    except Exception as error:
        if _is_of_stdout(error):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what is left
            if isinstance(error, BrokenPipeError):
                return 128 + signal.SIGPIPE
            error.filename = "standard output"
        sentence = _sentence(error)
        if sentence is None or "ROTORGRAM_TRACEBACK" in os.environ:
            raise
        print(f"rotorgram: {printable(sentence)}", file=sys.stderr)
        return getattr(error, "exit_status", 1)
    return status


class _Interrupted(KeyboardInterrupt):
    """Ctrl-C. After `KeyboardInterrupt` itself has ended an `exec`, which makes dataclasses,
    `python -m` ends by the signal, and the exit status of `main` is lost.
    """


def _interrupt(*_: object) -> None:
    raise _Interrupted


def _run(words: list[str]) -> int:
    name = words[0] if words else ""
    if name in ("", "-h", "--help"):
        print(_help(), file=sys.stdout if name else sys.stderr)
        return 0 if name else 2
    if name == "--version":
        from importlib.metadata import version

        print(f"rotorgram {version('rotorgram')}")
        return 0
    if name not in COMMANDS:
        print(
            f"rotorgram: expected a command of {', '.join(COMMANDS)}, got {name}", file=sys.stderr
        )
        return 2
    from ..rendering.gl import hidden_gl_setting
    from ._parser import parse

    if get_terminal_size().columns < 40:  # tyro does not end on narrower terminals
        os.environ["COLUMNS"] = "40"
    # Importing OpenGL takes time, also for a command that draws nothing.
    with hidden_gl_setting():
        module = import_module(f".{name.replace('-', '_')}", __name__)
        kind: type[Command] = getattr(module, _class_of(name))
        return parse(kind, f"rotorgram {name}", words[1:]).run() or 0


def _class_of(name: str) -> str:
    return name.title().replace("-", "")


def _help() -> str:
    lines = ["usage: rotorgram [-h] [--version] COMMAND ...", "", _ABOUT, "", "commands:"]
    for name in COMMANDS:
        file = Path(__file__).with_name(f"{name.replace('-', '_')}.py")
        text = file.read_text("utf-8")  # for speed, not imported
        summary = re.search(rf'class {_class_of(name)}\(.*\n    """([^"\n]*)', text)
        assert summary
        lines.append(f"  {name:12} {summary[1]}")
    return "\n".join([*lines, "", "rotorgram COMMAND --help lists the flags of a command."])


def _prepare_streams() -> None:
    """Printing shows each line at once, and never fails for a stream that is closed or knows ASCII
    alone."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115  for as long as we run
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace", line_buffering=True)


def _is_of_stdout(error: Exception) -> TypeGuard[OSError]:
    """Whether standard output takes no more: its reader is gone, or its disk is full."""
    if not isinstance(error, OSError) or error.filename or error.errno not in (EPIPE, ENOSPC):
        return False
    try:
        os.write(sys.stdout.fileno(), b"\n")
    except io.UnsupportedOperation:  # it is no file
        return False
    except OSError:
        return True
    return False


class _ToStandardError(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        print(f"rotorgram: {printable(record.getMessage())}", file=sys.stderr, flush=True)


def _show_log() -> None:
    """Our own log goes to standard error, in lines like our other sentences."""
    log = logging.getLogger("rotorgram")
    log.setLevel(logging.INFO)
    log.handlers = [_ToStandardError()]


def _sentence(error: Exception) -> str | None:
    """Sentence for the user; None for a bug of ours. Our own classes of errors are sentences."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    if isinstance(error, OSError) or type(error).__module__.startswith("rotorgram."):
        return str(error)
    if isinstance(error, ModuleNotFoundError) and error.name:
        top = error.name.partition(".")[0]
        for extra, modules in EXTRAS.items():
            if top in modules:
                return f"the package {top} is missing: pip install 'rotorgram[{extra}]'"
    return None

"""The command `rotorgram`."""

import atexit
import gc
import logging
import os
import signal
import sys
from collections.abc import Sequence

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; its exit status.

    What the user or the other side did wrong is one sentence on standard error, without traceback;
    with ROTORGRAM_TRACEBACK set, for whoever looks for a bug of ours, with it.
    """
    # To be terminated is no reason to leave the other side without a word.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    _show_log()
    # At the end Python looks through everything for garbage: with torch half a second for nothing.
    atexit.register(gc.freeze)
    try:
        import tyro

        from .commands import COMMANDS

        command = tyro.extras.subcommand_cli_from_dict(
            COMMANDS,
            prog="rotorgram",
            description="A MuJoCo quadcopter that reinforcement-learning agents fly over UDP.",
            args=arguments,
            config=(tyro.conf.FlagCreatePairsOff,),
        )
        return int(command.run())
    except KeyboardInterrupt:
        print("rotorgram: interrupted", file=sys.stderr)
        return 128 + signal.SIGINT
    except Exception as error:
        from .commands import user_errors

        if not isinstance(error, user_errors()) or "ROTORGRAM_TRACEBACK" in os.environ:
            raise
        print(f"rotorgram: {_sentence(error)}", file=sys.stderr)
        return getattr(error, "exit_status", 1)


class _ToStandardError(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        print(f"rotorgram: {record.getMessage()}", file=sys.stderr, flush=True)


def _show_log() -> None:
    """Our own log goes to standard error, in lines like our other sentences."""
    log = logging.getLogger("rotorgram")
    log.setLevel(logging.INFO)
    log.handlers = [_ToStandardError()]


def _sentence(error: Exception) -> str:
    if not (isinstance(error, OSError) and error.strerror):
        return str(error)
    return f"{error.filename}: {error.strerror}" if error.filename else error.strerror

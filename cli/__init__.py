"""The command `rotorgram`."""

import signal
import sys
from collections.abc import Sequence

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; its exit status.

    What the user or the other side did wrong is one sentence on standard error, without traceback.
    """
    import tyro

    from .commands import COMMANDS, user_errors

    # To be terminated is no reason to leave the other side without a word.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    command = tyro.extras.subcommand_cli_from_dict(
        COMMANDS,
        prog="rotorgram",
        description="A MuJoCo quadcopter that reinforcement-learning agents fly over UDP.",
        args=arguments,
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    try:
        return int(command.run())
    except KeyboardInterrupt:
        print("rotorgram: interrupted", file=sys.stderr)
        return 130
    except user_errors() as error:
        print(f"rotorgram: {error}", file=sys.stderr)
        return 1

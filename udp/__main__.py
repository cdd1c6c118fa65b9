"""A simulator process for programs: `python -m rotorgram.udp JSON [--until-stdin-closes]`.

The JSON object holds the keyword arguments of `Simulator`, but for `config`. With the flag it ends
with the program that holds its standard input, however that ends. People use `rotorgram sim`.
"""

import json
import os
import signal
import sys
from threading import Thread
from typing import Any, Final

from .errors import LinkError
from .simulator import Simulator

_KINDS: Final = {
    "server": (list, "[host, port]"),
    "bind": (list, "[host, port]"),
    "env": (str, "an id"),
    "insecure": (bool, "true or false"),
    "config": (type(None), "none"),
}
"""What JSON must hold by these names. The rest are checked as options of the env."""


def main() -> int:
    """Fly until the agent closes. Exit status 1 and one sentence if it fell silent."""
    # The agent closes the exchange; Ctrl-C in a terminal is meant for it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Ended by it Python tells nobody; as an exception it does.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    words = sys.argv[1:]
    if words[1:] == ["--until-stdin-closes"]:
        words.pop()
        Thread(target=_end_with_stdin, daemon=True).start()
    try:
        with Simulator(**parse_arguments(words)) as simulator:
            simulator.run()
    except (LinkError, OSError, ValueError) as error:
        print(f"rotorgram simulator: {error}", file=sys.stderr)
        return 1
    return 0


def _end_with_stdin() -> None:
    while os.read(0, 1024):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


def parse_arguments(words: list[str]) -> dict[str, Any]:
    """Keyword arguments of `Simulator` from those of the program. Raises `ValueError`."""
    if len(words) != 1:
        raise ValueError(f"expected one argument, a JSON object, got {len(words)}")
    try:
        arguments = json.loads(words[0])
    except (ValueError, RecursionError) as error:
        raise ValueError(f"expected a JSON object: {error}") from None
    if not isinstance(arguments, dict):
        raise ValueError(f"expected a JSON object, got {words[0][:80]}")
    for name, (kind, expected) in _KINDS.items():
        if name in arguments and not isinstance(arguments[name], kind):
            raise ValueError(f"{name}: expected {expected}, got {arguments[name]!r}")
    pairs = {name: tuple(arguments[name]) for name in ("server", "bind") if name in arguments}
    return arguments | pairs


if __name__ == "__main__":
    sys.exit(main())

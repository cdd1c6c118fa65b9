"""A simulator process for programs: `python -m rotorgram.udp JSON [--until-stdin-closes]`.

The JSON object holds the keyword arguments of `Simulator`, but for `config`: the options of the env
as `options`. `module`, which only our own command line gives, is imported first: it registers the
env of a user. An id is never imported: it may be one of a file. With the flag the process ends with
the program that holds its standard input, however that ends. People use `rotorgram sim`.
"""

import json
import os
import signal
import sys
from threading import Thread
from typing import Any, Final

from ..envs import registry
from ..envs.spec import canonical_id
from ..models.errors import InputError, MissingPackage, NoOpenGL, expect
from .protocol.client import LinkConfig
from .protocol.errors import LinkError
from .transport.simulator import Simulator

_FOR_EVER: Final = 30 * 86_400.0  # s
_KINDS: Final[dict[str, tuple[Any, str]]] = {
    "env": (str, "an id"),
    "module": (str, "the name of a module"),
    "options": (dict, "an object"),
    **dict.fromkeys(("num_envs", "drones"), (int, "a number")),
    **dict.fromkeys(("backend", "codec"), (str, "a name")),
    **dict.fromkeys(("server", "bind"), (list, "[host, port]")),
    **dict.fromkeys(("vehicle", "key_file", "record"), (str | None, "a path")),
    "insecure": (bool, "true or false"),
}


def main() -> int:
    """Fly until the agent closes. Exit status 1 and one sentence if it fell silent."""
    # The agent closes the exchange; Ctrl-C in a terminal is meant for it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    words = sys.argv[1:]
    ends_with_stdin = words[1:] == ["--until-stdin-closes"]
    try:
        arguments = parse_arguments(words[:1] if ends_with_stdin else words)
        if ends_with_stdin:  # an agent that is busy for long still holds it
            arguments["config"] = LinkConfig(timeout=_FOR_EVER)
        with Simulator(**arguments) as simulator:
            ended: list[int] = []

            def end(number: int, _: object) -> None:
                ended.append(number)
                simulator.stop()

            signal.signal(signal.SIGTERM, end)

            def stop_with_stdin() -> None:
                while os.read(0, 1024):
                    pass
                simulator.stop()

            if ends_with_stdin:
                Thread(target=stop_with_stdin, daemon=True).start()
            simulator.run()
            return 128 + ended[0] if ended else 0
    except (LinkError, OSError, InputError, MissingPackage, NoOpenGL) as error:
        print(f"rotorgram simulator: {error}", file=sys.stderr)
        return 1


def parse_arguments(words: list[str]) -> dict[str, Any]:
    """Keyword arguments of `Simulator` from those of the program. Raises `InputError`."""
    if len(words) != 1:
        raise InputError(f"expected one argument, a JSON object, got {len(words)}")
    try:
        arguments = json.loads(words[0])
    except (ValueError, RecursionError) as error:
        raise InputError(f"expected a JSON object: {error}") from None
    if not isinstance(arguments, dict):
        raise InputError(f"expected a JSON object, got {words[0][:80]}")
    for name, value in arguments.items():
        expect(name in _KINDS, name, f"one of {', '.join(_KINDS)}")
        kind, expected = _KINDS[name]
        expect(isinstance(value, kind), name, expected, f"{value!r}")
    if module := arguments.pop("module", None):
        registry.load(f"{module}:{canonical_id(arguments.get('env', ''))}")
    return {**arguments.pop("options", {}), **arguments}


if __name__ == "__main__":
    sys.exit(main())

"""A simulator process for programs: `python -P -m rotorgram.udp`; people use `rotorgram sim`.

Its first line of standard input is a JSON object: `config` as `EnvConfig.to_dict` gives it, and
keyword arguments of `Simulator`. `module`, which only our own command line gives, is imported
first: it registers the env of a user. An id is never imported: it may be one of a file. The process
ends with the program that holds its standard input, however that ends.
"""

import json
import os
import signal
import sys
from threading import Thread
from typing import Any

from ..envs import registry
from ..envs.config import EnvConfig
from ..models.drawn import remove_files
from ..models.errors import InputError, MissingPackage, NoOpenGL
from ..models.fields import mapping
from .protocol.client import LinkConfig
from .protocol.errors import LinkError
from .transport.simulator import Simulator

_FOR_EVER = 30 * 86_400.0
"""Seconds that an agent may be silent while it holds standard input."""


def main() -> int:
    """Fly until the agent closes. Exit status 1 and one sentence if it fell silent."""
    # The agent closes the exchange; Ctrl-C in a terminal is meant for it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        env, settings = read_arguments(sys.stdin.buffer.readline())
        with Simulator(env, config=LinkConfig(timeout=_FOR_EVER), **settings) as simulator:
            return _fly(simulator)
    except (LinkError, OSError, InputError, MissingPackage, NoOpenGL) as error:
        print(f"rotorgram simulator: {error}", file=sys.stderr)
        return 1


def _fly(simulator: Simulator) -> int:
    def stop_with_stdin() -> None:
        while os.read(0, 1024):
            pass
        simulator.stop()

    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    Thread(target=stop_with_stdin, daemon=True).start()
    simulator.run()
    return 0


def read_arguments(line: bytes) -> tuple[EnvConfig, dict[str, Any]]:
    """The config, and keyword arguments of `Simulator`. Raises `InputError`."""
    try:
        arguments = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise InputError(f"standard input: expected a JSON object: {error}") from None
    arguments = mapping(arguments, "standard input", "a JSON object")
    content = arguments.pop("config", None)
    if module := arguments.pop("module", None):
        registry.load(f"{module}:{dict(content or {}).get('env_id', '')}")
    return EnvConfig.from_dict(content), arguments


if __name__ == "__main__":
    status = main()
    remove_files()
    os._exit(status)  # all is closed; Python takes a tenth of a second to free what it has

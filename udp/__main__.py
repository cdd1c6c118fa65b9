"""A simulator process for programs: `python -m rotorgram.udp JSON`.

The JSON object holds the keyword arguments of `Simulator`. People use `rotorgram sim`.
"""

import json
import signal
import sys

from .errors import LinkError
from .simulator import Simulator


def main() -> int:
    """Fly until the agent closes. Exit status 1 and one sentence if it fell silent."""
    # The agent closes the exchange; Ctrl-C in a terminal is meant for it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    arguments = json.loads(sys.argv[1])
    for name in ("server", "bind"):
        arguments[name] = tuple(arguments[name])
    try:
        with Simulator(**arguments) as simulator:
            simulator.run()
    except (LinkError, OSError, ValueError) as error:
        print(f"rotorgram simulator: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Peers for the tests of the wire: simulators in threads and processes."""

import json
import socket
import subprocess
import sys
import textwrap
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rotorgram.envs.loop import Loop
from rotorgram.udp import LinkConfig, Simulator

ANY = ("127.0.0.1", 0)
ENV_ID = "rotorgram/Elevation-v0"
QUICK = LinkConfig(timeout=8)
TABLES: dict[str, Any] = json.loads((Path(__file__).parent / "data" / "udp.json").read_text())
"""Rows of the tests of the wire, by what they are."""


class Running:
    """A simulator in a thread, and how it ended."""

    def __init__(self, simulator: Simulator) -> None:
        self.simulator = simulator
        self.result: str | BaseException | None = None
        self.thread = threading.Thread(target=self._run)
        self.thread.start()

    def _run(self) -> None:
        try:
            self.result = self.simulator.run()
        except Exception as error:
            self.result = error
        self.simulator.close()

    def join(self) -> str | BaseException | None:
        self.thread.join(10)
        assert not self.thread.is_alive()
        return self.result

    def cut(self) -> None:
        """End it without a word to the agent, as if it had been killed."""
        self.simulator.close()
        assert isinstance(self.join(), OSError)


def simulate(agent: Any, config: LinkConfig = QUICK, **arguments: Any) -> Running:
    """A simulator for an agent, given itself or by its address."""
    server = getattr(agent, "address", agent)
    simulator = Simulator(server=server, config=config, **{"bind": ANY, **arguments})
    if isinstance(simulator.stepped, Loop):
        simulator.stepped.prepare()  # tests wait for less than that may take
    return Running(simulator)


def launch(code: str, *arguments: object, stdin: int | None = None) -> subprocess.Popen[str]:
    """A Python program in a process of its own."""
    command = [sys.executable, "-c", textwrap.dedent(code), *map(str, arguments)]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, stdin=stdin, stdout=pipe, stderr=pipe, text=True)


@contextmanager
def plain_socket(bind: tuple[str, int] = ANY) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(bind)
        sock.settimeout(5)
        yield sock

"""`rotorgram sim`: the simulator, a UDP client."""

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ._flags import BackendFlags, parse_address


@dataclass(frozen=True, kw_only=True)
class Sim(BackendFlags):
    """Simulate drones for an agent: the UDP client.

    Waits for the agent, flies by its commands and ends when it closes. An agent that is killed and
    started again within the timeout finds it waiting.
    """

    server: str = "127.0.0.1:8001"
    """Address of the agent, HOST:PORT."""
    bind: str = "127.0.0.1:8000"
    """Address of this side, HOST:PORT; port 0 takes a free one."""
    num_envs: int | None = None
    """Drones in all. Default: those of one world."""
    codec: Literal["binary", "text"] = "binary"
    """binary, or the paper's text."""
    timeout: float = 120.0
    """Give up when the agent has been silent for so many seconds."""
    key_file: Path | None = None
    """Key that the agent has too (rotorgram key): needed beyond this machine."""
    insecure: bool = False
    """Allow addresses beyond this machine without a key: anyone who reaches them may take part."""
    record: Path | None = None
    """MCAP file to write every message to."""
    view: Literal["window", "web"] | None = None
    """Show up to 16 drones: in a window, or on a page for browsers. Lock-step does
    not wait for it. Keys: docs/viewing.md."""
    view_port: int = 8080
    """TCP port of the page, on this machine's loopback; 0 takes the first free one."""
    world: Literal["airport", "plain"] = "airport"
    """Surroundings of the drones in the view."""
    realtime: bool = False
    """Fly no faster than real time, for viewers."""

    def run(self) -> int:
        """Simulate until the agent closes."""
        from ..udp import LinkConfig, Simulator

        simulator = Simulator(
            self.env_id,
            server=parse_address(self.server),
            num_envs=self.num_envs,
            drones=self.drones,
            bind=parse_address(self.bind),
            codec=self.codec,
            vehicle=self.vehicle,
            backend=self.backend,
            config=LinkConfig(timeout=self.timeout),
            key_file=self.key_file,
            insecure=self.insecure,
            record=self.record,
            **self.options,
        )
        shown: AbstractContextManager[None] = nullcontext()
        if self.view is not None or self.realtime:  # otherwise nothing that draws is imported
            from ._watch import watched

            shown = watched(simulator, self)
        with simulator, shown:
            here = "{}:{}".format(*simulator.address)
            print(f"simulating at {here} for the agent at {self.server} (Ctrl-C ends)", flush=True)
            try:
                print(simulator.run())
            finally:
                print(f"wire: {simulator.link.statistics}", flush=True)
        return 0

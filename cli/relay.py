"""`rotorgram relay`: a bad network on purpose."""

from contextlib import suppress
from dataclasses import dataclass, field
from typing import Annotated

from tyro.conf import OmitArgPrefixes

from ..udp.transport.relay import FaultConfig
from ._flags import Command
from ._inputs import parse_address

__all__ = ["Relay"]


class FaultFlags(FaultConfig):
    """Faults of the relayed datagrams."""

    def __post_init__(self) -> None:
        """Accept any number: `FaultConfig` raises `InputError` for a wrong one."""


@dataclass(frozen=True, kw_only=True)
class Relay(Command):
    """Stand between simulators and an agent, and lose, double, reorder, delay and spoil datagrams.

    Simulators fly through it with --server set to its address.
    """

    listen: str = "127.0.0.1:8002"
    """Address for the simulators, HOST:PORT."""
    server: str = "127.0.0.1:8001"
    """Address of the agent, HOST:PORT."""
    faults: Annotated[FaultFlags, OmitArgPrefixes] = field(default_factory=FaultFlags)
    insecure: bool = False
    """Allow addresses beyond this machine."""

    def run(self) -> int:
        """Relay until Ctrl-C."""
        from ..udp.transport import relay

        config = FaultConfig(**vars(self.faults))
        listen, server = parse_address(self.listen), parse_address(self.server)
        with relay.Relay(listen, server, config, insecure=self.insecure) as running:
            here = "{}:{}".format(*running.address)
            print(f"relaying from {here} to {self.server} (Ctrl-C ends)", flush=True)
            with suppress(KeyboardInterrupt):
                running.run()
            counts = sorted(running.counters.items())
            print(", ".join(f"{count} {name}" for name, count in counts) or "no datagrams")
        return 0

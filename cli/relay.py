"""`rotorgram relay`: a bad network on purpose."""

from contextlib import suppress
from dataclasses import dataclass

from ..udp.transport import relay
from ._flags import Command, parse_address


@dataclass(frozen=True, kw_only=True)
class Relay(relay.FaultConfig, Command):
    """Relay datagrams between simulators and an agent; lose, double, reorder, delay and spoil some.

    Simulators fly through it with --server set to its address.
    """

    listen: str = "127.0.0.1:8002"
    """Address for the simulators, HOST:PORT."""
    server: str = "127.0.0.1:8001"
    """Address of the agent, HOST:PORT."""
    insecure: bool = False
    """Allow addresses beyond this machine."""

    def run(self) -> int:
        """Relay until Ctrl-C."""
        config = relay.FaultConfig(**self.settings(relay.FaultConfig))
        listen, server = parse_address(self.listen), parse_address(self.server)
        with relay.Relay(listen, server, config, insecure=self.insecure) as running:
            here = "{}:{}".format(*running.address)
            print(f"relaying from {here} to {self.server} (Ctrl-C ends)", flush=True)
            with suppress(KeyboardInterrupt):
                running.run()
            counts = sorted(running.counters.items())
            print(", ".join(f"{count} {name}" for name, count in counts) or "no datagrams")
        return 0

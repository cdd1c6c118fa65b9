"""Commands of the wire: simulate, make a key, relay with faults, replay a journal."""

from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional

from ..udp.faults import FaultConfig
from ..udp.link import LinkConfig
from .base import Command, EnvOptions
from .inputs import parse_address

if TYPE_CHECKING:
    from ..udp import Simulator

__all__ = ["MakeKey", "RelayFaults", "Replay", "Sim"]


@dataclass(frozen=True, kw_only=True)
class Sim(Command):
    """Simulate drones for an agent: the UDP client.

    Waits for the agent, flies by its commands and ends when it closes. An agent that is killed and
    started again within the timeout finds it waiting.
    """

    server: str = "127.0.0.1:8001"
    """Address of the agent, HOST:PORT."""
    bind: str = "127.0.0.1:8000"
    """Address of this side, HOST:PORT; port 0 takes a free one."""
    num_envs: int = 1
    """Drones."""
    codec: Literal["binary", "text"] = "binary"
    """binary, or the paper's text."""
    timeout: float = LinkConfig.timeout
    """Give up when the agent has been silent for so many seconds."""
    max_resend: float = LinkConfig.max_resend
    """Longest wait before what was not answered is sent again, s: less where much is lost."""
    key_file: Path | None = None
    """Key that the agent has too (rotorgram key): needed beyond this machine."""
    insecure: bool = False
    """Allow addresses beyond this machine without a key: whoever reaches them may take part."""
    record: Path | None = None
    """MCAP file to write every message to."""
    view: Literal["window", "web"] | None = None
    """Show what is flown, up to 16 drones: in a window, or on a page for browsers. Lock-step does
    not wait for it. Keys: docs/viewing.md."""
    view_port: int = 8080
    """TCP port of the page, on this machine's loopback; 0 takes the first free one."""
    world: Literal["airport", "plain"] = "airport"
    """What is around the drones in the view."""
    realtime: bool = False
    """Fly no faster than real time, for who looks on."""
    env: EnvOptions = field(default_factory=EnvOptions)

    def run(self) -> int:
        """Simulate until the agent closes."""
        from ..udp import Simulator

        simulator = Simulator(
            server=parse_address(self.server),
            num_envs=self.num_envs,
            bind=parse_address(self.bind),
            codec=self.codec,
            config=LinkConfig(
                timeout=self.timeout,
                min_resend=min(self.max_resend, LinkConfig.min_resend),
                max_resend=self.max_resend,
            ),
            key_file=self.key_file,
            insecure=self.insecure,
            record=self.record,
            **asdict(self.env.checked()),
        )
        with simulator, self._watched(simulator):
            here = "{}:{}".format(*simulator.address)
            print(f"simulating at {here} for the agent at {self.server} (Ctrl-C ends)", flush=True)
            try:
                print(simulator.run())
            finally:
                print(f"wire: {simulator.link.statistics}", flush=True)
        return 0

    def _watched(self, simulator: "Simulator") -> AbstractContextManager[None]:
        """Whoever looks on; without one, nothing that draws is imported."""
        if self.view is None and not self.realtime:
            return nullcontext()
        from .watch import watched

        return watched(simulator, self.view, self.view_port, self.world, realtime=self.realtime)


@dataclass(frozen=True, kw_only=True)
class MakeKey(Command):
    """Write a new key for both sides of the wire. Copy it to the other machine by a safe way."""

    file: Positional[Path]
    """File to write; it must not exist."""

    def run(self) -> int:
        """Write it."""
        from ..udp.keys import write_key

        write_key(self.file)
        print(f"key: {self.file} (give it to both sides with --key-file)")
        return 0


class FaultOptions(FaultConfig):
    """What happens to datagrams."""

    def __post_init__(self) -> None:
        """Take anything, so that a wrong number is told like every other wrong input."""

    def checked(self) -> FaultConfig:
        """The faults, if they can be. Raises `ValueError`."""
        return FaultConfig(**vars(self))


@dataclass(frozen=True, kw_only=True)
class RelayFaults(Command):
    """Stand between simulators and an agent, and lose, double, reorder, delay and spoil datagrams.

    Simulators fly through it with --server set to its address.
    """

    listen: str = "127.0.0.1:8002"
    """Address for the simulators, HOST:PORT."""
    server: str = "127.0.0.1:8001"
    """Address of the agent, HOST:PORT."""
    faults: Annotated[FaultOptions, OmitArgPrefixes] = field(default_factory=FaultOptions)
    insecure: bool = False
    """Allow addresses beyond this machine."""

    def run(self) -> int:
        """Relay until Ctrl-C."""
        from ..udp.faults import Relay

        config = self.faults.checked()
        listen, server = parse_address(self.listen), parse_address(self.server)
        with Relay(listen, server, config, insecure=self.insecure) as relay:
            here = "{}:{}".format(*relay.address)
            print(f"relaying from {here} to {self.server} (Ctrl-C ends)", flush=True)
            with suppress(KeyboardInterrupt):
                relay.run()
            counts = sorted(relay.counters.items())
            print(", ".join(f"{count} {name}" for name, count in counts) or "no datagrams")
        return 0


@dataclass(frozen=True, kw_only=True)
class Replay(Command):
    """Tell what a journal holds, and simulate it again."""

    file: Positional[Path]
    """MCAP file that --record wrote; cut off by a crash it is read up to the cut."""
    verify: bool = False
    """Simulate every session again and compare every bit; exit status 1 if one differs."""

    def run(self) -> int:
        """Print the summary and the verdict."""
        from ..udp.replay import summarize, verify

        print(summarize(self.file))
        if not self.verify:
            return 0
        verdict = verify(self.file)
        print(verdict)
        return 0 if verdict.identical else 1

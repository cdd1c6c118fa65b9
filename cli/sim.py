"""`rotorgram sim`: the simulator, a UDP client."""

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ..models.errors import InputError, expect
from ._flags import BackendFlags, parse_address

if TYPE_CHECKING:
    from ..udp import LinkConfig, SharedSimulator, Simulator


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
    agents: tuple[str, ...] = ()
    """Several agents in place of one --server: HOST:PORT of each. They fly one world, and share its
    drones evenly in their order; HOST:PORT=drone_0,drone_2 names those of one."""
    when_lost: Literal["hold", "land", "end"] = "hold"
    """What drones do whose agent is lost to --agents, unless it says so itself: hold, land or end
    (rotors stand still)."""
    patience: float = 10.0
    """Seconds that the world waits for the command of one of --agents."""
    codec: Literal["binary", "text"] = "binary"
    """binary, or the paper's text."""
    timeout: float = 120.0
    """Give up when the agent has been silent for so many seconds."""
    drop: float = 0.0
    """Lose each datagram, sent or received, with this probability: tries an agent under loss."""
    drop_seed: int = 0
    """The same seed loses the same datagrams."""
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
    realtime: bool = False
    """Fly no faster than real time, for viewers."""

    def run(self) -> int:
        """Simulate until the agent closes."""
        if self.options.get("cameras"):  # an agent that was greeted would wait for pictures
            from ..rendering.gl import offscreen_context

            offscreen_context(16, 16).free()
        if "agents" in self.given:
            return self._run_shared()
        for name in ("when_lost", "patience"):
            flag = f"--{name.replace('_', '-')}"
            if name in self.given:
                raise InputError(f"{flag}: expected it with --agents, got {getattr(self, name)}")
        from ..udp import Simulator

        simulator = Simulator(
            self.env_id,
            server=parse_address(self.server),
            num_envs=self.num_envs,
            drones=self.drones,
            codec=self.codec,
            config=self._link(),
            record=self.record,
            **self._common(),
        )
        with simulator, self._shown(simulator):
            here = "{}:{}".format(*simulator.address)
            print(f"simulating at {here} for the agent at {self.server} (Ctrl-C ends)", flush=True)
            try:
                print(simulator.run())
            finally:
                print(f"wire: {simulator.link.statistics}", flush=True)
        return 0

    def _run_shared(self) -> int:
        """Simulate one world until all its agents have closed."""
        from ..udp import SharedSimulator

        for name in ("server", "num_envs", "codec", "record"):
            flag = f"--{name.replace('_', '-')}"
            if name in self.given:
                raise InputError(f"{flag}: expected none with --agents, got {getattr(self, name)}")
        if not self.agents:
            raise InputError("--agents: expected HOST:PORT of each agent, got none")
        named = {address: names.split(",") for address, _, names in
                 (agent.partition("=") for agent in self.agents) if names}  # fmt: skip
        right = len(named) in (0, len(self.agents))
        expect(right, "--agents", "drones of each agent or of none", " ".join(self.agents))
        shares = {parse_address(address): names for address, names in named.items()}
        simulator = SharedSimulator(
            self.env_id,
            shares or [parse_address(agent) for agent in self.agents],
            drones=self.drones,
            when_lost=self.when_lost,
            patience=self.patience,
            config=self._link(),
            **self._common(),
        )
        with simulator, self._shown(simulator):
            here = "{}:{}".format(*simulator.address)
            print(f"simulating at {here} for {len(self.agents)} agents (Ctrl-C ends)", flush=True)
            try:
                print(simulator.run())
            finally:
                for link in simulator.links:
                    where = "{}:{}".format(*link.address)
                    print(f"wire to {where}: {link.client.statistics}", flush=True)
        return 0

    def _link(self) -> "LinkConfig":
        from ..udp import LinkConfig

        return LinkConfig(timeout=self.timeout, drop=self.drop, drop_seed=self.drop_seed)

    def _common(self) -> dict[str, Any]:
        """Settings of both simulators."""
        return {
            "bind": parse_address(self.bind), "vehicle": self.vehicle, "backend": self.backend,
            "key_file": self.key_file, "insecure": self.insecure, **self.options,
        }  # fmt: skip

    def _shown(self, simulator: "Simulator | SharedSimulator") -> AbstractContextManager[None]:
        if self.view is None and not self.realtime:  # nothing that draws is imported
            return nullcontext()
        from ._watch import watched

        return watched(simulator, self)

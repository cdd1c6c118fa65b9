"""`rotorgram sim`: the simulator, a UDP client."""

from contextlib import ExitStack
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import arg

from ..models import InputError
from ._flags import MavlinkFlags, WireFlags, Words, parse_address

if TYPE_CHECKING:
    from ..udp.protocol.running import FreeRun


class Sim(WireFlags, MavlinkFlags):
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
    agents: Words = ()
    """Several agents in place of one --server: HOST:PORT of each. They fly one world, and share its
    drones evenly in their order."""
    codec: Literal["binary", "text"] = "binary"
    """binary, or the paper's text."""
    timeout: float = 120.0
    """Give up when the agent has been silent for so many seconds."""
    drop: float = 0.0
    """Lose each datagram, sent or received, with this probability: tries an agent under loss."""
    free_running: Annotated[float | None, arg(metavar="RATE")] = None
    """Keep time, at so many times real time, instead of waiting for each command. Late ones are
    counted. Default: lock-step."""
    silence: float = 0.5
    """With --free-running: seconds without a command, of simulated time, until --after."""
    after: Literal["hover", "land", "off", "hold"] = "hover"
    """What the craft does then: hover, land, stop its rotors, or hold the last action."""
    allow_events: bool = False
    """Let agents ask for the events of --events that happen when "asked": with a key, or on this
    machine."""
    view: bool = False
    """Show the first world in a window. Lock-step does not wait for it. Keys: docs/viewing.md."""

    @property
    def free_run(self) -> "FreeRun | None":
        """How the simulator keeps time; None for lock-step."""
        from ..udp.protocol.running import FreeRun

        if self.free_running is not None:
            return FreeRun(rate=self.free_running, silence=self.silence, after=self.after)
        if self.given.isdisjoint(("silence", "after")):
            return None
        raise InputError("--silence, --after: expected them with --free-running")

    def run(self) -> None:
        """Simulate until the agent closes."""
        if self.options.get("cameras"):  # an agent that was greeted would wait for pictures
            from ..rendering.gl import offscreen_context

            offscreen_context(16, 16).free()
        from ..udp import LinkConfig, Simulator
        from ._mavlink import mavlink_out

        several = "agents" in self.given
        if several and "server" in self.given:
            raise InputError("--server: cannot be used with --agents")
        agents = [parse_address(agent) for agent in self.agents] if several else None
        simulator = Simulator(
            self.env_config(),
            server=parse_address(self.server),
            agents=agents,
            num_envs=self.num_envs,
            bind=parse_address(self.bind),
            codec=self.codec,
            config=LinkConfig(**self.settings(LinkConfig)),
            key_file=self.key_file,
            insecure=self.insecure,
            record=self.record,
            free_run=self.free_run,
            allow_events=self.allow_events,
        )
        links = simulator.rules.links
        there = f"{len(links)} agents" if several else f"the agent at {self.server}"
        with ExitStack() as opened:
            opened.enter_context(simulator)
            if self.view:
                from ..rendering.live import Pace
                from ._watch import Watcher, open_view

                drones = len(simulator.spec.agents)
                view = opened.enter_context(
                    open_view(self, drones, self.env_config().scene, Pace(0.0))
                )
                print("shown in the window")
                simulator.observers.append(Watcher(view, simulator))
            out = opened.enter_context(mavlink_out(self, simulator.spec))
            if out is not None:
                stepped = simulator.stepped
                simulator.observers.append(lambda cause: out(stepped, cause.resets))
            here = "{}:{}".format(*simulator.address)
            print(f"simulating at {here} for {there} (Ctrl-C ends)")
            try:
                print(simulator.run())
            finally:
                for link in links:
                    where = " to {}:{}".format(*link.address) if several else ""
                    print(f"wire{where}: {link.client.statistics}")

"""The simulator: a UDP client that steps envs by the Commands of one agent, or of several."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Literal, cast

import numpy as np

from ...envs.config import DEFAULT_ENV, EnvConfig
from ...models.errors import InputError
from ...models.fields import Choice, Limits, check
from ..layouts import layout_of
from ..protocol import binary
from ..protocol.auth import Key, read_keys
from ..protocol.client import Address, Client, LinkConfig, largest_datagram, new_session
from ..protocol.messages import POLICIES, Hello
from ..protocol.party import AgentLink, OneAgent, SeveralAgents, SwarmWorld, WorldRules
from .driver import Driver
from .sockets import TEXT_WAY_OUT, WAY_OUT, Port, resolve
from .stepped import GymEnv, GymnasiumWorld, make_stepped

DEFAULT_AGENT: Final = ("127.0.0.1", 8001)
DEFAULT_SIMULATOR: Final = ("127.0.0.1", 8000)


class Simulator(Driver):
    """Simulated drones that an agent flies over UDP, or several agents.

    Several agents fly one world. Each is an ordinary one (`RemoteEnv`, `RemoteParallelEnv`, …): its
    Hello names its own drones, its States have their rows. The world steps when all agents that fly
    have answered, so its numbers are those of the world in process with the same actions, bit for
    bit. The rules are those of `SeveralAgents`.

    Args:
        env: `EnvConfig`, id of a registered env, or one Gymnasium env itself: observations are a
            Box or a Dict of Box, actions a Box or `Discrete`.
        server: Address (host, port) of the agent.
        agents: Addresses of several agents in its place. They share the drones evenly in their
            order.
        num_envs: Drones in all; None: those of one world.
        bind: Address of this side; port 0 takes a free port.
        codec: `binary`, or the paper's `text`.
        config: Times of the exchange. `timeout`: longest wait for an agent that is to come, or to
            come back, s.
        key_file: As `AgentSettings`, and so are `insecure` and `record`.
        when_lost: What the drones of one of several agents do when it is lost: `hold` (the action
            that changes nothing), `land` (`Loop.land`) or `end` (rotors stand still).
        patience: Longest wait for a Command of one of several agents, s.
        keywords: As of `EnvConfig.from_keywords`, with an id: `drones` of each world, `vehicle` …

    Raises:
        InputError: An option, an address, the key file or the env's spaces are not what they
            should be.
        OSError: The port is in use, or the record cannot be written.
    """

    def __init__(
        self,
        env: str | EnvConfig | GymEnv = DEFAULT_ENV,
        *,
        server: Address = DEFAULT_AGENT,
        agents: Sequence[Address] | None = None,
        num_envs: int | None = None,
        bind: Address = DEFAULT_SIMULATOR,
        codec: Literal["binary", "text"] = "binary",
        config: LinkConfig | None = None,
        key_file: Path | str | None = None,
        insecure: bool = False,
        record: Path | str | None = None,
        when_lost: str = "hold",
        patience: float = 10.0,
        **keywords: Any,
    ) -> None:
        check("codec", Choice(("binary", "text")), codec)
        check("patience", Limits(0, unit="s", above=True), patience)
        check("when_lost", Choice(POLICIES), when_lost)
        by_text = codec == "text"
        if agents is not None and not agents:
            raise InputError("agents: expected one address or more, got none")
        if agents is not None and (by_text or record or num_envs):
            raise InputError("agents: expected neither text, record nor num_envs with several")
        config = config or LinkConfig()
        key = Key(read_keys(key_file)[0], "simulator") if key_file else None
        insecure = insecure or key is not None
        way_out = TEXT_WAY_OUT if by_text else WAY_OUT
        with ExitStack() as failing:  # closes what is open if a later step fails
            stepped = make_stepped(env, num_envs, keywords)
            failing.callback(stepped.close)
            spec = stepped.spec
            worlds = stepped.num_envs // len(spec.agents)
            layout = layout_of(spec, worlds)
            servers = [server] if agents is None else list(agents)
            links: list[AgentLink] = []
            for number, address in enumerate(servers):
                there = resolve(address, insecure=insecure, way_out=way_out)
                if not there[1]:
                    raise InputError("server: expected the port of the agent, 1 to 65535, got 0")
                rows = _share(len(spec.agents), number, len(servers))
                own = replace(spec, agents=spec.agents[rows[0] : rows[-1] + 1])
                client = Client(
                    Hello(session=new_session(), spec=own.to_json(), worlds=worlds),
                    layout_of(own, worlds),
                    replace(config, drop_seed=config.drop_seed + number),
                    largest=largest_datagram(there, config.max_datagram),
                    by_text=by_text,
                    key=key,
                )
                links.append(AgentLink(number, there, client, rows))
            port = _open_port(bind, [link.address for link in links], insecure=insecure)
            failing.callback(port.close)
            rules: WorldRules
            if agents is None:
                rules = OneAgent(stepped, layout, spec.control_period, links)
            elif isinstance(stepped, GymnasiumWorld):
                raise InputError(f"env: expected a registered task for several drones, got {env!r}")
            else:
                world = cast(SwarmWorld, stepped)
                rules = SeveralAgents(
                    world, layout, spec.control_period, links, when_lost, patience
                )
            super().__init__(stepped, rules, port)
            if record:
                self._record(record)
            failing.pop_all()

    def _record(self, path: Path | str) -> None:
        from ..journal import Journal
        from ..journal.writer import models_of

        about, models = models_of(self.stepped)
        link = self.link
        codec = "text" if link.by_text else "binary"
        self._journal = Journal(path, side="simulator", codec=codec, about=about, models=models)
        link.tap = self._journal.tap
        if link.by_text:  # says no Hello
            link.tap(0, link.hello, binary.encode(link.hello))


def _share(drones: int, number: int, agents: int) -> np.ndarray:
    """The drones of one of several agents, which have the same number each."""
    if drones % agents:
        raise InputError(f"agents: expected a divisor of {drones} drones, got {agents} agents")
    share = drones // agents
    return number * share + np.arange(share)


def _open_port(bind: Address, agents: list[Address], *, insecure: bool) -> Port:
    if len(set(agents)) < len(agents):
        raise InputError(f"agents: expected a different address of each, got {agents}")
    port = Port(bind, insecure=insecure, peers=agents)
    if port.address in agents:
        port.close()
        raise InputError(f"server: expected the address of an agent, got that of this side, {bind}")
    return port

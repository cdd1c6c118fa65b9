"""Simulators: UDP clients that step envs by the Commands of one agent, or of several."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Any, Final, Literal, cast

import gymnasium as gym
import numpy as np

from ...envs.config import DEFAULT_ENV, EnvConfig
from ...envs.spec import EnvSpec
from ...models.errors import InputError
from ..layouts import layout_of
from ..protocol.auth import Key, read_keys
from ..protocol.client import Address, Client, LinkConfig, largest_datagram, new_session
from ..protocol.messages import POLICIES, Hello
from ..protocol.party import Absence, AgentLink, OneAgent, SeveralAgents, SwarmWorld
from .driver import Driver
from .sockets import TEXT_WAY_OUT, WAY_OUT, Port, resolve
from .stepped import make_stepped

DEFAULT_AGENT: Final = ("127.0.0.1", 8001)
DEFAULT_SIMULATOR: Final = ("127.0.0.1", 8000)


class Simulator(Driver):
    """Simulated drones that an agent flies over UDP.

    Args:
        env: `EnvConfig`, id of a registered env, or one Gymnasium env itself: observations are a
            Box or a Dict of Box, actions a Box or `Discrete`.
        server: Address (host, port) of the agent.
        num_envs: Drones in all; None: those of one world.
        bind: Address of this side; port 0 takes a free port.
        codec: `binary`, or the paper's `text`.
        config: Times of the exchange.
        key_file: As `AgentSettings`, and so are `insecure` and `record`.
        keywords: As of `EnvConfig.from_keywords`, with an id: `drones` of each world, `vehicle` …

    Attributes:
        link: The exchange with the agent, with its statistics.
        Others: As `Driver`.

    Raises:
        InputError: An option, an address, the key file or the env's spaces are not what they
            should be.
        OSError: The port is in use, or the record cannot be written.
    """

    def __init__(
        self,
        env: str | EnvConfig | gym.Env[Any, Any] = DEFAULT_ENV,
        *,
        server: Address = DEFAULT_AGENT,
        num_envs: int | None = None,
        bind: Address = DEFAULT_SIMULATOR,
        codec: Literal["binary", "text"] = "binary",
        config: LinkConfig | None = None,
        key_file: Path | str | None = None,
        insecure: bool = False,
        record: Path | str | None = None,
        **keywords: Any,
    ) -> None:
        if codec not in ("binary", "text"):
            raise InputError(f"codec: expected 'binary' or 'text', got {codec!r}")
        key = Key(read_keys(key_file)[0], "simulator") if key_file else None
        insecure = insecure or key is not None
        way_out = TEXT_WAY_OUT if codec == "text" else WAY_OUT
        server = resolve(server, insecure=insecure, way_out=way_out)
        if not server[1]:
            raise InputError("server: expected the port of the agent, 1 to 65535, got 0")
        with ExitStack() as failing:  # closes what is open if a later step fails
            stepped = make_stepped(env, num_envs, keywords)
            failing.callback(stepped.close)
            worlds = stepped.num_envs // len(stepped.spec.agents)
            layout = layout_of(stepped.spec, worlds)
            hello = Hello(session=new_session(), spec=stepped.spec.to_json(), worlds=worlds)
            config = config or LinkConfig()
            largest = largest_datagram(server, config.max_datagram)
            by_text = codec == "text"
            client = Client(hello, layout, config, largest=largest, by_text=by_text, key=key)
            link = AgentLink(0, server, client, np.arange(layout.drones))
            port = Port(bind, insecure=insecure, only=server)
            failing.callback(port.close)
            if port.address == server:
                raise InputError("server: expected the address of the agent, got that of this side")
            rules = OneAgent(stepped, layout, stepped.spec.control_period, [link])
            super().__init__(stepped, rules, port)
            if record:
                self._record(record, hello)
            failing.pop_all()

    def _record(self, path: Path | str, hello: Hello) -> None:
        from ..journal import Journal
        from ..journal.writer import models_of

        about, models = models_of(self.stepped)
        self._journal = Journal(
            path, side="simulator", text_hello=hello, about=about, models=models
        )
        self.link.tap = self._journal.tap


class SharedSimulator(Driver):
    """One world of several drones, each flown by one of several agents over UDP.

    Every agent is an ordinary one (`RemoteEnv`, `RemoteParallelEnv`, …): its Hello names its own
    drones, its States have their rows. The world steps when all agents that fly have answered, so
    its numbers are those of the world in process with the same actions, bit for bit. The rules are
    those of `SeveralAgents`.

    Args:
        env: `EnvConfig`, or id of a registered task for several drones.
        agents: Their addresses (host, port), which share the drones evenly in their order; or, by
            address, the names of the drones of each.
        when_lost: Policy of agents that state none: `hold` (the action that changes nothing),
            `land` (`Loop.land`) or `end` (rotors stand still).
        patience: Longest wait for a Command, s.
        bind: Address of this side; port 0 takes a free one.
        config: Times of the exchange. `timeout`: longest wait for an agent that is to come, or to
            come back, s.
        Others: As `Simulator`.

    Attributes:
        absences, episodes, steps, seed: As `SeveralAgents`.
        Others: As `Driver`.

    Raises:
        InputError: An argument is not what it should be.
        OSError: The port is in use.
    """

    def __init__(
        self,
        env: str | EnvConfig,
        agents: Sequence[Address] | Mapping[Address, Sequence[str]],
        *,
        when_lost: str = "hold",
        patience: float = 10.0,
        bind: Address = DEFAULT_SIMULATOR,
        config: LinkConfig | None = None,
        key_file: Path | str | None = None,
        insecure: bool = False,
        **keywords: Any,
    ) -> None:
        if not (isinstance(patience, int | float) and 0 < patience < inf):
            raise InputError(f"patience: expected seconds > 0, got {patience!r}")
        if when_lost not in POLICIES:
            raise InputError(f"when_lost: expected one of {', '.join(POLICIES)}, got {when_lost!r}")
        key = Key(read_keys(key_file)[0], "simulator") if key_file else None
        insecure = insecure or key is not None
        config = config or LinkConfig()
        with ExitStack() as failing:
            stepped = make_stepped(env, None, keywords)
            failing.callback(stepped.close)
            if not hasattr(stepped, "retire"):
                raise InputError(f"env: expected a registered task for several drones, got {env!r}")
            spec = stepped.spec
            links: list[AgentLink] = []
            for address, names in _shares(agents, spec.agents):
                there = resolve(address, insecure=insecure)
                if not there[1]:
                    raise InputError("agents: expected the port of each agent, 1 to 65535, got 0")
                links.append(_shared_link(len(links), there, spec, names, config, key))
            addresses = [link.address for link in links]
            if len(set(addresses)) < len(addresses):
                raise InputError(f"agents: expected a different address of each, got {addresses}")
            port = Port(bind, insecure=insecure)
            failing.callback(port.close)
            port.keep(addresses)
            if port.address in addresses:
                raise InputError(
                    f"agents: expected addresses of agents, got that of this side, {port.address}"
                )
            self._shared = SeveralAgents(
                cast(SwarmWorld, stepped),
                layout_of(spec),
                spec.control_period,
                links,
                when_lost=when_lost,
                patience=patience,
            )
            super().__init__(stepped, self._shared, port)
            failing.pop_all()

    @property
    def absences(self) -> list[Absence]:
        """Every `Absence` so far."""
        return self._shared.absences

    @property
    def episodes(self) -> int:
        """Episodes begun so far."""
        return self._shared.episodes

    @property
    def steps(self) -> int:
        """Control steps of the running episode."""
        return self._shared.steps

    @property
    def seed(self) -> int | None:
        """Seed of the running episode; None: the streams of the episode before went on."""
        return self._shared.seed


def _shared_link(
    number: int,
    address: Address,
    spec: EnvSpec,
    names: tuple[str, ...],
    config: LinkConfig,
    key: Key | None,
) -> AgentLink:
    """The link to the agent of these drones of a world."""
    own = replace(spec, agents=names)
    hello = Hello(session=new_session(), spec=own.to_json())
    config = replace(config, drop_seed=config.drop_seed + number)
    largest = largest_datagram(address, config.max_datagram)
    client = Client(hello, layout_of(own), config, largest=largest, key=key)
    rows = np.array([spec.agents.index(name) for name in names])
    return AgentLink(number, address, client, rows)


def _shares(
    agents: Sequence[Address] | Mapping[Address, Sequence[str]], names: tuple[str, ...]
) -> list[tuple[Address, tuple[str, ...]]]:
    """Drones of each agent. Raises `InputError` unless every drone has one."""
    if isinstance(agents, Mapping):
        shares = [(address, tuple(own)) for address, own in agents.items()]
        given = sorted(name for _, own in shares for name in own)
        if not all(own for _, own in shares) or given != sorted(names):
            got = ", ".join(given) or "none"
            raise InputError(f"agents: expected each of {', '.join(names)} once, got {got}")
        return shares
    count = len(agents)
    drones = len(names)
    if not count or drones % count:
        raise InputError(f"agents: expected a divisor of {drones} drones, got {count} agents")
    size = drones // count
    return [(address, names[i * size : (i + 1) * size]) for i, address in enumerate(agents)]

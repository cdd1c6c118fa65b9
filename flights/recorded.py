"""Trajectories of a journal: one reader for films, logs, plots, pictures and data sets."""

import logging
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

import numpy as np

from ..models import InputError
from ..udp.journal.reader import Recording, Session
from ..udp.protocol.messages import FLY, Command, State
from .trajectories import Ending, Flights, Trajectory

Array = np.ndarray


def recorded_trajectories(
    path: Path,
    episodes: Sequence[int] | None = None,
    *,
    session: int | None = None,
    drone: int | None = 0,
    observations: Collection[str] = (),
) -> Flights:
    """Episodes of one drone (of the session, from 0) of one session of a journal; with None those
    of all drones, one drone after the other.

    Sessions are counted from 1, as `rotorgram replay` does; None is the first with a step in it.
    Episodes are given by number, None for all. Those of a drone are counted from 0; every episode
    with a recorded step counts, also one that was given up or cut off by the journal's end. They
    get the observations of these names.

    Raises:
        InputError: It is no journal, or has no such session, drone or episode.
        OSError: It cannot be read.
    """
    sessions = []
    found: Flights = []
    for one in read_episodes(path, drone, observations=observations):
        if isinstance(one, Session):
            sessions.append(one)
        elif session in (None, one.session):
            found.append(one)
    if session is not None and not 1 <= session <= len(sessions):
        known = f"1 to {len(sessions)}" if sessions else "a journal with sessions"
        raise InputError(f"session: expected {known}, got {session} for {path}")
    drones = max((one.num_envs for one in sessions if session in (None, one.index)), default=1)
    if drone is not None and not 0 <= drone < drones:
        raise InputError(f"drone: expected 0 to {drones - 1} in {path}, got {drone}")
    if not found:
        raise InputError(f"{path}: expected an episode with a step in it, got none")
    flew = sorted({one.session for one in found})
    if len(flew) > 1:
        found = [one for one in found if one.session == flew[0]]
        logging.getLogger(__name__).info(
            "%s: session %d, the first of %d that flew; "
            "--session of log, plot and render takes another",
            path.name,
            flew[0],
            len(flew),
        )
    found.sort(key=lambda one: (one.drone, one.episode))
    if episodes is None:
        return found
    last = max(one.episode for one in found)
    for episode in episodes:
        if not 0 <= episode <= last:
            raise InputError(f"episode: expected 0 to {last} in {path}, got {episode}")
    return [one for episode in episodes for one in found if one.episode == episode]


def read_episodes(
    path: Path, drone: int | None = None, *, observations: Collection[str] | None = ()
) -> Iterator[Session | Trajectory]:
    """The sessions of a journal as they begin, their episodes as they end.

    A Command that is missing in the journal cuts off all episodes: nobody knows what was flown.

    Args:
        path: The journal.
        drone: The one whose trajectories are made; None: all.
        observations: Names of those that they get; None: all.
    """
    flying: dict[int, _SessionReader] = {}  # the last session of each slot
    for item in Recording(path):
        slot = item.session.slot
        if item.begins:
            if slot in flying:
                yield from flying[slot].finish()
            yield item.session
            flying[slot] = _SessionReader(item.session, drone, observations)
        if isinstance(item.message, State):
            yield from flying[slot].take(item.message, item.command)
    for reader in flying.values():
        yield from reader.finish()


class _SessionReader:
    """Makes trajectories from the States and Commands of one session."""

    def __init__(
        self, session: Session, drone: int | None, observations: Collection[str] | None
    ) -> None:
        self.session = session
        self._observed = {
            array.name: place
            for place, array in enumerate(session.spec.observation)
            if observations is None or array.name in observations
        }
        count = session.num_envs
        self._chosen = np.ones(count, bool) if drone is None else np.arange(count) == drone
        # Of the running episodes.
        self._rows: dict[int, list[list[Array]]] = {}
        self._seeds: dict[int, int | None] = {}
        self._episodes = [0] * count

    def take(self, state: State, command: Command | None) -> Iterator[Trajectory]:
        """The next State, and the Command before it: the episodes that it ends, one after the
        other.
        """
        if command is None:
            yield from self.finish()
            return
        for drone in np.flatnonzero((command.orders == FLY) & self._chosen).tolist():
            if drone not in self._rows:
                continue  # its episode has ended
            self._rows[drone].append(self._row(state, command, drone))
            if state.terminated[drone]:
                yield from self._end(drone, "terminated")
            elif state.truncated[drone]:
                yield from self._end(drone, "truncated")
        for drone in np.flatnonzero(command.resets & self._chosen).tolist():
            yield from self._end(drone, "cut off")
            # The first drone's seed counts for its world.
            first = drone - drone % len(self.session.spec.agents)
            self._seeds[drone] = None if command.seeds is None else int(command.seeds[first])
            self._rows[drone] = [self._row(state, command, drone)]

    def finish(self) -> Iterator[Trajectory]:
        """The episodes that the journal's end cuts off."""
        for drone in sorted(self._rows):
            yield from self._end(drone, "cut off")

    def _row(self, state: State, command: Command, drone: int) -> list[Array]:
        """Telemetry, observations that are wanted, and the reward and action that led there."""
        observed = [state.observations[place] for place in self._observed.values()]
        columns = [*state.telemetry, *observed, state.rewards, command.actions]
        return [np.array(column[drone]) for column in columns]

    def _end(self, drone: int, ending: Ending) -> Iterator[Trajectory]:
        """The episode of a drone, if it has a step."""
        rows = self._rows.pop(drone, [])
        if len(rows) < 2:
            return
        spec = self.session.spec
        *columns, rewards, actions = map(np.stack, zip(*rows, strict=True))
        count = len(spec.telemetry)
        names = [array.name for array in spec.telemetry]
        yield Trajectory(
            spec=spec,
            telemetry=dict(zip(names, columns[:count], strict=True)),
            rewards=rewards[1:],
            actions=actions[1:],
            ending=ending,
            episode=self._episodes[drone],
            observations=dict(zip(self._observed, columns[count:], strict=True)),
            session=self.session.index,
            drone=drone,
            seed=self._seeds[drone],
        )
        self._episodes[drone] += 1

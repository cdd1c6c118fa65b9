"""Trajectories of a journal: one reader for films, logs, plots, pictures and data sets."""

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..envs.spec import ArraySpec
from ..models.errors import InputError
from ..udp.journal.reader import Recording, Session, Transition
from ..udp.protocol.messages import State
from .trajectories import Ending, Trajectory

Array = np.ndarray


def recorded_trajectories(
    path: Path,
    episodes: Sequence[int] | None = None,
    *,
    session: int | None = None,
    drone: int | None = 0,
) -> list[Trajectory]:
    """Episodes of one drone (of the session, from 0) of one session of a journal; with None those
    of all drones, one drone after the other.

    Sessions are counted from 1, as `rotorgram replay` does; None is the first with a step in it.
    Episodes are given by number, None for all. Those of a drone are counted from 0; every episode
    with a recorded step counts, also one that was given up or cut off by the journal's end.

    Raises:
        InputError: It is no journal, or has no such session, drone or episode.
        OSError: It cannot be read.
    """
    if not path.is_file():
        raise InputError(f"{path}: expected a journal (.mcap), got no such file")
    sessions: list[Session] = []
    found: list[Trajectory] = []
    for one in read_episodes(path, drone):
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
        words = (
            "%s: session %d, the first of %d that flew; "
            "--session of log, plot and render takes another"
        )
        logging.getLogger(__name__).info(words, path.name, flew[0], len(flew))
    found.sort(key=lambda one: (one.drone, one.episode))
    if episodes is None:
        return found
    last = max(one.episode for one in found)
    for episode in episodes:
        if not 0 <= episode <= last:
            raise InputError(f"episode: expected 0 to {last} in {path}, got {episode}")
    return [one for episode in episodes for one in found if one.episode == episode]


def read_episodes(
    path: Path, drone: int | None = None, *, observations: bool = False
) -> Iterator[Session | Trajectory]:
    """The sessions of a journal as they begin, their episodes as they end.

    A Command that is missing in the journal cuts off all episodes: nobody knows what was flown.

    Args:
        path: The journal.
        drone: The one whose trajectories are made; None: all.
        observations: Whether they get their observations.
    """
    flying: dict[int, _SessionReader] = {}  # the last session of each slot
    for item in Recording(path):
        slot = item.session.slot
        if item.begins:
            if slot in flying:
                yield from flying[slot].finish()
            yield item.session
            flying[slot] = _SessionReader(item.session, drone, observations)
        if item.transition:
            yield from flying[slot].take(item.transition)
    for reader in flying.values():
        yield from reader.finish()


class _Row(NamedTuple):
    """One drone after a State, and the action that led there; None at the start."""

    telemetry: list[Array]
    observations: list[Array]
    reward: float
    action: Array | None


class _SessionReader:
    """Makes trajectories from the messages of one session."""

    def __init__(self, session: Session, drone: int | None, observations: bool) -> None:
        self.session = session
        self._observations = observations
        self._drones = len(session.spec.agents)
        count = session.num_envs
        self._chosen = np.ones(count, bool) if drone is None else np.arange(count) == drone
        self._rows: list[list[_Row]] = [[] for _ in range(count)]
        self._seeds: list[int | None] = [None] * count
        self._episodes = [0] * count

    def take(self, transition: Transition) -> Iterator[Trajectory]:
        """The next transition of the session: the episodes that it ends, one after the other."""
        state = transition.state
        command = transition.command
        if transition.is_gap:
            yield from self.finish()
        for drone in np.flatnonzero(transition.flown & self._chosen).tolist():
            if command is None or not self._rows[drone]:
                continue  # its episode has ended
            self._rows[drone].append(self._row(state, drone, command.actions[drone]))
            if state.terminated[drone]:
                yield from self._end(drone, "terminated")
            elif state.truncated[drone]:
                yield from self._end(drone, "truncated")
        for drone in np.flatnonzero(transition.resets & self._chosen).tolist():
            yield from self._end(drone, "cut off")
            self._rows[drone] = [self._row(state, drone, None)]
            first = drone - drone % self._drones  # the first drone's seed counts for its world
            seeds = transition.seeds
            self._seeds[drone] = None if seeds is None else int(seeds[first])

    def finish(self) -> Iterator[Trajectory]:
        """The episodes that the journal's end cuts off."""
        for drone in range(len(self._rows)):
            yield from self._end(drone, "cut off")

    def _row(self, state: State, drone: int, action: Array | None) -> _Row:
        observations = state.observations if self._observations else ()
        return _Row(
            telemetry=[np.array(values[drone]) for values in state.telemetry],
            observations=[np.array(values[drone]) for values in observations],
            reward=float(state.rewards[drone]),
            action=None if action is None else np.array(action),
        )

    def _end(self, drone: int, ending: Ending) -> Iterator[Trajectory]:
        """The episode of a drone, if it has a step; a new one has not begun."""
        rows = self._rows[drone]
        self._rows[drone] = []
        if len(rows) < 2:
            return
        spec = self.session.spec
        yield Trajectory(
            spec=spec,
            telemetry=_stacked(spec.telemetry, [row.telemetry for row in rows]),
            rewards=np.array([row.reward for row in rows[1:]]),
            actions=np.stack([row.action for row in rows if row.action is not None]),
            ending=ending,
            episode=self._episodes[drone],
            observations=_stacked(spec.observation, [row.observations for row in rows]),
            session=self.session.index,
            drone=drone,
            seed=self._seeds[drone],
        )
        self._episodes[drone] += 1


def _stacked(specs: Sequence[ArraySpec], rows: Sequence[Sequence[Array]]) -> dict[str, Array]:
    """Arrays by name, over time; nothing, if the rows are empty."""
    columns = zip(*rows, strict=True)
    return {spec.name: np.stack(column) for spec, column in zip(specs, columns, strict=False)}

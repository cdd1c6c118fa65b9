"""Flights to look at: flown in process by a policy, or read from a journal."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from ..agents.policies import Policy
from ..envs import ENV_ID, TELEMETRY_NAMES, ElevationConfig, ElevationEnv
from ..rendering import Moment
from ..udp.messages import Command, Hello, Message, State
from ..udp.replay import read_journal
from .evaluate import evaluation_seed

__all__ = ["Ending", "Track", "flown_tracks", "recorded_tracks"]

Ending = Literal["terminated", "truncated", "cut off"]
"""`cut off`: the journal, or its agent, ended it."""


@dataclass(frozen=True, kw_only=True)
class Track:
    """One episode of one drone, as it is looked at."""

    moments: list[Moment]
    """Moment k is what k control steps led to; the first is the episode's start."""
    control_period: float
    """Between two moments, s."""
    ending: Ending

    @property
    def seconds(self) -> float:
        """From its first moment to its last."""
        return (len(self.moments) - 1) * self.control_period

    @property
    def errors(self) -> list[float]:
        """E of every moment, m."""
        return [moment.error for moment in self.moments]

    def step_at(self, seconds: float) -> int:
        """Number of the moment that is seen at that time; the last, from its end on."""
        # A time that is a whole number of periods but for its last bits belongs to that step.
        return min(max(int(seconds / self.control_period + 1e-6), 0), len(self.moments) - 1)


def flown_tracks(
    policy: Policy | None, config: ElevationConfig, episodes: Sequence[int]
) -> list[Track]:
    """Evaluation episodes by number, flown in process without exploration.

    Args:
        policy: Who flies; None draws actions at random, the same for the same episode.
        config: Options of the env.
        episodes: Their numbers; their seeds are those of every evaluation.
    """
    with closing(ElevationEnv(**asdict(config))) as env:
        return [_flown(env, policy, episode) for episode in episodes]


def _flown(env: ElevationEnv, policy: Policy | None, episode: int) -> Track:
    seed = evaluation_seed(episode)
    observation, info = env.reset(seed=seed)
    if policy is None:
        env.action_space.seed(seed)
    else:
        policy.reset()
    moments = [Moment.of(info, observation[0], episode=episode)]
    terminated = truncated = False
    while not (terminated or truncated):
        action = env.action_space.sample() if policy is None else policy.act(observation)
        observation, reward, terminated, truncated, info = env.step(action)
        moments.append(
            Moment.of(
                info, observation[0], reward=float(reward), step=len(moments), episode=episode
            )
        )
    return Track(
        moments=moments,
        control_period=env.control_period,
        ending="terminated" if terminated else "truncated",
    )


def recorded_tracks(
    path: Path,
    episodes: Sequence[int] | None = None,
    *,
    session: int | None = None,
    drone: int = 0,
) -> list[Track]:
    """Episodes of one drone of one session of a journal.

    Args:
        path: What `--record` wrote; cut off by a crash it is read up to the cut.
        episodes: Their numbers; None for all there are. They count, from 0, the episodes of which a
            step is recorded, those that were given up and one that the journal's end cut off among
            them.
        session: As `rotorgram replay` counts them, from 1. None: the first in which something was
            flown.
        drone: Of the session, from 0.

    Raises:
        ValueError: It is no journal, or has no such session, drone or episode.
        OSError: It cannot be read.
    """
    if not path.is_file():
        raise ValueError(f"{path}: expected a journal (.mcap), got no such file")
    readers: dict[int, _Reader] = {}
    for item in read_journal(path):
        index = item.flight.index
        reader = readers.setdefault(index, _Reader(item.flight.hello, drone))
        if session in (None, index):
            reader.take(item.message)
    if session is not None and session not in readers:
        there = f"1 to {len(readers)}" if readers else "a journal with sessions"
        raise ValueError(f"session: expected {there}, got {session} for {path}")
    flown = [readers[index] for index in sorted(readers) if readers[index].steps]
    if not flown:
        raise ValueError(f"{path}: expected an episode in which something was flown, got none")
    return flown[0].chosen(episodes, path)


class _Reader:
    """Makes episodes of what a journal has of one session. It keeps one drone's numbers only."""

    def __init__(self, hello: Hello, drone: int) -> None:
        self._hello, self._drone = hello, drone
        self._known = hello.env_id == ENV_ID and hello.telemetry_names == TELEMETRY_NAMES
        self._command: Command | None = None
        self._moments: list[Moment] = []
        self._tracks: list[Track] = []
        self.steps = 0
        """Of any drone."""

    def take(self, message: Message) -> None:
        """The next message of the session."""
        if isinstance(message, Command):
            self._command = message
        elif isinstance(message, State):
            self.steps += self._command is not None and not bool(self._command.resets.all())
            if self._known and 0 <= self._drone < self._hello.num_drones:
                self._take_state(message, self._command)

    def chosen(self, episodes: Sequence[int] | None, path: Path) -> list[Track]:
        """Episodes by number, or all, once all is read. Raises `ValueError`."""
        hello, tracks = self._hello, self._tracks
        if not self._known:
            raise ValueError(f"{path}: expected a drone of {ENV_ID}, got one of {hello.env_id}")
        if not 0 <= self._drone < hello.num_drones:
            last = hello.num_drones - 1
            raise ValueError(f"drone: expected 0 to {last} in {path}, got {self._drone}")
        self._keep("cut off")
        if not tracks:
            raise ValueError(f"{path}: expected an episode of drone {self._drone}, got none")
        if episodes is None:
            return tracks
        for episode in episodes:
            if not 0 <= episode < len(tracks):
                last = len(tracks) - 1
                raise ValueError(f"episode: expected 0 to {last} in {path}, got {episode}")
        return [tracks[episode] for episode in episodes]

    def _take_state(self, state: State, command: Command | None) -> None:
        drone = self._drone
        begins = command is None or bool(command.resets[drone])
        if command is not None and command.holds is not None and command.holds[drone]:
            return
        if begins:
            self._keep("cut off")
        elif not self._moments:  # stepped after its end: no flight
            return
        self._moments.append(self._moment(state))
        if not begins and (state.terminated[drone] or state.truncated[drone]):
            self._keep("terminated" if state.terminated[drone] else "truncated")

    def _moment(self, state: State) -> Moment:
        drone, step = self._drone, len(self._moments)
        return Moment.of(
            dict(zip(TELEMETRY_NAMES, state.telemetry[drone].tolist(), strict=True)),
            float(state.observations[drone, 0]),
            reward=float(state.rewards[drone]) if step else 0.0,
            step=step,
            episode=len(self._tracks),
        )

    def _keep(self, ending: Ending) -> None:
        """The episode is over; it counts if a step of it was flown."""
        if len(self._moments) > 1:
            period = self._hello.control_period
            track = Track(moments=self._moments, control_period=period, ending=ending)
            self._tracks.append(track)
        self._moments = []

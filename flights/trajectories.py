"""Trajectories: flown by a policy without exploration, over any env, or read from a journal."""

import copy
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import gymnasium as gym
import numpy as np

from ..agents.episodes import LOST
from ..agents.policies import Policy
from ..envs.autoreset import AdvancingVectorEnv, worlds_done
from ..envs.spec import Discrete, EnvSpec, canonical_id, component_names
from ..models.errors import InputError, expect
from ..udp.protocol.messages import Command, State

_EVALUATION: Final = 20230324  # the day the paper appeared

EpisodeSet = Literal["final", "curve", "tuning"]
"""Evaluation episodes that share no start: `final` for the figures that are reported, `curve` for
snapshots during training and all other looks at a policy, `tuning` for choosing settings."""

_SETS: Final[tuple[EpisodeSet, ...]] = ("final", "curve", "tuning")

Ending = Literal["terminated", "truncated", "cut off"]
"""`cut off`: the journal, or its agent, ended it."""


def evaluation_seed(episode: int, of: EpisodeSet = "curve") -> int:
    """Seed of an evaluation episode: the same for every agent, and of no training."""
    sequence = np.random.SeedSequence(_EVALUATION, spawn_key=(_SETS.index(of), episode))
    return int(sequence.generate_state(1, np.uint64)[0])


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """One episode of one drone, T control steps."""

    spec: EnvSpec
    telemetry: Mapping[str, np.ndarray]
    """Every telemetry array by name, float64, shape (T + 1, *shape): row k is after k control
    steps, row 0 the start. Units and frames are those of the spec."""
    rewards: np.ndarray
    """float64, shape (T,)."""
    actions: np.ndarray
    """float64, shape (T, *shape): row k is flown from row k of the telemetry."""
    ending: Ending
    episode: int = 0
    """Its number."""

    def __len__(self) -> int:
        """T."""
        return len(self.rewards)

    @property
    def seconds(self) -> float:
        """From its start to its end."""
        return len(self) * self.spec.control_period

    @property
    def terminated(self) -> bool:
        """Whether it ended by a crash or the like, not by the clock."""
        return self.ending == "terminated"

    @property
    def headline(self) -> np.ndarray:
        """The headline metric, shape (T + 1,); nan where the env names none."""
        return self._rows("metrics" if self.spec.headline else "")[:, 0]

    @property
    def mean_thrust(self) -> np.ndarray:
        """Mean over the rotors, N, shape (T + 1,); nan where the env does not tell it."""
        return np.asarray(self._rows("thrust").mean(axis=1))

    def _rows(self, name: str) -> np.ndarray:
        """Telemetry, shape (T + 1, n); a column of nan where there is none of that name."""
        array = self.telemetry.get(name, np.full(len(self) + 1, np.nan))
        return np.asarray(array).reshape(len(self) + 1, -1)

    def step_at(self, seconds: float) -> int:
        """Number of the row that is seen at that time; the last, from its end on."""
        # A time that is a whole number of periods but for its last bits belongs to that step.
        return min(max(int(seconds / self.spec.control_period + 1e-6), 0), len(self))


# ---- flown


def fly(env: gym.Env[Any, Any], policy: Policy | None, seed: int, episode: int = 0) -> Trajectory:
    """One episode of a policy in an env of one drone, local or remote; once more, if its simulator
    was lost. Without a policy, actions are drawn at random, the same for the same seed.
    """
    lost = True
    while lost:
        observation, info = env.reset(seed=seed)
        spec: EnvSpec = env.get_wrapper_attr("env_spec")  # of the simulator that came
        if policy is None:
            env.action_space.seed(seed)
        else:
            policy.reset()
        told, rewards, actions = [info], [], []
        terminated = truncated = lost = False
        while not (terminated or truncated or lost):
            action = env.action_space.sample() if policy is None else policy.act(observation)
            observation, reward, terminated, truncated, info = env.step(action)
            told.append(info)
            rewards.append(float(reward))
            actions.append(np.array(action, np.float64))
            lost = LOST in info
    telemetry = {}
    for array in spec.telemetry:
        names = component_names(array)
        rows = np.array([[info[name] for name in names] for info in told], np.float64)
        telemetry[array.name] = rows.reshape(len(told), *array.shape)
    ending: Ending = "terminated" if terminated else "truncated"
    return Trajectory(
        spec=spec, telemetry=telemetry, rewards=np.array(rewards), actions=np.array(actions),
        ending=ending, episode=episode,
    )  # fmt: skip


def fly_episodes(
    env: Any, policy: Policy | None, episodes: int, of: EpisodeSet = "curve", first: int = 0
) -> list[Trajectory]:
    """So many evaluation episodes of a set, from the number `first` on, in their order.

    The env has one drone, or is a vector env without autoreset. That one flies as many at a time as
    it has worlds, each drone with a copy of the policy and to the same bits as one after the other.
    Without a policy actions are random. An episode of several drones of one world gives a
    trajectory for each, in their order.
    """
    seeds = {first + i: evaluation_seed(first + i, of) for i in range(episodes)}
    if not isinstance(env, AdvancingVectorEnv):
        return [fly(env, policy, seed, episode) for episode, seed in seeds.items()]
    found: dict[int, list[Trajectory]] = {}
    while missing := [episode for episode in seeds if episode not in found]:
        batch = missing[: env.num_envs // len(env.env_spec.agents)]  # again those that were lost
        found |= _fly_batch(env, policy, {episode: seeds[episode] for episode in batch})
    return [trajectory for episode in seeds for trajectory in found[episode]]


def _fly_batch(
    env: AdvancingVectorEnv, policy: Policy | None, seeds: Mapping[int, int]
) -> dict[int, list[Trajectory]]:
    """At most W episodes, one in each world; those of a lost simulator are missing."""
    spec, count = env.env_spec, env.num_envs
    drones = len(spec.agents)
    policies = [copy.deepcopy(policy) for _ in range(len(seeds) * len(spec.agents))]
    for one in policies:
        if one is not None:
            one.reset()
    if isinstance(spec.action, Discrete):
        actions: np.ndarray = np.zeros(count, np.int64)
    else:
        actions = np.zeros((count, *spec.action.shape), np.float32)
    given = [seed for seed in seeds.values() for _ in spec.agents]
    env.reset(seed=[*given, *[0] * (count - len(given))])
    rows, rewards, taken = [env.telemetry], [], []
    lengths, terminated = np.zeros(count, int), np.zeros(count, bool)
    lost = env.lost.copy()
    done = lost | (np.arange(count) >= len(given))
    while not done.all():
        told: Any = env.observations
        for drone in np.flatnonzero(~done).tolist():
            own = {k: v[drone] for k, v in told.items()} if isinstance(told, dict) else told[drone]
            one = policies[drone]
            actions[drone] = env.single_action_space.sample() if one is None else one.act(own)
        env.advance(actions, np.zeros(count, bool), None, worlds_done(done, drones))
        rows.append(env.telemetry)
        rewards.append(env.rewards)
        taken.append(actions.astype(np.float64))
        lengths += ~done
        terminated |= env.terminated & ~done
        lost |= env.lost & ~done
        done = done | env.terminated | env.truncated
    arrays = _stacked(rows)
    totals = np.array(rewards, np.float64).reshape(len(rewards), count)
    chosen = np.array(taken).reshape(len(taken), *actions.shape)

    def flown(drone: int, episode: int) -> Trajectory:
        return Trajectory(
            spec=spec,
            telemetry={name: array[: lengths[drone] + 1, drone] for name, array in arrays.items()},
            rewards=totals[: lengths[drone], drone],
            actions=chosen[: lengths[drone], drone],
            ending="terminated" if terminated[drone] else "truncated",
            episode=episode,
        )

    return {
        episode: [flown(drone, episode) for drone in range(world * drones, (world + 1) * drones)]
        for world, episode in enumerate(seeds)
        if not lost[world * drones]
    }


def _stacked(rows: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {name: np.array([row[name] for row in rows], np.float64) for name in rows[0]}


def flown_trajectories(
    policy: Policy | None,
    env_id: str,
    options: Mapping[str, Any],
    episodes: Sequence[int],
    *,
    vehicle: str | Path | None = None,
    of: EpisodeSet = "curve",
    drones: int = 1,
) -> list[Trajectory]:
    """Evaluation episodes of a set by number, flown in process: see `fly` and, for several drones
    of one world, `fly_episodes`. The vehicle is a file or a name, None the paper's.
    """
    name = canonical_id(env_id)  # a checkpoint may name a module, which is not to be imported
    if drones > 1:
        from ..envs.vector import LocalVectorEnv  # which imports MuJoCo

        settings: dict[str, Any] = {"drones": drones, "vehicle": vehicle, **options}
        with closing(LocalVectorEnv(name, drones, autoreset_mode="Disabled", **settings)) as world:
            found = [fly_episodes(world, policy, 1, of, first=episode) for episode in episodes]
            return [trajectory for flown in found for trajectory in flown]
    made = gym.make(name, disable_env_checker=True, vehicle=vehicle, **options)
    with closing(made.unwrapped) as env:
        return [fly(env, policy, evaluation_seed(episode, of), episode) for episode in episodes]


# ---- recorded


def recorded_trajectories(
    path: Path, episodes: Sequence[int] | None = None, *, session: int | None = None, drone: int = 0
) -> list[Trajectory]:
    """Episodes of one drone (of the session, from 0) of one session of a journal of `--record`; one
    that a crash cut off is read up to the cut. Sessions are counted from 1, as `rotorgram replay`
    does; None is the first with a step in it.

    Episodes are given by number, None for all. They count, from 0, those of which a step is
    recorded: those that were given up and one that the journal's end cut off among them.

    Raises:
        InputError: It is no journal, or has no such session, drone or episode.
        OSError: It cannot be read.
    """
    from ..udp.journal.reader import Recording

    expect(path.is_file(), str(path), "a journal (.mcap)", "no such file")
    readers: dict[int, _Reader] = {}
    for item in Recording(path):
        found = item.session
        reader = readers.setdefault(found.index, _Reader(found.spec, found.num_envs, drone))
        if session in (None, found.index):
            reader.take(item.message)
    known = f"1 to {len(readers)}" if readers else "a journal with sessions"
    expect(session is None or session in readers, "session", known, f"{session} for {path}")
    flown = next((readers[index] for index in sorted(readers) if readers[index].has_steps), None)
    if flown is None:
        raise InputError(f"{path}: expected an episode with a step in it, got none")
    last = flown.num_envs - 1
    expect(0 <= drone <= last, "drone", f"0 to {last} in {path}", str(drone))
    flown.keep("cut off")
    expect(flown.found, str(path), f"an episode of drone {drone}", "none")
    last = len(flown.found) - 1
    for episode in episodes or ():
        expect(0 <= episode <= last, "episode", f"0 to {last} in {path}", str(episode))
    return flown.found if episodes is None else [flown.found[episode] for episode in episodes]


class _Reader:
    """Makes trajectories of what a journal has of one session. It keeps one drone's numbers."""

    def __init__(self, spec: EnvSpec, num_envs: int, drone: int) -> None:
        self.num_envs = num_envs
        self.found: list[Trajectory] = []
        self.has_steps = False
        """Of any drone."""
        self._spec, self._drone = spec, drone
        self._command: Any = None
        self._rows: list[dict[str, np.ndarray]] = []
        self._rewards: list[float] = []
        self._actions: list[np.ndarray] = []

    def take(self, message: Any) -> None:
        """The next message of the session."""
        command, drone = self._command, self._drone
        if isinstance(message, Command):
            self._command = message
        if not isinstance(message, State):
            return
        self.has_steps |= command is not None and not command.resets.all()
        if not 0 <= drone < self.num_envs or (command is not None and command.frozen[drone]):
            return
        begins = command is None or bool(command.resets[drone])
        if begins:
            self.keep("cut off")
        elif not self._rows:  # stepped after its end: no episode
            return
        named = zip(self._spec.telemetry, message.telemetry, strict=True)
        self._rows.append({array.name: np.array(told[drone]) for array, told in named})
        if not begins:
            self._rewards.append(float(message.rewards[drone]))
            self._actions.append(np.array(command.actions[drone], np.float64))
            if message.terminated[drone] or message.truncated[drone]:
                self.keep("terminated" if message.terminated[drone] else "truncated")

    def keep(self, ending: Ending) -> None:
        """The episode has ended; it counts if it has a step."""
        if self._rewards:
            self.found.append(
                Trajectory(
                    spec=self._spec, telemetry=_stacked(self._rows), ending=ending,
                    rewards=np.array(self._rewards), actions=np.array(self._actions),
                    episode=len(self.found),
                )
            )  # fmt: skip
        self._rows, self._rewards, self._actions = [], [], []

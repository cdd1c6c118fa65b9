"""Trajectories: the record of a flight that evaluations, journals, films, data sets and logs share.

`fly_episodes` flies a policy without exploration, in any vector env; `flights/recorded.py` reads
journals.
"""

import copy
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import field
from functools import cached_property
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ..agents.policies import Array, Observation, Policy
from ..envs.autoreset import AdvancingVectorEnv, worlds_done
from ..envs.config import EnvConfig
from ..envs.registry import is_known
from ..envs.spec import EnvSpec
from ..models import InputError
from ..models.fields import immutable
from ..scenes import SceneConfig
from ..scenes.returns import RANGES, Reading
from ..sim.state import some

if TYPE_CHECKING:
    from ..sim.sensors.range_sensors import RangeSensor

Floats = NDArray[np.float64]

_EVALUATION = 20230324  # the day the paper appeared
_SIZE = (40.0, 40.0)  # m: square about the z axis that counts of a scene without a size

EpisodeSet = Literal["final", "curve", "tuning"]
"""Evaluation episodes that share no start: `final` for the figures that are reported, `curve` for
snapshots during training and all other looks at a policy, `tuning` for choosing settings."""

Ending = Literal["terminated", "truncated", "cut off"]
"""`cut off`: the episode was given up, its simulator was lost, or the journal ends before it."""


def evaluation_seed(
    episode: int, of: EpisodeSet = "curve", training_seed: int | None = None
) -> int:
    """Seed of an evaluation episode: the same for every agent, and of no training.

    Policies of different training seeds fly from different starts if their seed is given.
    """
    key = [get_args(EpisodeSet).index(of), episode]
    if training_seed is not None:
        key.append(training_seed)
    sequence = np.random.SeedSequence(_EVALUATION, spawn_key=key)
    return int(sequence.generate_state(1, np.uint64)[0])


@immutable
class Trajectory:
    """One episode of one drone, T control steps. Row k of T + 1 rows is after k steps."""

    spec: EnvSpec
    telemetry: Mapping[str, Floats]
    """Every telemetry array by name, float64, shape (T + 1, *shape), in the spec's units."""
    rewards: Floats
    """float64, shape (T,)."""
    actions: Array
    """Shape (T, *shape), of the action's dtype; row k is flown from row k of the telemetry."""
    ending: Ending
    episode: int = 0
    """Its number."""
    observations: Mapping[str, Array] = field(default_factory=dict)
    """By name, shape (T + 1, *shape), of the spec's dtypes; empty where they were not asked for."""
    session: int = 1
    """Session of the journal, from 1, as `rotorgram replay` counts."""
    drone: int = 0
    """Drone of the session, from 0."""
    seed: int | None = None
    """Seed of the reset of its world; None where that continued its random numbers."""

    def __len__(self) -> int:
        return len(self.rewards)

    def row(self, step: int) -> Mapping[str, Floats]:
        """The telemetry after a step; from its end on that of the end."""
        return {name: array[min(step, len(self))] for name, array in self.telemetry.items()}

    @property
    def seconds(self) -> float:
        """Duration, s."""
        return len(self) * self.spec.control_period

    @property
    def times(self) -> Floats:
        """Time of each row since the start, s, shape (T + 1,)."""
        return np.arange(len(self) + 1, dtype=np.float64) * self.spec.control_period

    @property
    def terminated(self) -> bool:
        """Whether it ended by a crash or the like, not by the clock."""
        return self.ending == "terminated"

    @cached_property
    def config(self) -> EnvConfig | None:
        """Of its env; None where the task is not known here."""
        spec = self.spec
        if not is_known(spec.env_id):
            return None
        return EnvConfig.from_keywords(spec.env_id, **spec.options)

    @cached_property
    def _range_sensors(self) -> "list[RangeSensor]":
        """Sensors with rays that are among the observations."""
        if self.config is None:
            return []
        from ..sim.sensors import range_sensors_of  # which imports MuJoCo

        sensors = range_sensors_of(self.config.sensors, self.spec.control_period)
        return [sensor for sensor in sensors if sensor.name in self.observations]

    def readings(self, step: int) -> list[Reading]:
        """What sensors with rays among the observations read after so many steps. Their rays begin
        where the craft was when they were cast.
        """
        found = []
        late = int(self.drawn.get("drawn_observation_delay", 0))  # control steps
        for sensor in self._range_sensors:
            taken = sensor.taken(step - late)
            found.append(sensor.reading(self.observations[sensor.name][step], self.pose[taken]))
        return found

    @cached_property
    def drawn(self) -> Mapping[str, float]:
        """What was drawn for the episode, by name."""
        for array in self.spec.telemetry:
            if array.name == "drawn":
                values = self.telemetry["drawn"][0].tolist()
                return dict(zip(array.components, values, strict=True))
        return {}

    @cached_property
    def scene(self) -> SceneConfig:
        """What surrounded it, with its layout; what is not known here is plain."""
        scene = self.config.scene if self.config else SceneConfig()
        layout = self.telemetry.get("layout")
        return scene if layout is None else scene.with_seed(int(layout[0, 0]))

    @cached_property
    def pose(self) -> Floats:
        """Position, m, and quaternion from body to world, z up, shape (T + 1, 7).

        Raises `InputError` where the telemetry has no position or attitude.
        """
        self.spec.check_telemetry(("position", "attitude"), "pose")
        return np.concatenate((self.telemetry["position"], self.telemetry["attitude"]), axis=1)

    @property
    def headline(self) -> Floats:
        """The headline metric, shape (T + 1,); nan where the env names none."""
        if self.spec.headline is None:
            return np.full(len(self) + 1, np.nan)
        return self.telemetry["metrics"][:, 0]

    def step_at(self, seconds: float) -> int:
        """Number of the row at that time; the last, from its end on."""
        # A time that is a whole number of periods but for its last bits belongs to that step.
        step = int(seconds / self.spec.control_period + 1e-6)
        return min(max(step, 0), len(self))


def mean_traversability(flights: Iterable[Trajectory]) -> float:
    """How hard the layouts of some flights are, as of `Solids.traversability`, at the heights of
    their starts; nan where nothing stands, or a scene is not known here.
    """
    from ..scenes import Solids  # which imports MuJoCo

    found = []
    for flight in flights:
        with suppress(InputError):  # a scene's file, or the telemetry, is elsewhere
            solids = Solids.of_scene(flight.scene).standing()
            half = np.array(getattr(flight.scene.values, "size", _SIZE)) / 2
            height = flight.pose[0, 2]
            radius = flight.spec.constant("radius", "traversability")
            if len(solids):
                hard = solids.traversability(radius, (*-half, height), (*half, height))
                found.append(hard)
    return float(np.mean(found)) if found else np.nan


def common_scene(scenes: Iterable[SceneConfig]) -> SceneConfig:
    """The scene of all flights of a picture. Raises `InputError` where they differ."""
    different = set(scenes)
    if len(different) != 1:
        got = " and ".join(sorted(map(str, different)))
        raise InputError(f"scene: expected one for all flights of a picture, got {got}")
    return different.pop()


# ---- flown

Flights = list[Trajectory]
ByEpisode = dict[int, Flights]


def fly_episodes(
    env: AdvancingVectorEnv,
    policy: Policy | None,
    episodes: int,
    of: EpisodeSet = "curve",
    first: int = 0,
    training_seed: int | None = None,
    observations: Collection[str] = (),
) -> Flights:
    """Evaluation episodes of a set, from the number `first` on, in their order.

    The env, without autoreset, flies as many at a time as it has worlds, each drone with a copy of
    the policy and to the same bits as one after the other. An episode whose simulator was lost is
    flown again. Without a policy, actions are drawn at random, the same for the same episode. An
    episode of several drones of one world gives a trajectory for each, in their order. Trajectories
    get the observations of these names.
    """
    numbers = range(first, first + episodes)
    seeds = {number: evaluation_seed(number, of, training_seed) for number in numbers}
    flown: ByEpisode = {}
    worlds = env.num_envs // len(env.env_spec.agents)
    while missing := [episode for episode in seeds if episode not in flown]:
        batch = {episode: seeds[episode] for episode in missing[:worlds]}
        flown |= _fly_batch(
            env, policy, batch, observations
        )  # without episodes whose simulator was lost
    return [trajectory for episode in seeds for trajectory in flown[episode]]


def _fly_batch(
    env: AdvancingVectorEnv,
    policy: Policy | None,
    seeds: Mapping[int, int],
    observations: Collection[str],
) -> ByEpisode:
    """At most W episodes, one in each world, by number; those of a lost simulator are missing."""
    drones = len(env.env_spec.agents)
    policies = _begun(env, policy, seeds)
    used = len(policies)
    wanted = [array.name for array in env.env_spec.observation if array.name in observations]
    told = [env.told()]
    seen = [_seen(env, wanted)]
    rewards = []
    actions = []
    lengths = np.zeros(env.num_envs, int)
    terminated = np.zeros(env.num_envs, bool)
    lost = env.lost
    done = lost | (np.arange(env.num_envs) >= used)
    while flying := np.flatnonzero(~done).tolist():
        frozen = worlds_done(done, drones) if some(done) else None
        ended = np.zeros_like(done)
        while not some(ended):
            chosen = act_each(env, policies, flying)
            env.advance(chosen, frozen=frozen)
            told.append(env.told())
            seen.append(_seen(env, wanted))
            rewards.append(env.rewards)
            actions.append(chosen)
            ended = (env.terminated | env.truncated) & ~done
        lengths[ended] = len(rewards)
        terminated = terminated | (env.terminated & ended)
        lost = lost | (env.lost & ended)
        done = done | ended
    telemetry, _ = told[0].read([step.moment for step in told])
    observed = {name: np.array([row[name] for row in seen]) for name in wanted}
    all_rewards = np.array(rewards)
    all_actions = np.array(actions)
    episodes = list(seeds)
    flown: ByEpisode = {}
    # A world that lost one of its drones is flown again.
    spoiled = lost.reshape(-1, drones).any(axis=1).repeat(drones)
    for drone in np.flatnonzero(~spoiled[:used]).tolist():
        episode = episodes[drone // drones]
        steps = lengths[drone]
        trajectory = Trajectory(
            spec=env.env_spec,
            observations={name: rows[: steps + 1, drone] for name, rows in observed.items()},
            telemetry={name: rows[: steps + 1, drone] for name, rows in telemetry.items()},
            rewards=all_rewards[:steps, drone],
            actions=all_actions[:steps, drone],
            ending="terminated" if terminated[drone] else "truncated",
            episode=episode,
            drone=drone % drones,
            seed=seeds[episode],
        )
        flown.setdefault(episode, []).append(trajectory)
    return flown


def _begun(
    env: AdvancingVectorEnv, policy: Policy | None, seeds: Mapping[int, int]
) -> list[Policy | None]:
    """Begin an episode in each of the first worlds; policies of their drones."""
    of_drones = [seed for seed in seeds.values() for _ in env.env_spec.agents]
    policies = [copy.deepcopy(policy) for _ in of_drones]
    for own in policies:
        if own is not None:
            own.reset()
    env.single_action_space.seed(of_drones[0])
    env.reset(seed=of_drones + [0] * (env.num_envs - len(of_drones)))
    return policies


def _seen(env: AdvancingVectorEnv, wanted: Sequence[str]) -> Mapping[str, Array]:
    """Some arrays of the present observations."""
    seen = env.observations
    if not isinstance(seen, Mapping):
        seen = dict.fromkeys(wanted, seen)
    return {name: seen[name] for name in wanted}


def act_each(
    env: AdvancingVectorEnv, policies: Sequence[Policy | None], flying: Sequence[int]
) -> Array:
    """Actions of the drones that fly, by their numbers, each by its own policy, or at random where
    that is None; 0 for the others.
    """
    space = env.single_action_space
    actions = np.zeros((env.num_envs, *(space.shape or ())), space.dtype)
    for drone in flying:
        policy = policies[drone]
        action = space.sample() if policy is None else policy.act(_seen_by(drone, env.observations))
        if np.shape(action) != space.shape:
            raise InputError(
                f"{type(policy).__name__.lower()}: expected an action of shape {space.shape}, "
                f"got {np.shape(action)}"
            )
        actions[drone] = action
    return actions


def _seen_by(drone: int, observations: Observation) -> Observation:
    """Its own observation."""
    if isinstance(observations, Mapping):
        return {name: values[drone] for name, values in observations.items()}
    own: Array = observations[drone]
    return own


def flown_trajectories(
    policy: Policy | None,
    config: EnvConfig,
    episodes: Sequence[int],
    of: EpisodeSet = "curve",
    training_seed: int | None = None,
    observations: Collection[str] = RANGES,
) -> Flights:
    """Evaluation episodes of a set by number, flown in process as by `fly_episodes`; with the
    readings of sensors with rays.
    """
    from ..envs.vector import LocalVectorEnv  # which imports MuJoCo

    found: Flights = []
    with closing(LocalVectorEnv(config, config.drones, autoreset_mode="Disabled")) as world:
        for episode in episodes:
            found += fly_episodes(world, policy, 1, of, episode, training_seed, observations)
    return found

"""Drones in remote simulators as Gymnasium envs of the agent: one drone, or many."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Unpack

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import ArrayLike

from ..envs.actions import Actions, Asking
from ..envs.autoreset import (
    LOST,
    AdvancingVectorEnv,
    Observation,
    Seed,
    Step,
    checked_mask,
    checked_mode,
    checked_seeds,
    worlds_done,
)
from ..envs.info import Info
from ..envs.spaces import action_space, joined, observation_space, telemetry_names
from ..envs.spec import ArraySpec, EnvSpec
from ..models.errors import InputError, NotCopied
from ..models.fields import Limits, OrNone, check, check_names
from .protocol.client import Address
from .protocol.layout import DRONES, MAX_DRONES, Array
from .protocol.messages import FLY, FREEZE, MAX_UINT64, RESET
from .protocol.statistics import Statistics
from .transport.agent import Agent, AgentConfig, AgentSettings
from .transport.simulator import DEFAULT_AGENT

Arrays = dict[str, Array]
_FLY = np.array([FLY], np.uint8)
_RESET = np.array([RESET], np.uint8)


class _Remote(Asking, NotCopied):
    """Base of both envs: the `Agent` behind them, and actions as they cross the wire."""

    _agent: Agent
    _flying = False

    def _open(self, address: Address, config: AgentConfig, connect: bool) -> None:
        """Listen, and wait for simulators; without success nothing stays open."""
        self._agent = Agent(address, config)
        if connect:
            try:
                self.connect()
            except BaseException:
                self._agent.close()
                raise

    def close_extras(self, **kwargs: object) -> None:
        """Tell the simulators and close the socket. May be called again."""
        self._agent.close()
        self._flying = False

    def _expect_flight(self) -> None:
        """Raise `ResetNeeded` where no reset has begun a flight."""
        if not self._flying:
            raise gym.error.ResetNeeded("step: expected a call of reset() first")

    @abstractmethod
    def connect(self) -> None:
        """Wait until it is the agent's turn: for the simulators' first States, if none has come."""

    @property
    def address(self) -> Address:
        """Address that this side listens on."""
        return self._agent.address

    @property
    def statistics(self) -> Statistics:
        """Counts and round trips of the wire, over all simulators."""
        return self._agent.server.statistics

    def _take_actions(self, spec: EnvSpec, drones: int) -> None:
        """Keep the check of actions of so many drones, and actions that do nothing."""
        self._actions = Actions.of(spec.action, drones)
        self._nothing: Array = np.zeros(self._actions.shape, self._actions.dtype)


class RemoteEnv(_Remote, gym.Env[Observation, ArrayLike]):
    """A drone in a remote simulator, flown in lock-step over UDP.

    The simulator may start before or after. Its Hello brings the spec of its env, and the spaces
    follow from that: this side needs neither the env's code nor MuJoCo. A text simulator says no
    Hello, and is read by the spec of `env_id` with `options` and the paper's vehicle: this side
    makes that env, so the id must be registered here.
    Observations, rewards, ends of episodes and telemetry are those of the env in the simulator, bit
    for bit; `info` carries the telemetry by its components.

    A simulator that is killed and started again, or another one that comes in its place, goes on:
    the running episode ends as truncated, with the observation before it, reward 0 and the reason
    in `info["simulator_lost"]`. If none comes, `PeerSilent` is raised; the next `reset` waits
    again. The simulator is told when the env is closed, garbage-collected, or its program ends.

    Args:
        address: Address (host, port) to listen on; port 0 takes a free one (see `address`).
        connect: Wait for the simulator now. Otherwise `connect` or the first `reset` waits.
        env_id: A simulator of another env is refused; None flies any.
        options: A simulator of other options is refused; None takes any. Those that are not given
            have their defaults if the env is registered here, and any value otherwise.
        vehicle_hash: A simulator of another vehicle is refused; None takes any.
        connect_timeout: Longest wait for a simulator, s, the first or one that replaces another,
            its compilation included; 60.
        timeout: Longest wait for an answer from it, s, before another may take its slot; 30. While
            it computes, it says so.
        key_file: File with the key that the simulators have too (`rotorgram key`). With it any
            address is allowed, because only holders of the key can take part.
        insecure: Allow an address that is not loopback without a key.
        record: MCAP file to write every message to; it must not exist.

    Attributes:
        env_spec: The `EnvSpec` of the env, once a simulator has come.
        control_period: Time of a step, s, likewise.

    Raises:
        InputError: An address, option, key file, action or seed is not what it should be; nothing
            was sent.
        OSError: The port is in use.
        PeerSilent: No simulator came, or it fell silent and no other came.
        PeerClosed: The simulator ended the exchange.
        gymnasium.error.ResetNeeded: A step before a reset, or after an episode's end.
        gymnasium.error.ClosedEnvironmentError: A reset after `close`.
    """

    def __init__(
        self,
        address: Address = DEFAULT_AGENT,
        *,
        connect: bool = True,
        **settings: Unpack[AgentSettings],
    ) -> None:
        self._open(address, AgentConfig(drones=1, slots=1, **settings), connect)

    def connect(self) -> None:
        self._take_spec(self._agent.connect())

    def reset(
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[Observation, Info]:
        """Start an episode in the simulator, with its generator seeded where a seed is given."""
        check("seed", OrNone(Limits(0, MAX_UINT64, whole=True)), seed)
        if options:
            raise InputError(f"options: expected none over UDP, got {options}")
        super().reset(seed=seed)
        self._flying = False
        self.connect()
        seeds = None if seed is None else np.array([seed], np.uint64)
        while True:
            self._agent.exchange({0: (self._nothing, _RESET, seeds, None)})
            if not self._agent.lost[0]:
                break  # else one has come instead that was not reset
        self._flying = True
        self._state = self._agent.states[0]
        return self._observation(), self._info()

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, Info]:
        """Fly for one control period. The action is sent in the dtype of its space."""
        if not self._flying:
            raise gym.error.ResetNeeded("step: expected a call of reset() first")
        usual = self._nothing
        actions = np.asarray(action)[np.newaxis]
        if actions.dtype != usual.dtype or actions.shape != usual.shape:
            actions = self._actions.checked(action)
        self._flying = False  # until the answer is there
        try:
            self._agent.exchange({0: (actions, _FLY, None, self._taken_asks())})
        except InputError:  # an action that is wrong, and nothing has happened
            self._flying = True
            raise
        if reason := self._agent.lost[0]:
            return self._observation(), 0.0, False, True, {**self._info(), LOST: reason}
        self._state = state = self._agent.states[0]
        terminated = state.terminated.item()
        truncated = state.truncated.item()
        self._flying = not (terminated or truncated)
        return self._observation(), state.rewards.item(), terminated, truncated, self._info()

    def close(self) -> None:
        self.close_extras()

    def _take_spec(self, spec: EnvSpec) -> None:
        """Set spaces and other attributes. Spaces that stay may have seeded generators."""
        if getattr(self, "env_spec", None) == spec:
            return
        self.env_spec = spec
        self.control_period = spec.control_period
        self.observation_space = observation_space(spec)
        self.action_space = action_space(spec)
        self.metadata = {"render_modes": [], "render_fps": spec.fps}
        self._arrays = tuple(array.name for array in spec.observation)
        self._names = telemetry_names(spec)
        self._take_actions(spec, 1)

    def _observation(self) -> Observation:
        """As the space has it, a copy."""
        arrays = self._state.observations
        if len(arrays) == 1:
            return np.array(arrays[0][0])
        return {name: np.array(a[0]) for name, a in zip(self._arrays, arrays, strict=True)}

    def _info(self) -> Info:
        numbers: list[float] = []
        for array in self._state.telemetry:
            numbers += array.ravel().tolist()
        return dict(zip(self._names, numbers, strict=True))


class RemoteVectorEnv(_Remote, AdvancingVectorEnv, VectorEnv[Observation, ArrayLike, Array]):
    """The M · N drones of M simulators with N drones each, in lock-step over one socket.

    The simulators may be on any machines, and come in any order: each takes the first slot that is
    free, and one that comes too late waits until another leaves. Drone i of slot p is env
    p · N + i. A slow simulator delays the others and changes nothing else.

    With SAME_STEP a step in which an episode ends takes a second round trip, in which the other
    drones are frozen. `info` has the telemetry, an array for each component.

    A simulator that is lost is replaced by the next that comes. The running episodes of its drones
    end as truncated, with the observation before, reward 0 and the reason in
    `info["simulator_lost"]`, with SAME_STEP in `final_info` too. The other slots wait meanwhile.

    Args:
        address: Address (host, port) to listen on; port 0 takes a free one.
        num_simulators: M.
        num_envs: Drones in all, M · N; a simulator with another share of them is refused. None: N
            is that of the first simulator that comes.
        autoreset_mode: `AutoresetMode`, or its value.
        connect: Wait for the simulators now. Otherwise `connect` or the first `reset` waits.
        Others: As `RemoteEnv`.

    Raises:
        PeerSilent: A slot stayed free for `connect_timeout`.
        PeerClosed: The last simulator ended the exchange.
        gymnasium.error.ResetNeeded: A step before every drone was reset, or (DISABLED) after an
            episode's end.
        Exception: All others as `RemoteEnv`.
    """

    def __init__(
        self,
        address: Address = DEFAULT_AGENT,
        *,
        num_simulators: int = 1,
        num_envs: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        connect: bool = True,
        **settings: Unpack[AgentSettings],
    ) -> None:
        self.closed = True  # nothing is open yet
        self.num_envs = 0
        self._arrays: Arrays = {}
        self.telemetry: Arrays = {}
        self._reasons: Array | None = None  # of simulators that were lost in this step
        self.metadata = {"render_modes": [], "autoreset_mode": checked_mode(autoreset_mode)}
        self.num_simulators: int = check("num_simulators", DRONES, num_simulators)
        drones = None
        if num_envs is not None:
            most = num_simulators * MAX_DRONES
            whole: int = check("num_envs", Limits(1, most, whole=True), num_envs)
            drones, left = divmod(whole, num_simulators)
            if left:
                raise InputError(
                    f"num_envs: expected a multiple of num_simulators = {num_simulators}, "
                    f"got {num_envs}"
                )
            self.num_envs = whole
        config = AgentConfig(drones=drones, slots=num_simulators, **settings)
        self._open(address, config, connect)
        self.closed = False

    def connect(self) -> None:
        spec = self._agent.connect()
        num_envs = self.num_simulators * (self._agent.config.drones or 1)
        self._take_spec(spec, num_envs, self.metadata["autoreset_mode"])
        self._take_actions(spec, num_envs)
        self._shape = self.num_simulators, num_envs // self.num_simulators

    def reset(self, *, seed: Seed = None, options: Info | None = None) -> tuple[Observation, Info]:
        """Begin an episode, for all drones or some.

        Where none is under way, before the first reset or after an error, a step wants a reset of
        every drone: with several masks too, as of the vector envs in process.

        Args:
            seed: Drone i gets seed + i, or the i-th of N seeds; None leaves its generator as it is.
            options: `reset_mask`: bool, shape (N,): which drones; the others are frozen.
        """
        options = options or {}
        check_names(options, ("reset_mask",), "options")
        in_flight = "reset_mask" in options and self._flying
        if not in_flight:
            self.connect()
        mask = checked_mask(options.get("reset_mask"), self.num_envs)
        seeds = self._seeds(seed)
        self._reasons = None
        if not in_flight:
            self.done = self.out = self._nobody
            self._idle = self._everybody  # those that no reset has begun
            self._flying = True
        self.advance(self._nothing, mask, seeds, ~mask)
        return self.observations, self._info(mask)

    def step(self, actions: ArrayLike) -> Step:
        """Fly every drone for one control period. The autoreset says what follows an episode."""
        self._expect_flight()
        self._reasons = None
        return super().step(actions)

    def advance(
        self,
        actions: ArrayLike,
        resets: Array | None = None,
        seeds: Seed = None,
        frozen: Array | None = None,
    ) -> None:
        """Reset some drones, freeze some, and fly the others: see `AdvancingVectorEnv`.

        With seeds every drone has one, also where it is ignored.
        """
        self._expect_flight()
        resets = self._nobody if resets is None else resets
        frozen = self._nobody if frozen is None else frozen & ~resets
        still = resets | frozen
        grounded = self.done | self._idle
        waiting = grounded & ~still
        if waiting.any():
            first = int(waiting.argmax())
            raise gym.error.ResetNeeded(f"step: expected a call of reset() for env {first} first")
        sent = np.array(self._actions.checked(actions, ~still))
        sent[still] = 0
        before = self._arrays, self.telemetry
        reasons = self._exchange(sent, resets, self._seeds(seeds), frozen)
        self._take_states(still)
        self.lost = (reasons != "") & ~(resets | grounded | self.out)
        if self.lost.any():
            self._break_off(before, reasons)
        self.out = self.terminated | self.truncated | (self.out & ~resets)
        self.done = worlds_done(self.out, len(self.env_spec.agents))
        self._idle = self._idle & ~resets
        self._flying = True
        if self.observer is not None:
            self.observer(self, resets)

    def _exchange(
        self,
        actions: Array,
        resets: Array,
        seeds: Array | None,
        frozen: Array,
    ) -> Array:
        """One exchange with each simulator; why that of each drone was lost, or "", shape (N,)."""
        asleep: Array = np.all(self._by_slot(frozen), axis=1)
        pending = np.flatnonzero(~asleep).tolist()
        reasons = [""] * self.num_simulators
        asks = self._taken_asks()
        self._flying = False  # until the answers are there
        while pending:
            orders = (RESET * resets + FREEZE * frozen).astype(np.uint8)
            arrays = map(self._by_slot, (actions, orders, seeds, asks))
            parts = list(zip(*arrays, strict=True))
            self._agent.exchange({slot: parts[slot] for slot in pending})
            asks = None
            lost = self._agent.lost
            reasons = [new or old for new, old in zip(lost, reasons, strict=True)]
            if seeds is None:
                break
            # A simulator in place of a lost one knows no seeds.
            starting: Array = np.any(self._by_slot(resets), axis=1)
            pending = [slot for slot, reason in enumerate(lost) if reason and starting[slot]]
            actions = self._nothing
            frozen = ~resets
        return np.repeat(np.array(reasons, object), self._shape[1])

    def _by_slot(self, array: Array | None) -> Array:
        """An array of all drones as rows of each simulator, shape (M, N / M, ...); None for each,
        where there is none.
        """
        if array is None:
            return np.full(self.num_simulators, None)
        return array.reshape(*self._shape, *array.shape[1:])

    def _break_off(self, before: tuple[Arrays, Arrays], reasons: Array) -> None:
        """Truncate the episodes of lost drones: these States are the start of the next ones."""
        for now, then in zip((self._arrays, self.telemetry), before, strict=True):
            for name, array in now.items():
                array[self.lost] = then[name][self.lost]
        self.rewards[self.lost] = 0.0
        self.terminated[self.lost] = False
        self.truncated[self.lost] = True
        earlier = np.full(self.num_envs, None) if self._reasons is None else self._reasons
        self._reasons = np.where(self.lost, reasons, earlier)

    def _seeds(self, seed: Seed) -> Array | None:
        """Seeds as they cross the wire. Raises `InputError`."""
        seeds = checked_seeds(seed, self.num_envs, MAX_UINT64)
        return None if seeds is None else np.array(seeds, np.uint64)

    def _take_states(self, still: Array) -> None:
        """Take over the States; rewards and flags are 0 for the drones that did not fly."""
        states = [self._agent.states[slot] for slot in range(self.num_simulators)]
        spec = self.env_spec
        self._arrays = _by_name(spec.observation, [state.observations for state in states])
        self.observations = joined(spec, self._arrays)
        self.telemetry = _by_name(spec.telemetry, [state.telemetry for state in states])
        self.rewards = np.where(still, 0.0, np.concatenate([s.rewards for s in states]))
        self.terminated = np.concatenate([s.terminated for s in states]) & ~still
        self.truncated = np.concatenate([s.truncated for s in states]) & ~still

    def _losses(self) -> Info:
        reasons = self._reasons
        return {} if reasons is None else {LOST: reasons, f"_{LOST}": reasons != None}  # noqa: E711


def _by_name(specs: Sequence[ArraySpec], states: Sequence[Sequence[Array]]) -> Arrays:
    """The arrays of several simulators, one after the other."""
    parts = zip(*states, strict=True)
    return {spec.name: np.concatenate(part) for spec, part in zip(specs, parts, strict=True)}

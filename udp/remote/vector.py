"""The drones of one or many remote simulators as one vector env of the agent."""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from ...envs.autoreset import AdvancingVectorEnv, Seeds, checked_mask, checked_seeds
from ...envs.spaces import joined
from ...envs.spec import Discrete, EnvSpec
from ...models.errors import InputError
from ..protocol.client import Address
from ..protocol.layout import MAX_DRONES
from ..protocol.messages import FREEZE, MAX_UINT64, RESET
from ..transport.agent import Agent, AgentConfig, Order
from ..transport.simulator import DEFAULT_AGENT
from .served import LOST, ServedEnv, action_dtype, checked_actions

__all__ = ["RemoteVectorEnv"]


class RemoteVectorEnv(ServedEnv, AdvancingVectorEnv):
    """The M · N drones of M simulators with N drones each, in lock-step over one socket.

    The simulators may be on any machines, and come in any order: each takes the first slot that is
    free, and one that comes too late waits until another leaves. Drone i of slot p is env
    p · N + i. A slow simulator delays the others and changes nothing else.

    Autoreset is Gymnasium's NEXT_STEP (the default), SAME_STEP or DISABLED, as of the vector envs
    in process; with SAME_STEP a step in which an episode ends takes a second round trip, in which
    the other drones are frozen. `info` has the telemetry, an array for each component.

    A simulator that is lost is replaced by the next that comes. The running episodes of its drones
    end as truncated, with the observation before, reward 0 and the reason in
    `info["simulator_lost"]`. The other slots wait meanwhile.

    Args:
        address: Address (host, port) to listen on; port 0 takes a free one.
        num_simulators: M.
        num_envs: Drones in all, M · N; a simulator with another share of them is refused. None: N
            is that of the first simulator that comes.
        autoreset_mode: `AutoresetMode`, or its value.
        connect: Wait for the simulators now. Otherwise `connect` or the first `reset` waits.
        env_id, options, vehicle_hash, connect_timeout, timeout, max_datagram: As `RemoteEnv`.
        key_file, insecure, record: As `RemoteEnv`.

    Raises:
        InputError: An address, number, option, key file, action or seed is not what it should be;
            nothing was sent.
        OSError: The port is in use.
        PeerSilent: A slot stayed free for `connect_timeout`.
        PeerClosed: The last simulator ended the exchange.
        gymnasium.error.ResetNeeded: A step before every drone was reset, or (DISABLED) after an
            episode's end.
        gymnasium.error.ClosedEnvironmentError: A reset after `close`.
    """

    def __init__(
        self,
        address: Address = DEFAULT_AGENT,
        *,
        num_simulators: int = 1,
        num_envs: int | None = None,
        env_id: str | None = None,
        options: Mapping[str, Any] | None = None,
        vehicle_hash: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        connect: bool = True,
        connect_timeout: float = 60.0,
        timeout: float = 30.0,
        max_datagram: int | None = None,
        key_file: Path | str | None = None,
        insecure: bool = False,
        record: Path | str | None = None,
    ) -> None:
        self.closed = True  # nothing is open yet
        if type(num_simulators) is not int or not 1 <= num_simulators <= MAX_DRONES:
            raise InputError(f"num_simulators: expected 1 to {MAX_DRONES}, got {num_simulators!r}")
        most = num_simulators * MAX_DRONES
        if num_envs is not None and (
            type(num_envs) is not int or not 1 <= num_envs <= most or num_envs % num_simulators
        ):
            raise InputError(
                f"num_envs: expected a multiple of num_simulators = {num_simulators}, at most "
                f"{most}, got {num_envs!r}"
            )
        self.num_simulators, self.num_envs = num_simulators, num_envs or 0
        self._broken: tuple[np.ndarray, np.ndarray] | None = None
        self._mode = autoreset_mode
        self._flying = False
        config = AgentConfig(
            env_id=env_id,
            options=options,
            vehicle_hash=vehicle_hash,
            worlds=num_envs // num_simulators if num_envs else None,
            slots=num_simulators,
            connect_timeout=connect_timeout,
            timeout=timeout,
            max_datagram=max_datagram,
            key_file=key_file,
            insecure=insecure,
            record=record,
        )
        self.metadata = {"render_modes": [], "autoreset_mode": _checked_mode(autoreset_mode)}
        self._agent = Agent(address, config)
        self.closed = False
        if connect:
            try:
                self.connect()
            except BaseException:
                self.close()
                raise

    def connect(self) -> None:
        """Wait until every slot is taken."""
        self._agent.connect()
        self._take(self._spec_that_came())

    def reset(
        self, *, seed: int | Seeds | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode, for all drones or some.

        Where none is under way, before the first reset or after an error, a step wants a reset of
        every drone: with several masks too, as of the vector envs in process.

        Args:
            seed: Drone i gets seed + i, or the i-th of N seeds; None leaves its generator as it is.
            options: `reset_mask`: bool, shape (N,): which drones; the others are frozen.
        """
        options = options or {}
        if unknown := [name for name in options if name != "reset_mask"]:
            raise InputError(f"options: expected reset_mask or none over UDP, got {unknown[0]!r}")
        if "reset_mask" in options and self._flying:
            mask = checked_mask(options["reset_mask"], self.num_envs)
            self.advance(self._nothing, mask, self._seeds(seed), ~mask)
            return self.observations, self._info(mask)
        self._flying = False
        self.connect()
        mask, seeds = checked_mask(options.get("reset_mask"), self.num_envs), self._seeds(seed)
        self._reset_until_done(mask, seeds)
        self.done, self._idle = np.zeros(self.num_envs, bool), ~mask
        self._flying = True
        self._take_states(np.ones(self.num_envs, bool))
        return self.observations, self._info(mask)

    def step(self, actions: Any) -> Any:
        """Fly every drone for one control period; what follows an episode, the autoreset says."""
        if not self._flying:
            raise gym.error.ResetNeeded("step: expected a call of reset() first")
        return super().step(actions)

    def advance(
        self,
        actions: np.ndarray,
        resets: np.ndarray | None = None,
        seeds: Seeds | None = None,
        frozen: np.ndarray | None = None,
    ) -> None:
        """Reset some drones, freeze some, and fly the others: see `AdvancingVectorEnv`."""
        if not self._flying:
            raise gym.error.ResetNeeded("step: expected a call of reset() first")
        nobody = np.zeros(self.num_envs, bool)
        resets, frozen = nobody if resets is None else resets, nobody if frozen is None else frozen
        grounded = self.done | self._idle
        if (waiting := grounded & ~(resets | frozen)).any():
            first = int(waiting.argmax())
            raise gym.error.ResetNeeded(f"step: expected a call of reset() for env {first} first")
        sent = self._sent(actions, resets | frozen)
        numbers = None if seeds is None else np.asarray(seeds, np.uint64)
        rows: np.ndarray = np.all(frozen.reshape(self._shape), axis=1)
        slots = [slot for slot in range(self.num_simulators) if not rows[slot]]
        self._flying = False  # until the answers are there
        self._agent.exchange(self._orders(slots, sent, resets, numbers, frozen))
        lost = self._agent.lost
        if any(lost) and seeds is not None:  # a simulator in place of a lost one knows none
            lost = self._reset_until_done(resets, numbers, lost)
        before, telemetry = self._arrays, self.telemetry
        self._take_states(resets | frozen)
        reasons = np.repeat(np.array(lost, object), self._shape[1])
        broken = (reasons != "") & ~resets & ~grounded
        if broken.any():  # these States are the start of the next episodes
            for now, then in ((self._arrays, before), (self.telemetry, telemetry)):
                for name, array in now.items():
                    array[broken] = then[name][broken]
            self.rewards[broken] = 0.0
            self.terminated[broken] = False
            self.truncated[broken] = True
            reasons[~broken] = None
            self._broken, self.lost = (reasons, broken), broken.copy()
        self.done = self.terminated | self.truncated | (self.done & ~resets)
        self._idle = self._idle & ~resets
        self._flying = True

    def close_extras(self, **kwargs: Any) -> None:
        """Tell the simulators and close the socket."""
        self._agent.close()
        self._flying = False

    def _take(self, spec: EnvSpec) -> None:
        """Set spaces and other attributes from the spec."""
        worlds = self._agent.worlds
        num_envs = self.num_simulators * worlds * len(spec.agents)
        self._take_spec(spec, num_envs, self._mode)
        self._shape = self.num_simulators, num_envs // self.num_simulators
        self._dtype = action_dtype(spec)
        self._row = () if isinstance(spec.action, Discrete) else spec.action.shape
        self._nothing: np.ndarray = np.zeros((num_envs, *self._row), self._dtype)
        if not self._flying:
            self.done = np.zeros(num_envs, bool)
            self._idle = np.ones(num_envs, bool)  # those that no reset has begun

    def _seeds(self, seed: Any) -> np.ndarray | None:
        seeds = checked_seeds(seed, self.num_envs, MAX_UINT64)
        return None if seeds is None else np.array(seeds, np.uint64)

    def _reset_until_done(
        self, resets: np.ndarray, seeds: np.ndarray | None, lost: list[str] | None = None
    ) -> list[str]:
        """Reset drones, again where another simulator comes meanwhile; which were lost, and why.

        Args:
            resets: Which, bool, shape (N,).
            seeds: Of all drones, or None.
            lost: For each slot why its simulator was lost before; None: all are to be reset.
        """
        wanted: np.ndarray = np.any(resets.reshape(self._shape), axis=1)
        reasons = lost or [""] * self.num_simulators
        anew = [not lost or bool(reason) for reason in reasons]
        while slots := [s for s in range(self.num_simulators) if anew[s] and wanted[s]]:
            self._agent.exchange(self._orders(slots, self._nothing, resets, seeds, ~resets))
            reasons = [new or old for new, old in zip(self._agent.lost, reasons, strict=True)]
            anew = [bool(reason) for reason in self._agent.lost]
        return reasons

    def _orders(
        self,
        slots: Collection[int],
        actions: np.ndarray,
        resets: np.ndarray,
        seeds: np.ndarray | None,
        frozen: np.ndarray,
    ) -> dict[int, Order]:
        """Order of each simulator. The arrays are those of all drones."""
        orders = (RESET * resets + FREEZE * frozen).astype(np.uint8).reshape(self._shape)
        rows = actions.reshape(*self._shape, *self._row)
        numbers = None if seeds is None else seeds.reshape(self._shape)
        return {
            slot: (rows[slot], orders[slot], None if numbers is None else numbers[slot])
            for slot in slots
        }

    def _take_states(self, still: np.ndarray) -> None:
        """Take over the States; rewards and flags are 0 for the drones that did not fly."""
        states = [state for state in self._agent.states if state]
        spec = self.env_spec
        self._arrays = {
            array.name: np.concatenate([state.observations[i] for state in states])
            for i, array in enumerate(spec.observation)
        }
        self.observations = joined(spec, self._arrays)
        self.telemetry = {
            array.name: np.concatenate([state.telemetry[i] for state in states])
            for i, array in enumerate(spec.telemetry)
        }
        self.rewards = np.where(still, 0.0, np.concatenate([s.rewards for s in states]))
        self.terminated = np.concatenate([s.terminated for s in states]) & ~still
        self.truncated = np.concatenate([s.truncated for s in states]) & ~still
        self._broken = None
        self.lost = np.zeros(self.num_envs, bool)

    def _sent(self, actions: np.ndarray, idle: np.ndarray) -> np.ndarray:
        """Actions as they cross the wire; those of drones that do not fly are 0."""
        shape = (self.num_envs, *self._row)
        array = np.asarray(actions)
        if isinstance(self.env_spec.action, Discrete):
            if array.shape == (self.num_envs, 1):
                array = array[:, 0]
            if idle.any():
                array = np.where(idle, 0, array)
            if array.dtype.kind == "f" and (array % 1 == 0).all():
                array = array.astype(np.int64)
        sent = checked_actions(array, self._dtype, shape)
        if idle.any() and sent.shape == shape:
            sent = sent.copy()
            sent[idle] = 0
        if self._dtype.kind == "f" and not (finite := np.isfinite(sent)).all():
            first = np.argwhere(~finite)[0].tolist()
            raise InputError(f"action: expected finite numbers, got {sent[*first]} at {first}")
        if isinstance(self.env_spec.action, Discrete):
            wrong = (sent < 0) | (sent >= self.env_spec.action.n)
            if wrong.any():
                last = self.env_spec.action.n - 1
                raise InputError(f"action: expected 0 to {last}, got {sent[wrong][0]}")
        return sent

    def _info(self, mask: np.ndarray) -> dict[str, Any]:
        info = super()._info(mask)
        if self._broken:
            info[LOST], info[f"_{LOST}"] = self._broken
        return info


def _checked_mode(mode: AutoresetMode | str) -> AutoresetMode:
    """Raises `InputError` if it is no autoreset mode."""
    try:
        return AutoresetMode(mode)
    except ValueError:
        expected = " or ".join(repr(m.value) for m in AutoresetMode)
        raise InputError(f"autoreset_mode: expected {expected}, got {mode!r}") from None

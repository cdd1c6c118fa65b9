"""The drones of one or many simulators elsewhere, as one vector env of the agent's."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from ..envs import ENV_ID, autoreset
from ..envs.autoreset import AdvancingVectorEnv, Seeds, checked_mask, checked_seeds
from .link import Address
from .messages import MAX_UINT64
from .remote import LOST
from .served import ServedEnv, keep_space
from .server import Server, ServerConfig
from .simulator import DEFAULT_AGENT

__all__ = ["RemoteVectorEnv"]


class RemoteVectorEnv(ServedEnv, AdvancingVectorEnv):
    """The M · N drones of M simulators with N drones each, in lock-step over one socket.

    The simulators may be on any machines, and come in any order: each takes the first place that
    is free, and one that comes too late waits until another leaves. Drone i of place p is env
    p · N + i. A slow simulator delays the others and changes nothing else.

    Autoreset is Gymnasium's NEXT_STEP (the default), SAME_STEP or DISABLED, as in
    `rotorgram.envs.ElevationVectorEnv`; with SAME_STEP a step in which an episode ends takes a
    second round trip, in which the other drones hold. `info` has the telemetry, an array for each
    name.

    A simulator that is lost is replaced by the next that comes. The running episodes of its drones
    end as truncated, with the observation before, reward 0 and the reason in
    `info["simulator_lost"]`. The other places wait meanwhile.

    Args:
        address: Address (host, port) to listen on; port 0 takes a free one.
        num_simulators: M.
        num_envs: Drones in all, M · N; a simulator with another share of them is refused. None: N
            is that of the first simulator that comes.
        env_id: The env to fly. A simulator of another one is refused.
        options: Options of that env; with them given, a simulator of others is refused.
        autoreset_mode: `AutoresetMode`, or its value.
        connect: Wait for the simulators now; needs `num_envs` where it is False.
        connect_timeout: Longest wait for a simulator to take a free place, s.
        timeout: Longest wait for an answer from one, s, before another may take its place.
        key_file: File with the key that the simulators have too (`rotorgram key`).
        insecure: Allow an address that is not loopback without a key.
        record: MCAP file to write every message to; it must not exist.

    Raises:
        ValueError: An address, number, option, key file, action or seed is not what it should be.
        OSError: The port is in use.
        PeerSilent: A place stayed free for `connect_timeout`.
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
        env_id: str = ENV_ID,
        options: Mapping[str, Any] | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        connect: bool = True,
        connect_timeout: float = 60.0,
        timeout: float = 30.0,
        key_file: Path | str | None = None,
        insecure: bool = False,
        record: Path | str | None = None,
    ) -> None:
        self.closed = True  # nothing is open yet
        if num_simulators < 1:
            raise ValueError(f"num_simulators: expected 1 or more, got {num_simulators}")
        if num_envs is not None and (num_envs < 1 or num_envs % num_simulators):
            raise ValueError(
                f"num_envs: expected a multiple of num_simulators = {num_simulators}, "
                f"got {num_envs}"
            )
        if num_envs is None and not connect:
            raise ValueError("num_envs: expected a number with connect=False, got None")
        self.env_id = env_id
        self._broken: tuple[np.ndarray, np.ndarray] | None = None
        self._mode = autoreset.autoreset_mode(autoreset_mode)
        self.num_simulators = num_simulators
        config = ServerConfig(
            env_id=env_id,
            options=dict(options or {}),
            drones=num_envs // num_simulators if num_envs else None,
            places=num_simulators,
            connect_timeout=connect_timeout,
            timeout=timeout,
            key_file=key_file,
            insecure=insecure,
            record=record,
        )
        self._server = Server(address, config)
        self.closed = self._flying = False
        if num_envs is not None:
            self._take_interface(num_envs)
        if connect:
            try:
                self.connect()
            except BaseException:
                self.close()
                raise

    def connect(self) -> None:
        """Wait until every place is taken."""
        self._server.connect()
        self._take_interface(self.num_simulators * (self._server.interface.drones or 1))

    def reset(
        self,
        *,
        seed: int | Seeds | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode, for all drones or some.

        Where none is under way, before the first reset or after an error, a step wants a reset of
        every drone: with several masks too, as in `ElevationVectorEnv`.

        Args:
            seed: Drone i gets seed + i, or the i-th of N seeds; None leaves its generator as it is.
            options: `reset_mask`: bool, shape (N,): which drones; the others hold.
        """
        options = options or {}
        if unknown := [name for name in options if name != "reset_mask"]:
            raise ValueError(f"options: expected reset_mask or none over UDP, got {unknown[0]!r}")
        if "reset_mask" in options and self._flying:
            mask = checked_mask(options["reset_mask"], self.num_envs)
            self.advance(self._no_actions, mask, self._seeds(seed), ~mask)
            return self.observations.copy(), self._info(mask)
        self._flying = False
        self.connect()
        mask, seeds = checked_mask(options.get("reset_mask"), self.num_envs), self._seeds(seed)
        self._reset_until_done(mask, seeds)
        self.over, self._idle = np.zeros(self.num_envs, bool), ~mask
        self._flying = True
        self._take_states(np.ones(self.num_envs, bool))
        return self.observations.copy(), self._info(mask)

    def advance(
        self,
        actions: np.ndarray,
        resets: np.ndarray,
        seeds: np.ndarray | None = None,
        holds: np.ndarray | None = None,
    ) -> None:
        """Reset some drones, hold some, and fly the others: see `AdvancingVectorEnv`."""
        if not self._flying:
            raise gym.error.ResetNeeded("step: expected a call of reset() first")
        held = np.zeros(self.num_envs, bool) if holds is None else holds
        grounded = self.over | self._idle
        if (waiting := grounded & ~(resets | held)).any():
            first = int(waiting.argmax())
            raise gym.error.ResetNeeded(f"step: expected a call of reset() for env {first} first")
        sent, shape = self._sent(actions), self._shape
        places = [p for p in range(self.num_simulators) if not held.reshape(shape)[p].all()]
        self._flying = False  # until the answers are there
        try:
            self._server.exchange(places, sent, *_by_place(shape, resets, seeds, holds))
        except ValueError:  # an action that is wrong, and nothing has happened
            self._flying = True
            raise
        lost = self._server.lost
        if any(lost) and seeds is not None:  # who came instead of a lost one has not seen them
            lost = self._reset_until_done(resets, seeds, lost)
        before, telemetry = self.observations, self._telemetry
        self._take_states(resets | held)
        reasons = np.repeat(np.array(lost, object), shape[1])
        broken = (reasons != "") & ~resets & ~grounded
        if broken.any():  # what came is the start of the next episodes
            self.observations[broken] = before[broken]
            self._telemetry[broken] = telemetry[broken]
            self.rewards[broken] = 0.0
            self.terminated[broken] = False
            self.truncated[broken] = True
            reasons[~broken] = None
            self._broken, self.lost = (reasons, broken), broken.copy()
        self.over = self.terminated | self.truncated | (self.over & ~resets)
        self._idle = self._idle & ~resets
        self._flying = True

    def close_extras(self, **kwargs: Any) -> None:
        """Tell the simulators and close the socket."""
        self._server.close()
        self._flying = False

    def _take_interface(self, num_envs: int) -> None:
        interface = self._server.interface
        self.num_envs = num_envs
        self.metadata = {
            "render_modes": [],
            "render_fps": round(1 / interface.control_period),
            "autoreset_mode": self._mode,
        }
        keep_space(self, "single_observation_space", interface.observation)
        keep_space(self, "single_action_space", interface.action)
        keep_space(self, "observation_space", batch_space(interface.observation, num_envs))
        keep_space(self, "action_space", batch_space(interface.action, num_envs))
        self._shape = self.num_simulators, num_envs // self.num_simulators
        self._size = (interface.action.shape or (1,))[0]
        if not self._flying:
            self.over = np.zeros(num_envs, bool)
            self._idle = np.ones(num_envs, bool)  # whom no reset has begun
        self._no_actions: np.ndarray = np.zeros((num_envs, self._size), np.float32)

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
            lost: For each place why its simulator was lost before; None: all are to be reset.
        """
        actions = self._no_actions.reshape(*self._shape, self._size)
        wanted: np.ndarray = np.any(resets.reshape(self._shape), axis=1)
        reasons = lost or [""] * self.num_simulators
        anew = [not lost or bool(reason) for reason in reasons]
        while places := [p for p in range(self.num_simulators) if anew[p] and wanted[p]]:
            self._server.exchange(places, actions, *_by_place(self._shape, resets, seeds, ~resets))
            reasons = [new or old for new, old in zip(self._server.lost, reasons, strict=True)]
            anew = [bool(reason) for reason in self._server.lost]
        return reasons

    def _take_states(self, still: np.ndarray) -> None:
        """Take over what came; rewards and flags are 0 for those that did not fly."""
        self.observations, self._telemetry = self._joined("observations"), self._joined("telemetry")
        self.rewards = np.where(still, 0.0, self._joined("rewards"))
        self.terminated = self._joined("terminated") & ~still
        self.truncated = self._joined("truncated") & ~still
        self._broken = None
        self.lost = np.zeros(self.num_envs, bool)

    def _sent(self, actions: np.ndarray) -> np.ndarray:
        """Actions as float32, shape (M, N, k). Raises `ValueError`."""
        array = np.asarray(actions)
        if array.shape != (self.num_envs, self._size):
            raise ValueError(
                f"actions: expected an array of shape {(self.num_envs, self._size)}, "
                f"got shape {array.shape}"
            )
        if isinstance(self.single_action_space, spaces.Discrete):
            choices = int(self.single_action_space.n)
            if not ((array >= 0) & (array < choices) & (array % 1 == 0)).all():
                raise ValueError(f"actions: expected whole numbers 0 to {choices - 1}, got {array}")
        # Whatever the program has set; what overflows is infinite, and refused as such.
        with np.errstate(over="ignore", under="ignore"):
            return array.astype(np.float32).reshape(*self._shape, self._size)

    def _joined(self, name: str) -> np.ndarray:
        """One field of the States of all places: a new array whose first axis has every drone."""
        return np.concatenate([getattr(state, name) for state in self._server.states])

    def _info(self, mask: np.ndarray) -> dict[str, Any]:
        names, columns = self._server.interface.telemetry, self._telemetry.T.copy()
        info: dict[str, Any] = dict(zip(names, columns, strict=True))
        info |= {f"_{name}": mask for name in names}
        if self._broken:
            info[LOST], info[f"_{LOST}"] = self._broken
        return info


def _by_place(shape: tuple[int, int], *arrays: np.ndarray | None) -> list[Any]:
    """Arrays of all drones, shape (M · N,), as (M, N)."""
    return [None if array is None else array.reshape(shape) for array in arrays]

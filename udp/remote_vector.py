"""The drones of one or many simulators elsewhere, as one vector env of the agent's."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from ..envs import ENV_ID
from .link import Address
from .messages import MAX_UINT64
from .remote import LOST, keep_space
from .server import Server, ServerConfig
from .simulator import DEFAULT_AGENT
from .statistics import Statistics

__all__ = ["RemoteVectorEnv"]

Step = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]


class RemoteVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """The M · N drones of M simulators with N drones each, in lock-step over one socket.

    The simulators may be on any machines, and come in any order: each takes the first place that
    is free, and one that comes too late waits until another leaves. Drone i of place p is env
    p · N + i. A slow simulator delays the others and changes nothing else.

    Autoreset is Gymnasium's NEXT_STEP: the step after an episode's end resets that drone, ignores
    its action and gives reward 0. `info` has the telemetry, an array for each name.

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
        gymnasium.error.ResetNeeded: A step before a reset.
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

    @property
    def address(self) -> Address:
        """Address that this side listens on."""
        return self._server.address

    @property
    def statistics(self) -> Statistics:
        """Counts and round trips of the wire, over all simulators."""
        return self._server.link.statistics

    def connect(self) -> None:
        """Wait until every place is taken."""
        self._server.connect()
        self._take_interface(self.num_simulators * (self._server.interface.drones or 1))

    def reset(
        self,
        *,
        seed: int | Sequence[int] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode for every drone: env i with seed + i, or the i-th of the seeds."""
        if options:
            raise ValueError(f"options: expected none over UDP, got {options}")
        self._flying = False
        self._server.connect()
        self._take_interface(self.num_simulators * (self._server.interface.drones or 1))
        seeds = self._seeds(seed)
        places: Sequence[int] = range(self.num_simulators)
        everyone = np.ones(self._shape, bool)
        while places:
            self._server.exchange(places, self._no_actions, everyone, seeds)
            # A simulator that came in the place of a lost one was not reset.
            places = [place for place, reason in enumerate(self._server.lost) if reason]
        self._ended = np.zeros(self.num_envs, bool)
        self._flying = True
        self._observations = self._joined("observations")
        self._telemetry = self._joined("telemetry")
        return self._observations.copy(), self._info()

    def step(self, actions: np.ndarray) -> Step:
        """Fly every drone for one control period; reset those whose episode has ended."""
        if not self._flying:
            raise gym.error.ResetNeeded("step: expected a call of reset() first")
        sent = self._sent(actions)
        resets = self._ended.reshape(self._shape)
        self._flying = False  # until the answers are there
        try:
            self._server.exchange(range(self.num_simulators), sent, resets)
        except ValueError:  # an action that is wrong, and nothing has happened
            self._flying = True
            raise
        observations, rewards = self._joined("observations"), self._joined("rewards")
        terminated, truncated = self._joined("terminated"), self._joined("truncated")
        telemetry = self._joined("telemetry")
        reasons = np.repeat(np.array(self._server.lost, object), self._shape[1])
        broken = (reasons != "") & ~self._ended
        if broken.any():  # what came is the start of the next episodes
            observations[broken] = self._observations[broken]
            telemetry[broken] = self._telemetry[broken]
            rewards[broken] = 0.0
            terminated[broken] = False
            truncated[broken] = True
        self._ended = terminated | truncated
        self._observations, self._telemetry = observations, telemetry
        info = self._info()
        if broken.any():
            reasons[~broken] = None
            info[LOST], info[f"_{LOST}"] = reasons, broken
        self._flying = True
        return observations.copy(), rewards, terminated, truncated, info

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
            "autoreset_mode": AutoresetMode.NEXT_STEP,
        }
        keep_space(self, "single_observation_space", interface.observation)
        keep_space(self, "single_action_space", interface.action)
        keep_space(self, "observation_space", batch_space(interface.observation, num_envs))
        keep_space(self, "action_space", batch_space(interface.action, num_envs))
        self._shape = self.num_simulators, num_envs // self.num_simulators
        self._size = (interface.action.shape or (1,))[0]
        self._no_actions = np.zeros((*self._shape, self._size), np.float32)

    def _seeds(self, seed: int | Sequence[int] | None) -> np.ndarray | None:
        if seed is None:
            return None
        numbers = range(seed, seed + self.num_envs) if isinstance(seed, int) else seed
        if (
            not isinstance(numbers, Sequence | np.ndarray)
            or len(numbers) != self.num_envs
            or not all(isinstance(n, int | np.integer) and 0 <= n <= MAX_UINT64 for n in numbers)
        ):
            raise ValueError(
                f"seed: expected a whole number, or {self.num_envs} of them, up to 2^64 - 1, "
                f"got {seed}"
            )
        return np.array(numbers, np.uint64).reshape(self._shape)

    def _sent(self, actions: np.ndarray) -> np.ndarray:
        """Actions as float32, shape (M, N, k). Raises `ValueError`."""
        array = np.asarray(actions)
        if array.shape != self.action_space.shape:
            raise ValueError(
                f"actions: expected an array of shape {self.action_space.shape}, "
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

    def _info(self) -> dict[str, Any]:
        columns = self._telemetry.T.copy()
        info: dict[str, Any] = {}
        for name, column in zip(self._server.interface.telemetry, columns, strict=True):
            info[name], info[f"_{name}"] = column, np.ones(self.num_envs, bool)
        return info

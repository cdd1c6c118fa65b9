"""What vector envs of the wire have in common: Gymnasium's autoreset over a single method."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

__all__ = [
    "AdvancingVectorEnv",
    "Seeds",
    "Step",
    "autoreset_mode",
    "check_names",
    "checked_mask",
    "checked_seeds",
]

Step = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]
Seeds = Sequence[int | None] | np.ndarray


class AdvancingVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """A vector env that is stepped by `advance`, the step of the wire.

    Attributes:
        observations: float32, shape (N, n). This and the others are as `advance` left them.
        rewards: float64, shape (N,).
        terminated, truncated: bool, shape (N,).
        over: bool, shape (N,): whose episode has ended and the next has not begun.
        lost: bool, shape (N,): whose episode was truncated since its simulator was lost.
    """

    observations: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    over: np.ndarray
    lost: np.ndarray

    @abstractmethod
    def reset(
        self, *, seed: int | Seeds | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode, for all drones or some."""

    @abstractmethod
    def advance(
        self,
        actions: np.ndarray,
        resets: np.ndarray,
        seeds: np.ndarray | None = None,
        holds: np.ndarray | None = None,
    ) -> None:
        """Reset some drones, hold some, and fly the others for one control period.

        Rewards and flags of a drone that is reset or held are 0, and its action is ignored. One
        that is held is afterwards as it was before.

        Args:
            actions: Shape (N, k), a discrete one by its number.
            resets: bool, shape (N,).
            seeds: uint64, shape (N,), of those that are reset; None leaves their generators as
                they are.
            holds: bool, shape (N,); None holds none.
        """

    @abstractmethod
    def _info(self, mask: np.ndarray) -> dict[str, Any]:
        """What there is to say of the drones now, each name with its mask."""

    def step(self, actions: np.ndarray) -> Step:
        """Fly every drone for one control period; what follows an episode, the autoreset says."""
        array = np.asarray(actions)
        if array.shape != self.action_space.shape:
            raise ValueError(
                f"actions: expected an array of shape {self.action_space.shape}, "
                f"got shape {array.shape}"
            )
        mode, nobody = self.metadata["autoreset_mode"], np.zeros(self.num_envs, bool)
        resets = self.over if mode == AutoresetMode.NEXT_STEP else nobody
        self.advance(array.reshape(self.num_envs, -1), resets)
        # Copies, for whoever writes into them.
        rewards, terminated = self.rewards.copy(), self.terminated.copy()
        truncated, info = self.truncated.copy(), self._info(~nobody)
        if mode == AutoresetMode.SAME_STEP and self.over.any():
            info = self._begin_next(truncated, info)
        return self.observations.copy(), rewards, terminated, truncated, info

    def _begin_next(self, truncated: np.ndarray, last_info: dict[str, Any]) -> dict[str, Any]:
        """SAME_STEP: reset those whose episode ended; the info, with that of their last step.

        A simulator that is lost meanwhile truncates the episodes of those that held: they begin
        their next as well.
        """
        last, ended = self.observations.copy(), np.zeros(self.num_envs, bool)
        shape = self.num_envs, *(self.single_action_space.shape or (1,))
        while self.over.any():
            truncated |= self.lost
            ended |= self.over
            self.advance(np.zeros(shape, np.float32), self.over, holds=~self.over)
        masks = {name: mask & ended for name, mask in last_info.items() if name.startswith("_")}
        info = self._info(np.ones(self.num_envs, bool))
        info |= {"final_obs": last, "_final_obs": ended}
        info |= {"final_info": last_info | masks, "_final_info": ended.copy()}
        return info


def autoreset_mode(mode: AutoresetMode | str) -> AutoresetMode:
    """The mode of that value. Raises `ValueError`."""
    try:
        return AutoresetMode(mode)
    except ValueError:
        expected = " or ".join(repr(m.value) for m in AutoresetMode)
        raise ValueError(f"autoreset_mode: expected {expected}, got {mode!r}") from None


def check_names(options: Mapping[str, Any], known: Sequence[str]) -> None:
    """Raise `ValueError` if a reset has an option that is not known."""
    if unknown := [name for name in options if name not in known]:
        raise ValueError(f"options: expected some of {', '.join(known)}, got {unknown[0]!r}")


def checked_mask(mask: Any, num_envs: int) -> np.ndarray:
    """The `reset_mask` of a reset's options, bool, shape (N,); None is all. Raises `ValueError`."""
    if mask is None:
        return np.ones(num_envs, bool)
    if (
        not isinstance(mask, np.ndarray)
        or (mask.dtype, mask.shape) != (bool, (num_envs,))
        or not mask.any()
    ):
        raise ValueError(
            f"reset_mask: expected an array of {num_envs} bool, one of them True, got {mask!r}"
        )
    return mask.copy()


def checked_seeds(seed: Any, num_envs: int, most: int | None = None) -> Seeds | None:
    """One seed for each env, from one number, N of them, or None. Raises `ValueError`.

    Args:
        seed: As Gymnasium's reset takes it.
        num_envs: N.
        most: Largest seed; where there is one, every env needs one.
    """
    if seed is None:
        return None
    numbers = seed
    if isinstance(seed, int | np.integer):
        numbers = range(int(seed), int(seed) + num_envs)
    if (
        not isinstance(numbers, Sequence | np.ndarray)
        or len(numbers) != num_envs
        or not all(_is_seed(number, most) for number in numbers)
    ):
        up_to = "from 0 on" if most is None else f"from 0 to 2^{most.bit_length()} - 1"
        raise ValueError(
            f"seed: expected a whole number {up_to}, or {num_envs} of them, got {seed!r}"
        )
    return numbers


def _is_seed(number: Any, most: int | None) -> bool:
    if number is None:
        return most is None
    return isinstance(number, int | np.integer) and 0 <= int(number) <= (most or int(number))

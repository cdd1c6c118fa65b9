"""What the algorithms have in common: fly, update, repeat; and stop and go on at any update."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import nn

from .episodes import EpisodeLog
from .networks import arrays_of, load_arrays
from .policies import NetworkPolicy
from .rollouts import AnyCollector, Collector, Rollout, VectorCollector
from .vector_episodes import VectorEpisodeLog

__all__ = [
    "Agent",
    "AnyLog",
    "Learner",
    "OnUpdate",
    "Terms",
    "optimizer_arrays",
    "seeds_of",
    "set_optimizer_arrays",
    "sizes",
    "updates_of",
]

AnyLog = EpisodeLog | VectorEpisodeLog
"""What a training flies through: one drone or many."""

OnUpdate = Callable[[], bool]
"""Called after every rollout and its update; training stops where it returns False."""


class Agent(Protocol):
    """An algorithm in training. Its state is plain arrays, whole at every update."""

    def train(self, log: AnyLog, env_steps: int, on_update: OnUpdate) -> None:
        """Train until the log counts `env_steps`; the state resumes where it stood."""

    def last_step(self, env_steps: int) -> int:
        """Env steps after which a training of so many ends: fewer where rollouts must be whole."""

    def actor(self) -> dict[str, np.ndarray]:
        """Weights for `NetworkPolicy`."""

    def state(self) -> dict[str, np.ndarray]:
        """Everything that the next update depends on, but for the env's position."""

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Take over a state."""

    def scalars(self) -> dict[str, float]:
        """Numbers of the last update under SB3's names, `train/…`; none before the first.

        `docs/algorithms/README.md` has the table. One that is not defined is NaN.
        """


@dataclass(frozen=True, kw_only=True, slots=True)
class Terms:
    """What the loss of an update was made of, kept as tensors: few updates are asked for numbers.

    Those of the critic are None where there is none.
    """

    gain: torch.Tensor
    """Mean of weight · log P, which the actor climbs."""
    entropy: torch.Tensor
    """Of the policy at each step, nats: shape (T,)."""
    value_loss: torch.Tensor | None = None
    """Mean squared error of the values."""
    values: torch.Tensor | None = None
    """V(s_t) before the update, shape (T,)."""
    targets: torch.Tensor | None = None
    """What they were drawn to, shape (T,)."""

    def numbers(self) -> dict[str, float]:
        """By SB3's names and with its signs."""
        numbers = {
            "train/policy_loss": -float(self.gain),
            "train/entropy_loss": -float(self.entropy.mean()),
        }
        if self.value_loss is not None:
            numbers["train/value_loss"] = float(self.value_loss)
        if self.values is not None and self.targets is not None:
            values, targets = self.values.numpy(), self.targets.numpy()
            spread, left = float(np.var(targets)), float(np.var(targets - values))
            numbers["train/explained_variance"] = 1 - left / spread if spread else np.nan
        return numbers


class Learner:
    """Base of our own algorithms: `collect` and `loss` are theirs; `loss` sets `terms` too.

    Args:
        networks: By name; `actor` is one of them.
        learning_rate: Of Adam.
        anneal: Lower it linearly to zero over the run.
        rng: Draws the actions.
    """

    def __init__(
        self,
        networks: dict[str, nn.Module],
        *,
        learning_rate: float,
        anneal: bool,
        rng: np.random.Generator,
    ) -> None:
        self.networks = networks
        self._learning_rate = learning_rate
        self._anneal = anneal
        self._rng = rng
        parameters = [p for network in networks.values() for p in network.parameters()]
        # foreach: one call for all parameters instead of one for each; same arithmetic.
        self._optimizer = torch.optim.Adam(parameters, lr=learning_rate, foreach=True)
        self._observation: np.ndarray | None = None
        self.terms: Terms | None = None
        """Of the last update."""

    def collect(self, collector: AnyCollector, policy: NetworkPolicy, most: int) -> Rollout:
        """Fly for one update, at most so many env steps; an empty rollout makes none."""
        raise NotImplementedError

    def loss(self, rollout: Rollout) -> torch.Tensor:
        """What one step of Adam lowers."""
        raise NotImplementedError

    def train(self, log: AnyLog, env_steps: int, on_update: OnUpdate) -> None:
        """Train until the log counts `env_steps`, or `on_update` returns False."""
        collector: AnyCollector
        if isinstance(log, VectorEpisodeLog):
            collector = VectorCollector(log, self._rng, self._observation)
        else:
            collector = Collector(log, self._rng, self._observation)
        while log.env_steps < env_steps:
            policy, before = NetworkPolicy(self.actor()), log.env_steps
            rollout = self.collect(collector, policy, env_steps - before)
            self._observation = collector.observation
            if self._anneal:
                self._set_learning_rate(1 - before / env_steps)
            if len(rollout):
                self._update(rollout)
            if not on_update():
                return

    def _update(self, rollout: Rollout) -> None:
        self._optimizer.zero_grad()
        self.loss(rollout).backward()  # type: ignore[no-untyped-call]
        self._optimizer.step()
        self.networks["actor"].clamp_()  # type: ignore[operator]

    def last_step(self, env_steps: int) -> int:
        """Env steps after which a training of so many ends: all are flown."""
        return env_steps

    def actor(self) -> dict[str, np.ndarray]:
        """Weights of the policy."""
        return arrays_of(self.networks["actor"])

    def state(self) -> dict[str, np.ndarray]:
        """Weights, Adam's moments and the generator, by name."""
        state = {
            f"{name}.{key}": value
            for name, network in self.networks.items()
            for key, value in arrays_of(network).items()
        }
        state |= optimizer_arrays(self._optimizer)
        state["rng"] = _text_array(json.dumps(self._rng.bit_generator.state))
        if self._observation is not None:
            state["observation"] = self._observation
        return state

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Take over a state."""
        for name, network in self.networks.items():
            prefix = f"{name}."
            load_arrays(network, {k[len(prefix):]: v for k, v in state.items()
                                  if k.startswith(prefix)})  # fmt: skip
        set_optimizer_arrays(self._optimizer, state)
        self._rng.bit_generator.state = json.loads(state["rng"].tobytes())
        self._observation = state.get("observation")
        self.terms = None

    def scalars(self) -> dict[str, float]:
        """Numbers of the last update under SB3's names; none before the first."""
        if self.terms is None:
            return {}
        numbers = self.terms.numbers()
        numbers["train/learning_rate"] = self._optimizer.param_groups[0]["lr"]
        numbers["train/n_updates"] = updates_of(self._optimizer)
        log_std = self.networks["actor"].log_std
        if isinstance(log_std, torch.Tensor):  # else the actions are discrete
            numbers["train/std"] = float(log_std.detach().exp().mean())
        return numbers

    def _set_learning_rate(self, share: float) -> None:
        for group in self._optimizer.param_groups:
            group["lr"] = self._learning_rate * share


def optimizer_arrays(optimizer: torch.optim.Optimizer) -> dict[str, np.ndarray]:
    """An optimizer's state as arrays named `optimizer.<parameter>.<quantity>`."""
    return {
        f"optimizer.{index}.{key}": value.numpy().copy()
        for index, entries in optimizer.state_dict()["state"].items()
        for key, value in entries.items()
    }


def set_optimizer_arrays(
    optimizer: torch.optim.Optimizer, arrays: Mapping[str, np.ndarray]
) -> None:
    """Take over what `optimizer_arrays` gave."""
    state: dict[int, dict[str, Any]] = {}
    for name, value in arrays.items():
        if name.startswith("optimizer."):
            _, index, key = name.split(".")
            state.setdefault(int(index), {})[key] = torch.from_numpy(value.copy())
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    for place, entries in state.items():
        shape = parameters[place].shape
        for key, value in entries.items():
            if key != "step" and value.shape != shape:
                raise ValueError(f"optimizer.{place}.{key}: expected shape {tuple(shape)}")
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": state, "param_groups": groups})


def updates_of(optimizer: torch.optim.Optimizer) -> int:
    """How many steps an Adam has taken."""
    states = list(optimizer.state.values())
    return int(states[0]["step"]) if states else 0


def _text_array(text: str) -> np.ndarray:
    return np.frombuffer(text.encode(), np.uint8)


def sizes(env: Any) -> tuple[int, Any]:
    """Length of an observation, and the action space, of an env or of one of a vector env."""
    observation = getattr(env, "single_observation_space", env.observation_space)
    return observation.shape[0], getattr(env, "single_action_space", env.action_space)


def seeds_of(seed: int) -> tuple[int, np.random.Generator]:
    """Seed of the weights and generator of the actions, independent of each other."""
    weights = np.random.SeedSequence(seed, spawn_key=(0,)).generate_state(1, np.uint64)[0]
    return int(weights), np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))

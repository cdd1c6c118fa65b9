"""Base of the algorithms: fly, update, repeat; stop and resume at any update."""

import json
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from .episodes import EpisodeLog
from .networks import Actor, arrays_of, load_arrays, nn, torch
from .policies import ActionMap, NetworkPolicy, flat_size
from .rollouts import Collector, Diverged, Rollout

OnUpdate = Callable[[], bool]
"""Called after every rollout and its update; training stops where it returns False."""


class Learner:
    """Base of our own algorithms: `collect` and `loss` are theirs; `loss` sets `terms` too.

    Attributes:
        terms: Of the loss of the last update, as tensors, for few updates are logged: `gain`, the
            mean of weight · log P, which the actor climbs; `entropy` of the policy at each step,
            nats, shape (T,); and of a critic `value_loss`, the mean squared error of the values,
            with `values`, V(s_t) before the update, and their `targets`, shape (T,).
    """

    def __init__(self, log: EpisodeLog, config: Any, seed: int) -> None:
        weights_seed, self._rng = seeds_of(seed)
        torch.manual_seed(weights_seed)
        self.spec, self.config = log.spec, config
        actions = ActionMap(log.spec.action)
        self._actor = Actor(
            flat_size(log.spec),
            actions.outputs,
            discrete=actions.discrete,
            hidden=config.hidden,
            log_std=config.log_std,
        )
        self.networks = nn.ModuleDict({"actor": self._actor, **self.others()})
        parameters, rate = self.networks.parameters(), config.learning_rate
        # foreach: one call for all parameters instead of one for each; same arithmetic.
        self._optimizer = torch.optim.Adam(parameters, lr=rate, foreach=True)
        self.terms: dict[str, torch.Tensor] = {}

    def others(self) -> dict[str, nn.Module]:
        """Networks besides the actor, by name."""
        return {}

    def collect(self, collector: Collector, policy: NetworkPolicy, most: int) -> Rollout:
        """Fly for one update, at most so many env steps; an empty rollout makes none."""
        raise NotImplementedError

    def loss(self, rollout: Rollout) -> torch.Tensor:
        """The loss that one step of Adam lowers."""
        raise NotImplementedError

    def train(self, log: EpisodeLog, env_steps: int, on_update: OnUpdate) -> None:
        """Train until the log counts `env_steps`, from the current state on. Raises `Diverged`."""
        collector = Collector(log, self._rng)
        while log.env_steps < env_steps:
            policy, before = NetworkPolicy(self.actor(), self.spec), log.env_steps
            rollout = self.collect(collector, policy, env_steps - before)
            if self.config.anneal:
                for group in self._optimizer.param_groups:
                    group["lr"] = self.config.learning_rate * (1 - before / env_steps)
            if len(rollout):
                self._optimizer.zero_grad()
                self.loss(rollout).backward()  # type: ignore[no-untyped-call]
                self._optimizer.step()
                self._actor.clamp_()
                check_finite(self._optimizer)
            if not on_update():
                return

    def last_step(self, env_steps: int) -> int:
        """Env steps after which a training of so many ends: all are flown."""
        return env_steps

    def actor(self) -> dict[str, np.ndarray]:
        """Weights for `NetworkPolicy`."""
        return arrays_of(self._actor)

    def state(self) -> dict[str, np.ndarray]:
        """All that the next update depends on: weights, Adam's moments and the generator."""
        text = json.dumps(self._rng.bit_generator.state).encode()
        arrays = arrays_of(self.networks) | optimizer_arrays(self._optimizer)
        return arrays | {"rng": np.frombuffer(text, np.uint8)}

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Take over a state."""
        for name, network in self.networks.items():
            load_arrays(network, state, f"{name}.")
        set_optimizer_arrays(self._optimizer, state)
        self._rng.bit_generator.state = json.loads(state["rng"].tobytes())
        self.terms = {}

    def scalars(self) -> dict[str, float]:
        """Numbers of the last update, as in `docs/algorithms/README.md`; none before the first."""
        if not self.terms:
            return {}
        terms = {name: tensor.detach().numpy() for name, tensor in self.terms.items()}
        numbers = {
            "train/policy_loss": -float(terms["gain"]),
            "train/entropy_loss": -float(terms["entropy"].mean()),
            "train/learning_rate": self._optimizer.param_groups[0]["lr"],
            "train/n_updates": updates_of(self._optimizer),
        }
        if "values" in terms:
            spread = float(np.var(terms["targets"]))
            left = float(np.var(terms["targets"] - terms["values"]))
            numbers["train/value_loss"] = float(terms["value_loss"])
            numbers["train/explained_variance"] = 1 - left / spread if spread else np.nan
        if self._actor.log_std is not None:
            numbers["train/std"] = float(self._actor.log_std.detach().exp().mean())
        return numbers


def check_finite(optimizer: torch.optim.Optimizer) -> None:
    """Raise `Diverged` unless all weights that an optimizer moves are finite numbers."""
    (group,) = optimizer.param_groups
    weights = torch.cat([parameter.detach().flatten() for parameter in group["params"]])
    if not torch.isfinite(weights).all():
        what = f"weights are not finite after update {updates_of(optimizer)}"
        raise Diverged(f"training diverged: {what}; try a lower learning_rate")


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
    """Take over what `optimizer_arrays` gave. Raises `ValueError` unless it is whole."""
    given = {k: v for k, v in arrays.items() if k.startswith("optimizer.")}
    (group,) = optimizer.param_groups
    expected = {
        f"optimizer.{index}.{key}": () if key == "step" else tuple(parameter.shape)
        for index, parameter in enumerate(group["params"])
        for key in ("step", "exp_avg", "exp_avg_sq")
    }
    got = {name: array.shape for name, array in given.items()}
    if got not in (expected, {}):
        raise ValueError(f"optimizer: expected arrays of shapes {expected}, got {got}")
    steps = {float(array) for name, array in given.items() if name.endswith(".step")}
    if len(steps) > 1 or min(steps, default=1) < 1:
        raise ValueError(f"optimizer: expected one step of 1 or more, got {sorted(steps)}")
    state: dict[int, dict[str, torch.Tensor]] = {}
    for name, value in given.items():
        _, index, key = name.split(".")
        state.setdefault(int(index), {})[key] = torch.from_numpy(value.copy())
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": state, "param_groups": groups})


def updates_of(optimizer: torch.optim.Optimizer) -> int:
    """Number of steps that an Adam optimizer has taken."""
    states = list(optimizer.state.values())
    return int(states[0]["step"]) if states else 0


def seeds_of(seed: int) -> tuple[int, np.random.Generator]:
    """Seed of the weights and generator of the actions, independent of each other."""
    weights = np.random.SeedSequence(seed, spawn_key=(0,)).generate_state(1, np.uint64)[0]
    return int(weights), np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))

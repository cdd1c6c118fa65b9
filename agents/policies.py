"""Policies for flying, in plain NumPy: such small nets need no tensor library."""

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from ..envs.spec import ArraySpec, Discrete, EnvSpec
from ..models.errors import InputError
from .config import Config
from .heads import Categorical, Gaussian, Head
from .layers import Floats, Layer, Module, Parts, Tanh, Weights
from .networks import make_network

Array = np.ndarray
Observation = Array | Mapping[str, Array]
"""As an env gives it."""
Action = Array | int
"""As an env takes it."""


class Policy(Protocol):
    """Chooses actions: called once for each control step.

    With an attribute `many` that is true, an object may also fly N drones, whose episodes all begin
    with `reset`: observations then have a first axis of N, and so has what `act` returns.
    """

    def reset(self) -> None:
        """Forget the last episode."""

    def act(self, observation: Observation) -> Action:
        """The action for an observation, both as the env has them."""


def flat(observations: Observation, spec: EnvSpec, *lead: int) -> Array:
    """Observations as networks take them: float32, shape (*lead, n).

    Given is an array of shape (*lead, ...), or a mapping with one for each array of the spec.
    """
    if not isinstance(observations, Mapping):
        return np.asarray(observations, np.float32).reshape(*lead, -1)
    arrays = [np.asarray(observations[array.name], np.float32) for array in spec.observation]
    return np.concatenate([array.reshape(*lead, -1) for array in arrays], axis=-1)


def lead_of(observation: Observation, spec: EnvSpec) -> tuple[int, ...]:
    """Axes of an observation before those of the spec: none of one drone, (N,) of many."""
    array = spec.observation[0]
    first = observation[array.name] if isinstance(observation, Mapping) else observation
    return np.shape(first)[: np.ndim(first) - len(array.shape)]


def flat_size(spec: EnvSpec) -> int:
    """Length n of a flat observation."""
    return sum(array.size for array in spec.observation)


class ActionMap:
    """Maps outputs of a network to actions of an env.

    Of a continuous action the network's 0 is the middle between the bounds, -1 the lower and 1 the
    upper one; where there is no bound, it is the number itself. Of a discrete action the network
    gives a number for each choice. An array of whole numbers raises `InputError`.

    Attributes:
        outputs: Numbers that the network gives.
        size: Numbers of a drawn action, k: 1 if discrete.
        discrete: Whether an action is a choice.
        squashed: Whether tanh of the network's numbers takes their place.
        middle: Action of an output 0, shape (1, k); the others likewise. None of them if discrete.
        half: What an output 1 adds to it.
        low: Lower bound of the action, float32; -inf where there is none.
        high: Upper bound.
    """

    def __init__(self, action: ArraySpec | Discrete, *, squashed: bool = False) -> None:
        self.discrete = isinstance(action, Discrete)
        self.squashed = squashed and not self.discrete
        if isinstance(action, Discrete):
            self.outputs = action.choices
            self.size = 1
            return
        if not action.dtype.startswith("float"):
            raise InputError(
                f"action: expected a choice or numbers of type float, got {action.dtype}"
            )
        self.outputs = self.size = action.size
        # Two axes here and below: NumPy is slow where it has to add one to a batch of one.
        low, high = (bound.reshape(1, -1) for bound in action.bounds())
        bounded = np.isfinite(low) & np.isfinite(high)
        with np.errstate(invalid="ignore"):
            self.middle = np.where(bounded, (low + high) / 2, 0.0).astype(np.float32)
            self.half = np.where(bounded, (high - low) / 2, 1.0).astype(np.float32)
        self.low = low.astype(np.float32)
        self.high = high.astype(np.float32)
        self._plain = bool((self.middle == 0).all() and (self.half == 1).all())

    def to_envs(self, actions: Array) -> Array:
        """Drawn actions (N, k) as the env's: float32, (N, k), inside the bounds; or int64, (N,)."""
        if self.discrete:
            return actions[:, 0].astype(np.int64)
        if self.squashed:
            actions = np.tanh(actions)
        if not self._plain:
            actions = self.middle + self.half * actions
        clipped: Array = np.minimum(np.maximum(actions, self.low), self.high)
        return clipped


class NetworkPolicy(Module):
    """A network and a head: what learns, draws actions and flies.

    Where the learner binds it to its weights, it is the policy that learns; a copy of it does not.

    Attributes:
        spec: What it sees: of an env, without privileged arrays.
        network: From observations to the mean of the action, or to the logits of the choices.
        memory: What the network remembers of the episode, if it has a memory.
        head: Distribution of the actions.
        actions: Map from outputs to actions of the env.
        shapes: Of its weights: those of the network and of the head.
    """

    many = True

    def __init__(self, spec: EnvSpec, config: Config) -> None:
        self.spec = spec = spec.for_actor()
        self.actions = ActionMap(spec.action, squashed=config.squashed)
        outputs = self.actions.outputs
        self.network = make_network(spec.observation, outputs, config)
        self.memory = self.network.memory
        self.head: Head = Gaussian(outputs) if config.draws else Head()
        if self.actions.discrete:
            self.head = Categorical(outputs)
        self.shapes = {**self.network.shapes, **self.head.shapes}

    @property
    def layers(self) -> list[Layer]:
        """Those of the network, and tanh where actions are squashed: what an export writes."""
        squashing = [Tanh()] if self.actions.squashed else []
        return [*self.network.layers, *squashing]

    @classmethod
    def load(cls, weights: Parts, spec: EnvSpec, config: Config) -> "NetworkPolicy":
        """The policy of some weights, `weights.arrays` of another: copies.

        Raises `InputError` unless they are those that the env and the config need.
        """
        policy = cls(spec, config)
        got = {name: array.shape for name, array in weights.items()}
        if got != policy.shapes:
            raise InputError(
                f"policy: expected weights of shapes {policy.shapes}, got {got}: it was trained "
                "for other observations or actions; give the --vehicle and the --env options of "
                "its training"
            )
        policy.bind(Weights.zeros(policy.shapes))
        for name, array in policy.weights.arrays.items():
            array[...] = weights[name]
        return policy

    def bind(self, weights: Weights) -> None:
        self.weights = weights
        self.network.bind(weights)
        self.head.bind(weights)

    def reset(self) -> None:
        """Forget the episode, if the network has a memory."""
        if self.memory:
            self.memory.state[...] = 0.0

    def act(self, observation: Observation) -> Action:
        """The most likely action, inside the bounds of the env."""
        lead = lead_of(observation, self.spec)
        output = self.outputs(flat(observation, self.spec, *(lead or (1,))))
        if isinstance(self.spec.action, Discrete):
            return output.argmax(axis=1) if lead else int(output.argmax())
        return self.actions.to_envs(output).reshape(*lead, *self.spec.action.shape)

    def outputs(self, observations: Floats) -> Floats:
        """Outputs of the network, shape (B, k), for flat observations, shape (B, n).

        They hold until the next call. A memory takes them as the next of B episodes.
        """
        return self.network.forward(observations.T).T

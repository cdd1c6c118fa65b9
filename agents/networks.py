"""The networks of the paper, section 2.3: one hidden layer of 16 ReLU units, in PyTorch.

Weights go to and from plain arrays, the form in which rollouts use them (`policies`) and
checkpoints keep them.
"""

import math
from collections.abc import Mapping

import numpy as np
import torch
from gymnasium import spaces
from torch import nn

__all__ = ["Actor", "Critic", "arrays_of", "load_arrays"]

LOG_STD_MIN, LOG_STD_MAX = -4.0, 1.0


def _layer(inputs: int, outputs: int, gain: float) -> nn.Linear:
    layer = nn.Linear(inputs, outputs)
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


class Actor(nn.Module):
    """Policy: Gaussian for a `Box` of actions, categorical for `Discrete`.

    The Gaussian's standard deviation does not depend on the state. An action is neither clipped
    nor squashed here: what the env gets is clipped, what is scored is what was drawn.

    Args:
        observation_size: Length of an observation.
        action_space: Flat `Box`, or `Discrete`.
        hidden: Units of the hidden layer.
        log_std: Logarithm of the standard deviation to begin with.
    """

    def __init__(
        self,
        observation_size: int,
        action_space: spaces.Space[np.ndarray],
        *,
        hidden: int = 16,
        log_std: float = -0.5,
    ) -> None:
        super().__init__()
        discrete = isinstance(action_space, spaces.Discrete)
        size = int(action_space.n) if discrete else action_space.shape[0]  # type: ignore[attr-defined,index]
        self.hidden = _layer(observation_size, hidden, math.sqrt(2))
        # Near zero: the first policy holds the thrust, whatever it sees.
        self.output = _layer(hidden, size, 0.01)
        self.log_std = None if discrete else nn.Parameter(torch.full((size,), log_std))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Means, or logits, shape (B, k), of observations (B, n)."""
        output: torch.Tensor = self.output(torch.relu(self.hidden(observations)))
        return output

    def score(
        self, observations: torch.Tensor, actions: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Log-probabilities (B,) and entropies (B,) of actions (B, k), or (B, 1) if discrete."""
        output = self(observations)
        if self.log_std is None:
            log_probabilities = torch.log_softmax(output, dim=1)
            chosen = log_probabilities.gather(1, actions.long()).squeeze(1)
            return chosen, -(log_probabilities.exp() * log_probabilities).sum(dim=1)
        log_std = self.log_std
        noise = (actions - output) * torch.exp(-log_std)
        constant = 0.5 * math.log(2 * math.pi)
        log_probability = -(0.5 * noise.square() + log_std + constant).sum(dim=1)
        return log_probability, (log_std + constant + 0.5).sum().expand(len(actions))

    def clamp_(self) -> None:
        """Keep the standard deviation between e^-4 and e."""
        if self.log_std is not None:
            with torch.no_grad():
                self.log_std.clamp_(LOG_STD_MIN, LOG_STD_MAX)


class Critic(nn.Module):
    """State value: the second network of A2C, of the same size as the first."""

    def __init__(self, observation_size: int, *, hidden: int = 16) -> None:
        super().__init__()
        self.hidden = _layer(observation_size, hidden, math.sqrt(2))
        self.output = _layer(hidden, 1, 1.0)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Values, shape (B,), of observations (B, n)."""
        values: torch.Tensor = self.output(torch.relu(self.hidden(observations)))
        return values.squeeze(1)


def arrays_of(module: nn.Module) -> dict[str, np.ndarray]:
    """Copies of a module's parameters."""
    return {name: p.detach().numpy().copy() for name, p in module.state_dict().items()}


def load_arrays(module: nn.Module, arrays: Mapping[str, np.ndarray]) -> None:
    """Set a module's parameters."""
    module.load_state_dict({name: torch.from_numpy(a.copy()) for name, a in arrays.items()})

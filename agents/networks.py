"""The networks of the paper, section 2.3, in PyTorch. Rollouts use their weights as arrays."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from ..models.errors import require

if TYPE_CHECKING:
    import torch
    from torch import nn
else:
    torch = require("torch", "train", "training")
    nn = torch.nn

__all__ = ["Actor", "Critic", "arrays_of", "load_arrays", "nn", "torch"]


def _layer(inputs: int, outputs: int, gain: float) -> nn.Linear:
    layer = nn.Linear(inputs, outputs)
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


class Actor(nn.Module):
    """Policy: Gaussian for continuous actions, categorical for discrete ones.

    The Gaussian's standard deviation does not depend on the state; its logarithm begins as
    `log_std`. Inputs are n, the length of a flat observation, outputs k, the numbers of an action
    or its choices.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        *,
        discrete: bool = False,
        hidden: int = 16,
        log_std: float = -0.5,
    ) -> None:
        super().__init__()
        self.hidden = _layer(inputs, hidden, math.sqrt(2))
        # Near zero: the first policy gives the middle of the action space, whatever it sees.
        self.output = _layer(hidden, outputs, 0.01)
        self.log_std = None if discrete else nn.Parameter(torch.full((outputs,), log_std))

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
                self.log_std.clamp_(-4.0, 1.0)


class Critic(nn.Module):
    """State value: the second network of A2C, of the same size as the first."""

    def __init__(self, inputs: int, *, hidden: int = 16) -> None:
        super().__init__()
        self.hidden = _layer(inputs, hidden, math.sqrt(2))
        self.output = _layer(hidden, 1, 1.0)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Values, shape (B,), of observations (B, n)."""
        values: torch.Tensor = self.output(torch.relu(self.hidden(observations)))
        return values.squeeze(1)


def arrays_of(module: nn.Module) -> dict[str, np.ndarray]:
    """Copies of a module's parameters."""
    return {name: p.detach().numpy().copy() for name, p in module.state_dict().items()}


def load_arrays(module: nn.Module, arrays: Mapping[str, np.ndarray], prefix: str = "") -> None:
    """Set a module's parameters from the arrays whose names begin with a prefix."""
    given = {name.removeprefix(prefix): a for name, a in arrays.items() if name.startswith(prefix)}
    module.load_state_dict({name: torch.from_numpy(a.copy()) for name, a in given.items()})

"""Arrays of the last control steps: actions on their way, observations that are late or kept."""

from typing import Any

from ..sim import Array


class Delay:
    """Keeps an array's last values for each drone, and gives those of some steps ago.

    `longest` is the largest delay, control steps.
    """

    def __init__(self, longest: int, xp: Any) -> None:
        self._longest, self._xp = longest, xp
        self._past: list[Array] = []  # the newest first

    def begin(self, mask: Array, values: Array) -> None:
        """Fill the past of the drones of a mask with these values; the mask broadcasts to them."""
        if not self._past:
            self._past = [values] * (self._longest + 1)
        self._past = [self._xp.where(mask, values, old) for old in self._past]

    def push(self, mask: Array | None, values: Array) -> None:
        """Add the values of the drones of a mask, None for all."""
        new = [values, *self._past[:-1]]
        if mask is not None:
            pairs = zip(new, self._past, strict=True)
            new = [self._xp.where(mask, value, old) for value, old in pairs]
        self._past = new

    def row(self) -> Array:
        """All of them side by side along the second axis, the oldest first."""
        return self._xp.concat(self._past[::-1], axis=1)

    def detach(self) -> None:
        """End the graph of gradients of tensors."""
        self._past = [values.detach() for values in self._past]

    def get(self, age: Array) -> Array:
        """Values of so many steps ago; the age, whole numbers, broadcasts to them."""
        values = self._past[0]
        for steps in range(1, self._longest + 1):
            values = self._xp.where(age >= steps, self._past[steps], values)
        return values

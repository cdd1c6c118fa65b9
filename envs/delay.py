"""Arrays of the last control steps: actions on their way, observations that are late or kept."""

import numpy as np

from ..sim import Array


class Delay:
    """Keeps an array's last values for each drone, and gives those of some steps ago.

    `longest` is the largest delay, control steps.
    """

    def __init__(self, longest: int) -> None:
        self._longest = longest
        self._past: list[Array] = []  # the newest first

    def begin(self, mask: Array, values: Array) -> None:
        """Fill the past of the drones of a mask with these values; the mask broadcasts to them."""
        if not self._past:
            self._past = [values] * (self._longest + 1)
        self._past = [np.where(mask, values, old) for old in self._past]

    def push(self, mask: Array | None, values: Array) -> None:
        """Add the values of the drones of a mask, None for all."""
        new = [values, *self._past[:-1]]
        if mask is not None:
            pairs = zip(new, self._past, strict=True)
            new = [np.where(mask, value, old) for value, old in pairs]
        self._past = new

    def row(self) -> Array:
        """All of them side by side along the second axis, the oldest first."""
        return np.concat(self._past[::-1], axis=1)

    def get(self, age: Array) -> Array:
        """Values of so many steps ago; the age, whole numbers, broadcasts to them."""
        values = self._past[0]
        for steps in range(1, self._longest + 1):
            values = np.where(age >= steps, self._past[steps], values)
        return values

"""Domain randomisation: parameters of a vehicle and its effects, drawn for each episode.

A parameter is a factor of the vehicle's own value, 1 being that value, or a number in its unit.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..models.errors import InputError, shortened
from ..models.fields import check_names, mapping
from ..models.files import read_own_toml
from .effects import EffectOptions
from .elementary import exp, log
from .random import Draw
from .state import ByName, clip


@dataclass(frozen=True)
class Parameter:
    """A parameter that can be drawn."""

    low: float
    """Least value; draws are clipped to it."""
    high: float
    """Largest value."""
    unit: str
    """Empty for a factor."""
    meaning: str
    needs: Sequence[str] = ()
    """At least one of these effects must be on."""


_TABLES = read_own_toml(__file__, "parameters")
PARAMETERS = {name: Parameter(**table) for name, table in _TABLES.items()}
"""What can be drawn, by name."""
CENTER = ("center_x", "center_y", "center_z")
LEAST_MASS = 0.1  # share of a mass that is left under any load
WHOLE = ("action_delay", "observation_delay")
"""Parameters that are whole numbers; a uniform draw gives each the same chance."""
CHANGE = Parameter(-math.inf, math.inf, "1", "what only changes within an episode; 0 before")
_TEXT = re.compile(r"\s*(uniform|loguniform)\s*\(([^()]*)\)\s*")


class Randomization:
    """Distributions by the parameter's name, as texts: "uniform(0.8, 1.2)", or a number.

    `uniform(low, high)` and `loguniform(low, high)`; a number stands for itself. Raises
    `InputError` for anything else, and for a parameter whose effect is off. Effects None: this is
    not checked.

    `changing`: by how much parameters grow at most within an episode. Those that are not drawn
    begin at the vehicle's own value; they move no random number of the others.
    """

    def __init__(
        self,
        texts: object,
        effects: EffectOptions | None,
        changing: Mapping[str, float] | None = None,
    ) -> None:
        self._changing = changing or {}
        self._kinds: dict[str, tuple[str, tuple[float, float]]] = {}
        given = mapping(texts, "randomize", "a mapping from names to distributions")
        check_names(given, PARAMETERS, "randomize")
        for name, text in given.items():
            self._kinds[name] = _distribution(name, text)
        for name in (*given, *self._changing):
            needs = PARAMETERS.get(name, CHANGE).needs
            if needs and effects and not any(getattr(effects, effect) for effect in needs):
                where = "randomize" if name in given else "events"
                raise InputError(
                    f"{where}: {name}: expected the effect {' or '.join(needs)}, "
                    "got it switched off"
                )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of what is drawn, in the order of `PARAMETERS`, and of what else changes."""
        drawn = [name for name in PARAMETERS if name in self._kinds]
        return (*drawn, *[name for name in self._changing if name not in self._kinds])

    def to_options(self) -> dict[str, float | str]:
        """The distributions by name in canonical form: a number, or a text."""
        options: dict[str, float | str] = {}
        for name, (kind, numbers) in self._kinds.items():
            inside = ", ".join(repr(number).removesuffix(".0") for number in numbers)
            is_one = kind == "uniform" and numbers[0] == numbers[1]
            options[name] = numbers[0] if is_one else f"{kind}({inside})"
        return options

    def most_steps(self, name: str) -> int:
        """Longest delay that can be, control steps; 0 where none is."""
        _, (_, most) = self._kinds.get(name, ("", (0.0, 0.0)))
        return round(most + self._changing.get(name, 0.0))

    def draw(self, draw: Draw) -> ByName:
        """Values by name, shape (W, A)."""
        drawn = {}
        for name in self.names:
            own = 0.0 if PARAMETERS.get(name, CHANGE).unit else 1.0
            kind, (low, high) = self._kinds.get(name, ("uniform", (own, own)))
            if kind == "loguniform":
                values = exp(draw.uniform(log(low), log(high)))
            else:
                spare = 0.5 if name in WHOLE else 0.0  # what is rounded to the ends
                values = draw.uniform(low - spare, high + spare)
            values = clip(values, low, high)
            drawn[name] = np.rint(values) if name in WHOLE else values
        return drawn


FIXED = Randomization({}, None)
"""Nothing is drawn."""


def _distribution(name: str, text: object) -> tuple[str, tuple[float, float]]:
    limits = PARAMETERS[name]
    match = _TEXT.fullmatch(text) if isinstance(text, str) else None
    kind, inside = match.groups() if match else ("uniform", f"{text},{text}")
    try:
        low, high = map(float, inside.split(","))
    except ValueError:
        low = high = math.nan
    is_within = limits.low <= low <= high <= limits.high
    if not is_within or (kind == "loguniform" and low <= 0):
        within = f"numbers from {limits.low:g} to {limits.high:g} {limits.unit}".rstrip()
        raise InputError(
            f"randomize: {name}: expected uniform(low,high), loguniform(low,high) or a number, "
            f"with low <= high and {within}, got {shortened(text)}"
        )
    return kind, (low, high)

"""Domain randomisation: what is drawn for each episode, of a vehicle, its effects and its start.

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
from .elementary import cos, exp, log, sin
from .random import Draw
from .rotations import product
from .state import Array, ByName, clip, looked_up, parts_of, stack


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
    usual: float = 0.0
    """Its value where it is not drawn."""


_TABLES = read_own_toml(__file__, "parameters")
PARAMETERS = {
    name: Parameter(**{"usual": 0.0 if table["unit"] else 1.0, **table})
    for name, table in _TABLES.items()
}
"""What can be drawn, by name."""
CENTER = ("center_x", "center_y", "center_z")
LEAST_MASS = 0.1  # share of a mass that is left under any load
WHOLE = ("action_delay", "observation_delay")
"""Parameters that are whole numbers; a uniform draw gives each the same chance."""
CHANGE = Parameter(-math.inf, math.inf, "1", "what only changes within an episode; 0 before")
_SHIFTS = {
    name: [f"start_{letter}{axis}" for axis in "xyz"]
    for name, letter in (("position", ""), ("velocity", "v"), ("body_rates", "w"))
}
CASE = "case"
"""Name of the number that says which alternatives an episode has, from 0."""
_TEXT = re.compile(r"\s*(uniform|loguniform)\s*\(([^()]*)\)\s*")

Distribution = tuple[str, tuple[float, float]]
"""Its kind, and its ends."""


class Randomization:
    """Distributions by the parameter's name, as texts: "uniform(0.8, 1.2)", or a number.

    `uniform(low, high)` and `loguniform(low, high)`; a number stands for itself. Alternatives stand
    between bars, as "1 | uniform(0.8, 1.2)": each episode draws a `case`, the place of the
    alternative that every parameter with several has. Raises `InputError` for anything else, and
    for a parameter whose effect is off. Effects None: this is not checked.

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
        self._kinds: dict[str, list[Distribution]] = {}
        given = mapping(texts, "randomize", "a mapping from names to distributions")
        check_names(given, PARAMETERS, "randomize")
        for name, text in given.items():
            parts = text.split("|") if isinstance(text, str) else [text]
            self._kinds[name] = [_distribution(name, part) for part in parts]
        counts = {len(kinds) for kinds in self._kinds.values()} - {1}
        self._cases = max(counts, default=1)
        if len(counts) > 1:
            got = " and ".join(map(str, sorted(counts)))
            raise InputError(f"randomize: expected as many alternatives of each, got {got}")
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
        drawn += [name for name in self._changing if name not in self._kinds]
        return (*drawn, CASE) if self._cases > 1 else tuple(drawn)

    def to_options(self) -> dict[str, float | str]:
        """The distributions by name in canonical form: a number, or a text."""
        options: dict[str, float | str] = {}
        for name, kinds in self._kinds.items():
            texts = [_text(*one) for one in kinds]
            (_, (low, high)), *others = kinds
            options[name] = " | ".join(texts) if others or low != high else low
        return options

    def most_steps(self, name: str) -> int:
        """Longest delay that can be, control steps; 0 where none is."""
        most = max((high for _, (_, high) in self._kinds.get(name, ())), default=0.0)
        return round(most + self._changing.get(name, 0.0))

    def shares(self, parameters: ByName) -> Array:
        """Where each of `names` is between the ends of what it may be: -1 to 1, shape (W, A, n)."""
        parts = []
        for name in self.names:
            low, high = self._ends(name)
            share = 2 * (parameters[name] - low) / max(high - low, 1e-9) - 1
            parts.append(clip(share, -1.0, 1.0))
        return stack(parts)

    def _ends(self, name: str) -> tuple[float, float]:
        if name == CASE:
            return 0.0, self._cases - 1.0
        ends = [end for _, pair in self._alternatives(name) for end in pair]
        change = self._changing.get(name, 0.0)
        return min(ends) + min(change, 0.0), max(ends) + max(change, 0.0)

    def draw(self, draw: Draw) -> ByName:
        """Values by name, shape (W, A)."""
        drawn = {}
        if self._cases > 1:
            case = np.floor(draw.uniform(0.0, self._cases))
            drawn[CASE] = np.repeat(case[:, :1], case.shape[1], axis=1)  # alike in a world
        for name in self.names:
            if name != CASE:
                share = draw.uniform(0.0, 1.0)
                drawn[name] = _drawn(name, self._alternatives(name), share, drawn.get(CASE))
        return drawn

    def _alternatives(self, name: str) -> list[Distribution]:
        usual = PARAMETERS.get(name, CHANGE).usual
        return self._kinds.get(name, [("uniform", (usual, usual))])


FIXED = Randomization({}, None)
"""Nothing is drawn."""


def moved(start: ByName, drawn: ByName) -> ByName:
    """A start, arrays by the names of an `InitialState`, that differs by what was drawn."""
    found = {**start}
    for name, shifts in _SHIFTS.items():
        if not drawn.keys().isdisjoint(shifts):
            found[name] = start[name] + stack([drawn.get(shift, 0.0) for shift in shifts])
    if "start_tilt" in drawn:
        half = math.radians(0.5) * drawn["start_tilt"]
        axis = math.radians(1.0) * drawn.get("start_axis", 0.0)
        turn = (cos(half), sin(half) * cos(axis), sin(half) * sin(axis), 0.0)
        found["quaternion"] = stack(product(turn, parts_of(start["quaternion"])))
    return found


def _drawn(name: str, kinds: Sequence[Distribution], share: Array, case: Array) -> Array:
    """Values at a share of the way between the ends, of the alternative of a case."""
    spare = 0.5 if name in WHOLE else 0.0  # what is rounded to the ends
    rows = []
    for kind, (low, high) in kinds:
        is_log = kind == "loguniform"
        first, last = (log(low), log(high)) if is_log else (low - spare, high + spare)
        rows.append((first, last - first, low, high, is_log))
    first, way, low, high, is_log = rows[0]
    if len(rows) > 1:
        first, way, low, high, is_log = parts_of(looked_up(np.array(rows, float), case))
    values = first + way * share
    if any(row[-1] for row in rows):
        values = np.where(is_log > 0, exp(values), values)
    values = clip(values, low, high)
    return np.rint(values) if name in WHOLE else values


def _text(kind: str, ends: tuple[float, float]) -> str:
    low, high = (repr(end).removesuffix(".0") for end in ends)
    return low if low == high else f"{kind}({low}, {high})"


def _distribution(name: str, text: object) -> Distribution:
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

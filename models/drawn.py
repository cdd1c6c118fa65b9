"""Craft that are drawn: `drawn:7` is one, and `drawn` or `drawn:0-999` another one in each episode.

A number stands for the same craft for ever, on every machine. `drawn.toml` says from what they are
drawn.
"""

import math
import re
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from .errors import InputError
from .files import read_own_toml
from .library import is_pool

SLOTS = 6
"""Most rotors of a drawn craft."""
MOST = 4096
"""Most craft of a pool."""
POOL = "drawn:0-2047"
"""What `drawn` stands for."""
GRAVITY = 9.81
"""Of a drawn craft's file, m/s²."""
_LEAST_LAG = 1e-4  # s
_MIDDLE = {"mass": math.log(50) / math.log(1000), "six": 0.0}  # of 1 kg, with six rotors
_RANGES = read_own_toml(__file__, "drawn")
_TYPICAL_ARM, _POWER = 0.22, 0.42  # m, and of the mass in kg
_ABSENT = 1e-9  # yaw of a slot without a rotor, which divisions need
_WORD = re.compile(r"drawn:(\d{1,9})(?:-(\d{1,9}))?")


class Craft(NamedTuple):
    """Drawn craft, arrays with the first axis N; SI units, axes of the body."""

    mass: np.ndarray
    thrust_to_weight: np.ndarray
    x: np.ndarray
    """Of each rotor, (N, SLOTS); 0 where there is none. So are y and turn."""
    y: np.ndarray
    turn: np.ndarray
    """1 where it turns clockwise, seen from above, else -1."""
    inertia: np.ndarray
    """About x, y and z at the center of mass, (N, 3)."""
    center: np.ndarray
    """Height of the center of mass above the rotors."""
    reaction: np.ndarray
    """Torque of a rotor about z per thrust, N·m/N."""
    lag: np.ndarray
    """Time constant of the rotors."""


def drawn_craft(numbers: range) -> Craft:
    """The craft of these numbers."""
    return _craft([np.random.default_rng(number).random(len(_RANGES)) for number in numbers])


def _craft(shares: Sequence[np.ndarray]) -> Craft:
    """Craft whose numbers lie at these shares of the ways between the ends of their ranges."""
    drawn = {
        name: _between(share, **ends)
        for (name, ends), share in zip(_RANGES.items(), np.transpose(shares), strict=True)
    }
    mass = _settled(drawn["mass"])
    typical = _TYPICAL_ARM * mass**_POWER
    arm = typical * drawn["arm"]
    six = drawn["six"] < 0.4
    rotors = np.where(six, 6, 4)
    layout = drawn["layout"]
    ahead = np.where(
        layout < 1, np.where(six, 30.0, 45.0), np.where(layout < 2, 0.0, drawn["azimuth"])
    )
    wide = np.where(six | (abs(drawn["stretch"]) < 10), 0.0, drawn["stretch"] / 2)
    slot = np.arange(SLOTS)[:, None]
    angle = np.radians(ahead + slot * 360 / rotors + wide * (slot % 2 - 0.5))
    there = slot < rotors
    first_turn = np.where(drawn["turn"] < 0, -1.0, 1.0)
    about = drawn["inertia"] * mass * arm * typical
    root = np.sqrt(drawn["aspect"])
    inertia = np.stack((about / root, about * root, 2 * about), axis=-1)
    inertia[:, 2] = drawn["flat"] * (inertia[:, 0] + inertia[:, 1])
    return Craft(
        mass=mass,
        thrust_to_weight=_settled(drawn["thrust_to_weight"]),
        x=_settled((there * arm * np.cos(angle)).T),
        y=_settled((there * arm * np.sin(angle)).T),
        turn=(there * first_turn * (1.0 - 2.0 * (slot % 2))).T,
        inertia=_settled(inertia),
        center=_settled(arm * drawn["center"]),
        reaction=_settled(arm * drawn["reaction"]),
        lag=_settled(np.maximum(drawn["lag"] - 0.025, _LEAST_LAG)),
    )


def range_of(word: str) -> range:
    """The numbers of the craft of a word, as `drawn:0-999`. Raises `InputError`."""
    match = _WORD.fullmatch(POOL if word == "drawn" else word)
    first, last = match.groups() if match else ("0", "-1")
    numbers = range(int(first), int(last or first) + 1)
    if not 0 < len(numbers) <= MOST:
        raise InputError(
            f"vehicle: expected drawn, drawn:NUMBER or drawn:FIRST-LAST with at most {MOST} craft "
            f"and numbers below 1e9, got {word!r:.100}"
        )
    return numbers


def middle_file() -> Path:
    """A TOML file as of `drawn_file`, of a craft of 1 kg with six rotors in the middle of all
    other ranges.
    """
    return _file_of("drawn", _craft([np.array([_MIDDLE.get(name, 0.5) for name in _RANGES])]))


def drawn_file(word: str) -> Path:
    """A TOML file of one drawn craft, `drawn:NUMBER`, in a folder that lasts as long as this
    process. Raises `InputError`.
    """
    numbers = range_of(word)
    if is_pool(word):
        raise InputError(f"vehicle: expected one craft, as drawn:{numbers[0]}, got {word}")
    return _file_of(word.replace(":", "-"), drawn_craft(numbers))


_WIDTHS = {
    "inertia": 3, "center": 1, "x": SLOTS, "y": SLOTS, "yaw": SLOTS, "share": SLOTS,
    "mix": 3 * SLOTS, "highest": 1, "lag": 1, "turning": 3,
}  # fmt: skip


def columns(rows: Any) -> Mapping[str, Any]:
    """Parts of rows of a pool's table, (..., k), by name, each (..., m).

    Per kilogram: `inertia`, kg·m²; `center`, height of the center of mass, m; `x`, `y`, `yaw`:
    place of each rotor, m, and its torque about z per thrust, N·m/N; `share` and `mix`, rotor by
    rotor, `highest`: as `Gains` has them; `lag`, s; `turning`, the largest angular accelerations,
    rad/s².
    """
    found = {}
    first = 0
    for name, width in _WIDTHS.items():
        found[name] = rows[..., first : first + width]
        first += width
    return found


def table_of(craft: Craft) -> np.ndarray:
    """Rows of craft, per kilogram, as `columns` says."""
    x, y = craft.x, craft.y
    yaw = craft.turn * craft.reaction[:, None]
    there = abs(craft.turn)
    count = there.sum(axis=1, keepdims=True)
    xx = (x * x).sum(axis=1, keepdims=True)
    xy = (x * y).sum(axis=1, keepdims=True)
    yy = (y * y).sum(axis=1, keepdims=True)
    size = count / (xx * yy - xy * xy)
    # The least thrusts of a torque: rotors are point symmetric and turn by turns, so that those
    # of yaw and of the collective thrust are orthogonal to each other and to roll and pitch.
    mix = np.stack(
        (
            size * (xx * y - xy * x),
            size * (xy * y - yy * x),
            there / np.where(yaw == 0, 1.0, yaw) + _ABSENT * (1 - there),
        ),
        axis=-1,
    )
    inertia = craft.inertia / craft.mass[:, None]
    highest = craft.thrust_to_weight[:, None] * GRAVITY
    pushes = [np.maximum(lever, 0.0).sum(axis=1) for lever in (y, x, yaw)]
    parts = {
        "inertia": inertia,
        "center": craft.center[:, None],
        "x": x,
        "y": y,
        "yaw": yaw,
        "share": there / count,
        "mix": mix.reshape(len(x), -1),
        "highest": highest,
        "lag": craft.lag[:, None],
        "turning": highest / count * np.stack(pushes, axis=1) / inertia,
    }
    return np.concat([parts[name] for name in _WIDTHS], axis=1)


def _file_of(name: str, craft: Craft) -> Path:
    """A TOML file of the first of some craft."""
    mass = float(craft.mass[0])
    there = np.flatnonzero(craft.turn[0]).tolist()
    thrust = float(craft.thrust_to_weight[0]) * mass * GRAVITY / len(there)
    turns = {1.0: "cw", -1.0: "ccw"}
    rotors = [
        f'[[rotors.list]]\nname = "rotor{i + 1}"\nturn = "{turns[craft.turn[0, i]]}"\n'
        f"position = [{craft.x[0, i]}, {craft.y[0, i]}, 0.0]\n"
        for i in there
    ]
    text = f"""name = "{name}"
timestep = 0.005
gravity = {GRAVITY}

[body]
mass = {mass}
inertia = {craft.inertia[0].tolist()}
center_of_mass = [0.0, 0.0, {craft.center[0]}]

{"".join(rotors)}
[rotors]
thrust = [0.0, {thrust}]
reaction = {craft.reaction[0]}
time_constant = {craft.lag[0]}
"""
    file = Path(_folder().name, f"{name}.toml")
    if not file.exists():
        file.write_text(text, encoding="utf-8")
    return file


def remove_files() -> None:
    """Remove the files of drawn craft, in a process that ends without Python's own end."""
    if _folder.cache_info().currsize:
        _folder().cleanup()


@cache
def _folder() -> TemporaryDirectory[str]:
    """Of the files, as long as this process needs them."""
    return TemporaryDirectory(prefix="rotorgram-", ignore_cleanup_errors=True)


def _between(share: np.ndarray, low: float, high: float, log: bool = False) -> np.ndarray:
    return low * (high / low) ** share if log else low + (high - low) * share


def _settled(values: np.ndarray) -> np.ndarray:
    """Rounded to six digits, as its file has them: the last bits differ between processors."""
    digits = [float(f"{value:.6g}") for value in values.ravel().tolist()]
    return np.reshape(digits, values.shape)

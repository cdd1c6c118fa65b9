"""Plots of flights over time: their telemetry, several flights laid over each other."""

import math
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..models.errors import InputError, require
from ..sim.rotations import euler
from .palette import FLIGHT_COLORS
from .signals import QUATERNION, Signal, signals_of
from .trajectories import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

Floats = NDArray[np.float64]

FORMATS = (".png", ".pdf", ".svg")
_COLUMNS = 3
_FIRST = (
    "position", "velocity", "attitude", "body_rates", "rates", "thrust", "battery", "voltage",
    "wind",
)  # fmt: skip
"""Order of the signals; others follow."""
_ON_POSITION = {"goal": "--", "payload": ":"}
"""Signals that are drawn beside the position, and their line style."""
_HIDDEN = ("time", "drawn", "action", "reward", *_ON_POSITION)
_WIDTH = 11.0  # inches
_ROW = 1.75  # inches


class Panel(NamedTuple):
    """One pair of axes: a number of a signal."""

    signal: str
    component: int
    label: str


def plot_flights(flights: Mapping[str, Trajectory], out: Path) -> None:
    """Draw flights, by the names in the legend, into a file of one of the `FORMATS`.

    A flight without a signal that another one has is not in its panels. Raises `InputError`:
    another ending; `MissingPackage`: there is no matplotlib; `OSError`: it cannot be written.
    """
    if out.suffix.lower() not in FORMATS:
        raise InputError(f"out: expected a file that ends in {', '.join(FORMATS)}, got {out.name}")
    require("matplotlib", "report", "a plot")
    from matplotlib import rc_context

    signals = {name: _shown(flight) for name, flight in flights.items()}
    with rc_context({"font.size": 9, "svg.fonttype": "none", "pdf.fonttype": 42}):
        figure = _drawn(flights, signals)
        figure.savefig(out, dpi=150)


def panels_of(signals: Sequence[Mapping[str, Signal]]) -> list[Panel]:
    """A panel for each number that any of the flights has, row by row."""
    kinds: dict[str, Signal] = {}
    for flight in signals:
        kinds = {**flight, **kinds}
    known = [name for name in _FIRST if name in kinds]
    others = [name for name in kinds if name not in known and name not in _HIDDEN]
    vectors: list[Panel] = []  # each fills a row
    rest: list[Panel] = []
    for name in known + others:
        signal = kinds[name]
        panels = vectors if len(signal.components) == _COLUMNS else rest
        for i, component in enumerate(signal.components):
            panels.append(Panel(name, i, _label(component, signal.units[i])))
    return vectors + rest


def _shown(flight: Trajectory) -> dict[str, Signal]:
    """The signals by name: each metric by itself, a quaternion as roll, pitch and yaw."""
    shown = {}
    for signal in signals_of(flight):
        if signal.name == "metrics":
            for i, (name, unit) in enumerate(zip(signal.components, signal.units, strict=True)):
                shown[name] = Signal(name, (name,), (unit,), signal.values[:, i : i + 1])
        elif signal.components == QUATERNION:
            angles = np.degrees(roll_pitch_yaw(signal.values))
            shown[signal.name] = Signal(signal.name, ("roll", "pitch", "yaw"), ("deg",) * 3, angles)
        else:
            shown[signal.name] = signal
    return shown


def roll_pitch_yaw(quaternion: Floats) -> Floats:
    """Angles about x, y and z of R = Rz(yaw) Ry(pitch) Rx(roll), rad, shape (T, 3).

    Roll and yaw have no jumps by a whole turn. Quaternions have shape (T, 4), scalar first.
    """
    roll, pitch, yaw = euler(quaternion)
    return np.stack((np.unwrap(roll), pitch, np.unwrap(yaw)), axis=-1)


def _label(name: str, unit: str) -> str:
    words = name.replace("_", " ")
    return f"{words} ({unit})" if unit else words


def _drawn(
    flights: Mapping[str, Trajectory], signals: Mapping[str, Mapping[str, Signal]]
) -> "Figure":
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    panels = panels_of(list(signals.values()))
    rows = math.ceil(len(panels) / _COLUMNS)
    figure = Figure(figsize=(_WIDTH, _ROW * rows + 0.6), layout="constrained")
    first: Axes | None = None
    for number, panel in enumerate(panels):
        axes = figure.add_subplot(rows, _COLUMNS, number + 1, sharex=first)
        first = first or axes
        _draw_panel(axes, panel, flights, signals)
        if number >= len(panels) - _COLUMNS:
            axes.set_xlabel("time (s)")
    if len(flights) > 1:
        lines = [Line2D([], [], color=color) for color, _ in zip(cycle(FLIGHT_COLORS), flights)]
        columns = min(len(flights), 4)
        figure.legend(lines, list(flights), loc="outside upper left", ncols=columns, frameon=False)
    else:
        figure.suptitle(next(iter(flights)), x=0.01, ha="left", fontsize=11)
    return figure


def _draw_panel(
    axes: "Axes",
    panel: Panel,
    flights: Mapping[str, Trajectory],
    signals: Mapping[str, Mapping[str, Signal]],
) -> None:
    keys: dict[str, Line2D] = {}  # of the panel's own legend
    for (name, flight), color in zip(flights.items(), cycle(FLIGHT_COLORS), strict=False):
        signal = signals[name].get(panel.signal)
        if signal is None or panel.component >= len(signal.components):
            continue
        values = signal.values[:, panel.component]
        axes.plot(flight.times, values, color=color, linewidth=1.2)
        if flight.terminated:  # a cross
            axes.plot(flight.times[-1], values[-1], "x", color=color, markersize=6)
        for other, style in _ON_POSITION.items():
            if panel.signal == "position" and other in signals[name]:
                beside = signals[name][other].values[:, panel.component]
                own = color if len(flights) > 1 else "0.4"
                (line,) = axes.plot(flight.times, beside, style, color=own, linewidth=1.0)
                keys.setdefault(other, line)
    axes.set_ylabel(panel.label)
    axes.grid(visible=True, color="0.9", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0.01)
    if keys:
        axes.legend(keys.values(), keys.keys(), loc="best", fontsize=8)

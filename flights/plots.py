"""Plots of flights over time: their telemetry, several flights laid over each other."""

import math
from collections.abc import Mapping
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..models.errors import require
from ..sim.rotations import euler
from .palette import FLIGHT_COLORS
from .plans import drawn_plan
from .signals import QUATERNION, Column, Signal, signals_of
from .trajectories import Floats, Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

Columns = dict[str, Column]

FORMATS = (".png", ".pdf", ".svg")
_COLUMNS = 3
_FIRST = (
    "position", "velocity", "attitude", "body_rates", "rates", "wind", "thrust", "battery",
    "voltage",
)  # fmt: skip
"""Order of the signals; others follow."""
_ON_POSITION = {"goal": "--", "payload": ":"}
"""Signals that are drawn beside the position, and their line style."""
_HIDDEN = ("time", "drawn", "action", "reward")
_WIDTH = 11.0  # inches
_ROW = 1.75  # inches


def plot_flights(flights: Mapping[str, Trajectory], out: Path, *, plan: bool = False) -> None:
    """Draw flights, by the names in the legend, into a file of one of the `FORMATS`; or their plan.

    A flight without a signal that another one has is not in its panels. Raises `ValueError`:
    another ending; `MissingPackage`: there is no matplotlib; `OSError`: it cannot be written; and
    what `drawn_plan` raises.
    """
    require("matplotlib", "report", "a plot")
    from matplotlib import rc_context

    with rc_context({"font.size": 9, "svg.fonttype": "none", "pdf.fonttype": 42}):
        figure = drawn_plan(flights) if plan else _drawn(flights)
        figure.savefig(out, dpi=150)


def shown_columns(flight: Trajectory) -> Columns:
    """The numbers of a flight by name, in the order of their panels; attitude as angles."""
    signals = {signal.name: signal for signal in signals_of(flight)}
    names = [name for name in _FIRST if name in signals]
    names += [name for name in signals if name not in (*_FIRST, *_HIDDEN)]
    columns: Columns = {}
    for name in names:
        signal = signals[name]
        if signal.components == QUATERNION:
            angles = np.degrees(roll_pitch_yaw(signal.values))
            signal = Signal(name, ("roll", "pitch", "yaw"), ("deg",) * 3, angles)
        columns |= {column.name: column for column in signal.columns()}
    return columns


def roll_pitch_yaw(quaternion: Floats) -> Floats:
    """Angles about x, y and z of R = Rz(yaw) Ry(pitch) Rx(roll), rad, shape (T, 3).

    Roll and yaw have no jumps by a whole turn. Quaternions have shape (T, 4), scalar first.
    """
    roll, pitch, yaw = euler(quaternion)
    return np.stack((np.unwrap(roll), pitch, np.unwrap(yaw)), axis=-1)


def _drawn(flights: Mapping[str, Trajectory]) -> "Figure":
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    columns = {name: shown_columns(flight) for name, flight in flights.items()}
    panels: Columns = {}
    for own in columns.values():
        panels = own | panels
    for other in _ON_POSITION:
        for axis in "xyz":
            panels.pop(f"{other}_{axis}", None)
    rows = math.ceil(len(panels) / _COLUMNS)
    figure = Figure(figsize=(_WIDTH, _ROW * rows + 0.6), layout="constrained")
    first: Axes | None = None
    for number, panel in enumerate(panels.values()):
        axes = figure.add_subplot(rows, _COLUMNS, number + 1, sharex=first)
        first = first or axes
        _draw_panel(axes, panel, flights, columns)
        if number >= len(panels) - _COLUMNS:
            axes.set_xlabel("time (s)")
    if len(flights) > 1:
        lines = [Line2D([], [], color=color) for color, _ in zip(cycle(FLIGHT_COLORS), flights)]
        ncols = min(len(flights), 4)
        figure.legend(lines, list(flights), loc="outside upper left", ncols=ncols, frameon=False)
    else:
        figure.suptitle(next(iter(flights)), x=0.01, ha="left", fontsize=11)
    return figure


def _draw_panel(
    axes: "Axes", panel: Column, flights: Mapping[str, Trajectory], columns: Mapping[str, Columns]
) -> None:
    keys: dict[str, Line2D] = {}  # of the panel's own legend
    for (name, flight), color in zip(flights.items(), cycle(FLIGHT_COLORS), strict=False):
        own = columns[name]
        if panel.name not in own:
            continue
        values = own[panel.name].values
        axes.plot(flight.times, values, color=color, linewidth=1.2)
        if flight.terminated:  # a cross
            axes.plot(flight.times[-1], values[-1], "x", color=color, markersize=6)
        for other, style in _ON_POSITION.items():
            beside = own.get(f"{other}_{panel.name}")
            if beside is not None:
                shade = color if len(flights) > 1 else "0.4"
                (line,) = axes.plot(flight.times, beside.values, style, color=shade, linewidth=1.0)
                keys.setdefault(other, line)
    words = panel.name.replace("_", " ")
    axes.set_ylabel(f"{words} ({panel.unit})" if panel.unit else words)
    axes.grid(visible=True, color="0.9", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0.01)
    if keys:
        axes.legend(keys.values(), keys.keys(), loc="best", fontsize=8)

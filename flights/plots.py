"""Plots of flights over time: their telemetry, several flights laid over each other."""

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
_STYLES = ("-", "--", ":", "-.")
"""Line styles of the numbers in one panel."""
_WIDTH = 11.0  # inches
_ROW = 1.75  # inches


class Panel(NamedTuple):
    """One pair of axes: some numbers of a signal."""

    signal: str
    components: tuple[int, ...]
    label: str
    wide: bool
    """It takes a whole row."""


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
    """Panels of all signals that any of the flights has, row by row."""
    kinds: dict[str, Signal] = {}
    for flight in signals:
        kinds = {**flight, **kinds}
    known = [name for name in _FIRST if name in kinds]
    others = [name for name in kinds if name not in known and name not in _HIDDEN]
    vectors: list[Panel] = []
    wides: list[Panel] = []
    scalars: list[Panel] = []
    for name in known + others:
        signal = kinds[name]
        count = len(signal.components)
        if name == "thrust" or count > _COLUMNS:
            wides.append(Panel(name, tuple(range(count)), _label(name, signal.units[0]), True))
            continue
        panels = vectors if count == _COLUMNS else scalars
        for i, component in enumerate(signal.components):
            panels.append(Panel(name, (i,), _label(component, signal.units[i]), False))
    return vectors + wides + scalars


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
    places = _places(panels)
    rows = places[-1][0] + 1
    figure = Figure(figsize=(_WIDTH, _ROW * rows + 0.6), layout="constrained")
    grid = figure.add_gridspec(rows, _COLUMNS)
    drawn: list[Axes] = []
    for panel, (row, column) in zip(panels, places, strict=True):
        cell = grid[row, :] if panel.wide else grid[row, column]
        axes = figure.add_subplot(cell, sharex=drawn[0] if drawn else None)
        drawn.append(axes)
        _draw_panel(axes, panel, flights, signals)
        if row == rows - 1:
            axes.set_xlabel("time (s)")
    if len(flights) > 1:
        lines = [Line2D([], [], color=color) for color, _ in zip(cycle(FLIGHT_COLORS), flights)]
        columns = min(len(flights), 4)
        figure.legend(lines, list(flights), loc="outside upper left", ncols=columns, frameon=False)
    else:
        figure.suptitle(next(iter(flights)), x=0.01, ha="left", fontsize=11)
    return figure


def _places(panels: Sequence[Panel]) -> list[tuple[int, int]]:
    """Row and column of each panel, side by side; a wide one has a row of its own."""
    places = []
    row = 0
    column = 0
    for panel in panels:
        if column and (panel.wide or column == _COLUMNS):
            row += 1
            column = 0
        places.append((row, column))
        column += _COLUMNS if panel.wide else 1
    return places


def _draw_panel(
    axes: "Axes",
    panel: Panel,
    flights: Mapping[str, Trajectory],
    signals: Mapping[str, Mapping[str, Signal]],
) -> None:
    several = len(flights) > 1
    colors = cycle(FLIGHT_COLORS)
    keys: dict[str, Line2D] = {}  # of the panel's own legend
    for (name, flight), color in zip(flights.items(), colors, strict=False):
        signal = signals[name].get(panel.signal)
        if signal is None:
            continue
        for number, component in enumerate(panel.components[: len(signal.components)]):
            values = signal.values[:, component]
            own = color if several else FLIGHT_COLORS[number % len(FLIGHT_COLORS)]
            style = _STYLES[number % len(_STYLES)] if several else "-"
            (line,) = axes.plot(flight.times, values, style, color=own, linewidth=1.2)
            if len(panel.components) > 1:
                keys.setdefault(signal.components[component], line)
        if flight.terminated:  # a cross
            ends = signal.values[-1, list(panel.components)]
            for end in ends:
                axes.plot(flight.times[-1], end, "x", color=color, markersize=6)
        if panel.signal == "position":
            for other, style in _ON_POSITION.items():
                if other in signals[name]:
                    values = signals[name][other].values[:, panel.components[0]]
                    own = color if several else "0.4"
                    (line,) = axes.plot(flight.times, values, style, color=own, linewidth=1.0)
                    keys.setdefault(other, line)
    axes.set_ylabel(panel.label)
    axes.grid(visible=True, color="0.9", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0.01)
    if keys:
        ncols = len(keys) if panel.wide else 1
        axes.legend(keys.values(), keys.keys(), loc="best", ncols=ncols, fontsize=8)

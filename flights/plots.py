"""Plots of flights: their telemetry over time, laid over each other, or their paths from above."""

import math
from collections.abc import Mapping
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..envs.spec import ArraySpec
from ..models.errors import InputError, require
from ..scenes.solids import Solids
from ..sim.rotations import euler
from .palette import FLIGHT_COLORS
from .signals import QUATERNION, Column, columns_of_array
from .trajectories import Floats, Trajectory, common_scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

Columns = dict[str, Column]

FORMATS = (".png", ".pdf", ".svg")
_COLUMNS = 3
_ON_POSITION = {"goal": "--", "payload": ":"}
"""Arrays that are drawn beside the position, and their line style."""
_HIDDEN = ("time", "drawn")
_ANGLES = ArraySpec(name="attitude", shape=(3,), unit="deg", components=("roll", "pitch", "yaw"))
_WIDTH = 11.0  # inches
_ROW = 1.75  # inches
_PLAN_SIZE = (9.0, 5.4)  # inches
_CELLS = 600  # along each side of the grid of distances whose contours are the outlines


def plot_flights(flights: Mapping[str, Trajectory], out: Path, *, plan: bool = False) -> None:
    """Draw flights, by the names in the legend, into a file of one of the `FORMATS`; or their plan.

    A flight without a number that another one has is not in its panel. Raises `ValueError`:
    another ending; `MissingPackage`: there is no matplotlib; `OSError`: it cannot be written; and
    what `drawn_plan` raises.
    """
    require("matplotlib", "report", "a plot")
    from matplotlib import rc_context

    with rc_context({"font.size": 9, "svg.fonttype": "none", "pdf.fonttype": 42}):
        figure = drawn_plan(flights) if plan else _drawn(flights)
        figure.savefig(out, dpi=150)


def shown_columns(flight: Trajectory) -> Columns:
    """The numbers of a flight's telemetry by name, in its order; attitude as angles."""
    columns: Columns = {}
    for array in flight.spec.telemetry:
        if array.name in _HIDDEN:
            continue
        values = flight.telemetry[array.name]
        if array.components == QUATERNION:
            array = _ANGLES
            values = np.degrees(roll_pitch_yaw(values))
        columns |= {column.name: column for column in columns_of_array(array, values)}
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


# ---- plans


def drawn_plan(flights: Mapping[str, Trajectory]) -> "Figure":
    """Paths of flights in one layout from above, a dot for each control step in the colour of its
    speed.

    Solids are cut at the median height of the paths. A cross is where a flight was terminated
    within the craft's radius of a solid or of the ground. Raises `InputError`: the flights have
    different layouts, or one whose solids move, or no position.
    """
    from matplotlib.figure import Figure

    flown = list(flights.values())
    scene = common_scene(flight.scene for flight in flown)
    solids = Solids.of_scene(scene)
    if solids.moves.any():
        raise InputError(f"plan: expected a scene whose solids stand still, got {scene}")
    constants = flown[0].spec.constants
    period = flown[0].spec.control_period
    paths = [flight.pose[:, :3] for flight in flown]
    speeds = [np.linalg.norm(np.gradient(path, period, axis=0), axis=1) for path in paths]
    ends = [flight.pose[-1, :3] for flight in flown if flight.terminated]
    marks = {
        "start": ("ko", [path[0] for path in paths]),
        "goal": ("k*", [goal for flight in flown for goal in flight.telemetry.get("goal", ())]),
        "touched": ("rX", [end for end in ends if solids.distance(end) <= constants["radius"]]),
    }
    figure = Figure(_PLAN_SIZE, layout="constrained")
    axes = figure.add_subplot(xlabel="x (m)", ylabel="y (m)")
    x, y, z = np.concatenate(paths).T
    dots = axes.scatter(x, y, 9, np.concatenate(speeds), cmap="turbo", vmin=0.0)
    figure.colorbar(dots, label="speed (m/s)", pad=0.01)
    for name, (look, places) in marks.items():
        x, y, _ = np.reshape(places, (-1, 3)).T
        axes.plot(x, y, look, markersize=9, label=name)
    axes.legend(loc="upper left", ncols=3)
    height = np.median(z)
    axes.set_title(f"{scene}: solids at a height of {height:.1f} m", loc="left", fontsize=9)
    axes.set_aspect("equal", "datalim")
    axes.margins(0.2)
    figure.draw_without_rendering()  # the layout sets the limits
    across = np.linspace(*axes.get_xlim(), _CELLS)
    up = np.linspace(*axes.get_ylim(), _CELLS)
    points = np.stack(np.meshgrid(across, up, height), axis=-1)[:, :, 0]
    axes.contourf(across, up, solids.distance(points), levels=(-1e9, 0.0), colors="#7f8d7b")
    return figure

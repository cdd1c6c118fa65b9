"""Plans: paths in a scene seen from above, among the solids at their height."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from ..models.errors import InputError
from ..scenes.solids import Solids
from .trajectories import Trajectory, common_scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SIZE = (9.0, 5.4)  # inches
_CELLS = 600  # along each side of the grid of distances whose contours are the outlines


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
    figure = Figure(_SIZE, layout="constrained")
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

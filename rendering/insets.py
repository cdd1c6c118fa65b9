"""What sensors with rays read, beside the scene: depth images, and points seen from above."""

import numpy as np

from ..scenes.returns import Reading
from .film import Picture
from .stage import Array, Moment, range_colors

_SHARE = 0.4  # of a picture's width and height, at most
_GAP = 6  # pixels about an inset
_DARK = (0.05, 0.07, 0.10)
_GREY = (0.23, 0.25, 0.29)
_CELL = 0.5  # m, of a view from above
_MIDDLE = 40  # cells from its edge to the craft
_RING = 10  # cells between two circles


def add_insets(picture: Picture, moment: Moment) -> None:
    """Draw the readings of a craft into the upper right corner of a picture, below each other.

    The first row of each is the scale of its colours, from 0 to the sensor's reach.
    """
    height, width, _ = picture.shape
    top = _GAP
    for reading in moment.readings:
        if top >= height:
            break
        reach = reading.reach
        view = range_colors(reading.distances, reach)
        if not reading.is_flat:
            view = _from_above(reading, view)
        rows, columns, _ = view.shape
        scale = range_colors(np.linspace(0.0, reach, columns), reach)
        inset = (255 * np.concatenate((scale[None], view))).astype(np.uint8)
        times = max(1, int(_SHARE * min(width / columns, height / rows)))
        inset = inset.repeat(times, axis=0).repeat(times, axis=1)[: height - top, : width - _GAP]
        bottom = top + len(inset)
        picture[top:bottom, width - _GAP - inset.shape[1] : width - _GAP] = inset
        top = bottom + _GAP


def _from_above(reading: Reading, colors: Array) -> Array:
    """Points within 20 m of a craft, x upwards and y to the left; circles are 5 m apart."""
    size = 2 * _MIDDLE + 1
    away = np.hypot(*(np.indices((size, size)) - _MIDDLE)).round()
    cells = np.where((away % _RING == 0)[..., None], _GREY, _DARK)
    offsets = (reading.points - reading.origin)[..., :2] / _CELL
    near = abs(offsets).max(axis=-1) <= _MIDDLE
    rows, columns = _MIDDLE - offsets[near].round().astype(int).T
    cells[rows, columns] = colors[near]
    return cells

"""What sensors with rays read, beside the scene: a cell for each ray."""

import numpy as np

from .film import Picture
from .stage import Moment, range_colors

_SHARE = 0.4  # of a picture's width and height, at most
_GAP = 6  # pixels about an inset
_LEAST = 16  # pixels of its height, at least


def add_insets(picture: Picture, moment: Moment) -> None:
    """Draw the readings of a craft into the upper right corner of a picture, below each other.

    The first row of each is the scale of its colours, from 0 to the sensor's reach. A lidar has a
    row for each ring.
    """
    height, width, _ = picture.shape
    top = _GAP
    for reading in moment.readings:
        if top >= height:
            break
        reach = reading.reach
        view = range_colors(reading.distances, reach)
        rows, columns, _ = view.shape
        scale = range_colors(np.linspace(0.0, reach, columns), reach)
        inset = (255 * np.concatenate((scale[None], view))).astype(np.uint8)
        times = max(1, int(_SHARE * min(width / columns, height / rows)))
        high = max(times, _LEAST // len(inset))
        inset = inset.repeat(high, axis=0).repeat(times, axis=1)[: height - top, : width - _GAP]
        bottom = top + len(inset)
        picture[top:bottom, width - _GAP - inset.shape[1] : width - _GAP] = inset
        top = bottom + _GAP

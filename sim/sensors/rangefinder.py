"""Rangefinder."""

from ..state import Array, clip, stack
from .base import Bounds, Sensor, Values


class Rangefinder(Sensor):
    """Distance from the body's origin along its -z axis, by a ray; white noise.

    It reads its limit where there is nothing.
    """

    name = "rangefinder"
    prefix = "range_"
    columns = 1
    needs = ("noise", "limit")
    frame = "body, along -z"
    components = ("distance",)
    units = ("m",)

    @classmethod
    def bounds(cls, values: Values) -> Bounds:
        return (0.0,), (values["limit"],)

    def measure(self, normal: Array) -> Array:
        distance = clip(self.world.below(), 0.0, self.values["limit"])
        return stack((distance,)) + self.values["noise"] * normal

"""Rangefinder."""

from ..state import Array, clip, stack
from ..world import World
from .base import Sensor


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

    def high(self) -> tuple[float, ...]:
        return (self.values["limit"],)

    def low(self) -> tuple[float, ...]:
        return (0.0,)

    def measure(self, world: World, normal: Array) -> Array:
        distance = clip(world.below(), 0.0, self.values["limit"])
        return stack((distance,)) + self.values["noise"] * normal

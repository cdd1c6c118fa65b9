"""A task of one's own in one file: come down and stand on the ground. See docs/extending.md.

rotorgram train a2c --env landing:Landing-v0
"""

from dataclasses import dataclass
from typing import Annotated

from rotorgram.envs import ArraySpec, Limits, Metric, Outcome, Task, TaskOptions, register
from rotorgram.sim import InitialState, clip, stack


@dataclass(frozen=True, kw_only=True)
class LandingOptions(TaskOptions):
    """Options of `Landing-v0`."""

    start: Annotated[float, Limits(2.0, 50.0, "m")] = 4.0
    """Mean height at which an episode begins, m above the ground; drawn from ± 1 m of it."""


class Landing(Task):
    """Come down, never faster than 1.5 m/s in the last 0.3 m, and stay down."""

    Options = LandingOptions
    action = "offset"
    episode_length = 400
    worst_step = -1.0
    metrics = (Metric(name="height", unit="m", settled=0.05, held=0.1, symbol="h"),)

    def setup(self):
        self.highest = 2.0 * self.options.start + 1.0
        self.observation = (
            ArraySpec(
                name="observation",
                shape=(2,),
                low=(-1.0, -20.0),
                high=(self.highest + 20.0, 20.0),
                unit=("m", "m/s"),
                frame="world, up",
                components=("height", "climb rate"),
            ),
        )

    def begin(self, draw):
        height = self.options.start + draw.uniform(-1.0, 1.0)
        return InitialState(position=stack((0.0, 0.0, self.vehicle.rest_height + height)))

    def observe(self, state):
        height = self.height(state)
        climb = state.velocity[..., 2]
        seen = stack((clip(height, -1.0, self.highest + 20.0), clip(climb, -20.0, 20.0)))
        return {"observation": seen}

    def outcome(self, state):
        height = self.height(state)
        climb = state.velocity[..., 2]
        hard = (height < 0.3) & (climb < -1.5)
        ended = hard | (height > self.highest) | (state.tilt_cosine < 0.5)
        nearness = (0.5 - abs(height)) / (0.5 + abs(height))
        return Outcome(
            reward={"nearness": nearness, "end": self.crash(ended)},
            terminated=ended,
            metrics={"height": height},
        )

    def goal(self, state):
        return stack((0.0, 0.0, 0.0 * state.position[..., 2] + self.vehicle.rest_height))

    def height(self, state):
        """Of the skids above the ground, m."""
        return state.position[..., 2] - self.vehicle.rest_height


register("Landing-v0", Landing)

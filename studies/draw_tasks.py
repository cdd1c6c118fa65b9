"""Draw `docs/images/tasks/NAME.png`: a moment of a flight of each task.

Run `python studies/draw_tasks.py [--out FOLDER]`; it needs no display. The
PID flies the task of the paper, `geometric` the others.

It takes about half a minute on two cores.
"""

from typing import NamedTuple

from measuring import IMAGES, options
from PIL import Image
from rotorgram.agents import CONTROLLERS
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec
from rotorgram.flights.filming import moments
from rotorgram.flights.trajectories import flown_trajectories
from rotorgram.rendering import Camera, Canvas, Stage

WIDTH = 480
HEIGHT = 270
TIMES = 2  # drawn larger and reduced: smooth edges
COLORS = 128  # of a picture: a quarter of the bytes


class Scene(NamedTuple):
    """The step of an evaluation's first episode that is drawn, and how."""

    step: int
    camera: Camera = "front"
    agent: str = "geometric"


SCENES = {
    "Elevation": Scene(20, agent="pid"),
    "Hover": Scene(20),
    "Waypoints": Scene(60, "chase"),
    "Tracking": Scene(150, "chase"),
    "Racing": Scene(60, "chase"),
    "Landing": Scene(90, "top"),
    "Recovery": Scene(25),
    "PayloadHover": Scene(25, "chase"),
}


def draw(name: str, scene: Scene) -> Image.Image:
    """A picture of the task by its name without ending."""
    agent = CONTROLLERS[scene.agent]
    config = EnvConfig.from_keywords(f"rotorgram/{name}-v0", **agent.options)
    (flown,) = flown_trajectories(agent(env_spec(config)), config, [0])
    stage = Stage()
    with Canvas(stage, WIDTH * TIMES, HEIGHT * TIMES) as canvas:
        for moment in moments(flown)[: scene.step + 1]:
            stage.show(moment)
        return Image.fromarray(canvas.draw(scene.camera)).reduce(TIMES)


def main() -> None:
    out = options(__doc__, out=IMAGES / "tasks").parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    for name, scene in SCENES.items():
        path = out / f"{name}.png"
        draw(name, scene).quantize(COLORS).save(path, optimize=True)
        print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB", flush=True)


if __name__ == "__main__":
    main()

"""Draw `docs/images/drone.png`: the craft hovering above the floor, without a display.

Run `python studies/draw_drone.py`; it needs EGL (on Debian: libegl1, libgl1-mesa-dri).

It takes a few seconds on two cores.
"""

import os

os.environ.setdefault("MUJOCO_GL", "egl")  # before mujoco is imported: it chooses once
import mujoco
from measuring import IMAGES, options
from PIL import Image
from rotorgram.scenes import build_scene

WIDTH = 1200
HEIGHT = 675
OVERSAMPLING = 1.5  # drawn larger and reduced: smooth edges of thin arms and discs
ALTITUDE = 1.2  # m: low enough for craft and shadow to share the picture


def draw() -> Image.Image:
    """The picture, WIDTH x HEIGHT, RGB: front and right side of the craft from above its level."""
    model = build_scene().compile()
    data = mujoco.MjData(model)
    data.qpos[2] = ALTITUDE
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.azimuth = 164.0
    camera.elevation = -20.0
    camera.distance = 4.25
    camera.lookat[:] = (0.0, 0.0, ALTITUDE - 0.38)
    size = int(HEIGHT * OVERSAMPLING), int(WIDTH * OVERSAMPLING)
    with mujoco.Renderer(model, *size) as renderer:
        renderer.update_scene(data, camera)
        large = Image.fromarray(renderer.render())
    return large.resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS)


def main() -> None:
    out = options(__doc__, out=IMAGES / "drone.png").parse_args().out
    out.parent.mkdir(parents=True, exist_ok=True)
    picture = draw()
    picture.save(out, optimize=True)
    print(f"{out}: {picture.width} x {picture.height}, {out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()

"""Draw `docs/images/cameras.jpg`: the same moment of a flight from every camera.

Run `python studies/draw_cameras.py`; it needs no display.

It takes a few seconds on two cores.
"""

from measuring import IMAGES, options
from PIL import Image, ImageDraw, ImageFont
from rotorgram.agents import PID
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec
from rotorgram.flights.filming import moments
from rotorgram.flights.trajectories import flown_trajectories
from rotorgram.rendering import CAMERAS, Canvas, Stage

WIDTH, HEIGHT = 480, 270  # of each picture
COLUMNS = 2
SPACE = 4
TIMES = 2  # drawn larger and reduced: smooth edges
ENV = "rotorgram/Elevation-v0"
EPISODE, STEP = 1, 20  # on its way to the goal


def draw() -> Image.Image:
    """Two columns; the last picture is of the plain floor."""
    config = EnvConfig(env_id=ENV)
    (flown,) = flown_trajectories(PID(env_spec(config)), config, [EPISODE])
    flight = moments(flown)
    views = [("airport", camera) for camera in CAMERAS] + [("plain", "chase")]
    rows = -(-len(views) // COLUMNS)
    size = (COLUMNS * (WIDTH + SPACE) - SPACE, rows * (HEIGHT + SPACE) - SPACE)
    sheet = Image.new("RGB", size, "white")
    for number, (scene, camera) in enumerate(views):
        stage = Stage(scene)
        with Canvas(stage, WIDTH * TIMES, HEIGHT * TIMES) as canvas:
            for moment in flight[: STEP + 1]:
                stage.show(moment)
            picture = Image.fromarray(canvas.draw(camera)).reduce(TIMES)
        write = ImageDraw.Draw(picture)
        name = camera if scene == "airport" else f"{camera}, --scene {scene}"
        font = ImageFont.load_default(15)
        box = write.textbbox((10, 8), name, font)
        around = (box[0] - 5, box[1] - 4, box[2] + 5, box[3] + 4)
        write.rounded_rectangle(around, 4, (13, 18, 26))
        write.text((10, 8), name, "white", font)
        column = number % COLUMNS
        row = number // COLUMNS
        sheet.paste(picture, (column * (WIDTH + SPACE), row * (HEIGHT + SPACE)))
    return sheet


def main() -> None:
    out = options(__doc__, out=IMAGES / "cameras.jpg").parse_args().out
    sheet = draw()
    sheet.save(out, quality=84, optimize=True)
    print(f"{out}: {sheet.width} x {sheet.height}, {out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()

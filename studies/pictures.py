"""Pictures of our pages: every scene, the film at the top of the README, and its plan.

    rotorgram train ppo --env rotorgram/Forest-v0 --effects motor_lag --env.density 0.125 \\
        --env.speed 2.5 5.5 --out runs/forest
    python studies/pictures.py runs/forest [--episode 0] [--images docs/images]

The training takes five minutes on two cores, the pictures take one.
"""

import argparse
import subprocess
import tempfile
from pathlib import Path

import mujoco
import numpy as np
from imageio_ffmpeg import get_ffmpeg_exe  # type: ignore[import-untyped]
from PIL import Image, ImageDraw, ImageFont
from rotorgram.cli import main as rotorgram
from rotorgram.models import QUAD_XML
from rotorgram.rendering.gl import Offscreen
from rotorgram.scenes import SCENES, build_scene, seeded_scenes

WIDTH, HEIGHT = 480, 300  # of a scene of the gallery
COLUMNS = 3
VIEWS = {  # of a scene: where the camera looks, its distance, azimuth and elevation
    "plain": ((0.0, 0.0, 1.0), 9.0, 40.0, -20.0),
    "airport": ((60.0, 20.0, 0.0), 150.0, 40.0, -16.0),
    "Forest-v0": ((0.0, 0.0, 2.0), 44.0, 62.0, -24.0),
    "warehouse": ((0.0, 0.0, 4.0), 34.0, 35.0, -22.0),
    "aisles": ((0.0, 0.0, 0.5), 14.0, 40.0, -35.0),
    "maze": ((0.0, 0.0, 1.0), 52.0, 40.0, -40.0),
    "hills": ((0.0, 0.0, 2.0), 75.0, 30.0, -22.0),
    "traffic": ((0.0, 0.0, 2.0), 20.0, 40.0, -22.0),
}
USUAL = ((0.0, 0.0, 3.0), 46.0, 40.0, -22.0)
FILM = "split[a][b];[a]palettegen=max_colors=64[p];[b][p]paletteuse=dither=none"
RATE = "10"  # frames per second


def scene_picture(name: str, scene: str) -> Image.Image:
    """A scene with the paper's craft at the origin, under a name."""
    model = build_scene(QUAD_XML, scene).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.lookat, camera.distance, camera.azimuth, camera.elevation = VIEWS.get(name, USUAL)
    drawing = Offscreen(model, WIDTH, HEIGHT, fine=True)
    drawing.update(data, camera)
    pixels = np.empty((HEIGHT, WIDTH, 3), np.uint8)
    drawing.draw(pixels)
    drawing.close()
    picture = Image.fromarray(pixels[::-1])
    draw = ImageDraw.Draw(picture)
    draw.text(
        (12, 8), name, "white", ImageFont.load_default(22), stroke_width=2, stroke_fill="black"
    )
    return picture


def gallery(out: Path) -> None:
    """Every scene, and the wood of `Forest-v0`, in rows of three."""
    scenes = {name: f"{name}:3" if name in seeded_scenes() else name for name in SCENES}
    scenes["Forest-v0"] = "forest:3,density=0.1,size=34x16,clear=ends"
    rows = -(-len(scenes) // COLUMNS)
    whole = Image.new("RGB", (COLUMNS * WIDTH, rows * HEIGHT), "white")
    for number, (name, scene) in enumerate(scenes.items()):
        row, column = divmod(number, COLUMNS)
        whole.paste(scene_picture(name, scene), (column * WIDTH, row * HEIGHT))
    whole.save(out, quality=85)


def film(policy: Path, episode: int, out: Path) -> None:
    """A flight through a wood that was never seen, as a GIF."""
    with tempfile.TemporaryDirectory() as folder:
        frames = Path(folder) / "film"
        words = ["--episode", str(episode), "--size", "480x270", "--fps", RATE]
        rotorgram(["render", str(policy), "--out", str(frames), *words])
        command = [get_ffmpeg_exe(), "-y", "-loglevel", "error", "-framerate", RATE]
        command += ["-i", str(frames / "%04d.png"), "-vf", FILM, str(out)]
        subprocess.run(command, check=True)


def plan(policy: Path, episode: int, out: Path) -> None:
    """The same flight from above."""
    out.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        journal = str(Path(folder) / "forest.mcap")
        rotorgram(["evaluate", str(policy), "--episodes", str(episode + 1), "--record", journal])
        rotorgram(["plot", journal, "--plan", "--episode", str(episode), "--out", str(out)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("policy", type=Path)
    parser.add_argument("--episode", type=int, default=0)
    parser.add_argument("--images", type=Path, default=Path("docs/images"))
    args = parser.parse_args()
    gallery(args.images / "scenes.jpg")
    film(args.policy, args.episode, args.images / "forest.gif")
    plan(args.policy, args.episode, args.images / "plan.png")


if __name__ == "__main__":
    main()

"""The flight at the top of the README, in few colours so that the file stays small.

    python studies/draw_flight.py [--out FILE.gif]

It needs no display, and takes a minute.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

from measuring import IMAGES, options
from PIL import Image

FRAMES = 70
COLORS = 64
FILM = (
    "render geometric --env rotorgram/Racing-v0 --vehicle skydio_x2 --size 400x240 --fps 10 "
    "--fast --no-overlay --out"
)


def main() -> None:
    """Render the film, and write its first frames in the colours of one of them."""
    out = options(__doc__, out=IMAGES / "flight.gif").parse_args().out
    with tempfile.TemporaryDirectory() as folder:
        film = Path(folder) / "flight.gif"
        command = [sys.executable, "-P", "-m", "rotorgram.cli", *FILM.split(), str(film)]
        subprocess.run(command, check=True)
        frames = []
        with Image.open(film) as picture:
            for index in range(FRAMES):
                picture.seek(index)
                frames.append(picture.convert("RGB"))
    palette = frames[FRAMES // 2].quantize(COLORS)
    reduced = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    reduced[0].save(out, save_all=True, append_images=reduced[1:], duration=100, loop=0)


if __name__ == "__main__":
    main()

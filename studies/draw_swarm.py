"""Draw `docs/images/swarm.png`: drones that cross, by a policy that hardly trained and by ORCA.

Run `python studies/draw_swarm.py`; it needs no display.
"""

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image
from rotorgram.training.compare import compare
from rotorgram.training.figures import SWARM_FIGURE
from rotorgram.training.report import write_report
from rotorgram.training.settings import CompareConfig

CONFIG = CompareConfig(
    env_id="rotorgram/Crossing-v0", vehicle="crazyflie2", drones=4, num_envs=4, agents=("ippo",),
    seeds=1, env_steps=2048, snapshots=1, curve_episodes=1, episodes=2, jobs=1,
)  # fmt: skip
COLORS = 128  # of the picture, for a small file


def main() -> None:
    """Compare, and keep the figure of the drones."""
    parser = argparse.ArgumentParser(description="Draw a figure of several drones.")
    default = Path(__file__).parent.parent / "docs" / "images" / "swarm.png"
    parser.add_argument("--out", type=Path, default=default)
    out = parser.parse_args().out
    with TemporaryDirectory() as made:
        compare(CONFIG, Path(made), "studies/draw_swarm.py", lambda *_: None)
        write_report(Path(made))
        picture = Image.open(Path(made) / "figures" / SWARM_FIGURE).convert("RGB")
    picture.quantize(COLORS, dither=Image.Dither.NONE).save(out, optimize=True)


if __name__ == "__main__":
    main()

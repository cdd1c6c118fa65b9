"""Why VPG does not hold from every start, seed by seed of a comparison.

    python studies/vpg_seeds.py FOLDER [--out FILE.csv]

Every final policy of VPG flies, without exploration, from 41 starts between 1 m above the target
and 1 m below it. Beside the starts from which it leaves the flight band stand slopes of its action:
over the error E, over its rate (damping) and over the thrust at the target, and over the rate where
the craft approaches the target from half a metre at 1 to 3 m/s, from below and from above. A
negative one lets the craft accelerate. The folder is that of a `rotorgram compare` with VPG.

It takes about a minute on two cores.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from measuring import options
from rotorgram.agents.checkpoints import load
from rotorgram.agents.policies import NetworkPolicy
from rotorgram.envs import make_vec, register
from rotorgram.envs.tasks import Elevation
from rotorgram.sim import InitialState, stack

ERRORS = np.linspace(-1.0, 1.0, 41)  # of the starts, m


class Placed(Elevation):
    """Each drone starts at an error of its own."""

    def begin(self, mask: Any, draw: Any) -> InitialState:
        """At rest."""
        super().begin(mask, draw)
        return InitialState(position=stack((0.0, 0.0, self.memory.target - ERRORS[:, None])))


register("studies/Placed-v0", Placed)


def crashed(policy: NetworkPolicy) -> np.ndarray:
    """Whether its flight from each of `ERRORS` ends before its time."""
    envs = make_vec("studies/Placed-v0", num_envs=len(ERRORS))
    observations, _ = envs.reset(seed=0)
    ended = np.zeros(len(ERRORS), bool)
    for _ in range(250):
        actions = policy.actions.to_envs(policy.outputs(observations))
        observations, _, terminated, _, _ = envs.step(actions)
        ended |= terminated
    return ended


def slope(policy: NetworkPolicy, start: list[float], end: list[float]) -> float:
    """Change of the action from one observation to another, over the change of what differs."""
    low, high = policy.outputs(np.array((start, end), np.float32))[:, 0]
    return round(float(high - low) / (sum(end) - sum(start)), 2)


def row(path: Path) -> dict[str, float | str]:
    policy = load(path).policy()
    wrong = ERRORS[crashed(policy)]
    return {
        "seed": path.stem.removeprefix("vpg-seed"),
        "crashes": len(wrong),
        "from": f"{wrong.min():.2f} to {wrong.max():.2f}" if len(wrong) else "",
        "over the error": slope(policy, [-0.3, 0, 0], [0.3, 0, 0]),
        "over its rate": slope(policy, [0, -0.3, 0], [0, 0.3, 0]),
        "over the thrust": slope(policy, [0, 0, -0.1], [0, 0, 0.1]),
        "over its rate, fast, from below": slope(policy, [0.5, -3, 0], [0.5, -1, 0]),
        "over its rate, fast, from above": slope(policy, [-0.5, 1, 0], [-0.5, 3, 0]),
    }


def main() -> None:
    parser = options(__doc__, out=Path)
    parser.add_argument("folder", type=Path)
    args = parser.parse_args()
    paths = sorted((args.folder / "checkpoints").glob("vpg-seed*.safetensors"))
    if not paths:
        parser.error(f"expected checkpoints of VPG in {args.folder / 'checkpoints'}, found none")
    rows = [row(path) for path in paths]
    for one in rows:
        print(one)
    if args.out:
        pd.DataFrame(rows).to_csv(args.out, index=False)


if __name__ == "__main__":
    main()

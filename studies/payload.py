"""The swing of a payload under the agent `geometric`, which damps it, and without its damping.

    python studies/payload.py [--episodes 20] [--out FILE.json]

Of each vehicle, over episodes of PayloadHover-v0 from seeds 100 on: medians of the means over the
last quarter of an episode, and episodes that terminated. Without: the agent is not told the options
of the env, and cannot know cable and mass.

It takes about two minutes on two cores.
"""

from dataclasses import replace

import numpy as np
from measuring import RESULTS, options, write
from rotorgram.agents import Geometric
from rotorgram.envs import SingleEnv

PAYLOAD = "rotorgram/PayloadHover-v0"
FLOWN = ("paper", "crazyflie2", "heavy_hexa")
FIRST = 100


def flown(name: str, episodes: int, damped: bool) -> dict[str, object]:
    """Error, m, swing, degrees, and episodes that terminated."""
    env = SingleEnv(PAYLOAD, vehicle=name, action="position")
    spec = env.env_spec if damped else replace(env.env_spec, options={})
    policy = Geometric(spec)
    ends = []
    crashes = 0
    for seed in range(FIRST, FIRST + episodes):
        observation, _ = env.reset(seed=seed)
        policy.reset()
        told = []
        terminated = False
        truncated = False
        while not (terminated or truncated):
            observation, _, terminated, truncated, info = env.step(policy.act(observation))
            told.append((info["payload_error"], info["swing"]))
        ends.append(np.mean(told[-(len(told) // 4) :], axis=0))
        crashes += terminated
    error, swing = np.median(ends, axis=0).round(4).tolist()
    return {"error_m": error, "swing_deg": swing, "terminated": crashes}


def main() -> None:
    args = options(__doc__, episodes=20, out=RESULTS / "control" / "payload.json").parse_args()
    told = {"episodes": args.episodes}
    for name in FLOWN:
        told[name] = {
            case: flown(name, args.episodes, damped=case == "damped")
            for case in ("without", "damped")
        }
        print(name, told[name], flush=True)
    write(args.out, told)


if __name__ == "__main__":
    main()

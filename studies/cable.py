"""How near the agent `geometric` holds a payload that several drones carry.

    python studies/cable.py [--episodes 10] [--out FILE.json]

Of each vehicle of the library and each number of drones, over the evaluation episodes of Cable-v0:
median and largest of the means of the payload's error over the last quarter of an episode, and
worlds whose episode terminated.

It takes about five minutes on two cores.
"""

import numpy as np
from measuring import RESULTS, options, write
from rotorgram.agents import Geometric
from rotorgram.envs import LocalVectorEnv
from rotorgram.flights.trajectories import fly_episodes
from rotorgram.models.library import vehicle_names

CABLE = "rotorgram/Cable-v0"
DRONES = (2, 3, 4, 8)


def flown(vehicle: str, drones: int, episodes: int) -> dict[str, object]:
    """Errors, m, and worlds that terminated."""
    env = LocalVectorEnv(
        CABLE, episodes * drones, drones=drones, vehicle=vehicle, action="position",
        autoreset_mode="Disabled",
    )  # fmt: skip
    flights = fly_episodes(env, Geometric(env.env_spec), episodes, "final")[::drones]
    ends = [one.telemetry["metrics"][-len(one.telemetry["metrics"]) // 4 :, 0] for one in flights]
    errors = [float(np.mean(end)) for end in ends]
    return {
        "error_m": round(float(np.median(errors)), 4),
        "worst_m": round(max(errors), 4),
        "terminated": sum(one.ending == "terminated" for one in flights),
    }


def main() -> None:
    args = options(__doc__, episodes=10, out=RESULTS / "control" / "cable.json").parse_args()
    told = {"episodes": args.episodes}
    for name in vehicle_names():
        told[name] = {str(count): flown(name, count, args.episodes) for count in DRONES}
        print(name, told[name], flush=True)
    write(args.out, told)


if __name__ == "__main__":
    main()

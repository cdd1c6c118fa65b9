"""A curriculum against training from scratch, at equally many env steps.

    OPENBLAS_NUM_THREADS=1 python studies/curriculum.py [--seeds 300 301 302 303 304]
        [--out docs/results/transfer/curriculum.csv]

PPO learns the track `dive` of Racing-v0, with its preset on `rigid` in this process: in one stage,
or after a stage on `oval`. The last policy flies 50 episodes of `dive` on `mujoco`, of starts
that no training has seen. A line for each row and seed is added: share of the flights that leave
out a gate, mean time of the others, s, and processor seconds.

It takes about twenty minutes on two cores.
"""

import time
from typing import Final

import numpy as np
from measuring import RESULTS, add_row, options
from rotorgram.agents import find_preset
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.config import EnvConfig
from rotorgram.flights.trajectories import fly_episodes
from rotorgram.training.settings import Run
from rotorgram.training.training import Training

RACING: Final = "rotorgram/Racing-v0"
ROWS: Final = {
    "dive": [("dive", 2_500_000)],
    "oval, dive": [("oval", 1_000_000), ("dive", 1_500_000)],
}
"""Tracks and env steps of the stages."""
EPISODES: Final = 50


def made(count: int, track: str, backend: str) -> LocalVectorEnv:
    """So many drones in this process."""
    return LocalVectorEnv(RACING, count, autoreset_mode="Disabled", backend=backend, track=track)


def measure(row: str, seed: int) -> dict[str, object]:
    """Train through the stages of a row, and fly the track of the last one."""
    preset = find_preset("ppo", "tuned", RACING)
    began = time.process_time()
    kept = None
    for track, env_steps in ROWS[row]:
        run = Run(
            algorithm="ppo", config=preset.config, seed=seed, env_steps=env_steps,
            num_envs=preset.num_envs, env=EnvConfig(env_id=RACING, task={"track": track}),
        )  # fmt: skip
        env = made(preset.num_envs, track, preset.backend)
        training = Training(run, env, start=kept)
        training.train()
        kept = training.checkpoint()
        env.close()
    seconds = time.process_time() - began
    env = made(EPISODES, ROWS[row][-1][0], "mujoco")
    flown = fly_episodes(env, training.agent.policy(), EPISODES, "final")
    env.close()
    whole = [one.seconds for one in flown if one.headline[-1] == 0]
    return {
        "row": row, "seed": seed, "left_out": round(1 - len(whole) / EPISODES, 2),
        "seconds": round(float(np.mean(whole)), 2) if whole else "",
        "processor_seconds": round(seconds, 1),
    }  # fmt: skip


def main() -> None:
    out = RESULTS / "transfer" / "curriculum.csv"
    args = options(__doc__, seeds=range(300, 305), out=out).parse_args()
    for seed in args.seeds:
        for row in ROWS:
            line = measure(row, seed)
            print(line, flush=True)
            add_row(args.out, line)


if __name__ == "__main__":
    main()

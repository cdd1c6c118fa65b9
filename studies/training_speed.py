"""Env steps per second of training: our A2C and VPG beside SB3's A2C.

    python studies/training_speed.py [--env-steps 20000] [--repeats 5] [--out FILE.json]
    python studies/training_speed.py --agents a2c sb3-a2c --num-envs 64 --backend rigid
        --steps-per-update 320 --env-steps 200000 [--in-process] --out FILE.json

Every training has a simulator process and a socket pair of its own, or with `--in-process` flies in
this process. The networks, the hyperparameters (preset `tuned`) and the number of env steps are the
same. The agents take turns, so that a machine that slows down slows all of them; medians are
compared, of rates and of the ratios to SB3's in the same turn. Imports and the start of the
simulator are not counted. 320 env steps of 64 drones are five of each for an update, as SB3's
default has it.

It takes about two minutes on two cores.
"""

import os
from contextlib import closing

import numpy as np
from measuring import RESULTS, medians, options, write
from rotorgram.agents import preset
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.config import DEFAULT_ENV, EnvConfig
from rotorgram.training.settings import Run
from rotorgram.training.training import Training
from rotorgram.udp.spawn import spawn_simulator


def steps_per_second(run: Run, *, in_process: bool) -> float:
    """Of a training, without the start of its simulator."""
    if in_process:
        opened = closing(LocalVectorEnv(run.env, run.num_envs, autoreset_mode="Disabled"))
    else:
        opened = spawn_simulator(run.env, num_envs=run.num_envs)
    with opened as env:
        training = Training(run, env)
        if in_process:
            env.loop.prepare()
        training.train()
        return training.log.env_steps / training.log.seconds


def main() -> None:
    args = options(
        __doc__, env_steps=20_000, agents=("a2c", "vpg", "sb3-a2c"), num_envs=1, backend="mujoco",
        steps_per_update=int, repeats=5, in_process=False, out=RESULTS / "training_speed.json",
    ).parse_args()  # fmt: skip
    changes = {"steps_per_update": args.steps_per_update} if args.steps_per_update else {}
    settings = {name: getattr(args, name) for name in ("env_steps", "num_envs")}
    env = EnvConfig.from_keywords(DEFAULT_ENV, backend=args.backend)
    rates: dict[str, list[float]] = {agent: [] for agent in args.agents}
    for repeat in range(args.repeats):
        for agent, own in rates.items():
            config = preset(agent, "tuned", **changes)
            run = Run(env=env, algorithm=agent, config=config, seed=repeat, **settings)
            own.append(round(steps_per_second(run, in_process=args.in_process), 1))
            print(f"{agent:8} {own[-1]:8,.0f} env steps/s", flush=True)
    middle = medians(rates)
    ratios = {}
    for agent, own in rates.items():
        beside = np.divide(own, rates["sb3-a2c"])
        ratios[agent] = round(float(np.median(beside)), 2)
    result = {
        **settings,
        "backend": args.backend,
        "in_process": args.in_process,
        "changes": changes,
        "rates": rates,
        "medians": middle,
        "ratio_to_sb3": ratios,
        "load_average": round(os.getloadavg()[0], 1),
    }
    write(args.out, result)
    for agent, median in middle.items():
        print(f"{agent:8} median {median:8,.0f} env steps/s, {ratios[agent]:.2f} x SB3's A2C")


if __name__ == "__main__":
    main()

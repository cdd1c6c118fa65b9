"""Flies rotorgram's envs by other people's libraries, and writes a page of what flew.

`make test-libraries` makes an environment with these libraries and runs

    python studies/libraries.py docs/libraries.md

The exit status is 1 if a library does not fly an env. The page has the versions.

It takes about two minutes on two cores.
"""

import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import rotorgram.envs  # noqa: F401  registers the envs

ENV = "rotorgram/Hover-v0"
SWARM = "rotorgram/Formation-v0"
FOREST = "rotorgram/Forest-v0"
STEPS = 20
COMMITS = {"CleanRL": "004f8a0"}  # of projects whose scripts are copied, not installed
CLEANRL = (
    "`ppo_atari_lstm.py` on `Forest-v0`: its loop is ours after it, `studies/recurrent_ppo.py`"
)
HEAD = """# With other libraries

`make test-libraries` flies these envs in an environment of its own, and writes this page.

| library | version | what flies | result |
|---|---|---|---|
"""
ZOO_SETTINGS = f"""{ENV}:
  n_timesteps: 200
  policy: MlpPolicy
  n_steps: 10
"""


class Case(NamedTuple):
    """A way to fly."""

    package: str
    """Name of the distribution, or of a project without one."""
    what: str
    fly: Callable[[], None]


def torchrl_single() -> None:
    """GymEnv makes the env by its id, with keywords of its own."""
    from torchrl.envs.libs.gym import GymEnv

    flown = GymEnv(ENV).rollout(STEPS)
    assert flown["observation"].shape[0] <= STEPS


def torchrl_vector() -> None:
    """GymWrapper takes a vector env of SAME_STEP or DISABLED."""
    from torchrl.envs.libs.gym import GymWrapper

    made = gym.make_vec(ENV, num_envs=4, autoreset_mode="SameStep")
    flown = GymWrapper(made).rollout(STEPS, break_when_any_done=False)
    assert flown["observation"].shape[:2] == (4, STEPS)


def torchrl_swarm() -> None:
    """PettingZooWrapper takes a parallel env."""
    from rotorgram.envs.parallel import LocalParallelEnv
    from torchrl.envs.libs.pettingzoo import PettingZooWrapper

    PettingZooWrapper(LocalParallelEnv(SWARM, drones=3)).rollout(STEPS)


def torchrl_forest() -> None:
    """A mapping of arrays: numbers, and distances along rays."""
    from torchrl.envs.libs.gym import GymEnv

    flown = GymEnv(FOREST).rollout(STEPS)
    assert flown["depth"].shape[1:] == (6, 32)


def multi_input() -> None:
    """SB3's policy for a mapping of arrays learns a little."""
    from stable_baselines3 import PPO

    PPO("MultiInputPolicy", gym.make(FOREST), n_steps=32, batch_size=32, n_epochs=1).learn(64)


def convolutions() -> None:
    """SB3's policy for images: a camera's uint8 picture, (height, width, 3), as SB3 wants."""
    from stable_baselines3 import PPO

    env = gym.make(FOREST, scene="forest:0-3,size=34x16,clear=ends", cameras="front@48x48")
    space = env.observation_space["front"]
    env = gym.wrappers.TransformObservation(env, lambda observed: observed["front"], space)
    PPO("CnnPolicy", env, n_steps=16, batch_size=16, n_epochs=1).learn(32)


def recurrent() -> None:
    """RecurrentPPO of sb3-contrib, whose policy has an LSTM."""
    from sb3_contrib import RecurrentPPO

    env = gym.make(FOREST)
    RecurrentPPO("MultiInputLstmPolicy", env, n_steps=32, batch_size=32, n_epochs=1).learn(64)


def cleanrl() -> None:
    """CleanRL's recurrent PPO, whose script is no package: the loop is ours after it."""
    from recurrent_ppo import learn

    env = gym.make_vec(FOREST, num_envs=4, autoreset_mode="SameStep")
    learn(env, steps=16, updates=1)


def skrl(vector: bool) -> None:
    """wrap_env recognises an env by its classes."""
    import torch
    from skrl.envs.wrappers.torch import wrap_env

    count = 4 if vector else 1
    made = gym.make_vec(ENV, num_envs=count) if vector else gym.make(ENV)
    env = wrap_env(made)
    env.reset()
    observations, *_ = env.step(torch.zeros(count, env.action_space.shape[-1]))
    assert observations.shape[0] == count


def supersuit() -> None:
    """concat_vec_envs_v1 copies the env by cloudpickle; SB3's PPO learns a little on it."""
    import supersuit as ss
    from rotorgram.envs.parallel import LocalParallelEnv
    from stable_baselines3 import PPO

    parallel = ss.black_death_v3(LocalParallelEnv(SWARM, drones=3))
    vector = ss.pettingzoo_env_to_vec_env_v1(parallel)
    worlds = ss.concat_vec_envs_v1(vector, 2, base_class="stable_baselines3")
    PPO("MlpPolicy", worlds, n_steps=16, batch_size=32, n_epochs=1).learn(96)


def asynchronous(context: str) -> None:
    """Gymnasium's AsyncVectorEnv: a process for each env."""
    made = gym.make_vec(
        ENV, num_envs=2, vectorization_mode="async", vector_kwargs={"context": context}
    )
    made.reset(seed=0)
    observations, *_ = made.step(made.action_space.sample())
    made.close()
    assert observations.shape[0] == 2


def zoo() -> None:
    """The training command of rl_zoo3."""
    with tempfile.TemporaryDirectory() as folder:
        settings = Path(folder) / "settings.yml"
        settings.write_text(ZOO_SETTINGS)
        command = ["--algo", "a2c", "--env", ENV, "--gym-packages", "rotorgram.envs"]
        command += ["--conf-file", str(settings), "--log-folder", folder]
        done = subprocess.run(
            [sys.executable, "-m", "rl_zoo3.train", *command], capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr[-300:]


CASES = (
    Case("torchrl", "`GymEnv`", torchrl_single),
    Case("torchrl", "`GymWrapper` on a vector env", torchrl_vector),
    Case("torchrl", "`PettingZooWrapper` on a swarm", torchrl_swarm),
    Case("torchrl", "`GymEnv` on `Forest-v0`", torchrl_forest),
    Case("stable_baselines3", "`MultiInputPolicy` on `Forest-v0`", multi_input),
    Case("stable_baselines3", "`CnnPolicy` on pictures of `Forest-v0`", convolutions),
    Case("sb3-contrib", "`RecurrentPPO` on `Forest-v0`", recurrent),
    Case("CleanRL", CLEANRL, cleanrl),
    Case("skrl", "`wrap_env`", lambda: skrl(vector=False)),
    Case("skrl", "`wrap_env` on a vector env", lambda: skrl(vector=True)),
    Case("SuperSuit", "`concat_vec_envs_v1` and SB3's PPO on a swarm", supersuit),
    Case("gymnasium", "`AsyncVectorEnv`, fork", lambda: asynchronous("fork")),
    Case("gymnasium", "`AsyncVectorEnv`, spawn", lambda: asynchronous("spawn")),
    Case("rl_zoo3", "`rl_zoo3.train`", zoo),
)


def main(page: Path) -> int:
    """Fly all cases and write the page; the exit status."""
    warnings.simplefilter("ignore")
    rows = []
    failed = 0
    for case in CASES:
        result = "flies"
        try:
            case.fly()
        except Exception as error:
            result = f"fails: {type(error).__name__}: {str(error).splitlines()[0][:120]}"
            failed += 1
        release = COMMITS.get(case.package) or version(case.package)
        row = f"| {case.package} | {release} | {case.what} | {result} |"
        print(row, flush=True)
        rows.append(row)
    page.write_text(HEAD + "\n".join(rows) + "\n", encoding="utf-8")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))

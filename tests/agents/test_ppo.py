"""PPO: its minibatches, its rates and its presets."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drones import Constant, log_of, rollout, vector
from nets import arrays_of
from rotorgram.agents import PPOConfig, find_preset, load
from rotorgram.agents.episodes import EpisodeRecorder
from rotorgram.agents.ppo import PPO
from rotorgram.agents.rollouts import Collector
from rotorgram.cli import main
from rotorgram.models.errors import InputError

SMALL = PPOConfig(gamma=0.5, gae_lambda=0.5, steps_per_update=3, epochs=1, minibatches=1)


def test_rates_of_actor_and_critic() -> None:
    """Adam's first step is the rate, whatever the gradient."""
    agent = PPO(log_of(), replace(SMALL, learning_rate=0.01, critic_learning_rate=0.03), 0)
    arrays, gradients = arrays_of(agent)
    before = {name: array.copy() for name, array in arrays.items()}
    agent.update(rollout())
    for name, array in arrays.items():
        moved = np.abs(array - before[name])[np.abs(gradients[name]) > 1e-3]
        rate = 0.03 if name.startswith("critic.") else 0.01
        np.testing.assert_allclose(moved, rate, rtol=0.01, err_msg=name)


def test_probabilities_before_an_update_are_those_of_the_policy_that_flew() -> None:
    log = EpisodeRecorder(vector(3), seed=0)
    agent = PPO(log, replace(SMALL, steps_per_update=90), 0)
    data = agent.collect(Collector(log, np.random.default_rng(0), agent._actor), 90)
    *_, before = agent.columns(data)
    rows = data.rows(data.observations)
    outputs = agent._actor.network.forward(rows.T)
    expected, _ = agent._actor.head.score(outputs, data.rows(data.actions).T)
    assert before.std() > 0.1
    np.testing.assert_allclose(before, expected, rtol=1e-4, atol=1e-5)


def test_squashed_actions_are_flown_by_tanh_with_noise_and_without() -> None:
    env = Constant()
    log = EpisodeRecorder(env, seed=0)
    agent = PPO(log, replace(SMALL, squashed=True, log_std=1.0), 0)
    drawn = agent.collect(Collector(log, np.random.default_rng(0), agent._actor), 6).actions
    assert np.abs(drawn).max() > 1
    action = log.spec.action
    low, high = (float(bound[0]) for bound in action.bounds())
    expected = (low + high) / 2 + (high - low) / 2 * np.tanh(drawn[:, 0, 0])
    np.testing.assert_allclose(env.flown[: len(expected)], expected, rtol=1e-5)
    policy = agent.policy()
    seen = np.ones(1, np.float32)
    output = policy.outputs(seen[np.newaxis])[0, 0]
    flown = (low + high) / 2 + (high - low) / 2 * np.tanh(output)
    assert policy.act(seen)[0] == pytest.approx(flown)


def test_an_update_ends_at_a_minibatch_that_is_too_far() -> None:
    """The divergence of the first minibatch is 0: the policy is still the one that flew."""
    config = replace(SMALL, steps_per_update=90, epochs=3, minibatches=4, learning_rate=0.1)
    steps = []
    for most in (None, 10.0, 1e-6):
        log = EpisodeRecorder(vector(3), seed=0)
        agent = PPO(log, replace(config, target_kl=most), 0)
        agent.update(agent.collect(Collector(log, np.random.default_rng(0), agent._actor), 90))
        steps.append(agent.optimizer.steps)
    assert steps == [12, 12, 1]


def test_every_epoch_takes_every_transition_once() -> None:
    agent = PPO(log_of(), replace(SMALL, epochs=4, minibatches=3, normalize=False), 0)
    taken: list[np.ndarray] = []
    minibatch = agent.minibatch

    def keep(*columns: np.ndarray, **_: None) -> tuple[float, ...]:
        taken.append(np.column_stack(columns))
        return minibatch(*columns)

    agent.minibatch = keep  # type: ignore[method-assign]
    numbers = np.arange(20, dtype=np.float32)
    column = numbers[:, np.newaxis]
    never = np.zeros(20, bool)
    kept = numbers != 7
    data = rollout(
        observations=column, actions=column / 10, rewards=numbers, next_observations=column + 1,
        terminated=never, truncated=never, kept=kept,
    )  # fmt: skip
    agent.update(data)
    assert [len(part) for part in taken] == [7, 6, 6] * 4
    assert agent.optimizer.steps == 12
    epochs = np.array(np.split(np.concatenate(taken), 4))
    orders = epochs[:, :, 0].argsort(axis=1)
    expected = epochs[0, orders[0]]
    assert expected[:, 0].tolist() == numbers[kept].tolist()
    for epoch, order in zip(epochs, orders, strict=True):
        np.testing.assert_array_equal(epoch[order], expected)  # a transition's columns together
    assert len(np.unique(orders, axis=0)) == 4


def test_the_tuned_preset_depends_on_the_task() -> None:
    ours = find_preset("ppo", "tuned", "rotorgram/Elevation-v0")
    assert (ours.num_envs, ours.env_steps, ours.backend) == (64, 36_000, "rigid")
    assert ours.config.hidden == (16,)
    hover = find_preset("ppo", "tuned", "rotorgram/Hover-v0")
    assert hover.num_envs == 64
    assert hover.config.hidden == (32, 32)
    assert find_preset("sb3-ppo", "tuned", "rotorgram/Hover-v0") == hover
    racing = find_preset("ppo", "tuned", "rotorgram/Racing-v0")
    assert racing.num_envs == 512
    assert racing.backend == "rigid"
    assert racing.config.hidden == (64, 64)
    assert racing.config.log_std == -0.8
    waypoints = find_preset("ppo", "tuned", "rotorgram/Waypoints-v0").config
    own = {"log_std": -0.8, "epochs": 2, "minibatches": 32, "gamma": 0.98}
    assert replace(waypoints, **own) == racing.config
    other = find_preset("ppo", "tuned", "other/Task-v0")
    assert other == replace(ours, fits=False, backend=None)  # it may need contact
    swarm = find_preset("ippo", "tuned", "rotorgram/Formation-v0")
    assert (swarm.num_envs, swarm.env_steps, swarm.backend) == (1024, 36_000_000, "rigid")
    assert swarm.episode_length == 100
    assert swarm.config.anneal_clip  # the cost of a crash grows
    for algorithm in ("ppo", "mappo"):
        for task, most, squashed in (("Crossing", 2.0, True), ("Escort", 8.0, False)):
            other = find_preset(algorithm, "tuned", f"rotorgram/{task}-v0")
            changes = {"reward_clip": most, "log_std": -2.5, "squashed": squashed}
            assert other.config == replace(swarm.config, **changes)
    assert find_preset("mappo", "tuned", "rotorgram/Formation-v0") == swarm
    with pytest.raises(InputError, match="preset: expected robust or tuned for ppo, got 'paper'"):
        find_preset("ppo", "paper")


def test_training_of_hover_is_robust_if_nothing_else_is_asked(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    words = ["train", "ppo", "--env", "rotorgram/Hover-v0", "--env-steps", "8192"]
    assert main([*words, "--out", str(folder)]) == 0
    kept = load(folder / "checkpoint.safetensors")
    robust = find_preset("ppo", "robust", "rotorgram/Hover-v0")
    assert kept.num_envs == robust.num_envs
    assert kept.config["reach"] == robust.config.reach
    assert {"start_y", "start_tilt", "mass"} <= {*kept.spec.options["randomize"]}
    assert all(np.isfinite(array).all() for array in kept.policy().weights.arrays.values())


@pytest.mark.parametrize(("words", "length"), [([], 100), (["--episode-length", "500"], 500)])
def test_swarms_train_in_short_episodes_if_no_length_is_given(
    words: list[str], length: int, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    few = ["--num-envs", "4", "--env-steps", "400", "--set", "steps_per_update=400"]
    swarm = ["train", "ippo", "--env", "rotorgram/Formation-v0", "--drones", "2", *few]
    assert main([*swarm, *words, "--out", str(folder)]) == 0
    assert load(folder / "checkpoint.safetensors").spec.options["episode_length"] == length


def test_training_by_the_command_takes_the_preset_s_drones_and_loads_nothing_slow(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "run"
    words = ["train", "ppo", "--env-steps", "2100", "--out", str(folder)]
    slow = {
        "matplotlib", "pandas", "rich", "rotorgram.udp", "scipy", "stable_baselines3",
        "tensorboard", "torch", "typeguard",
    }  # fmt: skip
    code = f"import sys; from rotorgram.cli import main; assert main({words}) == 0; " + (
        f"print(sorted({slow} & set(sys.modules)))"
    )
    told = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert told.stdout.splitlines()[-1] == "[]"
    kept = load(folder / "checkpoint.safetensors")
    assert kept.num_envs == 64
    assert kept.algorithm == "ppo"
    assert 2100 <= kept.position.env_steps < 2164


@pytest.mark.parametrize("algorithm", ["vpg", "a2c"])
def test_the_other_learners_load_no_torch(algorithm: str, tmp_path: Path) -> None:
    words = ["train", algorithm, "--no-udp", "--env-steps", "600", "--out", str(tmp_path / "run")]
    code = f"import sys; from rotorgram.cli import main; assert main({words}) == 0; " + (
        "print(sorted({'torch', 'tensorflow', 'stable_baselines3'} & set(sys.modules)))"
    )
    told = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert told.stdout.splitlines()[-1] == "[]"
    assert list((tmp_path / "run").rglob("events.out.tfevents.*"))

"""The analytic policy gradient: its derivative, and that it climbs, stops and resumes."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rotorgram.agents import EpisodeLog, load, make_agent, store
from rotorgram.agents.apg import near_end, steps_left
from rotorgram.agents.presets import APGConfig
from rotorgram.cli import main
from rotorgram.envs import LocalVectorEnv, Loop, Outcome, register
from rotorgram.envs.tasks.hover import Hover
from rotorgram.models.errors import InputError
from rotorgram.sim import WorldState
from rotorgram.training.settings import Run
from rotorgram.training.training import Training

HOVER = "rotorgram/Hover-v0"
IMU = {"gyro_noise": 0.0, "accelerometer_noise": 0.0}


def env_of(count: int = 8, **options: Any) -> LocalVectorEnv:
    settings: Any = {"backend": "rigid", "autoreset_mode": "Disabled", **options}
    settings.setdefault("gradients", settings["backend"] == "rigid")
    return LocalVectorEnv(HOVER, count, **settings)


def agent_of(config: APGConfig, **options: Any) -> tuple[Any, EpisodeLog]:
    log = EpisodeLog(env_of(**options), 3)
    return make_agent("apg", log, config, 3), log


def flown(steps: int, changes: dict[str, tuple[int, float]], **options: Any) -> Any:
    """An agent after such a flight, with some numbers of its weights changed before."""
    config = APGConfig(normalize_observations=False, gamma=1.0, tail=0, crash_cost=0.0,
                       minibatches=1, max_grad_norm=1e9)  # fmt: skip
    agent, log = agent_of(config, **options)
    # Rotors far from alike: the cost of body rates has no derivative where nothing turns.
    agent.weights.part("actor.").arrays["layers.2.bias"][...] = (0.3, -0.1, 0.2, 0.1)
    for name, (place, change) in changes.items():
        agent.weights.part("actor.").arrays[name].flat[place] += change
    log.start()
    agent.learn(*agent.flight(log, steps))
    return agent


@pytest.mark.parametrize(
    ("name", "place"),
    [("layers.2.bias", 0), ("layers.2.weight", 70), ("layers.1.weight", 5), ("layers.0.weight", 9)],
)
def test_the_gradient_is_the_derivative_of_the_mean_reward(name: str, place: int) -> None:
    """Against a difference: of minus the mean of r_k over 12 steps of 8 drones."""
    usual = {"dtype": "float64", "start_band": 0.2}
    slope = flown(12, {}, **usual).weights.part("actor.").gradients[name].flat[place]
    size = 0.02 if name == "layers.2.bias" else 0.1
    up, down = (flown(12, {name: (place, s)}, **usual).terms["gain"] for s in (size, -size))
    assert abs(slope) > 1e-6
    assert slope == pytest.approx((down - up) / (2 * size), rel=0.05)


class Climb(Hover):
    """Its reward is the speed upwards, m/s."""

    def outcome(self, state: WorldState) -> Outcome:
        return replace(super().outcome(state), reward={"climb": state.velocity[..., 2]})


def climbed(steps: int, tail: int, **options: Any) -> tuple[Any, np.ndarray]:
    """An agent that gives 0.1 whatever it sees, and its slopes by the outputs, of 3 drones.

    They start level. A rotor's output of 1 is 51 N more than hover, on 20 kg for 0.02 s: 0.051 m/s
    from then on.
    """
    register("test/Climb-v0", Climb)
    level = {"start_tilt": 0.0, "start_heading": 0.0, **options}
    env = LocalVectorEnv("test/Climb-v0", 3, autoreset_mode="Disabled", backend="rigid",
                         gradients=True, dtype="float64", **level)  # fmt: skip
    config = APGConfig(gamma=0.5, tail=tail, horizon=8, crash_cost=0.0, minibatches=1,
                       normalize_observations=False)  # fmt: skip
    agent: Any = make_agent("apg", log := EpisodeLog(env, 0), config, 0)
    agent.weights.values[:] = 0.0
    agent.weights.part("actor.").arrays["layers.2.bias"][:] = 0.1
    log.start()
    observations, slopes = agent.flight(log, steps)
    agent.learn(observations, slopes)
    return agent, slopes


def test_an_action_counts_with_what_follows_from_it() -> None:
    """Of 4 steps with a tail of 1: three actions, which 4, 3 and 2 rewards follow."""
    agent, slopes = climbed(4, 1)
    shares = np.array([1 + 0.5 + 0.25 + 0.125, 1 + 0.5 + 0.25, 1 + 0.5])
    expected = -0.051 * np.repeat(shares, 3)[:, None] * np.ones(4)
    assert slopes == pytest.approx(expected, rel=1e-5)
    by_bias = agent.weights.part("actor.").gradients["layers.2.bias"]
    assert by_bias == pytest.approx(np.full(4, -0.051 * 5.125 / 3), rel=1e-5)
    assert (agent.weights.part("actor.").arrays["layers.2.bias"] > 0.1).all()


def test_the_last_actions_of_an_episode_move_nothing() -> None:
    """Episodes of 5 steps, then a reset, then 2 steps; with a tail of 2 the first three count."""
    agent, slopes = climbed(8, 2, episode_length=5)
    shares = np.array([1.9375, 1.875, 1.75])
    assert slopes == pytest.approx(-0.051 * np.repeat(shares, 3)[:, None] * np.ones(4), rel=1e-5)
    # Speeds 0.0204 (1, 2, ...) m/s of four rotors at 0.1, discounted anew after the reset.
    gain = 0.0204 * (1 + 2 / 2 + 3 / 4 + 4 / 8 + 5 / 16 + 1 + 2 / 2) / 7
    assert agent.terms["gain"] == pytest.approx(gain, rel=1e-5)


def test_steps_left_to_a_cut() -> None:
    """Of a flight that is truncated after the second of four steps, and one that crashes there."""
    ends = np.array([[0, 0], [1, 1], [0, 0], [0, 0]], bool)
    left = steps_left(ends, ends & [False, True])
    assert left[:, 0].tolist() == [2, 1, 2, 1]
    assert left[2:, 1].tolist() == [2, 1]
    assert (left[:2, 1] > 1e9).all()


class Wall:
    """An episode that ends beyond x = 3 m."""

    def outcome(self, state: WorldState) -> Outcome:
        return Outcome(reward={}, terminated=state.position[..., 0] > 3.0, metrics={})


def test_the_slope_of_a_wall_that_is_near() -> None:
    """0.1 m from it, and noise of 0.3 m: the normal density of 1/3, over 0.3 m: 1.258 per m."""
    count, loop = 50_000, Loop(HOVER, 1, backend="rigid", device="cpu")
    level = torch.tensor((1.0, 0.0, 0.0, 0.0)).expand(count, 1, 4)
    position = torch.tensor((2.9, 7.0, 5.0)).repeat(count, 1, 1).requires_grad_()
    state = replace(loop.world.state, position=position, quaternion=level)
    near_end(Wall(), state, np.random.default_rng(0)).mean().backward()
    slope: Any = position.grad
    assert slope.sum(dim=(0, 1)).tolist() == pytest.approx([1.258, 0.0, 0.0], abs=0.03)


def test_it_climbs() -> None:
    config = APGConfig(horizon=40, tail=15, normalize_observations=False)
    run = Run(env_id=HOVER, backend="rigid", algorithm="apg", config=config, seed=0,
              env_steps=40 * 16 * 8, num_envs=16)  # fmt: skip
    training = Training(run, env_of(16, episode_length=40))
    gains: list[float] = []
    training.train(lambda: gains.append(training.agent.scalars()["train/policy_loss"]) or True)
    assert np.mean(gains[-3:]) < np.mean(gains[:3]) - 0.02  # minus the gain


@pytest.mark.parametrize("length", [25, 20])
def test_it_resumes_to_the_bit(length: int, tmp_path: Path) -> None:
    """After two updates of 10 steps, in the middle of an episode and just after its end."""
    config = APGConfig(horizon=10, tail=4, hidden=(8,))
    run = Run(env_id=HOVER, backend="rigid", algorithm="apg", config=config, seed=1,
              env_steps=320, num_envs=8, options={"episode_length": length})  # fmt: skip
    whole, part = (Training(run, env_of(8, episode_length=length)) for _ in range(2))
    whole.train()
    updates = []
    assert not part.train(lambda: updates.append(0) or len(updates) < 2)
    store(part.checkpoint(), tmp_path / "kept")
    rest = Training.resume(load(tmp_path / "kept"), env_of(8, episode_length=length))
    rest.train()
    for name, array in whole.agent.state().items():
        assert rest.agent.state()[name].tobytes() == array.tobytes(), name


def test_it_flies_as_its_policy_does() -> None:
    """The actions of the flight are those of `NetworkPolicy`, normalised observations too."""
    agent, log = agent_of(APGConfig(horizon=5, tail=2), episode_length=50)
    agent.train(log, 2 * 5 * 8, lambda: True)
    policy, seen = agent.policy(), log.observations
    agent.flight(log, 1)
    sent = log.position().actions[-1]
    assert sent == pytest.approx(policy.actions.to_envs(policy.output(seen)), abs=1e-6)


@pytest.mark.parametrize(
    ("env_id", "settings", "sentence"),
    [
        (HOVER, {}, "apg: expected an env in this process, on rigid with gradients, got another"),
        (HOVER, {"backend": "rigid", "sensors": {"imu": IMU}}, "apg: expected an env without"),
        ("rotorgram/Elevation-v0", {"backend": "rigid", "action_type": "discrete"},
         "apg: expected continuous actions, got choices"),
    ],
)  # fmt: skip
def test_what_it_cannot_fly(env_id: str, settings: Any, sentence: str) -> None:
    gradients = settings.get("backend") == "rigid"
    settings = {"autoreset_mode": "Disabled", "gradients": gradients, **settings}
    log = EpisodeLog(LocalVectorEnv(env_id, 2, **settings), 0)
    with pytest.raises(InputError, match=sentence):
        make_agent("apg", log, APGConfig(), 0)


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["train", "apg", "--env", HOVER, "--num-envs", "4", "--out", str(tmp_path / "run")]
    short = ["--env-steps", "160", "--set", "horizon=20", "tail=5"]
    assert main([*words, *short]) == 0
    assert "trained 160 of 160 env steps" in capsys.readouterr().out
    assert main(["evaluate", str(tmp_path / "run"), "--episodes", "1"]) == 0
    assert main([*words[:-1], str(tmp_path / "no"), "--listen", "127.0.0.1:0"]) == 1
    assert "listen: expected no flags of the wire" in capsys.readouterr().err

"""The analytic policy gradient: its derivative, and that it climbs, stops and resumes."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rotorgram.agents import EpisodeLog, make_agent
from rotorgram.agents.presets import APGConfig
from rotorgram.cli import main
from rotorgram.envs import LocalVectorEnv
from rotorgram.experiments.settings import Run
from rotorgram.experiments.training import Training
from rotorgram.models.errors import InputError

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
    agent, log = agent_of(APGConfig(normalize_observations=False, gamma=0.9), **options)
    # Rotors far from alike: the cost of body rates has no derivative where nothing turns.
    agent.weights.part("actor.").arrays["layers.2.bias"][...] = (0.3, -0.1, 0.2, 0.1)
    for name, (place, change) in changes.items():
        agent.weights.part("actor.").arrays[name].flat[place] += change
    log.start()
    agent.flight(log, steps)
    return agent


@pytest.mark.parametrize(
    ("name", "place"),
    [("layers.2.bias", 0), ("layers.2.weight", 70), ("layers.1.weight", 5), ("layers.0.weight", 9)],
)
def test_the_gradient_is_the_derivative_of_the_mean_reward(name: str, place: int) -> None:
    """Against a difference: of minus the mean of 0.9^k r_k over 12 steps of 8 drones."""
    usual = {"dtype": "float64", "start_band": 0.2}
    slope = flown(12, {}, **usual).weights.part("actor.").gradients[name].flat[place]
    size = 0.02 if name == "layers.2.bias" else 0.1
    up, down = (flown(12, {name: (place, s)}, **usual).terms["gain"] for s in (size, -size))
    assert abs(slope) > 1e-6
    assert slope == pytest.approx((down - up) / (2 * size), rel=0.05)


def test_episodes_that_end_begin_anew() -> None:
    """Of 5 steps: the sixth begins the next, is no transition, and its discount is 1 again."""
    agent, log = agent_of(APGConfig(gamma=0.5, normalize_observations=False), episode_length=5)
    rewards = []

    def kept(advance: Any = log.env.advance) -> Any:
        def both(*command: Any) -> None:
            advance(*command)
            rewards.append(np.array(log.env.rewards))

        return both

    log.env.advance = kept()  # type: ignore[method-assign]
    log.start()
    rewards.clear()
    agent.flight(log, 8)
    assert [(row == 0).all() for row in rewards] == [False] * 5 + [True] + [False] * 2
    assert log.env_steps == 7 * 8
    assert len(log.episodes) == 8
    shares = np.array([1, 0.5, 0.25, 0.125, 0.0625, 0, 1, 0.5])[:, None]
    expected = float((shares * np.array(rewards)).sum()) / (7 * 8)
    assert agent.terms["gain"] == pytest.approx(expected, rel=1e-5)


def test_it_climbs() -> None:
    config = APGConfig(horizon=40, normalize_observations=False)
    run = Run(env_id=HOVER, backend="rigid", algorithm="apg", config=config, seed=0,
              env_steps=40 * 16 * 16, num_envs=16)  # fmt: skip
    training = Training(run, env_of(16, episode_length=40))
    gains: list[float] = []
    training.train(lambda: gains.append(training.agent.scalars()["train/policy_loss"]) or True)
    assert np.mean(gains[-3:]) < np.mean(gains[:3]) - 0.02  # minus the gain


def test_it_resumes_to_the_bit() -> None:
    config = APGConfig(horizon=10, hidden=(8,))
    run = Run(env_id=HOVER, backend="rigid", algorithm="apg", config=config, seed=1,
              env_steps=320, num_envs=8, options={"episode_length": 25})  # fmt: skip
    whole, part = (Training(run, env_of(8, episode_length=25)) for _ in range(2))
    whole.train()
    updates = []
    assert not part.train(lambda: updates.append(0) or len(updates) < 2)
    rest = Training.resume(part.checkpoint(), env_of(8, episode_length=25))
    rest.train()
    for name, array in whole.agent.state().items():
        assert rest.agent.state()[name].tobytes() == array.tobytes(), name


def test_it_flies_as_its_policy_does() -> None:
    """The actions of the flight are those of `NetworkPolicy`, normalised observations too."""
    agent, log = agent_of(APGConfig(horizon=5), episode_length=50)
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
    short = ["--env-steps", "800", "--set", "horizon=50"]
    assert main([*words, *short]) == 0
    assert "trained 800 of 800 env steps" in capsys.readouterr().out
    assert main(["evaluate", str(tmp_path / "run"), "--episodes", "1"]) == 0
    assert main([*words[:-1], str(tmp_path / "no"), "--listen", "127.0.0.1:0"]) == 1
    assert "listen: expected no flags of the wire" in capsys.readouterr().err

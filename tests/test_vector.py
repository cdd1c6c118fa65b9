"""The vector env: N single envs bit for bit, Gymnasium's autoreset, and clear refusals."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import rotorgram.envs
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from rotorgram.envs import ENV_ID, ElevationVectorEnv
from rotorgram.envs.physics import PhysicsError
from rotorgram.models.frames import attitude_in_paper_frame, attitudes_in_paper_frame

N = 7
SHORT: dict[str, Any] = {"episode_length": 40, "flight_band": 1.5}
OPTIONS: list[dict[str, Any]] = [
    {},
    {"action_mode": "offset"},
    {"action_type": "discrete", "observation": "error", "linear_drag": 0.5},
    {"target": (4.0, 9.0), "control_period": 0.05},
    {"control_period": 0.005, "target": 2.0, "flight_band": 10.0, "episode_length": 900},
]


def same(ours: Any, theirs: Any, where: str = "") -> None:
    """Equal in every bit; Gymnasium keeps final observations and infos as objects, where given."""
    if isinstance(theirs, dict):
        assert set(ours) == set(theirs), where
        for name in theirs:
            if "final_info" in where and not name.startswith("_"):
                flags = theirs[f"_{name}"]
                assert ours[name][flags].tobytes() == theirs[name][flags].tobytes(), where
            else:
                same(ours[name], theirs[name], f"{where}/{name}")
    elif theirs.dtype == object:
        for mine, one in zip(ours, theirs, strict=True):
            assert one is None or mine.tobytes() == one.tobytes(), where
    else:
        assert (ours.dtype, ours.shape) == (theirs.dtype, theirs.shape), where
        assert ours.tobytes() == theirs.tobytes(), where


def actions_of(env: Any, dice: np.random.Generator) -> np.ndarray:
    if env.single_action_space == gym.spaces.Discrete(3):
        return dice.integers(0, 3, env.num_envs)
    return dice.uniform(-1.2, 1.2, (env.num_envs, 1)).astype(np.float32)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_bit_for_bit_that_of_single_envs(mode: AutoresetMode, options: dict[str, Any]) -> None:
    options = {**SHORT, **options}
    ours = gym.make_vec(ENV_ID, num_envs=N, autoreset_mode=mode, **options)
    theirs = SyncVectorEnv([lambda: gym.make(ENV_ID, **options)] * N, autoreset_mode=mode)
    assert isinstance(ours, ElevationVectorEnv)
    assert ours.metadata["autoreset_mode"] == mode
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    dice = np.random.default_rng(0)
    for one, other in zip(ours.reset(seed=3), theirs.reset(seed=3), strict=True):
        same(one, other)
    ended = 0
    for _ in range(600):
        actions = actions_of(ours, dice)
        for one, other in zip(ours.step(actions), theirs.step(actions), strict=True):
            same(one, other)
        ended += int((ours.terminated | ours.truncated).sum())
    assert mode == AutoresetMode.SAME_STEP or ended >= N
    ours.close()


def test_the_number_of_threads_changes_nothing() -> None:
    results = []
    for threads in (1, 2, 5):
        env = ElevationVectorEnv(9, num_threads=threads, flight_band=1.2)
        dice = np.random.default_rng(1)
        flown = [env.reset(seed=0)[0].tobytes()]
        flown += [b"".join(x.tobytes() for x in env.step(actions_of(env, dice))[:4])
                  for _ in range(100)]  # fmt: skip
        results.append(flown)
    assert results[0] == results[1] == results[2]


def test_what_a_step_gives_is_the_callers() -> None:
    env = ElevationVectorEnv(3, autoreset_mode="SameStep", episode_length=2)
    env.reset(seed=0)
    first = env.step(np.full((3, 1), 0.5, np.float32))
    kept = [array.copy() for array in first[:4]]
    info = {name: np.copy(value) for name, value in first[4].items()}
    second = env.step(np.full((3, 1), -0.5, np.float32))
    assert second[3].all()
    assert not np.shares_memory(first[0], second[0])
    for array, before in zip(first[:4], kept, strict=True):
        assert array.tobytes() == before.tobytes()
    for name, value in info.items():
        assert first[4][name].tobytes() == value.tobytes()
    # The reward of the last step stays, though the next episode has begun.
    assert second[4]["final_obs"].tobytes() != second[0].tobytes()
    error = second[4]["final_obs"][:, 0].astype(float)
    np.testing.assert_allclose(second[1], (0.5 - abs(error)) / (0.5 + abs(error)), rtol=1e-6)


def test_a_mask_resets_some_and_leaves_the_others() -> None:
    env = ElevationVectorEnv(4, autoreset_mode="Disabled", episode_length=3)
    env.reset(seed=5)
    hold = np.zeros((4, 1), np.float32)
    for _ in range(3):
        _, _, _, truncated, _ = env.step(hold + 0.3)
    assert truncated.all()
    with pytest.raises(gym.error.ResetNeeded, match=r"reset\(\) for env 0 first"):
        env.step(hold)
    before = env.observations.copy()
    mask = np.array([True, False, True, False])
    observations, info = env.reset(seed=[9, 1, 9, 1], options={"reset_mask": mask})
    assert observations[0].tobytes() == observations[2].tobytes()
    assert observations[[1, 3]].tobytes() == before[[1, 3]].tobytes()
    assert (info["_Y"] == mask).all()
    with pytest.raises(gym.error.ResetNeeded, match="env 1 first"):
        env.step(hold)
    env.reset(options={"reset_mask": ~mask})
    assert not env.step(hold)[3].any()


def test_who_holds_is_as_before() -> None:
    held, free = ElevationVectorEnv(2, episode_length=5), ElevationVectorEnv(2, episode_length=5)
    hold, nobody = np.array([True, False]), np.zeros(2, bool)
    actions = np.full((2, 1), 0.4, np.float32)
    for env in (held, free):
        env.reset(seed=0)
        env.advance(actions, nobody)
    before = held.observations[0].tobytes(), held.telemetry[0].tobytes()
    for _ in range(4):
        held.advance(np.full((2, 1), np.nan), nobody | ~hold, holds=hold)
        held.advance(np.array([[9.0], [0.4]]), nobody, holds=hold)
        assert (held.observations[0].tobytes(), held.telemetry[0].tobytes()) == before
        assert (held.rewards[0], held.terminated[0], held.truncated[0]) == (0.0, False, False)
    for _ in range(4):  # and its episode is as long as if it had not been held
        held.advance(actions, ~hold)
        free.advance(actions, ~hold)
        assert held.observations[0].tobytes() == free.observations[0].tobytes()
    assert held.truncated[0]
    held.advance(actions, ~hold, holds=hold)  # it may hold when its episode is over, too
    with pytest.raises(gym.error.ResetNeeded, match="env 0 first"):
        held.advance(actions, nobody)


def test_targets_and_starts_of_ones_own() -> None:
    env = ElevationVectorEnv(3)
    targets, starts = np.array([3.0, 5.0, 400.0]), np.array([2.5, 7.0, 399.0])
    observations, info = env.reset(options={"target": targets, "start": starts})
    assert info["Y"].tolist() == starts.tolist()
    np.testing.assert_array_equal(observations[:, 0], (targets - starts).astype(np.float32))
    assert not env.step(np.zeros((3, 1), np.float32))[2].any()
    # Without a start, the seed gives how far from the target it is: as with the env's own target.
    plain, _ = env.reset(seed=1)
    observations, info = env.reset(seed=1, options={"target": 50.0})
    np.testing.assert_allclose(observations, plain, atol=1e-6)
    np.testing.assert_allclose(info["Y"], 50.0 - plain[:, 0], atol=1e-5)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"mask": 1}, "options: expected some of reset_mask, target, start, got 'mask'"),
        ({"reset_mask": [True, False]}, "reset_mask: expected an array of 2 bool"),
        ({"reset_mask": np.zeros(2, bool)}, "one of them True"),
        ({"target": 1.5}, "target: expected elevations of 2 to"),
        ({"target": np.ones(3)}, r"shape \(2,\)"),
        ({"start": np.nan}, "start: expected elevations of 1 to"),
        ({"start": 9.0}, "start: expected at most flight_band = 3 m from the target, got 9.0"),
    ],
)
def test_wrong_options_of_a_reset(options: dict[str, Any], expected: str) -> None:
    env = ElevationVectorEnv(2)
    with pytest.raises(ValueError, match=expected):
        env.reset(options=options)


@pytest.mark.parametrize("seed", [-1, [1], [1, -1], 0.5, "12"])
def test_wrong_seeds(seed: Any) -> None:
    with pytest.raises(ValueError, match="seed: expected a whole number from 0 on, or 2 of them"):
        ElevationVectorEnv(2).reset(seed=seed)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"num_envs": 0}, "num_envs: expected 1 or more, got 0"),
        ({"num_threads": -1}, "num_threads: expected 0 or more, got -1"),
        ({"autoreset_mode": "never"}, "autoreset_mode: expected 'NextStep' or 'SameStep'"),
        ({"render_mode": "ansi"}, "render_mode: expected None, 'human' or 'rgb_array', got 'ansi'"),
        ({"speed": 1}, "options: expected some of target"),
    ],
)
def test_wrong_arguments(arguments: dict[str, Any], expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        ElevationVectorEnv(**arguments)


@pytest.mark.parametrize(
    ("kind", "actions", "expected"),
    [
        ("continuous", np.zeros(2), r"shape \(2, 1\), got shape \(2,\)"),
        ("continuous", np.array([[0.0], [np.nan]]), "finite numbers, got nan for env 1"),
        ("continuous", np.array([[0.0], [1e300]]), "finite numbers, got inf for env 1"),
        ("continuous", np.array([["a"], ["b"]]), "expected real numbers"),
        ("discrete", np.array([0, 3]), "0, 1 or 2, got 3.0 for env 1"),
        ("discrete", np.array([0.5, 1]), "0, 1 or 2, got 0.5 for env 0"),
    ],
)
def test_wrong_actions_change_nothing(kind: str, actions: np.ndarray, expected: str) -> None:
    envs = [ElevationVectorEnv(2, action_type=kind) for _ in range(2)]
    good = np.zeros(2, int) if kind == "discrete" else np.full((2, 1), 0.3, np.float32)
    for env in envs:
        env.reset(seed=0)
    with pytest.raises(ValueError, match=expected):
        envs[0].step(actions)
    for one, other in zip(*(env.step(good) for env in envs), strict=True):
        same(one, other)


def test_a_step_before_a_reset() -> None:
    with pytest.raises(gym.error.ResetNeeded):
        ElevationVectorEnv(2).step(np.zeros((2, 1), np.float32))


def test_a_bad_state_raises_and_a_reset_mends_it() -> None:
    env = ElevationVectorEnv(3)
    env.reset(seed=0)
    env._physics._qvel[1, 2] = 1e12
    with pytest.raises(PhysicsError, match=r"MuJoCo warned of mjWARN_BADQ.* in envs \[1\]"):
        env.step(np.zeros((3, 1), np.float32))
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros((3, 1), np.float32))
    env.reset(seed=0)
    env.step(np.zeros((3, 1), np.float32))


def test_attitudes_of_many_are_those_of_each() -> None:
    dice = np.random.default_rng(0)
    quaternions = dice.normal(size=(200, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    quaternions[:3] = [1, 0, 0, 0], [1, -0.0, 0, 0], [np.sqrt(0.5), 0, np.sqrt(0.5), 0]
    out = np.full((200, 3), 7.0)
    attitudes_in_paper_frame(quaternions, out)
    expected = np.array([attitude_in_paper_frame(q) for q in quaternions.tolist()])
    assert out.tobytes() == expected.tobytes()


def test_the_registered_env_checks_itself() -> None:
    assert gym.spec(ENV_ID).vector_entry_point == "rotorgram.envs.vector:ElevationVectorEnv"
    assert rotorgram.envs.ElevationVectorEnv is ElevationVectorEnv

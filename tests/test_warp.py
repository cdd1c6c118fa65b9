"""The vector env on MuJoCo Warp, on its CPU device: the flights of the NumPy one, in float32.

What Warp has to compile first takes it half a minute on two cores; its cache keeps it.
"""

import importlib
import sys
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from rotorgram.envs import ElevationVectorEnv
from rotorgram.envs.physics import PhysicsError
from rotorgram.models import load_model
from rotorgram.models.constants import REST_HEIGHT

pytest.importorskip("mujoco_warp")
from rotorgram.envs.warp import HIGHEST, ElevationWarpEnv

N = 6

# The tolerances that docs/gpu.md states. Positions are rounded to float32 in every physics step, so
# that errors grow with the height. The two may feel the floor one physics step apart.
ERROR_M, ERROR_PER_HEIGHT, ERROR_AT_CONTACT = 1e-4, 3e-6, 5e-3
RATE_M_S, RATE_AT_CONTACT = 1e-4, 0.2
THRUST = 5e-6
REWARD_SLOPE = 4.0  # of the reward over |E|, 1/m: steepest at the target


def warp_env(num_envs: int = N, **options: Any) -> ElevationWarpEnv:
    return ElevationWarpEnv(num_envs, device="cpu", **options)


def hold(env: ElevationWarpEnv) -> torch.Tensor:
    return torch.zeros(env.action_space.shape)


@pytest.fixture(scope="module")
def shared() -> Iterator[ElevationWarpEnv]:
    """An env for tests that begin with a reset of their own; to make one takes a second."""
    env = warp_env(2)
    yield env
    env.close()


def actions_of(env: Any, dice: np.random.Generator) -> np.ndarray:
    if env.single_action_space == gym.spaces.Discrete(3):
        return dice.integers(0, 3, env.num_envs)
    return dice.uniform(-1.2, 1.2, (env.num_envs, 1)).astype(np.float32)


@pytest.mark.parametrize(
    ("options", "touches"),
    [
        ({"episode_length": 60}, False),
        ({"action_mode": "offset", "target": HIGHEST, "episode_length": 100}, False),
        ({"action_type": "discrete", "observation": "error", "linear_drag": 0.5}, False),
        ({"target": 2.0, "flight_band": 10.0, "control_period": 0.05}, True),
        ({"target": 2.0, "flight_band": 10.0, "control_period": 0.25}, True),
    ],
    ids=str,
)
def test_flies_as_the_numpy_env_does(options: dict[str, Any], touches: bool) -> None:
    ours = warp_env(autoreset_mode="Disabled", **options)
    theirs = ElevationVectorEnv(N, autoreset_mode="Disabled", **options)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.model_hash == theirs.model_hash
    config, dice = ours.config, np.random.default_rng(0)
    target = config.target_range[0]
    tolerance_m = ERROR_M + ERROR_PER_HEIGHT * (target + config.flight_band)
    touched = ended = 0
    begun = np.ones(N, bool)
    for _ in range(150):
        if begun.any():
            start = target + dice.uniform(-1.0, 1.0, N)
            chosen = {"target": target, "start": start, "reset_mask": begun}
            first, _ = ours.reset(options=chosen)
            np.testing.assert_allclose(first, theirs.reset(options=chosen)[0], atol=tolerance_m)
        actions = actions_of(theirs, dice)
        observations, rewards, terminated, truncated, info = theirs.step(actions)
        mine = ours.step(torch.from_numpy(actions))
        error, floor = abs(observations[:, 0]), theirs._physics.touching
        # A flag may differ within the tolerance of its threshold alone.
        near = abs(error - config.flight_band) < tolerance_m
        near |= abs(info["Y"] - REST_HEIGHT) < tolerance_m
        np.testing.assert_array_equal(mine[2].numpy()[~near], terminated[~near])
        np.testing.assert_array_equal(mine[3].numpy()[~near], truncated[~near])
        low, high = ours.single_observation_space.low, ours.single_observation_space.high
        assert ((mine[0].numpy() >= low) & (mine[0].numpy() <= high)).all()
        error_m = np.where(floor, ERROR_AT_CONTACT, tolerance_m)
        rate = np.where(floor, RATE_AT_CONTACT, RATE_M_S)
        bound = np.stack((error_m, rate, np.full(N, THRUST)), axis=1)
        difference = abs(mine[0].numpy() - observations)
        assert (difference <= bound[:, : difference.shape[1]])[~near].all(), difference
        assert (abs(mine[1].numpy() - rewards) <= REWARD_SLOPE * error_m)[~near].all()
        for name in ("reward_elevation", "reward_termination", "thrust_clipped"):
            values = mine[4][name].numpy().astype(float)
            assert (abs(values - info[name]) <= REWARD_SLOPE * error_m)[~near].all(), name
        telemetry = np.stack([info[name] for name in ours.telemetry_names], axis=1)
        np.testing.assert_allclose(ours.telemetry()[~floor], telemetry[~floor], atol=5e-4)
        begun = terminated | truncated | mine[2].numpy() | mine[3].numpy()
        touched, ended = touched + int(floor.sum()), ended + int(begun.sum())
    assert ended >= N
    assert (touched > 0) == touches


def test_hover_holds() -> None:
    env = warp_env(episode_length=400)
    before = env.reset(seed=0)[0]
    for _ in range(300):
        observations, *_ = env.step(hold(env))
    torch.testing.assert_close(observations, before, atol=1e-6, rtol=0)


def test_free_fall() -> None:
    env = warp_env(1, action_mode="offset", thrust_scale=49.0)
    env.reset(options={"start": 7.0})
    for _ in range(25):
        observations, *_ = env.step(-torch.ones(1, 1))
    # 0.5 s: g t² / 2 = 1.225 m, g t = 4.9 m/s, no thrust.
    expected = torch.tensor([[5.0 - (7.0 - 1.225), 4.9, -1.0]])
    torch.testing.assert_close(observations, expected, atol=1e-5, rtol=0)


def test_next_step_autoreset() -> None:
    env = warp_env(episode_length=3)
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    env.reset(seed=0)
    # Drone 0 is 3 control steps ahead of itself: it begins again alone.
    env.step(hold(env))
    env.reset(options={"reset_mask": np.arange(N) == 0})
    climb = hold(env) + 1.0
    env.step(climb)
    last, _, _, truncated, _ = env.step(climb)
    assert truncated.tolist() == [False] + [True] * (N - 1)
    observations, rewards, terminated, truncated, info = env.step(climb)
    # The others were reset: at rest and hovering, within the band; their action was ignored.
    assert rewards[0] != 0
    assert (rewards[1:] == 0).all()
    assert (observations[1:, 1:] == 0).all()
    assert (observations[1:, 0].abs() <= 1.0).all()
    assert (observations[1:, 0] != last[1:, 0]).all()
    assert truncated.tolist() == [True] + [False] * (N - 1)
    assert not terminated.any()
    assert not info["thrust_clipped"].any()
    for _ in range(3):
        assert not truncated[1:].any()
        observations, rewards, terminated, truncated, _ = env.step(climb)
    assert truncated[1:].all()
    assert (rewards[1:] != 0).all()


def test_same_step_autoreset() -> None:
    env = warp_env(autoreset_mode="SameStep", episode_length=2)
    env.reset(seed=0)
    climb = hold(env) + 1.0
    *_, info = env.step(climb)
    assert not info["_final_obs"].any()
    observations, rewards, terminated, truncated, info = env.step(climb)
    assert truncated.all()
    assert not terminated.any()
    assert info["_final_obs"].all()
    assert (observations[:, 1:] == 0).all()
    # 49 + 5 N for 0.02 s, then 49 + 10 N: 1 and 2 m/s² upwards.
    np.testing.assert_allclose(info["final_obs"][:, 1], -0.06, atol=1e-5)
    error = info["final_obs"][:, 0].abs()
    torch.testing.assert_close(rewards, (0.5 - error) / (0.5 + error))
    torch.testing.assert_close(info["final_info"]["reward_elevation"], rewards)
    # What a step gave is the caller's: the next leaves it alone.
    kept = [observations.clone(), rewards.clone(), truncated.clone()]
    env.step(climb)
    for before, now in zip(kept, (observations, rewards, truncated), strict=True):
        assert torch.equal(before, now)


def test_disabled_autoreset_waits_for_a_reset() -> None:
    env = warp_env(2, autoreset_mode="Disabled", episode_length=1)
    env.reset(seed=0)
    assert env.step(hold(env))[3].all()
    with pytest.raises(gym.error.ResetNeeded, match=r"reset\(\) for env 0 first"):
        env.step(hold(env))
    before = env.physics.qpos.clone()
    observations, info = env.reset(options={"reset_mask": torch.tensor([True, False])})
    assert info["_reward_elevation"].tolist() == [True, False]
    assert torch.equal(env.physics.qpos[1], before[1])
    assert observations[0, 1:].tolist() == [0, 0]
    with pytest.raises(gym.error.ResetNeeded, match="env 1 first"):
        env.step(hold(env))


def test_a_seed_gives_the_same_flight() -> None:
    def flight(env: ElevationWarpEnv, seed: int) -> torch.Tensor:
        seen = [env.reset(seed=seed)[0]]
        dice = np.random.default_rng(1)
        for _ in range(60):
            seen.append(env.step(torch.from_numpy(actions_of(env, dice)))[0])
        return torch.stack(seen)

    options = {"target": (4.0, 9.0), "episode_length": 20}
    env, other = warp_env(**options), warp_env(**options)
    first = flight(env, 3)
    assert torch.equal(flight(other, 3), first)
    assert torch.equal(flight(env, 3), first)  # whatever was flown before
    assert not torch.equal(flight(env, 4)[0], first[0])


def test_starts_are_spread_over_the_band() -> None:
    env = warp_env(2000, target=(4.0, 9.0))
    observations, _ = env.reset(seed=0)
    heights = env.telemetry()[:, 1]
    targets = heights + observations[:, 0].numpy()
    for values, low, high in ((targets, 4.0, 9.0), (observations[:, 0].numpy(), -1.0, 1.0)):
        assert low - 1e-6 <= values.min() <= low + 0.02 * (high - low)
        assert high - 0.02 * (high - low) <= values.max() <= high + 1e-6
        assert abs(values.mean() - (low + high) / 2) < 0.03 * (high - low)


def test_tensors_share_the_memory_of_the_simulator(shared: ElevationWarpEnv) -> None:
    physics, data = shared.physics, shared.physics._data
    for name in ("qpos", "qvel", "ctrl"):
        tensor, array = getattr(physics, name), getattr(data, name)
        assert tensor.data_ptr() == array.ptr
        assert tensor.shape == array.shape
        assert tensor.dtype == torch.float32
    observations, _ = shared.reset(seed=0)
    # Observations are no views: nothing that is done to them reaches the simulator.
    before = data.qpos.numpy().copy()
    observations.fill_(7.0)
    np.testing.assert_array_equal(data.qpos.numpy(), before)


def test_the_model_is_that_of_mujoco() -> None:
    ours, theirs = warp_env(1, linear_drag=0.5).physics._model, load_model(linear_drag=0.5)
    assert int(ours.opt.integrator) == int(theirs.opt.integrator)
    assert ours.opt.timestep.numpy()[0] == np.float32(theirs.opt.timestep)
    np.testing.assert_array_equal(ours.opt.gravity.numpy()[0], theirs.opt.gravity.astype("f4"))
    for name in ("body_mass", "body_inertia", "body_ipos", "body_iquat", "dof_damping"):
        expected = getattr(theirs, name).astype(np.float32)
        np.testing.assert_array_equal(getattr(ours, name).numpy()[0], expected, err_msg=name)


def test_actions_beyond_the_bounds_count_as_the_bounds(shared: ElevationWarpEnv) -> None:
    seen = []
    for size in (1.0, 1e6):
        shared.reset(seed=0)
        seen.append(shared.step(torch.full((2, 1), size))[0])
    assert torch.equal(*seen)


@pytest.mark.parametrize(
    ("kind", "actions", "expected"),
    [
        ("continuous", np.zeros((2, 1), "f4"), "expected a torch tensor on cpu, got ndarray|cpu"),
        ("continuous", torch.zeros(2), r"real numbers of shape \(2, 1\), got torch.float32 of"),
        ("continuous", torch.zeros((2, 1)).cfloat(), "expected real numbers .* got torch.complex"),
        ("continuous", torch.tensor([[0.0], [torch.nan]]), "finite numbers, got nan for env 1"),
        ("continuous", torch.tensor([[1e300], [0.0]]).double(), "finite .*, got inf for env 0"),
        ("discrete", torch.tensor([0, 3]), "0, 1 or 2, got 3.0 for env 1"),
        ("discrete", torch.tensor([0.5, 1.0]), "0, 1 or 2, got 0.5 for env 0"),
    ],
)
def test_wrong_actions_change_nothing(kind: str, actions: Any, expected: str) -> None:
    env = warp_env(2, action_type=kind)
    before, _ = env.reset(seed=0)
    with pytest.raises(ValueError, match=f"^actions: .*{expected}"):
        env.step(actions)
    good = torch.ones(2) if kind == "discrete" else hold(env)
    torch.testing.assert_close(env.step(good)[0], before, atol=1e-6, rtol=0)


def test_without_checks_an_action_that_is_not_finite_counts_as_0() -> None:
    env = warp_env(2, checks=False)
    before, _ = env.reset(seed=0)
    observations, *_ = env.step(torch.tensor([[torch.nan], [torch.inf]]))
    torch.testing.assert_close(observations, before, atol=1e-6, rtol=0)


def test_a_bad_state_raises_and_a_reset_mends_it(shared: ElevationWarpEnv) -> None:
    shared.reset(seed=0)
    shared.physics.qvel[1, 2] = 1e12
    with pytest.raises(PhysicsError, match=r"bad states in envs \[1\]: reset the env"):
        shared.step(hold(shared))
    with pytest.raises(gym.error.ResetNeeded):
        shared.step(hold(shared))
    observations, _ = shared.reset(seed=0)
    torch.testing.assert_close(shared.step(hold(shared))[0], observations, atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"num_envs": 0}, "num_envs: expected 1 or more, got 0"),
        ({"render_mode": "human"}, "render_mode: expected None, got 'human'"),
        ({"autoreset_mode": "never"}, "autoreset_mode: expected 'NextStep' or 'SameStep'"),
        ({"target": (5.0, 200.0)}, r"target: expected at most 100 m in float32, got \(5.0, 200"),
        ({"device": "gpu"}, "device: expected 'cpu', or a CUDA device .*, got 'gpu'"),
        ({"device": "cuda:99"}, "device: expected 'cpu', or a CUDA device .*, got 'cuda:99'"),
        ({"speed": 1}, "options: expected some of target"),
    ],
)
def test_wrong_arguments(arguments: dict[str, Any], expected: str) -> None:
    with pytest.raises(ValueError, match=f"^{expected}"):
        ElevationWarpEnv(**arguments)


@pytest.mark.parametrize(
    ("seed", "options", "expected"),
    [
        ([1, 2], {}, r"seed: expected a whole number from 0 to 2\*\*64 - 1, got \[1, 2\]"),
        (-1, {}, "seed: expected a whole number .*, got -1"),
        (0, {"mask": 1}, "options: expected some of reset_mask, target, start, got 'mask'"),
        (0, {"reset_mask": torch.zeros(2, dtype=torch.bool)}, "reset_mask: .* one of them True"),
        (0, {"target": 200.0}, "target: expected at most 100 m in float32, got 200"),
        (0, {"start": torch.tensor([5.0, 9.0])}, "start: expected at most flight_band = 3 m"),
    ],
)
def test_wrong_resets_change_nothing(
    shared: ElevationWarpEnv, seed: Any, options: dict[str, Any], expected: str
) -> None:
    shared.reset(seed=0)
    before = shared.physics.qpos.clone()
    with pytest.raises(ValueError, match=f"^{expected}"):
        shared.reset(seed=seed, options=options)
    assert torch.equal(shared.physics.qpos, before)


def test_a_step_before_a_reset() -> None:
    env = warp_env(1)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(hold(env))


def test_gymnasium_makes_it() -> None:
    env = gym.make_vec("rotorgram/ElevationWarp-v0", num_envs=3, device="cpu", target=7.0)
    assert isinstance(env, ElevationWarpEnv)
    assert (env.num_envs, env.config.target) == (3, 7.0)


def test_without_mujoco_warp_one_sentence_tells_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delitem(sys.modules, "rotorgram.envs.warp")
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'rotorgram\[gpu\]'"):
        importlib.import_module("rotorgram.envs.warp")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
def test_a_gpu_flies_as_the_cpu_does() -> None:
    ours, theirs = ElevationWarpEnv(N, device="cuda"), warp_env()
    start = {"start": np.linspace(4.0, 6.0, N)}
    for env in (ours, theirs):
        env.reset(seed=0, options=start)
    dice = np.random.default_rng(0)
    for stream in (torch.cuda.default_stream(), torch.cuda.Stream()):
        torch.cuda.synchronize()
        with torch.cuda.stream(stream):
            for _ in range(20):
                actions = torch.from_numpy(actions_of(theirs, dice) / 4)
                for mine, other in zip(
                    ours.step(actions.cuda())[:4], theirs.step(actions)[:4], strict=True
                ):
                    assert mine.is_cuda
                    torch.testing.assert_close(mine.cpu(), other, atol=4e-4, rtol=0)

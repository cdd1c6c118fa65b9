"""MuJoCo Warp on its CPU device: the flights of the backend `mujoco`, in float32.

What Warp has to compile first takes it half a minute on two cores; its cache keeps it.
"""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from rotorgram.envs import LocalVectorEnv, Loop
from rotorgram.envs.loop import OnHost
from rotorgram.models.errors import InputError, MissingPackage
from rotorgram.models.vehicle import Vehicle
from rotorgram.sim import InitialState, PhysicsError, World, make_world

torch = pytest.importorskip("torch")
wp = pytest.importorskip("warp")
pytest.importorskip("mujoco_warp")

ELEVATION, HOVER = "rotorgram/Elevation-v0", "rotorgram/Hover-v0"
HEXA = Path(__file__).parents[1] / "data" / "hexa.xml"
N = 4
# The tolerances that docs/gpu.md states, after 100 control steps of 0.02 s within 40 m of the
# origin: tumbling at random thrusts, and level flight of the elevation task.
TUMBLING = {"position": 1e-3, "quaternion": 2e-4, "velocity": 2e-3, "body_rates": 2e-3}
LEVEL_M, LEVEL_M_S = 1e-4, 1e-4


@pytest.fixture(scope="module", autouse=True)
def quiet() -> None:
    wp.config.log_level = 30


def env_of(env_id: str = ELEVATION, num_envs: int = N, **options: Any) -> LocalVectorEnv:
    options |= {"backend": "warp", "device": "cpu", "tensors": True}
    env = gym.make_vec(env_id, num_envs=num_envs, **options)
    assert isinstance(env, LocalVectorEnv)
    return env


@pytest.fixture(scope="module")
def shared() -> Iterator[LocalVectorEnv]:
    """An env for tests that begin with a reset of their own."""
    env = env_of(autoreset_mode="Disabled", episode_length=60)
    yield env
    env.close()


def hold(num_envs: int = N) -> Any:
    return torch.zeros(num_envs, 1)


# --- the world ------------------------------------------------------------------------------------


def pair(vehicle: Vehicle, **pose: np.ndarray) -> tuple[World, World]:
    """Worlds of either backend that begin alike."""
    ours = make_world(vehicle, N, "warp", device="cpu")
    theirs = make_world(vehicle, N, "mujoco", num_threads=1)
    every = np.ones((N, 1), bool)
    theirs.reset(every, InitialState(**pose))
    ours.reset(
        torch.from_numpy(every),
        InitialState(**{n: torch.tensor(x).float() for n, x in pose.items()}),
    )
    return ours, theirs


@pytest.mark.parametrize("file", [None, HEXA], ids=["paper", "hexa"])
def test_tumbles_as_the_backend_mujoco_does(file: Path | None) -> None:
    vehicle, dice = Vehicle.load(file, linear_drag=0.3), np.random.default_rng(0)
    turned = dice.normal(size=(N, 1, 4))
    ours, theirs = pair(
        vehicle,
        position=dice.uniform(30.0, 40.0, (N, 1, 3)),
        quaternion=turned / np.linalg.norm(turned, axis=-1, keepdims=True),
        velocity=dice.normal(size=(N, 1, 3)),
        body_rates=dice.normal(size=(N, 1, 3)),
    )
    substeps = vehicle.substeps(0.02)
    low, high = vehicle.thrust_low, 0.5 * vehicle.hover_thrust + 0.5 * vehicle.thrust_high
    for _ in range(100):
        thrust = dice.uniform(low, high, (N, 1, vehicle.num_rotors))
        theirs.step(thrust, substeps)
        ours.step(torch.from_numpy(thrust).float(), substeps)
    assert not theirs.state.touching.any()
    assert not ours.state.touching.any()
    for name, tolerance in TUMBLING.items():
        mine, other = getattr(ours.state, name).numpy(), getattr(theirs.state, name)
        np.testing.assert_allclose(mine, other, atol=tolerance, rtol=0, err_msg=name)
    np.testing.assert_allclose(ours.state.thrust, theirs.state.thrust, rtol=1e-6)


@pytest.mark.parametrize("file", [None, HEXA], ids=["paper", "hexa"])
@pytest.mark.parametrize("period", [0.02, 0.5])
def test_feels_the_ground_when_the_backend_mujoco_does(file: Path | None, period: float) -> None:
    vehicle = Vehicle.load(file)
    rest = vehicle.rest_height
    heights = np.array([rest - 0.001, rest + 0.001, rest + 0.3, rest + 9.0])
    position = np.zeros((N, 1, 3))
    position[:, 0, 2] = heights
    ours, theirs = pair(vehicle, position=position)
    assert ours.state.touching.flatten().tolist() == [True, False, False, False]
    for _ in range(round(0.5 / period)):
        # A bounce within a long step is felt as well: contact is looked for every 0.02 s.
        for world, thrust in ((theirs, np.zeros((N, 1, 1))), (ours, torch.zeros(N, 1, 1))):
            world.step(thrust, vehicle.substeps(period))
        np.testing.assert_array_equal(ours.state.touching, theirs.state.touching)
    assert theirs.state.touching.ravel().tolist() == [True, True, True, False]


def test_worlds_outside_the_mask_stay_as_they_are() -> None:
    vehicle = Vehicle.load()
    position = np.full((N, 1, 3), 5.0)
    ours, _ = pair(vehicle, position=position, velocity=np.ones((N, 1, 3)))
    some = torch.tensor([[True], [False], [False], [True]])
    before = {
        name: getattr(ours.state, name).clone() for name in ("position", "velocity", "thrust")
    }
    ours.step(torch.full((N, 1, 4), 60.0), 2, some)
    ours.reset(some & False, InitialState(position=torch.zeros(N, 1, 3)))
    for name, values in before.items():
        now = getattr(ours.state, name)
        assert torch.equal(now[1:3], values[1:3])
        assert not torch.equal(now[0], values[0])


def test_tensors_share_the_memory_of_the_simulator() -> None:
    world: Any = make_world(Vehicle.load(), 2, "warp", device="cpu")
    assert world.state.position.data_ptr() == world.qpos.data_ptr()
    world.reset(
        torch.ones(2, 1, dtype=torch.bool), InitialState(position=torch.full((2, 1, 3), 7.0))
    )
    assert world.qpos[:, :3].tolist() == [[7.0] * 3] * 2
    assert world.ctrl.tolist() == [[49.0] * 4] * 2


def test_a_start_too_far_for_float32() -> None:
    with pytest.raises(InputError, match=r"^start: expected coordinates within 100 m .* 500\.0\]"):
        env_of(target=500.0, start_band=0.0).reset(seed=0)


# --- the env --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        {"episode_length": 60},
        {"action": "offset", "target": 90.0},
        {"action_type": "discrete", "observation": "error", "linear_drag": 0.5},
        {"target": 2.0, "flight_band": 10.0, "control_period": 0.05},
    ],
    ids=str,
)
def test_flies_as_the_backend_mujoco_does(options: dict[str, Any]) -> None:
    ours = env_of(autoreset_mode="Disabled", **options)
    theirs: Any = gym.make_vec(ELEVATION, num_envs=N, autoreset_mode="Disabled", **options)
    assert ours.env_spec == theirs.env_spec
    dice, begun = np.random.default_rng(0), np.ones(N, bool)
    target, band = ours.env_spec.options["target"], options.get("flight_band", 3.0)
    for _ in range(100):
        if begun.any():
            start = target + dice.uniform(-1.0, 1.0, N)
            chosen = {"target": target, "start": start, "reset_mask": begun}
            first, other = ours.reset(options=chosen)[0], theirs.reset(options=chosen)[0]
            np.testing.assert_allclose(first, other, atol=LEVEL_M, rtol=0)
        if ours.single_action_space == gym.spaces.Discrete(3):
            actions = dice.integers(0, 3, N)
        else:
            actions = dice.uniform(-1.2, 1.2, (N, 1)).astype(np.float32)
        mine: tuple[Any, ...] = ours.step(torch.from_numpy(actions))
        seen, rewards, terminated, truncated, info = mine
        expected = theirs.step(actions)
        error = expected[4]["elevation_error"]
        # A flag may differ within the tolerance of its threshold alone; the ground is no threshold.
        near = abs(abs(error) - band) < LEVEL_M
        crashed = expected[2] & (abs(error) < band - 0.1)
        np.testing.assert_array_equal(terminated.numpy()[~near], expected[2][~near])
        np.testing.assert_array_equal(truncated.numpy()[~near], expected[3][~near])
        off = abs(seen.numpy() - expected[0])
        assert (off[~crashed] <= [LEVEL_M, LEVEL_M_S, 5e-6][: off.shape[1]]).all(), off
        slope = 4.0  # of the reward over |E|, 1/m, at the target
        steady = ~(near | crashed)
        assert (abs(rewards.numpy() - expected[1]) <= slope * LEVEL_M)[steady].all()
        np.testing.assert_allclose(
            info["elevation_error"].numpy()[~crashed], error[~crashed], atol=LEVEL_M, rtol=0
        )
        begun = expected[2] | expected[3] | terminated.numpy() | truncated.numpy()


@pytest.mark.parametrize("file", [None, HEXA], ids=["paper", "hexa"])
def test_hover_observes_and_judges_as_in_numpy(file: Path | None) -> None:
    """The task on tensors says what the task on NumPy says of the same state."""
    loop = Loop(HOVER, N, vehicle=file, backend="warp", device="cpu")
    loop.advance(np.zeros((N, loop.vehicle.num_rotors)), np.ones(N, bool), range(N))
    for _ in range(10):
        loop.advance(torch.rand(N, loop.vehicle.num_rotors) - 0.5)
        assert loop.observations["observation"].dtype == torch.float32
        task = type(loop.task)(loop.task.options, loop.vehicle, (N, 1))
        state = type(loop.world.state)(
            **{name: getattr(loop.world.state, name).double().numpy() for name in TUMBLING},
            command=loop.world.state.command.double().numpy(),
            thrust=loop.world.state.thrust.double().numpy(),
            touching=loop.world.state.touching.numpy(),
        )
        seen, outcome = task.observe(state)["observation"], task.outcome(state)
        np.testing.assert_allclose(loop.observations["observation"], seen[:, 0], atol=2e-6)
        for name, values in outcome.metrics.items():
            np.testing.assert_allclose(loop.metrics[name], values[:, 0], atol=1e-4)
        for name, values in outcome.reward.items():
            np.testing.assert_allclose(loop.reward_terms[name], values[:, 0], atol=1e-5)
        assert loop.terminated.tolist() == outcome.terminated[:, 0].tolist()
        tumbled = loop.telemetry["attitude"]
        assert tumbled.dtype == np.float64
        assert abs(tumbled).max() > 0.1


def test_a_simulator_sends_what_the_tensors_hold() -> None:
    every, still = np.ones(N, bool), np.zeros((N, 1), np.float32)
    loops = [Loop(ELEVATION, N, backend="warp", device="cpu") for _ in range(2)]
    sent = OnHost(loops[0])
    for stepped in (sent, loops[1]):
        stepped.advance(still, every, np.arange(N, dtype=np.uint64))
        stepped.advance(still + 1, ~every, None, np.array([True, False, False, False]))
    assert sent.observations["observation"].dtype == np.float32
    assert sent.rewards.dtype == np.float64
    assert sent.terminated.dtype == sent.truncated.dtype == bool
    np.testing.assert_array_equal(
        sent.observations["observation"], loops[1].observations["observation"]
    )
    assert sent.rewards.tolist() == loops[1].rewards.tolist()
    assert (sent.rewards[0], sent.observations["observation"][0, 1]) == (0.0, 0.0)


def test_next_step_autoreset_and_info_of_tensors() -> None:
    env = env_of(episode_length=3)
    observations, info = env.reset(seed=0)
    names = {"elevation_error", "reward_elevation", "reward_termination"}
    assert set(info) == names | {f"_{name}" for name in names}
    assert all(value.device == observations.device for value in info.values())
    climb = hold() + 1.0
    for _ in range(2):
        assert not env.step(climb)[3].any()
    last, rewards, _, truncated, _ = env.step(climb)
    assert truncated.all()
    assert (rewards != 0).all()
    kept = last.clone()
    observations, rewards, terminated, truncated, _ = env.step(climb)
    # Reset: at rest and hovering, within the band; the action was ignored.
    assert (rewards == 0).all()
    assert not (terminated | truncated).any()
    assert (observations[:, 1:] == 0).all()
    assert (observations[:, 0].abs() <= 1.0).all()
    assert torch.equal(last, kept)  # what a step gave is the caller's
    assert not torch.equal(observations, last)


def test_same_step_autoreset() -> None:
    env = env_of(autoreset_mode="SameStep", episode_length=2)
    env.reset(seed=0)
    climb = hold() + 1.0
    assert "final_obs" not in env.step(climb)[4]
    observations, rewards, _, truncated, info = env.step(climb)
    assert truncated.all()
    assert info["_final_obs"].all()
    assert (observations[:, 1:] == 0).all()
    # 49 + 5 N for 0.02 s, then 49 + 10 N: 1 and 2 m/s² upwards.
    np.testing.assert_allclose(info["final_obs"][:, 1], -0.06, atol=1e-5)
    error = info["final_obs"][:, 0].abs()
    torch.testing.assert_close(rewards, (0.5 - error) / (0.5 + error))
    torch.testing.assert_close(info["final_info"]["reward_elevation"], rewards)


@pytest.mark.parametrize("kind", ["numpy", "torch"])
def test_masks_of_either_kind(shared: LocalVectorEnv, kind: str) -> None:
    shared.reset(seed=0)
    for _ in range(60):
        _, _, _, truncated, _ = shared.step(hold())
    assert truncated.all()
    with pytest.raises(gym.error.ResetNeeded, match=r"reset\(\) for env 0 first"):
        shared.step(hold())
    before = shared.telemetry["position"].copy()
    mask = np.array([True, False, True, False])
    given = torch.from_numpy(mask) if kind == "torch" else mask
    _, info = shared.reset(options={"reset_mask": given, "start": torch.full((N,), 5.5)})
    assert info["_elevation_error"].tolist() == mask.tolist()
    assert shared.telemetry["position"][:, 1].tolist() == [5.5, before[1, 1], 5.5, before[3, 1]]
    with pytest.raises(gym.error.ResetNeeded, match="env 1 first"):
        shared.step(hold())


def test_a_seed_gives_the_same_starts(shared: LocalVectorEnv) -> None:
    first = shared.reset(seed=3)[0]
    second = shared.reset()[0]
    assert torch.equal(shared.reset(seed=3)[0], first)
    assert torch.equal(shared.reset()[0], second)
    assert not torch.equal(shared.reset(seed=4)[0], first)
    assert len(set(first[:, 0].tolist())) == N


def test_starts_are_spread_over_the_band() -> None:
    env = env_of(num_envs=1000, target=(4.0, 9.0))
    observations, _ = env.reset(seed=0)
    goals = env.telemetry["goal"][:, 1]
    for values, low, high in ((goals, 4.0, 9.0), (observations[:, 0].numpy(), -1.0, 1.0)):
        share = np.sort((values - low) / (high - low))
        # Kolmogorov-Smirnov: 1.95 / sqrt(n) is passed by chance once in a thousand times.
        assert abs(share - np.linspace(0, 1, 1000)).max() < 1.95 / 1000**0.5


@pytest.mark.parametrize(
    ("kind", "actions", "expected"),
    [
        ("continuous", torch.zeros(N), r"a tensor of shape \(4, 1\)"),
        ("continuous", np.zeros(N), r"an array of shape \(4, 1\)"),
        ("continuous", torch.zeros((N, 1)).cfloat(), "expected real numbers .* got torch.complex"),
        ("continuous", torch.tensor([[0.0], [torch.nan], [0], [0]]), "got .nan. for env 1"),
        (
            "continuous",
            torch.full((N, 1), 1e300, dtype=torch.float64),
            "finite .*, got .inf. for env 0",
        ),
        ("discrete", torch.tensor([0, 3, 0, 0]), "0 to 2, got .3.0. for env 1"),
        ("discrete", torch.tensor([0.5, 1.0, 0, 0]), "0 to 2, got .0.5. for env 0"),
    ],
)
def test_wrong_actions_change_nothing(
    shared: LocalVectorEnv, kind: str, actions: Any, expected: str
) -> None:
    env = shared if kind == "continuous" else env_of(action_type=kind)
    before, _ = env.reset(seed=0)
    with pytest.raises(InputError, match=f"^actions: .*{expected}"):
        env.step(actions)
    good = torch.ones(N) if kind == "discrete" else hold()
    torch.testing.assert_close(env.step(good)[0], before, atol=1e-6, rtol=0)


def test_actions_beyond_the_bounds_count_as_the_bounds(shared: LocalVectorEnv) -> None:
    seen = []
    for size in (1.0, 1e6):
        shared.reset(seed=0)
        seen.append(shared.step(torch.full((N, 1), size))[0])
    assert torch.equal(*seen)


def test_a_bad_state_raises_and_a_reset_mends_it() -> None:
    loop = Loop(ELEVATION, 2, backend="warp", device="cpu")
    every, still = np.ones(2, bool), np.zeros((2, 1))
    loop.advance(still, every, [0, 1])
    loop.world.state.velocity[1, 0, 2] = 1e12
    with pytest.raises(PhysicsError, match=r"bad states in envs \[1\]: reset the env"):
        loop.advance(still)
    with pytest.raises(gym.error.ResetNeeded):
        loop.advance(still)
    loop.advance(still, every, [0, 1])
    loop.advance(still)
    assert abs(loop.observations["observation"][:, 1:]).max() < 1e-6


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"num_envs": 0}, "num_envs: expected 1 to 65536, got 0"),
        ({"device": "gpu"}, "device: expected 'cpu', or a CUDA device .*, got 'gpu'"),
        ({"device": "cuda:99"}, "device: expected 'cpu', or a CUDA device .*, got 'cuda:99'"),
        ({"num_threads": 2}, "num_threads: expected device, the setting of the backend warp"),
    ],
)
def test_wrong_arguments(arguments: dict[str, Any], expected: str) -> None:
    with pytest.raises(InputError, match=f"^{expected}"):
        LocalVectorEnv(ELEVATION, **{"num_envs": 2, "backend": "warp", **arguments})


def test_without_the_package_one_sentence_tells_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    with pytest.raises(MissingPackage, match=r"^the backend warp needs .*'rotorgram\[gpu\]'"):
        make_world(Vehicle.load(), 2, "warp")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
def test_a_gpu_flies_as_the_cpu_does() -> None:
    ours = gym.make_vec(ELEVATION, num_envs=N, backend="warp", device="cuda", tensors=True)
    theirs = env_of()
    for env in (ours, theirs):
        env.reset(seed=0, options={"start": np.linspace(4.0, 6.0, N)})
    dice = torch.Generator().manual_seed(0)
    for stream in (torch.cuda.default_stream(), torch.cuda.Stream()):
        torch.cuda.synchronize()
        with torch.cuda.stream(stream):
            for _ in range(20):
                actions = torch.rand(N, 1, generator=dice) * 0.5 - 0.25
                for mine, other in zip(
                    ours.step(actions.cuda())[:4], theirs.step(actions)[:4], strict=True
                ):
                    assert mine.is_cuda
                    torch.testing.assert_close(mine.cpu(), other, atol=4e-4, rtol=0)

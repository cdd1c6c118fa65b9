"""The vector env: N single envs bit for bit, Gymnasium's autoreset, and clear refusals."""

import os
import signal
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from contracts import TABLES, everyone, loop_of, on_both_tasks, rows_of, zero_actions
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from mujoco.batch import Batch, SimulationError
from rotorgram.envs import LocalVectorEnv
from rotorgram.models.errors import InputError
from rotorgram.sim import PhysicsError
from rotorgram.udp import RemoteVectorEnv

ID = "rotorgram/Elevation-v0"
HOVER = "rotorgram/Hover-v0"
HEXA = Path(__file__).parents[1] / "data" / "hexa.xml"
N = 7
FLOWN: list[tuple[str, dict[str, Any]]] = [
    (ID, {"flight_band": 1.5}),
    (ID, {"action": "offset", "flight_band": 1.5, "vehicle": HEXA}),
    (ID, {"action_type": "discrete", "observation": "error", "effects": {"linear_drag": 0.5}}),
    (ID, {"target": (4.0, 9.0), "control_period": 0.05}),
    (ID, {"control_period": 0.01, "target": 2.0, "flight_band": 10.0, "episode_length": 90}),
    (HOVER, {"flight_band": 2.0}),
    (HOVER, {"heading": 40.0, "control_period": 0.05, "vehicle": HEXA}),
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
        assert ours.tobytes() == theirs.tobytes(), (where, ours, theirs)


def actions_of(env: Any, dice: np.random.Generator) -> Any:
    if isinstance(env.single_action_space, gym.spaces.Discrete):
        return dice.integers(0, 3, env.num_envs)
    return dice.uniform(-1.2, 1.2, env.action_space.shape).astype(np.float32)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize(("env_id", "options"), FLOWN, ids=str)
def test_bit_for_bit_that_of_single_envs(
    mode: AutoresetMode, env_id: str, options: dict[str, Any]
) -> None:
    options = {"episode_length": 40, **options}
    ours = gym.make_vec(env_id, num_envs=N, autoreset_mode=mode, **options)
    theirs = SyncVectorEnv([lambda: gym.make(env_id, **options)] * N, autoreset_mode=mode)
    assert isinstance(ours, LocalVectorEnv)
    assert ours.metadata["autoreset_mode"] == mode
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    dice = np.random.default_rng(0)
    for one, other in zip(ours.reset(seed=3), theirs.reset(seed=3), strict=True):
        same(one, other)
    ended = 0
    for _ in range(250):
        actions = actions_of(ours, dice)
        step = ours.step(actions)
        for one, other in zip(step, theirs.step(actions), strict=True):
            same(one, other)
        ends = step[2] | step[3]
        ended += int(ends.sum())
    assert ended >= N
    ours.close()


def test_the_number_of_threads_changes_nothing() -> None:
    results = []
    for threads in (1, 2, 5):
        env = LocalVectorEnv(HOVER, 9, num_threads=threads)
        dice = np.random.default_rng(1)
        flown = [env.reset(seed=0)[0].tobytes()]
        for _ in range(60):
            step = env.step(actions_of(env, dice))
            flown += [array.tobytes() for array in step[:4]]
        results.append(flown)
    assert results[0] == results[1] == results[2]


@on_both_tasks
def test_what_a_step_gives_is_the_callers(env_id: str) -> None:
    env = LocalVectorEnv(env_id, 3, autoreset_mode="SameStep", episode_length=2)
    env.reset(seed=0)
    dice = np.random.default_rng(0)
    first = env.step(actions_of(env, dice))
    kept = [array.copy() for array in first[:4]]
    info = {name: np.copy(value) for name, value in first[4].items()}
    second = env.step(actions_of(env, dice))
    assert second[3].all()
    for array, before in zip(first[:4], kept, strict=True):
        assert array.tobytes() == before.tobytes()
    for name, value in info.items():
        assert first[4][name].tobytes() == value.tobytes()
    # The reward is that of the last step, though the next episode has begun.
    assert second[4]["final_obs"].tobytes() != second[0].tobytes()
    if env_id == ID:
        error = abs(second[4]["final_obs"][:, 0].astype(float))
        reward = (0.5 - error) / (0.5 + error)
        np.testing.assert_allclose(second[1], reward, rtol=1e-6)


@on_both_tasks
def test_a_mask_resets_some_and_leaves_the_others(env_id: str) -> None:
    env: Any = LocalVectorEnv(env_id, 4, autoreset_mode="Disabled", episode_length=3)
    env.reset(seed=5)
    hold = np.zeros(env.action_space.shape, np.float32)
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
    assert (info["_z"] == mask).all()
    with pytest.raises(gym.error.ResetNeeded, match="env 1 first"):
        env.step(hold)
    env.reset(options={"reset_mask": ~mask})
    _, _, _, truncated, _ = env.step(hold)
    assert not truncated.any()


NOBODY = ({"reset_mask": np.zeros(2, bool)}, "reset_mask: .* one of them True")


@pytest.mark.parametrize(("options", "expected"), [*TABLES["wrong options of a reset"], NOBODY])
def test_wrong_options_of_a_reset(options: dict[str, Any], expected: str) -> None:
    env = LocalVectorEnv(ID, 2)
    with pytest.raises(InputError, match=f"^{expected}"):
        env.reset(options=options)


@pytest.mark.parametrize("seed", [-1, [1], [1, -1], 0.5, "12", np.array(3)])
def test_wrong_seeds(seed: Any) -> None:
    with pytest.raises(
        InputError, match=r"^seed: expected a whole number of at least 0, or none, or 2 of them"
    ):
        LocalVectorEnv(ID, 2).reset(seed=seed)


@rows_of("wrong arguments", "arguments, expected")
def test_wrong_arguments(arguments: dict[str, Any], expected: str) -> None:
    with pytest.raises(InputError, match=f"^{expected}"):
        LocalVectorEnv(ID, **{"num_envs": 2, **arguments})


COMPLEX = ("continuous", [[1j], [0j]], "expected real numbers")


@pytest.mark.parametrize(
    ("kind", "actions", "expected"), [*TABLES["wrong actions change nothing"], COMPLEX]
)
def test_wrong_actions_change_nothing(kind: str, actions: np.ndarray, expected: str) -> None:
    envs = [LocalVectorEnv(ID, 2, action_type=kind) for _ in range(2)]
    good = np.zeros(2, int) if kind == "discrete" else np.full((2, 1), 0.3, np.float32)
    for env in envs:
        env.reset(seed=0)
    with pytest.raises(InputError, match=f"^actions: .*{expected}"):
        envs[0].step(actions)
    first, second = (env.step(good) for env in envs)
    for one, other in zip(first, second, strict=True):
        same(one, other)


def test_a_step_before_a_reset() -> None:
    env = LocalVectorEnv(ID, 2)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(zero_actions(2))


def test_a_bad_state_raises_and_a_reset_mends_it() -> None:
    loop = loop_of(ID, 3)
    still = zero_actions(3)
    every = everyone(3)
    loop.advance(still, every, [0, 1, 2])
    before = loop.observations["observation"].copy()
    loop.world.state.velocity[1, 0, 2] = 1e12
    with pytest.raises(PhysicsError, match=r"MuJoCo warned of mjWARN_BADQ.* in envs \[1\]"):
        loop.advance(still)
    with pytest.raises(gym.error.ResetNeeded):
        loop.advance(still)
    loop.advance(still, every, [0, 1, 2])
    assert loop.observations["observation"].tobytes() == before.tobytes()
    loop.advance(still)


def test_an_error_of_the_physics_leaves_no_warnings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Env 1 goes bad in the call in which MuJoCo fails in env 0."""
    loop = loop_of(ID, 2)
    step = Batch.step

    def failing(batch: Any, *arguments: Any, **named: Any) -> None:
        step(batch, *arguments, **named)
        raise SimulationError(np.array([0]), "out of memory")

    still = zero_actions(2)
    first = np.array([True, False])
    loop.advance(still, first | True, [0, 1])
    loop.world.state.velocity[1, 0, 2] = 1e12
    with monkeypatch.context() as patch:
        patch.setattr(Batch, "step", failing)
        with pytest.raises(PhysicsError, match="out of memory"):
            loop.advance(still)
    loop.advance(still, first, frozen=~first)
    loop.advance(still, frozen=~first)
    loop.advance(still, ~first)
    loop.advance(still)


@pytest.mark.quiet
def test_tilted_drones_cost_what_level_ones_do() -> None:
    """1,024 drones, telemetry and all: nothing is computed drone by drone."""
    envs = {}
    for tilt in (0.0, 30.0):
        env = LocalVectorEnv(HOVER, 1024, num_threads=1, start_tilt=tilt, start_heading=tilt)
        env.reset(seed=0)
        envs[tilt] = env
    best = dict.fromkeys(envs, float("inf"))
    actions = zero_actions(1024, 4)
    for _ in range(8):
        for tilt, env in envs.items():
            begun = time.perf_counter()
            env.step(actions)
            spent = time.perf_counter() - begun
            best[tilt] = min(best[tilt], spent)
    assert best[30.0] < 2.0 * best[0.0] + 1e-3


def test_the_registered_entry_point() -> None:
    for env_id in (ID, HOVER):
        registered = gym.spec(env_id)
        assert registered.vector_entry_point == "rotorgram.envs.vector:LocalVectorEnv"
        env = gym.make_vec(env_id, num_envs=2)
        assert isinstance(env, LocalVectorEnv)


@pytest.mark.parametrize("num_envs", [1, 4])
def test_a_closed_env_says_so(num_envs: int) -> None:
    env = LocalVectorEnv(ID, num_envs)
    env.reset(seed=0)
    before = env.telemetry["position"].copy()
    env.close()
    env.close()
    for call in (env.reset, lambda: env.step(zero_actions(num_envs))):
        with pytest.raises(gym.error.ClosedEnvironmentError, match="expected an open env"):
            call()
    assert env.telemetry["position"].tobytes() == before.tobytes()


TASKS = Path("/proc/self/task")


@pytest.mark.skipif(not TASKS.is_dir(), reason="no list of threads here")
def test_closing_ends_the_threads() -> None:
    others = set(os.listdir(TASKS))
    env = LocalVectorEnv(ID, 8, num_threads=4)
    ours = set(os.listdir(TASKS)) - others
    assert len(ours) == 3  # and the caller's
    env.close()
    deadline = time.monotonic() + 5.0  # one that is joined may be listed a little longer
    while ours & set(os.listdir(TASKS)) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not ours & set(os.listdir(TASKS))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_threads_do_not_follow_into_a_fork() -> None:
    """A child has no thread that would step its drones: it is told, and does not wait for them."""
    vector = gym.make_vec(ID, num_envs=2, num_threads=2)
    vector.reset(seed=1)
    action = zero_actions(2)
    vector.step(action)
    child = os.fork()
    if child == 0:
        signal.alarm(10)
        try:
            vector.step(action)
        except RuntimeError as error:
            os._exit(0 if "make another env" in str(error) else 1)
        os._exit(2)
    assert os.waitpid(child, 0)[1] == 0
    vector.step(action)
    vector.close()


@pytest.mark.parametrize("mode", AutoresetMode)
def test_other_libraries_find_the_autoreset_and_the_kind_of_env(mode: AutoresetMode) -> None:
    """TorchRL reads the attribute; skrl looks for Gymnasium among the direct bases."""
    with closing(gym.make_vec("rotorgram/Hover-v0", num_envs=2, autoreset_mode=mode)) as env:
        assert env.autoreset_mode == mode
        assert env.metadata["autoreset_mode"] == mode
    for kind in (LocalVectorEnv, RemoteVectorEnv):
        assert VectorEnv in kind.__bases__

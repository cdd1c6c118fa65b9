"""The elevation env: its contract, its closed forms, its bounds and its ends."""

import inspect
import itertools
import math
import re
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from rotorgram.envs import ENV_ID, TELEMETRY_NAMES, ElevationEnv, register
from rotorgram.envs.physics import PhysicsError
from stable_baselines3.common.env_checker import check_env as sb3_check_env

COMBINATIONS = [
    {"action_mode": mode, "action_type": kind, "observation": seen, "linear_drag": drag, **target}
    for mode, kind, seen, drag, target in itertools.product(
        ("increment", "offset"),
        ("continuous", "discrete"),
        ("full", "error"),
        (0.0, 2.0),
        ({}, {"target": (4.0, 8.0), "control_period": 0.05, "episode_length": 20}),
    )
]
H = 0.02


def _a(value: float) -> np.ndarray:
    return np.array([value], np.float32)


def _fixed(start: float, target: float = 5.0, **options: Any) -> ElevationEnv:
    """Env in an episode that starts at `start`, m."""
    env = ElevationEnv(target=target, **options)
    env.reset(seed=0)
    env._physics.data.qpos[2] = start
    return env


# --- registration and contract ----------------------------------------------------------------


@pytest.mark.parametrize("options", COMBINATIONS, ids=lambda o: "-".join(map(str, o.values())))
def test_contract(options: dict[str, Any]) -> None:
    env = gym.make(ENV_ID, disable_env_checker=True, **options).unwrapped
    check_env(env, skip_render_check=True)  # pictures: test_render_modes.py
    sb3_check_env(env)


def test_entry_point_is_declared_and_registers() -> None:
    (entry,) = entry_points(group="gymnasium.envs", name="rotorgram")
    assert entry.load() is register
    spec = gym.registry.pop(ENV_ID)
    try:
        entry.load()()
        assert gym.registry[ENV_ID].entry_point == "rotorgram.envs.elevation:ElevationEnv"
        entry.load()()  # twice does no harm: Gymnasium would warn
    finally:
        gym.registry[ENV_ID] = spec


def test_module_prefix_needs_no_import_and_importing_loads_no_simulator() -> None:
    code = (
        "import gymnasium, sys\n"
        "import rotorgram.envs\n"
        "assert 'mujoco' not in sys.modules\n"
        "del sys.modules['rotorgram.envs'], gymnasium.registry['rotorgram/Elevation-v0']\n"
        "env = gymnasium.make('rotorgram.envs:rotorgram/Elevation-v0', target=7)\n"
        "assert env.unwrapped.config.target == 7.0\n"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True)


def test_options_through_make() -> None:
    env: Any = gym.make(ENV_ID, target=6, observation="error", linear_drag=2.0, episode_length=3)
    env.reset(seed=1)
    assert env.observation_space.shape == (1,)
    assert env.unwrapped.config.target == 6.0
    assert [env.step(_a(0))[3] for _ in range(3)] == [False, False, True]
    with pytest.raises(ValueError, match=r"^options: expected some of target, .*, got 'targt'$"):
        gym.make(ENV_ID, targt=6)
    with pytest.raises(ValueError, match=r"^episode_length: expected .*, got 2.5$"):
        gym.make(ENV_ID, episode_length=2.5)
    with pytest.raises(ValueError, match=r"^render_mode: expected None, .*, got 'ansi'$"):
        ElevationEnv(render_mode="ansi")
    with pytest.raises(ValueError, match=r"^reset: expected no options, got {'target': 3}$"):
        env.reset(options={"target": 3})


def test_frames_per_second_follow_the_control_period() -> None:
    assert ElevationEnv().metadata["render_fps"] == 50
    assert ElevationEnv(control_period=0.1).metadata["render_fps"] == 10


def _table(heading: str) -> list[list[str]]:
    text = (inspect.getdoc(ElevationEnv) or "").split(f"## {heading}")[1].split("\n## ")[0]
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in row] for row in rows]


def test_docstring_tables_agree_with_the_spaces() -> None:
    env = ElevationEnv()
    header, *rows = _table("Observation")
    assert header == ["index", "quantity", "unit", "bounds"]
    space = env.observation_space
    assert [row[0] for row in rows] == [str(i) for i in range(space.shape[0])]
    assert [row[2] for row in rows] == ["m", "m/s", "1"]
    for row, low, high in zip(rows, space.low.tolist(), space.high.tolist(), strict=True):
        bounds = row[3]
        if bounds.startswith("±"):
            bounds = f"-{bounds[1:]} ... {bounds[1:]}"
        assert [float(part) for part in bounds.split(" ... ")] == pytest.approx(
            [low, high], abs=5e-4
        )
    kinds, modes = _table("Action")[1:3], _table("Action")[4:6]
    spaces = {row[0].strip("`"): row[1].strip("`") for row in kinds}
    for kind, written in spaces.items():
        space_of_kind = ElevationEnv(action_type=kind).action_space
        assert repr(space_of_kind).replace(".0", "") == written
    for mode, formula in modes:
        written_scale = float(re.findall(r"(\d+) a", formula)[0])
        assert ElevationEnv(action_mode=mode.strip("`")).config.newtons_per_action == written_scale


def test_docstring_names_every_info_key_and_every_option() -> None:
    env = ElevationEnv()
    text = inspect.getdoc(ElevationEnv) or ""
    keys = list(env.reset(seed=0)[1])
    assert keys[:10] == list(TELEMETRY_NAMES) == list(env.telemetry_names)
    for key in set(keys) - {"F2", "F3"}:
        assert f"`{key}`" in text


# --- actions ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("mode", "newtons"), [("increment", 5.0), ("offset", 20.0)])
def test_discrete_actions_fly_as_the_continuous_ones(mode: str, newtons: float) -> None:
    for index, action in enumerate((-1.0, 0.0, 1.0)):
        few, many = (
            ElevationEnv(action_mode=mode, action_type=kind) for kind in ("discrete", "continuous")
        )
        few.reset(seed=3)
        many.reset(seed=3)
        one, other = few.step(np.int64(index)), many.step(_a(action))
        assert one[0].tobytes() == other[0].tobytes()
        assert one[1:] == other[1:]
        assert one[4]["F1"] == one[4]["F4"] == 49.0 + newtons * action


def test_thrust_is_clipped_and_says_so() -> None:
    env = ElevationEnv(thrust_scale=30.0, flight_band=4.0)
    env.reset(seed=0)
    flown = [env.step(_a(a))[4] for a in (1, 1, 0, -1, -1, -1, -1)]
    assert [info["F3"] for info in flown] == [79, 100, 100, 70, 40, 10, 0]
    assert [info["thrust_clipped"] for info in flown] == [False, True, *[False] * 4, True]


@pytest.mark.parametrize(
    ("kind", "action", "sentence"),
    [
        ("continuous", _a(math.nan), "expected a finite number, got nan"),
        ("continuous", np.array([np.inf]), "expected a finite number, got inf"),
        ("continuous", [1e300], "expected a finite number, got inf"),
        ("continuous", 0.5, r"expected an array of shape \(1,\), got shape \(\)"),
        ("continuous", [0.5, 0.5], r"expected an array of shape \(1,\), got shape \(2,\)"),
        ("continuous", ["up"], r"expected an array .* of real numbers, got \['up'\]"),
        ("continuous", [1j], r"expected an array .* of real numbers, got \[1j\]"),
        ("continuous", [[1], [1, 2]], r"expected an array .* of real numbers, got"),
        ("discrete", 3, "expected 0, 1 or 2, got 3"),
        ("discrete", -1, "expected 0, 1 or 2, got -1"),
        ("discrete", 1.0, "expected 0, 1 or 2, got 1.0"),
        ("discrete", "hold", "expected 0, 1 or 2, got 'hold'"),
    ],
)
def test_a_wrong_action_changes_nothing(kind: str, action: Any, sentence: str) -> None:
    env, twin = (ElevationEnv(action_type=kind) for _ in range(2))
    for one in (env, twin):
        one.reset(seed=5)
    with pytest.raises(ValueError, match=f"^action: {sentence}"):
        env.step(action)
    good = 2 if kind == "discrete" else _a(0.3)
    assert env.step(good)[4] == twin.step(good)[4]


def test_number_types_of_an_action_do_not_matter() -> None:
    infos = []
    for action in (_a(0.1), [0.1], (0.1,), np.array([0.1]), np.array([0.1], ">f8")):
        env = ElevationEnv()
        env.reset(seed=0)
        infos.append(env.step(action)[4])
    assert all(info == infos[0] for info in infos)
    assert infos[0]["F1"] == 49.0 + 5.0 * float(np.float32(0.1))


# --- flight -----------------------------------------------------------------------------------


@pytest.mark.parametrize("period", [0.005, 0.02, 0.05])
@pytest.mark.parametrize("mode", ["increment", "offset"])
def test_flight_follows_the_formula_of_constant_acceleration(mode: str, period: float) -> None:
    env = ElevationEnv(action_mode=mode, control_period=period, flight_band=50.0, target=60.0)
    _, info = env.reset(seed=2)
    height, speed, thrust = info["Y"], 0.0, 49.0
    for n in range(60):
        action = (1.0, -0.25, 0.5, -1.0)[n // 3 % 4]  # exact in float32
        thrust = min(100.0, max(0.0, thrust + 5 * action if mode == "increment" else
                                49 + 20 * action))  # fmt: skip
        acceleration = 4 * thrust / 20 - 9.8
        height += speed * period + acceleration * period**2 / 2
        speed += acceleration * period
        observation, *_, info = env.step(_a(action))
        assert info["Y"] == pytest.approx(height, abs=1e-9)
        assert (info["X"], info["Z"]) == pytest.approx((0.0, 0.0), abs=1e-9)
        assert observation == pytest.approx([60 - height, -speed, thrust / 49 - 1], abs=1e-5)


def test_flight_with_drag_follows_the_exponential() -> None:
    drag, start = 2.0, 5.0
    env = _fixed(start, action_mode="offset", linear_drag=drag, flight_band=20.0, target=50.0)
    env._target = 5.0
    acceleration = 4 * 20 / 20  # full action: hover + 20 N each
    for n in range(1, 101):
        *_, info = env.step(_a(1.0))
        t = n * H
        fallen = (1 - math.exp(-drag * t)) / drag
        assert info["Y"] == pytest.approx(start + acceleration / drag * (t - fallen), abs=1e-9)


def test_reward_and_observation_of_a_step_by_hand() -> None:
    # Hover from 6 m: E = -1 m, reward (0.5 - 1) / (0.5 + 1).
    env = _fixed(6.0)
    observation, reward, terminated, truncated, info = env.step(_a(0.0))
    assert observation == pytest.approx([-1.0, 0.0, 0.0], abs=1e-6)
    assert reward == info["reward_elevation"] == pytest.approx(-1 / 3)
    assert (info["reward_termination"], info["thrust_clipped"]) == (0.0, False)
    assert not terminated
    assert not truncated
    assert [info[f"F{i}"] for i in (1, 2, 3, 4)] == [49.0] * 4


def test_telemetry_is_in_the_papers_frame() -> None:
    env = _fixed(5.0)
    half = math.radians(20) / 2
    env._physics.data.qpos[:] = 1.0, 2.0, 5.0, math.cos(half), 0.0, 0.0, math.sin(half)
    *_, info = env.step(_a(0.0))  # turned left by 20 degrees
    assert [info[name] for name in TELEMETRY_NAMES[:6]] == pytest.approx(
        [-2.0, 5.0, 1.0, 0.0, -20.0, 0.0], abs=1e-9
    )


def test_observation_is_nobody_elses_memory() -> None:
    env = ElevationEnv()
    first, _ = env.reset(seed=0)
    kept = first.copy()
    second, *_ = env.step(_a(1.0))
    np.testing.assert_array_equal(first, kept)
    assert second.dtype == np.float32
    second.fill(np.nan)
    assert first.base is second.base is None
    assert env.observation_space.contains(env.step(_a(1.0))[0])


OPTIONS = st.fixed_dictionaries(
    {
        "action_mode": st.sampled_from(["increment", "offset"]),
        "observation": st.sampled_from(["full", "error"]),
        "control_period": st.sampled_from([0.005, 0.02, 0.1, 1.0]),
        "linear_drag": st.sampled_from([0.0, 0.0, 2.0, 100.0]),
        "thrust_scale": st.sampled_from([None, 100.0]),
        "flight_band": st.sampled_from([1.01, 3.0, 20.0]),
        "target": st.sampled_from([2.0, 5.0, (2.0, 30.0)]),
    }
)


@settings(max_examples=60, deadline=None)
@given(OPTIONS, st.integers(0, 2**32), st.lists(st.tuples(st.floats(-1, 1), st.integers(1, 60))))
def test_bounds_are_never_left(
    options: dict[str, Any], seed: int, pieces: list[tuple[float, int]]
) -> None:
    env = ElevationEnv(**options)
    observation, _ = env.reset(seed=seed)
    assert observation in env.observation_space
    for action in itertools.chain.from_iterable([a] * n for a, n in pieces):
        observation, reward, terminated, truncated, info = env.step(_a(action))
        assert observation in env.observation_space
        assert not (terminated and truncated)
        assert reward == info["reward_elevation"] + info["reward_termination"]
        if terminated or truncated:
            return


@pytest.mark.parametrize("period", [0.02, 0.1, 0.5])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_fastest_crossing_stays_within_the_bounds(side: float, period: float) -> None:
    """To one edge, back at full acceleration, and out at the other edge."""
    fastest = 0.0
    for turn in np.linspace(0.3, 2.99, 12).tolist():
        env = ElevationEnv(action_mode="offset", thrust_scale=51.0, target=10.0, episode_length=999,
                           start_band=0.0, control_period=period)  # fmt: skip
        env.reset(seed=0)
        over, push = False, side * 0.5
        while not over:
            observation, _, over, *_ = env.step(_a(push))
            assert observation in env.observation_space
            fastest = max(fastest, abs(observation[1]) / env.config.rate_bound)
            if -side * observation[0] > turn:
                push = -side
    assert fastest > 0.4  # the bound is not idle


# --- ends -------------------------------------------------------------------------------------


def _last(env: ElevationEnv, action: float) -> tuple[int, tuple[Any, ...]]:
    for n in itertools.count(1):
        result = env.step(_a(action))
        if result[2] or result[3]:
            return n, result
    raise AssertionError


def test_truncated_by_the_time_limit() -> None:
    env = ElevationEnv()
    env.reset(seed=0)
    n, (_, reward, terminated, truncated, info) = _last(env, 0.0)
    assert (n, terminated, truncated) == (250, False, True)
    assert info["reward_termination"] == 0.0
    assert reward == info["reward_elevation"]
    with pytest.raises(ResetNeeded, match=r"expected a call of reset\(\) first"):
        env.step(_a(0.0))


def test_terminated_by_the_band() -> None:
    # From rest at the target in offset mode at full action: 4 m/s2, so 3 m after sqrt(1.5) s,
    # which lies in step 62 of 0.02 s: 2 * 1.22^2 = 2.9768 and 2 * 1.24^2 = 3.0752.
    env = _fixed(5.0, action_mode="offset")
    n, (_, reward, terminated, truncated, info) = _last(env, 1.0)
    assert (n, terminated, truncated) == (62, True, False)
    assert info["Y"] == pytest.approx(8.0752, abs=1e-9)
    assert reward == pytest.approx((0.5 - 3.0752) / (0.5 + 3.0752) - 20)
    with pytest.raises(ResetNeeded):
        env.step(_a(0.0))


def test_terminated_wins_over_truncated() -> None:
    env = _fixed(5.0, action_mode="offset", episode_length=62)
    n, (_, _, terminated, truncated, _) = _last(env, 1.0)
    assert (n, terminated, truncated) == (62, True, False)


def test_terminated_by_the_floor() -> None:
    env = _fixed(2.0, target=2.0, flight_band=50.0)
    _, (observation, _, terminated, truncated, info) = _last(env, -1.0)
    assert (terminated, truncated) == (True, False)
    assert info["Y"] < 0.4 + 1e-3
    assert observation in env.observation_space


def test_a_bounce_within_a_long_control_period_is_a_crash() -> None:
    env = _fixed(0.5, target=2.0, flight_band=50.0, control_period=1.0, thrust_scale=51.0)
    env._physics.data.qvel[2] = -3.0  # down at 3 m/s, full thrust: floor, and up again
    _, _, terminated, _, info = env.step(_a(1.0))
    assert info["Y"] > 1.0
    assert env._physics.data.ncon == 0
    assert terminated


@pytest.mark.parametrize(("degrees", "over"), [(59.0, False), (61.0, True), (180.0, True)])
@pytest.mark.parametrize("axis", [4, 5])
def test_terminated_by_tilt(degrees: float, over: bool, axis: int) -> None:
    env = _fixed(5.0)
    env._physics.data.qpos[3] = math.cos(math.radians(degrees) / 2)
    env._physics.data.qpos[axis] = math.sin(math.radians(degrees) / 2)
    _, reward, terminated, truncated, info = env.step(_a(0.0))
    assert (terminated, truncated) == (over, False)
    assert info["reward_termination"] == (-20.0 if over else 0.0)
    assert reward == info["reward_elevation"] + info["reward_termination"]


@pytest.mark.parametrize("field", ["qpos", "qvel"])
def test_a_bad_state_raises_and_leaves_no_log(
    field: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    env = ElevationEnv()
    env.reset(seed=0)
    getattr(env._physics.data, field)[2] = math.nan
    with pytest.raises(PhysicsError, match=f"MuJoCo warned of mjWARN_BAD{field.upper()} .*reset"):
        env.step(_a(0.0))
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ResetNeeded):
        env.step(_a(0.0))
    twin = ElevationEnv()
    assert env.reset(seed=4)[1] == twin.reset(seed=4)[1]
    assert env.step(_a(0.5))[4] == twin.step(_a(0.5))[4]


def test_a_log_file_that_the_user_named_stays_on(tmp_path: Path) -> None:
    import mujoco

    old = mujoco.MjLogConfig.get()
    mine = mujoco.MjLogConfig.get()
    mine.logto_file, mine.logfile = True, str(tmp_path / "mine.txt")
    try:
        mine.set()
        env = ElevationEnv()
        assert mujoco.MjLogConfig.get().logto_file
        env.reset(seed=0)
        env._physics.data.qvel[0] = math.nan
        with pytest.raises(PhysicsError):
            env.step(_a(0.0))
        assert "QVEL" in (tmp_path / "mine.txt").read_text()
    finally:
        old.set()


def test_a_step_before_a_reset() -> None:
    with pytest.raises(ResetNeeded, match=r"step: expected a call of reset\(\) first"):
        ElevationEnv().step(_a(0.0))


# --- seeds ------------------------------------------------------------------------------------


def test_seeds() -> None:
    one, other = ElevationEnv(), ElevationEnv()
    starts = [one.reset(seed=seed)[1]["Y"] for seed in range(20)]
    assert starts == [other.reset(seed=seed)[1]["Y"] for seed in range(20)]
    assert len(set(starts)) == 20
    assert all(4 <= start <= 6 for start in starts)


def test_an_unseeded_reset_continues_the_generator() -> None:
    one, other = ElevationEnv(), ElevationEnv()
    sequences = []
    for env in (one, other):
        first = env.reset(seed=0)[1]["Y"]
        sequences.append([first, *(env.reset()[1]["Y"] for _ in range(5))])
    assert sequences[0] == sequences[1]
    assert len(set(sequences[0])) == 6


def test_targets_and_starts_are_uniform() -> None:
    env = ElevationEnv(target=(3.0, 7.0), start_band=0.5)
    env.reset(seed=0)
    targets, offsets = [], []
    for _ in range(2000):
        observation, info = env.reset()
        offsets.append(-float(observation[0]))
        targets.append(info["Y"] + float(observation[0]))
    for values, low, high in ((targets, 3.0, 7.0), (offsets, -0.5, 0.5)):
        share = np.sort((np.array(values) - low) / (high - low))
        # Kolmogorov-Smirnov: 1.95 / sqrt(n) is passed by chance once in a thousand times.
        assert np.abs(share - np.linspace(0, 1, 2000)).max() < 1.95 / math.sqrt(2000)
        assert share[0] > -1e-6
        assert share[-1] < 1 + 1e-6


# --- what a policy on E alone can do ----------------------------------------------------------
#
# a = k E. Offset: E'' + d E' + 4 k E = 0. Increment: E''' + d E'' + 50 k E = 0.


def _errors(gain: float, steps: int, **options: Any) -> np.ndarray:
    """E after each step under a = gain * E, from 0.2 m below the target, m."""
    env = _fixed(4.8, observation="error", episode_length=steps, **options)
    error, errors, over = 0.2, [], False
    while not over:
        observation, _, terminated, truncated, _ = env.step(_a(gain * error))
        error, over = float(observation[0]), terminated or truncated
        errors.append(error)
    return np.array(errors)


@pytest.mark.parametrize("drag", [0.0, 0.5, 2.0])
@pytest.mark.parametrize("gain", [0.02, 0.1, 0.3, -0.1])
def test_increment_on_error_alone_diverges_even_with_drag(drag: float, gain: float) -> None:
    roots = np.roots([1.0, drag, 0.0, 50 * gain])
    assert roots.real.max() > 0.1
    errors = _errors(gain, 5000, action_mode="increment", linear_drag=drag)
    assert len(errors) < 5000
    assert abs(errors[-1]) > 3.0


def test_offset_on_error_alone_oscillates_without_drag() -> None:
    # w^2 = 4 k = 2; holding the thrust for a step feeds in energy: amplitude^2 grows by
    # 1 + w^2 h^2 / 2 = 1.0004 in each step.
    errors = _errors(0.5, 1000, action_mode="offset")
    assert len(errors) == 1000
    peaks = np.abs(errors[1:-1])[np.diff(np.sign(np.diff(errors))) != 0]
    periods = np.diff(np.flatnonzero(np.diff(np.sign(errors)) != 0)) * 2 * H
    assert periods == pytest.approx(2 * math.pi / math.sqrt(2), rel=0.02)
    steps = math.pi / math.sqrt(2) / H
    assert peaks[1:] / peaks[:-1] == pytest.approx(1.0004 ** (steps / 2), rel=1e-3)
    assert np.abs(errors[-250:]).max() > 0.2


@pytest.mark.parametrize("gain", [0.05, 0.5, 1.0])
@pytest.mark.parametrize("drag", [0.5, 2.0])
def test_offset_on_error_alone_converges_with_drag(gain: float, drag: float) -> None:
    slowest = -np.roots([1.0, drag, 4 * gain]).real.max()
    assert slowest > 0
    errors = _errors(gain, round(10 / slowest / H), action_mode="offset", linear_drag=drag)
    assert np.abs(errors[-10:]).max() < 2e-4  # ten time constants: 0.2 m * e^-10 = 9e-6 m


def test_offset_with_the_wrong_sign_diverges() -> None:
    assert abs(_errors(-0.5, 1000, action_mode="offset", linear_drag=2.0)[-1]) > 3.0


def test_increment_on_the_full_observation_can_converge() -> None:
    # a = 0.4 E + 0.4 E' - f with f = F / 49 N - 1: with u = 9.8 f, E'' = -u and
    # u' = 50 a = 20 E + 20 E' - 5.1 u, so s^3 + 5.1 s^2 + 20 s + 20: stable, since 5.1 * 20 > 20.
    assert np.roots([1.0, 50 / 9.8, 20.0, 20.0]).real.max() < -1
    env = _fixed(4.8)
    observation = np.array([0.2, 0.0, 0.0], np.float32)
    for _ in range(250):
        observation, *_ = env.step(_a(float(observation @ [0.4, 0.4, -1.0])))
    assert abs(observation[0]) < 2e-3

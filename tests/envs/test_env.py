"""Single envs: the contract of every task, the closed forms of the elevation task, its ends."""

import inspect
import itertools
import math
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from contracts import TABLES, everyone, loop_of, on_both_tasks, rows_of, spec_with, zero_actions
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from rotorgram.envs import SingleEnv, register
from rotorgram.envs.tasks.elevation import Elevation
from rotorgram.models.errors import InputError
from rotorgram.sim import InitialState, PhysicsError, stack

ID = "rotorgram/Elevation-v0"
HOVER = "rotorgram/Hover-v0"
HEXA = str(Path(__file__).parents[1] / "data" / "hexa.xml")
DRAG = {"linear_drag": 2.0}
COMBINATIONS: list[tuple[str, dict[str, Any]]] = [
    (ID, {"action": mode, "action_type": kind, "observation": seen, **rest})
    for mode, kind, seen, rest in itertools.product(
        ("increment", "offset"),
        ("continuous", "discrete"),
        ("full", "error"),
        ({}, {"target": (4.0, 8.0), "control_period": 0.05, "effects": DRAG, "vehicle": HEXA}),
    )
]
COMBINATIONS += [
    (HOVER, {}),
    (HOVER, {"goal": (30.0, -4.0, 8.0), "heading": 90.0, "control_period": 0.05, "vehicle": HEXA}),
    (HOVER, {"start_tilt": 0.0, "start_band": 0.0, "start_heading": 180.0, "episode_length": 9}),
]


def _a(value: float) -> np.ndarray:
    return np.array([value], np.float32)


def _env(env_id: str = ID, **options: Any) -> SingleEnv:
    env = gym.make(env_id, disable_env_checker=True, **options).unwrapped
    assert isinstance(env, SingleEnv)
    return env


class Flight:
    """A loop with one drone that begins at some height, m; its state can be written."""

    def __init__(self, start: float, target: float = 5.0, **options: Any) -> None:
        class Placed(Elevation):
            def begin(self, draw: Any) -> InitialState:
                super().begin(draw)
                return InitialState(position=stack((0.0, 0.0, np.array([[start]]))))

        register("env/Placed-v0", Placed)
        self.loop = loop_of("env/Placed-v0", **{"target": target, **options})
        every = everyone(1)
        self.loop.advance(zero_actions(1), every, [0])
        self.state = self.loop.world.state

    def step(self, action: float) -> None:
        self.loop.advance(np.array([[action]], np.float32))

    @property
    def over(self) -> bool:
        return bool(self.loop.done[0])

    @property
    def observation(self) -> np.ndarray:
        return np.asarray(self.loop.observations["observation"][0])

    @property
    def height(self) -> float:
        return float(self.loop.telemetry["position"][0, 2])

    @property
    def ends(self) -> tuple[bool, bool]:
        loop = self.loop
        return bool(loop.terminated[0]), bool(loop.truncated[0])

    def fly_out(self, action: float) -> int:
        """Steps until the episode is over."""
        for n in itertools.count(1):
            self.step(action)
            if self.over:
                return n
        raise AssertionError


# --- registration and contract ----------------------------------------------------------------


@pytest.mark.parametrize(("env_id", "options"), COMBINATIONS, ids=str)
def test_contract(env_id: str, options: dict[str, Any]) -> None:
    env = _env(env_id, **options)
    check_env(env, skip_render_check=True)  # pictures: test_render_modes.py
    observation, info = env.reset(seed=1)
    spec = env.env_spec
    telling = [name for array in spec.telemetry for name in array.components]
    told = list(info)
    assert told[: len(telling)] == telling
    types = {type(value) for value in info.values()}
    assert types == {float}
    metrics = {metric.name for metric in spec.metrics}
    assert metrics <= set(info)
    assert env.control_period == spec.control_period
    assert spec == spec_with(env_id, **options)
    before = observation.copy()
    action = env.action_space.sample()
    env.step(action)
    assert observation.tobytes() == before.tobytes()  # nobody else's memory


def test_stable_baselines_accepts_them() -> None:
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    for env_id in (ID, HOVER):
        env = _env(env_id)
        checker.check_env(env)


def test_module_prefix_needs_no_import_and_importing_loads_no_simulator() -> None:
    code = (
        "import gymnasium, sys\n"
        "import rotorgram.envs\n"
        "assert 'mujoco' not in sys.modules\n"
        "assert 'torch' not in sys.modules\n"
        "env = gymnasium.make('rotorgram.envs:rotorgram/Hover-v0', heading=7)\n"
        "assert env.unwrapped.env_spec.options['heading'] == 7.0\n"
        "assert env.unwrapped.env_spec.env_id == 'rotorgram/Hover-v0'\n"
        "assert 'torch' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True)


def test_options_through_make() -> None:
    env = _env(target=6, observation="error", effects={"linear_drag": 2.0}, episode_length=3)
    env.reset(seed=1)
    assert env.observation_space.shape == (1,)
    assert env.env_spec.options["target"] == 6.0
    steps = [env.step(_a(0)) for _ in range(3)]
    truncated = [step[3] for step in steps]
    assert truncated == [False, False, True]
    with pytest.raises(
        InputError, match=r"^options: expected some of .*target.*, got an .* 'targt'"
    ):
        gym.make(ID, targt=6)
    with pytest.raises(InputError, match=r"^render_mode: expected None, .*, got 'ansi'$"):
        SingleEnv(ID, render_mode="ansi")
    with pytest.raises(InputError, match=r"^reset: expected no options, got {'target': 3}$"):
        env.reset(options={"target": 3})
    with pytest.raises(InputError, match=r"^vehicle: cannot read nowhere.xml: "):
        gym.make(ID, vehicle="nowhere.xml")


def test_frames_per_second_follow_the_control_period() -> None:
    usual = _env()
    assert usual.metadata["render_fps"] == 50
    slow = _env(control_period=0.1)
    assert slow.metadata["render_fps"] == 10


def _table(heading: str) -> list[list[str]]:
    text = inspect.getdoc(Elevation) or ""
    _, after = text.split(f"## {heading}")
    section, *_ = after.split("\n## ")
    rows = []
    for line in section.splitlines():
        if line.startswith("| "):
            cells = line.strip("| ").split(" | ")
            rows.append([cell.strip() for cell in cells])
    return rows


def test_bounds_by_hand() -> None:
    space: Any = _env().observation_space
    (observation,) = spec_with(ID).observation
    assert observation.unit == ("m", "m/s", "1")
    assert space.low.tolist() == pytest.approx([-3.225, -11.268, -1.0], abs=5e-4)
    assert space.high.tolist() == pytest.approx([3.225, 11.268, 1.041], abs=5e-4)


def test_docstring_tables_agree_with_the_spaces() -> None:
    actions = _table("Action")
    for kind, told_space, *_ in actions[1:3]:
        env = _env(action_type=kind.strip("`"))
        text = repr(env.action_space)
        assert text.replace(".0", "") == told_space.strip("`")
    for mode, formula in actions[4:6]:
        flight = Flight(5.0, action=mode.strip("`"))
        flight.step(1.0)
        numbers = re.findall(r"(\d+) a", formula)
        newtons = float(numbers[0])
        assert flight.loop.telemetry["thrust"].tolist() == [[49.0 + newtons] * 4]


# --- actions ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("mode", "newtons"), [("increment", 5.0), ("offset", 20.0)])
def test_discrete_actions_fly_as_the_continuous_ones(mode: str, newtons: float) -> None:
    for index, action in enumerate((-1.0, 0.0, 1.0)):
        few = _env(action=mode, action_type="discrete")
        many = _env(action=mode, action_type="continuous")
        few.reset(seed=3)
        many.reset(seed=3)
        one = few.step(np.int64(index))
        other = many.step(_a(action))
        assert one[0].tobytes() == other[0].tobytes()
        assert one[1:] == other[1:]
        info = one[4]
        assert info["F1"] == 49.0 + newtons * action
        assert info["F4"] == info["F1"]


def test_thrust_is_clipped() -> None:
    env = _env(thrust_scale=30.0, flight_band=4.0)
    env.reset(seed=0)
    for action, thrust in TABLES["thrust is clipped"]:
        *_, info = env.step(_a(action))
        assert info["F3"] == thrust


COMPLEX = ("continuous", [1j], r"expected real numbers, got \[1j\]")


@pytest.mark.parametrize(
    ("kind", "action", "sentence"), [*TABLES["a wrong action changes nothing"], COMPLEX]
)
def test_a_wrong_action_changes_nothing(kind: str, action: Any, sentence: str) -> None:
    env = _env(action_type=kind)
    twin = _env(action_type=kind)
    env.reset(seed=5)
    twin.reset(seed=5)
    with pytest.raises(InputError, match=f"^actions?: {sentence}"):
        env.step(action)
    good = 2 if kind == "discrete" else _a(0.3)
    assert env.step(good)[4] == twin.step(good)[4]


def test_number_types_of_an_action_do_not_matter() -> None:
    infos = []
    for action in (_a(0.1), [0.1], (0.1,), np.array([0.1]), np.array([0.1], ">f8")):
        env = _env()
        env.reset(seed=0)
        *_, info = env.step(action)
        infos.append(info)
    first = infos[0]
    assert infos == [first] * len(infos)
    tenth = float(np.float32(0.1))
    assert first["F1"] == 49.0 + 5.0 * tenth


# --- flight -----------------------------------------------------------------------------------


@pytest.mark.parametrize("period", [0.01, 0.02, 0.05])
@pytest.mark.parametrize("mode", ["increment", "offset"])
def test_flight_follows_the_formula_of_constant_acceleration(mode: str, period: float) -> None:
    env = _env(action=mode, control_period=period, flight_band=50.0, target=60.0)
    _, info = env.reset(seed=2)
    height = info["z"]
    speed = 0.0
    thrust = 49.0
    for n in range(60):
        action = (1.0, -0.25, 0.5, -1.0)[n // 3 % 4]  # exact in float32
        if mode == "increment":
            thrust += 5 * action
        else:
            thrust = 49 + 20 * action
        thrust = min(100.0, max(0.0, thrust))
        acceleration = 4 * thrust / 20 - 9.8
        height += speed * period
        height += acceleration * period**2 / 2
        speed += acceleration * period
        observation, *_, info = env.step(_a(action))
        error = 60 - height
        assert info["z"] == pytest.approx(height, abs=1e-9)
        assert info["elevation_error"] == pytest.approx(error, abs=1e-9)
        assert info["x"] == pytest.approx(0.0, abs=1e-9)
        assert info["y"] == pytest.approx(0.0, abs=1e-9)
        assert info["goal_x"] == 0.0
        assert info["goal_z"] == 60.0
        assert info["goal_y"] == 0.0
        expected = [error, -speed, thrust / 49 - 1]
        assert observation == pytest.approx(expected, abs=1e-5)


def test_flight_with_drag_follows_the_exponential() -> None:
    drag = 2.0
    flight = Flight(5.0, action="offset", effects={"linear_drag": drag}, flight_band=20.0)
    for n in range(1, 101):
        flight.step(1.0)  # hover + 20 N each: 4 m/s2
        time = n * 0.02
        lag = (1 - math.exp(-drag * time)) / drag
        risen = 4 / drag * (time - lag)
        assert flight.height == pytest.approx(5.0 + risen, abs=1e-8)


def test_reward_and_observation_of_a_step_by_hand() -> None:
    # Hover at 6 m: E = -1 m, reward (0.5 - 1) / (0.5 + 1).
    flight = Flight(6.0)
    flight.step(0.0)
    loop = flight.loop
    assert flight.observation == pytest.approx([-1.0, 0.0, 0.0], abs=1e-6)
    assert loop.rewards.tolist() == pytest.approx([-1 / 3])
    terms = {name: values.tolist() for name, values in loop.told()()[1].items()}
    assert terms == {"elevation": loop.rewards.tolist(), "termination": [0.0]}
    assert flight.ends == (False, False)
    assert loop.telemetry["thrust"].tolist() == [[49.0] * 4]


def test_telemetry_has_z_up() -> None:
    flight = Flight(5.0)
    half = math.radians(20) / 2
    position = [1.0, 2.0, 5.0]
    quaternion = [math.cos(half), 0.0, 0.0, math.sin(half)]  # to the left
    flight.state.position[:] = position
    flight.state.quaternion[:] = quaternion
    flight.step(0.0)
    told = flight.loop.telemetry
    assert told["position"].ravel() == pytest.approx(position, abs=1e-9)
    assert told["attitude"].ravel() == pytest.approx(quaternion, abs=1e-9)


CHOICES: dict[str, Any] = TABLES["env: options whose bounds are never left"]
OPTIONS = st.fixed_dictionaries({name: st.sampled_from(values) for name, values in CHOICES.items()})
PIECE = st.tuples(st.floats(-1, 1), st.integers(1, 60))


@settings(max_examples=40, deadline=None)
@given(OPTIONS, st.integers(0, 2**32), st.lists(PIECE))
def test_bounds_are_never_left(
    options: dict[str, Any], seed: int, pieces: list[tuple[float, int]]
) -> None:
    env = _env(**options)
    observation, _ = env.reset(seed=seed)
    assert observation in env.observation_space
    for action in itertools.chain.from_iterable([a] * n for a, n in pieces):
        observation, reward, terminated, truncated, info = env.step(_a(action))
        assert observation in env.observation_space
        assert not (terminated and truncated)
        assert reward == info["reward_elevation"] + info["reward_termination"]
        if terminated or truncated:
            return


@pytest.mark.parametrize("period", [0.02, 0.5])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_fastest_crossing_stays_within_the_bounds(side: float, period: float) -> None:
    """To one edge, back at full acceleration, and out at the other edge."""
    fastest = 0.0
    env = _env(action="offset", thrust_scale=51.0, target=10.0, episode_length=999,
               start_band=0.0, control_period=period)  # fmt: skip
    space: Any = env.observation_space
    for turn in np.linspace(0.3, 2.99, 8).tolist():
        env.reset(seed=0)
        over = False
        push = side * 0.5
        while not over:
            observation, _, over, *_ = env.step(_a(push))
            assert observation in space
            error, rate, _ = observation
            share = abs(rate) / space.high[1]
            fastest = max(fastest, share)
            if -side * error > turn:
                push = -side
    assert fastest > 0.4  # the bound is not idle


# --- ends -------------------------------------------------------------------------------------


def test_truncated_by_the_time_limit() -> None:
    env = _env()
    env.reset(seed=0)
    for n in range(250):
        _, reward, terminated, truncated, info = env.step(_a(0.0))
        assert not terminated
        assert truncated == (n == 249)
    assert info["reward_termination"] == 0.0
    assert reward == info["reward_elevation"]
    with pytest.raises(ResetNeeded, match=r"expected a call of reset\(\) for env 0 first"):
        env.step(_a(0.0))


@pytest.mark.parametrize("length", [250, 62])
def test_terminated_by_the_band_and_never_truncated_too(length: int) -> None:
    # From rest at the target in offset mode at full action: 4 m/s2, so 3 m after sqrt(1.5) s,
    # which lies in step 62 of 0.02 s: 2 * 1.22^2 = 2.9768 and 2 * 1.24^2 = 3.0752.
    flight = Flight(5.0, action="offset", episode_length=length)
    assert flight.fly_out(1.0) == 62
    assert flight.ends == (True, False)
    assert flight.height == pytest.approx(8.0752, abs=1e-9)
    elevation = (0.5 - 3.0752) / (0.5 + 3.0752)
    assert flight.loop.rewards[0] == pytest.approx(elevation - 20)
    with pytest.raises(ResetNeeded):
        flight.step(0.0)


def test_terminated_by_the_floor() -> None:
    flight = Flight(2.0, target=2.0, flight_band=50.0)
    flight.fly_out(-1.0)
    assert flight.ends == (True, False)
    assert flight.height < 0.4 + 1e-3


def test_a_bounce_within_a_long_control_period_is_a_crash() -> None:
    flight = Flight(1.5, target=2.0, flight_band=50.0, control_period=1.0, thrust_scale=51.0)
    flight.state.position[..., 2] = 0.5
    flight.state.velocity[..., 2] = -3.0  # to the floor, and up again
    flight.step(1.0)
    assert flight.height > 1.0
    assert flight.ends == (True, False)


@rows_of("terminated by tilt", "degrees, over")
@pytest.mark.parametrize("axis", [1, 2])
def test_terminated_by_tilt(degrees: float, over: bool, axis: int) -> None:
    flight = Flight(5.0)
    half = math.radians(degrees) / 2
    flight.state.quaternion[..., 0] = math.cos(half)
    flight.state.quaternion[..., axis] = math.sin(half)
    flight.step(0.0)
    assert flight.ends == (over, False)
    cost = flight.loop.told()()[1]["termination"]
    assert cost.tolist() == [-20.0 * over]


@pytest.mark.parametrize(("field", "warning"), [("position", "QPOS"), ("velocity", "QVEL")])
def test_a_bad_state_raises_and_leaves_no_log(
    field: str, warning: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    flight = Flight(5.0)
    twin = Flight(5.0)
    getattr(flight.state, field)[..., 2] = math.nan
    with pytest.raises(PhysicsError, match=f"MuJoCo warned of mjWARN_BAD{warning} .*reset"):
        flight.step(0.0)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ResetNeeded):
        flight.step(0.0)
    for one in (flight, twin):
        one.loop.advance(_a(0.0), everyone(1), [4])
        one.step(0.5)
    assert str(flight.loop.telemetry) == str(twin.loop.telemetry)


def test_a_log_file_that_the_user_named_stays_on(tmp_path: Path) -> None:
    old = mujoco.MjLogConfig.get()
    mine = mujoco.MjLogConfig.get()
    mine.logto_file = True
    mine.logfile = str(tmp_path / "mine.txt")
    try:
        mine.set()
        flight = Flight(5.0)
        assert mujoco.MjLogConfig.get().logto_file
        flight.state.velocity[..., 0] = math.nan
        with pytest.raises(PhysicsError):
            flight.step(0.0)
        text = (tmp_path / "mine.txt").read_text()
        assert "QVEL" in text
    finally:
        old.set()


@on_both_tasks
def test_a_step_before_a_reset(env_id: str) -> None:
    env = _env(env_id)
    with pytest.raises(ResetNeeded, match=r"step: expected a call of reset\(\) for env 0 first"):
        env.step(env.action_space.sample())


# --- seeds ------------------------------------------------------------------------------------


@on_both_tasks
def test_seeds(env_id: str) -> None:
    def begun() -> list[bytes]:
        env = _env(env_id)
        starts = []
        for seed in (*range(10), *[None] * 5):  # at last it goes on with the stream
            observation, _ = env.reset(seed=seed)
            starts.append(observation.tobytes())
        return starts

    starts = begun()
    assert starts == begun()
    assert len(set(starts)) == 15


def test_targets_and_starts_are_uniform() -> None:
    env = _env(target=(3.0, 7.0), start_band=0.5)
    infos = [env.reset(seed=None if n else 0)[1] for n in range(2000)]
    targets = np.array([info["goal_z"] for info in infos])
    heights = np.array([info["z"] for info in infos])
    offsets = heights - targets
    for values, low, high in ((targets, 3.0, 7.0), (offsets, -0.5, 0.5)):
        share = np.sort((values - low) / (high - low))
        distance = np.abs(share - np.linspace(0, 1, 2000))
        # Kolmogorov-Smirnov: 1.95 / sqrt(n) is passed by chance once in a thousand times.
        assert distance.max() < 1.95 / math.sqrt(2000)


# --- what a policy on E alone can do ----------------------------------------------------------
#
# a = k E. Offset: E'' + d E' + 4 k E = 0. Increment: E''' + d E'' + 50 k E = 0.


def _errors(gain: float, steps: int, **options: Any) -> np.ndarray:
    """E after each step under a = gain * E, from 0.2 m below the target, m."""
    flight = Flight(4.8, observation="error", episode_length=steps, **options)
    errors = [0.2]
    while not flight.over:
        flight.step(gain * errors[-1])
        (error,) = flight.observation
        errors.append(float(error))
    return np.array(errors[1:])


@pytest.mark.parametrize("drag", [0.0, 2.0])
@pytest.mark.parametrize("gain", [0.02, 0.3, -0.1])
def test_increment_on_error_alone_diverges_even_with_drag(drag: float, gain: float) -> None:
    roots = np.roots([1.0, drag, 0.0, 50 * gain])
    assert roots.real.max() > 0.1
    errors = _errors(gain, 5000, action="increment", effects={"linear_drag": drag})
    assert len(errors) < 5000
    assert abs(errors[-1]) > 3.0


def test_offset_on_error_alone_oscillates_without_drag() -> None:
    # w^2 = 4 k = 2; holding the thrust for a step feeds in energy: amplitude^2 grows by
    # 1 + w^2 h^2 / 2 = 1.0004 in each step.
    errors = _errors(0.5, 1000, action="offset")
    assert len(errors) == 1000
    turns = np.diff(np.sign(np.diff(errors))) != 0
    peaks = np.abs(errors[1:-1][turns])
    crossings = np.diff(np.sign(errors)) != 0
    half_periods = np.diff(np.flatnonzero(crossings))
    periods = half_periods * 2 * 0.02
    assert periods == pytest.approx(2 * math.pi / math.sqrt(2), rel=0.02)
    steps = math.pi / math.sqrt(2) / 0.02
    growth = peaks[1:] / peaks[:-1]
    assert growth == pytest.approx(1.0004 ** (steps / 2), rel=1e-3)
    assert np.abs(errors[-250:]).max() > 0.2


@rows_of("offset on error alone converges with drag", "gain, drag")
def test_offset_on_error_alone_converges_with_drag(gain: float, drag: float) -> None:
    roots = np.roots([1.0, drag, 4 * gain])
    slowest = -roots.real.max()
    assert slowest > 0
    steps = round(10 / slowest / 0.02)
    errors = _errors(gain, steps, action="offset", effects={"linear_drag": drag})
    assert np.abs(errors[-10:]).max() < 2e-4  # ten time constants: 0.2 m * e^-10 = 9e-6 m


def test_offset_with_the_wrong_sign_diverges() -> None:
    errors = _errors(-0.5, 1000, action="offset", effects=DRAG)
    assert abs(errors[-1]) > 3.0


def test_increment_on_the_full_observation_can_converge() -> None:
    # a = 0.4 E + 0.4 E' - f with f = F / 49 N - 1: with u = 9.8 f, E'' = -u and
    # u' = 50 a = 20 E + 20 E' - 5.1 u, so s^3 + 5.1 s^2 + 20 s + 20: stable, since 5.1 * 20 > 20.
    roots = np.roots([1.0, 50 / 9.8, 20.0, 20.0])
    assert roots.real.max() < -1
    flight = Flight(4.8)
    for _ in range(250):
        action = flight.observation @ [0.4, 0.4, -1.0]
        flight.step(float(action))
    assert abs(flight.observation[0]) < 2e-3

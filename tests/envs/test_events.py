"""Events in flight: each kind against a flight without it, and what all kinds have in common."""

import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rotorgram.envs.compiled import CompiledLoop
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.loop import Loop
from rotorgram.models.errors import InputError
from rotorgram.scenes import Solids

BACKENDS = ("mujoco", "rigid")
PERIOD = 0.02  # s
MASS = 20.0  # kg, of the paper's craft
GRAVITY = 9.8  # m/s²
HOVER = np.zeros((1, 4), np.float32)
LEVEL = {"start_tilt": 0.0, "start_heading": 0.0, "start_band": 0.0, "flight_band": 100.0}

ALL_KINDS = (
    {"kind": "wind", "at": 0.1, "velocity": (3.0, 0.0, 0.0), "duration": 0.2},
    {"kind": "kick", "at": 0.2, "impulse": (0.002, 0.0, 0.0), "turn": (0.0, 1e-6, 0.0)},
    {"kind": "rotor", "at": 0.3, "rotor": 2, "share": 0.8},
    {"kind": "mass", "when": "z > 20.05", "mass": -0.005},
    {"kind": "sensor", "at": 0.2, "sensor": "gps", "failure": "frozen", "duration": 0.2},
    {"kind": "sensor", "at": 0.2, "sensor": "imu", "duration": 0.2},
    {"kind": "link", "at": 0.4, "delay": 3},
    {"kind": "link", "at": 0.1, "duration": 0.06, "outage": "hold"},
    {"kind": "link", "at": 0.5, "duration": 0.06, "outage": "off"},
    {"kind": "goal", "at": 0.2, "by": (0.1, 0.0, 0.0)},
)
SENSORS = {"imu": True, "gps": {"noise": 0.1, "velocity_noise": 0.1, "vertical_noise": 0.1}}


def flown(
    events: Any, actions: np.ndarray, backend: str = "mujoco", seed: int = 0, **more: Any
) -> list[dict[str, np.ndarray]]:
    """Telemetry and observations from the start on, of drones that all take the same actions."""
    options = {"backend": backend, "compiled": False, "goal": (0.0, 0.0, 20.0), **LEVEL, **more}
    if backend == "rigid":
        options["dtype"] = "float64"
    loop = Loop(EnvConfig.from_keywords("rotorgram/Hover-v0", events=events, **options))
    loop.advance(None, np.ones(1, bool), [seed])
    told = [{**loop.telemetry, **loop.observations}]
    for action in actions:
        loop.advance(action)
        told.append({**loop.telemetry, **loop.observations})
    loop.close()
    return told


def hovering(steps: int) -> np.ndarray:
    return np.repeat(HOVER[None], steps, axis=0)


def speeds(told: list[dict[str, np.ndarray]]) -> np.ndarray:
    return np.array([one["velocity"][0] for one in told])


# ---- each kind


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_kick_changes_the_velocity_by_impulse_over_mass(backend: str) -> None:
    kick = {"kind": "kick", "at": 2 * PERIOD, "impulse": (10.0, -4.0, 2.0)}
    velocity = speeds(flown([kick], hovering(5), backend))
    assert velocity[:3] == pytest.approx(0.0, abs=1e-12)
    assert velocity[3] == pytest.approx([0.5, -0.2, 0.1], rel=1e-9)
    assert velocity[5] == pytest.approx(velocity[3], rel=1e-9)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_long_kick_is_spread_over_its_duration(backend: str) -> None:
    kick = {"kind": "kick", "at": 0.0, "impulse": (10.0, 0.0, 0.0), "duration": 4 * PERIOD}
    velocity = speeds(flown([kick], hovering(6), backend))[:, 0]
    assert velocity == pytest.approx([0.0, 0.125, 0.25, 0.375, 0.5, 0.5, 0.5], rel=1e-9)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_kick_turns_by_angular_impulse_over_inertia(backend: str) -> None:
    config = EnvConfig.from_keywords("rotorgram/Hover-v0")
    inertia = config.load_vehicle().inertia[2, 2]
    kick = {"kind": "kick", "at": 0.0, "turn": (0.0, 0.0, 0.3)}
    told = flown([kick], hovering(1), backend)
    assert told[1]["body_rates"][0, 2] == pytest.approx(0.3 / inertia, rel=1e-9)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("mass", [-4.0, 5.0])
def test_mass_that_is_dropped_or_taken_changes_the_acceleration(backend: str, mass: float) -> None:
    event = {"kind": "mass", "at": 0.0, "mass": mass}
    velocity = speeds(flown([event], hovering(3), backend))[:, 2]
    rise = GRAVITY * (MASS / (MASS + mass) - 1.0)  # hover thrust on another mass
    assert velocity == pytest.approx(rise * PERIOD * np.arange(4), rel=1e-9)


@pytest.mark.parametrize("backend", BACKENDS)
def test_mass_adds_to_a_mass_that_is_drawn(backend: str) -> None:
    event = {"kind": "mass", "at": 0.0, "mass": 2.0}
    velocity = speeds(flown([event], hovering(1), backend, randomize={"mass": 0.9}))[:, 2]
    rise = GRAVITY * (MASS / (0.9 * MASS + 2.0) - 1.0)
    assert velocity[1] == pytest.approx(rise * PERIOD, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("backend", BACKENDS)
def test_mass_is_taken_at_the_center_and_leaves_the_inertia(backend: str) -> None:
    mass = {"kind": "mass", "at": 0.0, "mass": 20.0}
    turning = np.repeat(np.array([[[0.1, -0.1, 0.1, -0.1]]], np.float32), 3, axis=0)
    usual = flown([], turning, backend)[3]["body_rates"]
    assert flown([mass], turning, backend)[3]["body_rates"] == pytest.approx(usual, rel=1e-9)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_weak_rotor_gives_its_share(backend: str) -> None:
    event = {"kind": "rotor", "at": PERIOD, "rotor": 3, "share": 0.8, "duration": PERIOD}
    told = flown([event], hovering(3), backend)
    thrusts = np.array([one["thrust"][0] for one in told]) / (MASS * GRAVITY / 4)
    assert thrusts[1] == pytest.approx(1.0)
    assert thrusts[2] == pytest.approx([1.0, 1.0, 0.8, 1.0])
    assert thrusts[3] == pytest.approx(1.0)
    # A fifth of a quarter of the weight is missing; the craft has hardly turned yet.
    assert speeds(told)[2, 2] == pytest.approx(-0.05 * GRAVITY * PERIOD, rel=1e-3)


@pytest.mark.parametrize("backend", BACKENDS)
def test_losses_of_a_rotor_add_up_to_no_less_than_nothing(backend: str) -> None:
    events = [{"kind": "rotor", "at": 0.0, "rotor": 1, "share": share} for share in (0.7, 0.6)]
    thrust = flown(events, hovering(1), backend)[1]["thrust"][0, 0]
    assert thrust == pytest.approx(0.3 * MASS * GRAVITY / 4)
    events.append({"kind": "rotor", "at": 0.0, "rotor": 1})
    assert flown(events, hovering(1), backend)[1]["thrust"][0, 0] == 0.0


@pytest.mark.parametrize("backend", BACKENDS)
def test_wind_blows_for_its_duration(backend: str) -> None:
    more: dict[str, Any] = {"vehicle": "crazyflie2", "effects": {"rotor_drag": True}}
    event = {"kind": "wind", "at": PERIOD, "velocity": (3.0, -1.0, 0.0), "duration": 2 * PERIOD}
    told = flown([event], hovering(4), backend, **more)
    winds = np.array([one["wind"][0] for one in told])
    assert winds[:2].tolist() == [[0.0, 0.0, 0.0]] * 2
    assert winds[2:4].tolist() == [[3.0, -1.0, 0.0]] * 2
    assert winds[4].tolist() == [0.0, 0.0, 0.0]
    velocity = speeds(told)
    assert velocity[1] == pytest.approx(0.0, abs=1e-9)
    assert velocity[3, 0] > 0.0 > velocity[3, 1]


def test_wind_adds_to_that_of_the_effects() -> None:
    effects = {"rotor_drag": True, "wind": (1.0, 0.0, 0.0)}
    event = {"kind": "wind", "at": 0.0, "velocity": (2.0, 0.0, 0.5)}
    told = flown([event], hovering(1), vehicle="crazyflie2", effects=effects)
    assert told[1]["wind"].tolist() == [[3.0, 0.0, 0.5]]


@pytest.mark.parametrize(("failure", "held"), [("lost", False), ("frozen", True)])
def test_a_sensor_fails_and_works_again(failure: str, held: bool) -> None:
    event = {"kind": "sensor", "sensor": "gps", "failure": failure, "duration": 0.04, "at": 0.02}
    more: dict[str, Any] = {"vehicle": "crazyflie2", "sensors": SENSORS}
    told = [one["gps"] for one in flown([event], hovering(4), **more)]
    usual = [one["gps"] for one in flown([], hovering(4), **more)]
    before = usual[1] if held else 0.0 * usual[1]
    for failing in told[2:4]:
        assert failing.tolist() == before.tolist()
    for step in (0, 1, 4):  # and its noise is what it would have been
        assert told[step].tobytes() == usual[step].tobytes()


def test_a_slow_sensor_that_is_lost_reads_0_at_once() -> None:
    event = {"kind": "sensor", "sensor": "gps", "failure": "lost", "at": 0.06}
    gps = {"noise": 0.1, "velocity_noise": 0.1, "vertical_noise": 0.1, "rate": 10.0}
    told = [one["gps"] for one in flown([event], hovering(4), sensors={"gps": gps})]
    assert told[3].any()
    assert not told[4].any()


def test_actions_are_late_by_a_delay() -> None:
    dice = np.random.default_rng(0)
    actions = dice.uniform(-0.1, 0.1, (6, 1, 4)).astype(np.float32)
    event = {"kind": "link", "at": 0.0, "delay": 2}
    late = np.concatenate((hovering(2), actions[:4]))
    told = flown([event], actions)
    usual = flown([], late)
    for one, other in zip(told, usual, strict=True):
        assert one["position"].tobytes() == other["position"].tobytes()


def test_the_last_command_is_held_while_the_link_is_out() -> None:
    dice = np.random.default_rng(1)
    actions = dice.uniform(-0.1, 0.1, (6, 1, 4)).astype(np.float32)
    event = {"kind": "link", "at": 2 * PERIOD, "outage": "hold", "duration": 3 * PERIOD}
    told = flown([event], actions)
    usual = flown([], actions[[0, 1, 1, 1, 1, 5]])
    for one, other in zip(told, usual, strict=True):
        assert one["position"].tobytes() == other["position"].tobytes()


def test_the_motors_are_off_while_the_link_is_out() -> None:
    event = {"kind": "link", "at": PERIOD, "outage": "off", "duration": 2 * PERIOD}
    velocity = speeds(flown([event], hovering(4)))[:, 2]
    fall = -GRAVITY * PERIOD
    assert velocity == pytest.approx([0.0, 0.0, fall, 2 * fall, 2 * fall], abs=1e-9)


def test_a_goal_moves_and_comes_back() -> None:
    event = {"kind": "goal", "at": PERIOD, "by": (0.5, 0.0, -1.0), "duration": 2 * PERIOD}
    told = flown([event], hovering(4))
    goals = [one["goal"][0].tolist() for one in told]
    home, away = [0.0, 0.0, 20.0], [0.5, 0.0, 19.0]
    assert goals == [home, home, away, away, home]
    assert told[2]["observation"][0, :3] == pytest.approx([0.5, 0.0, -1.0], abs=1e-5)
    assert told[3]["metrics"][0, 0] == pytest.approx(np.sqrt(1.25))


# ---- when


def test_a_condition_fires_once() -> None:
    """A kick up, above a height, is one kick, though the craft stays there."""
    start = {"kind": "kick", "at": 0.0, "impulse": (0.0, 0.0, 20.0)}  # 1 m/s
    again = {"kind": "kick", "when": "z > 20.05", "impulse": (0.0, 0.0, 20.0)}
    told = flown([start, again], hovering(8))
    velocity = speeds(told)[:, 2]
    height = np.array([one["position"][0, 2] for one in told])
    first = int(np.argmax(height > 20.05))
    assert 1 < first < 6
    assert velocity[1 : first + 1] == pytest.approx(1.0)
    assert velocity[first + 1 :] == pytest.approx(2.0)


def test_every_number_of_the_telemetry_may_be_a_condition() -> None:
    """A thrust has a capital letter in its name."""
    kick = {"kind": "kick", "when": "F1 > 1.0", "impulse": (0.0, 0.0, 20.0)}
    velocity = speeds(flown([kick], hovering(3)))[:, 2]
    assert velocity[-1] == pytest.approx(20.0 / MASS, rel=1e-9)


def test_an_event_of_one_drone_of_a_swarm() -> None:
    kick = {"kind": "kick", "at": 0.0, "drone": 1, "impulse": (0.01, 0.0, 0.0)}
    config = EnvConfig.from_keywords(
        "rotorgram/Formation-v0", drones=2, vehicle="crazyflie2", backend="rigid", events=[kick]
    )
    loop = Loop(config)
    loop.advance(None, np.ones(2, bool), [0, 0])
    before = loop.telemetry["velocity"]
    loop.advance(np.zeros((2, *loop.spec.action.shape), np.float32))
    gained = loop.telemetry["velocity"] - before
    assert abs(gained[0, 0]) < 0.02
    assert gained[1, 0] == pytest.approx(0.01 / config.load_vehicle().mass, rel=0.05)
    loop.close()


def test_the_second_episode_begins_without_the_events_of_the_first() -> None:
    event = {"kind": "mass", "at": PERIOD, "mass": -4.0}
    config = EnvConfig.from_keywords("rotorgram/Hover-v0", events=[event], **LEVEL)
    loop = Loop(config)
    rises = []
    for _ in range(2):
        loop.advance(None, np.ones(1, bool), [3])
        for _ in range(2):
            loop.advance(HOVER)
            rises.append(loop.telemetry["velocity"][0, 2])
    loop.close()
    assert rises[0] == pytest.approx(0.0, abs=1e-9)
    assert rises[1] == pytest.approx(0.25 * GRAVITY * PERIOD)
    assert rises[2:] == rises[:2]


# ---- invariants


def batch(backend: str, *, compiled: bool, worlds: int, restored: bool = False) -> np.ndarray:
    """Observations and telemetry of a flight with events of all kinds, (steps, worlds, n)."""
    config = EnvConfig.from_keywords(
        "rotorgram/Hover-v0", backend=backend, compiled=compiled, vehicle="crazyflie2",
        events=ALL_KINDS, sensors=SENSORS, effects={"rotor_drag": True}, action="velocity",
        randomize={"mass": "uniform(0.9, 1.1)"}, goal=(0.0, 0.0, 20.0), **LEVEL,
    )  # fmt: skip
    make = CompiledLoop if compiled else Loop
    loop = make(config, worlds)
    dice = np.random.default_rng(0)
    loop.advance(None, np.ones(worlds, bool), list(range(worlds)))
    rows = []
    for step in range(36):
        action = dice.uniform(-0.2, 0.2, (1, 4)).astype(np.float32)
        if restored and step % 7 == 3:
            snapshot = loop.snapshot()
            loop.close()
            loop = make(config, worlds)
            loop.restore(snapshot)
        loop.advance(np.repeat(action, worlds, 0))
        arrays = [*loop.observations.values(), *loop.telemetry.values()]
        rows.append(np.concatenate([x.reshape(worlds, -1).astype(float) for x in arrays], axis=1))
    if compiled:
        assert loop.refusal == ""  # type: ignore[attr-defined]
    loop.close()
    return np.array(rows)


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_same_bits_compiled_batched_and_restored(backend: str) -> None:
    usual = batch(backend, compiled=False, worlds=2)
    assert (usual[0] != usual[-1]).any()
    for compiled, restored in ((True, False), (False, True), (True, True)):
        again = batch(backend, compiled=compiled, worlds=2, restored=restored)
        assert again.tobytes() == usual.tobytes()
    alone = batch(backend, compiled=True, worlds=1)
    assert alone.tobytes() == usual[:, :1].tobytes()


def test_an_event_that_never_comes_moves_no_drawn_number() -> None:
    later = [{"kind": kind, "at": 1e5, **size} for kind, size in (
        ("mass", {"mass": 1.0}), ("rotor", {"rotor": 1}), ("link", {"outage": "hold"}),
    )]  # fmt: skip
    randomize = {"mass": "uniform(0.9, 1.1)", "thrust": "uniform(0.9, 1.1)"}
    with_events = flown(later, hovering(3), seed=7, randomize=randomize)
    without = flown([], hovering(3), seed=7, randomize=randomize)
    for one, other in zip(with_events, without, strict=True):
        assert one["velocity"] == pytest.approx(other["velocity"], rel=1e-12)
        assert one["drawn"][:, :2].tobytes() == other["drawn"].tobytes()


def test_the_telemetry_says_what_acts() -> None:
    event = {"kind": "rotor", "at": PERIOD, "rotor": 2, "share": 0.25, "duration": PERIOD}
    told = [one["drawn"].tolist() for one in flown([event], hovering(3))]
    assert told == [[[1.0]], [[1.0]], [[0.25]], [[1.0]]]


# ---- configs


def test_a_config_goes_through_json_keywords_and_a_file(tmp_path: Path) -> None:
    events = [{"kind": "wind", "at": 1, "velocity": [1, 2, 3]}, {"kind": "mass", "when": "z > 1",
              "mass": -1.0, "drone": 0}]  # fmt: skip
    keywords: dict[str, Any] = {"effects": {"rotor_drag": True}, "vehicle": "crazyflie2"}
    config = EnvConfig.from_keywords("rotorgram/Hover-v0", events=events, **keywords)
    assert EnvConfig.from_dict(config.to_dict()) == config
    assert EnvConfig.from_keywords(**config.keywords()) == config
    file = tmp_path / "events.toml"
    file.write_text(
        '[[events]]\nkind = "wind"\nat = 1.0\nvelocity = [1.0, 2.0, 3.0]\n'
        '[[events]]\nkind = "mass"\nwhen = "z > 1"\nmass = -1\ndrone = 0\n'
    )
    read = EnvConfig.from_keywords("rotorgram/Hover-v0", events=str(file), **keywords)
    assert read == config
    assert read.digest == config.digest
    calm = EnvConfig.from_keywords("rotorgram/Hover-v0", **keywords)
    assert "events" not in calm.to_dict()
    assert calm.digest != config.digest


WRONG: list[tuple[str, Any]] = [
    (r"events: expected at most 64 tables \[\[events\]\], got 3", 3),
    ("expected 'wind' or .* or 'obstacle', got 'storm'", [{"kind": "storm"}]),
    (r"events\[0\]: expected at or when, got both or none", [{"kind": "mass", "mass": 1.0}]),
    (
        r"events\[0\].velocity: expected 3 numbers from -100 to 100 m/s, got None",
        [{"kind": "wind", "at": 1.0}],
    ),
    (r"events\[0\]: expected some of .*, got 'mas'", [{"kind": "mass", "at": 1, "mas": 1}]),
    (
        r"events\[0\].mass: expected a number from -1000 to 1000 kg, got inf",
        [{"kind": "mass", "at": 1, "mass": float("inf")}],
    ),
    (
        r"events\[0\].share: expected a number from 0 to 1, got 1.1",
        [{"kind": "rotor", "at": 1, "rotor": 1, "share": 1.1}],
    ),
    (
        r"events\[0\].when: expected NAME > NUMBER, NAME < NUMBER or asked, got .__import__",
        [{"kind": "mass", "when": "__import__('os')", "mass": 1.0}],
    ),
    (
        "events: when: expected some of x, y, z, .*, got 'height'",
        [{"kind": "mass", "when": "height > 1", "mass": 1.0}],
    ),
    (r"events\[0\].drone: .* 0 to 0, got 1", [{"kind": "mass", "at": 0, "mass": 1, "drone": 1}]),
    (r"events\[0\]: expected impulse or turn, got neither", [{"kind": "kick", "at": 0}]),
    (r"events\[0\]: expected delay or outage, got neither", [{"kind": "link", "at": 0}]),
    ("thrust_5: expected one of the 4 rotors", [{"kind": "rotor", "at": 0, "rotor": 5}]),
    (
        r"events\[0\]: expected a sensor of the env, got imu, which is off",
        [{"kind": "sensor", "at": 0, "sensor": "imu"}],
    ),
    (
        "events: wind_x: expected the effect body_drag or rotor_drag, got it switched off",
        [{"kind": "wind", "at": 0, "velocity": (1, 0, 0)}],
    ),
]


@pytest.mark.parametrize(("sentence", "events"), WRONG)
def test_a_wrong_event_is_refused_in_a_sentence(sentence: str, events: Any) -> None:
    with pytest.raises(InputError, match=sentence):
        Loop(EnvConfig.from_keywords("rotorgram/Hover-v0", events=events))


def test_a_task_whose_goal_is_its_own_moves_none() -> None:
    event = {"kind": "goal", "at": 0.0, "by": (1.0, 0.0, 0.0)}
    with pytest.raises(InputError, match=r"expected a task with the option goal, got .*Waypoints"):
        Loop(EnvConfig.from_keywords("rotorgram/Waypoints-v0", events=[event]))


# ---- an obstacle that is thrown


BALL = {"kind": "obstacle", "radius": 0.2, "start": (-6.0, 0.0, 20.5), "velocity": (10.0, 0.0, 1.0)}


def clearances(
    event: dict[str, Any], backend: str, *, compiled: bool, restored: bool = False, **more: Any
) -> list[float]:
    """From the craft's sphere to the nearest solid, after each step of hovering, m."""
    options = {"goal": (0.0, 0.0, 20.0), **LEVEL, **more}
    config = EnvConfig.from_keywords(
        "rotorgram/Hover-v0", backend=backend, compiled=compiled, events=[event], **options
    )
    make = CompiledLoop if compiled else Loop
    loop = make(config)
    loop.advance(None, np.ones(1, bool), [5])
    found = []
    for step in range(12):
        if restored and step == 7:
            snapshot = loop.snapshot()
            loop.close()
            loop = make(config)
            loop.restore(snapshot)
        loop.advance(HOVER)
        found.append(float(loop.record.state.clearance[0, 0]))
    loop.close()
    return found


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_ball_hangs_until_it_is_thrown_and_falls_freely(backend: str) -> None:
    event = BALL | {"at": 5 * PERIOD}
    found = clearances(event, backend, compiled=False)
    radius = EnvConfig.from_keywords("rotorgram/Hover-v0").load_vehicle().radius
    time = PERIOD * np.maximum(np.arange(1, 13) - 5, 0)
    x = -6.0 + 10.0 * time
    z = 0.5 + time - GRAVITY / 2 * time * time
    assert found == pytest.approx(np.hypot(x, z) - 0.2 - radius, abs=1e-4)
    assert found == clearances(event, backend, compiled=False, restored=True)
    assert found == clearances(event, backend, compiled=True)
    assert found == clearances(event, backend, compiled=True, restored=True)


@pytest.mark.parametrize("scene", ["forest:3", "forest:new", "traffic:0-3"])
@pytest.mark.parametrize("backend", BACKENDS)
def test_a_ball_flies_in_every_scene(scene: str, backend: str) -> None:
    """Over the trees, thrown by a condition on the craft."""
    event = BALL | {"when": "z > 19.0", "start": (-6.0, 0.0, 20.0), "velocity": (10.0, 0.0, 0.0)}
    found = clearances(event, backend, compiled=False, scene=scene)
    assert np.diff(found) == pytest.approx(-0.2, abs=0.01)  # 10 m/s for a step
    assert found == clearances(event, backend, compiled=True, scene=scene)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_ball_that_hits_is_a_contact(backend: str) -> None:
    event = BALL | {"at": 0.0, "start": (-3.0, 0.0, 20.0), "velocity": (20.0, 0.0, 0.0)}
    config = EnvConfig.from_keywords(
        "rotorgram/Hover-v0", backend=backend, events=[event], goal=(0.0, 0.0, 20.0), **LEVEL
    )
    loop = Loop(config)
    loop.advance(None, np.ones(1, bool), [5])
    steps = 0
    while not loop.terminated[0] and steps < 20:
        loop.advance(HOVER)
        steps += 1
    assert loop.terminated[0]
    assert 1 < steps < 9  # of 7.5 to the craft's origin
    loop.close()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("scene", ["file", "airport"])
def test_a_ball_beside_what_stands_in_a_scene(scene: str, backend: str, tmp_path: Path) -> None:
    file = tmp_path / "room.toml"
    file.write_text('[[obstacle]]\nkind = "sphere"\nsize = [1.0]\nposition = [9.0, 0.0, 20.0]\n')
    chosen = str(file) if scene == "file" else scene
    beside = BALL | {"at": 0.0, "start": (-60.0, 0.0, 20.0), "velocity": (0.0, 0.0, 0.1)}
    found = clearances(beside, backend, compiled=False, scene=chosen)
    radius = EnvConfig.from_keywords("rotorgram/Hover-v0").load_vehicle().radius
    expected = Solids.of_scene(chosen).standing().distance((0.0, 0.0, 20.0)) - radius
    assert found[0] == pytest.approx(expected, abs=0.05)


def test_the_page_has_every_kind_and_size() -> None:
    root = Path(__file__).parents[2]
    page = (root / "docs" / "events.md").read_text("utf-8")
    kinds = tomllib.loads((root / "envs" / "events.toml").read_text("utf-8"))
    always = kinds.pop("all")
    for kind, sizes in kinds.items():
        (row,) = [line for line in page.splitlines() if line.startswith(f"| `{kind}` |")]
        assert all(f"`{size}`" in row for size in sizes)
    assert all(re.search(rf"\b{name} = |`{name}`", page) for name in always)

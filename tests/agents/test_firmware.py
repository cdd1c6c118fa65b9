"""The Crazyflie's app: built for this machine, it asks for the thrusts that the policy asks for."""

import json
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nets import random_policy
from rotorgram.agents import Checkpoint, load, preset, store
from rotorgram.agents.episodes import Position
from rotorgram.agents.export import on_vehicle
from rotorgram.agents.export.crazyflie import app
from rotorgram.cli import main
from rotorgram.cli._env import UNIVERSAL
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec
from rotorgram.models import Vehicle
from rotorgram.models.errors import InputError
from rotorgram.models.library import find_vehicle
from rotorgram.sim.control.cascade import mixed
from rotorgram.sim.control.gains import Gains
from rotorgram.sim.control.wrench import SIZES
from test_peers import ROOT, compiled, tool

STUB = ROOT / "tests" / "data" / "crazyflie_stub"
C_FLAGS = ["-std=gnu11", "-O2", "-Wall", "-Wextra", "-Wdouble-promotion", "-Wfloat-conversion"]
CHECKED = ["-Werror", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
ARM = 0.046 * np.sqrt(0.5)
TORQUE = 0.005964552
"""Torque of a rotor over its thrust, m."""
HOVER = 0.027 * 9.81 / 4
LARGEST = 0.15916628
LAG = {"motor_lag": True}


def checkpoint_of(
    env_id: str = "rotorgram/Hover-v0", memory: int = 0, scale: float = 0.1, **keywords: Any
) -> Checkpoint:
    """A policy of random weights, of a Crazyflie on `rigid`."""
    given = {"vehicle": "crazyflie2", "backend": "rigid", "effects": LAG, **keywords}
    config = EnvConfig.from_keywords(env_id, **given)
    spec = env_spec(config)
    policy = random_policy(spec, (16,), "tanh", scale, memory=memory)
    chosen = preset("ppo", "tuned", hidden=(16,), activation="tanh", memory=memory)
    return Checkpoint(
        algorithm="ppo",
        config=vars(chosen),
        spec=spec,
        env=config,
        seed=0,
        env_steps=0,
        actor=policy.weights.arrays,
        state={},
        position=Position(env_steps=0, seconds=0.0),
    )


@pytest.fixture
def built(tmp_path: Path) -> Callable[..., Path]:
    def build(checkpoint: Checkpoint, *flags: str) -> Path:
        for name, content in app(checkpoint).items():
            (tmp_path / name).write_bytes(content)
        for file in STUB.iterdir():
            shutil.copy(file, tmp_path)
        sources = [tmp_path / "rotorgram_controller.c", tmp_path / "main.c"]
        program = tmp_path / "app"
        compiled(tool("gcc"), *C_FLAGS, *CHECKED, *flags, "-o", program, *sources, "-lm")
        return program

    return build


def forces(program: Path, records: np.ndarray) -> np.ndarray:
    """Thrust of M1 to M4 after each record, N, as the firmware's mixer takes the sums apart."""
    done = subprocess.run(
        [str(program)],
        input=records.astype(np.float32).tobytes(),
        capture_output=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    sums = np.frombuffer(done.stdout, np.float32).reshape(-1, 4).astype(float)
    thrust, roll, pitch, yaw = (sums / [1.0, ARM, ARM, TORQUE]).T
    motors = (
        thrust - roll - pitch - yaw,
        thrust - roll + pitch + yaw,
        thrust + roll + pitch - yaw,
        thrust + roll - pitch + yaw,
    )
    return np.stack(motors, axis=-1) / 4


def record(
    goal: tuple[float, ...] | None,
    position: Any = (0.0, 0.0, 0.0),
    velocity: Any = (0.0, 0.0, 0.0),
    quaternion: Any = (1.0, 0.0, 0.0, 0.0),
    rates: Any = (0.0, 0.0, 0.0),
    calls: int = 20,
) -> np.ndarray:
    """A goal is x, y, z (m) and a heading (degrees); rates are rad/s."""
    order = (1.0, *goal) if goal else (0.0,) * 5
    gravity = (0.0, 0.0, 1.0)
    yaw = 0.0
    state = (*position, *velocity, *quaternion, *np.degrees(rates), *gravity, yaw)
    return np.array([*order, *state, calls])


def flown(
    checkpoint: Checkpoint, goal: tuple[float, ...], least_range: float = 0.5
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the firmware would see in three episodes of the env, with motors off in between; the
    actions: the policy's, and -1, no thrust, where they are off; and the commands after each, N.
    """
    assert checkpoint.env is not None
    plain = checkpoint.env.changed(backend={"name": "rigid", "compiled": False})
    env = LocalVectorEnv(plain, 1, autoreset_mode="Disabled")
    policy = checkpoint.policy()
    records, actions, commands = [], [], []
    for seed in range(3):
        policy.reset()
        seen, _ = env.reset(seed=seed)
        done = False
        while not done:
            now = {name: values[0] for name, values in env.telemetry.items()}
            words = (now["position"], now["velocity"], now["attitude"], now["body_rates"])
            records.append(record(goal, *words))
            actions.append(np.array(policy.act(seen[0]), float))
            seen, _, terminated, truncated, _ = env.step(actions[-1][None])
            commands.append(env.loop.world.state.command[0, 0].copy())
            done = bool(terminated[0] or truncated[0])
        records.append(record(None))
        actions.append(np.full(4, -1.0))
        commands.append(np.zeros(4))
    env.close()
    assert len(actions) > 30
    assert np.ptp(actions, axis=0).min() > least_range
    return np.array(records), np.array(actions), np.array(commands)


def asked(thrusts: np.ndarray) -> np.ndarray:
    """Actions of the level `rotors` that thrusts are, N: 0 is a hover, 1 the largest."""
    over = thrusts - HOVER
    return np.where(over > 0, over / (LARGEST - HOVER), over / HOVER)


CASES: dict[str, tuple[dict[str, Any], tuple[float, ...]]] = {
    "hover": ({}, (0.0, 0.0, 5.0, 0.0)),
    "without lag": ({"effects": {}}, (0.0, 0.0, 5.0, 0.0)),
    "elsewhere": ({"goal": (2.0, -1.0, 7.0), "heading": 40.0}, (2.0, -1.0, 7.0, 40.0)),
    "memory": ({"memory": 6}, (0.0, 0.0, 5.0, 0.0)),
    "body frame": ({"env_id": "rotorgram/Recovery-v0"}, (0.0, 0.0, 20.0, 0.0)),
}


@pytest.mark.parametrize("case", CASES)
def test_it_asks_for_the_thrusts_of_the_policy(
    case: str, built: Callable[[Checkpoint], Path]
) -> None:
    keywords, goal = CASES[case]
    checkpoint = checkpoint_of(flight_band=20.0, **keywords)
    records, actions, _ = flown(checkpoint, goal)
    found = asked(forces(built(checkpoint), records))
    np.testing.assert_allclose(found, actions, rtol=0, atol=1e-5)


@pytest.mark.parametrize("effects", [{}, LAG], ids=["ideal", "lag"])
@pytest.mark.parametrize("env_id", ["rotorgram/Hover-v0", "rotorgram/Recovery-v0"])
def test_it_mixes_and_drives_what_accelerations_ask_for(
    env_id: str, effects: dict[str, bool], built: Callable[[Checkpoint], Path]
) -> None:
    """Beyond what the rotors can give, too."""
    options = {"action": "wrench", "frame": "body", "heading": 40.0, "flight_band": 20.0}
    checkpoint = checkpoint_of(
        env_id, scale=0.4, goal=(2.0, -1.0, 15.0), effects=effects, **options
    )
    records, _, commands = flown(checkpoint, (2.0, -1.0, 15.0, 40.0))
    assert (commands < 1e-9).any()
    assert (commands > LARGEST - 1e-7).any()
    np.testing.assert_allclose(forces(built(checkpoint), records), commands, rtol=0, atol=2e-5)


def test_roll_and_pitch_come_first_below_what_the_battery_holds_too(
    built: Callable[..., Path],
) -> None:
    """The firmware's largest thrust of a rotor is less than that of the vehicle's file."""
    most = 0.12
    options = {"action": "wrench", "frame": "body", "flight_band": 20.0, "effects": {}}
    checkpoint = checkpoint_of(scale=0.4, **options)
    first = checkpoint.actor["layers.0.weight"]
    first[:, 16:20] = 0.0  # blind to what its rotors do: they are stronger in the env
    records, actions, _ = flown(checkpoint, (0.0, 0.0, 5.0, 0.0))
    vehicle = Vehicle.load("crazyflie2")
    weaker = replace(Gains.of(vehicle, 0.005), highest=4 * most)
    lift, *turns = (np.array(SIZES) * actions).T
    thrusts = mixed(weaker, 0.027 * (9.81 + lift), list(vehicle.inertia @ turns))
    off = records[:, 0] == 0
    expected = np.where(off[:, None], 0.0, np.stack(thrusts, axis=-1))
    assert (expected > most - 1e-7).any()
    found = forces(built(checkpoint, f"-DTHRUST_MAX={most}f"), records)
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-5)


def test_an_estimate_drives_the_rotors_once_in_a_control_period() -> None:
    options = {"action": "wrench", "frame": "body"}
    mocap = {"noise": 0.001, "angle_noise": 0.002}
    sensors = {"imu": True, "motion_capture": mocap, "estimate": True, "observe": "estimate"}
    for checkpoint, calls in (
        (checkpoint_of(**options), 5),
        (checkpoint_of(**options, sensors=sensors), 20),
    ):
        header = app(checkpoint)["rotorgram_crazyflie.h"].decode()
        assert f"#define ROTORGRAM_DRIVEN {calls} " in header


def test_the_policy_for_every_craft_flies_the_crazyflie(
    built: Callable[[Checkpoint], Path],
) -> None:
    checkpoint = on_vehicle(load(UNIVERSAL), "crazyflie2")
    assert checkpoint.env
    assert checkpoint.env.effects.motor_lag
    records, _, commands = flown(checkpoint, (0.0, 0.0, 5.0, 0.0), least_range=0.1)
    np.testing.assert_allclose(forces(built(checkpoint), records), commands, rtol=0, atol=2e-5)


def test_rotors_of_another_order_that_fall_more_slowly(
    built: Callable[[Checkpoint], Path], tmp_path: Path
) -> None:
    text = find_vehicle("crazyflie2").read_text(encoding="utf-8")
    text = text.replace("\n[rotors]\n", "\n[rotors]\ntime_constant_down = 0.15\n")
    head, rotors_and_rest = text.split("[[rotors.list]]\n", 1)
    listed, rest = rotors_and_rest.split("\n[rotors]\n", 1)
    first, *others = listed.split("[[rotors.list]]\n")
    turned = "".join(f"[[rotors.list]]\n{block.rstrip()}\n\n" for block in (*others, first))
    vehicle = tmp_path / "turned.toml"
    vehicle.write_text(f"{head}{turned}[rotors]\n{rest}", encoding="utf-8")
    checkpoint = checkpoint_of(flight_band=20.0, vehicle=str(vehicle))
    records, actions, _ = flown(checkpoint, (0.0, 0.0, 5.0, 0.0))
    found = asked(forces(built(checkpoint), records))
    m1_last = np.roll(actions, 1, axis=1)  # the file now has M2, M3, M4, M1
    np.testing.assert_allclose(found, m1_last, rtol=0, atol=1e-5)


def test_motors_stop_without_a_setpoint_and_begin_anew(
    built: Callable[[Checkpoint], Path],
) -> None:
    program = built(checkpoint_of(memory=6))
    goal = (0.0, 0.0, 5.0, 0.0)
    flying = [record(goal, (0.3, 0.2, 4.0), (0.1, 0.0, -0.3))] * 3
    rows = [*flying, record(None, (0.3, 0.2, 4.0)), *flying]
    found = forces(program, np.array(rows))
    np.testing.assert_allclose(found[3], 0.0, atol=1e-9)
    np.testing.assert_array_equal(found[:3], found[4:])
    assert (found[0] != found[1]).any()  # the rotors of the model, and the memory, have moved on


def test_it_acts_once_in_a_control_period(built: Callable[[Checkpoint], Path]) -> None:
    goal = (0.0, 0.0, 5.0, 0.0)
    near = record(goal, (0.3, 0.2, 4.0), calls=19)
    far = record(goal, (-0.3, 0.9, 5.0), calls=1)
    found = forces(built(checkpoint_of()), np.array([near, far, far]))
    np.testing.assert_array_equal(found[0], found[1])
    assert abs(found[2] - found[1]).max() > 1e-3


def test_an_axis_without_a_wanted_position_keeps_the_last(
    built: Callable[[Checkpoint], Path],
) -> None:
    def rows(last: np.ndarray) -> np.ndarray:
        return np.array([record((0.5, -0.2, 5.0, 30.0), (0.3, 0.2, 4.0)), last])

    program = built(checkpoint_of())
    elsewhere = record((3.0, 2.0, 4.5, -60.0), (0.3, 0.2, 4.0))
    elsewhere[0] = 2  # along z alone
    higher = record((0.5, -0.2, 4.5, 30.0), (0.3, 0.2, 4.0))
    found = forces(program, rows(elsewhere))
    np.testing.assert_array_equal(found, forces(program, rows(higher)))
    elsewhere[0] = 1
    assert (found[1] != forces(program, rows(elsewhere))[1]).any()


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "level": (
        {"action": "rates"},
        "expected rotors or wrench for the firmware's motors, got rates",
    ),
    "number": (
        {"env_id": "rotorgram/Waypoints-v0"},
        "observation: expected numbers that the Crazyflie's firmware knows, "
        "got 'point after - position x'",
    ),
    "past": ({"history": 2}, "got 'goal - position x, 1 step ago'"),
    "curve": ({"effects": {"thrust_curve": True}}, "as the firmware's, got thrust_curve"),
    "craft": ({"vehicle": "heavy_hexa"}, "vehicle: expected four rotors that turn as the"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_the_firmware_cannot_do_is_refused_by_name(case: str) -> None:
    keywords, sentence = REFUSED[case]
    with pytest.raises(InputError) as error:
        app(checkpoint_of(**keywords))
    assert sentence in str(error.value)


def test_a_control_period_of_part_of_a_millisecond_is_refused() -> None:
    checkpoint = checkpoint_of()
    spec = replace(checkpoint.spec, control_period=0.0125)
    with pytest.raises(
        InputError, match=r"milliseconds, as the firmware counts them, got 0.0125 s$"
    ):
        app(replace(checkpoint, spec=spec))


def test_a_policy_of_an_unknown_vehicle_is_refused() -> None:
    with pytest.raises(InputError, match="one vehicle of this machine"):
        app(replace(checkpoint_of(), env=None))


def test_the_command_writes_a_new_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "policy.safetensors"
    store(checkpoint_of().policy_alone(), file)
    out = tmp_path / "app"
    words = ["export", str(file), "--to", "crazyflie", "-o", str(out)]
    assert main(words) == 0
    assert capsys.readouterr().out == f"app: {out} (6 files)\n"
    files = app(load(file))
    assert {one.name: one.read_bytes() for one in out.iterdir()} == files
    assert b"SPDX-License-Identifier: MIT" in files["Makefile"] + files["rotorgram_controller.c"]
    assert main(words) == 1
    assert "out: expected a new folder" in capsys.readouterr().err
    words = ["export", "universal", "--to", "crazyflie", "-o", str(tmp_path / "any")]
    assert main(words) == 1
    assert "expected one craft (--vehicle), got drawn" in capsys.readouterr().err
    assert main([*words, "--vehicle", "hummingbird"]) == 0
    assert not main([*words[:3], "c", "-o", str(tmp_path / "any.h"), "--vehicle", "heavy_hexa"])
    assert b"rotorgram" in (tmp_path / "any.h").read_bytes()
    words = ["export", str(file), "--to", "crazyflie", "--vehicle", "hummingbird"]
    assert main(words) == 1
    sentence = "vehicle: expected a policy of the level wrench, whose actions mean the same to"
    assert sentence in capsys.readouterr().err


def test_the_header_has_the_numbers_of_the_rotors() -> None:
    header = app(checkpoint_of())["rotorgram_policy.h"].decode()
    each = ", ".join(["0.0662175f"] * 4)
    for line in (
        "#define ROTORGRAM_ROTORS 4\n",
        f"#define ROTORGRAM_HOVER {{{each}}} /* N */\n",
        "#define ROTORGRAM_LEAST {0.0f, 0.0f, 0.0f, 0.0f} /* N */\n",
        "#define ROTORGRAM_LARGEST {0.15916628f, ",
        f"#define ROTORGRAM_INITIAL {{{each}}} /* N: ",
        "#define ROTORGRAM_POSITIONS {0.03252691f, -0.03252691f, 0.0f, -0.03252691f, ",
        "#define ROTORGRAM_TURNS {1, -1, 1, -1} ",
        "#define ROTORGRAM_LAGS {0.072f, 0.072f} ",
        "#define ROTORGRAM_GOAL {0, 1, 2} /* elements of the observation: goal - position x, ",
    ):
        assert line in header
    without = app(checkpoint_of(effects={}))["rotorgram_policy.h"].decode()
    assert "#define ROTORGRAM_LAGS {0.0f, 0.0f} " in without


def test_the_first_thrust_carries_the_payload() -> None:
    from rotorgram.agents.export import rotors_of

    env = EnvConfig.from_keywords(
        "rotorgram/PayloadHover-v0", vehicle="crazyflie2", payload_share=0.2
    )
    np.testing.assert_allclose(rotors_of(env)["initial"], [1.2 * HOVER] * 4, rtol=1e-6)


def test_the_page_shows_what_the_study_wrote() -> None:
    page = (ROOT / "docs" / "firmware.md").read_text(encoding="utf-8")
    content = json.loads((ROOT / "docs" / "results" / "firmware.json").read_text())
    for seed, flight in content["seeds"].items():
        error = f"{1000 * flight['firmware, m']:.1f} mm"
        (row,) = [line for line in page.splitlines() if line.startswith(f"| seed {seed} |")]
        assert f"| {1000 * flight['simulator, m']:.1f} mm" in row
        if flight["firmware, crashed"]:
            assert f"| {flight['firmware, crashed']:.0f} crashed |" in row
        else:
            assert f"| {error} | {flight['firmware, s to 0.1 m']:.2f} s |" in row
    for name, size in content["sizes"].items():
        if name != "controller, bytes":
            assert f"| {size:,.0f}" in page, name

"""The Crazyflie's firmware: an app whose out-of-tree controller is the policy.

The folder `crazyflie_app` has the files that are the same for every policy.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ...envs.config import EnvConfig
from ...envs.spec import EnvSpec, component_names
from ...envs.specification import make_task
from ...models.errors import InputError, shortened
from ...models.files import read_own_toml
from ...models.library import is_pool
from ..checkpoints import Checkpoint
from . import c, finite_policy, metadata

_FILES = ("Makefile", "Kbuild", "oot-config", "rotorgram_controller.c")
_FOLDER = Path(__file__).with_name("crazyflie_app")
_NAMES = read_own_toml(str(_FOLDER / "names"), "names")
_CALLS = 1000
"""Of the controller, per second."""
MOTORS = ((1, -1), (-1, -1), (-1, 1), (1, 1))
"""Signs of x and y of the motors M1 to M4, which turn anticlockwise and clockwise in turn."""
_REFUSED = ("thrust_curve", "battery", "efficiency")
"""Effects with which a command is no thrust in newtons; the firmware's is one."""


def app(checkpoint: Checkpoint) -> dict[str, bytes]:
    """The files of the app, by name.

    Raises `InputError`, which names what the firmware cannot know or do.
    """
    env = checkpoint.env
    if env is None or len(env.vehicle) > 1:
        raise InputError(
            "export: expected a policy that was trained on one vehicle of this machine"
        )
    if is_pool(env.vehicle[0]):
        raise InputError(f"vehicle: expected one craft (--vehicle), got {env.vehicle[0]}")
    _check_env(env)
    policy = finite_policy(checkpoint)
    facts = metadata(checkpoint)
    files = {name: (_FOLDER / name).read_bytes() for name in _FILES}
    files["rotorgram_policy.h"] = c.write(policy, facts)
    lines = _firmware_macros(env, policy.spec, json.loads(facts["rotors"]))
    files["rotorgram_crazyflie.h"] = ("\n".join(lines) + "\n").encode()
    return files


def _check_env(env: EnvConfig) -> None:
    if env.action not in ("rotors", "wrench"):
        raise InputError(
            f"action: expected rotors or wrench for the firmware's motors, got {env.action}"
        )
    refused = [name for name in _REFUSED if getattr(env.effects, name)]
    if refused:
        raise InputError(
            "effects: expected those with which a command is a thrust, as the firmware's, "
            f"got {', '.join(refused)}"
        )


def _firmware_macros(
    env: EnvConfig, spec: EnvSpec, rotors: dict[str, list[float]]
) -> Iterator[str]:
    """Lines of the header that the controller's C includes beside the policy's."""
    calls = _calls("control_period", spec.control_period)
    vehicle = env.load_vehicle()
    mixes = env.action == "wrench"
    often = mixes and not env.estimated
    driven = vehicle.timestep if often else spec.control_period  # between two commands, s
    frames = _NAMES["frames"]
    frame = spec.observation[0].frame
    if frame not in frames:
        raise InputError(
            f"observation: expected the frame {' or '.join(frames)}, got {shortened(frame)}"
        )
    bounds = [array.bounds() for array in spec.observation]
    lowest, highest = (np.concatenate(ends, axis=None) for ends in zip(*bounds, strict=True))
    lags = np.array(rotors["lags"])
    lacking = np.exp(-driven / np.where(lags > 0.0, lags, 1e-9))
    yield "/* SPDX-License-Identifier: MIT */"
    yield f"#define ROTORGRAM_CALLS {calls} /* of the controller, between two actions */"
    driven_calls = _calls("timestep", driven)
    yield f"#define ROTORGRAM_DRIVEN {driven_calls} /* of it, between two commands of the rotors */"
    yield f"#define ROTORGRAM_BODY {frames[frame]} /* whether vectors are in the body frame */"
    yield c.macro("motors", _rotor_of_motors(rotors), "rotor of M1 to M4")
    yield c.macro("lacking", lacking, "of a change of speed between these, rising and falling")
    yield c.macro("lowest", lowest, "of the observation")
    yield c.macro("highest", highest, "of the observation")
    yield "#define ROTORGRAM_SOURCES {" + ", ".join(_sources(spec)) + "}"
    if mixes:
        yield from _mixing_macros(make_task(env.resolve(), (1, 1)).controller, vehicle.gravity)


def _calls(name: str, seconds: float) -> int:
    """So many calls of the controller take this long."""
    calls = seconds * _CALLS
    if abs(calls - round(calls)) > 1e-6:
        raise InputError(
            f"{name}: expected a whole number of milliseconds, as the firmware counts them, "
            f"got {seconds:g} s"
        )
    return round(calls)


def _mixing_macros(wrench: Any, gravity: float) -> Iterator[str]:
    """Numbers of the controller of the level `wrench`."""
    plant = wrench.plant
    count = len(plant.share)
    rows = np.eye(count + 1, count, k=-1).tolist()
    nothing, *each = (np.array(wrench.told(plant, row)) for row in rows)
    lift, *turns = wrench.sizes(wrench.gains)
    yield "#define ROTORGRAM_WRENCH"
    yield c.macro("told", nothing, "of the observation, without thrust")
    yield c.macro("told_more", np.subtract(each, nothing), "by a newton of each rotor")
    yield c.macro("lift", (plant.mass * gravity, plant.mass * lift), "N: of actions of 0; of 1")
    yield c.macro("torque", np.array(plant.inertia) * turns, "N m, of actions of 1")
    yield c.macro("mix", plant.mix, "of rotors, N of collective thrust per N m")
    yield c.macro("share", plant.share, "of rotors, of the collective thrust")
    yield c.macro("collective", (plant.lowest, plant.highest), "N")
    yield c.macro("lead", [plant.lead], "change of a command per wanted change of thrust")


def _sources(spec: EnvSpec) -> Iterator[str]:
    """The controller's expression for each number of the observation."""
    known = _NAMES["sources"]
    for array in spec.observation:
        for name in component_names(array):
            if name not in known:
                raise InputError(
                    "observation: expected numbers that the Crazyflie's firmware knows, "
                    f"got {shortened(name)}"
                )
            yield f"seen.{known[name]}"


def _rotor_of_motors(rotors: dict[str, list[float]]) -> list[int]:
    """The rotor that is each motor. Raises `InputError` for another kind of craft."""
    signs = np.sign(np.reshape(rotors["positions"], (-1, 3))[:, :2]).astype(int)
    places = [tuple(row) for row in signs.tolist()]
    found = [places.index(place) for place in MOTORS if place in places]
    turns = [rotors["turns"][rotor] for rotor in found]
    if len(places) != 4 or turns != [1, -1, 1, -1] or min(rotors["least"]) < 0.0:
        raise InputError(
            "vehicle: expected four rotors that turn as the Crazyflie's do, the front right one "
            f"anticlockwise, got {len(places)} of turns {turns}"
        )
    return found

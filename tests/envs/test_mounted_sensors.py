"""Sensors with rays of a vehicle's file: what the option `sensors` takes from it."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rotorgram.envs import Loop
from rotorgram.envs.config import EnvConfig
from rotorgram.models import InputError, Vehicle
from rotorgram.models.export import export_mjcf
from rotorgram.udp.spawn import spawn_simulator

HOVER = "rotorgram/Hover-v0"
FOREST = "rotorgram/Forest-v0"
CRAFT = """
name = "seer"
[body]
mass = 0.5
inertia = [0.004, 0.004, 0.007]
[rotors]
frame = "cross"
arm = 0.17
thrust = [0, 3]
reaction = 0.016
"""
DEPTH = """
[sensors.depth]
position = [0.3, 0, 0.1]
pitch = { value = -20, source = "drawing 12" }
rows = 6
columns = 8
rate = 10
delay = 0.04
growth = 0.01
"""
OF_DEPTH = {
    "model": "d435",
    "position": [0.3, 0.0, 0.1],
    "pitch": -20.0,
    "rows": 6,
    "columns": 8,
    "rate": 10.0,
    "delay": 0.04,
    "growth": 0.01,
}
LIDAR = '[sensors.lidar]\nmodel = "os0"\nrows = 4\nyaw = 90\n'
RANGER = '[sensors.tof]\nmodel = "multiranger"\nposition = [0, 0, 0.02]\n'


def craft(folder: Path, more: str = "", name: str = "seer.toml") -> str:
    file = folder / name
    file.write_text(CRAFT + more, encoding="utf-8")
    return str(file)


def config(vehicle: str, sensors: Any, env_id: str = HOVER, **options: Any) -> EnvConfig:
    options = {"backend": "rigid", "compiled": False, **options}
    return EnvConfig.from_keywords(env_id, vehicle=vehicle, sensors=sensors, **options)


def flown(chosen: EnvConfig, steps: int = 12) -> bytes:
    """All observations of a flight of two worlds."""
    loop = Loop(chosen, 2)
    actions = np.zeros((2, 4), np.float32)
    loop.advance(actions, np.ones(2, bool), [3, 4])
    seen = []
    for _ in range(steps):
        seen += [array.tobytes() for array in loop.observations.values()]
        loop.advance(actions, None, None)
    return b"".join(seen)


def test_a_bare_option_has_the_settings_of_the_file(tmp_path: Path) -> None:
    mounted = config(craft(tmp_path, DEPTH), {"depth": True}, scene="forest:3")
    bare = craft(tmp_path, name="bare.toml")
    by_option = config(bare, {"depth": OF_DEPTH}, scene="forest:3")
    assert mounted.resolve().sensors == by_option.resolve().sensors == {"depth": OF_DEPTH}
    assert flown(mounted) == flown(by_option)
    assert flown(mounted) != flown(config(bare, {"depth": {"rows": 6, "columns": 8}}))


def test_the_option_wins(tmp_path: Path) -> None:
    vehicle = craft(tmp_path, DEPTH)
    resolved = config(vehicle, {"depth": {"pitch": 5, "rate": 50}}).resolve()
    assert resolved.sensors == {"depth": {**OF_DEPTH, "pitch": 5.0, "rate": 50.0}}


def test_a_sensor_that_is_not_chosen_is_not_carried(tmp_path: Path) -> None:
    vehicle = craft(tmp_path, DEPTH + LIDAR)
    assert config(vehicle, {}).resolve().sensors == {}
    resolved = config(vehicle, {"lidar": True}).resolve()
    assert resolved.sensors == {
        "lidar": {"model": "os0", "position": [0.0, 0.0, 0.0], "rows": 4, "yaw": 90.0}
    }


def test_another_model_takes_nothing_of_the_file(tmp_path: Path) -> None:
    vehicle = craft(tmp_path, LIDAR)
    named = {"lidar": {"model": "rplidar_a1"}}
    assert config(vehicle, named).resolve().sensors == named
    same = config(vehicle, {"lidar": {"model": "os0"}}).resolve()
    assert same.sensors["lidar"]["yaw"] == 90.0


def test_a_resolved_config_is_whole(tmp_path: Path) -> None:
    """Spec, journals and checkpoints have what is flown, also where the file is not."""
    vehicle = craft(tmp_path, DEPTH)
    resolved = config(vehicle, {"depth": True}).resolve()
    assert resolved.resolve() == resolved
    assert resolved.digest == config(vehicle, {"depth": True}).digest
    other = config(vehicle, {"depth": {"pitch": 0}})
    assert other.digest != resolved.digest
    spec = Loop(resolved, 1).spec
    again = EnvConfig.from_keywords(spec.env_id, **spec.options)
    assert again.sensors == {"depth": OF_DEPTH}
    content = resolved.to_dict()
    Path(vehicle).unlink()
    assert EnvConfig.from_dict(content).resolve().sensors == {"depth": OF_DEPTH}
    assert resolved.changed(episode_length=7).sensors == {"depth": OF_DEPTH}


def test_a_tasks_own_camera_keeps_its_shape_and_gets_the_mount(tmp_path: Path) -> None:
    vehicle = craft(tmp_path, DEPTH.replace("rate = 10", "rate = 20").replace("0.04", "0.05"))
    forest = config(vehicle, None, "rotorgram/Forest-v0").resolve()
    depth = forest.sensors["depth"]
    assert (depth["rows"], depth["columns"], depth["fov"]) == (6, 32, 120.0)
    assert (depth["pitch"], depth["position"]) == (-20.0, [0.3, 0.0, 0.1])
    taken = config(vehicle, {"depth": True}, "rotorgram/Forest-v0").resolve()
    assert taken.sensors["depth"]["columns"] == 8
    warehouse = config(craft(tmp_path, RANGER), None, "rotorgram/Warehouse-v0").resolve()
    assert warehouse.sensors == {"tof": {"model": "vl53l5cx", "reach": 2.0}}


def test_mjcf_has_them_as_numerics(tmp_path: Path) -> None:
    file = tmp_path / "seer.xml"
    export_mjcf(craft(tmp_path, DEPTH + RANGER), file)
    assert 'name="rotorgram/sensors.depth.d435.pitch"' in file.read_text("utf-8")
    resolved = config(str(file), {"depth": True, "tof": True}).resolve()
    assert resolved.sensors == {
        "depth": OF_DEPTH,
        "tof": {"model": "multiranger", "position": [0.0, 0.0, 0.02]},
    }
    text = file.read_text("utf-8").replace("depth.d435.pitch", "depth.d435.pich")
    file.write_text(text, encoding="utf-8")
    with pytest.raises(
        InputError,
        match=r"^vehicle: expected some of sensors.depth.d435.rows, .*, got '.*pich'$",
    ):
        Vehicle.load(file)


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (
            "[sensors.depth]\nreach = -1\n",
            r"seer.toml: sensors.depth.d435.reach: expected a number from 0.001 to 1000 m, got -1",
        ),
        (
            '[sensors.lidar]\nmodel = "os9"\n',
            r"seer.toml: sensors.lidar.model: expected 'mid360' or .*'rplidar_a1', got 'os9'",
        ),
        (
            "[sensors.lidar]\nfov = 80\n",
            r"seer.toml: sensors.lidar.mid360: expected some of rows, .*, got 'fov'",
        ),
        (
            RANGER + "rows = 2\n",
            r"seer.toml: sensors.tof.multiranger: expected some of near, .*, got 'rows'",
        ),
        ("[sensors]\ntof = 3\n", r"seer.toml: sensors.tof: expected a table, got 3"),
        ("[sensors.dept]\n", r"seer.toml: sensors: expected some of .*depth, .*, got 'dept'"),
        ("[sensors.tof]\npitch = nan\n", r"seer.toml: sensors.tof.vl53l5cx.pitch: .*, got nan"),
    ],
)
def test_a_wrong_table_is_refused_when_it_is_loaded(
    more: str, sentence: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=f"^{sentence}"):
        Vehicle.load(craft(tmp_path, more))


@pytest.mark.parametrize(
    ("more", "sensors", "sentence"),
    [
        (
            "[sensors.depth]\nnear = 5\nreach = 4\n",
            {"depth": True},
            r"seer.toml: sensors.depth.reach: expected more than near = 5 m, got 4",
        ),
        (
            "[sensors.lidar]\nrate = 50\n",
            {"lidar": True},
            r"seer.toml: sensors.lidar.rate: expected at most 10 Hz of a mid360, got 50 Hz",
        ),
        (
            RANGER,
            {"tof": {"rows": 4}},
            r"sensors.tof: expected some of model, near, .*, got 'rows'",
        ),
    ],
)
def test_what_does_not_go_together_is_refused_when_it_is_flown(
    more: str, sensors: dict[str, Any], sentence: str, tmp_path: Path
) -> None:
    chosen = config(craft(tmp_path, more), sensors)
    with pytest.raises(InputError, match=f"^{sentence}"):
        chosen.resolve()


def test_several_vehicles_have_no_sensors(tmp_path: Path) -> None:
    one = craft(tmp_path, DEPTH)
    other = craft(tmp_path, LIDAR, "other.toml")
    pair = config(f"{one},{other}", {"depth": True}, "rotorgram/Formation-v0", drones=2)
    with pytest.raises(InputError, match=r"^sensors: expected none with several vehicles, got dep"):
        pair.resolve()


@pytest.mark.parametrize(("env_id", "sensors"), [(HOVER, {"depth": True}), (FOREST, None)])
def test_a_simulator_of_our_own_has_the_settings_of_the_file(
    tmp_path: Path, env_id: str, sensors: Any
) -> None:
    file = craft(tmp_path, DEPTH.replace("0.04", "0.1"))  # whole control periods of both tasks
    mounted = config(file, sensors, env_id)
    with spawn_simulator(mounted) as env:
        depth = env.env_spec.options["sensors"]["depth"]
    assert depth["position"] == [0.3, 0.0, 0.1]
    assert depth["pitch"] == -20.0

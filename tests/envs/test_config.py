"""The config of an env: its forms, defaults, checks, files and digest."""

import json
import pickle
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from contracts import TABLES, rows_of
from rotorgram.envs import ArraySpec, EnvConfig, Loop, Outcome, Task, register
from rotorgram.envs.config import BackendConfig, SceneConfig, read_keywords, source_hash
from rotorgram.envs.tasks import Hover
from rotorgram.envs.tasks.racing import TRACKS
from rotorgram.models import QUAD_XML
from rotorgram.models.errors import InputError
from rotorgram.sim import EffectOptions, InitialState, stack
from rotorgram.udp.spawn import spawn_simulator

HOVER = "rotorgram/Hover-v0"
FULL = TABLES["config: FULL"]


class Hold(Task):
    """A task of one's own with an option that is named like a field of the config."""

    action = "offset"
    control_period = 0.05
    episode_length = 7

    def setup(self) -> None:
        self.observation = (ArraySpec(name="observation", shape=(1,)),)

    def begin(self, draw: Any) -> InitialState:
        return InitialState(position=stack((0.0, 0.0, 5.0 + 0.0 * draw.uniform(0.0, 1.0))))

    def observe(self, state: Any) -> dict[str, Any]:
        return {"observation": state.position[..., 2:]}

    def outcome(self, state: Any) -> Outcome:
        height = state.position[..., 2]
        return Outcome(reward={"height": height}, terminated=height > 9.0, metrics={})


register("config/Hold-v0", Hold)


def test_flat_keywords_reach_their_fields_and_the_task() -> None:
    config = EnvConfig.from_keywords("rotorgram/Formation-v0", **FULL)
    assert config.vehicle == ("crazyflie2", "crazyflie2")
    assert config.scene == SceneConfig(name="forest", seeds=(2, 3, 4))
    assert config.backend == BackendConfig(name="rigid", dtype="float64", compiled=False)
    assert config.effects == EffectOptions(motor_lag=True)
    assert config.cameras == ("front", "down")
    assert config.drones == 2
    assert config.action == "rates"
    assert config.history == 3
    assert config.control_period == 0.04
    assert config.episode_length == 9
    assert config.task["spacing"] == 4.0
    assert config.task["margin"] == 10.0  # a default of the task
    nested = {name: value for name, value in FULL.items() if name != "spacing"}
    assert EnvConfig.from_keywords(config.env_id, task={"spacing": 4}, **nested) == config


def test_defaults_come_from_the_task() -> None:
    config = EnvConfig(env_id="config/Hold-v0")
    assert config.action == "offset"
    assert config.control_period == 0.05
    assert config.episode_length == 7
    formation = EnvConfig(env_id="rotorgram/Formation-v0")
    assert formation.action == "velocity"
    assert formation.episode_length == 500


def test_a_default_that_is_none_of_a_config(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Hold, "defaults", {"colour": "red"})
    expected = (
        r"^config/Hold-v0: defaults: expected some of vehicle, sensors, backend, got 'colour'$"
    )
    with pytest.raises(InputError, match=expected):
        EnvConfig(env_id="config/Hold-v0")


def test_the_record_as_json_and_as_a_pickle() -> None:
    config = EnvConfig.from_keywords("rotorgram/Formation-v0", **FULL)
    content = config.to_dict()
    assert content["version"] == 1
    assert content["scene"]["name"] == "forest"
    assert content["scene"]["seeds"] == [2, 3, 4]
    assert EnvConfig.from_dict(content) == config
    assert pickle.loads(pickle.dumps(config)) == config
    with pytest.raises(InputError, match=r"^config: expected version 1, got 2$"):
        EnvConfig.from_dict(content | {"version": 2})
    with pytest.raises(InputError, match=r"^config: expected some of env_id, .*, got 'colour'$"):
        EnvConfig.from_dict(content | {"colour": "red"})


def test_flat_options_make_the_same_env() -> None:
    config = EnvConfig.from_keywords("rotorgram/Formation-v0", **FULL)
    again = EnvConfig.from_keywords(
        config.env_id, vehicle="crazyflie2,crazyflie2", drones=2, backend=config.backend,
        **config.flat_options(),
    )  # fmt: skip
    assert again == config


def test_the_keywords_of_a_file(tmp_path: Path) -> None:
    (tmp_path / "own.xml").write_text("<mujoco/>")
    file = tmp_path / "drone.toml"
    file.write_text(
        f'env_id = "{HOVER}"\nvehicle = "own.xml"\nstart_tilt = 5\nhistory = 2\n'
        '[backend]\nname = "rigid"\n[effects]\ngusts = 2\n'
    )
    config = EnvConfig.from_keywords(**read_keywords(file) | {"history": 4})
    assert config.vehicle == (str(tmp_path / "own.xml"),)  # beside the file
    assert config.task["start_tilt"] == 5.0
    assert config.history == 4
    assert config.backend.name == "rigid"
    assert config.effects.gusts == 2.0
    file.write_text("env_id = ")
    with pytest.raises(InputError, match=r"^config: expected a TOML file, got "):
        read_keywords(file)
    with pytest.raises(InputError, match=r"^config: cannot read .*nowhere.toml: "):
        read_keywords(tmp_path / "nowhere.toml")


@rows_of("a wrong field is one sentence", "keywords, sentence")
def test_a_wrong_field_is_one_sentence(keywords: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=f"^{sentence}$"):
        EnvConfig.from_keywords(HOVER, **keywords)


@rows_of("what does not go together is refused by name", "keywords, sentence")
def test_what_does_not_go_together_is_refused_by_name(
    keywords: dict[str, Any], sentence: str
) -> None:
    config = EnvConfig.from_keywords(HOVER, **keywords)
    with pytest.raises(InputError, match=f"^{sentence}"):
        config.resolve()


def test_the_digest_is_of_what_changes_numbers() -> None:
    config = EnvConfig(env_id=HOVER)
    same = replace(config, backend=BackendConfig(num_threads=2))
    assert config.digest == same.digest == config.resolve().digest
    others = [
        replace(config, history=2),
        replace(config, effects=EffectOptions(linear_drag=0.5)),
        replace(config, vehicle=("crazyflie2",)),
        replace(config, backend=BackendConfig(name="rigid")),
        EnvConfig(env_id=HOVER, task={"start_tilt": 3.0}),
    ]
    assert len({config.digest, *(other.digest for other in others)}) == 6


TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def craft_files(folder: Path, kind: str) -> str:
    """A vehicle's file of a kind, with all that it needs, in a new folder."""
    craft = QUAD_XML.read_text()
    folder.mkdir()
    if kind == "mjcf":
        (folder / "own.xml").write_text(craft)
    if kind == "included":
        (folder / "parts").mkdir()
        (folder / "parts" / "craft.xml").write_text(craft)
        (folder / "own.xml").write_text('<mujoco><include file="parts/craft.xml"/></mujoco>')
    if kind == "mesh":
        (folder / "hull.obj").write_text(TETRAHEDRON)
        hull = '<asset><mesh name="hull" file="../hull.obj"/></asset><worldbody>'
        (folder / "xml").mkdir()
        (folder / "xml" / "own.xml").write_text(craft.replace("<worldbody>", hull, 1))
        return str(folder / "xml" / "own.xml")
    if kind == "toml":
        (folder / "own.xml").write_text(craft)
        (folder / "vehicle.toml").write_text('[model]\nfile = "own.xml"\n')
        return str(folder / "vehicle.toml")
    return str(folder / "own.xml")


@pytest.mark.parametrize("kind", ["mjcf", "included", "mesh", "toml"])
def test_a_resolved_config_needs_no_file(kind: str, tmp_path: Path) -> None:
    vehicle = craft_files(tmp_path / "own", kind)
    config = EnvConfig(env_id=HOVER, vehicle=vehicle)
    resolved = config.resolve()
    loaded = resolved.load_vehicle()
    assert loaded.path == Path(vehicle)  # it is here, and as it was
    shutil.rmtree(tmp_path / "own")
    with pytest.raises(InputError, match=r"^vehicle: "):
        config.resolve()
    content = json.loads(json.dumps(resolved.to_dict()))
    again = EnvConfig.from_dict(content)
    assert again.resolve() == resolved
    assert again.digest == resolved.digest
    assert again.load_vehicle().hash == loaded.hash
    assert again.load_vehicle().name == loaded.name
    assert Loop(again).spec == Loop(resolved).spec


def test_a_file_that_changes_is_flown_as_it_was(tmp_path: Path) -> None:
    file = Path(craft_files(tmp_path / "own", "mjcf"))
    resolved = EnvConfig(env_id=HOVER, vehicle=str(file)).resolve()
    assert resolved.resolve() == resolved
    file.write_text(file.read_text().replace('ctrlrange="0 100"', 'ctrlrange="0 90"'))
    assert resolved.resolve() == resolved
    assert resolved.load_vehicle().thrust_high.tolist() == [100.0] * 4
    with pytest.raises(InputError, match=r"^vehicle_hash: expected [0-9a-f]{32}, got "):
        replace(resolved, files={}).resolve()


def test_the_digest_does_not_depend_on_where_files_lie(tmp_path: Path) -> None:
    here = EnvConfig(env_id=HOVER, vehicle=craft_files(tmp_path / "here", "mjcf"))
    there = EnvConfig(env_id=HOVER, vehicle=craft_files(tmp_path / "there", "mjcf"))
    assert here.digest == there.digest


def test_a_config_of_the_library_holds_no_files() -> None:
    config = EnvConfig.from_keywords("rotorgram/Formation-v0", vehicle="paper,crazyflie2", drones=2)
    assert config.resolve().files == {}


@pytest.mark.parametrize(
    "pair", [["../up.xml", ""], ["/etc/x.xml", ""], ["C:x.xml", ""], ["a.xml", "?"], ["a.xml"], 3]
)
def test_files_of_a_config_stay_in_their_folder(pair: Any) -> None:
    content = EnvConfig(env_id=HOVER).to_dict() | {"files": {"a.xml": [pair]}}
    with pytest.raises(InputError, match=r"^files: expected relative paths and contents in base64"):
        EnvConfig.from_dict(content)


def test_a_track_is_embedded(tmp_path: Path) -> None:
    file = tmp_path / "track.toml"
    file.write_text((TRACKS / "oval.toml").read_text())
    config = EnvConfig.from_keywords("rotorgram/Racing-v0", track=str(file))
    assert config == EnvConfig(env_id="rotorgram/Racing-v0")  # with the gates of the oval


def test_a_child_gets_the_vehicle_and_hello_the_digest(tmp_path: Path) -> None:
    vehicle = craft_files(tmp_path / "own", "mjcf")
    resolved = EnvConfig(env_id=HOVER, vehicle=vehicle).resolve()
    shutil.rmtree(tmp_path / "own")
    with spawn_simulator(resolved) as env:
        assert env.env_spec.vehicle_hash == resolved.vehicle_hash
        assert env.env_spec.config_digest == resolved.digest


def test_seeds_that_do_not_follow_each_other_are_refused() -> None:
    with pytest.raises(InputError, match=r"^scene: expected consecutive seeds, got \(1, 5\)$"):
        SceneConfig(name="forest", seeds=(1, 5))


def test_the_source_of_an_own_task_belongs_to_the_digest() -> None:
    assert source_hash(Hover) == ""
    assert len(source_hash(Hold)) == 32
    assert EnvConfig(env_id="config/Hold-v0").resolve().task_hash == source_hash(Hold)


def test_a_task_may_add_to_a_config_and_its_users_may_not_contradict_it() -> None:
    loop = Loop(EnvConfig(env_id="rotorgram/PayloadHover-v0"))
    assert loop.task.config.effects.payload == pytest.approx(2.0)  # a tenth of 20 kg
    assert loop.config.effects.payload == 0.0
    with pytest.raises(InputError, match=r"^effects: expected a payload that the options of"):
        Loop(EnvConfig.from_keywords("rotorgram/PayloadHover-v0", effects={"payload": 1.0}))


@pytest.mark.parametrize(
    ("changes", "name"),
    [({"effects": EffectOptions()}, "effects"), ({"history": 1}, "history"),
     ({"sensors": {}}, "sensors"), ({"scene": SceneConfig()}, "scene")],
)  # fmt: skip
def test_a_task_that_drops_a_setting_is_refused(changes: dict[str, Any], name: str) -> None:
    class Dropping(Hold):
        """Drops what it is given."""

        def adjust(self, config: EnvConfig) -> EnvConfig:
            return replace(config, **changes)

    register("config/Dropping-v0", Dropping)
    config = EnvConfig.from_keywords(
        "config/Dropping-v0",
        effects={"gusts": 1},
        history=2,
        sensors={"imu": True},
        scene="airport",
    )
    with pytest.raises(InputError, match=rf"^config/.*: expected adjust\(\) to keep {name}, got "):
        Loop(config)


def test_setup_runs_once_in_a_loop() -> None:
    class Counted(Hold):
        """Counts its setups."""

        count = 0

        def setup(self) -> None:
            super().setup()
            Counted.count += 1

    register("config/Counted-v0", Counted)
    Loop(EnvConfig(env_id="config/Counted-v0"), 3)
    assert Counted.count == 1


def test_an_unknown_keyword_is_a_type_error_too() -> None:
    """As TorchRL expects, which tries frameskip."""
    for make in (gym.make, lambda env_id, **rest: gym.make_vec(env_id, num_envs=2, **rest)):
        with pytest.raises(TypeError, match="unexpected keyword argument 'frameskip'"):
            make(HOVER, frameskip=4)


def test_the_dozen_names_are_lazy() -> None:
    code = (
        "import sys, rotorgram\n"
        "assert not {'numpy', 'gymnasium', 'rotorgram.envs'} & set(sys.modules)\n"
        "assert rotorgram.make('rotorgram/Hover-v0').unwrapped.config.env_id\n"
        "for name in rotorgram.__all__: getattr(rotorgram, name)\n"
    )
    subprocess.run([sys.executable, "-P", "-W", "error", "-c", code], check=True)

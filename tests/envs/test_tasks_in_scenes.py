"""Landing and tracking among trees: starts and goals are clear, or the scene is refused."""

import numpy as np
import pytest
from contracts import loop_of
from rotorgram.envs.config import BackendConfig, EnvConfig
from rotorgram.models import InputError
from rotorgram.scenes import Solids

from flights import task_of

TASKS = ["rotorgram/Landing-v0", "rotorgram/Tracking-v0"]


@pytest.mark.parametrize("env_id", TASKS)
def test_starts_and_goals_are_clear_of_trees(env_id: str) -> None:
    loop = loop_of(env_id, 6, backend="rigid", scene="forest:new,density=0.2,size=40x40")
    loop.advance(np.zeros((6, 4)), np.ones(6, bool), list(range(6)))
    radius = loop.spec.constants["radius"]
    for world, seed in enumerate(loop.world.scenery.seeds.tolist()):
        solids = Solids.of_layout(loop.config.scene, seed)
        assert len(solids) > 320
        for name in ("position", "goal"):
            assert solids.distance(loop.telemetry[name][world]) > radius
    loop.close()


@pytest.mark.parametrize("env_id", TASKS)
def test_a_scene_without_room_is_refused(env_id: str) -> None:
    with pytest.raises(InputError, match=f"scene: expected one that leaves .* to {env_id}, got"):
        task_of(env_id, scene="forest:new,density=0.2,size=40x40,clear=ends")
    with pytest.raises(InputError, match="got aisles, which leaves 0"):
        task_of(env_id, scene="aisles")


def test_a_wide_path_needs_a_wide_scene() -> None:
    with pytest.raises(InputError, match=r"leaves .* got gates:new, which leaves 8"):
        task_of("rotorgram/Tracking-v0", scene="gates:new", radius=9.0)
    task_of("rotorgram/Tracking-v0", radius=9.0)


def test_a_scene_without_options_has_those_of_the_task() -> None:
    of_task = {
        "Forest": ({"density": 0.2}, "forest:3", "forest:3,size=34x16,clear=ends,density=0.2"),
        "Gates": ({"opening": 1.2}, "gates:0-3", "gates:0-3,size=12x12"),
        "Hover": ({}, "forest:3", "forest:3"),
    }
    for name, (options, given, expected) in of_task.items():
        config = EnvConfig.from_keywords(f"rotorgram/{name}-v0", scene=given, **options)
        assert str(config.scene) == expected
        assert EnvConfig.from_keywords(**config.keywords()) == config


@pytest.mark.parametrize("name", ["Forest", "Warehouse", "Dodge"])
def test_some_tasks_fly_on_rigid_unless_told_otherwise(name: str) -> None:
    env_id = f"rotorgram/{name}-v0"
    config = EnvConfig(env_id=env_id)
    assert config.backend == BackendConfig(name="rigid")
    assert "backend" not in config.keywords()
    in_double = EnvConfig.from_keywords(env_id, dtype="float64")
    assert in_double.backend == BackendConfig(name="rigid", dtype="float64")
    other = EnvConfig.from_keywords(env_id, backend="mujoco")
    assert other.backend == BackendConfig(name="mujoco")
    for made in (config, in_double, other, other.unseen(), other.changed(episode_length=9)):
        assert EnvConfig.from_keywords(**made.keywords()) == made
        assert EnvConfig.from_dict(made.to_dict()) == made
    assert config.changed(backend="mujoco") == other
    assert other.changed(backend="rigid") == config
    with pytest.raises(InputError, match="num_threads: expected none with the backend rigid"):
        EnvConfig.from_keywords(env_id, num_threads=2).resolve()


@pytest.mark.parametrize(
    ("task", "scene"),
    [("Forest", "forest:3,density=0.05"), ("Forest", "forest:new,size=40x20"),
     ("Gates", "gates:new,size=16x16")],
)  # fmt: skip
def test_a_scene_that_contradicts_the_task_is_refused(task: str, scene: str) -> None:
    with pytest.raises(InputError, match=f"scene: expected .*, as the task's .*, got {scene}"):
        EnvConfig.from_keywords(f"rotorgram/{task}-v0", scene=scene)


def test_a_change_of_the_task_changes_its_scene() -> None:
    config = EnvConfig.from_keywords("rotorgram/Forest-v0", scene="forest:3")
    other = EnvConfig.from_keywords(**config.unseen().keywords()).changed(density=0.05)
    assert str(other.scene) == "forest:3,size=34x16,clear=ends,density=0.05"
    whole = {"scene": str(config.scene)}
    assert EnvConfig.from_keywords("rotorgram/Forest-v0", **whole) == config

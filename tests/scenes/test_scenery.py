"""Warehouse, forest and gates: drawn from a seed, seen and never touched."""

import re
from collections.abc import Callable
from contextlib import closing

import mujoco
import numpy as np
import pytest
from pictures import HEIGHT, WIDTH, at
from rotorgram.models import SEEDED_WORLDS, WORLDS, InputError, build_scene, parse_world
from rotorgram.models.cameras import cameras_of, chosen_views
from rotorgram.models.library import find_vehicle, vehicle_names
from rotorgram.models.scenery import SCENERIES, attach_forest, attach_gates, attach_warehouse
from rotorgram.models.vehicle import Vehicle
from rotorgram.rendering import Canvas, Stage
from rotorgram.rendering.cameras import Cameras

ATTACH = {"warehouse": attach_warehouse, "forest": attach_forest, "gates": attach_gates}
worlds = pytest.mark.parametrize("world", SEEDED_WORLDS)


def test_every_world_of_a_seed_has_its_maker() -> None:
    assert tuple(sorted(SCENERIES)) == tuple(sorted(SEEDED_WORLDS))


def ours(model: mujoco.MjModel, world: str) -> list[str]:
    names = [model.geom(i).name for i in range(model.ngeom)]
    return [name for name in names if name.startswith(f"{world}/")]


@worlds
def test_a_seed_is_one_scenery(world: str) -> None:
    first, again, other = (build_scene(world=f"{world}:{seed}").to_xml() for seed in (3, 3, 4))
    assert first == again
    for tag in ("texture", "light", "geom"):
        pattern = rf'<{tag} [^>]*name="{world}/[^>]*>'
        drawn, others = (set(re.findall(pattern, xml)) for xml in (first, other))
        assert drawn
        assert drawn != others, tag


@worlds
def test_names_say_world_object_and_part(world: str) -> None:
    model = build_scene(world=world).compile()
    names = ours(model, world)
    assert 100 < len(names) <= 600  # drawn in software too
    assert len(set(names)) == len(names)
    assert all(re.fullmatch(rf"{world}/[a-z]+(_[a-z0-9]+)?/[a-z]+(_[a-z0-9]+)?", n) for n in names)


@worlds
@pytest.mark.parametrize("seed", range(5))
def test_the_flying_room_is_free(world: str, seed: int) -> None:
    model = build_scene(world=f"{world}:{seed}").compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for name in ours(model, world):
        geom = model.geom(name).id
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE or "/gate_" in name:
            continue
        rotation = data.geom_xmat[geom].reshape(3, 3)
        centre = data.geom_xpos[geom] + rotation @ model.geom_aabb[geom, :3]
        half = abs(rotation) @ model.geom_aabb[geom, 3:]
        low, high = centre - half, centre + half
        inside = (low[:2] < 8.0).all() and (high[:2] > -8.0).all() and low[2] < 20.0
        assert not inside, name


@pytest.mark.parametrize("seed", range(5))
def test_the_craft_of_the_paper_fits_through_every_gate(seed: int) -> None:
    model = build_scene(world=f"gates:{seed}").compile()
    frames = [model.geom(n) for n in ours(model, "gates") if "/frame_" in n]
    by_name = {geom.name: geom for geom in frames}
    assert len(frames) == 4 * 8
    for gate in range(8):
        left, right, top, bottom = (
            by_name[f"gates/gate_{gate}/frame_{part}"]
            for part in ("left", "right", "top", "bottom")
        )
        across = np.linalg.norm(left.pos - right.pos) - left.size[1] - right.size[1]
        tall = top.pos[2] - bottom.pos[2] - top.size[2] - bottom.size[2]
        assert across == pytest.approx(5.0)
        assert tall == pytest.approx(5.0)


def fly(spec: mujoco.MjSpec) -> tuple[bytes, set[int]]:
    """Every bit of 1,000 steps of hops and landings, and the numbers of contacts met."""
    model = spec.compile()
    data, rng = mujoco.MjData(model), np.random.default_rng(1)
    states, contacts = [], set()
    for step in range(1000):
        if step % 40 == 0:
            data.ctrl[:] = rng.uniform(30.0, 68.0) + rng.uniform(-1.0, 1.0, model.nu)
        mujoco.mj_step(model, data)
        states.append(np.concatenate([data.qpos, data.qvel]))
        contacts.add(int(data.ncon))
    assert not data.warning.number.any()
    return np.array(states).tobytes(), contacts


@worlds
@pytest.mark.parametrize("visual", [True, False])
def test_motion_is_the_same_to_the_last_bit(world: str, visual: bool) -> None:
    alone, contacts = fly(build_scene())
    assert max(contacts) >= 2  # it stood on the floor
    assert fly(build_scene(world=world, visual=visual)) == (alone, contacts)


@worlds
def test_it_touches_nothing_and_is_dropped_with_what_is_visual(world: str) -> None:
    alone, model = build_scene().compile(), build_scene(world=world).compile()
    geoms = [model.geom(name).id for name in ours(model, world)]
    assert not model.geom_contype[geoms].any()
    assert not model.geom_conaffinity[geoms].any()
    assert not model.geom_bodyid[geoms].any()
    assert model.body_mass.tolist() == alone.body_mass.tolist()
    bare = build_scene(visual=False).compile()
    dropped = build_scene(world=world, visual=False).compile()
    assert (dropped.ngeom, dropped.nmat) == (bare.ngeom, bare.nmat)


@worlds
def test_every_vehicle_of_the_library_stands_in_it(world: str) -> None:
    for name in vehicle_names():
        assert ours(build_scene(find_vehicle(name), world).compile(), world)


@pytest.mark.parametrize("attach", ATTACH.values())
def test_a_wrong_seed_and_a_second_one_are_one_sentence(
    attach: Callable[[mujoco.MjSpec, int], None],
) -> None:
    spec = build_scene()
    with pytest.raises(InputError, match="seed: expected an integer of at least 0, got -1"):
        attach(spec, -1)
    attach(spec, 0)
    with pytest.raises(InputError, match="spec: expected a scene without a"):
        attach(spec, 0)


@worlds
def test_a_picture_has_many_colours(world: str, opengl: None) -> None:
    with Canvas(Stage(world), WIDTH, HEIGHT, fast=True) as canvas:
        canvas.stage.show(at(5.0))
        picture = canvas.draw("chase")
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 200
    assert 30 < picture.mean() < 225


@worlds
def test_cameras_see_its_objects(opengl: None, world: str) -> None:
    vehicle = Vehicle.load()
    views = chosen_views(["front@96x72", "front_segmentation@96x72"], cameras_of(vehicle))
    with closing(Cameras(vehicle, views, world=f"{world}:1")) as cameras:
        place, turn = np.array([[0.0, 0.0, 5.0]]), np.array([[1.0, 0.0, 0.0, 0.0]])
        due = {view.name: np.ones(1, bool) for view in views}
        cameras.take(due, np.ones(1, bool), {"position": place, "quaternion": turn})
        seen = np.unique(cameras.pictures["front_segmentation"])
        objects = [cameras.objects[i] for i in seen]
        assert sum(one.startswith(f"{world}/") for one in objects) > 4


def test_names_and_seeds() -> None:
    assert [parse_world(name) for name in WORLDS] == [(name, 0) for name in WORLDS]
    assert parse_world("forest:12") == ("forest", 12)
    for wrong in (
        "moon",
        "airport:1",
        "forest:",
        "forest:-1",
        "forest:1.5",
        "forest:9999999999",
        "",
    ):
        with pytest.raises(InputError, match=r"world: expected 'plain' or .* as 'forest:3', got"):
            parse_world(wrong)

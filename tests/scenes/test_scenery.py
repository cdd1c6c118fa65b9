"""Warehouse, forest and gates: drawn from a seed, seen and never touched."""

import re
from contextlib import closing

import mujoco
import numpy as np
import pytest
from pictures import TABLES
from rotorgram.models import QUAD_XML, InputError
from rotorgram.models.cameras import chosen_views
from rotorgram.models.library import find_vehicle, vehicle_names
from rotorgram.models.mjcf import vehicle_spec
from rotorgram.models.vehicle import Vehicle
from rotorgram.rendering.cameras import Cameras
from rotorgram.scenes import SCENES, build_scene, parse_scene, seeded_scenes

scenes = pytest.mark.parametrize("scene", seeded_scenes())
OPEN_SCENES = [name for name in seeded_scenes() if parse_scene(name).values.room]


def ours(model: mujoco.MjModel, scene: str) -> list[str]:
    names = [model.geom(i).name for i in range(model.ngeom)]
    return [name for name in names if name.startswith(f"{scene}/")]


@scenes
def test_a_seed_is_one_scene(scene: str) -> None:
    first, again, other = (build_scene(scene=f"{scene}:{seed}").to_xml() for seed in (3, 3, 4))
    assert first == again
    for tag in ("texture", "light", "geom"):
        pattern = rf'<{tag} [^>]*name="{scene}/[^>]*>'
        drawn, others = (set(re.findall(pattern, xml)) for xml in (first, other))
        assert drawn
        assert drawn != others, tag


@scenes
def test_names_say_scene_object_and_part(scene: str) -> None:
    model = build_scene(scene=scene).compile()
    names = ours(model, scene)
    least = 100 if scene in OPEN_SCENES else 12
    assert least < len(names) <= 600  # drawn in software too
    assert len(set(names)) == len(names)
    assert all(re.fullmatch(rf"{scene}/[a-z]+(_[a-z0-9]+)?/[a-z]+(_[a-z0-9]+)?", n) for n in names)


@pytest.mark.parametrize("scene", OPEN_SCENES)
@pytest.mark.parametrize("seed", range(5))
def test_the_flying_room_is_free(scene: str, seed: int) -> None:
    model = build_scene(scene=f"{scene}:{seed}").compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for name in ours(model, scene):
        geom = model.geom(name).id
        kind = model.geom_type[geom]
        is_land = kind == mujoco.mjtGeom.mjGEOM_PLANE or kind == mujoco.mjtGeom.mjGEOM_HFIELD
        if is_land or "/gate_" in name:
            continue
        rotation = data.geom_xmat[geom].reshape(3, 3)
        centre = data.geom_xpos[geom] + rotation @ model.geom_aabb[geom, :3]
        half = abs(rotation) @ model.geom_aabb[geom, 3:]
        low = centre - half
        high = centre + half
        inside = (low[:2] < 8.0).all() and (high[:2] > -8.0).all() and low[2] < 20.0
        assert not inside, name


@pytest.mark.parametrize("seed", range(5))
def test_the_craft_of_the_paper_fits_through_every_gate(seed: int) -> None:
    model = build_scene(scene=f"gates:{seed}").compile()
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


def fly(model: mujoco.MjModel) -> tuple[bytes, set[int]]:
    """Every bit of 1,000 steps of hops and landings, and the numbers of contacts."""
    data = mujoco.MjData(model)
    rng = np.random.default_rng(1)
    states = []
    contacts = set()
    for step in range(1000):
        if step % 40 == 0:
            data.ctrl[:] = rng.uniform(30.0, 68.0) + rng.uniform(-1.0, 1.0, model.nu)
        mujoco.mj_step(model, data)
        states.append(np.concatenate([data.qpos, data.qvel, data.qacc, data.sensordata]))
        contacts.add(int(data.ncon))
    assert not data.warning.number.any()
    return np.array(states).tobytes(), contacts


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("discard", [True, False])
def test_it_is_looked_at_and_never_felt(scene: str, discard: bool) -> None:
    """The craft moves to the last bit as over bare ground; nothing is added but geoms."""
    alone = vehicle_spec(QUAD_XML).compile()
    flown, contacts = fly(alone)
    assert 0 in contacts
    assert max(contacts) >= 2  # it flew, and it stood on the floor
    spec = build_scene(scene=scene)
    spec.compiler.discardvisual = discard
    model = spec.compile()
    assert fly(model) == (flown, contacts)
    for count in ("nbody", "njnt", "nv", "nu", "nsensor", "nsite", "nmocap", "neq", "npair"):
        assert getattr(model, count) == getattr(alone, count), count
    assert (model.nmesh, model.nflex, model.nskin) == (0, 0, 0)
    assert model.nhfield == (scene == "hills")
    assert model.body_mass.tolist() == alone.body_mass.tolist()
    assert model.body_inertia.tolist() == alone.body_inertia.tolist()
    if discard:
        assert (model.ngeom, model.nmat) == (alone.ngeom, alone.nmat)
    geoms = [model.geom(name).id for name in ours(model, scene)]
    assert not model.geom_contype[geoms].any()
    assert not model.geom_conaffinity[geoms].any()
    assert not model.geom_bodyid[geoms].any()
    assert set(model.geom_group[geoms]) <= {2}
    skies = np.flatnonzero(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX)
    assert len(skies) == (0 if discard else 1)


@scenes
def test_every_vehicle_of_the_library_stands_in_it(scene: str) -> None:
    for name in vehicle_names():
        assert ours(build_scene(find_vehicle(name), scene).compile(), scene)


@scenes
def test_cameras_see_its_objects(opengl: None, scene: str) -> None:
    vehicle = Vehicle.load()
    views = chosen_views(["front@96x72", "front_segmentation@96x72"], vehicle.cameras)
    with closing(Cameras(vehicle, views, scene=f"{scene}:1")) as cameras:
        place = np.array([[0.0, 0.0, 5.0]])
        turn = np.array([[1.0, 0.0, 0.0, 0.0]])
        due = {view.name: np.ones(1, bool) for view in views}
        cameras.take(due, {"position": place, "quaternion": turn})
        seen = np.unique(cameras.pictures["front_segmentation"])
        objects = [cameras.objects[i] for i in seen]
        least = 5 if scene in OPEN_SCENES else 2
        assert sum(one.startswith(f"{scene}/") for one in objects) >= least


def test_names_and_seeds() -> None:
    assert [parse_scene(name).name for name in SCENES] == list(SCENES)
    assert parse_scene("forest:12").seeds == (12,)
    for wrong in TABLES["wrong_scenes"]:
        with pytest.raises(
            InputError,
            match=r"scene: expected 'plain' or .* as 'forest:3', .*, got",
        ):
            parse_scene(wrong)

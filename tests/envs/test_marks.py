"""What pictures show of a task: it crosses the wire in the spec, and a stage draws it."""

from typing import Any

import mujoco
import numpy as np
import pytest
from contracts import TABLES, rows_of, spec_with
from pictures import at
from rotorgram.envs.rendering import moment
from rotorgram.envs.spec import EnvSpec, Mark, SpecError
from rotorgram.rendering import Stage

TRACK = (
    '{"gates":[{"position":[4,0,5],"heading":90,"size":2}],'
    '"start":{"position":[0,0,5],"heading":0}}'
)
GATE = Mark(shape="gate", size=2.0, position=(4.0, 0.0, 5.0), heading=90.0)
CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
CYLINDER = int(mujoco.mjtGeom.mjGEOM_CYLINDER)
SPHERE = int(mujoco.mjtGeom.mjGEOM_SPHERE)


def drawn(**fields: Any) -> list[tuple[int, list[float], list[float]]]:
    """Kind, place and size of each geom that a moment adds; goals in the paper's frame."""
    stage = Stage("plain", trail=False)
    stage.show(at(5.0, **fields))
    scene = mujoco.MjvScene(stage.model, 100)
    stage.decorate(scene)
    geoms = scene.geoms[: scene.ngeom]
    return [(geom.type, geom.pos.tolist(), geom.size.tolist()) for geom in geoms]


def test_tasks_have_their_marks_and_the_wire_keeps_them() -> None:
    racing = spec_with("rotorgram/Racing-v0", track=TRACK)
    assert racing.marks == (GATE,)
    text = racing.to_json()
    assert EnvSpec.from_json(text) == racing
    waypoints = spec_with("rotorgram/Waypoints-v0", radius=0.4)
    assert waypoints.marks == (Mark(shape="ball", size=0.4, moves=True),)
    (pad,) = spec_with("rotorgram/Landing-v0").marks
    assert pad.shape == "disc"
    assert pad.size == 0.5
    assert pad.moves is True
    hover = spec_with("rotorgram/Hover-v0")
    assert "marks" not in hover.to_json()


def test_a_moment_has_the_marks_of_its_spec() -> None:
    spec = spec_with("rotorgram/Racing-v0", track=TRACK)
    telemetry = {array.name: np.zeros(array.shape) for array in spec.telemetry}
    assert moment(spec, telemetry).marks == (GATE,)


def test_a_gate_is_a_square_across_its_heading() -> None:
    """Passed along y: its corners are 1 m from (4, 0, 5) along x and z."""
    geoms = drawn(goal=None, marks=(GATE,))
    places = sorted(np.round(place, 6).tolist() for kind, place, _ in geoms)
    kinds = [kind for kind, *_ in geoms]
    assert kinds == [CAPSULE] * 4
    assert places == TABLES["marks: places of the bars of a gate"]


def test_what_moves_is_at_the_goal_in_place_of_its_disc() -> None:
    """The goal is at (2, -1, 0.3); the pad lies 0.3 m below."""
    pad = Mark(shape="disc", size=0.5, position=(0.0, 0.0, -0.3), moves=True)
    ((kind, place, size),) = drawn(goal=(2.0, -1.0, 0.3), marks=(pad,))
    assert kind == CYLINDER
    assert place == pytest.approx([2.0, -1.0, 0.01], abs=1e-6)
    assert size == pytest.approx([0.5, 0.5, 0.01], abs=1e-6)
    ball = Mark(shape="ball", size=0.3, moves=True)
    ((kind, place, _),) = drawn(goal=(2.0, -1.0, 5.0), marks=(ball,))
    assert kind == SPHERE
    assert place == pytest.approx([2.0, -1.0, 5.0])
    assert drawn(goal=None, marks=(pad,)) == []


@rows_of("wrong marks", "fields, sentence")
def test_wrong_marks(fields: dict[str, Any], sentence: str) -> None:
    with pytest.raises(SpecError) as error:
        Mark(**fields)
    assert str(error.value).startswith(sentence)

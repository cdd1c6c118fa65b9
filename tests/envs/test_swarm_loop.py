"""The loop with several drones in a world: who is out, what goes on, and what is refused."""

import numpy as np
import pytest
from contracts import everyone, loop_of, zero_actions
from rotorgram.envs.loop import Loop
from rotorgram.models import InputError
from swarms import RISE

HOVER = zero_actions(2)


def begun(worlds: int = 1, drones: int = 2, **options: int) -> Loop:
    loop = loop_of(RISE, worlds, drones=drones, **options)
    rows = worlds * drones
    loop.advance(zero_actions(rows), everyone(rows), range(rows))
    return loop


def test_a_world_tells_its_drones_by_name_and_row() -> None:
    loop = begun(2, 3)
    assert loop.spec.agents == ("drone_0", "drone_1", "drone_2")
    assert loop.num_envs == 6
    assert loop.observations["observation"].shape == (6, 3)
    rows = loop.observations["observation"][:, 0].reshape(2, 3)
    assert rows == pytest.approx(np.tile(5.0 * np.arange(3), (2, 1)), abs=0.1)
    assert len(np.unique(rows - 5.0 * np.arange(3))) == 6
    assert loop.telemetry["position"].shape == (6, 3)


def test_one_that_ends_is_out_and_the_others_fly_on() -> None:
    loop = begun()
    up = np.array([[1.0], [0.0]], np.float32)
    ends = rewards = 0
    for step in range(30):
        loop.advance(up)
        if loop.terminated[0]:
            ends = ends + 1
            out_at = step
            climb = loop.world.state.velocity[0, 0, 2]
            assert (loop.rewards[0], loop.done.any()) == (1.0, False)
            assert loop.out.tolist() == [True, False]
        rewards += loop.rewards[0]
    assert ends == 1
    assert rewards == out_at + 1  # nothing once it was out
    assert loop.truncated.tolist() == [False, True]  # the episode of the other ended by time
    assert loop.done.tolist() == [True, True]
    # Its rotors stand still: it falls, and the other stays.
    fallen = 9.8 * 0.02 * (29 - out_at)
    assert loop.world.state.velocity[0, :, 2] == pytest.approx([climb - fallen, 0.0], abs=1e-9)
    assert loop.telemetry["thrust"][0].tolist() == [0.0] * 4
    with pytest.raises(Exception, match="reset"):
        loop.advance(up)
    loop.advance(up, everyone(2))
    assert not (loop.out | loop.done).any()


def test_a_world_begins_anew_while_another_flies_on() -> None:
    loop = begun(2)
    alone = begun(2)
    up = np.array([[1.0], [1.0], [0.0], [0.0]], np.float32)
    while not loop.done.any():
        loop.advance(up)
        alone.advance(up)
    assert loop.done.tolist() == [True, True, False, False]
    loop.advance(up, loop.done, [9, 9, None, None])
    alone.advance(up, np.array([True, True, False, False]), [9, None, None, None])
    assert loop.steps.tolist() == [0, 0, alone.steps[2], alone.steps[3]]
    assert (loop.observations["observation"] == alone.observations["observation"]).all()


def test_half_a_world_cannot_be_reset_or_frozen() -> None:
    loop = begun()
    expected = "resets, frozen: expected all 2 drones of a world or none, got some of them"
    with pytest.raises(InputError, match=expected):
        loop.advance(HOVER, np.array([True, False]))
    with pytest.raises(InputError, match=expected):
        loop.advance(HOVER, None, None, np.array([False, True]))
    loop.advance(HOVER)


def test_a_task_that_is_flown_alone_refuses_more() -> None:
    expected = "drones: expected 1 with rotorgram/Hover-v0, got 2"
    with pytest.raises(InputError, match=expected):
        loop_of("rotorgram/Hover-v0", drones=2)

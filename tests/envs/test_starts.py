"""A start that touches a solid of a user's file is refused at the reset, by name."""

from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import rotorgram.envs  # noqa: F401
from rotorgram.models import InputError

ENV = "rotorgram/Hover-v0"
RACER = Path(__file__).parents[1] / "data" / "racer.xml"
WAYS = pytest.mark.parametrize("compiled", [True, False])
BACKENDS = pytest.mark.parametrize("backend", ["rigid", "mujoco"])
FAR = '{ kind = "box", size = [1, 1, 1], position = [90, 0, 1], label = "far" }'
HULL = "vertices = [[-40, -30, 0.5], [40, -30, 0.5], [0, 40, 0.5], [0, 0, 60]]"


def made(scene: Any = "plain", num_envs: int = 0, **options: Any) -> Any:
    options |= {"scene": scene, "vehicle": str(RACER)}
    if num_envs:
        return gym.make_vec(ENV, num_envs=num_envs, **options)
    return gym.make(ENV, **options)


def start_of(seed: int) -> list[float]:
    """Where the episode of a seed begins, without obstacles."""
    with closing(made(num_envs=1)) as envs:
        envs.reset(seed=seed)
        place: list[float] = envs.unwrapped.loop.record.state.position[0, 0].tolist()
    return place


def yard(folder: Path, *obstacles: str) -> str:
    """Path of a file of obstacles; the last is a ball about the start of seed 5."""
    ball = f'{{ kind = "sphere", size = [0.05], position = {start_of(5)}, label = "ball" }}'
    path = folder / "yard.toml"
    path.write_text(f"obstacle = [{', '.join((*obstacles, ball))}]\n")
    return str(path)


PLACE = r"\[(-?\d+\.\d{1,3}(, )?){3}\]"
REFUSED = (
    rf"^start: expected one that touches nothing, got {PLACE}, which touches own/ball_1/sphere:"
)


@WAYS
@BACKENDS
def test_of_drawn_starts_those_in_a_solid_are_refused(
    tmp_path: Path, backend: str, compiled: bool
) -> None:
    with closing(made(yard(tmp_path, FAR), backend=backend, compiled=compiled)) as env:
        env.reset(seed=6)
        with pytest.raises(InputError, match=REFUSED):
            env.reset(seed=5)
        action = np.zeros(env.action_space.shape, np.float32)
        with pytest.raises(gym.error.ResetNeeded):
            env.step(action)
        env.reset(seed=6)
        env.step(action)


@WAYS
@BACKENDS
def test_of_a_batch_too(tmp_path: Path, backend: str, compiled: bool) -> None:
    scene = yard(tmp_path, FAR)
    with closing(made(scene, 4, backend=backend, compiled=compiled)) as envs:
        envs.reset(seed=6)
        if compiled:
            assert envs.unwrapped.loop.refusal == ""
        with pytest.raises(InputError, match=REFUSED):
            envs.reset(seed=2)
        envs.reset(seed=6)
        envs.step(np.zeros(envs.action_space.shape, np.float32))


@WAYS
@BACKENDS
def test_who_is_not_reset_is_not_refused(tmp_path: Path, backend: str, compiled: bool) -> None:
    """Seed 5 begins in the ball: the second env, which waits while the first is reset."""
    with closing(made(yard(tmp_path, FAR), 2, backend=backend, compiled=compiled)) as envs:
        first = {"reset_mask": np.array([True, False])}
        envs.reset(seed=4, options=first)
        with pytest.raises(InputError, match=REFUSED):
            envs.reset(seed=4)
        envs.reset(seed=4, options=first)
        second = {"reset_mask": np.array([False, True])}
        with pytest.raises(InputError, match=REFUSED):
            envs.reset(seed=4, options=second)
        envs.reset(seed=5, options=second)
        envs.step(np.zeros(envs.action_space.shape, np.float32))


@WAYS
@BACKENDS
def test_of_an_episode_that_begins_by_itself(tmp_path: Path, backend: str, compiled: bool) -> None:
    """The second episodes of many seeds: one of them begins in the ball of another scene."""
    with closing(made(num_envs=2, episode_length=1)) as envs:
        envs.reset(seed=6)
        action = np.zeros(envs.action_space.shape, np.float32)
        envs.step(action)
        envs.step(action)
        place = envs.unwrapped.loop.record.state.position[1, 0].tolist()
    path = tmp_path / "second.toml"
    path.write_text(f"obstacle = [{{ kind = 'sphere', size = [0.05], position = {place} }}]\n")
    options = {"backend": backend, "compiled": compiled, "episode_length": 1}
    with closing(made(str(path), 2, **options)) as envs:
        envs.reset(seed=6)
        _, _, _, truncated, _ = envs.step(action)
        assert truncated.all()
        with pytest.raises(InputError, match=r"which touches own/sphere_0/sphere: "):
            envs.step(action)


@WAYS
def test_a_start_in_the_hull_of_a_mesh_about_it(tmp_path: Path, compiled: bool) -> None:
    path = tmp_path / "hall.toml"
    path.write_text(f"obstacle = [{FAR}, {{ kind = 'hull', {HULL}, label = 'hall' }}]\n")
    words = r"^start: .*, which touches own/hall_1/hull: "
    env = made(str(path), compiled=compiled)
    with closing(env), pytest.raises(InputError, match=words):
        env.reset(seed=1)


@BACKENDS
def test_a_start_in_an_obstacle_of_the_vehicle_s_file(tmp_path: Path, backend: str) -> None:
    x, y, z = start_of(5)
    post = f'<geom name="post" type="sphere" size="0.1" pos="{x} {y} {z}"/></worldbody>'
    file = tmp_path / "own.xml"
    file.write_text(RACER.read_text().replace("</worldbody>", post, 1))
    with closing(gym.make(ENV, vehicle=str(file), backend=backend)) as env:
        env.reset(seed=6)
        with pytest.raises(InputError, match=r"^start: .*, which touches post: move one of them$"):
            env.reset(seed=5)


@BACKENDS
def test_what_touches_nothing_has_the_bits_of_before(tmp_path: Path, backend: str) -> None:
    far = tmp_path / "far.toml"
    far.write_text(f"obstacle = [{FAR}]\n")
    with closing(made(backend=backend)) as bare, closing(made(str(far), backend=backend)) as env:
        assert bare.reset(seed=2)[0].tobytes() == env.reset(seed=2)[0].tobytes()
        for _ in range(30):
            action = np.zeros(env.action_space.shape, np.float32)
            ours, theirs = bare.step(action), env.step(action)
            assert ours[0].tobytes() == theirs[0].tobytes()
            assert ours[1:4] == theirs[1:4]

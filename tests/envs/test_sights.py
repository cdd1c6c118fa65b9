"""Pictures as observations of envs: local, in vectors, over UDP; the flight stays as it is."""

import os
import socket
import subprocess
import sys
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from contracts import everyone, rows_of, spec_with, zero_actions
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from peers import ANY, Running
from relay import FaultConfig, relaying
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.parallel import LocalParallelEnv
from rotorgram.models import InputError
from rotorgram.models.cameras import chosen_views
from rotorgram.models.vehicle import Vehicle
from rotorgram.rendering.cameras import Cameras
from rotorgram.udp import LinkConfig, Simulator
from rotorgram.udp.remote_parallel import RemoteParallelEnv
from rotorgram.udp.spawn import spawn_simulator
from test_cameras import BELLY, vehicle_with

LANDING = "rotorgram/Landing-v0"
HOVER = "rotorgram/Hover-v0"
EYES = "down@16x12,down_depth@16x12,down_segmentation@16x12"


def test_the_checker_of_gymnasium(opengl: None) -> None:
    with closing(gym.make(LANDING, cameras=EYES)) as env:
        check_env(env.unwrapped, skip_render_check=True)
        space = env.observation_space
        assert isinstance(space, spaces.Dict)
        assert space["down"] == spaces.Box(0, 255, (12, 16, 3), np.uint8)
        assert space["down_depth"] == spaces.Box(0.0, 1000.0, (12, 16, 1), np.float32)
        assert space["down_segmentation"] == spaces.Box(0, 3, (12, 16, 1), np.int32)


def test_a_spec_tells_of_pictures() -> None:
    spec = spec_with(LANDING, cameras=[EYES])
    down, depth, objects = spec.observation[1:]
    assert objects.categories == ("nothing", "scene/floor", "drone_0", "task/disc_0 of drone_0")
    assert down.categories == ()
    assert depth.unit == "m"
    assert down.frame.endswith("m in the body, looks along (0 0 -1), 90 degrees high")
    assert spec.options["cameras"] == EYES.split(",")
    assert type(spec).from_json(spec.to_json()) == spec
    assert "cameras" not in spec_with(LANDING).options


def test_the_flight_is_that_without_cameras(opengl: None) -> None:
    more = {"history": 2, "effects": {"linear_drag": 0.1}}
    with (
        closing(gym.make(HOVER, **more)) as blind,
        closing(gym.make(HOVER, cameras="front@8x8", scene="airport", **more)) as seeing,
    ):
        first = blind.reset(seed=3)[0]
        second = seeing.reset(seed=3)[0]
        seeing.action_space.seed(4)
        for _ in range(60):
            assert first.tobytes() == second["observation"].tobytes()
            action = seeing.action_space.sample()
            first, *rest, info = blind.step(action)
            second, *others, told = seeing.step(action)
            assert rest == others
            assert info == told
            if rest[1] or rest[2]:
                break


def test_a_slow_camera_holds_its_picture(opengl: None, tmp_path: Path) -> None:
    """`belly` takes every other step: its pictures are those of the even ones."""
    vehicle = str(vehicle_with(tmp_path, BELLY).path)
    words = "belly,down_depth"
    with closing(gym.make(HOVER, vehicle=vehicle, cameras=words, action="velocity")) as env:
        seen = [env.reset(seed=1)[0]]
        seen += [env.step(np.array((1, 0, 0, 0.5), np.float32))[0] for _ in range(6)]
        for step in range(1, 7):
            same = (seen[step]["belly"] == seen[step - 1]["belly"]).all()
            assert same == (step % 2 == 1)
            assert (seen[step]["down_depth"] != seen[step - 1]["down_depth"]).any()
        again = env.reset(seed=1)[0]
        assert (again["belly"] == seen[0]["belly"]).all()


def test_drones_of_one_world_see_each_other(opengl: None) -> None:
    words = "front_segmentation@48x48"
    with closing(
        LocalParallelEnv("rotorgram/Formation-v0", drones=3, cameras=words, formation="line")
    ) as env:
        seen = env.reset(seed=2)[0]
        names = spec_with("rotorgram/Formation-v0", cameras=[words], vehicle=None, drones=3)
        objects = names.observation[1].categories
        assert {f"drone_{i}" for i in range(3)} < {*objects}
        assert env.observation_space("drone_1")["front_segmentation"].shape == (48, 48, 1)
        others = set()
        for name in env.agents:
            numbers = set(np.unique(seen[name]["front_segmentation"]).tolist())
            assert objects.index(name) not in numbers
            others |= {objects[number] for number in numbers}
        assert {f"drone_{i}" for i in range(3)} & others  # ahead of another


def test_pictures_of_the_backend_rigid(opengl: None) -> None:
    with (
        closing(LocalVectorEnv(HOVER, 2, cameras="down", backend="mujoco")) as usual,
        closing(LocalVectorEnv(HOVER, 2, cameras="down", backend="rigid")) as rigid,
    ):
        first = usual.reset(seed=5)[0]
        second = rigid.reset(seed=5)[0]
        pictures = np.asarray(second["down"])
        assert pictures.dtype == np.uint8
        assert pictures.shape == (2, 64, 64, 3)
        assert np.abs(pictures.astype(int) - first["down"]).max() <= 1
        craft = Vehicle.load()
        told = rigid.loop.world.state
        views = chosen_views(["down"], craft.cameras)
        with closing(Cameras(craft, views, (2, 1))) as cameras:
            names = "position", "quaternion"
            state = {k: np.asarray(getattr(told, k)).reshape(2, -1) for k in names}
            cameras.take({"down": everyone(2)}, state)
            assert (pictures == cameras.pictures["down"]).all()
            assert len(np.unique(pictures)) > 20


def test_each_episode_has_a_world_of_its_own(opengl: None) -> None:
    """One of those that are told, by the seed; the same alone, in a batch and over UDP."""
    options: dict[str, Any] = {
        "cameras": "front@32x24,front_segmentation@32x24", "scene": "warehouse:0-2",
        "action": "velocity", "episode_length": 2,
    }  # fmt: skip
    seeds = [3, 4, 5, 6]
    still = zero_actions(4, 4)
    with closing(LocalVectorEnv(HOVER, 4, autoreset_mode="Disabled", **options)) as env:
        assert env.env_spec.observation == spec_with(HOVER, **options).observation
        names = env.env_spec.observation[2].categories
        first = env.reset(seed=seeds)[0]
        second = env.step(still)[0]
        again = env.reset()[0]
    found = []
    for number in range(3):
        alone = options | {"scene": f"warehouse:{number}"}
        with closing(LocalVectorEnv(HOVER, 4, autoreset_mode="Disabled", **alone)) as env:
            own = env.reset(seed=seeds)[0]
            stepped = env.step(still)[0]
            objects = np.array(env.env_spec.observation[2].categories)
        same = (own["front"] == first["front"]).all(axis=(1, 2, 3))
        for row in np.flatnonzero(same):
            assert (second["front"][row] == stepped["front"][row]).all()
            told = np.array(names)[first["front_segmentation"][row]]
            assert (told == objects[own["front_segmentation"][row]]).all()
        found.append(same)
    assert np.sum(found, axis=0).tolist() == [1, 1, 1, 1]
    assert len({*np.argmax(found, axis=0)}) > 1
    assert (again["front"] != first["front"]).any(axis=(1, 2, 3)).all()  # other starts, at least
    with spawn_simulator(EnvConfig.from_keywords(HOVER, **options)) as env:
        told = env.reset(seed=5)[0]
        for name, picture in told.items():
            assert (np.asarray(picture) == first[name][2]).all()


def test_a_simulator_that_cannot_draw_says_so_before_it_greets() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as agent:
        agent.bind(("127.0.0.1", 0))
        line = ["sim", "--server", f"127.0.0.1:{agent.getsockname()[1]}", "--env", HOVER]
        done = subprocess.run(
            [sys.executable, "-m", "rotorgram.cli", *line, "--cameras", "front"],
            env={**os.environ, "MUJOCO_GL": "disable"}, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 2
        assert "OpenGL: expected EGL" in done.stderr
        agent.setblocking(False)
        with pytest.raises(BlockingIOError):
            agent.recv(9)


@rows_of("wrong options", "options, sentence")
def test_wrong_options(options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        spec_with(HOVER, **options)


def test_words_may_come_one_by_one() -> None:
    for words in ("a,b", ["a", "b"]):
        assert EnvConfig.from_keywords(HOVER, cameras=words).cameras == ("a", "b")


def test_a_simulator_without_opengl_says_so_in_a_sentence() -> None:
    words = ["evaluate", "geometric", "--env", HOVER, "--cameras", "front", "--episodes", "1"]
    done = subprocess.run(
        [sys.executable, "-m", "rotorgram.cli", *words],
        env=os.environ | {"MUJOCO_GL": "disable"},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 1
    assert "OpenGL: expected EGL (on Debian and Ubuntu: apt-get install" in done.stderr
    assert "Traceback" not in done.stderr


def test_pictures_of_a_swarm_cross_a_lossy_wire(opengl: None) -> None:
    """One State for the world, 30 % of the datagrams lost: every bit of every drone's picture."""
    words = "front_segmentation@24x16,down@8x8"
    name = "rotorgram/Formation-v0"
    local = LocalParallelEnv(name, 3, cameras=words)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(ANY)
        agent = taken.getsockname()
    with relaying(agent, FaultConfig(drop=0.3, duplicate=0.1, reorder=0.1, seed=5)) as relay:
        simulator = Simulator(
            name, server=relay.address, bind=ANY, num_envs=3, drones=3, cameras=words.split(","),
            config=LinkConfig(timeout=60),
        )  # fmt: skip
        running = Running(simulator)
        with closing(RemoteParallelEnv(agent)) as remote, closing(local):
            assert remote.observation_spaces == local.observation_spaces
            here = remote.reset(seed=4)[0]
            there = local.reset(seed=4)[0]
            dice = np.random.default_rng(6)
            for _ in range(8):
                assert here.keys() == there.keys() == {*local.agents}
                for drone, seen in there.items():
                    for part, values in seen.items():
                        assert here[drone][part].tobytes() == values.tobytes()
                shape = local.action_space("drone_0").shape
                actions = {one: dice.uniform(-1, 1, shape).astype("f4") for one in local.agents}
                here = remote.step(actions)[0]
                there = local.step(actions)[0]
        running.join()


@pytest.mark.parametrize("over_udp", [False, True], ids=["in process", "over UDP"])
def test_sb3_learns_from_pictures(opengl: None, over_udp: bool) -> None:
    sb3: Any = pytest.importorskip("stable_baselines3")
    options = {"cameras": ["down@40x40"], "action": "velocity"}
    with ExitStack() as opened:
        if over_udp:
            env = opened.enter_context(spawn_simulator(EnvConfig.from_keywords(HOVER, **options)))
        else:
            env = opened.enter_context(closing(gym.make(HOVER, **options)))
        settings = {"n_steps": 16, "batch_size": 16, "n_epochs": 1, "device": "cpu"}
        model = sb3.PPO("MultiInputPolicy", env, **settings).learn(16)
        kinds = {k: type(v).__name__ for k, v in model.policy.features_extractor.extractors.items()}
    assert kinds == {"down": "NatureCNN", "observation": "Flatten"}


def test_a_loop_as_cleanrl_has_it(opengl: None) -> None:
    """Storage by the spaces of a Gymnasium vector env; what a step gives goes in as it is."""
    envs = gym.make_vec(HOVER, num_envs=3, cameras="down@16x16,down_depth@16x16")
    space = envs.single_observation_space
    stored = {name: np.zeros((4, 3, *box.shape), box.dtype) for name, box in space.items()}
    envs.action_space.seed(1)
    seen, _ = envs.reset(seed=1)
    for step in range(4):
        for name, values in seen.items():
            assert values.dtype == stored[name].dtype
            stored[name][step] = values
        seen, *_ = envs.step(envs.action_space.sample())
    envs.close()
    assert stored["down"].any()
    assert 0 < stored["down_depth"].max() <= 1000


FORKED = """
import os
import sys
import gymnasium as gym
import rotorgram.envs

make = "rotorgram/Hover-v0"
envs = gym.make_vec(make, num_envs=2, vectorization_mode="async", cameras="down@8x8")
print(envs.reset(seed=1)[0]["down"].shape)
envs.close()
old = gym.make(make, cameras="down@8x8")
old.reset(seed=1)
if os.fork() == 0:
    for env in old, gym.make(make, cameras="down@8x8"):
        try:
            env.reset(seed=1)
        except RuntimeError as error:
            print(error, flush=True)
    os._exit(0)
os.wait()
"""


def test_processes_that_are_forked(opengl: None) -> None:
    """Gymnasium's async vector env draws; who draws before it forks is told, and does not hang."""
    done = subprocess.run(
        [sys.executable, "-c", FORKED], capture_output=True, text=True, timeout=60
    )
    shape, *sentences = done.stdout.splitlines()
    assert shape == "(2, 8, 8, 3)"
    begin = "OpenGL: expected a process that was started anew, got one that was"
    assert [one[: len(begin)] for one in sentences] == [begin] * 2, done.stderr

"""The window on a screen in memory."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

WINDOW = """
import time
import mujoco
from rotorgram.rendering import Moment, Stage
from rotorgram.rendering.live import LiveView, Pace

stage, pace = Stage("plain", 2), Pace(0.02)
live = LiveView(stage, pace)
for step in range(20):
    height = 5.0 + step / 20
    moments = [
        Moment(position=(0.0, 0.0, height), attitude=(1.0, 0.0, 0.0, 0.0), thrusts=(49.0,) * 4,
               goal=(0.0, 0.0, 5.0), step=step)
    ] * 2
    live.draw(*moments)
    time.sleep(0.05)
end = time.monotonic() + 60
for _ in range(2):  # when it takes them up again, they are drawn
    while not live.wants and time.monotonic() < end:
        time.sleep(0.05)
    live.draw(*moments)
while not live.wants and time.monotonic() < end:
    time.sleep(0.05)
assert live.is_running
surface = live._window
handle = surface._handle
assert abs(stage.data.qpos[2] - 5.95) < 1e-9, stage.data.qpos
with handle.lock():
    assert handle.cam.lookat[2] == 5.0
    discs = [g for g in handle.user_scn.geoms[:handle.user_scn.ngeom]
             if g.type == mujoco.mjtGeom.mjGEOM_CYLINDER]
    assert [round(float(g.pos[2]), 6) for g in discs] == [5.0, 5.0], discs
    assert handle.user_scn.ngeom > 2  # and pieces of paths
for key in (32, 262, 340):  # space, arrow, shift
    surface._on_key(key)
assert (pace.paused, pace.wait(0.0)) == (True, 0.0)
live.close()
assert not live.is_running
print("looked at")
"""


FORGOTTEN = """
import gymnasium as gym
import rotorgram.envs

env = gym.make("rotorgram/Elevation-v0", render_mode="human")
env.reset(seed=0)
for _ in range(5):
    env.step([0.0])
    env.render()  # as many scripts do: shown already, and not again
print("flown")
"""
PETTINGZOO = """
import swarms
from pettingzoo.test.render_test import render_test
from pettingzoo.utils import aec_to_parallel, parallel_to_aec
from rotorgram.envs.parallel import LocalParallelEnv

made = []
def env(render_mode):
    made.append(parallel_to_aec(LocalParallelEnv(swarms.RISE, 3, render_mode)))
    return made[-1]

render_test(env)
modes = [aec_to_parallel(one).render_mode for one in made]
for one in made:
    one.close()
print(*modes)
"""
needs_screen = pytest.mark.skipif(
    shutil.which("Xvfb") is None, reason="no Xvfb to open a window on"
)


@needs_screen
def test_the_window(tmp_path: Path) -> None:
    assert on_a_screen(WINDOW, tmp_path) == "looked at\n"


@needs_screen
def test_a_window_that_nobody_closes_ends_with_its_program(tmp_path: Path) -> None:
    assert on_a_screen(FORGOTTEN, tmp_path) == "flown\n"


@needs_screen
def test_pettingzoos_test_of_rendering(tmp_path: Path) -> None:
    pytest.importorskip("pettingzoo")
    script = f"import sys; sys.path.append({str(Path(__file__).parents[1])!r})\n{PETTINGZOO}"
    assert on_a_screen(script, tmp_path) == "human human rgb_array\n"


def on_a_screen(script: str, folder: Path) -> str:
    """What a script prints that has a display in memory, and ends well."""
    reading, writing = os.pipe()
    screen = ["-screen", "0", "320x240x24", "-nolisten", "tcp"]
    with subprocess.Popen(
        ["Xvfb", "-displayfd", str(writing), *screen],
        pass_fds=[writing],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as xvfb:
        os.close(writing)
        try:
            with os.fdopen(reading) as pipe:
                display = f":{pipe.readline().strip()}"
            environment = {k: v for k, v in os.environ.items() if k != "WAYLAND_DISPLAY"}
            done = subprocess.run(
                [sys.executable, "-c", script],
                env=environment | {"DISPLAY": display},
                cwd=folder,
                capture_output=True,
                text=True,
                timeout=100,
            )
        finally:
            xvfb.terminate()
    if "window: expected a display" in done.stderr:
        pytest.skip("Xvfb has no OpenGL (on Debian and Ubuntu: libgl1-mesa-dri)")
    assert done.returncode == 0, done.stderr
    return done.stdout

"""The window on a screen in memory, and the page without a browser."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

WINDOW = """
import os, sys, threading, time
import mujoco
from rotorgram.rendering import Moment, Stage
from rotorgram.rendering.live import LiveView, Pace, open_surface

niceness = os.getpriority(os.PRIO_PROCESS, 0)
stage, pace = Stage("plain", 2), Pace(0.02)
surface = open_surface("window", stage, pace)
live = LiveView(stage, surface, pace)
for step in range(20):
    height = 5.0 + step / 20
    live.draw(*[
        Moment(position=(0.0, height, 0.0), attitude=(0.0, 0.0, 0.0), thrusts=(49.0,) * 4,
               goal=(0.0, 5.0, 0.0), step=step)
    ] * 2)
    time.sleep(0.05)
end = time.monotonic() + 60
while not live.wants and time.monotonic() < end:
    time.sleep(0.05)
assert live.is_running and live.surface.is_watched()
handle = surface._handle
assert abs(stage.data.qpos[2] - 5.95) < 1e-9, stage.data.qpos
assert handle.cam.lookat[2] == 5.0
discs = [g for g in handle.user_scn.geoms[:handle.user_scn.ngeom]
         if g.type == mujoco.mjtGeom.mjGEOM_CYLINDER]
assert [round(float(g.pos[2]), 6) for g in discs] == [5.0, 5.0], discs
assert handle.user_scn.ngeom > 2  # and pieces of paths
for key in (32, 262, 61, 340):  # space, arrow, +, shift
    surface._press(key)
pace.wait(0.0)
assert (pace.paused, pace.speed) == (True, 2.0)
if sys.platform == "linux":  # whoever flies comes first
    assert os.getpriority(os.PRIO_PROCESS, threading.main_thread().native_id) == niceness
    for thread in surface._threads:
        assert os.getpriority(os.PRIO_PROCESS, thread.native_id) == 10
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
    if "NoDisplay" in done.stderr:
        pytest.skip("Xvfb has no OpenGL (on Debian and Ubuntu: libgl1-mesa-dri)")
    assert done.returncode == 0, done.stderr
    return done.stdout


PAGE = """
import socket
import time
from urllib.request import urlopen
import mujoco
from rotorgram.rendering import Moment, Stage
from rotorgram.rendering import web
from rotorgram.rendering.live import LiveView, Pace, open_surface

def wait_until(condition):
    end = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)

def answers(url):
    try:
        urlopen(url, timeout=20).close()
    except OSError:  # the server is about to listen
        return False
    return True

SAME, EVIL = "http://127.0.0.1:{port}", "http://evil.example"
HERE = "Host: 127.0.0.1:{port}"
REQUESTS = [
    ("/state", [HERE], 101),  # a program that is no browser
    ("/state", [HERE, "Origin: " + SAME], 101),
    ("/ui", [HERE, "Origin: " + SAME], 101),
    ("/state", ["Host: localhost:9000", "Origin: http://localhost:9000"], 101),  # ssh -L 9000:
    ("/state", [HERE, "Origin: " + EVIL], 403),
    ("/ui", [HERE, "Origin: " + EVIL], 403),
    ("/drop", [HERE, "Origin: null"], 403),
    ("/ui", [HERE, "Origin: http://127.0.0.1:3000"], 403),  # another page of this machine
    ("/state", ["Host: evil.example:{port}", "Origin: http://evil.example:{port}"], 403),
    ("/model", ["Host: evil.example:{port}"], 403),  # its name server names this machine
    ("/model", [HERE, "Origin: " + EVIL], 403),
    ("/model", [HERE], 200),
    ("/", ["Host: evil.example"], 403),
]

def upgrade(port, path, headers):
    lines = [f"GET {path} HTTP/1.1", *(h.format(port=port) for h in headers)]
    if path in ("/state", "/ui", "/drop"):
        lines += ["Connection: Upgrade", "Upgrade: websocket", "Sec-WebSocket-Version: 13",
                  "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ=="]
    with socket.create_connection(("127.0.0.1", port), timeout=20) as connection:
        connection.sendall("\\r\\n".join([*lines, "", ""]).encode())
        return int(connection.makefile("rb").readline().split()[1])

def look(stage, pace, page, live):
    live.draw(Moment(position=(0.0, 5.0, 0.0), attitude=(0.0, 0.0, 0.0), thrusts=(49.0,) * 4,
                     goal=(0.0, 5.5, 0.0), step=3))
    url = f"http://127.0.0.1:{page.port}/"
    assert url in page.where
    wait_until(lambda: answers(url))
    assert b"<canvas" in urlopen(url, timeout=20).read()
    assert len(urlopen(url + "model", timeout=20).read()) >= mujoco.mj_sizeModel(stage.model)
    viewer = page._panel.viewer
    wait_until(lambda: page._panel._lines)
    assert ("step", "3") in page._panel._lines
    for path, headers, status in REQUESTS:
        answer = upgrade(page.port, path, headers)
        assert answer == status, (path, headers, answer)
    assert viewer.address == ("127.0.0.1", page.port)
    assert viewer.extra_geoms[0].type == mujoco.mjtGeom.mjGEOM_CYLINDER
    assert viewer.extra_geoms[0].pos.tolist() == [0.0, 0.0, 5.5]
    assert viewer.camera.lookat[2] == 5.5
    wait_until(lambda: viewer.data.qpos[2] == 5.0)
    time.sleep(0.2)  # a few frames
    assert live.is_running
    assert not live.surface.is_watched()  # no browser has come
    try:
        web.WebPage(stage, pace, page.port)
    except ValueError as error:
        assert str(error).startswith(f"port: expected a free one, got {page.port}"), error
    else:
        raise AssertionError("two pages at one port")

stage, pace = Stage("plain"), Pace(0.02)
page = open_surface("web", stage, pace, 0)
with LiveView(stage, page, pace) as live:
    look(stage, pace, page, live)
assert not page.is_running()

web._HOST = "0.0.0.0"  # as another version of MuJoCo might: it binds what it likes
try:
    web.WebPage(stage, pace, 0)
except OSError as error:
    assert "would serve 0.0.0.0 port" in str(error), error
else:
    raise AssertionError("a page for everybody")
print("looked at")
"""


def test_the_page(tmp_path: Path) -> None:
    pytest.importorskip("mujoco.studio.web_viewer", reason="no mujoco-studio")
    # In a process of its own: MuJoCo's server leaves connections to Python's end.
    done = subprocess.run(
        [sys.executable, "-c", PAGE], cwd=tmp_path, capture_output=True, text=True, timeout=100
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("looked at\n")

"""Flights by hand: sticks at every level, what happens without a hand, and the page that steers."""

import http.client
import json
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import Browser, browser
from commands import Capsys, refused, start
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.vector import LocalVectorEnv
from rotorgram.flights.recorded import recorded_trajectories
from rotorgram.flights.stick_page import StickPage
from rotorgram.flights.sticks import PATIENCE, SILENCE, HandPilot
from rotorgram.models import InputError

WITH_TWO_STICKS = ("rotors", "rates", "attitude", "velocity", "position")
ROLL, PITCH, THROTTLE, YAW = range(4)


class Hand:
    """A pilot with a clock that the test moves, and the craft that it flies."""

    def __init__(self, level: str, env_id: str = "rotorgram/Waypoints-v0", **more: Any) -> None:
        config = EnvConfig.from_keywords(
            env_id, **{"action": level, "vehicle": "crazyflie2", "episode_length": 3000, **more}
        )
        self.env = LocalVectorEnv(config, 1, autoreset_mode="Disabled")
        self.env.reset(seed=1)
        self.now = 0.0
        self.pilot = HandPilot(self.env.loop.task, lambda: self.now)

    def fly(self, seconds: float, sticks: list[float] | None = None) -> None:
        for _ in range(round(seconds / self.env.control_period)):
            if sticks is not None:
                self.pilot.steer(json.dumps(sticks).encode())
            self.env.advance(self.pilot.action(self.env.telemetry))
            self.now += self.env.control_period

    def told(self, name: str) -> np.ndarray:
        return np.array(self.env.telemetry[name][0])


def pushed(stick: int, share: float = 0.3) -> list[float]:
    sticks = [0.0] * 4
    sticks[stick] = share
    return sticks


@pytest.mark.parametrize("level", WITH_TWO_STICKS)
def test_sticks_fly_the_craft_where_they_point(level: str) -> None:
    """Axes of the world: x forward, y left, z up; the craft starts with its nose along x."""
    for stick, axis, sign in ((ROLL, 1, -1), (PITCH, 0, 1), (THROTTLE, 2, 1)):
        hand = Hand(level)
        hand.fly(0.3, pushed(stick, 0.1 if level in ("rotors", "rates") else 0.3))
        velocity = hand.told("velocity")
        assert sign * velocity[axis] > 0.05
        assert np.abs(np.delete(velocity, [axis, 2])).max() < 1e-6
    hand = Hand(level)
    hand.fly(0.3, pushed(YAW))
    assert hand.told("body_rates")[2] < -0.1  # the nose to the right


@pytest.mark.parametrize("options", [{}, {"action_type": "discrete"}, {"action": "increment"}])
def test_levels_of_one_number_have_the_throttle(options: dict[str, Any]) -> None:
    hand = Hand("offset", "rotorgram/Elevation-v0", vehicle=None, **options)
    hand.fly(0.4, [0.9, 0.9, 1.0, 0.9])
    assert hand.told("velocity")[2] > 0.2
    assert np.abs(hand.told("velocity")[:2]).max() < 1e-9


@pytest.mark.parametrize("level", WITH_TWO_STICKS)
def test_a_lost_hand_leaves_a_hover_and_then_a_landing(level: str) -> None:
    hand = Hand(level)
    hand.fly(0.3, pushed(PITCH, 0.03 if level in ("rotors", "rates") else 0.1))
    assert hand.pilot.flies == "hand"
    assert hand.told("velocity")[0] > 0.05
    hand.fly(SILENCE + 0.1)
    assert hand.pilot.flies == "hover"
    hand.fly(PATIENCE - 0.2)
    assert hand.pilot.flies == "hover"
    assert np.abs(hand.told("velocity")).max() < 0.01
    hand.fly(2.0)
    assert hand.pilot.flies == "land"
    assert hand.told("velocity") == pytest.approx([0.0, 0.0, -0.5], abs=0.01)
    hand.fly(0.1, pushed(THROTTLE))
    assert hand.pilot.flies == "hand"


HOSTILE = [
    b"", b"[0, 0, 0]", b"[0, 0, 0, NaN]", b"[0, 0, 0, 1e999]", b"[0, 0, 0, 1.5]", b"{}", b"null",
    b"[true, 0, 0, 0]", b'["0", 0, 0, 0]', b"[[0], 0, 0, 0]", b"[" * 100, b"\xff\xfe", b"1" * 200,
]  # fmt: skip


@pytest.mark.parametrize("body", HOSTILE)
def test_what_is_no_sticks_is_refused_and_steers_nothing(body: bytes) -> None:
    hand = Hand("velocity")
    with pytest.raises(InputError, match="sticks: expected 4 numbers from -1 to 1, got"):
        hand.pilot.steer(body)
    assert hand.pilot.silence == np.inf


# ---- the page


@contextmanager
def page(steer: Callable[[bytes], None]) -> Iterator[StickPage]:
    with closing(StickPage(("127.0.0.1", 0), steer)) as served:
        yield served


def asked(served: StickPage, method: str, path: str, body: bytes = b"", **headers: str) -> Any:
    """Status and text of an answer."""
    connection = http.client.HTTPConnection(*served.server_address[:2], timeout=5)
    connection.request(method, path, body or None, headers)
    answer = connection.getresponse()
    text = answer.read().decode()
    connection.close()
    return answer.status, text


def test_only_who_knows_the_key_may_steer() -> None:
    bodies: list[bytes] = []
    with page(bodies.append) as served:
        path = "/" + served.url.rpartition("/")[2]
        served.shown = b'{"time": 1.5}'
        assert asked(served, "POST", path, b"[0, 0, 0, 0]") == (200, '{"time": 1.5}')
        status, text = asked(served, "GET", path)
        assert status == 200
        assert text.startswith("<!doctype html>")
        for other in ("/", "/sticks", path + "x", path[:-1], "/%C3%A9"):
            for method in ("GET", "POST"):
                assert asked(served, method, other, b"[1, 1, 1, 1]") == (
                    400, "key: expected the address that rotorgram teleop printed"
                )  # fmt: skip
        with socket.create_connection(served.server_address[:2], timeout=5) as raw:
            raw.sendall(b"GET /\xe9 HTTP/1.1\r\n\r\n")
            assert raw.recv(1 << 16).startswith(b"HTTP/1.1 400 ")
    assert bodies == [b"[0, 0, 0, 0]"]


def test_a_body_of_another_size_is_refused() -> None:
    hand = Hand("velocity")
    with page(hand.pilot.steer) as served:
        path = "/" + served.url.rpartition("/")[2]
        size = "body: expected a whole number from 1 to 256 bytes, got "
        assert asked(served, "POST", path, b"0" * 257) == (400, size + "257")
        for length in ("-1", "many", "1" * 500, "1" * 5000):
            status, text = asked(served, "POST", path, **{"Content-Length": length})
            assert status == 400
            assert text.startswith(size)
        assert asked(served, "POST", path, b"[2, 0, 0, 0]") == (
            400, "sticks: expected 4 numbers from -1 to 1, got [2, 0, 0, 0]"
        )  # fmt: skip
    assert hand.pilot.silence == np.inf


GAMEPAD = """
const pad = {index: 0, mapping: "standard", axes: [0, 0, 0, 0], buttons: []};
let pads = [null];
navigator.getGamepads = () => pads;
function plug() { pads = [pad]; }
function unplug() {
  pads = [null];
  const event = new Event("gamepaddisconnected");
  event.gamepad = pad;
  dispatchEvent(event);
}
"""


class Heard:
    """What a page sends, with the time of the last."""

    def __init__(self) -> None:
        self.sticks: list[float] = []
        self.at = -np.inf

    def __call__(self, body: bytes) -> None:
        self.sticks = json.loads(body)
        self.at = time.monotonic()

    def wait(self, roll: float, pitch: float, throttle: float, yaw: float) -> None:
        expected = pytest.approx([roll, pitch, throttle, yaw], abs=0.05)
        deadline = time.monotonic() + 20
        while self.sticks != expected:
            assert time.monotonic() < deadline, self.sticks
            time.sleep(0.02)

    def is_silent(self) -> bool:
        """Whether nothing comes for as long as a craft waits."""
        time.sleep(0.5)  # what is on its way
        return self.at < time.monotonic() - 0.4


def middle(tab: Browser, side: int) -> tuple[float, float, float]:
    """Place and size of a stick, pixels."""
    width, height = tab.evaluate("[canvas.clientWidth, canvas.clientHeight]")
    size = min(width, height) * 0.16
    return (width - 1.5 * size if side else 1.5 * size), height - 1.5 * size, size


def test_the_page_has_sticks_keys_and_a_gamepad(tmp_path: Path) -> None:
    heard = Heard()
    with browser(tmp_path) as tab, page(heard) as served:
        opened = tab.open(served.url, GAMEPAD)
        heard.wait(0, 0, 0, 0)
        x, y, size = middle(tab, 1)
        tab.mouse("mousePressed", x, y)
        tab.mouse("mouseMoved", x + 0.5 * size, y - size)
        heard.wait(0.5, 1, 0, 0)
        tab.mouse("mouseReleased", x, y)
        heard.wait(0, 0, 0, 0)
        x, y, size = middle(tab, 0)
        tab.mouse("mousePressed", x, y)
        tab.mouse("mouseMoved", x - 3 * size, y + 0.25 * size)
        heard.wait(0, 0, -0.25, -1)
        tab.mouse("mouseReleased", x, y)
        tab.key("keyDown", "KeyW")
        tab.key("keyDown", "ArrowRight")
        heard.wait(0.5, 0, 0.5, 0)
        tab.key("keyUp", "KeyW")
        tab.key("keyUp", "ArrowRight")
        heard.wait(0, 0, 0, 0)

        tab.evaluate("plug()")
        tab.evaluate("pad.axes = [-0.5, -0.25, 0.75, 1.0]")  # down is positive
        heard.wait(0.75, -1, 0.25, -0.5)
        tab.evaluate("unplug()")
        assert heard.is_silent()
        assert tab.evaluate("told.textContent").startswith("the gamepad was unplugged")
        tab.key("keyDown", "ArrowUp")
        heard.wait(0, 0.5, 0, 0)

        tab.close(opened)
        assert heard.is_silent()


# ---- the command


def test_a_flight_by_hand_is_recorded(tmp_path: Path) -> None:
    record = tmp_path / "flight.mcap"
    words = ["--env", "rotorgram/Hover-v0", "--action", "velocity", "--episode-length", "50"]
    process = start(
        "teleop", "--bind", "127.0.0.1:0", "--episodes", 2, "--speed", 4, "--record", record, *words
    )
    assert process.stdout is not None
    line = process.stdout.readline()
    host, path = line.split()[1].removeprefix("http://").split("/")
    connection = http.client.HTTPConnection(host, timeout=30)

    with closing(connection), suppress(OSError):  # the second episode has ended
        while True:
            connection.request("POST", f"/{path}", b"[0, 0.2, 0, 0]")
            answer = connection.getresponse()
            assert answer.status == 200
            answer.read()
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert out.startswith("episode 0: 1.00 s, truncated, ")
    first, second = recorded_trajectories(record)
    assert [first.seed, second.seed] == [0, 1]
    assert [first.ending, second.ending] == ["truncated", "truncated"]
    assert first.actions[10:].tolist() == pytest.approx(np.tile([0.2, 0, 0, 0], (40, 1)))


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ["--bind", "0.0.0.0:0"],
            "0.0.0.0 is not a loopback address: expected 127.0.0.1, or --ins",
        ),
        (["--env", "rotorgram/Formation-v0", "--drones", 2], "drones: expected 1, flown by hand"),
        (["--speed", 100], "speed: expected a number from"),
    ],
)
def test_what_teleop_refuses(words: list[Any], sentence: str, capsys: Capsys) -> None:
    assert sentence in refused(capsys, "teleop", "--bind", "127.0.0.1:0", *words)

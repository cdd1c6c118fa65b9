"""Live views: when a step is due, what is written, and that nobody who flies ever waits."""

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import mujoco
import numpy as np
import pytest
from peers import Running
from pictures import HEXA, at
from rotorgram.cli import main
from rotorgram.cli._watch import Watcher
from rotorgram.envs import SingleEnv
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec
from rotorgram.models import InputError
from rotorgram.rendering import Moment, Stage, window
from rotorgram.rendering.live import LiveView, Pace
from rotorgram.udp import RemoteEnv, Simulator
from rotorgram.udp.protocol.messages import Command

ELEVATION = "rotorgram/Elevation-v0"


def moment(step: int = 0, *, height: float = 5.0, error: float = 0.5, episode: int = 0) -> Moment:
    return at(height, error, reward=0.25, step=step, episode=episode)


@dataclass
class FakeSurface:
    """Keeps what it is to draw; until `gate` opens it is busy with it."""

    stage: Stage
    gate: threading.Event = field(default_factory=threading.Event)
    shown: list[tuple[Moment, ...]] = field(default_factory=list)
    error: Exception | None = None
    open: bool = True

    def show(self) -> None:
        self.shown.append(self.stage.moments)
        assert self.gate.wait(60)
        if self.error is not None:
            raise self.error

    def is_running(self) -> bool:
        return self.open

    def close(self) -> None:
        self.open = False


@pytest.fixture(scope="module")
def stage() -> Stage:
    return Stage("plain")


@contextmanager
def fake_view(stage: Stage, *, busy: bool = False) -> Iterator[tuple[LiveView, FakeSurface]]:
    surface = FakeSurface(stage)
    if not busy:
        surface.gate.set()
    with patch.object(window, "Window", lambda *_: surface):
        live = LiveView(stage, Pace(0.0))
    try:
        yield live, surface
    finally:
        surface.gate.set()
        live.close()


def wait_until(condition: object, seconds: float = 20.0) -> None:
    assert callable(condition)
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.002)


# When a step is due: by hand, with times that are sums of powers of two.


def test_real_time_is_one_step_each_period() -> None:
    pace = Pace(0.25)
    assert pace.wait(100.0) == 0.0
    pace.stepped(100.0)
    assert pace.wait(100.0) == 0.25
    assert pace.wait(100.125) == 0.125
    assert pace.wait(100.25) == 0.0
    # Taken 1/16 s late; the next one is due when it always was.
    pace.stepped(100.3125)
    assert pace.wait(100.3125) == 0.1875


def test_a_late_step_is_made_up_for_up_to_a_tenth_of_a_second() -> None:
    pace = Pace(0.25)
    pace.stepped(100.0)
    pace.stepped(101.0)  # due at 100.25: so it counts as taken at 100.9
    assert pace.wait(101.0) == pytest.approx(0.15)


@pytest.mark.parametrize(("speed", "wait"), [(1 / 16, 4.0), (0.5, 0.5), (8.0, 0.03125)])
def test_speed_divides_the_period(speed: float, wait: float) -> None:
    pace = Pace(0.25, speed)
    pace.stepped(100.0)
    assert pace.wait(100.0) == wait


def test_pause_waits_for_ever_and_goes_on_at_once() -> None:
    pace = Pace(0.25)
    pace.stepped(100.0)
    pace.press("pause")
    assert pace.wait(100.5) is None
    assert pace.wait(900.0) is None
    pace.press("pause")
    assert pace.wait(900.0) == 0.0
    pace.stepped(900.0)  # and there is nothing to catch up on
    assert pace.wait(900.0) == 0.25


def test_each_press_of_step_lets_one_pass() -> None:
    pace = Pace(0.25)
    pace.stepped(100.0)
    pace.press("step")  # pauses, too
    assert pace.wait(100.0) == 0.0
    pace.stepped(100.0)
    assert pace.wait(100.5) is None
    pace.press("step")
    pace.press("step")
    assert pace.wait(101.0) == 0.0
    pace.stepped(101.0)
    assert pace.wait(101.0) == 0.0
    pace.stepped(101.0)
    assert pace.wait(101.0) is None


def test_without_a_period_every_step_is_due() -> None:
    pace = Pace(0.0)
    for now in (5.0, 5.0, 6.0):
        assert pace.wait(now) == 0.0
        pace.stepped(now)


@pytest.mark.parametrize("speed", [0.0, -1.0, 1 / 17, 8.5, float("nan")])
def test_wrong_speed(speed: float) -> None:
    with pytest.raises(InputError, match=r"^speed: expected a number from 0.0625 to 8, got"):
        Pace(0.02, speed)


# What is written and where it is looked from.


def test_lines_over_two_drones_are_those_of_the_first() -> None:
    stage = Stage("plain", 2)
    both = (at(9.0, position=(0.0, y, 9.0), step=7) for y in (0.0, 1.234))
    stage.show(*both)
    own = stage.moments[0].lines
    assert stage.lines == [
        ("drones", "2, numbers of the first"),
        ("least distance", "1.23 m"),
        *own,
    ]


def test_the_camera_goes_with_the_goal_and_leaves_the_mouse_its_turn() -> None:
    stage = Stage("plain")
    camera = mujoco.MjvCamera()
    stage.show(moment(height=4.5, error=0.5))
    stage.follow(camera)
    assert camera.lookat.tolist() == [0.0, 0.0, 5.0]
    assert (camera.azimuth, camera.elevation) == (0.0, -17.0)  # from behind, from above
    camera.azimuth, camera.lookat[0] = 45.0, 2.0  # by the mouse
    for height, error in ((2.5, 2.5), (3.0, 2.0)):  # the craft alone moves
        stage.show(moment(1, height=height, error=error))
        stage.follow(camera)
        assert camera.lookat.tolist() == [2.0, 0.0, 5.0]
    stage.show(moment(2, height=8.0, error=0.0))
    stage.follow(camera)
    assert camera.lookat.tolist() == [2.0, 0.0, 8.0]
    assert camera.azimuth == 45.0


def test_without_a_goal_the_camera_goes_with_the_craft() -> None:
    stage = Stage("plain")
    camera = mujoco.MjvCamera()
    for height in (5.0, 6.0):
        stage.show(at(height, goal=None))
        stage.follow(camera)
        assert camera.lookat.tolist() == [0.0, 0.0, height]


def test_the_camera_goes_with_the_craft_if_the_goal_is_far_away() -> None:
    stage = Stage("plain")
    camera = mujoco.MjvCamera()
    for height, error in ((5.0, 100.0), (25.0, 80.0)):
        stage.show(moment(height=height, error=error))
        stage.follow(camera)
        assert camera.lookat.tolist() == [0.0, 0.0, height]
        assert camera.distance < 10.0


# The simulation never waits.


def test_a_busy_view_drops_all_but_the_latest(stage: Stage) -> None:
    with fake_view(stage, busy=True) as (live, surface):
        assert live.wants
        live.draw(moment(0))
        wait_until(lambda: surface.shown)
        for step in range(1, 100):  # none of these calls may wait: the surface never answers
            live.draw(moment(step))
        assert not live.wants
        surface.gate.set()
        wait_until(lambda: live.wants and len(surface.shown) == 2)
        assert [shown[0].step for shown in surface.shown] == [0, 99]


def test_what_drawing_raises_is_raised_by_is_running(stage: Stage) -> None:
    with fake_view(stage) as (live, surface):
        surface.error = RuntimeError("the driver is gone")
        assert live.is_running
        live.draw(moment())
        with pytest.raises(RuntimeError, match="the driver is gone"):
            wait_until(lambda: not live.is_running)
        assert not live.is_running


def test_what_drawing_raises_because_it_was_closed_is_no_error(stage: Stage) -> None:
    with fake_view(stage, busy=True) as (live, surface):
        live.draw(moment())
        wait_until(lambda: surface.shown)
        surface.error = RuntimeError("there is no window")
        surface.open = False
        surface.gate.set()
        wait_until(lambda: not live.is_running)
        assert not live.draw_in_time(moment())


ACTIONS = np.sin(np.arange(600)).astype(np.float32)[:, np.newaxis]


def flown(env: object, steps: int) -> list[tuple[bytes, float, bool, bool]]:
    """The bits of so many steps of an env, with resets where they are due."""
    assert isinstance(env, SingleEnv | RemoteEnv)
    observation, _ = env.reset(seed=3)
    seen = [(observation.tobytes(), 0.0, False, False)]
    for action in ACTIONS[:steps]:
        if seen[-1][2] or seen[-1][3]:
            observation, _ = env.reset()
            seen.append((observation.tobytes(), 0.0, False, False))
        else:
            observation, reward, terminated, truncated, _ = env.step(action)
            seen.append((observation.tobytes(), float(reward), terminated, truncated))
    return seen


def test_a_watched_simulator_flies_the_same_bits_and_does_not_wait(stage: Stage) -> None:
    expected = flown(SingleEnv(ELEVATION), 600)
    assert sum(terminated or truncated for *_, terminated, truncated in expected) >= 2
    with RemoteEnv(("127.0.0.1", 0), connect=False, connect_timeout=20) as env:
        simulator = Simulator(server=env.address, bind=("127.0.0.1", 0))
        with simulator, fake_view(stage, busy=True) as (live, surface):
            simulator.observers.append(Watcher(live, simulator))
            running = Running(simulator)
            # The surface is busy with its first picture until all of this is flown.
            assert flown(env, 600) == expected
            assert len(surface.shown) == 1
            surface.gate.set()
            env.close()
            running.join()


# What a view shows of the wire.


def simulator_of(*heights: float, rotors: int = 4) -> Any:
    """What a watcher reads of a simulator: drones at these heights, 0.5 m below their goals.

    `advance` flies what led to a State, before the watcher sees it.
    """
    drones = len(heights)
    position = np.zeros((drones, 3))
    goal = np.zeros((drones, 3))
    position[:, 1] = heights
    goal[:, 1] = np.add(heights, 0.5)
    telemetry = {
        "position": position,
        "attitude": np.zeros((drones, 3)),
        "thrust": np.full((drones, rotors), 9.0),
        "goal": goal,
        "metrics": np.full((drones, 1), 0.5),
    }
    spec = env_spec(EnvConfig.from_keywords(ELEVATION, vehicle=HEXA if rotors == 6 else None))
    loop = SimpleNamespace(spec=spec, telemetry=telemetry, instruments=())

    def advance(cause: Command) -> Command:
        """Steps and rewards as `Loop` has them after a Command."""
        flies = cause.orders == 0
        loop.steps = np.where(cause.resets, 0, loop.steps + flies)
        loop.rewards = np.where(flies, 0.25, 0.0)
        return cause

    loop.steps = np.zeros(drones, int)
    loop.rewards = np.zeros(drones)
    return SimpleNamespace(spec=spec, stepped=loop, advance=advance)


def command(*orders: str) -> Command:
    """r resets, f freezes, s steps."""
    return Command(
        session=1,
        sequence=1,
        actions=np.zeros((len(orders), 1), np.float32),
        orders=np.array(["srf".index(order) for order in orders], np.uint8),
    )


class RecordingView:
    """A live view that keeps what it is given."""

    is_running = wants = True

    def __init__(self, stage: Stage) -> None:
        self.stage = stage
        self.pace = Pace(0.0)
        self.drawn: list[tuple[Moment, ...]] = []

    def draw(self, *moments: Moment) -> None:
        self.drawn.append(moments)


def test_a_watcher_counts_steps_and_episodes_of_each_drone() -> None:
    view = RecordingView(Stage("plain", 2))
    simulator = simulator_of(4.0, 6.0, 8.0)
    watcher = Watcher(view, simulator)  # type: ignore[arg-type]
    causes = [
        command("r", "r", "r"),  # the simulator's own first reset
        command("r", "r", "r"),  # as an agent begins: nothing was flown yet
        command("s", "s", "s"),
        command("s", "f", "s"),
        command("r", "s", "s"),
        command("s", "r", "s"),
    ]
    for cause in causes:
        watcher(simulator.advance(cause))
    counted = [[(m.step, m.episode) for m in moments] for moments in view.drawn]
    assert counted == [
        [(0, 0), (0, 0)],
        [(0, 0), (0, 0)],
        [(1, 0), (1, 0)],
        [(2, 0), (1, 0)],
        [(0, 1), (2, 0)],
        [(1, 1), (0, 1)],
    ]
    first, second = view.drawn[-1]
    assert first.position == (0.0, 4.0, 0.0)
    assert first.goal == (0.0, 4.5, 0.0)
    assert first.metrics == (("E", "0.500 m"),)
    assert (first.reward, second.reward) == (0.25, 0.0)  # no step led to a start


def test_a_watcher_shows_the_rotors_that_there_are() -> None:
    view = RecordingView(Stage("plain", vehicle=HEXA))
    Watcher(view, simulator_of(4.0, rotors=6))(command("r"))  # type: ignore[arg-type]
    assert view.drawn[0][0].thrusts == (9.0,) * 6


def test_a_pause_freezes_the_picture_alone() -> None:
    view = RecordingView(Stage("plain"))
    simulator = simulator_of(5.0)
    watcher = Watcher(view, simulator)  # type: ignore[arg-type]
    watcher(command("r"))
    view.pace.press("pause")
    for _ in range(3):
        watcher(simulator.advance(command("s")))  # returns: lock-step goes on
    view.pace.press("step")
    for _ in range(3):
        watcher(simulator.advance(command("s")))
    assert [moments[0].step for moments in view.drawn] == [0, 4]


def test_a_view_that_fails_or_closes_stops_no_simulator(
    caplog: pytest.LogCaptureFixture, stage: Stage
) -> None:
    class FailingView(RecordingView):
        @property
        def is_running(self) -> bool:  # type: ignore[override]
            raise RuntimeError("the driver is gone")

    failing = FailingView(stage)
    closed = RecordingView(stage)
    closed.is_running = False
    for view in (failing, closed):
        watcher = Watcher(view, simulator_of(5.0))  # type: ignore[arg-type]
        for _ in range(2):
            watcher(command("s"))
        assert not view.drawn
    assert "the simulator goes on: the driver is gone" in caplog.text
    assert len(caplog.records) == 1 or "was closed" in caplog.text


# The command.


def status_and_error(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str]:
    status = main(list(words))
    error = capsys.readouterr().err
    return status, error.strip()


@pytest.mark.parametrize("words", [("view", "pid"), ("sim", "--view", "--bind", "127.0.0.1:0")])
@pytest.mark.skipif(sys.platform != "linux", reason="other systems always have a display")
def test_no_display(
    words: tuple[str, ...],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    status, error = status_and_error(capsys, *words, "--scene", "plain")
    assert status == 2
    assert error.startswith("rotorgram: window: expected a display, got none")
    assert "rotorgram render" in error
    assert "\n" not in error


WRONG = [
    (("--speed", "9"), "speed: expected a number from 0.0625 to 8, got 9.0"),
    (("--episodes", "0"), "episodes: expected a whole number of at least 1, or none, got 0"),
]


@pytest.mark.parametrize(("words", "expected"), WRONG)
def test_wrong_flags(
    words: tuple[str, ...], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    status, error = status_and_error(capsys, "view", "pid", "--scene", "plain", *words)
    assert status == 1
    assert error == f"rotorgram: {expected}"


def open_fakes(monkeypatch: pytest.MonkeyPatch) -> list[FakeSurface]:
    """What `rotorgram view` opens in place of windows."""
    surfaces: list[FakeSurface] = []

    def open_fake(stage: Stage, press: object) -> FakeSurface:
        surfaces.append(FakeSurface(stage))
        surfaces[-1].gate.set()
        return surfaces[-1]

    monkeypatch.setattr(window, "Window", open_fake)
    return surfaces


def test_view_shows_a_journal_to_its_end(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = tmp_path / "flight.mcap"
    anywhere = ("127.0.0.1", 0)
    with RemoteEnv(anywhere, connect=False, record=journal) as env:
        simulator = Simulator(server=env.address, bind=anywhere, episode_length=30)
        running = Running(simulator)
        seen = flown(env, 70)  # 30 steps, a reset, 30 steps, a reset, 8 steps
    running.join()
    surfaces = open_fakes(monkeypatch)
    assert main(["view", str(journal), "--scene", "plain", "--speed", "8"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in out[1:]] == [f"episode {k}" for k in range(3)]
    total = sum(reward for _, reward, *_ in seen[1:31])
    assert out[1].startswith(f"episode 0: return {total:.1f}, ")
    assert {shown[0].episode for shown in surfaces[0].shown} == {0, 1, 2}
    assert main(["view", str(journal), "--effects", "linear_drag=1"]) == 1
    assert "expected no options with a journal" in capsys.readouterr().err


@pytest.mark.parametrize("who", ["pid", "random"])
def test_view_shows_episodes_at_the_speed_that_was_asked_for(
    who: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    surfaces = open_fakes(monkeypatch)
    words = ["--episodes", "2", "--speed", "8", "--episode-length", "80"]
    began = time.monotonic()
    assert main(["view", who, "--scene", "plain", *words]) == 0
    # 81 pictures an episode, 0.02 s / 8 between two; at most 0.1 s are made up for.
    assert time.monotonic() - began >= 161 * 0.02 / 8 - 0.1
    out = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in out] == [
        f"showing {who} in the window (Ctrl-C ends)",
        "episode 0",
        "episode 1",
    ]
    shown = [shown[0] for shown in surfaces[0].shown]
    order = [(m.episode, m.step) for m in shown]
    assert order == sorted(set(order))
    assert {m.episode for m in shown} == {0, 1}

"""A simulator that keeps time: its rules on a fake clock, and flights with a silent agent."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from commands import Capsys, refused
from links import HERE, NONCE, BothSides, hello, layout, outgoing
from peers import ANY, Running, simulate
from rotorgram.envs.compiled import make_loop
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.failsafe import DESCENT, Failsafe
from rotorgram.flights.recorded import recorded_trajectories
from rotorgram.models import InputError
from rotorgram.udp import RemoteEnv, Simulator
from rotorgram.udp.journal.replay import Verification
from rotorgram.udp.protocol.client import Client, LinkConfig
from rotorgram.udp.protocol.messages import FLY, RESET, State
from rotorgram.udp.protocol.party import AgentLink
from rotorgram.udp.protocol.running import FreeRun, FreeRunning
from rotorgram.udp.protocol.server import Server

PERIOD = 0.1  # s, of a step
RATE = 2.0  # so a step is due every 0.05 s
SILENCE = 0.25  # s: the first two steps without a Command hold the last actions
LEVELS = ("rotors", "rates", "attitude", "velocity", "position", "offset", "increment")


class World:
    """Two drones of a world each. A step has the reward of its action; a drone can be ended."""

    def __init__(self) -> None:
        self.observations = {"height": np.zeros((2, 1), np.float32)}
        self.rewards = np.zeros(2)
        self.terminated = self.truncated = self.out = self.done = np.zeros(2, bool)
        self.telemetry: dict[str, Any] = {}
        self.flown: list[list[float]] = []
        self.ends: list[bool] = [False, False]

    def advance(self, actions: Any, resets: Any, seeds: Any, frozen: Any, asks: Any = None) -> None:
        idle = np.zeros(2, bool) if frozen is None else frozen
        begun = np.zeros(2, bool) if resets is None else resets
        assert not (self.done & ~idle & ~begun).any()
        flies = ~idle & ~begun
        self.flown.append(np.where(flies, actions[:, 0], np.nan).tolist())
        self.rewards = np.where(flies, actions[:, 0], 0.0).astype(float)
        self.terminated = flies & np.array(self.ends)
        self.done = self.out = (self.done & ~begun) | self.terminated


class Flight(BothSides):
    """Both sides, on a clock that the test moves."""

    def __init__(self, failsafe: bool = True) -> None:
        self.now = 0.0
        self.world = World()
        shape = layout(2, shapes=((),))
        client = Client(hello(worlds=2), shape, LinkConfig(timeout=60))
        link = AgentLink(("127.0.0.1", 1000), client, slice(0, 2))
        run = FreeRun(rate=RATE, silence=SILENCE)
        actions = np.full((2, 1), 9.0)
        self.rules = FreeRunning(
            self.world, shape, PERIOD, [link], run, (lambda: actions) if failsafe else None
        )
        self.server = Server(lambda _: shape, draw_nonce=lambda: NONCE)
        self.states: list[State] = []
        self.rules.start(0.0)
        self.pump()

    def pump(self) -> None:
        moving = True
        while moving:
            moving = self.rules.step(self.now)
            self.rules.answer(self.now)
            (link,) = self.rules.links
            for datagram in outgoing(link.client):
                event = self.server.receive(datagram, HERE, self.now)
                if event and isinstance(event.message, State):
                    self.states.append(event.message)
                moving = True
            for datagram, _ in outgoing(self.server):
                self.rules.receive(link, datagram, self.now)
                moving = True

    def say(self, *actions: float, orders: tuple[int, int] = (FLY, FLY)) -> None:
        (session,) = self.server.slots
        assert session is not None
        sent = np.array(actions, np.float32).reshape(2, 1)
        session.send_command(sent, np.array(orders, np.uint8), None, self.now)
        self.pump()

    @property
    def counts(self) -> tuple[int, int, int]:
        counters = self.rules.links[0].client.statistics.counters
        return counters["held"], counters["late"], counters["overrun"]


NAN = float("nan")


def same(flown: list[list[float]], expected: list[list[float]]) -> bool:
    return bool(np.array_equal(np.array(flown), np.array(expected), equal_nan=True))


def test_a_command_in_time_waits_for_the_clock_and_is_flown_once() -> None:
    flight = Flight()
    assert same(flight.world.flown, [[NAN, NAN]])  # the first reset
    flight.now = 0.02
    flight.say(1.0, 2.0)
    assert len(flight.states) == 1
    flight.wait(0.031)  # the step is due 0.05 s after the reset
    assert same(flight.world.flown[1:], [[1.0, 2.0]])
    assert [s.time for s in flight.states] == pytest.approx([0.0, PERIOD])
    assert flight.states[1].rewards.tolist() == [1.0, 2.0]
    assert flight.states[1].telemetry[0].tolist() == [0.0, 0.0]
    assert flight.counts == (0, 0, 0)


def test_a_silent_agent_leaves_the_last_action_and_then_the_failsafe() -> None:
    flight = Flight()
    flight.say(1.0, 2.0)
    flight.wait(0.051)
    flight.wait(0.2)  # four steps that nobody asks for; 0.3 s of silence at the third
    assert same(flight.world.flown[1:], [[1.0, 2.0]] * 3 + [[9.0, 9.0]] * 2)
    assert flight.counts == (4, 0, 0)
    assert len(flight.states) == 2
    flight.say(5.0, 6.0)
    flight.wait(0.05)
    assert flight.counts == (4, 1, 0)
    last = flight.states[-1]
    assert last.rewards.tolist() == [1 + 1 + 9 + 9 + 5, 2 + 2 + 9 + 9 + 6]
    assert last.telemetry[0].tolist() == pytest.approx([4 * PERIOD] * 2)
    assert last.time == pytest.approx(6 * PERIOD)
    flight.say(5.0, 6.0)
    flight.wait(0.05)
    assert flight.states[-1].telemetry[0].tolist() == [0.0, 0.0]
    assert flight.states[-1].rewards.tolist() == [5.0, 6.0]


def test_without_a_failsafe_the_last_action_is_held() -> None:
    flight = Flight(failsafe=False)
    flight.wait(0.051)
    assert same(flight.world.flown, [[NAN, NAN], [0.0, 0.0]])  # after a reset: the neutral one
    flight.say(3.0, 4.0)
    flight.wait(0.4)
    assert same(flight.world.flown[2:], [[3.0, 4.0]] * 8)


def test_an_end_in_a_silence_is_told_and_waits_for_its_reset() -> None:
    flight = Flight()
    flight.say(1.0, 2.0)
    flight.wait(0.051)
    flight.world.ends[0] = True
    flight.wait(0.05)
    flight.world.ends[0] = False
    flight.wait(0.05)
    assert same(flight.world.flown[-2:], [[1.0, 2.0], [NAN, 2.0]])
    flight.say(5.0, 6.0)  # for one whose end the agent does not know
    flight.wait(0.05)
    assert same(flight.world.flown[-1:], [[NAN, 6.0]])
    last = flight.states[-1]
    assert last.terminated.tolist() == [True, False]
    assert last.rewards.tolist() == [1.0, 2.0 + 2.0 + 6.0]
    flight.wait(0.05)
    flight.say(0.0, 7.0, orders=(RESET, FLY))
    flight.wait(0.05)
    last = flight.states[-1]
    assert last.terminated.tolist() == [False, False]
    assert last.rewards.tolist() == [0.0, 6.0 + 7.0]


def test_a_long_delay_of_this_side_is_counted_and_not_made_up_for() -> None:
    flight = Flight()
    flight.now = 1.0
    flight.pump()
    assert flight.counts == (1, 0, 1)
    flight.wait(0.051)
    assert flight.counts == (3, 0, 1)


# ---- flights


def config(level: str, **more: Any) -> EnvConfig:
    given = {"action": level, "episode_length": 1000, "vehicle": "crazyflie2", **more}
    return EnvConfig.from_keywords("rotorgram/Waypoints-v0", **given)


@pytest.mark.parametrize("level", LEVELS)
def test_every_level_hovers_and_lands_without_a_pilot(level: str) -> None:
    loop = make_loop(config(level), 2)
    size = len(loop.spec.action.components)
    loop.advance(None, np.ones(2, bool), 3)
    dice = np.random.default_rng(0)
    for _ in range(5):
        loop.advance(dice.uniform(-0.5, 0.5, (2, size)))
    assert np.abs(loop.telemetry["velocity"]).max() > 0.01
    hover = Failsafe(loop.task, "hover")
    for _ in range(200):
        loop.advance(hover.actions(loop.telemetry))
    assert np.abs(loop.telemetry["velocity"]).max() < 1e-3
    land = Failsafe(loop.task, "land")
    for _ in range(100):
        loop.advance(land.actions(loop.telemetry))
    assert loop.telemetry["velocity"] == pytest.approx(np.array([[0, 0, -DESCENT]] * 2), abs=1e-3)


@contextmanager
def flying(
    env: EnvConfig, record: Path | None = None, **run: Any
) -> Iterator[tuple[RemoteEnv, Running]]:
    remote = RemoteEnv(ANY, connect=False, timeout=5, connect_timeout=5)
    running = simulate(remote, env=env, free_run=FreeRun(**run), record=record)
    try:
        remote.connect()
        yield remote, running
    finally:
        remote.close()
        running.join()


def test_an_agent_in_time_flies_the_bits_of_lock_step() -> None:
    env = config("rates")
    actions = [np.full(4, 0.001 * step, np.float32) for step in range(10)]
    local = make_loop(env)
    local.advance(None, np.ones(1, bool), 5)
    expected = []
    for action in actions:
        local.advance(action)
        seen = local.observations["observation"][0].tobytes()
        expected.append((seen, local.rewards[0], local.telemetry["position"][0, 2]))
    with flying(env, rate=0.1) as (remote, running):  # a busy machine answers within 0.2 s
        remote.reset(seed=5)
        for action, told in zip(actions, expected, strict=True):
            observation, reward, *_, info = remote.step(action)
            assert (observation.tobytes(), reward, info["z"]) == told
            assert info["command_age"] == 0.0
    assert running.simulator.link.statistics.counters["held"] == 0


@pytest.mark.parametrize("after", ["hover", "land", "off"])
def test_a_silent_agent_over_udp(after: Any) -> None:
    with flying(config("rotors"), rate=5.0, after=after) as (env, running):
        env.reset(seed=1)
        for _ in range(10):
            *_, before = env.step(np.full(4, 0.01, np.float32))
        time.sleep(0.5)  # 2.5 s of flight
        *_, info = env.step(np.zeros(4, np.float32))
    assert info["command_age"] > 1.5
    speeds = {"hover": 0.0, "land": -DESCENT}
    if after in speeds:
        assert info["vz"] == pytest.approx(speeds[after], abs=0.02)
    else:
        assert info["z"] < before["z"] - 0.5
    counters = running.simulator.link.statistics.counters
    assert counters["late"] >= 1
    assert counters["held"] >= 75


def test_its_journal_is_read_and_not_repeated(tmp_path: Path) -> None:
    record = tmp_path / "flight.mcap"
    env = config("rates")
    with flying(env, record=record, rate=5.0) as (remote, _):
        remote.reset(seed=1)
        for _ in range(5):
            remote.step(np.zeros(4, np.float32))
    (flight,) = recorded_trajectories(record)
    assert flight.telemetry["command_age"].shape == (len(flight) + 1,)
    verdict = str(Verification(record, vehicle="crazyflie2"))
    assert "expected a flight in lock-step, got one of sim --free-running" in verdict


def test_what_cannot_keep_time_is_refused(capsys: Capsys) -> None:
    with pytest.raises(InputError, match="off: expected actions of the level rotors, got velocity"):
        Simulator(config("velocity"), bind=ANY, free_run=FreeRun(after="off"))
    with pytest.raises(InputError, match="after: expected hold with Pendulum-v1, got hover"):
        Simulator(gym.make("Pendulum-v1"), bind=ANY, free_run=FreeRun())
    with pytest.raises(InputError, match="one agent and binary"):
        Simulator(codec="text", bind=ANY, free_run=FreeRun())
    with pytest.raises(InputError, match="rate: expected a number from"):
        FreeRun(rate=0)
    assert "expected them with --free-running" in refused(capsys, "sim", "--silence", "1")
    Simulator(gym.make("Pendulum-v1"), bind=ANY, free_run=FreeRun(after="hold")).close()

"""Many drones of one or several simulators: places, and simulators that are lost."""

import logging
import re
import time
from contextlib import closing
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from fleets import (
    Failing,
    assert_parity,
    assert_same,
    flying,
    random_actions,
    sync,
)
from peers import ANY, ENV_ID, TABLES, plain_socket, simulate
from rotorgram.udp import (
    LinkConfig,
    PeerSilent,
    Refused,
    RemoteVectorEnv,
)

# ---- places


def test_a_place_that_stays_free() -> None:
    remote = RemoteVectorEnv(ANY, num_simulators=2, num_envs=2, connect=False, connect_timeout=0.4)
    running = simulate(remote)
    sentence = rf"^no simulator came to 127.0.0.1:{remote.address[1]} for 0.4 s"
    for _ in range(2):
        with pytest.raises(PeerSilent, match=sentence):
            remote.reset()
    other = simulate(remote)
    with sync(2) as local:
        assert_same(remote.reset(seed=5), local.reset(seed=5))
    remote.close()
    assert running.join() == other.join() == "the agent closed"


def test_a_late_simulator_waits_until_another_leaves(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    # Its timeout is shorter than its wait: it does not run while the agent says Wait.
    config = LinkConfig(timeout=0.5)
    with flying(2, 2) as (remote, running):
        remote.reset(seed=3)
        late = simulate(remote, config, num_envs=2)
        start = time.monotonic()
        while time.monotonic() - start < 1:
            remote.step(np.zeros((4, 1)))
            time.sleep(0.02)
        assert late.simulator.link.state == "hello"
        assert late.simulator.link.statistics.counters["refused"] == 0
        assert "every slot of the agent is taken; waiting for a free one" in caplog.text
        running[0].cut()
        remote._agent.config.timeout = 0.3
        *_, truncated, info = remote.step(np.zeros((4, 1)))
        assert truncated.sum() == 2
        assert late.simulator.link.state == "waiting"
        reason = info["simulator_lost"][truncated][0]
        assert reason.startswith("no datagram from the simulator at 127.0.0.1:")
        remote.step(np.zeros((4, 1)))
    assert late.join() == "the agent closed"


class Slow(gym.Wrapper):
    def step(self, action: Any) -> Any:
        time.sleep(0.02)
        return super().step(action)


def test_a_slow_simulator_only_delays() -> None:
    remote = RemoteVectorEnv(ANY, num_simulators=2, num_envs=2, connect=False)
    running = [
        simulate(remote),
        simulate(remote, env=Slow(gym.make(ENV_ID, disable_env_checker=True))),
    ]
    with closing(remote), sync(2) as local:
        assert_same(remote.reset(seed=8), local.reset(seed=8))
        start = time.monotonic()
        assert_parity(remote, local, 30)
        assert time.monotonic() - start >= 0.6
    assert [one.join() for one in running] == ["the agent closed"] * 2


@pytest.mark.parametrize(("arguments", "sentence"), TABLES["refused beside others"])
def test_another_kind_of_simulator_is_refused(arguments: dict[str, Any], sentence: str) -> None:
    """With a place still free; what counts is the first that came, and the number asked for."""
    remote = RemoteVectorEnv(ANY, num_simulators=2, num_envs=4, connect=False, connect_timeout=0.5)
    good = simulate(remote, num_envs=2)
    with pytest.raises(PeerSilent):
        remote.reset()
    bad = simulate(remote, **arguments)
    with pytest.raises(PeerSilent, match=f"last datagram dropped: refused from .*{sentence}"):
        remote.reset()
    error = bad.join()
    assert isinstance(error, Refused)
    assert re.search(sentence, str(error))
    other = simulate(remote, num_envs=2)
    remote.reset()
    remote.close()
    assert good.join() == other.join() == "the agent closed"


def test_a_text_simulator_is_turned_away_where_two_drones_are_expected() -> None:
    remote = RemoteVectorEnv(ANY, num_simulators=1, num_envs=2, connect=False, connect_timeout=0.5)
    line = b"1,0.0,0,0,1,1,1," + b"0," * 9 + b"0"
    with plain_socket() as sock:
        sock.sendto(line, remote.address)
        with pytest.raises(PeerSilent):
            remote.reset()
        assert sock.recv(1200) == b"1,close"
    remote.close()


def test_text_simulators_fly_as_well() -> None:
    remote = RemoteVectorEnv(
        ANY, env_id=ENV_ID, num_simulators=2, num_envs=2, connect=False, connect_timeout=5
    )
    running = [simulate(remote, codec="text") for _ in range(2)]
    with closing(remote), sync(2) as local:
        assert_same(remote.reset(seed=2), local.reset(seed=2))
        assert assert_parity(remote, local, 300) >= 2
    assert [one.join() for one in running] == ["the agent closed"] * 2


# ---- lost simulators


def test_one_simulator_closes_and_no_other_comes() -> None:
    env = Failing(gym.make(ENV_ID, disable_env_checker=True))
    remote = RemoteVectorEnv(ANY, num_simulators=2, num_envs=2, connect=False, connect_timeout=0.5)
    running = [simulate(remote), simulate(remote, env=env)]
    remote.reset(seed=0)
    env.fails = True
    sentence = (
        r"^the simulator at 127.0.0.1:\d+ closed: RuntimeError: out of fuel; "
        rf"no other came to 127.0.0.1:{remote.address[1]} for 0.5 s$"
    )
    with pytest.raises(PeerSilent, match=sentence):
        remote.step(np.zeros((2, 1)))
    running[1].join()
    running[1] = simulate(remote)
    with sync(2) as local:
        assert_same(remote.reset(seed=1), local.reset(seed=1))
        assert_parity(remote, local, 10)
    remote.close()
    assert [one.join() for one in running] == ["the agent closed"] * 2


@pytest.mark.parametrize("how", ["another waits", "same address", "comes later"])
def test_a_killed_simulator_takes_only_its_own_drones_along(how: str) -> None:
    """Three simulators of two drones; the others' numbers are those of a flight without it."""
    options = {"episode_length": 40}
    same = how == "same address"
    drones = slice(2, 4)
    others = np.array([0, 1, 4, 5])
    with flying(3, 2, **options) as (remote, running), sync(6, **options) as local:
        remote._agent.config.timeout = 10 if same else 0.5
        assert_same(remote.reset(seed=6), local.reset(seed=6))
        assert assert_parity(remote, local, 65) == 6
        session = remote._agent.server.slots[1]
        assert session is not None
        address = session.peer
        victim = next(one for one in running if one.simulator.address == address)
        running.remove(victim)
        if how == "another waits":
            running.append(simulate(remote, num_envs=2, **options))
        before = local.step(np.zeros((6, 1), np.float32))
        assert_same(remote.step(np.zeros((6, 1))), before)
        victim.cut()
        if how != "another waits":
            bind = address if same else ANY
            running.append(simulate(remote, bind=bind, num_envs=2, **options))
        actions = np.full((6, 1), 0.3, np.float32)
        here = remote.step(actions)
        there = local.step(actions)
        assert_same(here, there, others)
        assert_same((here[0], here[-1]), (before[0], before[-1]), drones)
        assert here[1][drones].tolist() == [0.0, 0.0]
        assert here[2].tolist() == [False] * 6
        assert here[3].tolist() == [False, False, True, True, False, False]
        assert here[4]["_simulator_lost"].tolist() == here[3].tolist()
        reasons = here[4]["simulator_lost"].tolist()
        assert reasons[2] == reasons[3]
        assert reasons[:2] == reasons[4:] == [None, None]
        sentence = f"no datagram from the simulator at 127.0.0.1:{address[1]} for 0.5 s, waiting at"
        if same:
            sentence = f"the simulator at 127.0.0.1:{address[1]} was started anew"
        assert reasons[2].startswith(sentence)
        # The others fly on as if nothing had been; the new ones begin with a reset.
        here = remote.step(-actions)
        assert_same(here, local.step(-actions), others)
        assert here[1][drones].tolist() == [0.0, 0.0]
        assert (here[0][drones, 1:] == 0).all()
        assert "simulator_lost" not in here[4]
        dice = np.random.default_rng(0)
        for _ in range(100):
            actions = random_actions(local, dice)
            assert_same(remote.step(actions), local.step(actions), others)
        # And all of them obey a seed.
        assert_same(remote.reset(seed=1), local.reset(seed=1))
        assert_parity(remote, local, 50)
        assert remote.statistics.counters["sessions"] == 4


def test_a_simulator_lost_between_an_episode_and_the_next() -> None:
    """Its drones were to be reset anyway: they are, by its successor, and no episode is cut."""
    with flying(2, 1, episode_length=3) as (remote, running):
        remote.reset(seed=0)
        for _ in range(3):
            *_, truncated, _ = remote.step(np.zeros((2, 1)))
        assert truncated.all()
        here = running[1].simulator.address
        running[1].cut()
        running.append(simulate(remote, bind=here, episode_length=3))
        observations, rewards, terminated, truncated, info = remote.step(np.zeros((2, 1)))
        assert rewards.tolist() == [0.0, 0.0]
        assert not (terminated | truncated).any()
        assert "simulator_lost" not in info
        assert (observations[:, 1:] == 0).all()
        del running[1]


def test_a_simulator_lost_during_a_reset_is_replaced_and_seeded() -> None:
    with flying(2, 1) as (remote, running), sync(2) as local:
        remote.reset(seed=0)
        here = running[0].simulator.address
        running[0].cut()
        running[0] = simulate(remote, bind=here)
        assert_same(remote.reset(seed=9), local.reset(seed=9))
        assert assert_parity(remote, local, 260) >= 2


def test_a_simulator_lost_in_the_second_round_trip_of_a_step_is_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """SAME_STEP: drone 0 begins its next episode, and the simulator is lost that drone 1 flies."""
    with flying(1, 2, autoreset="SameStep", episode_length=3) as (remote, running):
        remote.reset(seed=0)
        remote.step(np.zeros((2, 1)))
        remote.reset(options={"reset_mask": np.array([False, True])})
        remote.step(np.zeros((2, 1)))
        advance = remote.advance
        here = running[0].simulator.address
        calls: list[Any] = []

        def lose_it(*arguments: Any) -> None:
            calls.append(arguments)
            if len(calls) == 2:
                running[0].cut()
                running[0] = simulate(remote, bind=here, num_envs=2, episode_length=3)
            advance(*arguments)

        monkeypatch.setattr(remote, "advance", lose_it)
        *_, truncated, info = remote.step(np.zeros((2, 1)))
        assert len(calls) == 3
        assert truncated.tolist() == info["_final_info"].tolist() == [True, True]
        reason = f"the simulator at 127.0.0.1:{here[1]} was started anew"
        for where in (info, info["final_info"]):
            assert where["simulator_lost"].tolist() == [None, reason]
            assert where["_simulator_lost"].tolist() == [False, True]
        *_, info = remote.step(np.zeros((2, 1)))
        assert "simulator_lost" not in info

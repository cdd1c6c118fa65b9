"""Many drones of one or several simulators as one vector env: parity, places, lost simulators."""

import json
import logging
import re
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import rotorgram.envs
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from peers import ANY, ENV_ID, Running, launch, plain_socket
from rotorgram.envs import ElevationVectorEnv
from rotorgram.udp import (
    LinkConfig,
    PeerClosed,
    PeerSilent,
    Refused,
    RemoteVectorEnv,
    Simulator,
    binary,
)
from rotorgram.udp.fleet import describe, make_env
from rotorgram.udp.messages import Wait

QUICK = LinkConfig(timeout=10, first_resend=0.02, max_resend=0.2)
NAMES = rotorgram.envs.TELEMETRY_NAMES

SIMULATE = """
    import json, sys
    from rotorgram.udp import LinkConfig, Simulator
    arguments = json.loads(sys.argv[1])
    for name in ("server", "bind"):
        arguments[name] = tuple(arguments[name])
    config = LinkConfig(timeout=20, first_resend=0.02, max_resend=0.2)
    with Simulator(config=config, **arguments) as simulator:
        print(simulator.address[1], flush=True)
        print(simulator.run())
"""


@contextmanager
def flying(
    simulators: int, drones: int, env: str = ENV_ID, autoreset: str = "NextStep", **options: Any
) -> Iterator[tuple[RemoteVectorEnv, list[Running]]]:
    """A RemoteVectorEnv, and simulators for it in threads."""
    remote = RemoteVectorEnv(
        ANY,
        num_simulators=simulators,
        num_envs=simulators * drones,
        env_id=env,
        autoreset_mode=autoreset,
        connect=False,
    )
    running = [simulate(remote, num_envs=drones, env=env, **options) for _ in range(simulators)]
    try:
        yield remote, running
    finally:
        remote.close()
        for one in running:
            one.join()


def simulate(remote: RemoteVectorEnv, config: LinkConfig = QUICK, **arguments: Any) -> Running:
    return Running(Simulator(server=remote.address, config=config, **{"bind": ANY, **arguments}))


@contextmanager
def sync(num_envs: int, **options: Any) -> Iterator[VectorEnv]:
    with closing(
        gym.make_vec(ENV_ID, num_envs=num_envs, vectorization_mode="sync", **options)
    ) as env:
        yield env


def assert_same(here: tuple, there: tuple, drones: slice = slice(None)) -> None:
    """What reset or step gave, without the info, bit for bit."""
    for ours, theirs in zip(here[:-1], there[:-1], strict=True):
        assert ours.dtype == theirs.dtype
        assert ours[drones].tobytes() == theirs[drones].tobytes()
    for name in (name for name in there[-1] if name.lstrip("_") in NAMES):
        ours, theirs = here[-1][name], there[-1][name]
        assert ours.dtype == theirs.dtype
        assert ours[drones].tobytes() == theirs[drones].tobytes()


def random_actions(env: VectorEnv, dice: np.random.Generator) -> np.ndarray:
    shape = env.action_space.shape
    if isinstance(env.single_action_space, spaces.Discrete):
        return dice.integers(3, size=shape)
    return dice.uniform(-1.2, 1.2, shape).astype(np.float32)


def assert_parity(remote: VectorEnv, local: VectorEnv, steps: int) -> int:
    """How many episodes ended on the way."""
    dice = np.random.default_rng(5)
    ends = 0
    for _ in range(steps):
        actions = random_actions(local, dice)
        here, there = remote.step(actions), local.step(actions)
        assert_same(here, there)
        assert set(here[-1]) == {*NAMES, *(f"_{name}" for name in NAMES)}
        ends += int((here[2] | here[3]).sum())
    return ends


# ---- parity


@pytest.mark.parametrize("simulators", [1, 3])
@pytest.mark.parametrize("drones", [1, 4])
def test_parity(simulators: int, drones: int) -> None:
    options = {"episode_length": 23, "target": (4.0, 6.0)}
    number = simulators * drones
    with flying(simulators, drones, **options) as (remote, _), sync(number, **options) as local:
        for seed in (0, [2**63 + 5 * i for i in range(number)], [7] * number):
            assert_same(remote.reset(seed=seed), local.reset(seed=seed))
            assert assert_parity(remote, local, 80) >= 3 * number
        assert_same(remote.reset(), local.reset())  # the generators go on
        assert assert_parity(remote, local, 30) >= number


def test_parity_of_episodes_that_end_at_different_times() -> None:
    options = {"action_type": "discrete", "flight_band": 1.2, "episode_length": 60}
    with flying(3, 2, **options) as (remote, _), sync(6, **options) as local:
        assert_same(remote.reset(seed=1), local.reset(seed=1))
        assert remote.single_action_space == spaces.Discrete(3)
        assert remote.action_space == local.action_space
        assert assert_parity(remote, local, 500) > 40


def test_the_step_after_an_end_is_a_reset() -> None:
    """NEXT_STEP by hand: the step after an end has reward 0, no flag, and ignores its action."""
    with flying(1, 2, episode_length=3) as (remote, _):
        first, _ = remote.reset(seed=4)
        for _ in range(2):
            assert not remote.step(np.zeros((2, 1), np.float32))[3].any()
        assert remote.step(np.zeros((2, 1), np.float32))[3].all()
        observations, rewards, terminated, truncated, info = remote.step(np.ones((2, 1)))
        assert rewards.tolist() == [0.0, 0.0]
        assert not (terminated | truncated).any()
        assert (observations[:, 1:] == 0).all()  # at rest, at hover thrust
        assert (observations[:, 0] != first[:, 0]).all()
        assert info["F1"].tolist() == [49.0, 49.0]


def test_another_env_of_gymnasium_flies_too() -> None:
    local = gym.make_vec("CartPole-v1", num_envs=4, vectorization_mode="sync")
    with flying(2, 2, env="CartPole-v1") as (remote, _), closing(local):
        assert_same(remote.reset(seed=3), local.reset(seed=3))
        dice = np.random.default_rng(0)
        for _ in range(100):
            actions = dice.integers(2, size=4)
            here, there = remote.step(actions), local.step(actions)
            assert_same((*here[:1], *here[2:]), (*there[:1], *there[2:]))
            # Gymnasium's own are float64 as well; CartPole's are whole.
            assert here[1].tolist() == there[1].tolist()
            assert here[4] == {}


# ---- Gymnasium's interface


@pytest.mark.parametrize("options", [{}, {"action_type": "discrete", "observation": "error"}])
def test_spaces_and_metadata(options: dict[str, Any]) -> None:
    with flying(2, 2, control_period=0.04, **options) as (remote, _), sync(4, **options) as local:
        remote.reset()
        assert isinstance(remote, VectorEnv)
        assert remote.num_envs == 4
        assert remote.action_space == local.action_space
        assert remote.single_action_space == local.single_action_space
        assert remote.observation_space == batch_space(remote.single_observation_space, 4)
        assert remote.single_observation_space.shape == local.single_observation_space.shape
        assert remote.metadata == {
            "render_modes": [],
            "render_fps": 25,
            "autoreset_mode": AutoresetMode.NEXT_STEP,
        }
        assert remote.render_mode is None
        assert remote.unwrapped is remote
        assert repr(remote) == "RemoteVectorEnv(num_envs=4)"


def test_what_a_step_gives() -> None:
    with flying(2, 2) as (remote, _):
        observations, info = remote.reset(seed=0)
        for _ in range(20):
            assert observations in remote.observation_space
            assert observations.dtype == np.float32
            for name in NAMES:
                assert (info[name].dtype, info[name].shape) == (np.float64, (4,))
                assert (info[f"_{name}"].dtype, info[f"_{name}"].all()) == (bool, True)
            observations, *arrays, info = remote.step(remote.action_space.sample())
            assert [a.dtype for a in arrays] == [np.float64, bool, bool]
            assert [a.shape for a in arrays] == [(4,)] * 3


def test_what_a_step_gives_is_the_callers() -> None:
    with flying(1, 2) as (remote, _), sync(2) as local:
        assert_same(remote.reset(seed=0), local.reset(seed=0))
        for _ in range(5):
            here, there = remote.step(np.ones((2, 1))), local.step(np.ones((2, 1), np.float32))
            assert_same(here, there)
            for array in (*here[:4], *here[4].values()):
                array[...] = 1  # changes nothing of the next step, nor of another array
            assert here[0].sum() == 6


def test_the_first_simulator_says_how_many_drones_there_are() -> None:
    with plain_socket() as sock:
        address = sock.getsockname()
    running = [
        Running(Simulator(server=address, bind=ANY, num_envs=3, config=QUICK)) for _ in range(2)
    ]
    with closing(RemoteVectorEnv(address, num_simulators=2)) as remote:
        assert (remote.num_envs, remote.num_simulators) == (6, 2)
        assert remote.observation_space.shape == (6, 3)
        assert remote.statistics.counters["sessions"] == 2
        sentence = f"127.0.0.1:{address[1]} refused: expected a simulator of 3 drones, got one of 2"
        error = simulate(remote, num_envs=2)
        remote.reset()
        for _ in range(50):
            remote.step(np.zeros((6, 1)))
            time.sleep(0.01)
        assert isinstance(error.join(), Refused)
        assert sentence in str(error.result)
    assert [one.join() for one in running] == ["the agent closed"] * 2


def test_seeded_spaces_stay_seeded() -> None:
    with flying(1, 2) as (remote, _):
        samples = []
        for _ in range(2):
            remote.action_space.seed(3)
            remote.reset()
            samples.append(remote.action_space.sample().tolist())
        assert samples[0] == samples[1]


def test_a_forgotten_env_tells_its_simulators() -> None:
    remote = RemoteVectorEnv(ANY, num_simulators=2, num_envs=2, connect=False)
    running = [simulate(remote) for _ in range(2)]
    remote.reset()
    del remote
    assert [one.join() for one in running] == ["the agent closed"] * 2


# ---- what the caller does wrong


def test_steps_at_the_wrong_time() -> None:
    actions = np.zeros((2, 1))
    with flying(1, 2) as (remote, _):
        with pytest.raises(gym.error.ResetNeeded, match="step: expected a call of reset"):
            remote.step(actions)
        remote.reset()
        remote.step(actions)
        remote.close()
        remote.close()
        with pytest.raises(gym.error.ResetNeeded):
            remote.step(actions)
        with pytest.raises(gym.error.ClosedEnvironmentError, match="expected an open env"):
            remote.reset()


@pytest.mark.parametrize(
    ("actions", "sentence"),
    [
        (np.zeros(4), r"actions: expected an array of shape \(4, 1\), got shape \(4,\)"),
        (np.zeros((2, 1)), r"actions: expected an array of shape \(4, 1\), got shape \(2, 1\)"),
        (0.0, r"actions: expected an array of shape \(4, 1\), got shape \(\)"),
        ([[0.0], [0.0], [0.0], [np.nan]], "action: expected finite numbers"),
        ([[0.0], [0.0], [np.inf], [0.0]], "action: expected finite numbers"),
        ([[0.0], [0.0], [1e300], [0.0]], "action: expected finite numbers"),
    ],
)
def test_wrong_actions_raise_and_nothing_has_happened(actions: Any, sentence: str) -> None:
    with flying(2, 2) as (remote, _), sync(4) as local:
        assert_same(remote.reset(seed=1), local.reset(seed=1))
        sent = remote.statistics.counters["sent"]
        with pytest.raises(ValueError, match=sentence):
            remote.step(actions)
        assert remote.statistics.counters["sent"] == sent
        good = np.full((4, 1), 0.5, np.float32)
        assert_same(remote.step(good), local.step(good))


def test_wrong_discrete_actions() -> None:
    with flying(1, 2, action_type="discrete") as (remote, _):
        remote.reset()
        for actions in ([0, 3], [-1, 0], [0.5, 1], [np.nan, 1]):
            with pytest.raises(ValueError, match="actions: expected whole numbers 0 to 2, got"):
                remote.step(np.array(actions))
        remote.step(np.array([0, 2]))


@pytest.mark.parametrize("seed", [-1, 2**64 - 3, [1, 2, 3], [1, 2, 3, -1], [1, 2, 3, 2**64],
                                  [1, 2, 3, 0.5], [1, 2, 3, None], 0.5, "1234"])  # fmt: skip
def test_wrong_seeds(seed: Any) -> None:
    with flying(2, 2) as (remote, _):
        remote.reset(seed=[0, 2**64 - 1, 5, 5])
        sent = remote.statistics.counters["sent"]
        sentence = r"seed: expected a whole number from 0 to 2\^64 - 1, or 4 of them, got"
        with pytest.raises(ValueError, match=sentence):
            remote.reset(seed=seed)
        with pytest.raises(
            ValueError, match="options: expected reset_mask or none over UDP, got 'target'"
        ):
            remote.reset(options={"target": 5.0})
        assert remote.statistics.counters["sent"] == sent
        remote.reset(seed=2**64 - 4)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"num_simulators": 0}, "num_simulators: expected 1 or more, got 0"),
        ({"num_envs": 0}, "num_envs: expected a multiple of num_simulators = 1, got 0"),
        (
            {"num_simulators": 2, "num_envs": 5},
            "num_envs: expected a multiple of num_simulators = 2, got 5",
        ),
        ({"connect": False}, "num_envs: expected a number with connect=False, got None"),
        ({"timeout": 0}, "timeout: expected seconds > 0, got 0"),
        ({"options": {"wind": 1}}, "options: expected some of target, .*, got 'wind'"),
        ({"address": ("0.0.0.0", 0)}, "0.0.0.0 is not a loopback address"),
        ({"key_file": "/nowhere/key"}, "key file: cannot read /nowhere/key"),
    ],
)
def test_wrong_arguments(arguments: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=f"^{sentence}"):
        RemoteVectorEnv(**{"address": ANY, **arguments})


# ---- autoreset


@pytest.mark.parametrize("drones", [1, 3])
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_autoreset_is_that_of_the_local_env(mode: str, drones: int) -> None:
    options: dict[str, Any] = {"episode_length": 12, "flight_band": 1.3}
    local = ElevationVectorEnv(2 * drones, autoreset_mode=mode, **options)
    with flying(2, drones, autoreset=mode, **options) as (remote, _):
        assert remote.metadata["autoreset_mode"] == local.metadata["autoreset_mode"]
        assert_same(remote.reset(seed=4), local.reset(seed=4))
        dice, ended = np.random.default_rng(2), 0
        for _ in range(80):
            actions = dice.uniform(-1, 1, (2 * drones, 1)).astype(np.float32)
            here, there = remote.step(actions), local.step(actions)
            assert_same(here, there)
            assert ("final_obs" in here[4]) == ("final_obs" in there[4])
            if "final_obs" in here[4]:
                flags = there[4]["_final_obs"]
                ended += flags.sum()
                for name in ("final_obs", "_final_obs"):
                    assert here[4][name].tobytes() == there[4][name].tobytes()
                finals = here[4]["final_info"], there[4]["final_info"]
                for name in NAMES:
                    assert finals[0][name][flags].tobytes() == finals[1][name][flags].tobytes()
                    assert (finals[0][f"_{name}"] == flags).all()
        assert (ended > 0) == (mode == "SameStep")


def test_a_mask_resets_some_and_the_others_hold() -> None:
    local = ElevationVectorEnv(4, autoreset_mode="Disabled")
    with flying(2, 2, autoreset="Disabled") as (remote, _):
        assert_same(remote.reset(seed=1), local.reset(seed=1))
        dice = np.random.default_rng(0)
        for number in range(20):
            actions = dice.uniform(-1, 1, (4, 1)).astype(np.float32)
            assert_same(remote.step(actions), local.step(actions))
            mask = np.array([[True, False, False, False], [False, True, True, False]][number % 2])
            masked = [
                env.reset(seed=[number, 1, 2, 3], options={"reset_mask": mask.copy()})
                for env in (remote, local)
            ]
            assert_same(*masked)
            assert (masked[0][1]["_Y"] == mask).all()
        with pytest.raises(ValueError, match="reset_mask: expected an array of 4 bool"):
            remote.reset(options={"reset_mask": np.zeros(4, bool)})


def test_who_has_ended_and_holds_is_not_forgotten() -> None:
    options: dict[str, Any] = {"start_band": 0.3, "flight_band": 0.4}
    local = ElevationVectorEnv(2, **options)
    with flying(1, 2, **options) as (remote, _):
        assert_same(remote.reset(seed=1), local.reset(seed=1))
        actions = np.array([[1.0], [0.0]], np.float32)
        while not local.over.any():
            assert_same(remote.step(actions), local.step(actions))
        assert local.over.tolist() == [True, False]
        others = {"reset_mask": np.array([False, True])}
        assert_same(remote.reset(seed=7, options=others), local.reset(seed=7, options=others))
        for _ in range(3):  # the first resets drone 0
            assert_same(remote.step(actions), local.step(actions))


def test_a_step_after_the_end_without_autoreset_changes_nothing() -> None:
    with flying(1, 2, autoreset="Disabled", episode_length=2) as (remote, _):
        remote.reset(seed=0)
        hold = np.zeros((2, 1), np.float32)
        remote.step(hold)
        assert remote.step(hold)[3].all()
        with pytest.raises(gym.error.ResetNeeded, match="for env 0 first"):
            remote.step(hold)
        remote.reset(options={"reset_mask": np.ones(2, bool)})
        assert not remote.step(hold)[3].any()


def test_states_larger_than_the_systems_buffer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rotorgram.udp.sockets._BUFFER", 212_992)  # Linux's own limit
    local = ElevationVectorEnv(5000)
    with flying(1, 5000) as (remote, _):
        assert_same(remote.reset(seed=1), local.reset(seed=1))
        actions = np.full((5000, 1), 0.1, np.float32)
        for _ in range(3):
            assert_same(remote.step(actions), local.step(actions))


def test_an_env_of_others_is_held_too() -> None:
    with flying(1, 2, env="CartPole-v1", autoreset="SameStep") as (remote, _):
        remote.reset(seed=0)
        push = np.array([1, 0])
        for _ in range(60):
            observations, _, terminated, _, info = remote.step(push)
            if terminated.any():
                assert (info["_final_obs"] == terminated).all()
                assert (abs(observations[terminated]) < 0.05).all()
                push = push[::-1]
        assert remote.statistics.counters["resent"] == 0


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
    config = LinkConfig(timeout=0.5, first_resend=0.05, max_resend=0.1)
    with flying(2, 2) as (remote, running):
        remote.reset(seed=3)
        late = simulate(remote, config, num_envs=2)
        start = time.monotonic()
        while time.monotonic() - start < 1:
            remote.step(np.zeros((4, 1)))
            time.sleep(0.02)
        assert late.simulator.link.state == "hello"
        assert late.simulator.link.statistics.counters["refused"] == 0
        assert "every place at the agent is taken; waiting for a free one" in caplog.text
        running[0].cut()
        remote._server.config = replace(remote._server.config, timeout=0.3)
        *_, truncated, info = remote.step(np.zeros((4, 1)))
        assert truncated.sum() == 2
        assert late.simulator.link.state == "waiting"
        reason = info["simulator_lost"][truncated][0]
        assert reason.startswith("no datagram from the simulator at 127.0.0.1:")
        remote.step(np.zeros((4, 1)))
    assert late.join() == "the agent closed"


def test_a_stranger_is_told_to_wait_with_no_more_bytes_than_he_sent() -> None:
    with flying(1, 2) as (remote, _), plain_socket() as stranger:
        remote.reset()
        hello = describe(make_env(ENV_ID, {}), 2)
        stranger.sendto(binary.encode(hello), remote.address)
        answer = b""
        stranger.setblocking(False)
        until = time.monotonic() + 5
        while not answer and time.monotonic() < until:
            remote.step(np.zeros((2, 1)))
            try:
                answer = stranger.recv(65507)
            except BlockingIOError:
                time.sleep(0.01)
        message = binary.decode(answer)
        assert isinstance(message, Wait)
        assert message.session == hello.session
        assert len(answer) <= len(binary.encode(hello))


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


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"num_envs": 1}, "expected a simulator of 2 drones, got one of 1"),
        ({"num_envs": 3}, "expected a simulator of 2 drones, got one of 3"),
        ({"num_envs": 2, "env": "CartPole-v1"}, f"expected a simulator of {ENV_ID}, got one of"),
        ({"num_envs": 2, "linear_drag": 0.5}, "expected linear_drag 0.0, got 0.5"),
        ({"num_envs": 2, "observation": "error"}, "expected observation 'full', got 'error'"),
    ],
)
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
        assert sock.recv(1024) == b"1,close"
    remote.close()


def test_text_simulators_fly_as_well() -> None:
    remote = RemoteVectorEnv(ANY, num_simulators=2, num_envs=2, connect=False)
    running = [simulate(remote, codec="text") for _ in range(2)]
    with closing(remote), sync(2) as local:
        assert_same(remote.reset(seed=2), local.reset(seed=2))
        assert assert_parity(remote, local, 300) >= 2
    assert [one.join() for one in running] == ["the agent closed"] * 2


# ---- lost simulators


class Failing(gym.Wrapper):
    """Raises when it is told to."""

    fails = False

    def step(self, action: Any) -> Any:
        if self.fails:
            raise RuntimeError("out of fuel")
        return super().step(action)


def test_all_simulators_close() -> None:
    envs = [Failing(gym.make(ENV_ID, disable_env_checker=True)) for _ in range(2)]
    remote = RemoteVectorEnv(ANY, num_simulators=2, num_envs=2, connect=False, connect_timeout=5)
    running = [simulate(remote, env=env) for env in envs]
    actions = np.zeros((2, 1))
    remote.reset(seed=0)
    remote.step(actions)
    for env in envs:
        env.fails = True
    sentence = r"the simulator at 127.0.0.1:\d+ closed: RuntimeError: out of fuel"
    with pytest.raises(PeerClosed, match=sentence):
        remote.step(actions)
    with pytest.raises(gym.error.ResetNeeded):
        remote.step(actions)
    assert [str(one.join()) for one in running] == ["out of fuel"] * 2
    running = [simulate(remote) for _ in envs]  # a reset waits for others
    with sync(2) as local:
        assert_same(remote.reset(seed=0), local.reset(seed=0))
        assert_parity(remote, local, 10)
    remote.close()
    assert [one.join() for one in running] == ["the agent closed"] * 2


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
    remote = RemoteVectorEnv(
        ANY, num_simulators=3, num_envs=6, connect=False, timeout=10 if same else 0.5
    )
    with ExitStack() as stack:
        stack.callback(remote.close)

        def start(bind: tuple[str, int] = ANY) -> Any:
            arguments = {"server": remote.address, "bind": bind, "num_envs": 2, **options}
            process = launch(SIMULATE, json.dumps(arguments))
            stack.callback(process.communicate)
            stack.callback(process.kill)
            return process

        processes = [start() for _ in range(3)]
        ports = [int(process.stdout.readline()) for process in processes]
        local = stack.enter_context(sync(6, **options))
        assert_same(remote.reset(seed=6), local.reset(seed=6))
        assert assert_parity(remote, local, 65) == 6
        place = 1
        session = remote._server.link.places[place]
        assert session is not None
        port = session.peer[1]
        if how == "another waits":
            processes.append(start())
            assert processes[3].stdout.readline()
        victim = processes.pop(ports.index(port))
        before = local.step(np.zeros((6, 1), np.float32))
        assert_same(remote.step(np.zeros((6, 1))), before)
        victim.kill()
        victim.wait()
        if how != "another waits":
            processes.append(start(("127.0.0.1", port) if same else ANY))
        drones, others = slice(2, 4), np.array([0, 1, 4, 5])
        actions = np.full((6, 1), 0.3, np.float32)
        here, there = remote.step(actions), local.step(actions)
        assert_same(here, there, others)
        assert_same((here[0], here[-1]), (before[0], before[-1]), drones)
        assert here[1][drones].tolist() == [0.0, 0.0]
        assert here[2].tolist() == [False] * 6
        assert here[3].tolist() == [False, False, True, True, False, False]
        assert here[4]["_simulator_lost"].tolist() == here[3].tolist()
        reasons = here[4]["simulator_lost"].tolist()
        assert reasons[2] == reasons[3]
        assert reasons[:2] == reasons[4:] == [None, None]
        if same:
            assert reasons[2] == f"the simulator at 127.0.0.1:{port} was started anew"
        else:
            sentence = f"no datagram from the simulator at 127.0.0.1:{port} for 0.5 s, waiting at "
            assert reasons[2].startswith(sentence)
        # The others fly on as if nothing had been; the new ones begin with a reset.
        actions = np.full((6, 1), -0.2, np.float32)
        here, there = remote.step(actions), local.step(actions)
        assert_same(here, there, others)
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
        remote.close()
        for process in processes:
            out, err = process.communicate(timeout=10)
            assert process.returncode == 0, err
            assert out.endswith("the agent closed\n")


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

"""One drone over real sockets: parity, the env, strangers, and peers that others wrote."""

import copy
import json
import pickle
import re
import threading
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import rotorgram.envs  # noqa: F401
from gymnasium.utils.env_checker import check_env
from peers import ANY, ENV_ID, QUICK, launch, plain_socket, simulate
from remotes import assert_parity, flying
from rotorgram.udp import (
    RemoteEnv,
    RemoteVectorEnv,
    Simulator,
)
from rotorgram.udp.protocol import binary
from rotorgram.udp.protocol.messages import Close, Command, State, Welcome
from stable_baselines3.common.env_checker import check_env as sb3_check_env

PAGE = Path(__file__).parents[2] / "docs" / "protocol.md"
SIMULATE = """
    import sys
    from rotorgram.udp import LinkConfig, Simulator
    port, codec = int(sys.argv[1]), sys.argv[2]
    with Simulator(server=("127.0.0.1", port), bind=("127.0.0.1", 0), codec=codec,
                   config=LinkConfig(timeout=20)) as simulator:
        print("over:", simulator.run())
"""


# ---- parity


@pytest.mark.parametrize("codec", ["binary", "text"])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"action_type": "discrete", "observation": "error", "effects": {"linear_drag": 0.5}},
        {"target": (4.0, 6.0), "episode_length": 20, "action": "offset"},
    ],
)
def test_parity(codec: str, options: dict[str, Any]) -> None:
    with flying(codec=codec, **options) as pair:
        local = gym.make(ENV_ID, **options)
        assert_parity(pair.remote, 1000, (0, 2**64 - 1, 7, 0), **options)
        assert pair.remote.observation_space == local.observation_space
        assert pair.remote.action_space == local.action_space
        pair.remote.close()
        assert pair.running.join() == "the agent closed"


# ---- the env


@pytest.mark.parametrize("options", [{}, {"action_type": "discrete"}])
def test_both_checkers_are_content(options: dict[str, Any]) -> None:
    with flying(**options) as pair:
        pair.remote.connect()
        check_env(pair.remote, skip_render_check=True)
        sb3_check_env(pair.remote)


def test_what_the_simulator_says_of_itself() -> None:
    with flying(control_period=0.04, observation="error") as pair:
        pair.remote.connect()
        spec = pair.remote.env_spec
        assert spec == pair.simulator.spec
        assert spec.env_id == ENV_ID
        assert spec.control_period == pair.remote.control_period == 0.04
        assert set(spec.vehicle_hash) != {"0"}
        assert pair.remote.metadata == {"render_modes": [], "render_fps": 25}
        assert pair.remote.observation_space.shape == (1,)


def test_step_before_reset_and_after_the_end_and_after_close() -> None:
    with flying(episode_length=2) as pair:
        remote = pair.remote
        action = np.zeros(1, np.float32)
        with pytest.raises(gym.error.ResetNeeded, match="step: expected a call of reset"):
            remote.step(action)
        remote.reset()
        remote.step(action)
        assert remote.step(action)[3]
        with pytest.raises(gym.error.ResetNeeded):
            remote.step(action)
        remote.close()
        remote.close()
        with pytest.raises(gym.error.ClosedEnvironmentError, match="expected an open env"):
            remote.reset()


def test_wrong_actions_and_seeds_raise_and_nothing_has_happened() -> None:
    with flying() as pair:
        remote = pair.remote
        remote.reset(seed=1)
        sent = remote.statistics.counters["sent"]
        for action, sentence in [
            (np.array([np.nan]), "actions: expected finite numbers"),
            (np.array([np.inf]), "actions: expected finite numbers"),
            (np.zeros(2), r"actions: expected shape \(1,\), got \(2,\)"),
            (0.5, r"actions: expected shape \(1,\), got \(\)"),
        ]:
            with pytest.raises(ValueError, match=sentence):
                remote.step(action)
        for seed in (-1, 2**64):
            with pytest.raises(ValueError, match="seed: expected a whole number from 0 to"):
                remote.reset(seed=seed)
        with pytest.raises(ValueError, match="options: expected none over UDP"):
            remote.reset(options={"start": 1})
        assert remote.statistics.counters["sent"] == sent
        remote.step(np.zeros(1))
    with flying(action_type="discrete") as pair:
        pair.remote.reset()
        for action in (3, -1, 0.5, True):
            with pytest.raises(ValueError, match=r"actions?: expected"):
                pair.remote.step(action)


@pytest.mark.parametrize(
    "make",
    [
        lambda: RemoteEnv(ANY, connect=False),
        lambda: RemoteVectorEnv(ANY, connect=False),
        lambda: Simulator(bind=ANY),
    ],
)
@pytest.mark.parametrize("copies", [copy.copy, copy.deepcopy, pickle.dumps])
def test_no_side_is_copied(make: Any, copies: Any) -> None:
    """Two would take turns in answering the States of one simulator."""
    env = make()
    with pytest.raises(TypeError, match="cannot be copied or pickled: make another one"):
        copies(env)
    env.close()


def test_observations_are_copies() -> None:
    with flying() as pair:
        first, _ = pair.remote.reset(seed=0)
        bits = first.tobytes()
        second = pair.remote.step(np.ones(1))[0]
        assert first.flags.writeable
        assert first.tobytes() == bits != second.tobytes()


# ---- strangers


def test_strangers_change_nothing_but_counters() -> None:
    dice = np.random.default_rng(1)
    with flying() as pair, plain_socket() as stranger:
        local = gym.make(ENV_ID)
        pair.remote.reset(seed=4)
        local.reset(seed=4)
        hello = pair.simulator.link.hello
        orders = np.ones(1, np.uint8)
        actions = np.zeros((1, 1), np.float32)
        reset = Command(session=hello.session, sequence=3, orders=orders, actions=actions)
        closing = Close(session=hello.session, sequence=2, reason="forged")
        forged = [
            b"",
            b"1,0.5,0,0,1,1,1",
            b"1,close",
            b"3,0.0,0,0,1,1,1," + b"0," * 9 + b"0",
            dice.bytes(65507),
            binary.encode(hello),
            binary.encode(closing),
            binary.encode(reset, pair.simulator.link.layout),
        ]
        for _ in range(50):
            for datagram in forged:
                stranger.sendto(datagram, pair.remote.address)
                stranger.sendto(datagram, pair.simulator.address)
            time.sleep(0.01)  # strangers are looked at so often
            action = dice.uniform(-0.1, 0.1, 1).astype(np.float32)
            here = pair.remote.step(action)
            there = local.step(action)
            assert here[0].tobytes() == there[0].tobytes()
            assert here[1:4] == there[1:4]
        counters = pair.remote.statistics.counters
        assert min(counters[name] for name in ("malformed", "foreign")) > 2
        assert pair.simulator.link.sequence == 52
        counters = pair.simulator.link.statistics.counters
        assert set(counters) <= {"sessions", "sent", "received", "resent", "stale"}
        pair.remote.close()
        assert pair.running.join() == "the agent closed"


def test_welcome_may_seed_the_first_reset() -> None:
    with plain_socket() as sock:
        running = simulate(sock.getsockname())
        datagram, address = sock.recvfrom(65507)
        hello = binary.decode(datagram)
        sock.sendto(binary.encode(Welcome(session=hello.session, nonce=5, seed=0)), address)
        state = binary.decode(sock.recv(65507), running.simulator.link.layout)
        assert state.nonce == 5
        assert isinstance(state, State)
        expected, _ = gym.make(ENV_ID).reset(seed=0)
        assert state.observations[0][0].tobytes() == expected.tobytes()
        close = Close(session=hello.session, sequence=1, reason="seen enough")
        sock.sendto(binary.encode(close), address)
        assert running.join() == "seen enough"


# ---- peers that others wrote


def test_the_text_agent_of_the_page(capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = re.findall(r"```python\n(import socket\n.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    assert len(code.splitlines()) <= 22
    names: dict[str, Any] = {}
    agent = threading.Thread(target=exec, args=(code.replace("8001", "0"), names))
    agent.start()
    while "reply" not in names:  # bound by then
        time.sleep(0.01)
    with Simulator(
        server=names["agent"].getsockname(), bind=ANY, codec="text", config=QUICK
    ) as simulator:
        assert simulator.run() == "the agent closed"
    agent.join(10)
    names["agent"].close()
    match = re.fullmatch(r"250 steps, return ([0-9.]+)\n", capsys.readouterr().out)
    assert match is not None
    assert float(match[1]) > 150  # of 250: it reached the target and held it


TEXT_SIMULATOR = """
    import socket, sys

    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(("127.0.0.1", 0))
    sock.settimeout(0.5)
    agent = ("127.0.0.1", int(sys.argv[1]))
    elevation, rate, thrust, sequence = 5.0, 0.0, 49.0, 1
    while True:
        seen = [5.0 - elevation, -rate, thrust / 49 - 1, 0, elevation, *[0] * 10, *[thrust] * 4,
                0, 5.0, 0, 5.0 - elevation]
        fields = [sequence, 1.0, 0, 0, *seen]
        line = ",".join(map(str, fields)).encode()
        answer = [""]
        while answer[0] != str(sequence):
            try:
                sock.sendto(line, agent)
                answer = sock.recv(1200).decode().split(",")
            except (TimeoutError, ConnectionError):
                pass
        if answer[1] == "close":
            break
        if answer[1] == "reset":
            elevation, rate, thrust = 5.0, 0.0, 49.0
        else:
            thrust += 5 * float(answer[1])
            rate += (4 * thrust / 20 - 9.8) * 0.02
            elevation += rate * 0.02
        sequence += 1
    print("closed after", sequence)
"""


def test_a_text_simulator_that_somebody_else_wrote() -> None:
    with RemoteEnv(ANY, env_id=ENV_ID, connect=False, connect_timeout=10) as remote:
        process = launch(TEXT_SIMULATOR, remote.address[1])
        observation, info = remote.reset(seed=9)
        assert observation.tolist() == [0.0, 0.0, 0.0]
        observation, reward, terminated, truncated, info = remote.step(np.ones(1))
        rate = (4 * 54 / 20 - 9.8) * 0.02
        assert info["z"] == 5.0 + rate * 0.02
        assert info["F4"] == 54.0
        assert observation.tolist() == pytest.approx([-rate * 0.02, -rate, 54 / 49 - 1])
        assert (reward, terminated, truncated) == (1.0, False, False)
    out, err = process.communicate(timeout=10)
    assert out == "closed after 3\n"
    assert err == ""


@pytest.mark.parametrize(
    "wanted", [{}, {"env_id": f"rotorgram.envs:{ENV_ID}", "options": {}}], ids=["any", "fault 5"]
)
def test_the_wire_does_not_load_mujoco_nor_torch(wanted: dict[str, Any]) -> None:
    code = """
        import json, sys
        from rotorgram.udp import RemoteEnv
        env = RemoteEnv(("127.0.0.1", 0), connect=False, **json.loads(sys.argv[1]))
        env.close()
        print([name for name in ("mujoco", "torch", "stable_baselines3") if name in sys.modules])
    """
    out, err = launch(code, json.dumps(wanted)).communicate(timeout=60)
    assert out == "[]\n"
    assert err == ""

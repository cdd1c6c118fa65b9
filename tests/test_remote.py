"""Both sides over real sockets: parity, strangers, silence, and peers that others wrote."""

import errno
import gc
import json
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import rotorgram.envs  # noqa: F401
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from peers import ANY, ENV_ID, Running, launch, plain_socket
from rotorgram.udp import (
    LinkConfig,
    LinkError,
    PeerClosed,
    PeerSilent,
    Refused,
    RemoteEnv,
    Simulator,
    binary,
    sockets,
)
from rotorgram.udp.__main__ import parse_arguments
from rotorgram.udp.fleet import describe
from rotorgram.udp.messages import Close, Command, Hello, Refuse, State, Welcome
from stable_baselines3.common.env_checker import check_env as sb3_check_env

PAGE = Path(__file__).parent.parent / "docs" / "protocol.md"
QUICK = LinkConfig(timeout=5)
WAYS_OUT = (
    r"0\.0\.0\.0 is not a loopback address: expected 127\.0\.0\.1, or a key that both sides share "
    r"\(key_file, --key-file\), or insecure=True \(--insecure\)"
)
SIMULATE = """
    import sys
    from rotorgram.udp import LinkConfig, Simulator
    port, codec = int(sys.argv[1]), sys.argv[2]
    with Simulator(server=("127.0.0.1", port), bind=("127.0.0.1", 0), codec=codec,
                   config=LinkConfig(timeout=20)) as simulator:
        print("over:", simulator.run())
"""


@contextmanager
def flying(env: Any = ENV_ID, codec: Any = "binary", **options: Any) -> Iterator[SimpleNamespace]:
    """A RemoteEnv, and a simulator for it in a thread."""
    remote_options = options if codec == "text" else None
    remote = RemoteEnv(ANY, connect=False, options=remote_options, timeout=5, connect_timeout=5)
    simulator = Simulator(
        env, server=remote.address, bind=ANY, codec=codec, config=QUICK, **options
    )
    running = Running(simulator)
    try:
        yield SimpleNamespace(remote=remote, simulator=simulator, running=running)
    finally:
        remote.close()
        running.join()


# ---- parity


def assert_parity(remote: gym.Env, local: gym.Env, steps: int, seeds: list[int]) -> None:
    """The same seeds and actions give the same bits."""
    dice = np.random.default_rng(5)
    names = local.unwrapped.telemetry_names

    def same(here: tuple, there: tuple) -> None:
        assert here[0].tobytes() == there[0].tobytes()
        assert here[0].dtype == there[0].dtype
        assert here[1:-1] == there[1:-1]
        assert [type(v) for v in here[1:-1]] == [type(v) for v in there[1:-1]]
        assert {name: there[-1][name] for name in names} == here[-1]

    same(remote.reset(seed=seeds[0]), local.reset(seed=seeds[0]))
    ends = 0
    for _ in range(steps):
        if isinstance(local.action_space, spaces.Discrete):
            action: Any = int(dice.integers(3))
        else:
            action = dice.uniform(-1.2, 1.2, 1).astype(np.float32)
        here, there = remote.step(action), local.step(action)
        same(here, there)
        if here[2] or here[3]:
            ends += 1
            seed = seeds[ends] if ends < len(seeds) else None
            same(remote.reset(seed=seed), local.reset(seed=seed))
    assert ends >= len(seeds)


@pytest.mark.parametrize("codec", ["binary", "text"])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"action_type": "discrete", "observation": "error", "linear_drag": 0.5},
        {"target": (4.0, 6.0), "episode_length": 20, "action_mode": "offset"},
    ],
)
def test_parity(codec: str, options: dict[str, Any]) -> None:
    with flying(codec=codec, **options) as pair:
        local = gym.make(ENV_ID, **options)
        assert_parity(pair.remote, local, 1000, [0, 2**64 - 1, 7, 0])
        assert pair.remote.observation_space == local.observation_space
        assert pair.remote.action_space == local.action_space
        pair.remote.close()
        assert pair.running.join() == "the agent closed"


@pytest.mark.parametrize("codec", ["binary", "text"])
def test_parity_with_a_simulator_in_another_process(codec: str) -> None:
    with RemoteEnv(ANY, connect=False, connect_timeout=20) as remote:
        process = launch(SIMULATE, remote.address[1], codec)
        assert_parity(remote, gym.make(ENV_ID), 1000, [0, 2**64 - 1])
    out, err = process.communicate(timeout=10)
    assert (process.returncode, err) == (0, "")
    assert out == "over: the agent closed\n"


def test_another_env_of_gymnasium_flies_too() -> None:
    remote = RemoteEnv(ANY, env_id="CartPole-v1", connect=False)
    running = Running(Simulator("CartPole-v1", server=remote.address, bind=ANY))
    with remote, gym.make("CartPole-v1") as local:
        assert remote.reset(seed=3)[0].tobytes() == local.reset(seed=3)[0].tobytes()
        assert remote.action_space == local.action_space
        assert remote.metadata["render_fps"] == 50
        here, there = remote.step(1), local.step(1)
        assert here[0].tobytes() == there[0].tobytes()
        assert here[1:4] == there[1:4]
    assert running.join() == "the agent closed"


# ---- the env


@pytest.mark.parametrize("options", [{}, {"action_type": "discrete"}])
def test_both_checkers_are_content(options: dict[str, Any]) -> None:
    with flying(**options) as pair:
        check_env(pair.remote, skip_render_check=True)
        sb3_check_env(pair.remote)


def test_what_the_simulator_says_of_itself() -> None:
    with flying(control_period=0.04, observation="error") as pair:
        pair.remote.connect()
        hello = pair.remote.hello
        assert hello is not None
        assert hello.env_id == ENV_ID
        assert hello.control_period == 0.04
        assert hello.model_hash == pair.simulator.fleet.env.unwrapped.model_hash
        assert set(hello.model_hash) != {"0"}
        assert pair.remote.metadata == {"render_modes": [], "render_fps": 25}
        assert pair.remote.observation_space.shape == (1,)


def test_step_before_reset_and_after_the_end_and_after_close() -> None:
    with flying(episode_length=2) as pair:
        remote, action = pair.remote, np.zeros(1, np.float32)
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
            (np.array([np.nan]), "action: expected finite numbers"),
            (np.array([np.inf]), "action: expected finite numbers"),
            (np.zeros(2), r"action: expected an array of shape \(1,\), got shape \(2,\)"),
            (0.5, r"expected an array of shape \(1,\), got shape \(\)"),
        ]:
            with pytest.raises(ValueError, match=sentence):
                remote.step(action)
        for seed in (-1, 2**64):
            with pytest.raises(ValueError, match="seed: expected 0 to"):
                remote.reset(seed=seed)
        with pytest.raises(ValueError, match="options: expected none over UDP"):
            remote.reset(options={"start": 1})
        assert remote.statistics.counters["sent"] == sent
        remote.step(np.zeros(1))
    with flying(action_type="discrete") as pair:
        pair.remote.reset()
        for action in (3, -1, 0.5):
            with pytest.raises(ValueError, match="action: expected a whole number 0 to 2"):
                pair.remote.step(action)


def test_observations_are_copies() -> None:
    with flying() as pair:
        first, _ = pair.remote.reset(seed=0)
        bits = first.tobytes()
        second = pair.remote.step(np.ones(1))[0]
        assert first.flags.writeable
        assert first.tobytes() == bits != second.tobytes()


# ---- silence and ends


def test_no_simulator_comes() -> None:
    start = time.monotonic()
    with pytest.raises(PeerSilent, match=r"no simulator came to 127.0.0.1:\d+ for 0.2 s"):
        RemoteEnv(ANY, connect_timeout=0.2)
    assert time.monotonic() - start < 2


def test_nothing_listens() -> None:
    with plain_socket() as sock:
        port = sock.getsockname()[1]
    for codec, what in (("binary", "Hello"), ("text", "State 1")):
        with Simulator(
            server=("127.0.0.1", port), bind=ANY, codec=codec, config=LinkConfig(timeout=0.5)
        ) as simulator:
            with pytest.raises(PeerSilent) as caught:
                simulator.run()
            with pytest.raises(ValueError, match="run: expected one call"):
                simulator.run()
        assert re.fullmatch(
            rf"no answer from the agent at 127.0.0.1:{port} for 0.5 s, {what} sent \d+ times; "
            "nothing listens on that port",
            str(caught.value),
        )


def test_an_agent_that_hears_but_never_answers() -> None:
    with plain_socket() as sock:
        simulator = Simulator(
            server=sock.getsockname(), bind=ANY, config=LinkConfig(timeout=0.3, first_resend=0.1)
        )
        running = Running(simulator)
        error = running.join()
        assert isinstance(error, PeerSilent)
        sends = int(re.findall(r"for 0.3 s, Hello sent (\d+) times", str(error))[0])
        datagrams = [sock.recv(65507) for _ in range(sends)]
        sock.setblocking(False)
        with pytest.raises(BlockingIOError):  # who was not welcome does not take leave
            sock.recv(65507)
    assert len(set(datagrams)) == 1
    assert isinstance(binary.decode(datagrams[0]), Hello)


def test_an_agent_that_falls_silent_is_told() -> None:
    with plain_socket() as sock:
        simulator = Simulator(
            server=sock.getsockname(), bind=ANY, config=LinkConfig(timeout=0.3, first_resend=0.1)
        )
        running = Running(simulator)
        hello, address = sock.recvfrom(65507)
        welcome = Welcome(session=binary.decode(hello).session)
        sock.sendto(binary.encode(welcome), address)
        error = running.join()
        assert isinstance(error, PeerSilent)
        sends = int(re.findall(r"for 0.3 s, State 1 sent (\d+) times", str(error))[0])
        states = [sock.recv(65507) for _ in range(sends)]
        goodbyes = [sock.recv(65507) for _ in range(5)]  # of ten: nobody answers
    assert len(set(states)) == len(set(goodbyes)) == 1
    goodbye = binary.decode(goodbyes[0])
    assert isinstance(goodbye, Close)
    assert goodbye.reason == "no answer from the agent for 0.3 s"


def test_a_flood_of_junk_does_not_extend_either_wait() -> None:
    stop = threading.Event()

    def flood(sock: socket.socket, target: Any) -> None:
        while not stop.is_set():
            sock.sendto(b"junk", target)
            time.sleep(1e-4)

    with plain_socket() as sock, plain_socket() as stranger:
        simulator = Simulator(server=sock.getsockname(), bind=ANY, config=LinkConfig(timeout=0.5))
        remote = RemoteEnv(ANY, connect=False, connect_timeout=0.5)
        threads = [
            threading.Thread(target=flood, args=pair)
            for pair in ((sock, simulator.address), (stranger, remote.address))
        ]
        for thread in threads:
            thread.start()
        start = time.monotonic()
        try:
            with pytest.raises(PeerSilent, match="last datagram dropped: malformed"):
                simulator.run()
            with pytest.raises(PeerSilent, match="last datagram dropped: malformed from 127"):
                remote.connect()
        finally:
            stop.set()
            for thread in threads:
                thread.join()
        assert time.monotonic() - start < 4
        assert simulator.link.statistics.counters["malformed"] > 10
        simulator.close()
        remote.close()


def test_a_wait_may_be_longer_than_the_system_waits_in_one_go(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sockets, "_LONGEST", 0.02)
    start = time.monotonic()
    with pytest.raises(PeerSilent, match=r"for 0\.2 s"):
        RemoteEnv(ANY, connect_timeout=0.2)
    assert 0.2 <= time.monotonic() - start < 2
    with sockets.open_socket(ANY, insecure=False) as sock, pytest.raises(TimeoutError):
        sockets.receive(sock, 1e300)


class Interrupted(socket.socket):
    def settimeout(self, value: float | None) -> None:
        super().settimeout(value)
        raise KeyboardInterrupt


def test_an_interrupted_wait_leaves_the_socket_as_it_was() -> None:
    with Interrupted(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(ANY)
        sock.setblocking(False)
        with pytest.raises(KeyboardInterrupt):
            sockets.receive(sock, 0.1)
        assert sock.gettimeout() == 0


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_signals_neither_end_nor_extend_a_wait() -> None:
    before = signal.signal(signal.SIGALRM, lambda *_: None)
    try:
        with sockets.open_socket(ANY, insecure=False) as sock:
            signal.setitimer(signal.ITIMER_REAL, 0.005, 0.005)
            start = time.monotonic()
            with pytest.raises(TimeoutError):
                sockets.receive(sock, 0.1)
            assert 0.1 <= time.monotonic() - start < 1
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def test_empty_and_largest_datagrams_are_counted_and_dropped() -> None:
    with RemoteEnv(ANY, connect=False, connect_timeout=0.1) as remote, plain_socket() as sock:
        for datagram in (b"", bytes(65507)):
            sock.sendto(datagram, remote.address)
            with pytest.raises(PeerSilent, match="last datagram dropped: malformed"):
                remote.connect()
        assert remote.statistics.counters == {"received": 2, "malformed": 2}


def test_no_way_to_the_agent_is_like_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    errors = [OSError(errno.EHOSTUNREACH, "No route to host")]  # a firewall rejects, for example

    def receive(sock: socket.socket, timeout: float) -> Any:
        if errors:
            raise errors.pop()
        return sockets.receive(sock, timeout)

    monkeypatch.setattr("rotorgram.udp.simulator.receive", receive)
    with plain_socket() as sock:
        address = sock.getsockname()
        with Simulator(server=address, bind=ANY, config=LinkConfig(timeout=0.3)) as simulator:
            sentence = r"Hello sent \d times; receiving failed: No route to host"
            with pytest.raises(PeerSilent, match=sentence):
                simulator.run()


def test_closed_by_another_thread_while_it_waits() -> None:
    remote = RemoteEnv(ANY, connect=False, connect_timeout=0.3)
    closing = threading.Timer(0.05, remote.close)
    closing.start()
    with pytest.raises(gym.error.ClosedEnvironmentError, match="the env was closed"):
        remote.connect()
    closing.join()
    with plain_socket() as sock:
        simulator = Simulator(server=sock.getsockname(), bind=ANY, config=QUICK)
        closing = threading.Timer(0.05, simulator.close)
        closing.start()
        with pytest.raises(OSError) as caught:
            simulator.run()
        assert caught.value.errno == errno.EBADF
        closing.join()


def test_a_simulator_that_falls_silent() -> None:
    with RemoteEnv(ANY, connect=False, connect_timeout=1, timeout=0.5) as remote:
        running = Running(Simulator(server=remote.address, bind=ANY, config=QUICK))
        remote.reset(seed=0)
        running.cut()
        gone = (
            r"no datagram from the simulator at 127.0.0.1:\d+ for 0.5 s, "
            r"waiting at 127.0.0.1:\d+ for State 3"
        )
        start = time.monotonic()
        with pytest.raises(PeerSilent, match=rf"^{gone}; no other came to 127.0.0.1:\d+ for 1 s$"):
            remote.step(np.zeros(1))
        assert 1.5 <= time.monotonic() - start < 2.5
        with pytest.raises(gym.error.ResetNeeded):
            remote.step(np.zeros(1))
        with pytest.raises(PeerSilent, match=f"^{gone}; no other came"):  # a reset waits again
            remote.reset()
        running = Running(Simulator(server=remote.address, bind=ANY, config=QUICK))
        local = gym.make(ENV_ID)
        assert remote.reset(seed=3)[0].tobytes() == local.reset(seed=3)[0].tobytes()
    assert running.join() == "the agent closed"


def test_a_reset_after_a_close_waits_for_another_simulator() -> None:
    with RemoteEnv(ANY, connect=False, connect_timeout=0.5) as remote:
        for _ in range(2):
            running = Running(Simulator(Broken(None), server=remote.address, bind=ANY))
            remote.reset()
            remote.step(np.zeros(1))
            remote.step(np.zeros(1))
            with pytest.raises(PeerClosed, match="RuntimeError: bad state"):
                remote.step(np.zeros(1))
            with pytest.raises(gym.error.ResetNeeded):
                remote.step(np.zeros(1))
            running.join()
        sentence = r"closed: RuntimeError: bad state x+; no other came to 127.0.0.1:\d+ for 0.5 s$"
        with pytest.raises(PeerSilent, match=sentence):
            remote.reset()


def test_a_simulator_that_is_started_anew_at_the_same_address() -> None:
    with RemoteEnv(ANY, connect=False, timeout=10) as remote:
        running = Running(Simulator(server=remote.address, bind=ANY, config=QUICK))
        remote.reset(seed=0)
        before = remote.step(np.ones(1))
        here = running.simulator.address
        running.cut()
        running = Running(Simulator(server=remote.address, bind=here, config=QUICK))
        after = remote.step(np.ones(1))
        assert after[0].tobytes() == before[0].tobytes()
        assert after[1:4] == (0.0, False, True)
        reason = f"the simulator at 127.0.0.1:{here[1]} was started anew"
        assert after[4] == {**before[4], "simulator_lost": reason}
        with pytest.raises(gym.error.ResetNeeded):
            remote.step(np.ones(1))
        local = gym.make(ENV_ID)
        assert_parity(remote, local, 300, [5])
        running.cut()  # the next reset meets the new one
        running = Running(Simulator(server=remote.address, bind=here, config=QUICK))
        assert_parity(remote, local, 300, [6])
        assert remote.statistics.counters["sessions"] == 3
    assert running.join() == "the agent closed"


def test_a_second_simulator_waits_until_the_first_has_left(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with RemoteEnv(ANY, connect=False, timeout=5) as remote:
        first = Running(Simulator(Broken(None), server=remote.address, bind=ANY, config=QUICK))
        remote.reset()
        # Its timeout is shorter than the wait: it does not run while the agent says Wait.
        config = LinkConfig(timeout=0.6, first_resend=0.05, max_resend=0.2)
        second = Running(Simulator(Broken(0.0), server=remote.address, bind=ANY, config=config))
        until = time.monotonic() + 1.2
        while time.monotonic() < until:
            remote.reset()
            time.sleep(0.02)
        remote.step(np.zeros(1))
        remote.step(np.zeros(1))
        with pytest.raises(PeerClosed, match="bad state"):
            remote.step(np.zeros(1))
        remote.reset()
        remote.step(np.zeros(1))
        assert remote.statistics.counters["refused"] == 0
        first.join()
    assert second.join() == "the agent closed"
    assert "every place at the agent is taken; waiting for a free one" in caplog.text


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_the_simulator_program_ends_on_sigterm_and_tells_the_agent() -> None:
    with RemoteEnv(ANY, connect=False, connect_timeout=20, timeout=10) as remote:
        arguments = json.dumps({"server": remote.address, "bind": ANY})
        process = subprocess.Popen([sys.executable, "-m", "rotorgram.udp", arguments])
        remote.reset(seed=0)
        process.send_signal(signal.SIGINT)  # Ctrl-C is for the agent
        remote.step(np.zeros(1))
        process.send_signal(signal.SIGTERM)
        with pytest.raises(PeerClosed, match="closed: the simulator was stopped"):
            remote.reset()
        assert process.wait(10) == 128 + signal.SIGTERM


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_ctrl_c_at_the_agent_tells_the_simulator() -> None:
    agent = launch(
        """
        import time
        from rotorgram.udp import RemoteEnv
        env = RemoteEnv(("127.0.0.1", 0), connect=False)
        print(env.address[1], flush=True)
        env.reset()
        print("flying", flush=True)
        time.sleep(60)
        """
    )
    assert agent.stdout is not None
    port = int(agent.stdout.readline())
    running = Running(Simulator(server=("127.0.0.1", port), bind=ANY, config=QUICK))
    assert agent.stdout.readline() == "flying\n"
    agent.send_signal(signal.SIGINT)
    _, err = agent.communicate(timeout=10)
    assert "KeyboardInterrupt" in err
    assert running.join() == "the agent closed"


def test_a_forgotten_env_tells_the_simulator() -> None:
    remote = RemoteEnv(ANY, connect=False)
    running = Running(Simulator(server=remote.address, bind=ANY, config=QUICK))
    remote.reset()
    del remote
    gc.collect()
    assert running.join() == "the agent closed"


def test_a_simulator_that_waits_is_told_when_the_agent_closes() -> None:
    with flying() as pair:
        pair.remote.reset()
        waiting = Running(Simulator(server=pair.remote.address, bind=ANY, config=QUICK))
        until = time.monotonic() + 5
        while not waiting.simulator.link.statistics.counters["received"]:
            assert time.monotonic() < until
            pair.remote.reset()
        pair.remote.close()
        error = waiting.join()
        assert isinstance(error, Refused)
        assert str(error).endswith(" refused: the agent closed")


class Broken(gym.Env[np.ndarray, np.ndarray]):
    """Raises, or goes bad, at the third step."""

    observation_space = spaces.Box(-1, 1, (1,), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)
    spec = SimpleNamespace(id=ENV_ID)  # type: ignore[assignment]

    def __init__(self, value: float | None) -> None:
        self.value, self.steps = value, 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return np.zeros(1, np.float32), {}

    def step(self, action: np.ndarray) -> Any:
        self.steps += 1
        if self.steps == 3 and self.value is None:
            raise RuntimeError("bad state\n" + "x" * 600)
        value = self.value if self.steps == 3 else 0.0
        return np.array([value], np.float32), 0.0, False, False, {}


@pytest.mark.parametrize("codec", ["binary", "text"])
@pytest.mark.parametrize(
    ("value", "sentence"),
    [
        (None, "RuntimeError: bad state x+"),
        (np.nan, "ValueError: observations: expected finite"),
    ],
)
def test_an_env_that_fails(codec: Any, value: float | None, sentence: str) -> None:
    remote = RemoteEnv(
        ANY, connect=False, options={"observation": "error"} if codec == "text" else None
    )
    env = Broken(value)
    if codec == "text":
        env.telemetry_names = remote._names  # type: ignore[attr-defined]
        info = dict.fromkeys(remote._names, 0.0)
        reset, step = env.reset, env.step
        env.reset = lambda **k: (reset(**k)[0], info)  # type: ignore[method-assign]
        env.step = lambda action: (*step(action)[:4], info)  # type: ignore[method-assign]
    running = Running(Simulator(env, server=remote.address, bind=ANY, codec=codec, config=QUICK))
    remote.reset()
    remote.step(np.zeros(1))
    remote.step(np.zeros(1))
    if codec == "text":
        sentence = "the simulator closed"
    with pytest.raises(PeerClosed, match=f"the simulator at .* closed: {sentence}"):
        remote.step(np.zeros(1))
    assert isinstance(running.join(), RuntimeError if value is None else ValueError)
    remote.close()


def test_an_agent_that_flies_on_after_the_end() -> None:
    with plain_socket() as sock:
        simulator = Simulator(
            server=sock.getsockname(), bind=ANY, codec="text", config=QUICK, episode_length=1
        )
        running = Running(simulator)
        for sequence in (1, 2):
            line, address = sock.recvfrom(1024)
            sock.sendto(f"{sequence},0.0".encode(), address)
        assert b"2," in line
        assert sock.recv(1024) == b"2,close"
    error = running.join()
    assert isinstance(error, LinkError)
    assert "an action came for drone 0 after the end of its episode: expected a reset" in str(error)


# ---- addresses and options


def test_a_port_in_use() -> None:
    with plain_socket() as sock:
        taken = sock.getsockname()
        sentence = f"cannot bind 127.0.0.1:{taken[1]}: the port is in use: choose another one"
        with pytest.raises(OSError, match=sentence):
            RemoteEnv(taken)
        with pytest.raises(OSError, match=sentence):
            Simulator(server=("127.0.0.1", 8001), bind=taken)


@pytest.mark.parametrize(
    ("address", "sentence"),
    [
        (("0.0.0.0", 0), WAYS_OUT),
        (("192.0.2.1", 0), "192.0.2.1 is not a loopback address"),
        (("127.0.0.1", 65536), r"address: expected \(host, port from 0 to 65535\), got"),
        (("127.0.0.1", "8001"), "address: expected"),
        (("127.0.0.1", True), "address: expected"),
        (("127.0.0.1", 0.5), "address: expected"),
        ("127.0.0.1:8001", "address: expected"),
        (("no host", 1), "host: expected a name or IPv4 address, got 'no host'"),
    ],
)
def test_wrong_addresses(address: Any, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        RemoteEnv(address)
    with pytest.raises(ValueError, match=sentence):
        Simulator(bind=address)
    with pytest.raises(ValueError, match=sentence):
        Simulator(server=address, bind=ANY)


def test_insecure_allows_other_addresses() -> None:
    with RemoteEnv(("0.0.0.0", 0), insecure=True, connect=False) as remote:
        assert remote.address[0] == "0.0.0.0"
    with pytest.raises(OSError, match=r"cannot bind 192.0.2.1:0: this machine has no such address"):
        RemoteEnv(("192.0.2.1", 0), insecure=True)


def test_wrong_options() -> None:
    with pytest.raises(ValueError, match="server: expected the port of the agent"):
        Simulator(server=ANY, bind=ANY)
    with pytest.raises(ValueError, match="codec: expected 'binary' or 'text', got 'json'"):
        Simulator(codec="json")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="env: expected a registered id, got 'rotorgram/No-v0'"):
        Simulator("rotorgram/No-v0")
    with pytest.raises(ValueError, match="env: expected a registered id, got 'nowhere:No-v0'"):
        Simulator("nowhere:No-v0")
    with pytest.raises(ValueError, match=r"options of CartPole-v1: .*'wind'"):
        Simulator("CartPole-v1", wind=1)
    with pytest.raises(ValueError, match=r"options: expected some of target, .*, got 'wind'"):
        RemoteEnv(ANY, options={"wind": 1})
    with pytest.raises(ValueError, match="observation space: expected a flat Box of float32"):
        Simulator("FrozenLake-v1")
    with pytest.raises(ValueError, match=r"options \['target'\]: expected none with an env"):
        Simulator(Broken(None), target=1)
    with pytest.raises(ValueError, match="env: expected a registered id"):
        RemoteEnv(ANY, env_id="rotorgram/No-v0")
    for name in ("timeout", "connect_timeout"):
        with pytest.raises(ValueError, match=f"{name}: expected seconds > 0, got 0"):
            RemoteEnv(ANY, **{name: 0})


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ([], "expected one argument, a JSON object, got 0"),
        (["{}", "{}"], "expected one argument, a JSON object, got 2"),
        (["server"], "expected a JSON object: Expecting value"),
        (["[" * 100_000], "expected a JSON object: maximum recursion depth"),
        (["[1]"], r"expected a JSON object, got \[1\]"),
        (['{"server": 5}'], r"server: expected \[host, port\], got 5"),
        (['{"env": 5}'], "env: expected an id, got 5"),
        (['{"insecure": "false"}'], "insecure: expected true or false, got 'false'"),
        (['{"config": {"timeout": 1}}'], "config: expected none"),
    ],
)
def test_wrong_arguments_of_the_simulator_program(words: list[str], sentence: str) -> None:
    with pytest.raises(ValueError, match=f"^{sentence}"):
        parse_arguments(words)


def test_the_simulator_program_says_what_is_wrong_in_one_sentence() -> None:
    for words, sentence in (
        ([], "expected one argument, a JSON object, got 0"),
        (['{"bind": ["127.0.0.1", 0], "target": NaN}'],
         "target: expected an elevation in m, or a pair (low, high) with low <= high, got nan"),
    ):  # fmt: skip
        done = subprocess.run(
            [sys.executable, "-m", "rotorgram.udp", *words], capture_output=True, text=True
        )
        assert (done.returncode, done.stdout) == (1, "")
        assert done.stderr == f"rotorgram simulator: {sentence}\n"


@pytest.mark.parametrize(
    ("options", "env", "sentence"),
    [
        ({}, "CartPole-v1", f"refused: expected a simulator of {ENV_ID}, got one of CartPole-v1"),
        ({"observation": "error"}, ENV_ID, "refused: expected observation 'error', got 'full'"),
        (
            {"action_mode": "offset", "linear_drag": 0.5},
            ENV_ID,
            "expected action_mode 'offset', got 'increment'; expected linear_drag 0.5, got 0.0",
        ),
    ],
)
def test_refusals_say_why(options: dict[str, Any], env: str, sentence: str) -> None:
    with RemoteEnv(ANY, connect=False, connect_timeout=0.5, options=options) as remote:
        running = Running(Simulator(env, server=remote.address, bind=ANY, config=QUICK))
        with pytest.raises(PeerSilent, match=r"last datagram dropped: refused from 127.0.0.1:"):
            remote.connect()
        error = running.join()
    assert isinstance(error, Refused)
    assert re.search(sentence, str(error))


def test_a_simulator_of_two_drones_is_refused() -> None:
    hello = describe(gym.make(ENV_ID))
    two = Hello(**{n: getattr(hello, n) for n in hello.__slots__} | {"num_drones": 2})
    with RemoteEnv(ANY, connect=False, connect_timeout=0.3) as remote, plain_socket() as sock:
        sock.sendto(binary.encode(two), remote.address)
        with pytest.raises(PeerSilent, match="expected a simulator of one drone, got one of 2"):
            remote.connect()
        assert isinstance(binary.decode(sock.recv(65507)), Refuse)


# ---- strangers


def test_strangers_change_nothing_but_counters() -> None:
    dice = np.random.default_rng(1)
    with flying() as pair, plain_socket() as stranger:
        local = gym.make(ENV_ID)
        pair.remote.reset(seed=4)
        local.reset(seed=4)
        hello = pair.simulator.link.hello
        forged = [
            b"",
            b"1,0.5,0,0,1,1,1",
            b"1,close",
            b"3,0.0,0,0,1,1,1," + b"0," * 9 + b"0",
            dice.bytes(65507),
            binary.encode(hello),
            binary.encode(Close(session=hello.session, sequence=2, reason="forged")),
            binary.encode(Command(session=hello.session, sequence=3, resets=np.ones(1, bool),
                                  actions=np.zeros((1, 1), np.float32))),
        ]  # fmt: skip
        for _ in range(50):
            for datagram in forged:
                stranger.sendto(datagram, pair.remote.address)
                stranger.sendto(datagram, pair.simulator.address)
            time.sleep(0.01)  # strangers are looked at so often
            action = dice.uniform(-0.1, 0.1, 1).astype(np.float32)
            here, there = pair.remote.step(action), local.step(action)
            assert here[0].tobytes() == there[0].tobytes()
            assert here[1:4] == there[1:4]
        counters = pair.remote.statistics.counters
        assert min(counters[name] for name in ("malformed", "foreign", "refused")) > 2
        assert pair.simulator.link.sequence == 52
        counters = pair.simulator.link.statistics.counters
        assert set(counters) <= {"sessions", "sent", "received", "resent", "stale"}
        pair.remote.close()
        assert pair.running.join() == "the agent closed"


def test_welcome_may_seed_the_first_reset() -> None:
    with plain_socket() as sock:
        running = Running(Simulator(server=sock.getsockname(), bind=ANY, config=QUICK))
        datagram, address = sock.recvfrom(65507)
        hello = binary.decode(datagram)
        sock.sendto(binary.encode(Welcome(session=hello.session, seed=0)), address)
        state = binary.decode(sock.recv(65507))
        assert isinstance(state, State)
        expected, _ = gym.make(ENV_ID).reset(seed=0)
        assert state.observations[0].tobytes() == expected.tobytes()
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
        simulator.fleet.env.reset(seed=1)
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
        seen = [5.0 - elevation, -rate, thrust / 49 - 1, 0, elevation, 0, 0, 0, 0, *[thrust] * 4]
        fields = [sequence, 1.0, 0, 0, *seen]
        line = ",".join(map(str, fields)).encode()
        answer = [""]
        while answer[0] != str(sequence):
            try:
                sock.sendto(line, agent)
                answer = sock.recv(1024).decode().split(",")
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
    with RemoteEnv(ANY, connect=False, connect_timeout=10) as remote:
        process = launch(TEXT_SIMULATOR, remote.address[1])
        observation, info = remote.reset(seed=9)
        assert observation.tolist() == [0.0, 0.0, 0.0]
        assert remote.hello is None
        observation, reward, terminated, truncated, info = remote.step(np.ones(1))
        rate = (4 * 54 / 20 - 9.8) * 0.02
        assert info["Y"] == 5.0 + rate * 0.02
        assert info["F4"] == 54.0
        assert observation.tolist() == pytest.approx([-rate * 0.02, -rate, 54 / 49 - 1])
        assert (reward, terminated, truncated) == (1.0, False, False)
    out, err = process.communicate(timeout=10)
    assert (out, err) == ("closed after 3\n", "")


def test_the_wire_needs_neither_mujoco_nor_torch() -> None:
    code = """
        import sys
        from rotorgram.udp import RemoteEnv
        env = RemoteEnv(("127.0.0.1", 0), connect=False)
        env.action_space.sample()
        env.close()
        print([name for name in ("mujoco", "torch", "stable_baselines3") if name in sys.modules])
    """
    out, err = launch(code).communicate(timeout=60)
    assert (out, err) == ("[]\n", "")

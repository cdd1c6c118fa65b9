"""One drone over real sockets: silence, restarts and ends on either side."""

import errno
import gc
import io
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import rotorgram.envs  # noqa: F401
from peers import ANY, ENV_ID, QUICK, plain_socket, simulate
from remotes import Broken
from rotorgram.envs.config import EnvConfig
from rotorgram.models.errors import InputError
from rotorgram.udp import (
    LinkConfig,
    PeerClosed,
    PeerSilent,
    RemoteEnv,
    Simulator,
)
from rotorgram.udp import __main__ as udp_main
from rotorgram.udp.protocol import binary
from rotorgram.udp.protocol.messages import Hello
from rotorgram.udp.spawn import spawn_simulator, start_simulator
from rotorgram.udp.transport import simulator as driver
from rotorgram.udp.transport import sockets


def test_a_vehicle_that_is_not_there_leaves_no_record(tmp_path: Path) -> None:
    record = tmp_path / "flight.mcap"
    config = EnvConfig(vehicle="missing.toml")
    with pytest.raises(InputError, match=r"missing\.toml"), spawn_simulator(config, record=record):
        pass
    assert not record.exists()


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
        error = simulate(sock.getsockname(), LinkConfig(timeout=0.3)).join()
        assert isinstance(error, PeerSilent)
        sends = int(re.findall(r"for 0.3 s, Hello sent (\d+) times", str(error))[0])
        datagrams = [sock.recv(65507) for _ in range(sends)]
        sock.setblocking(False)
        with pytest.raises(BlockingIOError):  # who was not welcome does not take leave
            sock.recv(65507)
    assert len(set(datagrams)) == 1
    assert isinstance(binary.decode(datagrams[0]), Hello)


@pytest.mark.quiet
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


@pytest.mark.quiet
def test_a_wait_may_be_longer_than_the_system_waits_in_one_go(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sockets, "LONGEST_WAIT", 0.02)
    start = time.monotonic()
    with pytest.raises(PeerSilent, match=r"for 0\.2 s"):
        RemoteEnv(ANY, connect_timeout=0.2)
    assert 0.2 <= time.monotonic() - start < 2
    with sockets.open_socket(ANY, insecure=False) as sock, pytest.raises(TimeoutError):
        sock.receive(1e300)


@pytest.mark.quiet
def test_signals_neither_end_nor_extend_a_wait() -> None:
    before = signal.signal(signal.SIGALRM, lambda *_: None)
    try:
        with sockets.open_socket(ANY, insecure=False) as sock:
            signal.setitimer(signal.ITIMER_REAL, 0.005, 0.005)
            start = time.monotonic()
            with pytest.raises(TimeoutError):
                sock.receive(0.1)
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

    class Socket(sockets.Socket):
        def receive(self, timeout: float) -> Any:
            if errors:
                raise errors.pop()
            return super().receive(timeout)

    monkeypatch.setattr(sockets, "Socket", Socket)
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


@pytest.mark.quiet
def test_a_simulator_that_falls_silent() -> None:
    with RemoteEnv(ANY, connect=False, connect_timeout=1, timeout=0.5) as remote:
        running = simulate(remote)
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
        running = simulate(remote)
        local = gym.make(ENV_ID)
        assert remote.reset(seed=3)[0].tobytes() == local.reset(seed=3)[0].tobytes()
    assert running.join() == "the agent closed"


def test_the_simulator_program_ends_on_sigterm_and_tells_the_agent() -> None:
    with RemoteEnv(ANY, connect=False, connect_timeout=20, timeout=10) as remote:
        process = start_simulator(EnvConfig(), remote.address)
        remote.reset(seed=0)
        process.send_signal(signal.SIGINT)  # Ctrl-C is for the agent
        remote.step(np.zeros(1))
        process.send_signal(signal.SIGTERM)
        with pytest.raises(PeerClosed, match="closed: the simulator was stopped"):
            remote.reset()
        assert process.wait(10) == 128 + signal.SIGTERM
        assert process.stdin is not None
        process.stdin.close()


def test_sigterm_for_a_group_is_for_the_agent(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "rotorgram.cli", "train", "ppo", "--udp", "--out", "run"]
    words += ["--env-steps", "9000000"]
    training = subprocess.Popen(words, cwd=tmp_path, start_new_session=True, stderr=-1, stdout=-1)
    deadline = time.monotonic() + 30
    while not (tmp_path / "run" / "checkpoint.safetensors").exists():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    os.killpg(training.pid, signal.SIGTERM)
    _, said = training.communicate(timeout=30)
    assert (training.returncode, said) == (128 + signal.SIGTERM, b"")


def test_a_forgotten_env_tells_the_simulator() -> None:
    remote = RemoteEnv(ANY, connect=False)
    running = simulate(remote)
    remote.reset()
    del remote
    gc.collect()
    assert running.join() == "the agent closed"


@pytest.mark.parametrize(
    ("value", "sentence"),
    [
        (None, "RuntimeError: bad state x+"),
        (np.nan, "InputError: .*: expected finite numbers"),
    ],
)
def test_an_env_that_fails(value: float | None, sentence: str) -> None:
    remote = RemoteEnv(ANY, connect=False)
    running = simulate(remote, env=Broken(value))
    remote.reset()
    remote.step(np.zeros(1))
    remote.step(np.zeros(1))
    with pytest.raises(PeerClosed, match=f"the simulator at .* closed: {sentence}"):
        remote.step(np.zeros(1))
    assert isinstance(running.join(), RuntimeError if value is None else ValueError)
    remote.close()


def test_a_simulator_of_our_own_waits_as_long_as_its_agent_lives(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An agent may train or evaluate something else for minutes, and holds its standard input."""
    made: list[Any] = []

    class Made(Simulator):
        def run(self) -> str:
            made.append(self.link.config.timeout)
            return ""

    monkeypatch.setattr(udp_main, "Simulator", Made)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    words = {"config": EnvConfig().to_dict(), "server": ["127.0.0.1", 9], "bind": ANY}
    line = json.dumps(words).encode() + b"\n"
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=io.BytesIO(line)))
    monkeypatch.setattr(os, "read", lambda *_: b"")
    assert udp_main.main() == 0
    assert made[0] >= 86_400


def test_a_pause_of_its_own_does_not_end_a_simulator(  # fault 25
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = [0.0]
    monkeypatch.setattr(driver, "time", SimpleNamespace(monotonic=lambda: now[0]))
    with plain_socket() as nobody, Simulator(server=nobody.getsockname(), bind=ANY) as simulator:

        def receive(*_: object) -> None:  # the process was stopped meanwhile
            now[0] += 1e4
            if now[0] > 3e4:
                simulator.stop()
            raise TimeoutError

        monkeypatch.setattr(driver.Port, "receive", receive)
        assert simulator.run() == "the simulator was stopped"

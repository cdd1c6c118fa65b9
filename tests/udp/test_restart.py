"""Either side is killed, interrupted, frozen or an impostor: the other goes on, or says why not."""

import json
import re
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rotorgram.envs  # noqa: F401
from peers import ANY, ENV_ID, TABLES, Running, launch, plain_socket, simulate
from relay import FaultConfig, relaying
from remotes import assert_parity
from rotorgram.envs.config import EnvConfig
from rotorgram.udp import (
    LinkConfig,
    PeerSilent,
    Refused,
    RemoteEnv,
    RemoteVectorEnv,
    Simulator,
)
from rotorgram.udp.protocol.auth import write_key
from rotorgram.udp.spawn import start_simulator

LOSSY = FaultConfig(drop=0.3, duplicate=0.1, reorder=0.2, seed=2)
AT_ONCE = 5.0
"""Far from every timeout. Of that an interpreter with MuJoCo takes 0.2 s to end, or 1 s and more
on a busy machine."""
SIMULATE = """
    import json, sys
    from rotorgram.udp import LinkConfig, Simulator
    from rotorgram.udp.protocol.client import RoundTrips
    arguments = json.loads(sys.argv[1])
    RoundTrips.wait = lambda *_: 0.005  # asks again as often however bad the path is
    for name in ("server", "bind"):
        arguments[name] = tuple(arguments[name])
    config = LinkConfig(timeout=30)
    with Simulator(config=config, **arguments) as simulator:
        print(simulator.address[1], flush=True)
        print(simulator.run())
"""

AGENT = """
    import json, sys
    from rotorgram.udp import RemoteVectorEnv
    arguments = json.loads(sys.argv[1])
    number = arguments.pop("num_envs", 1)
    arguments["address"] = tuple(arguments["address"])
    env_id = "rotorgram/Elevation-v0"
    env = RemoteVectorEnv(env_id=env_id, connect=False, num_envs=number, **arguments)
    print(env.address[1], flush=True)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    print("flying", flush=True)
    while True:
        env.step(env.action_space.sample())
"""


@contextmanager
def program(code: str, **arguments: Any) -> Iterator[Any]:
    """A simulator or an agent in a process of its own, and the port that it has."""
    process: Any = launch(code, json.dumps(arguments))
    try:
        process.port = int(process.stdout.readline() or 0)
        yield process
    finally:
        process.kill()
        process.communicate()


def simulating(server: tuple[str, int], bind: tuple[str, int] = ANY, **arguments: Any) -> Any:
    return program(SIMULATE, server=server, bind=bind, **arguments)


def kill(process: subprocess.Popen[str]) -> None:
    process.kill()
    process.wait()


@pytest.fixture(params=["clean", "lossy"])
def network(request: pytest.FixtureRequest) -> Iterator[Any]:
    """Gives the address that leads to an agent's: its own, or that of a bad relay before it."""
    with ExitStack() as stack:

        def towards(address: tuple[str, int]) -> tuple[str, int]:
            if request.param == "clean":
                return address
            return stack.enter_context(relaying(address, LOSSY)).address

        yield towards


@pytest.fixture
def key_file(tmp_path: Path) -> str:
    write_key(tmp_path / "key")
    return str(tmp_path / "key")


def ends(process: subprocess.Popen[str]) -> str:
    """What a simulator that ended in order says at last; its log is empty or on `stderr`."""
    out, err = process.communicate(timeout=10)
    assert process.returncode == 0, err
    return out.splitlines()[-1]


# ---- the simulator is killed


@pytest.mark.parametrize(
    ("network", "kind", "same"),
    TABLES["killed simulators"],  # text only at its port: elsewhere there is no Wait
    indirect=["network"],
)
def test_a_killed_simulator_is_replaced(network: Any, kind: str, same: bool, key_file: str) -> None:
    keys = {"key_file": key_file} if kind == "key" else {}
    codec = "text" if kind == "text" else "binary"
    told = same and kind != "text"  # by a Hello; else only its silence tells
    with RemoteEnv(
        ANY, env_id=ENV_ID, connect=False, timeout=20 if told else 0.7, **keys
    ) as remote:
        address = network(remote.address)
        with simulating(address, codec=codec, **keys) as first:
            observation, _ = remote.reset(seed=1)
            for _ in range(20):
                observation, *_, info = remote.step(np.zeros(1))
            kill(first)
        bind = ("127.0.0.1", first.port) if same else ANY
        with simulating(address, bind, codec=codec, **keys) as second:
            start = time.monotonic()
            after, reward, terminated, truncated, lost = remote.step(np.zeros(1))
            assert time.monotonic() - start < 4
            assert after.tobytes() == observation.tobytes()
            assert (reward, terminated, truncated) == (0.0, False, True)
            reason = lost.pop("simulator_lost")
            assert lost == info
            if told:
                assert re.fullmatch(r"the simulator at 127.0.0.1:\d+ was started anew", reason)
            else:
                sentence = r"no datagram from the simulator at .* for 0.7 s, waiting at .*"
                assert re.fullmatch(sentence, reason)
            assert_parity(remote, 100, (3,))
            assert remote.statistics.counters["sessions"] == 2
            remote.close()
            assert ends(second) == "the agent closed"


def test_a_simulator_that_was_frozen_begins_anew() -> None:
    """Its place was given up: the session is over, and is not taken up where it was."""
    with RemoteEnv(ANY, connect=False, timeout=0.5) as remote:
        with simulating(remote.address) as process:
            remote.reset(seed=0)
            before = remote.step(np.ones(1))
            process.send_signal(signal.SIGSTOP)
            thaw = threading.Timer(1.0, process.send_signal, [signal.SIGCONT])
            thaw.start()
            after = remote.step(np.ones(1))
            thaw.join()
            assert after[0].tobytes() == before[0].tobytes()
            assert after[3]
            assert "for 0.5 s" in after[4]["simulator_lost"]
            assert_parity(remote, 100, (2,))
            remote.close()
            assert ends(process) == "the agent closed"
        assert remote.statistics.counters["sessions"] == 2


# ---- the agent is killed


@pytest.mark.parametrize(
    "options", [{}, {"codec": "text"}, {"key_file": "yes"}], ids=["binary", "text", "key"]
)
def test_a_killed_agent_is_replaced(network: Any, options: dict[str, str], key_file: str) -> None:
    """The same simulator process serves one agent after the other, at the same port."""
    keys = {"key_file": key_file} if "key_file" in options else {}
    with plain_socket() as sock:
        address = sock.getsockname()
    with simulating(network(address), **{**options, **keys}) as simulator:
        for _ in range(2):
            with program(AGENT, address=address, **keys) as agent:
                assert agent.stdout.readline() == "flying\n"
                time.sleep(0.05)
                kill(agent)
                assert simulator.poll() is None
        with RemoteEnv(address, env_id=ENV_ID, connect=False, **keys) as remote:
            start = time.monotonic()
            assert_parity(remote, 100, (4,))
            assert time.monotonic() - start < 8
        out, err = simulator.communicate(timeout=10)
    assert simulator.returncode == 0
    assert out == "the agent closed\n"
    anew = err.count("the agent does not know this session (any more); beginning a new one")
    assert anew == (0 if "codec" in options else 2)


# ---- Ctrl-C


def seconds_until_both_end(signalled: Any, other: Any) -> float:
    """Interrupt one program; how long both take to be gone, s."""
    start = time.monotonic()
    signalled.send_signal(signal.SIGINT)
    for process in (signalled, other):
        process.wait(10)
    return time.monotonic() - start


@pytest.mark.parametrize("codec", ["binary", "text"])
@pytest.mark.parametrize("side", ["simulator", "agent"])
def test_ctrl_c_ends_both_at_once(side: str, network: Any, codec: str) -> None:
    with program(AGENT, address=ANY) as agent:
        address = network(("127.0.0.1", agent.port))
        with simulating(address, codec=codec) as simulator:
            assert agent.stdout.readline() == "flying\n"
            signalled, other = (agent, simulator) if side == "agent" else (simulator, agent)
            assert seconds_until_both_end(signalled, other) < AT_ONCE
            assert "KeyboardInterrupt" in signalled.stderr.read()
            if side == "agent":
                assert ends(simulator) == "the agent closed"
                return
            reason = "the simulator closed" if codec == "text" else "the simulator was stopped"
            sentence = rf"PeerClosed: the simulator at .* closed: {reason}"
            assert re.search(sentence, agent.stderr.read())


def test_ctrl_c_with_nobody_there_ends_at_once() -> None:
    with plain_socket() as sock, simulating(sock.getsockname()) as simulator:
        sock.recv(65507)  # its Hello
        with program(AGENT, address=ANY) as agent:
            time.sleep(0.1)
            assert seconds_until_both_end(agent, agent) < AT_ONCE
            assert seconds_until_both_end(simulator, simulator) < AT_ONCE
            for process in (agent, simulator):
                assert "KeyboardInterrupt" in process.stderr.read()


def test_a_simulator_ends_with_its_standard_input() -> None:
    """That of a program which was killed: before the first Welcome and in mid-flight."""
    with RemoteEnv(ANY, connect=False) as remote, plain_socket() as nobody:
        for server in (nobody.getsockname(), remote.address):
            with start_simulator(EnvConfig(), server) as process:
                assert process.stdin is not None
                if server == remote.address:
                    remote.reset()
                else:
                    nobody.recv(65507)  # its Hello
                process.stdin.close()
                assert process.wait(AT_ONCE) == 0


# ---- keys


@contextmanager
def keyed(
    agent_key: str | None, simulator_key: str | None, codec: Any = "binary"
) -> Iterator[tuple[RemoteEnv, Running]]:
    remote = RemoteEnv(ANY, env_id=ENV_ID, connect=False, connect_timeout=0.6, key_file=agent_key)
    running = simulate(remote, LinkConfig(timeout=0.5), codec=codec, key_file=simulator_key)
    try:
        yield remote, running
    finally:
        remote.close()
        running.join()


@pytest.mark.parametrize(("agent_key", "simulator_key", "sentence"), TABLES["keys that differ"])
def test_keys_that_differ(
    agent_key: str | None,
    simulator_key: str | None,
    sentence: str,
    key_file: str,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    write_key(tmp_path / "another")
    files = {None: None, "key": key_file, "another": str(tmp_path / "another")}
    with keyed(files[agent_key], files[simulator_key]) as (remote, running):
        with pytest.raises(PeerSilent, match=re.escape(sentence)):
            remote.connect()
        error = running.join()
        answers = remote.statistics.counters["sent"]
    assert f"{sentence}\n" in caplog.text
    if simulator_key is None:
        assert isinstance(error, Refused)
        assert str(error) == f"the agent at 127.0.0.1:{remote.address[1]} refused: {sentence}"
        return
    assert isinstance(error, PeerSilent)
    if agent_key is None:  # an unsealed Refuse may be anybody's: it is not believed
        assert "forged from the agent: key: the agent has none (--key-file)" in str(error)
    else:
        assert answers == 0  # no answer to a forgery


def test_text_and_a_key(key_file: str) -> None:
    with pytest.raises(ValueError, match="text codec: expected no key, got one"):
        Simulator(bind=ANY, codec="text", key_file=key_file)
    with keyed(key_file, None, codec="text") as (remote, running):
        with pytest.raises(PeerSilent, match="last datagram dropped: forged"):
            remote.connect()
        error = running.join()
        assert isinstance(error, Refused)
        assert "closed before its first command: it has no free slot, has a key" in str(error)


def test_a_key_allows_every_address(key_file: str) -> None:
    for kind, arguments in ((RemoteEnv, {}), (RemoteVectorEnv, {"num_envs": 1})):
        with pytest.raises(ValueError) as caught:
            kind(("0.0.0.0", 0), connect=False, **arguments)
        assert str(caught.value) == (
            "0.0.0.0 is not a loopback address: expected 127.0.0.1, or a key that both sides share "
            "(key_file, --key-file), or insecure=True (--insecure) where everybody who reaches "
            "this port may fly the drone"
        )
    with RemoteEnv(("0.0.0.0", 0), connect=False, key_file=key_file) as remote:
        address = "127.0.0.1", remote.address[1]
        running = simulate(address, bind=("0.0.0.0", 0), key_file=key_file)
        assert_parity(remote, 100, (1,))
        remote.close()
        assert running.join() == "the agent closed"


# ---- what was recorded

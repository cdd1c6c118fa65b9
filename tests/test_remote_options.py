"""One drone over real sockets: addresses, options and refusals."""

import re
import subprocess
import sys
from typing import Any

import gymnasium as gym
import pytest
import rotorgram.envs  # noqa: F401
from peers import ANY, ENV_ID, Running, plain_socket
from remotes import QUICK, Broken
from rotorgram.udp import (
    PeerSilent,
    Refused,
    RemoteEnv,
    Simulator,
    binary,
)
from rotorgram.udp.__main__ import parse_arguments
from rotorgram.udp.fleet import describe
from rotorgram.udp.messages import Hello, Refuse

WAYS_OUT = (
    r"0\.0\.0\.0 is not a loopback address: expected 127\.0\.0\.1, or a key that both sides share "
    r"\(key_file, --key-file\), or insecure=True \(--insecure\)"
)


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

"""Peers that were written from docs/protocol.md alone, in C and C#, against ours."""

import json
import math
import os
import re
import shutil
import socket
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from random import Random

import numpy as np
import pytest
from peers import TABLES
from relay import FaultConfig, relaying
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.loop import Loop
from rotorgram.envs.registry import env_spec
from rotorgram.envs.spec import EnvSpec
from rotorgram.udp import RemoteEnv

ENV_ID = "rotorgram/Elevation-v0"
ROOT = Path(__file__).parents[2]
PEERS = ROOT / "examples" / "peers"
LOSSY = FaultConfig(drop=0.3, duplicate=0.1, reorder=0.1, seed=1)


def tool(name: str) -> str:
    """Where a compiler is. Only a machine that is not the CI may lack it."""
    found = shutil.which(name)
    if found is None and "CI" not in os.environ:
        pytest.skip(
            f"{name} is not installed (apt-get install gcc libc6-dev mono-mcs mono-runtime)"
        )
    assert found is not None, f"{name} is not installed, and the CI is to fly both peers"
    return found


def compiled(*command: object) -> None:
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0
    assert done.stdout == ""
    assert done.stderr == ""


@pytest.fixture(scope="module")
def agent(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    program = tmp_path_factory.mktemp("agent") / "agent"
    flags = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
    compiled(tool("gcc"), *flags, "-o", program, PEERS / "agent.c", "-lm")
    return [str(program)]


@pytest.fixture(scope="module")
def simulator(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    mono = tool("mono")
    program = tmp_path_factory.mktemp("simulator") / "simulator.exe"
    compiled(tool("mcs"), "-warnaserror", f"-out:{program}", *sorted(PEERS.glob("*.cs")))
    return [mono, str(program), "--bind", "127.0.0.1:0", "--timeout", "20", "--server"]


@contextmanager
def running(command: list[str], *arguments: object) -> Iterator[subprocess.Popen[str]]:
    """A program that is over when the block is, by itself or killed."""
    everything = [*command, *map(str, arguments)]
    pipe = subprocess.PIPE
    with subprocess.Popen(everything, stdout=pipe, stderr=pipe, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def ours(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "rotorgram.cli", *map(str, arguments)]


def ended(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    out, err = process.communicate(timeout=100)
    return process.returncode, out, err


def place(address: tuple[str, int]) -> str:
    return f"{address[0]}:{address[1]}"


@contextmanager
def udp() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        sock.settimeout(10)
        yield sock


@contextmanager
def relayed(server: tuple[str, int], config: FaultConfig | None) -> Iterator[tuple[str, int]]:
    """Where a simulator finds the agent: its own address, or that of a relay before it."""
    if config is None:
        yield server
        return
    with relaying(server, config) as relay:
        yield relay.address


# The agent in C.


def waiting(process: subprocess.Popen[str]) -> tuple[str, int]:
    assert process.stdout is not None
    line = process.stdout.readline()
    assert line.startswith("waiting at 127.0.0.1:"), line
    return "127.0.0.1", int(line.rsplit(":", 1)[1])


TEXT_SIMULATOR = """
import sys
from rotorgram.udp import Simulator
with Simulator(server=("127.0.0.1", int(sys.argv[1])), bind=("127.0.0.1", 0), codec="text",
               episode_length=int(sys.argv[2])) as simulator:
    simulator.run()
"""


def flown(agent: list[str], config: FaultConfig | None, steps: int = 250) -> list[str]:
    """Three episodes of a simulator by text, the agent's lines."""
    with (
        running(agent, 0, 3, 7) as process,
        relayed(waiting(process), config) as address,
        running([sys.executable, "-c", TEXT_SIMULATOR], address[1], steps) as simulator,
    ):
        status, out, err = ended(process)
        assert status == 0
        assert err == ""
        assert ended(simulator)[0] == 0
    return out.splitlines()


def test_agent_holds_our_drone(agent: list[str]) -> None:
    pattern = r"episode \d: 250 steps, return (\S+), last \|E\| (\S+) m, truncated"
    episodes = [re.fullmatch(pattern, line) for line in flown(agent, None)]
    assert len(episodes) == 3
    for episode in episodes:
        assert episode is not None
        assert float(episode[1]) > 150
        assert float(episode[2]) < 0.05


def test_agent_flies_the_same_whatever_the_network_does(agent: list[str]) -> None:
    assert flown(agent, LOSSY, 60) == flown(agent, None, 60)


TELEMETRY = ",0,5,0,0,0,0,0,0,0,0,0,0,49,49,49,49,0,5,0,0.5"
GOLDEN = json.loads((ROOT / "docs" / "golden.json").read_text("utf-8"))
JUNK_LINES = [
    *[line.encode() for line in GOLDEN["text of env one"]["malformed states"]],
    b"\xff\x00\xa7",
    bytes.fromhex("a7520301"),
    b"42,close\x00",
    b"42,1,0,0,1,0,0",  # no telemetry
    b"42,1,0,0,1,0,0" + TELEMETRY.encode() + b",1",
    b"42,1,0,0,1,0,." + TELEMETRY.encode(),
    b"42,1,0,0,1,0,1e" + TELEMETRY.encode(),
    b"18446744073709551658,1,0,0,1,0,0" + TELEMETRY.encode(),  # 42 modulo 2^64
    b"042,1,0,0,1,0,0" + TELEMETRY.encode(),
    b"42,1,0,0,1,0,0" + TELEMETRY.encode() + b"\x00",
]


def state(start: str) -> bytes:
    return (start + TELEMETRY).encode()


def test_agent_answers_by_the_rules(agent: list[str]) -> None:
    with running(agent, 0, 1, 2**64 - 1) as process, udp() as sock, udp() as stranger:
        sock.connect(waiting(process))
        stranger.connect(sock.getpeername())

        def ask(line: bytes) -> bytes:
            sock.send(line)
            return sock.recv(2048)

        for line in [*JUNK_LINES, b"41,close"]:
            sock.send(line)
        # A text simulator may begin at any number. The first State is answered by our own reset.
        reset = b"41,reset,18446744073709551615"
        assert ask(state("41,0,0,0,0.5,0,0")) == reset
        # Junk and old numbers get no answer: the next that comes is that of the repeat.
        for line in [*JUNK_LINES, state("40,0,0,0,0,0,0"), state("43,0,0,0,0,0,0"), b"43,close"]:
            sock.send(line)
        assert ask(state("41,0,0,0,0.5,0,0")) == reset
        # A reset's State has reward 0 and neither flag.
        sock.send(state("42,1,0,0,0.01,0,0"))
        sock.send(state("42,0,0,1,0.01,0,0"))
        assert ask(state("42,0,0,0,1e-2,-.001,+0.") + b"\r\n") == b"42,%.17g" % (
            9 * 0.01 + 6 * -0.001
        )
        # Another simulator finds the place taken, whatever it says.
        for line in [b"5,close", b"43,close", *JUNK_LINES, state("43,0,0,0,0,0,0")]:
            stranger.send(line)
        assert stranger.recv(2048) == b"43,close"
        assert ask(state("43,0.25,0,0,-0.5,0,0") + b"\n") == b"43,-1"
        assert ask(state("44,-0.125,0,1,-0.25,0,0") + b"\r") == b"44,close"
        assert ask(state("44,-0.125,0,1,-0.25,0,0")) == b"44,close"
        assert sock.recv(2048) == b"44,close"  # repeated, until it is answered
        sock.send(b"44,close")
        status, out, err = ended(process)
    assert status == 0
    assert err == ""
    assert out == "episode 1: 2 steps, return 0.125, last |E| 0.250000 m, truncated\n"


def test_agent_says_why_it_gives_up(agent: list[str]) -> None:
    with running(agent, 0, 1, 0, 1) as process, udp() as sock:
        sock.connect(waiting(process))
        sock.send(bytes.fromhex(golden("hello")))
        status, _, err = ended(process)
    assert status == 1
    assert err == (
        "no text simulator came within 1 s; datagrams dropped: 1, "
        "binary ones too: start sim --codec text\n"
    )
    with running(agent, 0, 2) as process, udp() as sock:
        sock.connect(waiting(process))
        sock.send(state("1,0,0,0,0,0,0"))
        assert sock.recv(2048) == b"1,reset,0"
        sock.send(b"2,close")  # its State 2 was lost
        assert sock.recv(2048) == b"1,close"
        assert ended(process)[::2] == (1, "the simulator closed in episode 1\n")
    for arguments in (["-1"], ["65536"], ["0", "x"], ["0", "1", str(2**64)], ["0", "1", "0", "0"]):
        with running(agent, *arguments) as process:
            status, _, err = ended(process)
            assert status == 2
            assert "expected a whole number" in err


# The simulator in C#.


def golden(name: str) -> str:
    return next(case["bytes"] for case in GOLDEN["messages"] if case["name"] == name)


def test_simulator_writes_and_reads_the_golden_datagrams(simulator: list[str]) -> None:
    read = TABLES["golden datagrams that a simulator reads"]
    envs = {case["name"]: case["env"] for case in GOLDEN["messages"]}
    given = [f"{envs[name]}:{golden(name)}" for name in read]
    # What concerns a simulator, and can be told without the state of a link.
    wrong = [
        f"{case['env']}:{case['bytes']}"
        for case in GOLDEN["malformed"]
        if not ("Hello" in case["name"] or "State" in case["name"] or "Missing" in case["name"])
    ]
    assert len(wrong) > 15
    spec = json.dumps(GOLDEN["envs"]["one"]["spec"], separators=(",", ":"))
    with running(simulator[:2], "--self-test", spec, *given, *wrong) as test:
        status, out, err = ended(test)
    assert status == 0
    assert err == ""
    written = ["hello", "state 1 echoes the nonce", "state, truncated", "close"]
    assert out.splitlines() == [
        *(f"{name} {golden(name)}" for name in written),
        *read.values(),
        *["malformed"] * len(wrong),
    ]


def law(observation: np.ndarray) -> float:
    error, rate, thrust = map(float, observation)
    return max(-1.0, min(1.0, 9 * error + 6 * rate - 9.8 * thrust))


def flights(simulator: list[str], config: FaultConfig | None, steps: int) -> list[object]:
    """All that the agent sees of two seeded flights with noise in their actions."""
    noise = Random(5)
    seen = []
    with (
        RemoteEnv(("127.0.0.1", 0), connect=False) as env,
        relayed(env.address, config) as address,
        running(simulator, place(address)) as process,
    ):
        for seed in (1, 2):
            observation, info = env.reset(seed=seed)
            seen.append((0.0, observation.tolist(), 0.0, False, False, info))
            for _ in range(steps):
                action = np.float32(law(observation) + noise.uniform(-0.5, 0.5))
                observation, reward, *ends, info = env.step([action])
                seen.append((float(action), observation.tolist(), reward, *ends, info))
        env.close()
        status, out, err = ended(process)
    assert status == 0
    assert err == ""
    assert " 1 sessions;" in out
    return seen


def fly(loop: Loop, action: float, *, reset: bool = False) -> None:
    loop.advance(np.array([[action]], np.float32), np.array([reset]), None, None)


def test_simulator_flies_the_closed_form_and_our_drone(simulator: list[str]) -> None:
    seen = flights(simulator, None, 250)
    ours = Loop(EnvConfig(env_id=ENV_ID))
    assert len(seen) == 2 * 251
    for i, (action, observation, reward, *ends, info) in enumerate(seen):
        step = i % 251
        if step == 0:
            y = info["z"]
            v = 0.0
            thrust = 49.0
            assert abs(5 - y) <= 1
            # Ours starts elsewhere, which moves the whole flight by as much.
            fly(ours, 0.0, reset=True)
            moved = y - ours.telemetry["position"][0, 2]
        else:
            thrust = min(100.0, max(0.0, thrust + 5 * min(1.0, max(-1.0, action))))
            u = 4 * thrust / 20 - 9.8
            y = y + v * 0.02 + u * 0.02**2 / 2
            v = v + u * 0.02
            fly(ours, action)
            height = ours.telemetry["position"][0, 2]
            assert info["z"] == pytest.approx(height + moved, abs=1e-9)
            assert info["F1"] == pytest.approx(ours.telemetry["thrust"][0, 0], abs=1e-9)
        still = ("x", "y", "qx", "qy", "qz", "vx", "vy", "rate_x", "rate_y", "rate_z")
        assert [info[n] for n in still] == [0.0] * 10
        assert [info[n] for n in ("qw", "goal_x", "goal_y", "goal_z")] == [1.0, 0.0, 0.0, 5.0]
        assert info["vz"] == pytest.approx(v, abs=1e-9)
        assert info["elevation_error"] == 5.0 - info["z"]
        assert [info[n] for n in ("z", "F1", "F2", "F3", "F4")] == pytest.approx(
            [y, thrust, thrust, thrust, thrust], abs=1e-9
        )
        assert observation == pytest.approx([5 - y, -v, thrust / 49 - 1], abs=1e-6)
        error = abs(5 - y)
        assert reward == pytest.approx((0.5 - error) / (0.5 + error) if step else 0.0, abs=1e-9)
        assert ends == [False, step == 250]
    ours.close()


def test_simulator_flies_the_same_whatever_the_network_does(simulator: list[str]) -> None:
    broken = replace(LOSSY, corrupt=0.02, truncate=0.02)
    assert flights(simulator, broken, 60) == flights(simulator, None, 60)


@pytest.mark.parametrize(("config", "episodes"), [(None, 3), (LOSSY, 1)], ids=["clean", "lossy"])
def test_simulator_is_held_by_our_pid(
    simulator: list[str], config: FaultConfig | None, episodes: int
) -> None:
    with udp() as sock:
        address = sock.getsockname()
    command = ours("serve", "pid", "--listen", place(address), "--episodes", episodes)
    with (
        running(command) as serve,
        relayed(address, config) as there,
        running(simulator, place(there)) as process,
    ):
        status, out, _ = ended(serve)
        assert status == 0
        assert ended(process)[0] == 0
    errors = re.findall(r"last E (\S+) m", out)
    assert len(errors) == episodes
    assert max(abs(float(error)) for error in errors) < 0.05


# By hand: the agent's datagrams as the page has them.

NONCE = 0xFEDCBA9876543210


def datagram(kind: int, session: int, sequence: int, body: bytes = b"", version: int = 3) -> bytes:
    head = bytes([0xA7, 0x52, version, kind])
    rest = struct.pack("<QQ", session, sequence) + body
    return head + struct.pack("<I", zlib.crc32(head + rest)) + rest


def welcome(session: int, seed: int | None = None) -> bytes:
    return datagram(2, session, 0, struct.pack("<QQBB6x", NONCE, seed or 0, seed is not None, 3))


def command(
    session: int, sequence: int, action: float = 0.0, order: int = 0, seeds: tuple[int, ...] = ()
) -> bytes:
    body = struct.pack("<I4xf4xB", len(seeds), action, order)
    return datagram(
        5, session, sequence, body + ((seeds and struct.pack(f"<7x{len(seeds)}Q", *seeds)) or b"")
    )


def text_field(reason: str) -> bytes:
    return struct.pack("<H", len(reason.encode())) + reason.encode()


class Hand:
    """An agent by hand: `next` is the simulator's next datagram that is not a repeat."""

    def __init__(self, sock: socket.socket) -> None:
        self.sock = sock
        self.last = b""
        self.session = 0
        self.simulator: tuple[str, int] | None = None

    def receive(self) -> bytes:
        got, address = self.sock.recvfrom(65_535)
        assert self.simulator in (None, address)
        self.simulator = address
        assert zlib.crc32(got[:4] + got[8:]) == struct.unpack_from("<I", got, 4)[0]
        return got

    def next(self) -> bytes:
        got = self.receive()
        while got == self.last:
            got = self.receive()
        self.last = got
        return got

    def repeat(self) -> None:
        """What comes next is the last one again, byte for byte."""
        assert self.receive() == self.last

    def send(self, *datagrams: bytes) -> None:
        assert self.simulator is not None
        for one in datagrams:
            self.sock.sendto(one, self.simulator)

    def hello(self) -> None:
        got = self.next()
        assert got[:4] == b"\xa7\x52\x03\x01"
        session, sequence = struct.unpack_from("<QQ", got, 8)
        assert (session not in (0, self.session), sequence) == (True, 0)
        self.session = session
        low, high, worlds, size = struct.unpack_from("<BB2xII", got, 24)
        assert low == 3
        assert high == 3
        assert worlds == 1
        assert len(got) == 40 + size
        assert EnvSpec.from_json(got[40:].decode()) == replace(
            env_spec(EnvConfig(env_id=ENV_ID)),
            vehicle="point mass",
            vehicle_hash="0" * 32,
            config_digest="",  # it has no config
            constants={"gravity": 9.8},
        )

    def state(self, sequence: int) -> tuple[float, tuple[float, ...], tuple[float, ...], int, int]:
        got = self.next()
        assert len(got) == 72 + 8 * 21
        assert got[:4] == b"\xa7\x52\x03\x04"
        assert struct.unpack_from("<QQ", got, 8) == (self.session, sequence)
        time, nonce = struct.unpack_from("<dQ", got, 24)
        assert time == pytest.approx(0.02 * (sequence - 1))
        assert nonce == (NONCE if sequence == 1 else 0)
        observation = struct.unpack_from("<3f", got, 40)
        (reward,) = struct.unpack_from("<d", got, 56)
        return reward, struct.unpack_from("<21d", got, 72), observation, got[64], got[65]

    def closed(self, sequence: int, reason: str = "") -> None:
        assert self.next() == datagram(6, self.session, sequence, text_field(reason))


def junk(hand: Hand, sequence: int) -> list[bytes]:
    """What must change nothing where a simulator waits for this Command."""
    session = hand.session
    random = Random(0)
    good = command(session, sequence, 0.5)
    reason = text_field("no")
    noise = [random.randbytes(n) for n in (1, 23, 24, 49)]
    cut = [good[:n] for n in range(len(good))]
    flipped = []
    for at in range(len(good)):
        wrong = bytearray(good)
        wrong[at] ^= 1
        flipped.append(bytes(wrong))
    commands = [
        command(session ^ 1, sequence, 0.5),
        command(0, sequence, 0.5),
        command(session, sequence - 1, 0.5),
        command(session, sequence + 1, 0.5),
        command(session, sequence, math.nan),
        command(session, sequence, -math.inf, 1),
        command(session, sequence, 0.5, 3),
        command(session, sequence, 0.5, 1, (1, 2)),
    ]
    bodies = [
        datagram(5, session, sequence, good[24:], version=4),
        datagram(5, session, sequence, struct.pack("<I4xf4xB", 1, 0, 0)),
        datagram(5, session, sequence, struct.pack("<I4xf4xB", 2**32 - 1, 0, 0)),
        datagram(5, session, sequence, struct.pack("<I4x2f2B", 0, 0, 0, 0, 0)),
    ]
    others = [
        datagram(1, session, 0, b"hello"),
        datagram(3, session, 0, reason),
        datagram(4, session, sequence, bytes(100)),
    ]
    closes = [
        datagram(6, session, sequence + 1, reason),
        datagram(6, session, sequence, reason + b"!"),
        datagram(6, session, sequence, b"\x01\x00\xff"),
        datagram(6, session, sequence, b"\x01\x00\n"),
        datagram(6, session, sequence),
        datagram(6, session ^ 1, sequence, reason),
    ]
    kinds = [
        datagram(7, session, 0),
        datagram(8, session, sequence + 1),
        datagram(8, session, sequence, b"\x00"),
        datagram(8, session ^ 1, sequence),
        datagram(9, session, sequence),
        datagram(11, session, sequence),
        welcome(session, 3),
    ]
    plain = [b"", b"1,reset", *noise, *cut, *flipped, good + b"\x00"]
    return [*plain, *commands, *bodies, *others, *closes, *kinds]


def test_simulator_obeys_the_rules(simulator: list[str]) -> None:
    with udp() as sock, udp() as stranger, running(simulator, place(sock.getsockname())) as process:
        hand = Hand(sock)
        hand.hello()
        hand.repeat()
        hand.send(*[d for d in junk(hand, 1) if d[3:4] not in (b"\x02", b"\x03")])
        hand.send(
            welcome(hand.session ^ 1), welcome(hand.session)[:-1], datagram(7, hand.session, 0)
        )
        hand.repeat()
        hand.send(welcome(hand.session, 7))
        first = hand.state(1)
        reward, telemetry, observation, *ends = first
        assert reward == 0
        assert ends == [0, 0]
        height = telemetry[2]
        error = telemetry[20]
        assert telemetry[:13] == (0, 0, height, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0)
        assert telemetry[13:] == (49, 49, 49, 49, 0, 0, 5, error)
        assert error == 5 - height
        assert observation == pytest.approx((5 - height, 0, 0))
        hand.send(*junk(hand, 1))
        hand.repeat()
        hand.repeat()
        stranger.sendto(command(hand.session, 1, 1.0), hand.simulator)
        hand.repeat()
        # The seed of the Welcome is that of the first reset. A reset without one goes on.
        hand.send(command(hand.session, 1, 1.0, 1, (7,)), command(hand.session, 1, 1.0))
        assert hand.state(2) == first
        hand.send(command(hand.session, 2, order=1))
        assert hand.state(3)[2] != observation
        # One step for one Command, however often it comes.
        hand.send(command(hand.session, 3, 0.5), *[command(hand.session, 3, 0.5)] * 3)
        assert hand.state(4)[1][13:17] == (51.5,) * 4
        hand.send(*junk(hand, 4))
        hand.repeat()
        # A frozen drone stays as it is, without a reward.
        before = hand.last
        hand.send(command(hand.session, 4, 1.0, 2))
        frozen = hand.state(5)
        assert frozen[0] == 0
        assert hand.last[72:] == before[72:]
        # An agent that knows nothing of it: a new session.
        old = hand.session
        hand.send(datagram(8, hand.session, 5))
        hand.hello()
        hand.send(command(old, 5, 0.5), datagram(8, old, 5), datagram(6, old, 5, text_field("")))
        hand.repeat()
        hand.send(welcome(hand.session))
        begun = hand.state(1)
        hand.send(command(hand.session, 1, 0, 1, (hand.session,)))
        assert hand.state(2) == begun  # without a seed, the session's number is one
        hand.send(datagram(6, hand.session, 1, text_field("enough")))
        hand.closed(2)
        status, out, err = ended(process)
    assert status == 0
    assert err == ""
    assert out.startswith("enough\n7 states, 2 sessions;")


def test_simulator_ends_as_the_rules_say(simulator: list[str]) -> None:
    with udp() as sock, running(simulator, place(sock.getsockname())) as process:
        hand = Hand(sock)
        hand.hello()
        hand.send(datagram(3, hand.session, 0, text_field("too old"), version=4))
        status, out, _ = ended(process)
        assert status == 1
        assert out.splitlines()[0] == "refused by the agent: too old"
    with udp() as sock, running(simulator, place(sock.getsockname())) as process:
        hand = Hand(sock)
        hand.hello()
        hand.send(welcome(hand.session))
        terminated = 0
        sequence = 0
        while not terminated:
            sequence += 1
            reward, telemetry, _, terminated, truncated = hand.state(sequence)
            hand.send(command(hand.session, sequence, 1e30))
        error = abs(5 - telemetry[2])
        assert error > 3
        assert reward == pytest.approx((0.5 - error) / (0.5 + error) - 20)
        assert truncated == 0
        reason = "drone 0 was flown on after its episode's end: send a reset"
        hand.closed(sequence, reason)
        hand.repeat()  # until it is answered
        hand.send(datagram(6, hand.session, sequence, text_field("")))
        status, out, _ = ended(process)
        assert status == 1
        assert out.splitlines()[0] == reason
    with (
        udp() as sock,
        running(simulator, place(sock.getsockname()), "--timeout", "0.3") as process,
    ):
        status, out, _ = ended(process)
        assert status == 1
        assert out.splitlines()[0] == "no answer from the agent for 0.3 s"
    with (
        udp() as sock,
        running(simulator, place(sock.getsockname()), "--timeout", "1.5") as process,
    ):
        hand = Hand(sock)
        hand.hello()
        hand.send(welcome(hand.session))
        hand.state(1)
        for _ in range(10):  # 2 s: the agent waits for another simulator
            time.sleep(0.2)
            hand.send(datagram(9, hand.session, 1))
        hand.send(command(hand.session, 1, 0.0))
        hand.state(2)


UNITY = """
using System;
namespace UnityEngine {
public class Component { public Transform transform;
    public T GetComponent<T>() { throw new Exception(); } }
public class MonoBehaviour : Component { public bool enabled; }
public class Transform { public void SetPositionAndRotation(Vector3 p, Quaternion r) {} }
public class Rigidbody : Component { public Vector3 position, velocity, angularVelocity;
    public void AddForce(Vector3 force) {} }
public struct Vector3 { public float x, y, z; public static Vector3 zero;
    public Vector3(float x, float y, float z) { this.x = x; this.y = y; this.z = z; } }
public struct Quaternion { public static Quaternion identity; }
public enum SimulationMode { Script }
public static class Physics {
    public static SimulationMode simulationMode; public static Vector3 gravity;
    public static void Simulate(float step) {} public static void SyncTransforms() {} }
public static class Debug { public static void Log(object message) {} }
public class RequireComponent : Attribute { public RequireComponent(Type type) {} }
public static class Uses { // it fails to compile without the script
    public static MonoBehaviour Script(Rotorgram.RotorgramBehaviour script) { return script; } }
}
"""


def test_unity_script_compiles(tmp_path: Path) -> None:
    """Against a stub of what it uses: Unity itself is not here."""
    stub = tmp_path / "Unity.cs"
    stub.write_text(UNITY)
    out = f"-out:{tmp_path / 'unity.dll'}"
    sources = sorted(PEERS.glob("*.cs"))
    compiled(tool("mcs"), "-t:library", "-d:UNITY_5_3_OR_NEWER", out, *sources, stub)
    assert (tmp_path / "unity.dll").is_file()

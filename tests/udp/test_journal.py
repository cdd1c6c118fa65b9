"""The journal: what is in it, that it can be repeated, and that no end of a program spoils it."""

import gc
import io
import json
import logging
import os
import re
import signal
import struct
import textwrap
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.writer import Writer
from peers import ANY, ENV_ID, TABLES, launch, simulate
from relay import FaultConfig, relaying
from rotorgram.cli.replay import Replay
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.loop import Loop
from rotorgram.models.errors import InputError
from rotorgram.udp import (
    LinkConfig,
    PeerSilent,
    Refused,
    RemoteEnv,
    RemoteVectorEnv,
    Simulator,
)
from rotorgram.udp.journal import Journal, Recording, Summary
from rotorgram.udp.journal import writer as journal_module
from rotorgram.udp.journal.reader import MAX_CHUNK
from rotorgram.udp.journal.replay import Verification
from rotorgram.udp.protocol import binary
from rotorgram.udp.protocol.auth import write_key
from rotorgram.udp.protocol.messages import FLY, Close, Command, Hello, Message, State, Welcome

PAGE = Path(__file__).parents[2] / "docs" / "journal.md"
TIMES: dict[str, Any] = {"timeout": 5, "connect_timeout": 5}


def fly(remote: Any, steps: int, seed: int | None = 7) -> SimpleNamespace:
    """Fly at random; steps, resets and episodes as the agent sees them."""
    remote.reset(seed=seed)
    remote.action_space.seed(steps)
    drones = getattr(remote, "num_envs", 1)
    flown = 0
    resets = 1
    episodes = 0
    ended = np.zeros(drones, bool)
    for _ in range(steps):
        _, _, terminated, truncated, _ = remote.step(remote.action_space.sample())
        flown += int((~ended).sum())
        ended = np.atleast_1d(terminated) | np.atleast_1d(truncated)
        episodes += int(ended.sum())
        if drones == 1 and ended[0]:
            remote.reset()
            resets += 1
            ended = np.zeros(1, bool)
    return SimpleNamespace(steps=flown, resets=resets, episodes=episodes)


@contextmanager
def pair(
    folder: Path, codec: Any = "binary", drones: int = 1, key: bool = False, **options: Any
) -> Iterator[SimpleNamespace]:
    """An agent and a simulator in a thread that both keep a journal."""
    files = {side: folder / f"{side}.mcap" for side in ("agent", "simulator")}
    key_file = folder / "key" if key else None
    if key_file:
        write_key(key_file)
    known = options if codec == "text" else None
    env_id = ENV_ID if codec == "text" else None
    common: dict[str, Any] = {
        "env_id": env_id, "options": known, "connect": False, "key_file": key_file, **TIMES,
        "record": None if codec == "text" else files["agent"],
    }  # fmt: skip
    remote: Any
    if drones == 1:
        remote = RemoteEnv(ANY, **common)
    else:
        remote = RemoteVectorEnv(ANY, num_envs=drones, **common)
    ours = {"key_file": key_file, "record": files["simulator"], **options}
    running = simulate(remote, num_envs=drones, codec=codec, **ours)
    try:
        yield SimpleNamespace(remote=remote, **files)
    finally:
        remote.close()
        running.join()


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """The files of a flight of 3 drones, 600 steps, and what it came to."""
    with pair(tmp_path_factory.mktemp("flight"), drones=3) as both:
        seen = fly(both.remote, 600)
    return SimpleNamespace(agent=both.agent, simulator=both.simulator, seen=seen)


def datagrams(path: Path, *kinds: type) -> list[bytes]:
    """Those of States and Commands, or of the messages asked for, in order."""
    wanted = kinds or (State, Command)
    return [item.datagram for item in Recording(path) if isinstance(item.message, wanted)]


def steps_of(path: Path) -> list[int]:
    """Steps of all drones of each session."""
    steps: dict[int, int] = {}
    for item in Recording(path):
        flown = item.message.orders == FLY if isinstance(item.message, Command) else []
        steps[item.session.index] = steps.get(item.session.index, 0) + int(np.sum(flown))
    return list(steps.values())


def rewrite(source: Path, target: Path, change: Callable[[Message], Message]) -> None:
    """Write a journal again with changed messages."""
    recording = Recording(source)
    target.unlink(missing_ok=True)
    journal = Journal(target, side=recording.about["side"], about=recording.about)
    for item in recording:
        message = change(item.message)
        data = binary.encode(message, item.session.layout)
        journal.tap(item.session.slot, message, data)
    journal.close()


def flip(array: np.ndarray, *index: int) -> np.ndarray:
    """A copy with the last bit of one number flipped."""
    copy = array.copy()
    kind = {1: np.uint8, 4: np.uint32, 8: np.uint64}[copy.itemsize]
    copy.view(kind)[index] ^= 1
    return copy


def flipped(arrays: tuple[np.ndarray, ...], which: int, *index: int) -> tuple[np.ndarray, ...]:
    """Arrays with the last bit of one number of one of them flipped."""
    return tuple(flip(a, *index) if i == which else a for i, a in enumerate(arrays))


# ---- repeating


@pytest.mark.parametrize(
    ("arrangement", "options"),
    [
        ({}, {}),
        ({"codec": "text"}, {"target": (4.0, 6.0), "episode_length": 40}),
        ({"drones": 3, "key": True}, {"action_type": "discrete", "observation": "error"}),
    ],
)
def test_both_sides_can_be_repeated_bit_for_bit(
    arrangement: dict[str, Any], options: dict[str, Any], tmp_path: Path
) -> None:
    with pair(tmp_path, **arrangement, **options) as both:
        seen = fly(both.remote, 500)
    assert seen.episodes > 1
    sides = ["simulator"] if arrangement.get("codec") == "text" else ["agent", "simulator"]
    for side in sides:
        path = getattr(both, side)
        summary = Summary(path)
        verdict = Verification(path)
        assert (summary.about["side"], summary.complete, summary.ending) == (side, True, "complete")
        assert steps_of(path) == [seen.steps]
        (session,) = summary.sessions
        assert session.states == 501 + seen.resets
        assert session.num_envs == arrangement.get("drones", 1)
        codec = summary.about.get("codec", "binary")  # of a simulator
        assert codec == arrangement.get("codec", "binary")
        assert session.ending.startswith("closed: the ")
        assert 0 < session.last - session.first < 60e9
        (compared,) = verdict.sessions
        assert compared.same == session.states
        assert verdict.identical
        assert str(verdict).endswith(f"identical: {compared.same} States in 1 session")
    first, *others = [datagrams(getattr(both, side), State)[1][40:] for side in sides]
    assert all(other == first for other in others)


def test_a_tilted_flight_by_text_is_repeated(tmp_path: Path) -> None:
    file = tmp_path / "simulator.mcap"
    hover = "rotorgram/Hover-v0"
    remote = RemoteEnv(ANY, env_id=hover, options={}, connect=False, timeout=5)
    running = simulate(remote, env=hover, codec="text", record=file)
    remote.reset(seed=3)
    for _ in range(10):
        *_, info = remote.step(np.array([0.1, -0.1, 0.05, 0.0], np.float32))
    assert abs(info["qx"]) > 1e-3
    remote.close()
    running.join()
    assert Verification(file).identical


def test_an_agent_with_a_journal_does_not_fly_text(tmp_path: Path) -> None:
    record = tmp_path / "agent.mcap"
    with closing(RemoteEnv(ANY, env_id=ENV_ID, connect=False, record=record, **TIMES)) as remote:
        running = simulate(remote, codec="text")
        with pytest.raises(PeerSilent, match="text is not flown here"):
            remote.connect()
        assert isinstance(running.join(), Refused)


@pytest.mark.parametrize("drones", [1, 3])
def test_what_acts_is_drawn_and_is_measured_is_repeated(drones: int, tmp_path: Path) -> None:
    world = TABLES["effects, draws and sensors"]
    options = {**world, "vehicle": "crazyflie2", "env": "rotorgram/Hover-v0", "episode_length": 40}
    with pair(tmp_path, drones=drones, **options) as both:
        assert fly(both.remote, 150, seed=None).episodes > 1
        if drones > 1:
            both.remote.reset(seed=5, options={"reset_mask": np.array([True, False, True])})
            both.remote.step(both.remote.action_space.sample())
    for side in ("agent", "simulator"):
        assert Verification(getattr(both, side), vehicle="crazyflie2").identical


def test_a_flight_on_rigid_is_repeated_on_rigid(tmp_path: Path) -> None:
    with pair(tmp_path, drones=3, env="rotorgram/Hover-v0", backend="rigid") as both:
        assert fly(both.remote, 100).episodes > 1
    for side in ("agent", "simulator"):
        path = getattr(both, side)
        assert Verification(path, backend="rigid").identical
        assert not Verification(path, backend="mujoco").identical  # which computes in float64
    assert Recording(both.simulator).about["backend"] == "rigid"
    assert Verification(both.simulator).identical


def test_both_sides_write_the_same_datagrams(flight: SimpleNamespace) -> None:
    everything = State, Command, Hello, Welcome
    ours = datagrams(flight.agent, *everything)
    theirs = datagrams(flight.simulator, *everything)
    assert ours == theirs
    assert len(ours) == 2 * 602 + 1  # Hello, Welcome, State 1 and its reset; the last has no answer


def test_nothing_that_a_journal_names_is_imported(
    flight: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "evil.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(str(tmp_path))
    for env_id in ("evil:Evil-v0", "CartPole-v1", "rotorgram/No-v0"):
        path = tmp_path / "named.mcap"
        rewrite(flight.simulator, path, changed_spec(env_id=env_id))
        (session,) = Verification(path).sessions
        assert session.problem.startswith(
            "State 1 cannot be repeated: env: expected a registered id ("
        )
        assert session.problem.endswith(f", got {env_id!r}")
        assert Summary(path).sessions[0].spec.env_id == env_id
    path = tmp_path / "named.mcap"  # a module before an id that is registered changes nothing
    name = f"evil:{ENV_ID}"
    rewrite(flight.simulator, path, changed_spec(env_id=name))
    assert Verification(path).identical


def changed_spec(**values: Any) -> Callable[[Message], Message]:
    """Changes fields of the spec of every Hello."""

    def changed(message: Message) -> Message:
        if not isinstance(message, Hello):
            return message
        return replace(message, spec=json.dumps(json.loads(message.spec) | values))

    return changed


def test_a_flight_of_another_env_is_recorded_and_not_repeated(tmp_path: Path) -> None:
    path = tmp_path / "pole.mcap"
    remote = RemoteEnv(ANY, env_id="CartPole-v1", connect=False, **TIMES)
    pole = gym.make("CartPole-v1", sutton_barto_reward=True)
    running = simulate(remote, env=pole, record=path)
    with remote:
        fly(remote, 60)
    running.join()
    assert steps_of(path) == [60]
    assert not Verification(path).identical


def test_a_flight_that_never_began(tmp_path: Path) -> None:
    path = tmp_path / "alone.mcap"
    config = LinkConfig(timeout=0.1)
    with Simulator(server=("127.0.0.1", 9), bind=ANY, record=path, config=config) as simulator:
        with pytest.raises(PeerSilent):
            simulator.run()
        (session,) = Summary(path).sessions  # finished by the end of `run`
    assert session.ending == "not closed"
    assert session.states == 0
    assert str(Verification(path)).endswith("nothing to compare")
    assert not Verification(path).identical


def test_a_refused_simulator(tmp_path: Path) -> None:
    path = tmp_path / "refused.mcap"
    with RemoteEnv(ANY, env_id=ENV_ID, connect=False, timeout=5, connect_timeout=1) as remote:
        running = simulate(remote, env=gym.make("CartPole-v1"), record=path)
        with pytest.raises(PeerSilent):
            remote.connect()
        assert isinstance(running.join(), Refused)
    (session,) = Summary(path).sessions
    assert session.ending.startswith("refused: ")
    assert ENV_ID in session.ending


CHANGES = {
    "reward": lambda s: replace(s, rewards=flip(s.rewards, 2)),
    "telemetry qx": lambda s: replace(s, telemetry=flipped(s.telemetry, 1, 2, 1)),
    "observation rate of the error": (
        lambda s: replace(s, observations=flipped(s.observations, 0, 2, 1))
    ),
    "truncated": lambda s: replace(s, truncated=flip(s.truncated, 2)),
}


@pytest.mark.parametrize("field", CHANGES)
def test_one_flipped_bit_is_found(field: str, flight: SimpleNamespace, tmp_path: Path) -> None:
    path = tmp_path / "flipped.mcap"

    def change(message: Message) -> Message:
        chosen = isinstance(message, State) and message.sequence == 123
        return CHANGES[field](message) if chosen else message

    rewrite(flight.simulator, path, lambda message: message)
    assert Verification(path).identical
    rewrite(flight.simulator, path, change)
    verdict = Verification(path)
    assert not verdict.identical
    (session,) = verdict.sessions
    found = session.difference
    assert found is not None
    assert found.sequence == 123
    assert found.drone == 2
    assert found.field == field
    assert session.differing == 1
    assert session.same == 601
    assert found.recorded != found.replayed
    if field == "reward":
        was, now = float(found.recorded), float(found.replayed)
        assert abs(was - now) == pytest.approx(np.spacing(now), rel=0.5)
        assert f"State 123, drone 2, reward: recorded {found.recorded}" in str(verdict)


def test_other_options_and_another_model_are_noticed(
    flight: SimpleNamespace, tmp_path: Path
) -> None:
    def other(**values: Any) -> Path:
        path = tmp_path / "other.mcap"
        rewrite(flight.simulator, path, changed_spec(**values))
        return path

    options = dict(next(iter(Recording(flight.simulator))).session.spec.options)
    verdict = Verification(other(options=options | {"effects": {"linear_drag": 0.5}}))
    hashes = "expected an env of the vehicle_hash '[0-9a-f]{32}', got '[0-9a-f]{32}'"
    assert re.search(hashes, verdict.sessions[0].problem)
    verdict = Verification(other(vehicle_hash="1" * 32))
    assert re.search(hashes, verdict.sessions[0].problem)
    assert verdict.sessions[0].problem.endswith(" (--vehicle names its file)")
    verdict = Verification(other(options=options | {"target": 6.5}))
    found = verdict.sessions[0].difference
    assert found is not None
    assert found.sequence == 1
    verdict = Verification(other(options=options | {"observation": "error"}))
    assert "State 1 cannot be repeated: expected an env of the observation " in (
        verdict.sessions[0].problem
    )
    assert str(verdict).endswith("not identical")
    verdict = Verification(other(options=options | {"gravity": 1}))
    assert "State 1 cannot be repeated: " in verdict.sessions[0].problem


def test_a_missing_command_is_noticed(flight: SimpleNamespace, tmp_path: Path) -> None:
    path = tmp_path / "gap.mcap"

    def change(message: Message) -> Message:
        if isinstance(message, Command) and message.sequence == 50:
            return replace(message, sequence=51)
        return message

    rewrite(flight.agent, path, change)
    (session,) = Verification(path).sessions
    assert session.same == 50
    assert (
        session.problem
        == "State 51 cannot be repeated: expected Command 50 before it, got none of that number"
    )


# ---- sessions


def test_several_simulators_at_once(tmp_path: Path) -> None:
    path = tmp_path / "agent.mcap"
    remote = RemoteVectorEnv(ANY, num_simulators=2, num_envs=4, connect=False, record=path, **TIMES)
    running = [simulate(remote, num_envs=2) for _ in range(2)]
    seen = fly(remote, 300)
    remote.close()
    for one in running:
        one.join()
    summary = Summary(path)
    assert [s.slot for s in summary.sessions] == [0, 1]
    assert sum(steps_of(path)) == seen.steps
    assert Verification(path).identical
    with path.open("rb") as file:
        topics = {c.topic for c in make_reader(file).get_summary().channels.values()}
    assert topics == {"/slot0", "/slot1"}


def test_an_agent_that_was_started_anew(tmp_path: Path) -> None:
    path = tmp_path / "simulator.mcap"
    killed = launch(RECORD, 0, tmp_path / "killed.mcap", 20, "wait")
    assert killed.stdout is not None
    address = "127.0.0.1", int(killed.stdout.readline())
    running = simulate(address, record=path)
    while not killed.stdout.readline().startswith("flown"):
        pass
    killed.kill()
    killed.communicate()
    with RemoteEnv(address, connect=False, **TIMES) as second:
        fly(second, 20)
    running.join()
    summary = Summary(path)
    assert [s.ending for s in summary.sessions] == [
        "the agent does not know this session",
        "closed: the agent closed",
    ]
    assert steps_of(path) == [20, 20]
    assert Verification(path).identical


def test_loss_and_repetition_do_not_enter(tmp_path: Path) -> None:
    ours = tmp_path / "agent.mcap"
    theirs = tmp_path / "simulator.mcap"
    faults = FaultConfig(drop=0.1, duplicate=0.1, reorder=0.1, corrupt=0.05, seed=3)
    remote = RemoteEnv(ANY, connect=False, record=ours, **TIMES)
    with relaying(remote.address, faults) as relay:
        running = simulate(relay, record=theirs)
        fly(remote, 200)
        remote.close()
        running.join()
    assert relay.counters["dropped"] > 10
    assert datagrams(ours)[:-1] == datagrams(theirs)[: len(datagrams(ours)) - 1]
    numbers = [binary.peek(datagram)[::2] for datagram in datagrams(theirs)]
    assert numbers[:-1] == [(kind, n) for n in range(1, len(numbers) // 2 + 1) for kind in (4, 5)]
    assert Verification(ours).identical
    assert Verification(theirs).identical


# ---- the file


def test_it_is_valid_mcap_with_checksums_and_summary(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(journal_module, "_CHUNK", 5000)
    with pair(tmp_path) as both:
        fly(both.remote, 300)
    for path in (both.agent, both.simulator):
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            summary = reader.get_summary()
            messages = [(c.topic, m) for _, c, m in reader.iter_messages()]
            assert reader.get_header().library == "rotorgram 0.1.0"
        assert summary is not None
        counts = summary.statistics
        assert counts.message_count == len(messages)
        assert counts.chunk_count == len(summary.chunk_indexes) > 10
        assert {topic for topic, _ in messages} == {"/slot0"}
        assert abs(counts.message_end_time - time.time_ns()) < 60e9
        states = [m for _, m in messages if binary.peek(m.data)[0] == binary.STATE]
        assert len(states) > 300
        assert [m.sequence for m in states] == list(range(1, len(states) + 1))


def test_what_else_is_in_it(flight: SimpleNamespace) -> None:
    ours = Recording(flight.agent)
    theirs = Recording(flight.simulator)
    hello = next(iter(theirs)).session.hello
    assert ours.about["side"] == "agent"
    assert theirs.about["version of mujoco"][0].isdigit()
    with flight.agent.open("rb") as file:
        _, _, first = next(make_reader(file).iter_messages("/slot0"))
    assert binary.decode(first.data) == hello


def test_it_is_written_every_second_and_when_a_clock_is_set_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [10**18]
    monkeypatch.setattr(time, "time_ns", lambda: now[0])
    path = tmp_path / "j.mcap"
    sizes = []
    journal = Journal(path, side="agent")
    close = Close(session=1, sequence=1, reason="x" * 500)
    hello = Hello(session=1, spec=Loop(EnvConfig(env_id=ENV_ID)).spec.to_json())
    journal.tap(0, hello, binary.encode(hello))
    for _ in range(50):
        now[0] += 5 * 10**8
        journal.tap(0, close, binary.encode(close))
        journal.write()
        sizes.append(path.stat().st_size)
    now[0] -= 3600 * 10**9
    journal.tap(0, close, binary.encode(close))
    journal.write()
    assert path.stat().st_size > sizes[-1]  # written at once
    journal.close()
    journal.close()
    journal.tap(0, close, binary.encode(close))
    assert sum(b > a for a, b in pairwise(sizes)) in (24, 25)
    assert len(list(Recording(path))) == 52


def test_a_file_that_is_there_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "old.mcap"
    path.write_bytes(b"precious")
    sentence = "record: expected a file that does not exist yet, got "
    with pytest.raises(FileExistsError, match=sentence):
        Simulator(bind=ANY, record=path)
    with pytest.raises(FileExistsError, match=sentence):
        RemoteEnv(ANY, connect=False, record=path)
    assert path.read_bytes() == b"precious"
    with pytest.raises(FileNotFoundError):
        RemoteEnv(ANY, connect=False, record=tmp_path / "no" / "where.mcap")
    gc.collect()


def test_what_is_no_journal(tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_bytes(b"not at all an mcap file")
    with pytest.raises(ValueError, match="expected an MCAP file, got another"):
        Summary(path)
    buffer = io.BytesIO()
    writer = Writer(buffer)
    writer.start()
    writer.finish()
    path.write_bytes(buffer.getvalue())
    with pytest.raises(ValueError, match="expected a journal of format 5, got 'another MCAP file'"):
        Verification(path)
    with pytest.raises(FileNotFoundError):
        Verification(tmp_path / "none")


# ---- hostile files


def test_a_chunk_that_grows_is_not_read(flight: SimpleNamespace, tmp_path: Path) -> None:
    """A short chunk can decompress to any number of bytes."""
    head = flight.simulator.read_bytes()
    begin = head.index(b"\x06", head.index(b"backend"))  # opcode of the first chunk
    while struct.unpack_from("<BQ", head, begin)[1] > len(head):
        begin = head.index(b"\x06", begin + 1)
    for content, size in (
        (bytes(4 * MAX_CHUNK), 4 * MAX_CHUNK),
        (bytes(4 * MAX_CHUNK), MAX_CHUNK),
        (bytes(4 * MAX_CHUNK), 100),
    ):
        compressed = zstandard.ZstdCompressor(level=19).compress(content)
        assert len(compressed) < 20_000
        body = struct.pack("<QQQII", 0, 0, size, 0, 4) + b"zstd"
        body += struct.pack("<Q", len(compressed)) + compressed
        path = tmp_path / "bomb.mcap"
        path.write_bytes(head[:begin] + struct.pack("<BQ", 6, len(body)) + body)
        program = (
            "import resource, sys; from rotorgram.udp.journal import Summary; "
            "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss; "
            "print(Summary(sys.argv[1]).ending); "
            "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)"
        )
        out, errors = launch(program, path).communicate(timeout=60)
        ending, kilobytes = out.splitlines()
        assert errors == ""
        assert ending.startswith("cut off")
        assert int(kilobytes) < 3 * MAX_CHUNK / 1024


def test_a_spec_that_is_nested_too_deep(tmp_path: Path) -> None:
    path = tmp_path / "deep.mcap"
    with path.open("wb") as new:
        writer = Writer(new)
        writer.start()
        writer.add_metadata("rotorgram", {"format": "5"})
        channel = writer.register_channel("/slot0", "rotorgram", 0)
        writer.add_message(channel, 0, binary.encode(Hello(session=1, spec="[" * 200_000)), 0)
        writer.finish()
    with pytest.raises(InputError, match=r"deep\.mcap: a message that cannot be read: .* maximum"):
        Summary(path)


def test_terminal_escapes_are_not_printed(tmp_path: Path) -> None:
    path = tmp_path / "escape.mcap"
    escapes = dict.fromkeys(("side", "version of numpy"), "\x1b[2J\x9b31m\u202e")
    Journal(path, side="", about=escapes).close()
    out = str(Summary(path)) + str(Verification(path))
    assert "[2J" in out
    assert all(character.isprintable() or character == "\n" for character in out)


# ---- ends that nobody wished for


def test_a_file_that_was_cut_is_read_up_to_the_cut(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(journal_module, "_CHUNK", 10_000)
    with pair(tmp_path) as both:
        fly(both.remote, 500)
    for path in (both.agent, both.simulator):
        whole = datagrams(path, object)
        data = path.read_bytes()
        cut = tmp_path / "cut.mcap"
        sizes = []
        for tenth in range(10):
            for size in (len(data) * tenth // 10, len(data) * tenth // 10 + 3):
                cut.write_bytes(data[:size])
                part = datagrams(cut, object)
                assert part == whole[: len(part)]
                summary = Summary(cut)
                verdict = Verification(cut)
                assert not summary.complete
                assert summary.ending.startswith("cut off")
                assert all(session.identical for session in verdict.sessions)
                assert verdict.identical == bool(part)
                sizes.append(len(part))
        assert sizes == sorted(sizes)
        assert sizes[-1] > 0.8 * len(whole)
        cut.write_bytes(data[:-1])  # no message is missing, and yet it is not complete
        assert datagrams(cut, object) == whole
        assert not Summary(cut).complete


def test_a_damaged_file_is_read_up_to_the_damage(flight: SimpleNamespace, tmp_path: Path) -> None:
    data = bytearray(flight.simulator.read_bytes())
    for at in range(len(data) // 2, len(data) // 2 + 5000):
        data[at] ^= 0x10
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    summary = Summary(path)
    assert not summary.complete
    assert summary.ending.startswith("damaged (")
    recording = Recording(path)
    for _ in range(2):
        list(recording)
        assert recording.ending.startswith("damaged ("), "also when it is read again"
    assert all(session.identical for session in Verification(path).sessions)
    assert Replay(file=path, verify=True).run() == 1, "a script must not take it for verified"


RECORD = """
    import sys, time, numpy as np
    from rotorgram.udp import RemoteEnv
    remote = RemoteEnv(("127.0.0.1", int(sys.argv[1])), record=sys.argv[2], connect=False)
    print(remote.address[1], flush=True)
    remote.reset(seed=1)
    for step in range(int(sys.argv[3])):
        if any(remote.step(np.zeros(1, np.float32))[2:4]):
            remote.reset()
        if step % 50 == 0:
            print("step", time.time_ns(), flush=True)
    print("flown", flush=True)
    if sys.argv[4:]:
        time.sleep(60)
"""


def test_sigkill_costs_at_most_a_second(tmp_path: Path) -> None:
    path = tmp_path / "agent.mcap"
    process = launch(RECORD, 0, path, 10**9)
    assert process.stdout is not None
    port = int(process.stdout.readline())
    running = simulate(("127.0.0.1", port), LinkConfig(timeout=1))
    start = time.monotonic()
    last = ""
    while time.monotonic() - start < 2.5:
        last = process.stdout.readline()
    process.kill()
    process.communicate()
    assert isinstance(running.join(), PeerSilent)
    items = list(Recording(path))
    lost = int(last.split()[1]) - items[-1].time
    assert lost < 1.1e9
    assert len(items) > 1000
    verdict = Verification(path)
    assert verdict.identical
    assert not verdict.complete
    assert "note: the file is cut off" in str(verdict)


@pytest.mark.parametrize("goodbye", ["", "import os; os.kill(os.getpid(), 2)", "1 / 0"])
def test_the_end_of_the_program_finishes_the_file(goodbye: str, tmp_path: Path) -> None:
    path = tmp_path / "agent.mcap"
    process = launch(textwrap.dedent(RECORD) + goodbye + "\n", 0, path, 100)
    assert process.stdout is not None
    port = int(process.stdout.readline())
    running = simulate(("127.0.0.1", port))
    _, errors = process.communicate(timeout=30)
    assert bool(errors) == bool(goodbye)
    assert running.join() == "the agent closed"
    summary = Summary(path)
    assert summary.complete
    assert steps_of(path) == [100]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_takes_effect_after_the_write(
    number: int, flight: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One comes in the middle of each chunk, and one in the middle of the end."""

    def interrupted(write: Callable[[Writer], None]) -> Callable[[Writer], None]:
        def write_with_signal(writer: Writer) -> None:
            signal.raise_signal(number)
            write(writer)

        return write_with_signal

    path = tmp_path / "agent.mcap"
    items = list(Recording(flight.agent))[:5]
    monkeypatch.setattr(journal_module, "_CHUNK", 0)  # each message is a chunk
    for name in ("flush", "finish"):
        monkeypatch.setattr(Writer, name, interrupted(getattr(Writer, name)))
    earlier = signal.signal(number, signal.default_int_handler)
    try:
        journal = Journal(path, side="agent")
        for item in items:
            journal.tap(item.session.slot, item.message, item.datagram)
            with pytest.raises(KeyboardInterrupt):
                journal.write()
        with pytest.raises(KeyboardInterrupt):
            journal.close()
    finally:
        signal.signal(number, earlier)
    assert Recording(path).complete
    assert datagrams(path, object) == [item.datagram for item in items]


@pytest.mark.parametrize("goodbye", ["sys.exit()", "del remote; os._exit(0)"])
def test_a_forked_child_leaves_its_parents_file_alone(goodbye: str, tmp_path: Path) -> None:
    path = tmp_path / "agent.mcap"  # fault 34
    fork = f"""
import os
if not os.fork():
    {goodbye}
os.wait()
for _ in range(50):
    remote.step(np.zeros(1, np.float32))
"""
    process = launch(textwrap.dedent(RECORD) + fork, 0, path, 100)
    assert process.stdout is not None
    server = "127.0.0.1", int(process.stdout.readline())
    running = simulate(server)
    _, errors = process.communicate(timeout=30)
    assert errors == ""
    assert running.join() == "the agent closed"
    summary = Summary(path)
    assert summary.complete
    assert steps_of(path) == [150]
    assert Verification(path).identical


def test_a_full_device_ends_the_record_and_not_the_flight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(journal_module, "_CHUNK", 10_000)
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with caplog.at_level(logging.WARNING, "rotorgram.udp"), pair(tmp_path) as both:
        both.remote.reset(seed=1)
        fly(both.remote, 100)
        room = 8192 + max(p.stat().st_size for p in (both.agent, both.simulator))
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
        try:
            seen = fly(both.remote, 400)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert seen.steps == 400
    warnings = [record.getMessage() for record in caplog.records]
    assert len(warnings) == 2  # one for each file
    for warning in warnings:
        assert re.fullmatch(
            r"record: writing .*\.mcap failed \(File too large\): the flight goes on, its journal "
            "ends here",
            warning,
        )
    for path in (both.agent, both.simulator):
        assert path.stat().st_size <= room
        assert not Summary(path).complete
        assert Summary(path).sessions[0].states > 102
        assert Verification(path).identical


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full here")
def test_a_device_that_is_full_from_the_beginning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "full.mcap"
    opened = Path.open

    def full(self: Path, *arguments: Any, **words: Any) -> Any:
        file = opened(self, *arguments, **words)
        if self != path:
            return file
        file.close()
        return open("/dev/full", "wb")

    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(OSError, match="No space left on device"):
        RemoteEnv(ANY, connect=False, record=path)
    assert not path.exists()


# ---- the page


def test_the_snippet_of_the_page(
    flight: SimpleNamespace, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    assert len(code.splitlines()) <= 12
    exec(code.replace("flight.mcap", str(flight.simulator)), {})
    lines = capsys.readouterr().out.splitlines()
    states = [i.message for i in Recording(flight.simulator) if isinstance(i.message, State)]
    assert len(lines) == len(states)
    assert float(lines[-1].split()[-1]) == states[-1].telemetry[0][0, 2]

"""Writes golden.json: datagrams for whoever writes a peer, byte by byte, right ones and wrong ones.

python tests/golden.py
"""

import json
import zlib
from dataclasses import fields
from hashlib import blake2b
from pathlib import Path
from typing import Any, Final

import numpy as np
from rotorgram.envs.spec import ArraySpec, Discrete, EnvSpec, Metric
from rotorgram.udp.layouts import layout_of
from rotorgram.udp.protocol import binary
from rotorgram.udp.protocol.auth import Key
from rotorgram.udp.protocol.fragments import Transfer
from rotorgram.udp.protocol.messages import (
    Alive,
    Close,
    Command,
    Extension,
    Hello,
    Message,
    Missing,
    Refuse,
    State,
    Unknown,
    Wait,
    Welcome,
)

FILE: Final = Path(__file__).parent.parent / "docs" / "golden.json"
SESSION: Final = 0x0123456789ABCDEF
NONCE: Final = 0xFEDCBA9876543210
SECRET: Final = bytes(range(32))
LARGEST: Final = 60
"""Of a datagram in the cases with fragments, bytes."""

ONE: Final = EnvSpec(
    env_id="a/One-v0",
    options={"target": 5.0},
    control_period=0.02,
    vehicle="quad",
    vehicle_hash="00112233445566778899aabbccddeeff",
    config_digest="ffeeddccbbaa99887766554433221100",
    observation=(ArraySpec(name="observation", shape=(3,), low=-1.0, high=(1.0, 2.0, 3.0)),),
    action=Discrete(n=3),
    telemetry=(
        ArraySpec(name="position", shape=(3,), unit="m", frame="world", components=("x", "y", "z")),
        ArraySpec(name="metrics", shape=(1,), unit="m", components=("error",)),
    ),
    metrics=(Metric(name="error", unit="m"),),
    constants={"gravity": 9.8, "gains": (0.5, 2.0)},
)
TWO: Final = EnvSpec(
    env_id="a/Two-v0",
    control_period=0.1,
    observation=(
        ArraySpec(name="picture", shape=(1, 2, 3), dtype="uint8", low=0, high=255),
        ArraySpec(name="state", shape=(1,), low=-1, high=1),
    ),
    action=ArraySpec(name="action", shape=(1,), low=-1.0, high=1.0),
)
SWARM: Final = EnvSpec(
    env_id="a/Swarm-v0",
    control_period=0.02,
    agents=("drone_0", "drone_1", "drone_2"),
    observation=(ArraySpec(name="observation", shape=(1,)),),
    action=ArraySpec(name="action", shape=(1,), low=-1.0, high=1.0),
    telemetry=(ArraySpec(name="metrics", shape=(1,), components=("error",)),),
    metrics=(Metric(name="error", unit="m"),),
)
WORLDS: Final = {"one": 1, "two": 2, "swarm": 2}
SPECS: Final = {"one": ONE, "two": TWO, "swarm": SWARM}
LAYOUTS: Final = {name: layout_of(spec, WORLDS[name]) for name, spec in SPECS.items()}


def f4(*values: Any) -> np.ndarray:
    return np.array(values, np.float32)


def one_state(sequence: int, **changes: Any) -> State:
    content: dict[str, Any] = {
        "session": SESSION, "sequence": sequence, "time": 0.0, "nonce": 0,
        "observations": (f4([0.25, -0.0, 1.5]),), "rewards": np.zeros(1),
        "terminated": np.zeros(1, bool), "truncated": np.zeros(1, bool),
        "telemetry": (np.array([[-2.0, -1.0, 5.0]]), np.array([[0.25]])),
    }  # fmt: skip
    return State(**content | changes)


def two_state(sequence: int) -> State:
    return State(
        session=SESSION,
        sequence=sequence,
        time=0.2,
        observations=(np.arange(12, dtype=np.uint8).reshape(2, 1, 2, 3), f4([0.5], [1e-45])),
        rewards=np.array([-0.0, 0.1]),
        terminated=np.array([False, True]),
        truncated=np.array([True, False]),
    )


def swarm_state() -> State:
    """The second drone of the first world crashes; the first of the second world is out."""
    column = np.arange(6.0)[:, np.newaxis]
    return State(
        session=SESSION,
        sequence=3,
        time=0.04,
        observations=(column.astype(np.float32),),
        rewards=np.array([0.5, -20.0, 0.5, 0.0, 0.5, 0.5]),
        terminated=np.array([False, True, False, False, False, False]),
        truncated=np.zeros(6, bool),
        telemetry=(column / 8,),
    )


def swarm_command() -> Command:
    """The first world flies, the second is reset; the seed of its first drone counts."""
    return Command(
        session=SESSION,
        sequence=3,
        actions=f4([0.5], [0.0], [-1.0], [0.0], [0.0], [0.0]),
        orders=np.repeat(np.array([0, 1], np.uint8), 3),
        seeds=np.array([0, 0, 0, 7, 8, 9], np.uint64),
    )


def one_command(sequence: int, choice: int, order: int, seed: int | None = None) -> Command:
    return Command(
        session=SESSION,
        sequence=sequence,
        actions=np.array([choice]),
        orders=np.array([order], np.uint8),
        seeds=None if seed is None else np.array([seed], np.uint64),
    )


def two_command(orders: list[int], seeds: list[int] | None = None) -> Command:
    return Command(
        session=SESSION,
        sequence=3,
        actions=f4([0.5], [-1.0]),
        orders=np.array(orders, np.uint8),
        seeds=None if seeds is None else np.array(seeds, np.uint64),
    )


def messages() -> list[tuple[str, str, Message]]:
    """Name, name of the spec, message: one of each kind, and the corners."""
    hello = Hello(session=SESSION, spec=ONE.to_json())
    extension = Extension(number=7, value=b"abc")
    return [
        ("hello", "one", hello),
        ("hello of two worlds, with an extension", "two",
         Hello(session=SESSION, spec=TWO.to_json(), worlds=2, versions=(2, 3),
               extensions=(extension,))),
        ("hello of two worlds of three drones", "swarm",
         Hello(session=SESSION, spec=SWARM.to_json(), worlds=2)),
        ("welcome", "one", Welcome(session=SESSION, nonce=NONCE)),
        ("welcome with a seed", "one", Welcome(session=SESSION, nonce=NONCE, seed=7)),
        ("welcome with a critical extension", "one",
         Welcome(session=SESSION, nonce=NONCE,
                 extensions=(Extension(number=1, value=b"", critical=True), extension))),
        ("welcome with the policy land", "swarm",
         Welcome(session=SESSION, nonce=NONCE,
                 extensions=(Extension(number=1, value=b"land"),))),
        ("refuse", "one", Refuse(session=SESSION, reason="busy")),
        ("wait", "one", Wait(session=SESSION)),
        ("unknown", "one", Unknown(session=SESSION, sequence=1)),
        ("alive", "one", Alive(session=SESSION, sequence=1)),
        ("missing: 0, 2 and 9 of 10", "two",
         Missing(session=SESSION, sequence=2, kind=binary.STATE, count=10, first=0,
                 bitmap=bytes([0b101, 0b10]))),
        ("state 1 echoes the nonce", "one", one_state(1, nonce=NONCE)),
        ("state, truncated", "one",
         one_state(2, time=0.02, rewards=np.array([0.5]), truncated=np.array([True]))),
        ("state of two drones with a picture", "two", two_state(3)),
        ("state of two worlds of three drones: 1 crashes, 3 is out", "swarm", swarm_state()),
        ("command to fly choice 2", "one", one_command(1, 2, 0)),
        ("command to reset, with a seed", "one", one_command(1, 0, 1, 2**64 - 1)),
        ("command: fly, freeze", "two", two_command([0, 2])),
        ("command: reset, fly; with seeds", "two", two_command([1, 0], [2**64 - 1, 5])),
        ("command: fly the first world, reset the second", "swarm", swarm_command()),
        ("close", "one", Close(session=SESSION, sequence=1, reason="done")),
        ("close, the answer", "one", Close(session=SESSION, sequence=1, reason="")),
    ]  # fmt: skip


def described(message: Message) -> dict[str, Any]:
    """The fields as JSON: whole numbers of 64 bits as decimal text, bytes in hexadecimal."""
    content: dict[str, Any] = {}
    for field in fields(message):
        content[field.name] = _plain(getattr(message, field.name))
    return content


def _plain(value: Any) -> Any:
    match value:
        case np.ndarray() if value.dtype == np.uint64:
            return [str(number) for number in value.tolist()]
        case np.ndarray():
            return value.tolist()
        case bytes():
            return value.hex()
        case Extension():
            return described(value)  # type: ignore[arg-type]
        case tuple():
            return [_plain(one) for one in value]
        case int() if not isinstance(value, bool) and value > 2**32:
            return str(value)
    return value


def fixed(datagram: bytes) -> bytes:
    """The datagram with its checksum made right."""
    crc = zlib.crc32(datagram[8:], zlib.crc32(datagram[:4]))
    return datagram[:4] + crc.to_bytes(4, "little") + datagram[8:]


def changed(datagram: bytes, at: int, new: bytes) -> bytes:
    return fixed(datagram[:at] + new + datagram[at + len(new) :])


def malformed(right: dict[str, bytes]) -> list[tuple[str, str, bytes]]:
    """Name, name of the spec, bytes. Each is dropped, whatever else it says."""
    hello = right["hello"]
    welcome = right["welcome"]
    close = right["close"]
    state, picture = right["state, truncated"], right["state of two drones with a picture"]
    choice = right["command to fly choice 2"]
    freeze = right["command: fly, freeze"]
    nan = b"\x00\x00\xc0\x7f"
    infinity = b"\x00\x00\x80\x7f"
    flags = LAYOUTS["one"].state.flags.start
    missing = right["missing: 0, 2 and 9 of 10"]
    one = "one"
    two = "two"
    return [
        ("nothing", one, b""),
        ("a header cut short", one, right["wait"][:23]),
        ("another magic", one, fixed(b"\xa7\x54" + close[2:])),
        ("a wrong checksum", one, close[:-1] + b"E"),
        ("version 3", one, changed(close, 2, b"\x03")),
        ("type 0", one, changed(right["wait"], 3, b"\x00")),
        ("type 11", one, changed(right["wait"], 3, b"\x0b")),
        ("a Hello with a sequence number", one, changed(hello, 16, b"\x01")),
        ("a Hello of no world", one, changed(hello, 28, bytes(4))),
        ("a Hello of versions 3 to 2", one, changed(hello, 24, b"\x03\x02")),
        ("a Hello with a spec that is longer than it", one, changed(hello, 32, b"\xff\xff")),
        ("a Welcome with 2 for a flag", one, changed(welcome, 40, b"\x02")),
        ("a Welcome cut short", one, fixed(welcome[:-1])),
        ("an extension cut short", one, fixed(welcome + b"\x07\x00\x04\x00abc")),
        ("a Wait with a body", one, fixed(right["wait"] + b"\x00")),
        ("a State one byte short", one, fixed(state[:-1])),
        ("a State one byte long", one, fixed(state + b"\x00")),
        ("a State with an observation that is NaN", one, changed(state, 40, nan)),
        ("a State with an infinite observation", one, changed(state, 44, infinity)),
        ("a State with a flag of 2", one, changed(state, flags, b"\x02")),
        ("a State whose time is NaN", one, changed(state, 24, b"\x00" * 6 + b"\xf8\x7f")),
        ("a picture's State, read as the other env's", one, picture),
        ("a Command with choice 3 of 3", one, changed(choice, 32, b"\x03")),
        ("a Command with choice -1", one, changed(choice, 32, b"\xff" * 8)),
        ("a Command that resets, with choice 3", one,
         changed(changed(choice, 32, b"\x03"), 40, b"\x01")),
        ("a Command with an action that is NaN for a frozen drone", two, changed(freeze, 36, nan)),
        ("a Command with order 3", two, changed(freeze, 40, b"\x03")),
        ("a Command with one seed for two drones", two, changed(freeze, 24, b"\x01")),
        ("a Close with a longer reason than it has", one, changed(close, 24, b"\x05")),
        ("a Close with a line feed", one, changed(close, 26, b"\n")),
        ("a Close that is not UTF-8", one, changed(close, 26, b"\xff")),
        ("a Missing of a Close", two, changed(missing, 24, b"\x06")),
        ("a Missing without a bitmap", two, fixed(missing[:30])),
        ("a Missing of fragment 10 of 10", two, changed(missing, 31, b"\x04")),
    ]  # fmt: skip


def fragments(right: dict[str, bytes]) -> list[dict[str, Any]]:
    """Cases with the datagrams of a message that is larger than a datagram."""
    cases = []
    for name in ("hello", "state of two drones with a picture"):
        transfer = Transfer(right[name], LARGEST)
        cases.append(
            {
                "name": f"fragments of at most {LARGEST} bytes",
                "of": name,
                "datagrams": [one.hex() for one in transfer.start()],
            }
        )
    return cases


def wrong_fragments(right: dict[str, bytes]) -> list[tuple[str, bytes]]:
    """Name and bytes. Each is dropped."""
    message = right["state of two drones with a picture"]
    first, *_ = Transfer(message, LARGEST).start()
    return [
        ("number 2 of 2", changed(first, 24, b"\x02\x00\x02\x00")),
        ("of no fragment at all", changed(first, 24, b"\x00\x00\x00\x00")),
        ("of 16,385", changed(first, 26, b"\x01\x40")),
        ("that asks with a 2", changed(first, 28, b"\x02")),
        ("with an empty slice", fixed(first[:32])),
    ]


def sealed(right: dict[str, bytes]) -> list[dict[str, Any]]:
    """What either side seals, with the shared key or that of the session."""
    cases = []
    keys = {side: Key(SECRET, side) for side in ("simulator", "agent")}
    sessions = {side: key.for_session(SESSION, NONCE) for side, key in keys.items()}
    state = sessions["simulator"].seal(right["state 1 echoes the nonce"])
    for name, side, key, asked in (
        ("hello", "simulator", "shared", b""),
        ("welcome", "agent", "shared", b""),
        ("wait", "agent", "shared", b""),
        ("unknown", "agent", "shared", state),
        ("state 1 echoes the nonce", "simulator", "session", b""),
        ("command to fly choice 2", "agent", "session", b""),
        ("alive", "simulator", "session", b""),
        ("close, the answer", "simulator", "session", b""),
        ("close, the answer", "agent", "session", b""),
    ):
        case: dict[str, Any] = {"of": name, "from": side, "key": key}
        if asked:
            case["answers"] = asked.hex()
        sealing = (keys if key == "shared" else sessions)[side]
        cases.append(case | {"datagram": sealing.seal(right[name], asked).hex()})
    return cases


def forged(right: dict[str, bytes]) -> list[dict[str, Any]]:
    """Datagrams that a side with the key drops, as it would take `of` from the other."""
    hello = right["hello"]
    command = right["command to fly choice 2"]
    theirs = Key(SECRET, "agent")
    session, other = theirs.for_session(SESSION, NONCE), theirs.for_session(SESSION, NONCE + 1)
    good = session.seal(command)
    return [
        {"name": name, "of": of, "from": side, "datagram": datagram.hex()}
        for name, of, side, datagram in (
            ("not sealed", "hello", "simulator", hello),
            ("with the tag of the other side", "hello", "simulator", theirs.seal(hello)),
            ("with another key", "hello", "simulator", Key(bytes(32), "simulator").seal(hello)),
            ("with the shared key", "command to fly choice 2", "agent", theirs.seal(command)),
            ("of another session", "command to fly choice 2", "agent", other.seal(command)),
            ("with another key id", "command to fly choice 2", "agent",
             good[:7] + bytes([good[7] ^ 1]) + good[8:]),
            ("with one bit of the tag flipped", "command to fly choice 2", "agent",
             good[:23] + bytes([good[23] ^ 1]) + good[24:]),
            ("cut short", "command to fly choice 2", "agent", good[:-1]),
        )
    ]  # fmt: skip


def text_lines() -> dict[str, Any]:
    """Lines of the env `one`: seven numbers of observation and telemetry, a discrete action."""
    state = "1,0.5,0,1,0.25,-0.0,1.5,1.0,5.0,-2.0,0.25"
    numbers = ",.25,-0,1.5e0,+1,5.,-2,25E-2"
    return {
        "states": [state, "0,0,0,0" + numbers, "7,-1e-300,1,1" + numbers + "\n",
                   "18446744073709551615,0,0,0" + numbers + "\r\n", "3,close\r"],
        "commands": ["1,2", "1,0\n", "1,reset", "1,reset,18446744073709551615", "1,close"],
        "malformed states": [
            "", "1", "1,", "close", "01,0,0,0" + numbers, "1,0,0,0" + numbers + ",1",
            "1,0,0,0" + numbers[:-6], "-1,0,0,0" + numbers, "+1,0,0,0" + numbers,
            "18446744073709551616,0,0,0" + numbers, "1,nan,0,0" + numbers, "1,inf,0,0" + numbers,
            "1,1e999,0,0" + numbers, "1,0x1,0,0" + numbers, "1,0,2,0" + numbers,
            "1,0,00,0" + numbers, "1, 0,0,0" + numbers, "1,0,0,0,1e39" + numbers[4:],
            "1,0,0,0" + numbers + " ", "1,0,0,0" + numbers + "\n\n", "1,close,",
            "1," + 1300 * "0" + ",0,0" + numbers,
        ],
        "malformed commands": [
            "", "1", "1,", "1,3", "1,-1", "1,+1", "1,02", "1,1.0", "1,1e0", "1,0,0", "01,1",
            "1,reset,", "1,reset,-1", "1,reset,01", "1,reset,18446744073709551616",
            "1,reset,1,2", "1,Reset", "1,freeze",
        ],
    }  # fmt: skip


def golden() -> dict[str, Any]:
    """The whole file."""
    told = messages()
    right = {name: binary.encode(message, LAYOUTS[env]) for name, env, message in told}
    key = Key(SECRET, "agent")
    numbers = SESSION.to_bytes(8, "little") + NONCE.to_bytes(8, "little")
    session_key = blake2b(numbers, key=SECRET, digest_size=32, person=b"session").digest()
    return {
        "protocol": binary.VERSION,
        "envs": {
            name: {
                "worlds": WORLDS[name],
                "spec": json.loads(spec.to_json()),
                "state bytes": LAYOUTS[name].state.size,
                "command bytes without and with seeds": [
                    LAYOUTS[name].command.size, LAYOUTS[name].seeded_command.size
                ],
            }
            for name, spec in SPECS.items()
        },
        "messages": [
            {"name": name, "env": env, "type": type(message).__name__,
             "fields": described(message), "bytes": right[name].hex()}
            for name, env, message in told
        ],
        "malformed": [
            {"name": name, "env": env, "bytes": data.hex()} for name, env, data in malformed(right)
        ],
        "fragments": fragments(right),
        "malformed fragments": [
            {"name": name, "bytes": data.hex()} for name, data in wrong_fragments(right)
        ],
        "key": {
            "shared": SECRET.hex(),
            "id": key.id.hex(),
            "session": f"{SESSION:016x}",
            "nonce": f"{NONCE:016x}",
            "of the session": session_key.hex(),
        },
        "sealed": sealed(right),
        "forged": forged(right),
        "text of env one": text_lines(),
    }  # fmt: skip


def written() -> str:
    """The text of the file."""
    return json.dumps(golden(), indent=1) + "\n"


if __name__ == "__main__":
    FILE.write_text(written(), "utf-8")

"""docs/golden.json: datagrams byte by byte for whoever writes a peer, right and wrong ones."""

import json
import zlib
from pathlib import Path
from typing import Any, Final

from rotorgram.envs.spec import EnvSpec
from rotorgram.udp.layouts import layout_of
from rotorgram.udp.protocol import binary
from rotorgram.udp.protocol.messages import Message

FILE: Final = Path(__file__).parent.parent / "docs" / "golden.json"
GOLDEN: Final[dict[str, Any]] = json.loads(FILE.read_text("utf-8"))
ENVS: Final = GOLDEN["envs"]
KEY: Final = GOLDEN["key"]
LINES: Final = GOLDEN["text of env one"]

SPECS: Final = {name: EnvSpec.from_json(json.dumps(env["spec"])) for name, env in ENVS.items()}
LAYOUTS: Final = {name: layout_of(spec, ENVS[name]["worlds"]) for name, spec in SPECS.items()}
SESSION: Final = int(KEY["session"], 16)
NONCE: Final = int(KEY["nonce"], 16)
SECRET: Final = bytes.fromhex(KEY["shared"])


def messages() -> list[tuple[str, str, Message]]:
    """Name, name of the env, message: one of each kind, and the corners."""
    found = []
    for case in GOLDEN["messages"]:
        env = case["env"]
        message = binary.decode(bytes.fromhex(case["bytes"]), LAYOUTS[env])
        found.append((case["name"], env, message))
    return found


def fixed(datagram: bytes) -> bytes:
    """The datagram with its checksum made right."""
    crc = zlib.crc32(datagram[8:], zlib.crc32(datagram[:4]))
    return datagram[:4] + crc.to_bytes(4, "little") + datagram[8:]


def changed(datagram: bytes, at: int, new: bytes) -> bytes:
    """The datagram with other bytes at a place, and the checksum made right."""
    return fixed(datagram[:at] + new + datagram[at + len(new) :])

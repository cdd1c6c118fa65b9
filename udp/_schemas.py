"""How a journal tells viewers what is in it: ROS 1 messages and JSON schemas."""

import json
import re
from collections.abc import Iterable
from typing import Final

from .messages import Hello

__all__ = ["EVENT", "NUMBERS", "command_schema", "field_names", "state_schema"]

_HEADER: Final = (
    "uint8[2] magic",
    "uint8 version",
    "uint8 type",
    "uint32 crc",
    "uint64 session",
    "uint64 sequence",
)
EVENT: Final = (
    "rotorgram.Event",
    json.dumps(
        {
            "type": "object",
            "required": ["type", "session", "datagram"],
            "properties": {
                "type": {"type": "string"},
                "session": {"type": "string", "description": "number, hexadecimal"},
                "sequence": {"type": "integer"},
                "reason": {"type": "string"},
                "datagram": {"type": "string", "description": "its binary datagram, hexadecimal"},
            },
        }
    ),
)
"""Name and JSON schema of all messages but States and Commands."""
NUMBERS: Final = (
    "rotorgram.Statistics",
    json.dumps({"type": "object", "additionalProperties": {"type": "number"}}),
)
"""Name and JSON schema of the statistics."""


def state_schema(hello: Hello) -> str:
    """A State of this session's sizes as a ROS 1 message."""
    drones, names = hello.num_drones, field_names(hello.telemetry_names)
    lines = [
        *_HEADER,
        "uint32 drones",
        "uint16 observation_size",
        "uint16 telemetry_size",
        f"float64[{drones}] rewards",
        *([f"rotorgram/Telemetry[{drones}] telemetry"] if names else []),
        f"float32[{drones * hello.observation_low.size}] observations",
        f"bool[{drones}] terminated",
        f"bool[{drones}] truncated",
    ]
    if names:
        lines += ["=" * 80, "MSG: rotorgram/Telemetry", *(f"float64 {name}" for name in names)]
    return "\n".join(lines) + "\n"


def command_schema(hello: Hello) -> str:
    """A Command of this session's sizes as a ROS 1 message."""
    drones = hello.num_drones
    lines = [
        *_HEADER,
        "uint32 drones",
        "uint16 action_size",
        "uint8[6] reserved",
        "uint64[] seeds",
        f"float32[{drones * hello.action_low.size}] actions",
        f"uint8[{drones}] orders",
    ]
    return "\n".join(lines) + "\n"


def field_names(names: Iterable[str]) -> list[str]:
    """Names made into those that ROS 1 allows, each another one."""
    fields: list[str] = []
    for name in names:
        field = re.sub(r"[^a-zA-Z0-9_]", "_", name)
        field = field if re.match("[a-zA-Z]", field) else f"t{field}"
        while field in fields:
            field += "_"
        fields.append(field)
    return fields

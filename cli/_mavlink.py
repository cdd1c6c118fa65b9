"""Flights that go out as MAVLink."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING

from ..envs.spec import EnvSpec
from ..models import InputError
from ._flags import MavlinkFlags, parse_address

if TYPE_CHECKING:
    from ..autopilots.mavlink import MavlinkOut


@contextmanager
def mavlink_out(command: MavlinkFlags, spec: EnvSpec) -> Iterator["MavlinkOut | None"]:
    """What sends flights of an env where --mavlink says. Raises `InputError`."""
    if command.mavlink is None:
        yield None
        return
    kind, _, address = command.mavlink.partition(":")
    if kind != "udp":
        raise InputError(f"mavlink: expected udp:HOST:PORT, got {command.mavlink!r}")
    from ..autopilots.mavlink import MavlinkOut

    with closing(MavlinkOut(parse_address(address), spec)) as out:
        print(f"MAVLink goes to {address}")
        yield out

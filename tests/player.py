"""A program that plays a recorded session back: what a flight stack sent, in its turn.

    python tests/player.py SESSION [ARGUMENTS OF THE STACK]

It checks each datagram that it gets against the recorded one, and ends with a sentence where one
differs. It has no word of a flight stack but the answers of Betaflight's CLI.
"""

import lzma
import os
import socket
import struct
import sys
import zlib
from pathlib import Path
from threading import Thread

HOST = "127.0.0.1"
EVENT = struct.Struct("<BHI")
"""Whether the program sent it; the port it went to, or 0; size of what follows, or its checksum."""
RELEASE = b"# Betaflight / SITL (SITL) %s Jan  1 2026 / 00:00:00 MSP API: 1.47\r\n"


def write_session(path, events):
    """Write events, (port or None, datagram): the port of what went to the program, whose datagram
    may be its checksum.
    """
    parts = []
    for port, datagram in events:
        if port is None:
            parts.append(EVENT.pack(1, 0, len(datagram)) + datagram)
        else:
            check = datagram if isinstance(datagram, int) else zlib.crc32(datagram)
            parts.append(EVENT.pack(0, port, check))
    path.write_bytes(lzma.compress(b"".join(parts)))


def read_session(path):
    """Events: (port or None, datagram or its checksum)."""
    content = lzma.decompress(path.read_bytes())
    at = 0
    while at < len(content):
        sent, port, number = EVENT.unpack_from(content, at)
        at += EVENT.size
        if sent:
            yield None, content[at : at + number]
            at += number
        else:
            yield port, number


def answer_cli(listening):
    """Answer as a CLI that takes every command, and saves."""
    while True:
        link, _ = listening.accept()
        with link, link.makefile("rb") as lines:
            for line in iter(lines.readline, b""):
                command = line.strip()
                if command == b"save":
                    Path("eeprom.bin").write_bytes(b"configured")
                    link.sendall(line + b"Rebooting")
                    break
                said = RELEASE % b"2026.12.0" if command == b"version" else b""
                link.sendall(line + said + b"# ")


def play(session, ports, there):
    """Play a session from sockets that are bound to ports; 0 is that of the first event."""
    sockets = {}
    for port, moved in ports.items():
        sockets[port] = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sockets[port].bind((HOST, moved))
    own = sockets.get(0) or next(iter(sockets.values()))
    for number, (port, content) in enumerate(read_session(session)):
        if port is None:
            own.sendto(content, there)
            continue
        datagram = sockets[port].recv(2048)
        if zlib.crc32(datagram) != content:
            sys.exit(f"datagram {number} to port {port} is not the recorded one: {datagram.hex()}")
    own.recv(2048)  # the session has ended: it hangs


def main():
    session = Path(sys.argv[1])
    apart = int(os.environ.get("BETAFLIGHT_APART", "0"))
    if session.stem.startswith("betaflight"):
        with socket.create_server((HOST, 5761 + apart)) as listening:
            Thread(target=answer_cli, args=(listening,), daemon=True).start()
            play(session, {9003: 9003 + apart, 9004: 9004 + apart}, (HOST, 9001 + apart))
    else:
        play(session, {0: 0}, (HOST, int(sys.argv[2])))


if __name__ == "__main__":
    main()

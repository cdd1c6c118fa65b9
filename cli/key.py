"""`rotorgram key`: a key for both sides of the wire."""

from pathlib import Path

from tyro.conf import Positional

from ._flags import Command


class Key(Command):
    """Write a new key for both sides of the wire. Copy it over a secure channel."""

    file: Positional[Path]
    """File to write; it must not exist."""

    def run(self) -> None:
        """Write it."""
        from ..udp.protocol.auth import write_key

        write_key(self.file)
        print(f"key: {self.file} (give it to both sides with --key-file)")

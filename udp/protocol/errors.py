"""Errors of the peer and the wire. Misuse of our own code raises `ValueError`."""


class DecodeError(Exception):
    """A datagram is not a message. It is counted and dropped; it never ends a run by itself."""

    cause = "malformed"  # under which it is counted


class VersionMismatch(DecodeError):
    """An intact binary datagram of another protocol version."""


class Forged(DecodeError):
    """A datagram is not sealed with the key of this side and session, or not at all."""

    cause = "forged"


class LinkError(ConnectionError):
    """The exchange with the other side cannot go on."""


class PeerSilent(LinkError, TimeoutError):
    """Nothing came from the other side in time."""


class Refused(LinkError):
    """The agent turned the simulator away."""


class PeerClosed(LinkError):
    """The other side ended the exchange."""

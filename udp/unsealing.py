"""How the agent takes the seal off a datagram: which key it is under, and what to say if none."""

from contextlib import suppress

from . import binary
from .admission import Admission
from .errors import DecodeError, Forged
from .keys import Key, is_sealed, message_of
from .link import Address

__all__ = ["KeyMismatch", "NoSuchSession", "unseal"]


class KeyMismatch(Forged):
    """One side has a key, the other has none."""


class NoSuchSession(DecodeError):
    """A sealed message of a session whose key is not here."""


def unseal(datagram: bytes, address: Address, key: Key | None, admission: Admission) -> bytes:
    """A binary datagram without its seal.

    States and Closes are sealed with the key of their session, all else with the shared one.

    Args:
        datagram: As it came, sealed or not.
        address: Where it came from.
        key: The shared one; None if the agent has none.
        admission: Who has a place, and who was welcomed.

    Raises:
        KeyMismatch: One side has a key, the other has none.
        Forged: The seal is not of that key.
        NoSuchSession: No session of that address and number has a key here.
    """
    if key is None:
        if is_sealed(datagram):
            raise KeyMismatch("key: this agent has none (--key-file), and the simulator has")
        return datagram
    if not is_sealed(datagram):
        raise KeyMismatch("key: this agent has one (--key-file), and the simulator has none")
    kind, number, _ = binary.peek(message_of(datagram))
    if kind not in binary.OF_SESSION:
        return key.open(datagram)
    _, session = admission.seat_of(address)
    if session and session.key and session.number == number:
        return session.key.open(datagram)
    # If the Welcome was not for this one, but for an old copy of its Hello, it is as good as none.
    opening = admission.openings.get((address, number))
    if opening and opening.key:
        with suppress(DecodeError):
            return opening.key.open(datagram)
    raise NoSuchSession(f"session {number:016x}")

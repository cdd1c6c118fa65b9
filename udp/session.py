"""One simulator's session at the agent: whose turn it is, and which message may come next."""

from dataclasses import dataclass, field
from typing import Final

from . import binary
from .keys import Key
from .link import Address
from .messages import Close, Hello, Message, State, Welcome, one_line
from .parts import Assembler

__all__ = ["Session"]

_NEXT: Final = {
    ("expecting", State): "deciding",
    ("expecting", Close): "closed",
    ("deciding", Close): "closed",
    ("closing", Close): "closed",
}
"""What a message of the simulator does to its session; any other pair is dropped."""


@dataclass(eq=False)
class Session:
    """An open exchange with one simulator, pinned to its address and codec.

    `state` is one of `expecting` (a State), `deciding` (a State waits for its Command), `closing`
    (for the answer to a Close) and `closed`.
    """

    peer: Address
    hello: Hello | None
    """None if it speaks text."""
    number: int
    """Session number; 0 with the text codec."""
    key: Key | None = None
    welcome: Welcome | None = None
    reply: list[bytes] = field(default_factory=list)
    """The answer to the last State, or the Welcome: one datagram or its parts."""
    repeats: int = 0
    """How often an answer was sent again."""
    parts: Assembler | None = None
    """Of the State that is coming in parts."""
    state: str = "expecting"
    sequence: int = 0
    """Number of the State that came last."""
    asked_at: float | None = None
    """When the Command was sent whose State is expected."""

    @property
    def is_text(self) -> bool:
        """Whether it speaks the text codec."""
        return self.hello is None

    def next_state(self, message: Message) -> str | None:
        """The state after a message of the simulator; None if it may not come now."""
        if not isinstance(message, State | Close):
            return None
        ahead = message.sequence - self.sequence
        if isinstance(message, State):
            is_due = ahead == 1
        else:  # the State before a Close may have been lost, but not while it is answered
            is_due = ahead == 0 or (ahead == 1 and self.state != "deciding")
        return _NEXT.get((self.state, type(message))) if is_due else None

    def misfit(self, state: State) -> str:
        """In what a State is not of the sizes that the Hello told, or ""."""
        if self.hello is None:
            return ""  # a line was read by the sizes of the text codec
        hello = self.hello
        expected = (hello.num_drones, hello.observation_low.size, len(hello.telemetry_names))
        got = (*state.observations.shape, state.telemetry.shape[1])
        if got == expected:
            return ""
        return f"State: expected (drones, observations, telemetry) = {expected}, got {got}"

    def goodbye(self, reason: str) -> Close:
        """The Close that ends it."""
        return Close(session=self.number, sequence=self.sequence, reason=one_line(reason))

    def take_part(self, sequence: int, part: bytes) -> bytes | None:
        """Take a part of the State of that number; the State, if it is whole now.

        Raises `DecodeError`, as `Assembler.take`.
        """
        assert self.hello is not None
        if self.parts is None:
            self.parts = Assembler(binary.state_size(self.hello))
        return self.parts.take(sequence, part)

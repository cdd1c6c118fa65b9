"""Who flies for the agent, who may come next, and how much is remembered of those who came.

Anybody may say Hello, so whatever is kept of somebody without a place is bounded.
"""

from collections import OrderedDict
from typing import Any, Final

from .link import Address
from .session import Session

__all__ = ["Admission"]

_MOST: Final = 1024
"""Simulators that are remembered between Hello and first State, while they wait, and after."""
_LEAST_ASSEMBLING: Final = 16
"""Sessions without a place for which parts of a first State are kept; more, if there are more
places: so many simulators may come at the same moment."""


class Admission:
    """The places, and those who want one: a table each, with no word to anybody.

    Args:
        count: Places.

    Attributes:
        places: Session of each place, None where it is free.
        seats: Number of the place of each address that has one.
        openings: Sessions that were welcomed, and whose first State has not come.
        waiting: For each address that waits for a place its session's number, and with how many
            bytes more than a Wait it asked.
        ended: Numbers of the sessions that had a place.
        assembling: Openings whose first State is coming in parts, the one idle longest first.
    """

    def __init__(self, count: int) -> None:
        self.places: list[Session | None] = [None] * count
        self.seats: dict[Address, int] = {}
        self.openings: OrderedDict[tuple[Address, int], Session] = OrderedDict()
        self.waiting: OrderedDict[Address, tuple[int, int]] = OrderedDict()
        self.ended: OrderedDict[int, None] = OrderedDict()
        self.assembling: OrderedDict[Session, None] = OrderedDict()

    def seat_of(self, address: Address) -> tuple[int, Session | None]:
        """The place of an address and its session; -1 and None if it has none."""
        place = self.seats.get(address, -1)
        return place, self.places[place] if place >= 0 else None

    def has_room(self, address: Address) -> bool:
        """Whether this one may have a place: a free one, or its own for another session."""
        return None in self.places or address in self.seats

    def open(self, session: Session) -> None:
        """Remember one that was welcomed."""
        _keep(self.openings, (session.peer, session.number), session)
        self.waiting.pop(session.peer, None)

    def wait(self, address: Address, number: int, room: int) -> None:
        """Remember one that waits for a place."""
        _keep(self.waiting, address, (number, room))

    def forget(self, address: Address, number: int) -> None:
        """Forget one that was welcomed."""
        self.assembling.pop(self.openings.pop((address, number)), None)

    def forget_until(self, opening: Session) -> None:
        """Forget the opening of a State 1, and what the same address began before it.

        That has not ended: if this State came late, a simulator may still say that Hello.
        """
        for address, number in list(self.openings):
            if address == opening.peer:
                self.forget(address, number)
                if number == opening.number:
                    return

    def keep_parts(self, opening: Session) -> None:
        """Keep the parts of one without a place, for the last few that have sent any."""
        self.assembling[opening] = None
        self.assembling.move_to_end(opening)
        if len(self.assembling) > max(_LEAST_ASSEMBLING, len(self.places)):
            idle, _ = self.assembling.popitem(last=False)
            idle.parts = None

    def seat(self, session: Session) -> int:
        """Give a session its place: that of an earlier one, or the first free one."""
        place, earlier = self.seat_of(session.peer)
        if earlier:
            self.free(place)
        else:
            place = self.places.index(None)
        self.places[place] = session
        self.seats[session.peer] = place
        return place

    def free(self, place: int) -> None:
        """Free a place, if it is taken."""
        session, self.places[place] = self.places[place], None
        if session:
            del self.seats[session.peer]
            if session.hello:
                _keep(self.ended, session.number, None)

    def is_elsewhere(self, number: int, address: Address, *, seated: bool) -> bool:
        """Whether another address holds a session of that number: has a place, or is to come.

        Args:
            number: The session's.
            address: Who says that it is his.
            seated: Look only at those that have a place.
        """
        held = {(s.peer, s.number) for s in self.places if s}
        if not seated:
            held.update(self.openings)
            held.update((there, waits) for there, (waits, _) in self.waiting.items())
        return any(n == number and there != address for there, n in held)


def _keep(table: "OrderedDict[Any, Any]", key: Any, value: Any) -> None:
    """Put into a table that forgets its oldest entries."""
    table[key] = value
    table.move_to_end(key)
    if len(table) > _MOST:
        table.popitem(last=False)

"""Statistics of one side of the wire: counts, round trips, and notices at a bounded rate."""

from collections import Counter, deque

import numpy as np

from .messages import one_line

NOTICE_INTERVAL = 10.0  # shortest time between two notices of the same cause, s

_REMEMBERED = 1 << 14
_QUIET = frozenset({"duplicate", "stale"})
"""Events of every network that loses datagrams: counted, without a notice."""


class Statistics:
    """Counts and times of one side. Everything else about dropped datagrams is forgotten."""

    def __init__(self) -> None:
        self.counters: Counter[str] = Counter()
        """`sent`, `received`, `resent`, `unsent`, `sessions`, and what was dropped, by cause:
        `malformed`, `forged`, `foreign`, `refused`, `duplicate`, `stale`."""
        self.round_trips: deque[float] = deque(maxlen=_REMEMBERED)
        """The last ones, s: from the first sending of a message to the answer that counts."""
        self.last_error = ""  # why the last unexpected datagram was dropped; "" if none was
        self.notices: list[str] = []
        """Sentences for the log, until `take_notices`."""
        self._next_notice: dict[str, float] = {}

    def drop(self, cause: str, reason: str, now: float) -> None:
        """Count a datagram that changes nothing; say so if it is time to."""
        self.counters[cause] += 1
        if cause in _QUIET:
            return
        self.last_error = one_line(f"{cause} {reason}")
        if now >= self._next_notice.get(cause, now):
            self.notices.append(f"dropped a datagram: {self.last_error}")
            self._next_notice[cause] = now + NOTICE_INTERVAL

    def notice(self, sentence: str) -> None:
        """Keep a notice for the log."""
        self.notices.append(one_line(sentence))

    def take_notices(self) -> list[str]:
        """Sentences for the log, each once."""
        notices = self.notices
        self.notices = []
        return notices

    def numbers(self) -> dict[str, float]:
        """All of it as numbers by name, round trips in milliseconds: for logs of training."""
        shares = (0.5, 0.99, 1.0)
        trips = 1e3 * np.quantile(self.round_trips or [0.0], shares, method="inverted_cdf")
        names = ("round_trip_p50_ms", "round_trip_p99_ms", "round_trip_max_ms")
        return {**self.counters, **dict(zip(names, trips.tolist(), strict=True))}

    def __str__(self) -> str:
        if not self.counters:
            return "no datagrams"
        counts = ", ".join(f"{count} {name}" for name, count in sorted(self.counters.items()))
        if not self.round_trips:
            return counts
        p50, p99, most = list(self.numbers().values())[-3:]
        return f"{counts}; round trip p50 {p50:.3f} ms, p99 {p99:.3f} ms, max {most:.3f} ms"

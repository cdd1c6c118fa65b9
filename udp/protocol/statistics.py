"""Statistics of one side of the wire: counts, round trips, and warnings at a bounded rate."""

import logging
from collections import Counter, deque

import numpy as np

from .messages import one_line

WARNING_INTERVAL = 10.0  # shortest time between two warnings of the same cause, s

_log = logging.getLogger("rotorgram.udp")
_REMEMBERED = 1 << 14


class Statistics:
    """Counts and times of one side. Everything else about dropped datagrams is forgotten."""

    def __init__(self) -> None:
        self.counters: Counter[str] = Counter()
        """`sent`, `received`, `resent`, `unsent`, `sessions`, and what was dropped, by cause:
        `malformed`, `forged`, `foreign`, `refused`, and without a warning, for every network that
        loses datagrams has them, `duplicate` and `stale`."""
        self.round_trips: deque[float] = deque(maxlen=_REMEMBERED)
        """The last ones, s: from the first sending of a message to the answer that counts."""
        self.last_error = ""  # why the last unexpected datagram was dropped; "" if none was
        self._next_warning: dict[str, float] = {}

    def drop(self, cause: str, reason: str, now: float) -> None:
        """Count a datagram that changes nothing; warn if it is time to."""
        self.counters[cause] += 1
        self.last_error = one_line(f"{cause} {reason}")
        if now >= self._next_warning.get(cause, now):
            warn(f"dropped a datagram: {self.last_error}")
            self._next_warning[cause] = now + WARNING_INTERVAL

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


def warn(sentence: str) -> None:
    """Write a warning to the log `rotorgram.udp`: one line of bounded length."""
    _log.warning("%s", one_line(sentence))

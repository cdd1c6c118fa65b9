"""Counts, round trips and warnings, on a clock that is moved."""

import re

import pytest
from rotorgram.udp.protocol.statistics import Statistics, warn

# ---- warnings


def test_one_warning_for_each_cause_in_ten_seconds(caplog: pytest.LogCaptureFixture) -> None:
    statistics = Statistics()
    said = []
    for tick in range(6000):  # a minute, a hundred junk datagrams a second
        statistics.drop("malformed", f"junk {tick}", tick / 100)
        said += [(tick / 100, sentence) for sentence in caplog.messages]
        caplog.clear()
    assert [now for now, _ in said] == pytest.approx([0, 10, 20, 30, 40, 50])
    assert said[0][1] == "dropped a datagram: malformed junk 0"
    assert said[1][1] == "dropped a datagram: malformed junk 1000"
    assert statistics.counters == {"malformed": 6000}
    assert statistics.last_error == "malformed junk 5999"


def test_each_cause_has_its_own_time(caplog: pytest.LogCaptureFixture) -> None:
    statistics = Statistics()
    for now in (0.0, 1.0, 11.0):
        for cause in ("forged", "foreign", "malformed", "refused"):
            statistics.drop(cause, "x", now)
    assert [sentence.split()[3] for sentence in caplog.messages] == [
        "forged", "foreign", "malformed", "refused",
    ] * 2  # fmt: skip


def test_a_warning_is_one_line_of_bounded_length(caplog: pytest.LogCaptureFixture) -> None:
    statistics = Statistics()
    statistics.drop("malformed", "a\nb\x1b[2J" + "ü" * 5000, 0.0)
    warn("agent\r\nagain" + "x" * 5000)
    for line in (statistics.last_error, *caplog.messages):
        assert not re.search(r"[\x00-\x1f\x7f-\x9f]", line)
        assert len(line.encode()) <= 512


# ---- numbers


def some_statistics() -> Statistics:
    statistics = Statistics()
    statistics.counters.update({"sent": 3, "received": 2, "stale": 1})
    statistics.round_trips.extend([0.5] * 20_000)  # these are forgotten
    statistics.round_trips.extend([0.001] * 16_200 + [0.008] * 183 + [0.02])
    return statistics


def test_numbers_by_name() -> None:
    trips = {"round_trip_p50_ms": 1.0, "round_trip_p99_ms": 8.0, "round_trip_max_ms": 20.0}
    assert some_statistics().numbers() == {"sent": 3, "received": 2, "stale": 1, **trips}
    assert Statistics().numbers() == dict.fromkeys(trips, 0.0)


def test_in_a_sentence() -> None:
    assert str(Statistics()) == "no datagrams"
    statistics = Statistics()
    statistics.counters.update({"sent": 3, "received": 2})
    assert str(statistics) == "2 received, 3 sent"
    assert str(some_statistics()) == (
        "2 received, 3 sent, 1 stale; round trip p50 1.000 ms, p99 8.000 ms, max 20.000 ms"
    )

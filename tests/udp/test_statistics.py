"""Counts, round trips and notices, on a clock that is moved."""

import random
import re
from collections.abc import Callable

import numpy as np
import pytest
from rotorgram.udp.protocol.statistics import NOTICE_INTERVAL, Durations, Statistics

SAMPLES: dict[str, Callable[[np.random.Generator], np.ndarray]] = {
    "uniform": lambda dice: dice.uniform(50e-6, 10e-3, 9999),
    "long tail": lambda dice: dice.lognormal(-9, 2, 9999),
    "two peaks": lambda dice: dice.choice([60e-6, 12e-3], 9999) * dice.uniform(0.9, 1.1, 9999),
    "powers of two": lambda dice: 2.0 ** dice.integers(-20, 6, 9999),
    "one": lambda dice: np.array([0.02]),
}


def durations(samples: np.ndarray) -> Durations:
    table = Durations()
    for seconds in samples.tolist():
        table.add(seconds)
    return table


# ---- durations


@pytest.mark.parametrize("name", SAMPLES)
def test_quantiles_are_those_of_numpy(name: str) -> None:
    samples = SAMPLES[name](np.random.default_rng(1))
    table = durations(samples)
    assert table.count == len(samples)
    assert table.longest == samples.max()
    for share in (0.01, 0.1, 0.5, 0.9, 0.99, 0.999, 1.0):
        exact = np.quantile(samples, share, method="inverted_cdf")
        assert table.quantile(share) == exact


def test_quantiles_of_chosen_numbers() -> None:
    table = durations(np.array([1e-3] * 98 + [0.5, 2.0]))
    assert table.quantile(0.5) == 1e-3
    assert table.quantile(0.99) == 0.5
    assert table.quantile(1.0) == 2.0 == table.longest
    assert Durations().quantile(0.5) == Durations().longest == 0.0


def test_the_last_durations_count() -> None:
    table = durations(np.arange(20_000.0))
    assert table.count == 16_384
    assert table.longest == 19_999.0
    assert table.quantile(0.0) == 20_000 - 16_384


# ---- notices


def test_one_notice_for_each_cause_in_ten_seconds() -> None:
    statistics = Statistics()
    said = []
    for tick in range(6000):  # a minute, a hundred junk datagrams a second
        statistics.drop("malformed", f"junk {tick}", tick / 100)
        said += [(tick / 100, notice) for notice in statistics.take_notices()]
    assert [now for now, _ in said] == pytest.approx([0, 10, 20, 30, 40, 50])
    assert said[0][1] == "dropped a datagram: malformed junk 0"
    assert said[1][1] == "dropped a datagram: malformed junk 1000 (999 more before)"
    assert statistics.counters == {"malformed": 6000}
    assert statistics.last_error == "malformed junk 5999"


def test_each_cause_has_its_own_time() -> None:
    statistics = Statistics()
    for now in (0.0, 1.0, 11.0):
        for cause in ("forged", "foreign", "malformed", "refused"):
            statistics.drop(cause, "x", now)
    assert [notice.split()[3] for notice in statistics.take_notices()] == [
        "forged", "foreign", "malformed", "refused",
    ] * 2  # fmt: skip
    assert statistics.take_notices() == []


def test_what_every_bad_network_does_is_counted_and_not_said() -> None:
    statistics = Statistics()
    for now in range(100):
        statistics.drop("duplicate", "", float(now))
        statistics.drop("stale", "", float(now))
    assert statistics.take_notices() == []
    assert statistics.last_error == ""
    assert statistics.counters == {"duplicate": 100, "stale": 100}


def test_notices_are_bounded_whatever_comes() -> None:
    dice = random.Random(4)
    statistics = Statistics()
    now = 0.0
    causes = ["forged", "foreign", "malformed", "refused", "duplicate", "stale"]
    for _ in range(20_000):
        now += dice.expovariate(100)
        statistics.drop(dice.choice(causes), "x" * dice.randrange(2000), now)
    assert len(statistics.take_notices()) <= 4 * (1 + now / NOTICE_INTERVAL)


def test_a_notice_is_one_line_of_bounded_length() -> None:
    statistics = Statistics()
    statistics.drop("malformed", "a\nb\x1b[2J" + "ü" * 5000, 0.0)
    statistics.notice("agent\r\nagain" + "x" * 5000)
    for line in (statistics.last_error, *statistics.take_notices()):
        assert not re.search(r"[\x00-\x1f\x7f-\x9f]", line)
        assert len(line.encode()) <= 512 + len("dropped a datagram: ")


# ---- numbers


def some_statistics() -> Statistics:
    statistics = Statistics()
    statistics.counters.update({"sent": 3, "received": 2})
    statistics.drop("stale", "", 0.0)
    for milliseconds in (1, 1, 1, 8):
        statistics.round_trips.add(milliseconds / 1000)
    return statistics


def test_numbers_by_name() -> None:
    numbers = some_statistics().numbers()
    assert numbers == {
        "sent": 3,
        "received": 2,
        "stale": 1,
        "round_trip_p50_ms": pytest.approx(1, rel=0.032),
        "round_trip_p99_ms": pytest.approx(8, rel=0.032),
        "round_trip_max_ms": pytest.approx(8),
    }
    assert Statistics().numbers() == {
        "round_trip_p50_ms": 0.0, "round_trip_p99_ms": 0.0, "round_trip_max_ms": 0.0,
    }  # fmt: skip


def test_in_a_sentence() -> None:
    assert str(Statistics()) == "no datagrams"
    statistics = Statistics()
    statistics.counters.update({"sent": 3, "received": 2})
    assert str(statistics) == "2 received, 3 sent"
    assert re.fullmatch(
        r"2 received, 3 sent, 1 stale; "
        r"round trip p50 1\.0\d\d ms, p99 8\.000 ms, max 8\.000 ms",
        str(some_statistics()),
    )

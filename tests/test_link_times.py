"""Timers of both state machines: resends, timeouts and the end, on a clock moved by hand."""

from typing import Any

import numpy as np
import pytest
from links import (
    HERE,
    OTHER,
    REFUSE,
    SESSION,
    STRANGER,
    WAIT,
    WELCOME,
    Wire,
    agent,
    close,
    command,
    drive,
    dropped,
    hello,
    simulator,
    state,
    to_ready,
    to_ready_again,
    to_waiting,
    unknown,
)
from rotorgram.udp import binary
from rotorgram.udp.agent_link import Event
from rotorgram.udp.messages import Refuse, Wait
from rotorgram.udp.simulator_link import SimulatorLink


def resend_times(link: SimulatorLink, now: float) -> list[float]:
    """When it resent, and at last gave up, after `now`."""
    times = []
    while True:
        timer = link.next_timer()
        assert timer is not None
        times.append(timer - now)
        if not link.handle_timer(timer):
            return times


def test_resends_back_off_within_bounds_until_the_timeout() -> None:
    link = simulator()
    link.connect(50.0)
    times = resend_times(link, 50.0)
    assert times[:3] == pytest.approx([0.2, 0.6, 1.4])
    assert np.diff(times[2:-1]) == pytest.approx(1.0)
    assert times[-1] == pytest.approx(10.0)
    assert link.take_outgoing() == [binary.encode(hello())] * len(times)  # no Close: nobody knows
    assert link.sends == len(times)
    assert link.statistics.counters == {"sent": 1, "resent": len(times) - 1}
    assert (link.state, link.next_timer()) == ("closed", None)


def test_a_silent_agent_is_told_when_the_simulator_gives_up() -> None:
    link = simulator()
    to_waiting(link, Wire("agent", False))
    link.take_outgoing()
    times = resend_times(link, 0.0)
    assert times[-1] == pytest.approx(10.0)
    goodbye = binary.encode(close(1, reason="no answer from the agent for 10 s"))
    outgoing = link.take_outgoing()
    assert outgoing == [binary.encode(state(1))] * (len(times) - 1) + [goodbye]
    assert link.state == "closing"


def test_every_resend_is_byte_identical() -> None:
    link = simulator()
    to_ready(link, Wire("agent", False))
    link.take_outgoing()
    link.send_state(state(1, value=0.1), 0.0)
    for _ in range(5):
        timer = link.next_timer()
        assert timer is not None
        assert link.take_outgoing() == [binary.encode(state(1, value=0.1))]
        assert link.handle_timer(timer)


def fly(link: SimulatorLink, sequence: int, now: float, trip: float) -> float:
    """One State and its Command; the time afterwards."""
    link.send_state(state(sequence), now)
    link.receive(binary.encode(command(sequence)), now + trip)
    return now + trip


def test_the_wait_follows_the_round_trips() -> None:
    link = simulator()
    to_ready(link, Wire("agent", False))
    now = fly(link, 1, 0.0, 0.05)  # the first round trip: mean 50 ms, variation 25 ms
    link.send_state(state(2), now)
    assert link.next_timer() == pytest.approx(now + 0.05 + 4 * 0.025)
    now += 0.05
    link.receive(binary.encode(command(2)), now)
    for sequence in range(3, 200):
        now = fly(link, sequence, now, 0.05)
    link.send_state(state(200), now)
    assert link.next_timer() == pytest.approx(now + 0.05, abs=1e-3)
    now += 30.0  # the agent learnt: a long pause must not stretch the wait past its bound
    link.receive(binary.encode(command(200)), now)
    link.send_state(state(201), now)
    assert link.next_timer() == pytest.approx(now + 1.0)


def test_an_ambiguous_round_trip_does_not_change_the_wait() -> None:
    link = simulator()
    to_ready(link, Wire("agent", False))
    link.send_state(state(1), 0.0)
    assert link.handle_timer(0.2)
    link.receive(binary.encode(command(1)), 0.2001)
    link.send_state(state(2), 1.0)
    assert link.next_timer() == pytest.approx(1.2)  # still the first wait
    # Statistics have it, from the first sending: that is what the flight waited for.
    assert link.statistics.round_trips.longest == pytest.approx(0.2001)


def test_fast_round_trips_keep_the_shortest_wait() -> None:
    link = simulator()
    to_ready(link, Wire("agent", False))
    now = fly(link, 1, 0.0, 1e-6)
    link.send_state(state(2), now)
    assert link.next_timer() == pytest.approx(now + 0.01)


def test_the_timer_does_nothing_before_its_time() -> None:
    link, server = simulator(), agent()
    assert (link.next_timer(), server.next_timer()) == (None, None)
    link.connect(0.0)
    link.take_outgoing()
    assert link.handle_timer(0.1)
    server.handle_timer(0.1)
    assert link.take_outgoing() == server.take_outgoing() == []


def test_nothing_but_the_awaited_datagram_extends_the_wait() -> None:
    link, wire = simulator(), Wire("agent", False)
    to_waiting(link, wire)
    now = 0.0
    while (timer := link.next_timer()) is not None and link.handle_timer(timer):
        now = timer
        for junk in (b"", b"junk", wire(command(0)), wire(WELCOME), wire(WAIT), wire(REFUSE)):
            link.receive(junk, now)
    assert timer == pytest.approx(10.0)
    assert link.state == "closing"


def test_while_wait_comes_the_timeout_does_not_run() -> None:
    link, wire = simulator(), Wire("agent", False)
    link.connect(0.0)
    now = 0.0
    for _ in range(100):  # ten times the timeout
        timer = link.next_timer()
        assert timer is not None
        assert link.handle_timer(timer)
        now = timer
        link.receive(wire(WAIT), now)
    assert now > 90
    assert link.state == "hello"
    assert link.statistics.take_notices() == [
        "every place at the agent is taken; waiting for a free one"
    ]
    assert not dropped(link)
    assert resend_times(link, now)[-1] == pytest.approx(10.0)  # then it does
    assert link.state == "closed"


def test_each_session_says_once_that_it_waits() -> None:
    link, wire = simulator(), Wire("agent", False)
    link.connect(0.0)
    for message in (WAIT, WAIT, WELCOME):
        link.receive(wire(message), 0.0)
    link.send_state(state(1), 0.0)
    for message in (unknown(1), Wait(session=OTHER), Wait(session=OTHER)):
        link.receive(wire(message), 0.0)
    assert [notice.split()[0] for notice in link.statistics.take_notices()] == [
        "every", "the", "every",
    ]  # fmt: skip


@pytest.mark.parametrize("side", ["simulator", "agent"])
def test_a_lost_close_is_repeated_until_nobody_will_answer(side: str) -> None:
    link: Any
    if side == "simulator":
        link = simulator()
        to_waiting(link, Wire("agent", False))
    else:
        link = agent(places=2)
        drive(link, ["other", hello(), state(1)], Wire("simulator", False))
    link.take_outgoing()
    link.close("done", 7.0)
    link.close("again", 7.0)
    times = []
    while (timer := link.next_timer()) is not None:
        times.append(timer - 7.0)
        link.handle_timer(timer)
    # Every 25 ms; the tenth time would be the end.
    assert times[:9] == pytest.approx([0.025 * n for n in range(1, 10)])
    assert times[-1] == pytest.approx(0.25)
    goodbye = binary.encode(close(1, reason="done"))
    if side == "simulator":
        assert link.state == "closed"
        assert set(link.take_outgoing()) == {goodbye}
    else:
        assert link.places == [None, None]
        other = binary.encode(close(1, session=5, reason="done"))
        assert set(link.take_outgoing()) == {(goodbye, HERE), (other, STRANGER)}
    assert 9 <= link.statistics.counters["resent"] / (1 + (side == "agent")) <= 10


def test_an_agent_that_closes_waits_only_for_those_who_have_not_answered() -> None:
    link, wire = agent(places=2), Wire("simulator", False)
    drive(link, ["other", hello(), state(1)], wire)
    link.close("done", 0.0)
    assert isinstance(link.receive(wire(close(1)), HERE, 0.01), Event)
    link.take_outgoing()
    link.handle_timer(0.025)
    again = binary.encode(close(1, session=5, reason="done"))
    assert link.take_outgoing() == [(again, STRANGER)]
    link.receive(wire(close(1, session=5)), STRANGER, 0.03)
    assert link.next_timer() is None
    assert link.take_outgoing() == []


@pytest.mark.parametrize("sealed", [False, True], ids=["open", "sealed"])
def test_an_agent_that_closes_refuses_those_who_wait(sealed: bool) -> None:
    ours, theirs = Wire("agent", sealed), Wire("simulator", sealed)
    link = agent(key=ours.key)
    drive(link, ["other", hello()], theirs)
    link.take_outgoing()
    link.close("done", 0.0)
    goodbye = close(1, session=5, reason="done")
    assert link.take_outgoing() == [
        (ours(goodbye), STRANGER),
        (ours(Refuse(session=SESSION, reason="done")), HERE),
    ]


def test_closing_before_anybody_knows_says_nothing() -> None:
    link = simulator()
    link.connect(0.0)
    link.take_outgoing()
    link.close("bye", 0.0)
    server = agent()
    server.close("nobody was there", 0.0)
    assert link.take_outgoing() == server.take_outgoing() == []
    assert link.next_timer() is server.next_timer() is None


def test_a_reason_becomes_one_line() -> None:
    link = simulator()
    to_ready(link, Wire("agent", False))
    link.take_outgoing()
    link.close("line one\nline two", 0.0)
    assert link.take_outgoing() == [binary.encode(close(0, reason="line one line two"))]


def test_ctrl_c_in_the_midst_of_a_state_leaves_it_unsent(monkeypatch: pytest.MonkeyPatch) -> None:
    # Or else the agent would have a State 2 and a Close of State 1, which is stale to it.
    link, wire = simulator(), Wire("agent", False)
    to_ready_again(link, wire)
    link.take_outgoing()

    def interrupted(_: SimulatorLink) -> float:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(SimulatorLink, "_resend_interval", interrupted)
        with pytest.raises(KeyboardInterrupt):
            link.send_state(state(2), 1.0)
    assert (link.state, link.sequence) == ("ready", 1)
    link.close("stopped", 1.0)
    (datagram,) = link.take_outgoing()
    assert binary.decode(datagram) == close(1, reason="stopped")

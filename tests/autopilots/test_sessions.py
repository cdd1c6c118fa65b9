"""Recorded sessions of flight stacks, played back: the same bytes go out, and the same flight."""

import json
import re
import sys
from pathlib import Path

import pytest
from player import read_session, write_session
from sessions import HASHES, SECONDS, SESSIONS, VEHICLES, flown, hash_of

PLAYER = Path(__file__).parents[1] / "player.py"
STACKS = sorted(VEHICLES)


@pytest.fixture
def played(tmp_path):
    """A program for each stack that plays a session: the recorded one, or another."""

    def program(name, session=None):
        path = tmp_path / name
        session = session or SESSIONS / f"{name}.xz"
        # The libraries for lock-step would stop the clock of an interpreter.
        words = f'unset LD_PRELOAD; exec "{sys.executable}" "{PLAYER}" "{session}" "$@"'
        path.write_text(f"#!/bin/sh\n{words}\n")
        path.chmod(0o755)
        return path

    return program


@pytest.mark.parametrize("name", STACKS)
def test_a_session_is_flown_again_to_the_bit(played, name):
    flight, tally = flown(name, played(name))
    assert tally.faults == []
    assert tally.late == 0
    assert hash_of(flight) == json.loads(HASHES.read_text())[name]


@pytest.mark.parametrize("name", STACKS)
def test_another_flight_is_not_the_recorded_one(played, name):
    _, tally = flown(name, played(name), effects={"motor_lag": True, "efficiency": (0.9, 1, 1, 1)})
    (fault,) = tally.faults
    assert f"{name}: ended with status 1: datagram " in fault
    assert "is not the recorded one" in fault


def changed(path, change):
    """A session of Betaflight or the Crazyflie whose 500th event from the end is another, or from
    which on it hangs.
    """
    events = list(read_session(SESSIONS / path.name))
    answers = [place for place, (port, _) in enumerate(events) if port is None]
    place = answers[-500]
    if change is None:
        del events[place:]
    else:
        events[place] = None, change
    write_session(path, events)
    return path


@pytest.mark.parametrize("wrong", [b"", b"\xff" * 3, b"\x04\x00\x00\x00" + b"\xff" * 64])
def test_wrong_motors_stop_them_and_nothing_else(played, tmp_path, wrong):
    session = changed(tmp_path / "betaflight.xz", wrong)
    flight, tally = flown("betaflight", played("betaflight", session))
    (fault,) = tally.faults
    assert re.match("betaflight: expected (68 bytes of|finite) motors, got ", fault)
    assert flight.telemetry["thrust"][-1].max() < 1e-3
    assert len(flight) == SECONDS * 1000


@pytest.mark.parametrize("name", STACKS)
def test_a_program_that_hangs_stops_the_motors(played, tmp_path, name):
    session = changed(tmp_path / f"{name}.xz", None)
    flight, tally = flown(name, played(name, session))
    (fault,) = tally.faults
    assert fault.startswith(f"{name}: expected an answer within 5 s, got none")
    assert flight.telemetry["velocity"][-1, 2] < -1.0

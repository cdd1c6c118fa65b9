"""Programs of others: their folders, ports, ends."""

import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import textwrap
import time
from ast import literal_eval
from collections import deque
from itertools import islice
from pathlib import Path

import pytest
from rotorgram.autopilots import programs
from rotorgram.autopilots.programs import HOST, Program
from rotorgram.models import InputError
from rotorgram.udp.protocol.errors import PeerClosed, PeerSilent

CORES = """
import os, socket, sys, time
time.sleep(0.3)  # until its core is chosen
mine = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
mine.sendto(repr(os.sched_getaffinity(0)).encode(), ("127.0.0.1", int(sys.argv[1])))
"""
FLOOD = """
import socket, sys, time
mine = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
while True:
    mine.sendto(b"no answer", ("127.0.0.1", int(sys.argv[1])))
    time.sleep(0.001)
"""
ECHO = """
import os, socket, sys
mine = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
mine.sendto(os.getcwd().encode(), ("127.0.0.1", int(sys.argv[1])))
while True:
    data, there = mine.recvfrom(100)
    if data == b"end":
        os.kill(os.getpid(), 9)
    mine.sendto(data, there)
"""


def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind((HOST, 0))
        return one.getsockname()[1]


def any_of(datagram):
    return datagram


def started(text, name="echo"):
    program = Program(name, free_port())
    port = program.link.getsockname()[1]
    program.start(sys.executable, ["-c", text, str(port)])
    return program


def runs(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_it_runs_in_a_folder_of_its_own_that_goes():
    program = started(ECHO)
    folder = program.meet(any_of).decode()
    assert folder == str(program.folder.resolve())
    program.close()
    assert not program.folder.exists()
    program.close()


def test_in_lock_step_programs_have_cores_and_leave_one():
    before = os.sched_getaffinity(0)
    others = len(before) - 1
    running = [started(CORES) for _ in range(others)]
    taken = [literal_eval(program.meet(any_of).decode()) for program in running]
    assert all(len(cores) == 1 and cores < before for cores in taken)
    assert len(set().union(*taken)) == others
    assert os.sched_getaffinity(0) == before
    for program in running:
        program.close()


def test_a_program_that_says_nothing_takes_no_time_of_this_thread():
    program = started(ECHO)
    program.meet(any_of)
    program.send(b"hello")
    assert program.receive() == b"hello"
    used = time.thread_time()
    with pytest.raises(PeerSilent):
        program.receive(wait=1.0)
    assert time.thread_time() - used < 0.1
    program.close()


def test_cores_that_the_user_chose_are_kept():
    before = os.sched_getaffinity(0)
    chosen = {max(before)}
    os.sched_setaffinity(0, chosen)
    try:
        program = started(CORES)
        assert program.meet(any_of).decode() == repr(chosen)
        program.close()
        assert os.sched_getaffinity(0) == chosen
    finally:
        os.sched_setaffinity(0, before)


def test_it_runs_where_cores_cannot_be_chosen(monkeypatch):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setaffinity", refuse)
    program = started(CORES)
    assert program.meet(any_of).decode() == repr(os.sched_getaffinity(0))
    program.close()


def test_one_with_its_own_clock_runs_where_it_likes():
    before = os.sched_getaffinity(0)
    program = Program("echo", free_port())
    words = ["-c", CORES, str(program.link.getsockname()[1])]
    program.start(sys.executable, words, period=0.01)
    assert program.meet(any_of).decode() == repr(before)
    assert os.sched_getaffinity(0) == before
    program.close()


def test_one_that_ends_says_what_it_said_last():
    program = started("import sys; print('first'); sys.exit('no gyro')")
    with pytest.raises(PeerClosed, match=r"^echo: ended with status 1: no gyro$"):
        program.receive(wait=5.0)
    program.close()


def test_one_that_hangs_is_named():
    program = started("import time; time.sleep(60)")
    with pytest.raises(PeerSilent, match=r"^echo: expected an answer within 0\.1 s, got none$"):
        program.receive(wait=0.1)
    program.close()


def test_one_that_only_talks_is_named(monkeypatch):
    monkeypatch.setattr(programs, "ANSWER", 0.5)
    program = started(FLOOD)
    program.meet(any_of)
    program.send(b"hello")
    heard = iter(program.receive, b"an answer")
    assert next(heard) == b"no answer"
    with pytest.raises(PeerSilent, match=r"^echo: expected an answer within 5 s, got none$"):
        deque(islice(heard, 100_000))
    program.close()


def test_one_that_ignores_the_signal_is_killed():
    program = started("import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN)" + ECHO)
    program.meet(any_of)
    began = time.monotonic()
    program.close()
    assert time.monotonic() - began < 10.0


def test_what_cannot_be_run_is_refused(tmp_path):
    program = Program("echo", free_port())
    nothing = tmp_path / "none"
    for content in (None, "text"):
        if content:
            nothing.write_text(content)
        with pytest.raises(InputError, match=f"expected one that can be run, got {nothing}$"):
            program.start(nothing)
    program.close()


def test_the_next_program_has_other_ports():
    port = free_port()
    first = Program("echo", port, apart=7)
    second = Program("echo", port, apart=7)
    assert (first.moved, second.moved) == (0, 7)
    assert second.link.getsockname()[1] == port + 7
    with pytest.raises(InputError, match=f"expected that port {port} is free, got one in use"):
        Program("echo", port)
    first.close()
    third = Program("echo", port, apart=7)
    assert third.moved == 0
    second.close()
    third.close()


def test_a_port_that_the_program_needs_is_checked():
    taken = free_port()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((HOST, taken))
        with pytest.raises(InputError, match=f"port {taken} is free"):
            Program("echo", free_port(), (taken,))


def test_nothing_is_left_when_we_are_killed(tmp_path):
    ours = textwrap.dedent(f"""
        import sys, time
        from rotorgram.autopilots.programs import Program
        program = Program("echo", {free_port()})
        sleeper = "import os, time; print(os.getpid(), flush=True); time.sleep(60)"
        program.start(sys.executable, ["-c", sleeper])
        print(program.folder, flush=True)
        time.sleep(60)
    """)
    process = subprocess.Popen([sys.executable, "-c", ours], stdout=subprocess.PIPE, text=True)
    folder = process.stdout.readline().strip()
    deadline = time.monotonic() + 10.0
    while not (said := (Path(folder) / "output.txt").read_text()):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    while runs(int(said)):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    shutil.rmtree(folder)


def test_a_program_of_the_user_is_told_how_and_waited_for(capsys):
    program = Program("echo", free_port())
    port = program.link.getsockname()[1]
    program.start(None, ["-c", ECHO, str(port)], {"SPEED": "1 2"})
    said = capsys.readouterr().out
    assert said.startswith("echo: waiting for it; start it so:\n")
    command = said.split("\n", 1)[1].replace(" echo ", f" {shlex.quote(sys.executable)} ")
    with subprocess.Popen(
        ["sh", "-c", f"exec env {command.split('&& ')[1]}"], cwd=program.folder
    ) as own:
        assert program.meet(any_of).decode() == str(program.folder.resolve())
        own.kill()
    with pytest.raises(PeerSilent, match=r"expected an answer within 0\.1 s"):
        program.receive(wait=0.1)
    program.close()


def test_only_the_program_is_heard():
    program = Program("echo", free_port())
    here = program.link.getsockname()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.sendto(b"hostile", here)
        program.start(sys.executable, ["-c", ECHO, str(here[1])])

        def read(datagram):
            if datagram == b"hostile":
                raise InputError("expected no hostile one")

        program.meet(read)
        for number in range(100):
            other.sendto(f"hostile {number}".encode(), here)
        program.send(b"hello")
        assert program.receive() == b"hello"
    with pytest.raises(PeerSilent):
        program.receive(wait=0.1)
    program.close()


def answers(text, words, period=None):
    """What a program says in reply to words, a step each: its text after 'say: '."""
    program = Program("echo", free_port())
    port = program.link.getsockname()[1]
    program.start(sys.executable, ["-c", text, str(port)], period=period)
    program.meet(any_of)

    def read(datagram):
        return datagram[5:] if datagram.startswith(b"say: ") else None

    for word in words:
        program.send(word)
        yield program.answer(read)
    program.close()


def test_in_lock_step_each_answer_is_waited_for():
    slow = "    import time; time.sleep(0.05)\n    mine.sendto(b'say: ' + data, there)\n"
    assert list(answers(ECHO + slow, [b"one", b"two"])) == [b"one", b"two"]


def test_by_its_own_clock_the_newest_of_a_period_counts_and_none_is_late():
    period = 0.2
    counts = ECHO.replace(
        "    mine.sendto(data, there)",
        "    for one in range(3 * int(data)): mine.sendto(b'say: %d' % one, there)",
    )
    began = time.monotonic()
    assert list(answers(counts, [b"1", b"0", b"2"], period)) == [b"2", None, b"5"]
    assert time.monotonic() - began >= 3 * period


def test_by_its_own_clock_too_only_the_program_is_heard():
    program = Program("echo", free_port())
    here = program.link.getsockname()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:

        def read(datagram):
            other.sendto(b"hostile", here)  # before the link is connected

        program.start(sys.executable, ["-c", ECHO, str(here[1])], period=0.2)
        program.meet(read)
        assert program.answer(any_of) is None
        program.send(b"hello")
        assert program.answer(any_of) == b"hello"
    program.close()


def test_one_with_its_own_clock_that_says_no_more_is_named(monkeypatch):
    monkeypatch.setattr("rotorgram.autopilots.programs.ANSWER", 0.3)
    dead = answers(ECHO, 100 * [b"end"], 0.01)
    assert [next(dead) for _ in range(10)] == 10 * [None]
    with pytest.raises(PeerClosed, match=r"^echo: ended with status -9: it said nothing$"):
        list(dead)


def test_one_that_is_killed_is_named():
    program = started(ECHO)
    program.meet(any_of)
    program.send(b"end")
    for _ in range(3):
        time.sleep(0.05)
        program.send(b"hello")
    with pytest.raises(PeerClosed, match=r"^echo: ended with status -9: it said nothing$"):
        program.receive(wait=1.0)
    program.close()

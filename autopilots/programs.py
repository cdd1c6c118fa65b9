"""Programs of others: each in a folder of its own, that ends with this process."""

import math
import os
import shlex
import shutil
import socket
import subprocess
import time
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import cache
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

from ..models import InputError
from ..udp.protocol.errors import PeerClosed, PeerSilent

HOST = "127.0.0.1"
ANSWER = 5.0
"""Longest time for an answer, s."""
_MOST = 16
"""Of one kind that run side by side."""
WATCH = 0.001
"""Time for which this thread watches for an answer, s, before it sleeps until one comes."""
REST = 0.1
"""After a watch without an answer, time until it watches again, s: others may want the core."""
_BEHIND = 0.005  # s: a longer delay of real time is not made up for
_LOG = "output.txt"
_STARTED = count()

Answer = TypeVar("Answer")


class Program:
    """A program that runs, with datagrams to and from it. `close` ends it, as does the end of this
    process. Its folder is removed then.

    Attributes:
        moved: What is added to its ports: several programs of one kind have others.
        folder: Where it runs.
        link: The socket that gets what the program sends to its simulator.
        sent_at: When it was sent something, s of the monotonic clock.
    """

    def __init__(self, name: str, own: int, others: Sequence[int] = (), apart: int = 0) -> None:
        """It is the first of several programs whose ports on the loopback interface are free:
        `own`, of `link`, and `others`, which the program will bind, each moved by `apart` a
        program.

        Raises `InputError` if none are free.
        """
        self.name = name
        self._closing = ExitStack()
        self._end = weakref.finalize(self, self._closing.close)
        self.folder = Path(self._closing.enter_context(TemporaryDirectory(prefix="rotorgram-")))
        self._process: subprocess.Popen[bytes] | None = None
        self._there: tuple[str, int] | None = None  # from where it sends
        # `_watch_from`: when answers are watched for again; never before it has a core of its own.
        self.sent_at = self._watch_from = math.inf
        self._period: float | None = None
        self._due = self._heard = 0.0
        last = (_MOST - 1) * apart
        for self.moved in range(0, last + 1, apart or 1):
            try:
                self.link = self.listen(own)
                for port in others:
                    bound_socket(name, port + self.moved).close()
            except InputError:
                if self.moved == last:
                    raise
            else:
                return

    def start(
        self,
        program: Path | str | None,
        arguments: Sequence[str] = (),
        environment: Mapping[str, str] = {},
        period: float | None = None,
    ) -> None:
        """Run it in the folder, its output in a file there. Without a program, say how the user
        starts it, and wait for it.

        With a period of its steps, s, it keeps its own clock. Without one it is kept on one of
        several cores, and this thread watches for its answers: a thread that sleeps wakes late.
        """
        self._period = period
        if program is None:
            around = [f"{name}={shlex.quote(value)}" for name, value in environment.items()]
            words = " ".join([*around, shlex.join([self.name, *arguments])])
            place = shlex.quote(str(self.folder))
            print(f"{self.name}: waiting for it; start it so:\ncd {place} && {words}")
            return
        command = [str(program), *arguments]
        if not os.access(program, os.X_OK):
            raise InputError(f"program: expected one that can be run, got {program}")
        if shutil.which("setpriv"):  # it is killed even if this process is
            command = ["setpriv", "--pdeathsig", "KILL", *command]
        log = self._closing.enter_context((self.folder / _LOG).open("wb"))
        self._process = subprocess.Popen(
            command,
            cwd=self.folder,
            env={**os.environ, **environment},
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            process_group=0,
        )
        self._closing.enter_context(self._process)  # waits for its end
        self._closing.callback(self._process.kill)  # while it waits it takes no other signal
        if period is None:
            with suppress(OSError, AttributeError):  # a system where cores cannot be chosen
                if others := sorted(os.sched_getaffinity(0))[1:]:
                    core = others[(os.getpid() + next(_STARTED)) % len(others)]
                    os.sched_setaffinity(self._process.pid, {core})
                    self._watch_from = 0.0

    def listen(self, port: int) -> socket.socket:
        """A socket that gets what the program sends there. It does not wait."""
        bound = self._closing.enter_context(bound_socket(self.name, port + self.moved))
        bound.setblocking(False)
        return bound

    def keep(self, connection: socket.socket) -> socket.socket:
        """A connection to the program, which is closed with it."""
        return self._closing.enter_context(connection)

    def receive(self, where: socket.socket | None = None, wait: float = ANSWER) -> bytes:
        """The next datagram, of `link` unless told otherwise.

        Raises `PeerSilent` where none comes, or when those since the last one that was sent were no
        answer for too long, `PeerClosed` if it has ended.
        """
        where = where or self.link
        with suppress(TimeoutError, ConnectionRefusedError):
            while (now := time.monotonic()) < self.sent_at + ANSWER:
                watches = max(self._watch_from, self.sent_at) <= now < self.sent_at + WATCH
                if self._watch_from <= now and not watches:
                    self._watch_from = now + REST
                where.settimeout(0.0 if watches else wait)
                try:
                    datagram, sender = where.recvfrom(2048)
                except BlockingIOError:
                    continue
                if where is not self.link or sender == self._there:
                    return datagram
        raise self.silent(f"an answer within {wait:g} s, got none")

    def meet(self, read: Callable[[bytes], object]) -> bytes:
        """The first datagram on `link` that `read` does not refuse by `InputError`. From then on
        only its sender is heard. Raises as `receive`.
        """
        deadline = time.monotonic() + ANSWER
        self.link.settimeout(ANSWER if self._process else None)
        while self._process is None or time.monotonic() < deadline:
            with suppress(TimeoutError, InputError):
                datagram, sender = self.link.recvfrom(2048)
                read(datagram)
                self._there = sender
                self.link.connect(sender)
                self.link.setblocking(False)
                self._due = self._heard = time.monotonic()
                return datagram
        raise self.silent(f"an answer within {ANSWER:g} s, got none")

    def answer(self, read: Callable[[bytes], Answer | None]) -> Answer | None:
        """Its answer to a step, as `read` takes it from a datagram on `link`; None of another one.

        In lock-step the first answer is waited for. By its own clock a step takes its period of
        real time, and the answer is the newest that came in it, or None. Raises as `receive`.
        """
        answer = None
        if self._period is None:
            while answer is None:
                answer = read(self.receive())
            return answer
        self._due = max(self._due, time.monotonic() - _BEHIND) + self._period
        time.sleep(max(self._due - time.monotonic(), 0.0))
        for datagram, sender in arrived(self.link):
            newer = read(datagram) if sender == self._there else None
            answer = answer if newer is None else newer
        now = time.monotonic()
        if answer is not None:
            self._heard = now
        elif now - self._heard > ANSWER:
            raise self.silent(f"an answer within {ANSWER:g} s, got none")
        return answer

    def silent(self, words: str) -> Exception:
        """Why what was expected did not come: it has ended, or else in words."""
        status = self._process.poll() if self._process else None
        if status is None:
            return PeerSilent(f"{self.name}: expected {words}")
        lines = (self.folder / _LOG).read_text(errors="replace").strip().splitlines()
        said = lines[-1] if lines else "it said nothing"
        return PeerClosed(f"{self.name}: ended with status {status}: {said}")

    def send(self, datagram: bytes, port: int | None = None) -> None:
        """Send to a port of it, before that is moved; unless told otherwise to that from which it
        sent first.
        """
        assert self._there is not None
        self.sent_at = time.monotonic()
        with suppress(ConnectionRefusedError):  # it has ended: `receive` says so
            self.link.sendto(datagram, (HOST, port + self.moved) if port else self._there)

    def library(self, source: Path) -> str:
        """Path of a shared library of a C file, in the folder. Raises `InputError`."""
        library = self.folder / f"{source.stem}.so"
        library.write_bytes(_compiled(source))
        return str(library)

    def close(self) -> None:
        """End it. It may be called again."""
        self._end()


@cache
def _compiled(source: Path) -> bytes:
    """A shared library of a C file. Raises `InputError`."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        raise InputError("autopilot: expected a C compiler for lock-step, got none: install gcc")
    with TemporaryDirectory() as folder:
        library = Path(folder) / "library"
        words = (compiler, "-O2", "-shared", "-fPIC", "-o", library, source, "-ldl", "-lpthread")
        subprocess.run(words, check=True)
        return library.read_bytes()


def arrived(link: socket.socket) -> Iterator[tuple[bytes, tuple[str, int]]]:
    """Datagrams that have come to a socket that does not wait, with their senders."""
    with suppress(BlockingIOError, ConnectionError):
        while True:
            yield link.recvfrom(2048)


def bound_socket(name: str, port: int) -> socket.socket:
    """A socket for datagrams on a port. Raises `InputError` if that is taken."""
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        bound.bind((HOST, port))
    except OSError:
        bound.close()
        raise InputError(
            f"{name}: expected that port {port} is free, got one in use: does another run?"
        ) from None
    return bound

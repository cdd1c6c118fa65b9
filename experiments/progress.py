"""Progress of runs in other processes: one small datagram now and then.

A lost datagram does no harm: the next one has the same numbers. Processes share no pipe or lock,
and a run goes on without a listener. Datagrams stay on this machine: a run on another machine
reports nothing before it is done.
"""

import contextlib
import json
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Lock, Thread

__all__ = ["Home", "OnProgress", "Tell", "listening", "telling"]

OnProgress = Callable[[str, int, int, str], None]
"""Called with a run's name, the amounts done and in total, and a status text."""

Tell = Callable[[int, int, str], None]
"""The same for one run, without its name."""

Home = tuple[str, int]
"""Of a listener: the name of its machine, and a port."""


@contextmanager
def telling(name: str, home: Home) -> Iterator[Tell]:
    """A function that tells the progress of one run to a listener on the same machine."""
    host, port = home
    here = host == socket.gethostname()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:

        def tell(done: int, total: int, words: str) -> None:
            if here:
                with contextlib.suppress(OSError):  # nobody listens
                    data = json.dumps([name, done, total, words]).encode()
                    sock.sendto(data, ("127.0.0.1", port))

        yield tell


@contextmanager
def listening(on_progress: OnProgress) -> Iterator[tuple[Home, OnProgress]]:
    """Pass on the progress of runs, from a thread of its own, to the end of the block.

    Gives the home for `telling`, and a function that passes on progress of this process.
    """
    lock = Lock()

    def tell(name: str, done: int, total: int, words: str) -> None:
        with lock:
            on_progress(name, done, total, words)

    def listen() -> None:
        while datagram := sock.recv(4096):
            try:
                name, done, total, words = json.loads(datagram)
            except (TypeError, ValueError):
                continue
            tell(str(name), int(done), int(total), str(words))

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        address = sock.getsockname()
        thread = Thread(target=listen, daemon=True)
        thread.start()
        try:
            yield (socket.gethostname(), address[1]), tell
        finally:
            sock.sendto(b"", address)
            thread.join()

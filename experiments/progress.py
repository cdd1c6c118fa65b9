"""Progress of runs in other processes: one small datagram now and then.

A lost datagram does no harm: the next one has the same numbers. Processes share no pipe or lock,
and a run goes on without a listener. Datagrams stay on this machine: a run on another machine
reports nothing before it is done.
"""

import contextlib
import json
import math
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from threading import Lock, Thread
from typing import Final

__all__ = ["OnProgress", "Progress", "ProgressListener", "ProgressSender"]

OnProgress = Callable[[str, int, int, str], None]
"""Called with a run's name, the amounts done and in total, and a status text."""

_EVERY: Final = 0.2  # s


@dataclass(frozen=True, kw_only=True)
class Progress:
    """Progress of a training."""

    env_steps: int
    total: int
    seconds: float
    mean_return: float
    """Of the last 20 episodes; NaN before the first has ended. TensorBoard's curve is over 100."""
    mean_size: float
    """Mean size of the headline metric, of the last 20 episodes; NaN if there is none."""
    symbol: str = ""
    """Of that metric."""
    unit: str = ""

    def words(self) -> str:
        """Status text for a progress bar."""
        if math.isnan(self.mean_return):
            return ""
        text = f"return {self.mean_return:.0f}"
        if math.isnan(self.mean_size):
            return text
        return f"{text}, |{self.symbol}| {self.mean_size:.2f} {self.unit}".rstrip()


class ProgressSender:
    """Tells the progress of one run to a `ProgressListener` on the same machine.

    Args:
        name: Of the run.
        home: The listener's.
    """

    def __init__(self, name: str, home: tuple[str, int]) -> None:
        self.name = name
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        host, port = home
        self._to = ("127.0.0.1", port) if host == socket.gethostname() else None
        self._last = 0.0

    def __call__(self, done: int, total: int, words: str) -> None:
        """Tell it now."""
        if self._to is None:
            return
        with contextlib.suppress(OSError):  # nobody listens
            self._socket.sendto(json.dumps([self.name, done, total, words]).encode(), self._to)

    def __enter__(self) -> "ProgressSender":
        """Return the sender, to be closed at the end of the block."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close its socket."""
        self._socket.close()

    def rarely(self, state: Callable[[], Progress]) -> None:
        """Tell it, unless it was told a moment ago."""
        now = time.monotonic()
        if now - self._last >= _EVERY:
            self._last = now
            now_at = state()
            self(now_at.env_steps, now_at.total, now_at.words())


class ProgressListener:
    """Passes on the progress of runs, from a thread of its own, until its block ends."""

    def __init__(self, on_progress: OnProgress) -> None:
        self._on_progress = on_progress
        self._lock = Lock()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._port: int = self._socket.getsockname()[1]
        self.home = (socket.gethostname(), self._port)
        """Name of this machine, and port: for `ProgressSender`."""
        self._thread = Thread(target=self._listen, daemon=True)

    def __enter__(self) -> "ProgressListener":
        """Begin to listen."""
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Pass on what is left, and end."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            sock.sendto(b"", ("127.0.0.1", self._port))
        self._thread.join()
        self._socket.close()

    def tell(self, name: str, done: int, total: int, words: str) -> None:
        """Pass on progress of this process."""
        with self._lock:
            self._on_progress(name, done, total, words)

    def _listen(self) -> None:
        while datagram := self._socket.recv(4096):
            try:
                name, done, total, words = json.loads(datagram)
            except (TypeError, ValueError):
                continue
            self.tell(str(name), int(done), int(total), str(words))

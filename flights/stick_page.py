"""The page with two sticks: a server for browsers, which steer by POST and read the flight."""

import secrets
from collections.abc import Callable
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

from ..models.errors import InputError
from ..models.fields import Limits, check

_LONGEST = Limits(1, 256, "bytes", whole=True)
_PAGE = Path(__file__).with_name("sticks.html")


class StickPage(ThreadingHTTPServer):
    """Serves the page in threads of its own. Only who knows the key in its address may steer.

    Args:
        bind: Address to wait at; port 0 takes a free one.
        steer: Gets the body of every request that steers. Raises `InputError`.

    Attributes:
        url: Address for a browser.
        shown: The flight as it is now, for the page, JSON: the answer to each such request.
    """

    def __init__(self, bind: tuple[str, int], steer: Callable[[bytes], None]) -> None:
        super().__init__(bind, _Handler)
        self.steer = steer
        self.shown = b"{}"
        self.path = f"/{secrets.token_urlsafe(16)}"
        host, port = self.server_address[:2]
        self.url = f"http://{host!s}:{port}{self.path}"
        Thread(target=self.serve_forever, daemon=True).start()

    def close(self) -> None:
        """Stop."""
        self.shutdown()
        self.server_close()


class _Handler(BaseHTTPRequestHandler):
    server: StickPage
    protocol_version = "HTTP/1.1"  # one connection for all requests of a page
    timeout = 5  # s without a request

    def handle(self) -> None:
        with suppress(OSError):  # the tab was closed
            super().handle()

    def do_GET(self) -> None:
        self._reply(_PAGE.read_bytes, "text/html; charset=utf-8")

    def do_POST(self) -> None:
        self._reply(self._steered, "application/json")

    def _steered(self) -> bytes:
        length: str | int = self.headers.get("Content-Length", "")
        with suppress(ValueError):  # of what is no number, or has thousands of digits
            length = int(length)
        size = check("body", _LONGEST, length)
        self.server.steer(self.rfile.read(size))
        return self.server.shown

    def _reply(self, content: Callable[[], bytes], kind: str) -> None:
        status = 200
        try:
            if not secrets.compare_digest(self.path.encode(), self.server.path.encode()):
                raise InputError("key: expected the address that rotorgram teleop printed")
            body = content()
        except InputError as error:
            status = 400
            body = str(error).encode()
            kind = "text/plain; charset=utf-8"
            self.close_connection = True  # the rest of the body was not read
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Say nothing."""

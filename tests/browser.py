"""A headless Chromium, driven over its pipe for debugging."""

import base64
import itertools
import json
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

CHROMIUM = shutil.which("chromium")


class Browser:
    """One tab, which other tabs may join."""

    def __init__(self, sent: int, received: int) -> None:
        self._sent = sent
        self._received = received
        self._numbers = itertools.count(1)
        self._left = b""
        self._session = ""

    def call(self, method: str, *, session: str | None = None, **parameters: Any) -> Any:
        """A command of the DevTools protocol; its result."""
        number = next(self._numbers)
        words = {"id": number, "method": method, "params": parameters}
        if session is None:
            session = self._session
        if session:
            words["sessionId"] = session
        os.write(self._sent, json.dumps(words).encode() + b"\0")
        while True:
            while b"\0" not in self._left:
                more = os.read(self._received, 1 << 16)
                assert more, "the browser has ended"
                self._left += more
            message, _, self._left = self._left.partition(b"\0")
            answer = json.loads(message)
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]

    def open(self, url: str, script: str = "") -> str:
        """Open a tab, and run a script before those of the page; its id."""
        target = self.call(
            "Target.createTarget",
            session="",
            url="about:blank",
            newWindow=True,
            width=900,
            height=600,
        )
        flat = {"targetId": target["targetId"], "flatten": True}
        self._session = self.call("Target.attachToTarget", session="", **flat)["sessionId"]
        self.call("Page.enable")
        if script:
            self.call("Page.addScriptToEvaluateOnNewDocument", source=script)
        self.call("Page.navigate", url=url)
        return str(target["targetId"])

    def close(self, target: str) -> None:
        """Close a tab."""
        self._session = ""
        self.call("Target.closeTarget", targetId=target)

    def evaluate(self, script: str) -> Any:
        """The value of an expression on the page."""
        result = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def mouse(self, kind: str, x: float, y: float) -> None:
        """`mousePressed`, `mouseMoved` or `mouseReleased`, pixels."""
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def key(self, kind: str, code: str) -> None:
        """`keyDown` or `keyUp`."""
        self.call("Input.dispatchKeyEvent", type=kind, code=code, key=code)

    def screenshot(self, path: Path) -> None:
        data = self.call("Page.captureScreenshot", format="png")["data"]
        path.write_bytes(base64.b64decode(data))


@contextmanager
def browser(folder: Path) -> Iterator[Browser]:
    """Skips the test where there is no Chromium."""
    if CHROMIUM is None:
        pytest.skip("needs chromium")
    to_read, to_send = os.pipe()
    to_receive, to_write = os.pipe()
    words = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe"]
    words += [f"--user-data-dir={folder}", "--no-first-run"]
    # The browser reads its descriptor 3 and writes its descriptor 4.
    shell = f'exec "$@" 3<&{to_read} 4>&{to_write}'
    process = subprocess.Popen(
        ["bash", "-c", shell, "bash", *words],
        pass_fds=(to_read, to_write),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    os.close(to_read)
    os.close(to_write)
    try:
        yield Browser(to_send, to_receive)
    finally:
        process.kill()
        process.wait()
        os.close(to_send)
        os.close(to_receive)

"""The README's Python is pasted and run as it stands, but for the port."""

import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
BLOCKS = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)


@pytest.mark.parametrize("code", BLOCKS, ids=range(len(BLOCKS)))
def test_snippet(code: str, tmp_path: Path) -> None:
    simulators = []
    if "Remote" in code:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            sock.bind(("127.0.0.1", 0))
            port = sock.getsockname()[1]
        code = code.replace("8001", str(port))
        count, drones = (2, 4) if "RemoteVectorEnv" in code else (1, 1)
        flags = ["--server", f"127.0.0.1:{port}", "--bind", "127.0.0.1:0"]
        command = [sys.executable, "-m", "rotorgram.cli", "sim", "--num-envs", str(drones), *flags]
        simulators = [subprocess.Popen(command) for _ in range(count)]
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=90
    )
    assert done.returncode == 0, done.stderr
    assert not list(tmp_path.iterdir()), "a snippet leaves no files behind"
    for simulator in simulators:
        assert simulator.wait(20) == 0


def test_every_snippet_is_found() -> None:
    assert len(BLOCKS) == 5


def test_links_lead_somewhere() -> None:
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        for target in re.findall(r"\]\((?!https?:|#)([^)#]+)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"

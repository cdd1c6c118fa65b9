"""docs/troubleshooting.md quotes what is really printed: each sentence is provoked."""

import sys
from contextlib import suppress
from pathlib import Path
from threading import Thread

import pytest
from peers import plain_socket
from programs import ROOT, free_port
from rotorgram.cli import main
from rotorgram.udp import PeerSilent, RemoteEnv

PAGE = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
CODE = " ".join(PAGE.split()).split("`")[1::2]
"""What the page quotes between backquotes."""
QUIET = ["sim", "--bind", "127.0.0.1:0", "--timeout", "0.3", "--server"]
"""A simulator that gives up soon."""


@pytest.fixture
def key(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    main(["key", str(tmp_path / "drone.key")])
    capsys.readouterr()
    return tmp_path / "drone.key"


def check(arguments: list[str], parts: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """That the command fails with one sentence of these parts, and that the page quotes them."""
    assert main(arguments) != 0
    *logged, sentence = capsys.readouterr().err.splitlines()
    assert sentence.startswith("rotorgram: ")
    assert all(line.startswith("rotorgram: dropped a datagram") for line in logged)
    for part in parts:
        assert part in sentence
        assert any(part in code for code in CODE), part


def test_no_agent(key: Path, capsys: pytest.CaptureFixture[str]) -> None:
    alone = [*QUIET, f"127.0.0.1:{free_port()}"]
    parts = ["no answer from the agent at", "Hello sent", "nothing listens on that port"]
    check(alone, parts, capsys)
    keyed = [*alone, "--key-file", str(key)]
    check(keyed, ["; an agent with another key does not answer"], capsys)


def test_an_agent_that_drops_everything(capsys: pytest.CaptureFixture[str]) -> None:
    """As behind a firewall: there is a socket, and no answer."""
    with plain_socket() as sock:
        assert main([*QUIET, "{}:{}".format(*sock.getsockname())]) == 1
    sentence = capsys.readouterr().err
    assert "no answer from the agent at" in sentence
    assert "nothing listens" not in sentence


@pytest.mark.parametrize(
    ("keyed", "part"),
    [(True, "key: this agent has one (--key-file), and the simulator has none"),
     (False, "refused: options: expected target 6.0, got 5.0")],
)  # fmt: skip
def test_refused(keyed: bool, part: str, key: Path, capsys: pytest.CaptureFixture[str]) -> None:
    env = RemoteEnv(
        ("127.0.0.1", 0),
        options={} if keyed else {"target": 6.0},
        key_file=key if keyed else None,
        connect=False,
        connect_timeout=3.0,
    )
    waiting = Thread(target=_wait, args=[env])
    waiting.start()
    check([*QUIET, "{}:{}".format(*env.address)], [part], capsys)
    waiting.join()
    env.close()


def _wait(env: RemoteEnv) -> None:
    with suppress(PeerSilent):
        env.connect()


def test_an_address_that_others_reach(capsys: pytest.CaptureFixture[str]) -> None:
    part = "is not a loopback address: expected 127.0.0.1, or a key"
    check(["serve", "pid", "--listen", "0.0.0.0:8001"], [part], capsys)


def test_a_port_in_use(capsys: pytest.CaptureFixture[str]) -> None:
    with plain_socket() as sock:
        address = "{}:{}".format(*sock.getsockname())
        parts = ["cannot bind", ": the port is in use"]
        check(["serve", "pid", "--listen", address], parts, capsys)


def test_a_bad_key_file(key: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["sim", "--key-file", str(key)]
    key.write_text("abc")
    check(arguments, ["key file: expected 64 hexadecimal digits"], capsys)
    key.chmod(0o644)
    check(arguments, ["to be readable by its owner alone (chmod 600)"], capsys)


def test_a_folder_that_is_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    check(
        ["train", "a2c", "--out", str(tmp_path)],
        ["out: expected a new folder", "exists already"],
        capsys,
    )


def test_a_missing_layer(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    check(["train", "sb3-a2c"], ["pip install 'rotorgram[train]'"], capsys)


def test_a_task_that_is_not_known(capsys: pytest.CaptureFixture[str]) -> None:
    check(["sim", "--env", "rotorgram/Race-v0"], ["env: expected a registered id ("], capsys)


def test_nothing_to_draw_with(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "disable")
    parts = ["OpenGL: expected EGL", "apt-get install libegl1 libgl1-mesa-dri",
             "got none (MUJOCO_GL switches it off)"]  # fmt: skip
    check(["render", "pid", "--out", str(tmp_path / "a.png")], parts, capsys)


def test_no_display(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    check(["view", "pid"], ["window: expected a display, got none"], capsys)

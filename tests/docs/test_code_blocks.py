"""Every code block of README and docs: Python runs as pasted, commands are ones that there are.

A block whose fence says `python continued` goes on from the block before it on that page. A block
that names port 8001 gets simulators; the port is then one of the test's own. A command of ours in a
comment of its own is run first. What else is not as on the page stands in `INSTEAD`, with the
reason.
"""

import io
import re
import shlex
import subprocess
import sys
import tomllib
from contextlib import redirect_stdout
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import pytest
from programs import EXAMPLES, ROOT, free_port, rotorgram, run
from rotorgram.cli import COMMANDS
from rotorgram.cli._parser import parse
from rotorgram.training.settings import Study

PAGES = [
    ROOT / "README.md",
    *sorted(path for path in (ROOT / "docs").rglob("*.md") if "results" not in path.parts),
    *sorted(EXAMPLES.rglob("*.md")),
    ROOT / "models" / "README.md",
]
FLAG = re.compile(r"--[a-z][a-z0-9.-]*")
FENCE = re.compile(r"^```(.*?)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LANGUAGES = {"python", "python continued", "sh", "text", "toml", "xml", "mermaid"}
DRAWING = ("cameras", "rotorgram.rendering", "flights.filming")
"""Words of programs that need OpenGL."""
COMPILED = {"c"}  # tests/agents/test_export.py compiles and runs it


class Block(NamedTuple):
    page: str
    language: str
    code: str


def blocks(page: Path) -> list[Block]:
    name = page.relative_to(ROOT).as_posix()
    return [Block(name, *found) for found in FENCE.findall(page.read_text(encoding="utf-8"))]


ALL = [block for page in PAGES for block in blocks(page)]


def programs() -> list[tuple[str, str]]:
    """Page and code of every program: a block with those that continue it."""
    found: list[list[str]] = []
    for block in ALL:
        if block.language == "python":
            found.append([block.page, block.code])
        elif block.language == "python continued":
            assert found[-1][0] == block.page, f"{block.page}: a continuation of nothing"
            found[-1][1] += block.code
    return [(page, code) for page, code in found]


PROGRAMS = programs()
INSTEAD = {
    # page: (what the page says, what is run, why)
    "docs/effects.md": [
        ("tests/data/racer.xml", (ROOT / "tests/data/racer.xml").as_posix(), "seen from a clone"),
    ],
    "docs/scaling.md": [
        ("0.0.0.0", "127.0.0.1", "a test opens no port to the network"),
    ],
}

FLIGHT = """
from threading import Thread
from rotorgram.udp import RemoteEnv, Simulator
env = RemoteEnv(("127.0.0.1", 0), connect=False, record="flight.mcap")
simulator = Simulator(server=env.address, bind=("127.0.0.1", 0), episode_length=10)
thread = Thread(target=simulator.run)
thread.start()
env.reset(seed=0)
for _ in range(10):
    env.step([0.0])
env.close()
thread.join()
simulator.close()
"""


@pytest.fixture(scope="session")
def training(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a short training, for pages that fly a policy."""
    folder = tmp_path_factory.mktemp("training") / "run"
    run(rotorgram("train", "a2c", "--env-steps", "256", "--out", folder), folder.parent)
    return folder


def simulators_for(code: str, port: int, folder: Path) -> list[subprocess.Popen[bytes]]:
    """What the page's text says runs in other terminals."""
    count, drones = (2, 4) if "RemoteVectorEnv" in code else (1, 1)
    flags = ["--num-envs", str(drones), "--server", f"127.0.0.1:{port}", "--bind", "127.0.0.1:0"]
    if "SOCK_DGRAM" in code:
        flags += ["--codec", "text"]
    if "drone.key" in code:
        run(rotorgram("key", "drone.key"), folder)
        flags += ["--key-file", "drone.key"]
    return [subprocess.Popen(rotorgram("sim", *flags), cwd=folder) for _ in range(count)]


@pytest.mark.parametrize(
    ("page", "code"), PROGRAMS, ids=[f"{page}-{i}" for i, (page, _) in enumerate(PROGRAMS)]
)
def test_python_runs_as_pasted(
    page: str,
    code: str,
    training: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
) -> None:
    if "import minari" in code:
        pytest.importorskip("minari")
    if any(word in code for word in DRAWING):
        request.getfixturevalue("opengl")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    for there, here, _ in INSTEAD.get(page, ()):
        code = code.replace(there, here)
    simulators = []
    if "flight.mcap" in code:
        run([sys.executable, "-c", FLIGHT], tmp_path)
    for words in re.findall(r"^# rotorgram (.+)$", code, re.MULTILINE):
        run(rotorgram(*words.split()), tmp_path)
    for script, words in re.findall(r"^# python (examples/\S+) (.+)$", code, re.MULTILINE):
        run([sys.executable, str(ROOT / script), *words.split()], tmp_path)
    if "policy.onnx" in code:
        run(rotorgram("export", training, "--to", "onnx"), tmp_path)
    if "8001" in code:
        port = free_port()
        code = code.replace("8001", str(port))
        simulators = simulators_for(code, port, tmp_path)
    run([sys.executable, "-c", code], tmp_path)
    for simulator in simulators:
        assert simulator.wait(20) == 0
    assert all(path.name in code for path in tmp_path.iterdir()), "files that nobody was told of"


def test_what_is_run_instead_is_on_the_page() -> None:
    for page, changes in INSTEAD.items():
        for there, _, why in changes:
            assert there in (ROOT / page).read_text(encoding="utf-8"), f"{page}: {there}: {why}"


def test_every_fence_says_what_it_is() -> None:
    """So that no block escapes the tests; text is what is shown, mermaid is drawn."""
    for block in ALL:
        drawing = block.page == "models/README.md" and not block.language
        compiled = block.language in COMPILED and block.page == "docs/export.md"
        assert block.language in LANGUAGES or drawing or compiled, f"{block.page}: {block.language}"
    assert len(PROGRAMS) >= 16


FILES = {  # by the name in their first line
    b.code.splitlines()[0].removeprefix("# "): b.code
    for b in ALL
    if b.language == "toml" and re.match(r"# \S+\.toml\n", b.code)
}
STUDIES = [b for b in ALL if b.page == "docs/extending.md" and b.language == "toml"]


@pytest.mark.parametrize("block", STUDIES, ids=range(len(STUDIES)))
def test_rows_of_a_study_are_ones_that_there_are(block: Block, tmp_path: Path) -> None:
    (tmp_path / "rows.toml").write_text(block.code)
    assert Study.from_toml(tmp_path / "rows.toml").rows


# Commands


def parse_command(arguments: list[str]) -> None:
    """By the real parser. Raises `SystemExit` for what it does not know."""
    name, *flags = arguments
    module = import_module(f"rotorgram.cli.{name.replace('-', '_')}")
    kind = getattr(module, name.title().replace("-", ""))
    parse(kind, f"rotorgram {name}", flags)


@cache
def flags_of(*command: str) -> frozenset[str]:
    page = io.StringIO()
    with redirect_stdout(page), pytest.raises(SystemExit):
        parse_command([*command, "--help"])
    return frozenset(FLAG.findall(page.getvalue()))


def commands_of(block: Block) -> list[list[str]]:
    """Each command of a block, as a shell would split it."""
    found: list[list[str]] = []
    for line in block.code.splitlines():
        found.append([])
        for word in shlex.split(line, comments=True):
            found[-1].append(word.removesuffix(";"))
            if word.endswith(";"):
                found.append([])
    return [command for command in found if command]


TYPED = [
    (block.page, command)
    for block in ALL
    if block.language == "sh"
    for command in commands_of(block)
]
OTHERS = {
    # what is not ours, and why nothing of it is tested here
    "apt-get": "the system's",
    "ssh": "the system's",
    "source": "the shell's; `make install` makes the file",
    "export": "the shell's",
    "git": "the system's",
    "mavproxy.py": "a ground station of others; tests/autopilots/test_mavlink_out.py receives",
    "tensorboard": "a dependency's; tests/agents/test_logs.py reads what it reads",
    "gcc": "tests/udp/test_peers.py, tests/agents/test_export.py",
    "./agent": "tests/udp/test_peers.py",
    "mcs": "tests/udp/test_peers.py",
    "mono": "tests/udp/test_peers.py",
}
RUN = {
    # commands that are run too, on the pages that have them, and what makes them short
    "rotorgram key drone.key": [],
    "rotorgram train a2c --num-envs 32 --set steps_per_update=1024 learning_rate=0.02 "
    "--out runs/first": ["--env-steps", "2048"],
    "rotorgram evaluate runs/first": ["--episodes", "1"],
    "rotorgram replay flight.mcap": [],
    "rotorgram replay flight.mcap --verify": [],
}


@pytest.mark.parametrize(
    ("page", "command"), TYPED, ids=[f"{page}-{i}" for i, (page, _) in enumerate(TYPED)]
)
def test_commands_are_ones_that_there_are(
    page: str, command: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)  # where landing.py is
    monkeypatch.chdir(tmp_path)
    for name, content in FILES.items():
        (tmp_path / name).write_text(content)
    program, *arguments = command
    match program:
        case "rotorgram":
            parse_command(arguments)
        case "make":
            assert re.search(rf"^{arguments[0]}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
        case "pip":
            extra = re.fullmatch(r"rotorgram\[(\w+)]", arguments[1])
            project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
            assert extra
            assert extra[1] in project["optional-dependencies"]
        case "python":
            assert (ROOT / arguments[0]).is_file()
        case "ray":
            script = Path(sys.executable).with_name("ray")
            told = run([str(script), arguments[0], "--help"], ROOT)
            assert all(word in told for word in arguments if word.startswith("--"))
        case _:
            assert program in OTHERS, page


def test_short_commands_run(tmp_path: Path) -> None:
    typed = {shlex.join(command) for _, command in TYPED}
    run([sys.executable, "-c", FLIGHT], tmp_path)
    for command, more in RUN.items():
        assert command in typed
        run(rotorgram(*command.split()[1:], *more), tmp_path)


def test_commands_and_flags_in_the_text_are_ones_that_there_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    own = flags_of("sim", "--env", "landing:Landing-v0")
    flags = own.union(*(flags_of(command) for command in COMMANDS))
    for script in ("capture.py", "dataset.py", "identification/identify.py"):
        shown = run([sys.executable, str(EXAMPLES / script), "--help"], ROOT)
        flags |= set(FLAG.findall(shown))
    for page in PAGES:
        name = page.relative_to(ROOT).as_posix()
        for mention in re.findall(r"`([^`\n]+)`", FENCE.sub("", page.read_text(encoding="utf-8"))):
            words = mention.replace("\\|", "|").split()
            used = {word for word in words if re.match(r"--[a-z]", word) and "…" not in word}
            if words[0] == "rotorgram" and words[1:] and words[1] != "COMMAND":
                assert words[1] in COMMANDS, f"{name}: {mention}"
                ours = [word for word in words if re.fullmatch(r"rotorgram/[\w-]+", word)]
                task = ["--env", *ours] if ours else []
                assert used <= flags_of(words[1], *task) | {"--help"}, f"{name}: {mention}"
            elif words[0] in used:
                assert used <= flags, f"{name}: {mention}"

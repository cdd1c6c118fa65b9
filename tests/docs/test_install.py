"""What is installed: layers of packages, the wheel, and how little a command imports."""

import re
import shutil
import subprocess
import sys
import time
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import pytest
from rotorgram.cli import COMMANDS, EXTRAS

ROOT = Path(__file__).parents[2]
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
FOLDERS = sorted({name.split(".")[1] for name in PROJECT["tool"]["setuptools"]["packages"][1:]})
IMPORT_NAMES = {"pillow": "PIL"}

WITHOUT = """
import sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {names!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Missing())
from rotorgram.cli import main
sys.exit(main(sys.argv[1:]))
"""


def run_without(names: set[str], *arguments: object) -> subprocess.CompletedProcess[str]:
    """A command in a process that lacks these packages."""
    return subprocess.run(
        [sys.executable, "-c", WITHOUT.format(names=names), *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=60,
    )


def optional(*extras: str) -> set[str]:
    return {module for extra in extras for module in EXTRAS[extra]}


ALL = optional(*EXTRAS)


def test_the_table_of_extras_is_that_of_pyproject() -> None:
    declared = PROJECT["project"]["optional-dependencies"]
    for extra, modules in EXTRAS.items():
        names = [re.split(r"[>=\[]", line)[0] for line in declared[extra]]
        assert [IMPORT_NAMES.get(n, n.replace("-", "_")) for n in names] == list(modules), extra


@pytest.mark.parametrize(
    ("missing", "arguments", "sentence"),
    [
        ("train", ["train", "a2c"], "pip install 'rotorgram[train]'"),
        ("train", ["compare"], "pip install 'rotorgram[train]'"),
        ("train", ["sweep", "a2c", "--grid", "gamma=0.9"], "pip install 'rotorgram[train]'"),
        ("train", ["evaluate", "checkpoint"], "pip install 'rotorgram[train]'"),
        ("record", ["sim", "--bind", "127.0.0.1:0", "--record", "a.mcap"],
         "pip install 'rotorgram[record]'"),
        ("record", ["replay", "FILE"], "pip install 'rotorgram[record]'"),
        ("dataset", ["dataset", "FILE", "--to", "parquet", "--out", "a"], "'rotorgram[record]'"),
        ("render", ["render", "random", "--out", "a.mp4"], "pip install 'rotorgram[render]'"),
        ("report", ["compare", "--seeds", "1"], "pip install 'rotorgram[report]'"),
        ("ray", ["compare", "--runner", "ray"], "pip install 'rotorgram[ray]'"),
    ],
)  # fmt: skip
def test_a_missing_package_is_one_sentence(
    missing: str,
    arguments: list[str],
    sentence: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "file"
    checkpoint = tmp_path / "checkpoint"
    file.touch()
    checkpoint.touch()
    words = [str(file) if word == "FILE" else word for word in arguments]
    done = run_without(optional(missing), *words)
    assert done.returncode == 1, done.stderr
    assert sentence in done.stderr
    assert done.stderr.count("\n") == 1
    assert {path.name for path in tmp_path.iterdir()} <= {"file", "checkpoint", "runs"}
    assert not list(tmp_path.glob("runs/*")), "nothing is left of a run that could not begin"


def test_the_base_alone_flies(tmp_path: Path) -> None:
    """What the base installs: a simulator and the PID meet; a key, a model's checks."""
    assert run_without(ALL, "key", tmp_path / "key").returncode == 0
    assert run_without(ALL, "vehicle", "check", "paper").returncode == 0
    serve = ["serve", "pid", "--episodes", "1", "--listen", "127.0.0.1:0"]
    with subprocess.Popen(
        [sys.executable, "-c", WITHOUT.format(names=ALL), *serve], stdout=subprocess.PIPE, text=True
    ) as agent:
        try:
            assert agent.stdout is not None
            server = re.search(r"at (\S+) \(", agent.stdout.readline())[1]  # type: ignore[index]
            done = run_without(ALL, "sim", "--server", server, "--bind", "127.0.0.1:0")
            assert done.returncode == 0, done.stderr
            out, _ = agent.communicate(timeout=30)
        finally:
            agent.kill()
    assert "episode 0: return" in out


def imported(*arguments: str) -> set[str]:
    """Top-level packages that a command has imported when it ends."""
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "rotorgram.cli", *arguments],
        capture_output=True,
        text=True,
        timeout=60,
    )
    names = (line.rpartition("|")[2].strip() for line in done.stderr.splitlines())
    return {name.partition(".")[0] for name in names}


@pytest.mark.parametrize("command", COMMANDS)
def test_flags_are_checked_before_anything_heavy_is_imported(command: str) -> None:
    heavy = {"mujoco", "torch", "pandas", "matplotlib", "stable_baselines3", "ray", "scipy"}
    assert not imported(command, "--wrong-flag") & heavy
    if command in ("key", "replay", "report", "bench"):
        assert not imported(command, "--wrong-flag") & {"gymnasium"}


@pytest.mark.quiet
@pytest.mark.parametrize(
    "arguments",
    [["--help"], ["--version"], ["sim", "--help"], ["train", "--help"], ["sim", "--wrong-flag"],
     ["sim", "--bind", "127.0.0.1:0", "--timeout", "0.01"]],
    ids=" ".join,
)  # fmt: skip
def test_a_command_starts_in_time(arguments: list[str]) -> None:
    def seconds(*command: str) -> float:
        begin = time.perf_counter()
        subprocess.run([sys.executable, *command], capture_output=True)
        return time.perf_counter() - begin

    taken = min(seconds("-m", "rotorgram.cli", *arguments) for _ in range(5))
    # 0.6 s is promised for a machine on which the libraries of `sim` take 0.46 s by themselves.
    libraries = min(seconds("-c", "import gymnasium, mujoco, tyro") for _ in range(5))
    assert taken < max(0.6, 0.6 / 0.46 * libraries)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from a copy: setuptools leaves folders beside what it builds."""
    pytest.importorskip("setuptools")
    source = tmp_path_factory.mktemp("source")
    out = tmp_path_factory.mktemp("wheel")
    for folder in ("rotorgram", *FOLDERS):
        shutil.copytree(
            ROOT / folder, source / folder, ignore=shutil.ignore_patterns("__pycache__")
        )
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    build = "import sys; from setuptools.build_meta import build_wheel; build_wheel(sys.argv[1])"
    subprocess.run([sys.executable, "-c", build, out], cwd=source, check=True, capture_output=True)
    (path,) = out.glob("*.whl")
    return path


def test_the_wheel_has_every_file(wheel: Path) -> None:
    expected = {
        f"rotorgram/{path.relative_to(ROOT)}"
        for folder in FOLDERS
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    expected |= {"rotorgram/__init__.py", "rotorgram/__main__.py"}
    packed = set(zipfile.ZipFile(wheel).namelist())
    assert {name for name in packed if not name.startswith("rotorgram-")} == expected

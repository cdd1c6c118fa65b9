"""docs/architecture.md is true: who imports whom, what is where, and what is public."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
# Each imports from those before it alone.
PACKAGES = (
    "models",
    "scenes",
    "sim",
    "rendering",
    "envs",
    "udp",
    "agents",
    "flights",
    "training",
    "autopilots",
    "cli",
)


def imports(path: Path) -> Iterator[tuple[str, bool]]:
    """Modules that a file of the repository imports, and whether it does so when it is loaded.

    Those of rotorgram begin with its name. Imports for types alone count as later ones.
    """
    package = ["rotorgram", *path.relative_to(ROOT).parts[:-1]]
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        at_once = node in tree.body
        if isinstance(node, ast.Import):
            yield from ((alias.name, at_once) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            if node.module:
                yield ".".join([*base, node.module]), at_once
            else:
                yield from ((".".join([*base, alias.name]), at_once) for alias in node.names)


def imported(where: str) -> set[str]:
    """What the files of a folder, or a file, import."""
    path = ROOT / where
    files = sorted(path.rglob("*.py")) if path.is_dir() else [path]
    assert files
    return {name for file in files for name, _ in imports(file)}


def packages(names: set[str]) -> set[str]:
    """Packages of rotorgram among modules."""
    inner = {name.split(".")[1] for name in names if name.startswith("rotorgram.")}
    return inner & set(PACKAGES)  # the package itself has import_when_used


def others(names: set[str]) -> set[str]:
    """Packages that are neither ours nor the standard library's, among modules."""
    tops = {name.partition(".")[0] for name in names}
    return tops - {"rotorgram"} - set(sys.stdlib_module_names)


def table(heading: str) -> dict[str, list[str]]:
    """First column to the words in code of the second, of the table whose first heading is that."""
    rows = PAGE.split(f"| {heading}\n|---|---|\n")[1].split("\n\n")[0]
    cells = (row.strip("|").split("|") for row in rows.splitlines())
    return {first.strip(" `"): re.findall("`([^`]+)`", second) for first, second in cells}


@pytest.mark.parametrize("package", PACKAGES)
def test_who_imports_whom(package: str) -> None:
    listed = set(table("package | imports from |")[package])
    assert packages(imported(package)) - {package} == listed
    earlier = set(PACKAGES[: PACKAGES.index(package)])
    assert listed <= earlier


@pytest.mark.parametrize("where", ["udp/protocol", "envs/spec.py"])
def test_what_crosses_the_wire_needs_numpy_alone(where: str) -> None:
    names = imported(where)
    inside = "rotorgram." + where.replace("/", ".").removesuffix(".py")
    ours = {name for name in names if name.startswith("rotorgram") and inside not in name}
    light = {f"rotorgram.models.{name}" for name in ("errors", "fields", "files", "frames")}
    light.add("rotorgram.scenes")
    assert {"rotorgram.models.errors"} <= ours <= light
    assert others(names) == {"numpy"}


def test_a_task_knows_the_world_and_the_spec() -> None:
    names = imported("envs/tasks")
    ours = {name for name in names if name.startswith("rotorgram.")}
    assert packages(names) == {"envs", "models", "scenes", "sim"}
    assert {name for name in ours if ".envs." in name} == {
        "rotorgram.envs.config",
        "rotorgram.envs.memory",
        "rotorgram.envs.state",
        "rotorgram.envs.spec",
        "rotorgram.envs.tasks.goal",
        "rotorgram.envs.tasks.measures",
        "rotorgram.envs.tasks.swarm",
        "rotorgram.envs.tasks.task",
    }
    assert {name for name in ours if ".sim" in name} == {"rotorgram.sim"}
    assert others(names) == {"numpy"}
    assert "gymnasium" not in others(imported("sim"))


def test_no_env_loads_what_draws() -> None:
    for path in (ROOT / "envs").rglob("*.py"):
        at_once = {name for name, loaded in imports(path) if loaded}
        assert "rendering" not in packages(at_once) - {"envs"}, path


def test_an_agent_loads_neither_mujoco_nor_torch() -> None:
    program = (
        "import sys; from rotorgram.agents import *; from rotorgram.udp import RemoteVectorEnv; "
        "print(sorted({'mujoco', 'torch', 'pandas', 'matplotlib'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout == "[]\n"
    assert done.stderr == ""


def test_a_wrong_flag_of_train_loads_nothing_that_trains_or_flies() -> None:
    program = (
        "import sys; from rotorgram.cli import main\n"
        "try: main(['train', 'ppo', '--wrong-flag'])\n"
        "except SystemExit as end: print(end.code)\n"
        "print(sorted(name for name in ('mujoco', 'rotorgram.agents.learner', 'rotorgram.udp', "
        "'rotorgram.training', 'rotorgram.sim.sensors') if name in sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout == "2\n[]\n"


@pytest.mark.parametrize("package", PACKAGES)
def test_every_folder_is_on_the_page(package: str) -> None:
    text = PAGE.split("## What is where")[1].split("\n## ")[0]
    for path in (ROOT / package).rglob("__init__.py"):
        folder = path.parent.relative_to(ROOT).as_posix()
        assert f"`{folder}/`" in text, folder


def test_files_that_the_page_names_are_there() -> None:
    """Those with a folder from the root on; a bare name is looked for everywhere."""
    text = PAGE.replace("docs/PAGE.md", "")
    named = re.findall(r"`((?:[\w.-]+/)*[\w-]+\.(?:py|md|toml|xml))`", text)
    assert len(named) > 15
    for name in named:
        assert (ROOT / name).exists() if "/" in name else any(ROOT.rglob(name)), name

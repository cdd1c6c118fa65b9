"""Gathers the pages of the site in build/docs; `make docs` calls it, then Zensical.

The pages are written for the repository: their links lead to files as they lie there, beyond docs/
too. A site has one folder of pages. So what belongs to it from elsewhere (`ELSEWHERE`, and the
scripts in examples/) gets a place in it, and every link is rewritten to the places. A link to
anything that the site has not is an error. build/api shows mkdocstrings the packages under their
names, as .venv/types does mypy.
"""

import os
import re
import shutil
import tomllib
from pathlib import Path, PurePosixPath

__all__ = ["main"]

ROOT = Path(__file__).parent.parent
PAGES = ROOT / "build" / "docs"
API = ROOT / "build" / "api" / "rotorgram"
ELSEWHERE = {
    "models/README.md": "vehicle.md",
    "scenes/README.md": "scenes.md",
    "examples/README.md": "examples/index.md",
    "examples/peers/README.md": "examples/peers.md",
}
FENCED = re.compile(r"^(```.*?^```$)", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\((?!https?:|#)([^)#\s]+)(#[^)\s]*)?\)")


def main() -> None:
    """Write all pages, pictures and scripts of the site, and the links to the packages."""
    shutil.rmtree(PAGES, ignore_errors=True)
    shutil.rmtree(API.parent, ignore_errors=True)
    places = _places()
    for source, place in places.items():
        target = PAGES / place
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.endswith(".md"):
            target.write_text(_page(source, places), encoding="utf-8")
        elif place.endswith(".md"):
            target.write_text(_listing(source), encoding="utf-8")
        else:
            shutil.copyfile(ROOT / source, target)
    API.mkdir(parents=True)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    for name, folder in project["tool"]["setuptools"]["package-dir"].items():
        _, _, subpackage = name.partition(".")
        if subpackage:
            (API / subpackage).symlink_to(ROOT / folder, target_is_directory=True)
    (API / "__init__.py").symlink_to(ROOT / "rotorgram" / "__init__.py")


def _places() -> dict[str, str]:
    """Path in the repository to path on the site, of everything that the site has."""
    places = dict(ELSEWHERE)
    for path in sorted((ROOT / "docs").rglob("*")):
        name = path.relative_to(ROOT / "docs").as_posix()
        written_by_a_command = name.startswith("results/") and name.endswith(".md")
        if path.is_file() and path.suffix not in (".py", ".pyc") and not written_by_a_command:
            places[f"docs/{name}"] = name
    for path in sorted((ROOT / "models" / "vehicles").glob("*/*")):
        place = f"vehicles/{path.parent.name}/{path.name.replace('README', 'index')}"
        places[path.relative_to(ROOT).as_posix()] = place
    for path in sorted((ROOT / "examples").rglob("*.py")):
        name = path.relative_to(ROOT).as_posix()
        places[name] = f"{name.removesuffix('.py')}.md"
    del places["docs/assets/mermaid/README.md"]
    return places


def _page(source: str, places: dict[str, str]) -> str:
    """A page with its links as they are on the site, and its diagrams drawn without a CDN."""
    text = (ROOT / source).read_text(encoding="utf-8")
    parts = FENCED.split(text)
    for i in range(0, len(parts), 2):
        parts[i] = LINK.sub(lambda match: _link(match, source, places), parts[i])
    text = "".join(parts).replace("```python continued\n", "```python\n")
    if "```mermaid\n" in text:
        script = _relative("assets/mermaid/mermaid.tiny.js", places[source])
        text += f'\n<script src="{script}"></script>\n'
    return text


def _link(match: re.Match[str], source: str, places: dict[str, str]) -> str:
    target = os.path.normpath(PurePosixPath(source).parent / match[1]).replace(os.sep, "/")
    for path in (target, f"{target}/README.md"):
        if path in places:
            return f"]({_relative(places[path], places[source])}{match[2] or ''})"
    raise ValueError(f"{source}: expected a link to what the site has, got {match[1]}")


def _relative(place: str, page: str) -> str:
    """The way from a page to another place. A browser goes it too: PAGE.md becomes PAGE.html."""
    return os.path.relpath(place, PurePosixPath(page).parent).replace(os.sep, "/")


def _listing(source: str) -> str:
    """A script as a page."""
    code = (ROOT / source).read_text(encoding="utf-8")
    return f"# {PurePosixPath(source).name}\n\n```python\n{code}```\n"


if __name__ == "__main__":
    main()

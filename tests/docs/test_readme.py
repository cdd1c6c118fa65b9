"""The README and the pages lead somewhere, in the repository and on the site."""

import re
import runpy
import tomllib
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "examples").rglob("*.md")),
    ROOT / "models" / "README.md",
]
LINK = re.compile(r"\]\((?!https?:|#)([^)#]+)")


def site() -> dict[str, Any]:
    config = tomllib.loads((ROOT / "zensical.toml").read_text(encoding="utf-8"))
    project: dict[str, Any] = config["project"]
    return project


def pages_of(nav: list[dict[str, Any]]) -> list[str]:
    found = []
    for entry in nav:
        for target in entry.values():
            found += [target] if isinstance(target, str) else pages_of(target)
    return found


@pytest.fixture
def stage() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "docs" / "stage.py"))


def test_links_lead_somewhere() -> None:
    for page in PAGES:
        for target in LINK.findall(page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_the_pages_of_the_api_name_modules_that_there_are() -> None:
    for page in (ROOT / "docs" / "api").glob("*.md"):
        for module in re.findall(r"^::: (\S+)", page.read_text(encoding="utf-8"), re.MULTILINE):
            assert find_spec(module), module


def test_the_navigation_has_every_page_once(stage: dict[str, Any]) -> None:
    """Zensical fails on a link that leads nowhere, but not on such an entry or a page without."""
    listed = pages_of(site()["nav"])
    scripts = {place for source, place in stage["_places"]().items() if source.endswith(".py")}
    pages = {place for place in stage["_places"]().values() if place.endswith(".md")}
    vehicles = {page for page in pages if page.startswith("vehicles/")}  # the library links to them
    library = (ROOT / "docs" / "library.md").read_text(encoding="utf-8")
    assert all(f"/{page.split('/')[1]}/README.md)" in library for page in vehicles)
    assert sorted(listed) == sorted(pages - scripts - vehicles)


def test_the_page_of_observations_is_that_of_the_specs() -> None:
    script = runpy.run_path(str(ROOT / "docs" / "observations.py"))
    written = (ROOT / "docs" / "observations.md").read_text(encoding="utf-8")
    assert script["page"]() == written


def test_the_readme_lists_what_the_navigation_has(stage: dict[str, Any]) -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8").split("## Where to go next")[1]
    places = stage["_places"]()
    reference = [page for page in pages_of(site()["nav"]) if page.startswith("api/")]
    linked = [places[target] for target in LINK.findall(text) if target in places]
    assert ["index.md", *linked, *reference] == pages_of(site()["nav"])


def test_links_of_the_site_lead_to_its_places(stage: dict[str, Any]) -> None:
    places = {"docs/a/page.md": "a/page.md", "docs/b.md": "b.md", "models/README.md": "vehicle.md"}

    def staged(target: str) -> str:
        match = stage["LINK"].search(f"[there]({target})")
        link: str = stage["_link"](match, "docs/a/page.md", places)
        return link

    assert staged("../b.md#part") == "](../b.md#part)"
    assert staged("../../models/README.md") == "](../vehicle.md)"
    assert staged("../../models/") == "](../vehicle.md)"
    with pytest.raises(ValueError, match=r"docs/a/page\.md: .* got \.\./\.\./tests/links\.py"):
        staged("../../tests/links.py")


def test_code_is_not_rewritten(stage: dict[str, Any]) -> None:
    """What looks like a link inside a block is code."""
    parts = stage["FENCED"].split("[a](b)\n```python\nf[a](b)\n```\n[c](d)\n")
    assert parts == ["[a](b)\n", "```python\nf[a](b)\n```", "\n[c](d)\n"]

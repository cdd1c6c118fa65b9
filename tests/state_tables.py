"""Writes the tables of states into docs/protocol.md, from the code: python tests/state_tables.py"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from rotorgram.udp.protocol.transitions import AGENT, SIMULATOR

PAGE: Final = Path(__file__).parent.parent / "docs" / "protocol.md"
HEAD: Final = "| state | sent or received | message | next state |\n|---|---|---|---|\n"
HEADINGS: Final = {"### Simulator\n": SIMULATOR, "### Agent, for each simulator\n": AGENT}


def rows(table: Mapping[Any, Any]) -> str:
    return HEAD + "".join(
        f"| {state} | {way} | {message.__name__} | {after} |\n"
        for state, ways in table.items()
        for (way, message), after in ways.items()
    )


def page() -> str:
    """The text of the page with the tables of the code."""
    text = PAGE.read_text("utf-8")
    for heading, table in HEADINGS.items():
        before, after = text.split(heading)
        start = after.index(HEAD)
        end = after.index("\n\n", start) + 1
        text = before + heading + after[:start] + rows(table) + after[end:]
    return text


if __name__ == "__main__":
    PAGE.write_text(page(), "utf-8")

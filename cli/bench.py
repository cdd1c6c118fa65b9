"""`rotorgram bench`: env steps per second on this machine."""

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from rich import box
from rich.table import Table

from ._flags import Command, folder_to_write


@dataclass(frozen=True, kw_only=True)
class Bench(Command):
    """Measure env steps per second on this machine, from raw physics to a simulator over UDP."""

    rounds: int = 7
    """Turns of every layer, besides one to warm up; medians count."""
    seconds: float = 0.5
    """Length of a turn."""
    out: Path | None = None
    """Folder to write to. Default: runs/bench-TIME."""

    def run(self) -> int:
        """Measure and print."""
        from rich.console import Console

        from ..training.bench import RATIOS, bench
        from ._progress import bars

        logging.getLogger("rotorgram").setLevel(logging.WARNING)  # no counters of every wire
        with folder_to_write(self.out, "bench") as folder, bars() as progress:

            def on_layer(name: str, turn: int, turns: int) -> None:
                progress("bench", turn, turns, name)

            layers = bench(self.rounds, self.seconds, folder, on_layer)
            progress("bench", 1, 1, "done")
        show = Console().print
        show(_table("layer", "what", "env steps/s", "µs per env step", rows=[
            (one.name, one.about, f"{one.rate:,.0f}", f"{1e6 / one.rate:.2f}") for one in layers
        ]))  # fmt: skip
        values = [(ratio, ratio.value(layers)) for ratio in RATIOS]
        show(_table("ratio", "median", "target", rows=[
            (ratio.name, f"{'' if ratio.reached(value) else '[red]'}{value:.2f}", ratio.target_text)
            for ratio, value in values
        ]))  # fmt: skip
        print(f"written: {folder / 'bench.json'}")
        return 0


def _table(*headings: str, rows: Iterable[tuple[str, ...]]) -> Table:
    """A table of words, then numbers: only layers have a second column of words."""
    table = Table(box=box.SIMPLE_HEAD)
    for place, heading in enumerate(headings):
        table.add_column(heading, justify="left" if place == 0 or heading == "what" else "right")
    for row in rows:
        table.add_row(*row)
    return table

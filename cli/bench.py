"""`rotorgram bench`: the speed of each layer of a training on this machine."""

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rich import box
from rich.table import Table

from ..models.errors import require
from ._flags import Command
from ._inputs import folder_to_write

if TYPE_CHECKING:
    from ..experiments.bench import Layer

__all__ = ["Bench"]


@dataclass(frozen=True, kw_only=True)
class Bench(Command):
    """Measure the layers of a training on this machine, from raw physics to an update."""

    rounds: int = 7
    """Turns of every layer, besides one to warm up; medians count."""
    seconds: float = 0.5
    """Length of a turn."""
    out: Path | None = None
    """Folder to write to. Default: runs/bench-TIME."""

    def run(self) -> int:
        """Measure, print and draw."""
        from rich.console import Console

        from ..experiments.bench import BenchConfig, bench
        from ._progress import bars

        require("matplotlib", "report", "drawing")  # before anything is measured
        config = BenchConfig(rounds=self.rounds, seconds=self.seconds)
        logging.getLogger("rotorgram").setLevel(logging.WARNING)  # no counters of every wire
        with folder_to_write(self.out, "bench") as folder, bars() as progress:
            layers = bench(config, folder, lambda name, at, of: progress("bench", at, of, name))
            turns = (config.rounds + 1) * len(layers)
            progress("bench", turns, turns, "done")
        console = Console()
        console.print(_rates(layers))
        console.print(_parts(layers))
        console.print(_ratios(layers))
        _draw(layers, folder / "bench.png")
        print(f"written: {folder / 'bench.json'}, {folder / 'bench.png'}")
        return 0


def _rates(layers: "list[Layer]") -> Table:
    table = Table("layer", "what", box=box.SIMPLE_HEAD)
    for name in ("env steps/s", "µs per env step"):
        table.add_column(name, justify="right")
    for layer in layers:
        table.add_row(layer.name, layer.about, f"{layer.rate:,.0f}", f"{1e6 / layer.rate:.2f}")
    return table


def _ratios(layers: "list[Layer]") -> Table:
    from ..experiments.bench import RATIOS

    table = Table("ratio", box=box.SIMPLE_HEAD)
    for name in ("median", "target"):
        table.add_column(name, justify="right")
    for ratio in RATIOS:
        value = ratio.value(layers)
        mark = "" if ratio.reached(value) else "[red]"
        table.add_row(ratio.name, f"{mark}{value:.2f}", ratio.target_text)
    return table


def _parts(layers: "list[Layer]") -> Table:
    from ..experiments.bench import parts_of

    table = Table("part of a lock-step step of one drone", box=box.SIMPLE_HEAD)
    table.add_column("µs", justify="right")
    for name, seconds in parts_of(layers):
        table.add_row(name, f"{1e6 * seconds:.1f}")
    return table


def _draw(layers: "list[Layer]", path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 0.28 * len(layers) + 1), layout="constrained")
    axes = figure.subplots()
    shown = layers[::-1]
    axes.barh([layer.name for layer in shown], [layer.rate for layer in shown], color="#2b6cb0")
    for place, layer in enumerate(shown):
        axes.text(layer.rate, place, f" {layer.rate:,.0f}", va="center", fontsize=8)
    axes.set(xscale="log", xlabel="env steps per second")
    axes.margins(x=0.12)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=150)

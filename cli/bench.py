"""`rotorgram bench`: measure the layers, print a table, draw a plot."""

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from matplotlib.figure import Figure
from rich import box
from rich.console import Console
from rich.table import Table

from ..experiments.bench import RATIOS, BenchConfig, Layer, ratio_of
from ..experiments.bench import bench as measure
from .inputs import new_folder
from .progress import bars

if TYPE_CHECKING:
    from .measuring import Bench

__all__ = ["bench"]


def bench(command: "Bench") -> int:
    """Measure, print and draw."""
    config = BenchConfig(rounds=command.rounds, seconds=command.seconds)
    logging.getLogger("rotorgram").setLevel(logging.WARNING)  # no reports of every wire each minute
    folder = new_folder(command.out, "bench")
    with bars() as progress:
        layers = measure(config, folder, lambda name, at, of: progress("bench", at, of, name))
        turns = (config.rounds + 1) * len(layers)
        progress("bench", turns, turns, "done")
    console = Console()
    console.print(_rates(layers))
    console.print(_ratios(layers))
    _draw(layers, folder / "bench.png")
    print(f"written: {folder / 'bench.json'}, {folder / 'bench.png'}")
    return 0


def _rates(layers: list[Layer]) -> Table:
    table = Table(box=box.SIMPLE_HEAD)
    for name, where in (("layer", "left"), ("what", "left"), ("env steps/s", "right"),
                        ("µs per env step", "right")):  # fmt: skip
        table.add_column(name, justify=where)  # type: ignore[arg-type]
    for layer in layers:
        table.add_row(layer.name, layer.about, f"{layer.rate:,.0f}", f"{1e6 / layer.rate:.2f}")
    return table


def _ratios(layers: list[Layer]) -> Table:
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column("ratio of rates")
    table.add_column("median", justify="right")
    for numerator, denominator in RATIOS:
        ratio = ratio_of(layers, numerator, denominator)
        table.add_row(f"{numerator} ÷ {denominator}", f"{ratio:.2f}")
    return table


def _draw(layers: list[Layer], path: Path) -> None:
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

"""`rotorgram bench`: env steps per second on this machine."""

import logging
from pathlib import Path

from ._flags import Command


class Bench(Command):
    """Measure env steps per second on this machine, from raw physics to a simulator over UDP."""

    rounds: int = 7
    """Turns of every layer, besides one to warm up; medians count."""
    seconds: float = 0.5
    """Length of a turn."""
    out: Path | None = None
    """Folder to write to. Default: runs/bench-TIME."""

    def run(self) -> None:
        """Measure and print."""
        from rich.box import SIMPLE_HEAD
        from rich.console import Console
        from rich.table import Table

        from ..training.bench import HOVER, LAYERS, bench
        from ._progress import bars
        from ._training import folder_to_write

        logging.getLogger("rotorgram").setLevel(logging.WARNING)  # no counters of every wire
        with folder_to_write(self.out, "bench") as folder, bars() as progress:
            measured = bench(LAYERS, self.rounds, self.seconds, folder, progress)
            progress("bench", 1, 1, "done")
        rates = Table("layer", "what", "env steps/s", "µs per env step", box=SIMPLE_HEAD)
        for layer in LAYERS:
            rate = measured.medians[layer.name]
            rates.add_row(layer.name, layer.about, f"{rate:,.0f}", f"{1e6 / rate:.2f}")
        Console().print(rates)
        if seconds := measured.policy_seconds:
            print(f"rotorgram train ppo --env {HOVER}: {seconds:.2f} s of one core")
        print(f"written: {folder / 'bench.json'}")

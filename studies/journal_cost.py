"""What a journal costs: lock-step rates with one on no side, either side and both.

    python studies/journal_cost.py [--rounds 80] [--seconds 0.25] [--out FILE.json]

Four pairs of an agent (here) and a simulator (a process each) are open at the same time; one drone,
binary codec, loopback. They take turns to fly for a moment, in an order that changes from round to
round. Within a round each rate is compared to that without a journal; the medians of these ratios
count, so that a machine that slows down for a while slows all alike.

Beside it, less disturbed by others: the processor time of a step on the side that writes, against
that of the same side without a journal, and the journal alone, chunks and writing included.

It takes about two minutes on two cores.
"""

import statistics
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from measuring import RESULTS, in_turns, medians, options, table, write
from rotorgram.envs.config import EnvConfig
from rotorgram.udp import RemoteEnv
from rotorgram.udp.journal import Journal, Recording, Summary
from rotorgram.udp.protocol.messages import Command, Hello, State
from rotorgram.udp.spawn import start_simulator

SIDES: dict[str, tuple[str, ...]] = {
    "none": (),
    "simulator": ("simulator",),
    "agent": ("agent",),
    "both": ("simulator", "agent"),
}


COLUMNS = ("ratio", "quartiles", "microseconds", "processor_microseconds")


class Slice(NamedTuple):
    """A moment of a flight."""

    rate: float
    """Steps per second."""
    agent: float
    """Processor time of the agent, µs per step."""
    simulator: float
    """That of the simulator; 0 where the system does not tell."""


class Flight:
    """A pair that flies for a moment at a time."""

    def __init__(self, env: RemoteEnv, simulator: int) -> None:
        self.env = env
        self.simulator = simulator
        self.actions = np.random.default_rng(0).uniform(-0.1, 0.1, (4096, 1)).astype(np.float32)
        self.steps = 0
        env.reset(seed=0)

    def fly(self, seconds: float) -> Slice:
        start = time.perf_counter()
        before = self.steps
        here = time.process_time()
        there = processor_time(self.simulator)
        while time.perf_counter() - start < seconds:
            _, _, terminated, truncated, _ = self.env.step(self.actions[self.steps % 4096])
            self.steps += 1
            if terminated or truncated:
                self.env.reset()
        here, there = time.process_time() - here, processor_time(self.simulator) - there
        count = self.steps - before
        rate = count / (time.perf_counter() - start)
        return Slice(round(rate, 1), round(1e6 * here / count, 2), round(1e6 * there / count, 2))


def processor_time(process: int) -> float:
    """Of another process, s."""
    path = Path(f"/proc/{process}/schedstat")
    return int(path.read_text().split()[0]) / 1e9 if path.exists() else 0.0


@contextmanager
def flight(name: str, folder: Path) -> Iterator[Flight]:
    record = folder / f"{name}-agent.mcap" if "agent" in SIDES[name] else None
    with RemoteEnv(("127.0.0.1", 0), connect=False, record=record) as env:
        settings = {}
        if "simulator" in SIDES[name]:
            settings["record"] = str(folder / f"{name}-simulator.mcap")
        with start_simulator(EnvConfig(), env.address, **settings) as process:
            yield Flight(env, process.pid)
            env.close()
            process.wait()


def measure(rounds: int, seconds: float, folder: Path) -> dict[str, list[Slice]]:
    with ExitStack() as stack:
        flights = {name: stack.enter_context(flight(name, folder)) for name in SIDES}
        for one in flights.values():
            one.fly(seconds)
        return in_turns(flights, rounds, lambda one: one.fly(seconds))


def compare(name: str, slices: dict[str, list[Slice]]) -> dict[str, object]:
    """Ratios of rates, and times per step more, of the same rounds."""
    pairs = list(zip(slices[name], slices["none"], strict=True))
    ratios = [a.rate / b.rate for a, b in pairs]
    low, _, high = statistics.quantiles(ratios, n=4)
    more = {side: [getattr(a, side) - getattr(b, side) for a, b in pairs] for side in SIDES[name]}
    return {
        "ratio": round(statistics.median(ratios), 4),
        "quartiles": [round(low, 4), round(high, 4)],
        "microseconds": round(statistics.median(1e6 / a.rate - 1e6 / b.rate for a, b in pairs), 2),
        "processor_microseconds": {
            side: round(statistics.median(numbers), 2) for side, numbers in more.items()
        },
    }


def journal_alone(source: Path, target: Path, repeats: int = 9) -> float:
    """Shortest time of a State and its Command in the journal, µs."""
    items = list(Recording(source))
    hello = next(item for item in items if isinstance(item.message, Hello))
    flown = [(i.message, i.datagram) for i in items if isinstance(i.message, State | Command)]
    flown = flown[:40_000]
    times = []
    for number in range(repeats):
        journal = Journal(target / f"{number}.mcap", side="agent")
        journal.tap(0, hello.message, hello.datagram)
        start = time.perf_counter()
        for message, datagram in flown:
            journal.tap(0, message, datagram)
        times.append(time.perf_counter() - start)
        journal.close()
    return 1e6 * min(times) / (len(flown) / 2)


def main() -> None:
    out = RESULTS / "reliability" / "journal.json"
    args = options(__doc__, rounds=80, seconds=0.25, out=out).parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        slices = measure(args.rounds, args.seconds, folder)
        files = {side: folder / f"both-{side}.mcap" for side in ("agent", "simulator")}
        states = {side: Summary(file).sessions[0].states for side, file in files.items()}
        sizes = {side: round(files[side].stat().st_size / states[side], 1) for side in files}
        alone = journal_alone(files["agent"], folder)
    rates = {name: [one.rate for one in many] for name, many in slices.items()}
    result = {
        "rounds": args.rounds,
        "seconds": args.seconds,
        "steps_per_second": medians(rates),
        "journal_on": {name: compare(name, slices) for name in list(SIDES)[1:]},
        "journal_alone_microseconds": round(alone, 2),
        "bytes_per_step": sizes,
        "rates": rates,
    }
    write(args.out, result)
    print(f"without a journal: {statistics.median(rates['none']):,.0f} steps/s (median)")
    rows = [
        [name, *(str(numbers[key]) for key in COLUMNS)]
        for name, numbers in result["journal_on"].items()
    ]
    print(table(("journal on", *COLUMNS), rows))
    print(f"the journal alone: {alone:.2f} µs per step")
    print(f"bytes per step: {sizes}")


if __name__ == "__main__":
    main()

"""What the scripts beside it share: options, measurements in turns, and the file of the result."""

import argparse
import csv
import json
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final, TypeVar, get_type_hints

RESULTS: Final = Path("docs/results")
RELAY: Final = Path(__file__).parents[1] / "tests" / "relay.py"
Name = TypeVar("Name")
Way = TypeVar("Way")
Value = TypeVar("Value")


def options(doc: str, *needed: str, **defaults: object) -> argparse.ArgumentParser:
    """A parser with an option for each name; `doc` is the script's.

    An option takes what its default is, a sequence one value or more. A type stands for an option
    without a default, which may be needed, and False for a switch.
    """
    parser = argparse.ArgumentParser(description=doc.splitlines()[0])
    for name, default in defaults.items():
        flag = f"--{name.replace('_', '-')}"
        if default is False:
            parser.add_argument(flag, action="store_true")
        elif isinstance(default, type):
            parser.add_argument(flag, type=default, required=name in needed)
        elif isinstance(default, list | tuple | range):
            parser.add_argument(flag, type=type(default[0]), nargs="+", default=default)
        else:
            kind = Path if isinstance(default, Path) else type(default)
            parser.add_argument(flag, type=kind, default=default)
    return parser


def launch(code: str, settings: object, *before: str) -> subprocess.Popen[str]:
    """Run code in a process of its own, with its settings as JSON in `sys.argv[1]`.

    `before` are the words of a command that runs it.
    """
    words = [*before, sys.executable, "-c", code, json.dumps(settings)]
    pipe = subprocess.PIPE
    return subprocess.Popen(words, stdin=pipe, stdout=pipe, text=True)


@contextmanager
def relay(
    servers: Sequence[tuple[str, int]], faults: Mapping[str, float]
) -> Iterator[tuple[list[tuple[str, int]], list[dict[str, int]]]]:
    """A relay before each server, in one process: (their addresses, afterwards their counts)."""
    counts: list[dict[str, int]] = []
    with launch(RELAY.read_text(), [servers, faults]) as process:
        yield [tuple(address) for address in json.loads(process.stdout.readline())], counts
        process.stdin.close()
        counts += json.loads(process.stdout.readline())


def free_ports(count: int) -> list[int]:
    """UDP ports of this machine that are free now."""
    with ExitStack() as opened:
        kind = socket.AF_INET, socket.SOCK_DGRAM
        socks = [opened.enter_context(socket.socket(*kind)) for _ in range(count)]
        for sock in socks:
            sock.bind(("127.0.0.1", 0))
        return [sock.getsockname()[1] for sock in socks]


def in_turns(
    ways: Mapping[Name, Way], rounds: int, measure: Callable[[Way], Value]
) -> dict[Name, list[Value]]:
    """Measure each way once a round: a machine that slows down slows all of them."""
    measured: dict[Name, list[Value]] = {name: [] for name in ways}
    for _ in range(rounds):
        for name, way in ways.items():
            measured[name].append(measure(way))
    return measured


def timed(step: Callable[[], object], seconds: float) -> tuple[float, float]:
    """Mean wall time and processor time of a step, s, over three steps or more of `seconds`."""
    count = 0
    began = time.perf_counter()
    used = time.process_time()
    while count < 3 or time.perf_counter() - began < seconds:
        step()
        count += 1
    return (time.perf_counter() - began) / count, (time.process_time() - used) / count


def seconds_of(
    steps: Mapping[Name, Callable[[], object]], rounds: int, seconds: float
) -> dict[Name, float]:
    """Median wall time of each step, s, of rounds of so many seconds in turns."""
    return medians(in_turns(steps, rounds, lambda step: timed(step, seconds)[0]))


def medians(measured: Mapping[Name, list[float]]) -> dict[Name, float]:
    """Median of what was measured of each way."""
    return {name: statistics.median(values) for name, values in measured.items()}


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of Markdown."""
    escaped = ([cell.replace("|", "\\|") for cell in cells] for cells in (head, *rows))
    lines = [f"| {' | '.join(cells)} |" for cells in escaped]
    rule = "|---" * len(head) + "|"
    return "\n".join((lines[0], rule, *lines[1:]))


def add_row(path: Path, row: Mapping[str, object]) -> None:
    """Add a row to a CSV file, which begins with the names of the first one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, row.keys(), lineterminator="\n")
        if not file.tell():
            writer.writeheader()
        writer.writerow(row)


def write_rows(path: Path, rows: Sequence[Any]) -> None:
    """Write rows of one dataclass as CSV."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, asdict(rows[0]))
        writer.writeheader()
        writer.writerows(map(asdict, rows))


def read_rows(path: Path, kind: type[Value]) -> list[Value]:
    """The rows of a dataclass that `write_rows` wrote."""
    types = {n: "True".__eq__ if t is bool else t for n, t in get_type_hints(kind).items()}
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return [kind(**{name: types[name](text) for name, text in row.items()}) for row in rows]


def write_sums(
    args: argparse.Namespace,
    path: Path,
    measure: Callable[[Any], None],
    sums: Callable[[], dict[str, Any]],
    page: Callable[[dict[str, Any]], str],
) -> None:
    """Fly, unless `--only-sums` is given; write the sums of all flights, and print their table."""
    if not args.only_sums:
        measure(args)
    result = sums()
    write(path, result)
    print(page(result))


def write(path: Path, result: Mapping[str, object]) -> None:
    """Write a result as JSON, with the software and the machine on which it depends."""
    from rotorgram.models.files import software_versions
    from rotorgram.training.results import machine

    path.parent.mkdir(parents=True, exist_ok=True)
    result = {**result, "versions": software_versions(), "machine": machine()}
    path.write_text(json.dumps(result, indent=2) + "\n")

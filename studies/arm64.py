"""Flights on `rigid` by code for arm64: do they have the committed hashes?

    apt-get install qemu-user gcc-aarch64-linux-gnu libc6-dev-arm64-cross
    python studies/arm64.py
    python studies/arm64.py --only Hover

The step of each compiled flight of tests/contracts.py is compiled for arm64, four worlds in a
vector, and linked to a program that runs it under qemu on memories that come through a pipe. All
else runs here. Prints whether each flight has its hash of tests/data/hashes.json; exit status 1 if
one has not. It takes a few minutes.
"""

import ctypes
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from math import prod
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import llvmlite.binding as binding
import numpy as np
from measuring import options
from rotorgram.envs import machine
from rotorgram.envs.compiled import make_loop
from rotorgram.sim.compile import llvm

sys.path.append(str(Path(__file__).parents[1] / "tests"))
from contracts import HASHES, RIGID, WORLDS, flight, hash_of

TRIPLE = "aarch64-linux-gnu"
FOLDER = TemporaryDirectory()
DRIVER = """
#include <stdio.h>
#include <stdlib.h>
void run(long{types}, char **);
int main(void) {{
    long head[{count} + 1];
    char *a[{count}];
    while (fread(head, 8, {count} + 1, stdin) == {count} + 1) {{
        for (int i = 0; i < {count}; i++) {{
            a[i] = aligned_alloc(64, (head[i + 1] + 63) / 64 * 64);
            if (fread(a[i], 1, head[i + 1], stdin) != head[i + 1]) return 1;
        }}
        run(head[0]{values}, a + {memories});
        for (int i = 0; i < {count}; i++) {{
            fwrite(a[i], 1, head[i + 1], stdout);
            free(a[i]);
        }}
        fflush(stdout);
    }}
}}
"""


def program(text: str, memories: int, count: int) -> Path:
    """A program that runs a module's function of so many memories, and of arrays outside."""
    target = binding.Target.from_triple(TRIPLE)
    module = binding.parse_assembly(text)
    made = target.create_target_machine(cpu="generic", opt=2, reloc="static")
    folder = Path(FOLDER.name)
    (folder / "run.o").write_bytes(made.emit_object(module))
    types = ", char *" * memories
    values = "".join(f", a[{number}]" for number in range(memories))
    driver = DRIVER.format(types=types, values=values, memories=memories, count=count)
    (folder / "main.c").write_text(driver)
    words = [f"{TRIPLE}-gcc", "-static", "-o", "main", "main.c", "run.o", "-lm"]
    subprocess.run(words, cwd=folder, check=True)
    return folder / "main"


def compiled(regions: Any, layouts: Sequence[Any], outside: Any, width: int) -> llvm.Code:
    """What stands for the function of this name: its code runs under qemu."""
    sizes = [layout.size for layout in layouts]
    for dtype, shape in outside.values():
        sizes.append(layouts[0].lanes * prod(shape) * dtype.itemsize)
    text = llvm._Printer(layouts, outside, width).text(regions)
    words = ["qemu-aarch64", program(text, len(layouts), len(sizes))]
    pipe: Any = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE)

    def run(blocks: int, *addresses: int) -> None:
        *memories, table = addresses
        others = (ctypes.c_int64 * len(outside)).from_address(table)
        places = [(a, blocks * x) for a, x in zip([*memories, *others], sizes, strict=True)]
        head = np.array([blocks, *(size for _, size in places)])
        pipe.stdin.write(head.tobytes())
        for address, size in places:
            pipe.stdin.write(ctypes.string_at(address, size))
        pipe.stdin.flush()
        for address, size in places:
            ctypes.memmove(address, pipe.stdout.read(size), size)

    return run


def main() -> None:
    args = options(__doc__, only="").parse_args()
    binding.initialize_all_targets()
    binding.initialize_all_asmprinters()
    machine.compiled = compiled
    machine.widest = lambda: 4
    expected = json.loads(HASHES.read_text())
    flown = []
    start = time.perf_counter()
    for name, case in RIGID.items():
        if case.options.get("compiled") is False or args.only not in name:
            continue
        loop = make_loop(case.config(), WORLDS)
        flown.append(hash_of(flight(loop)) == expected[name])
        assert loop.machine()
        print(f"{name:28} {'same' if flown[-1] else 'differs'}", flush=True)
    seconds = time.perf_counter() - start
    print(
        f"{sum(flown)} of {len(flown)} flights have their hash by code for arm64, {seconds:.0f} s"
    )
    sys.exit(not all(flown))


if __name__ == "__main__":
    main()

"""Coverage-guided fuzzing of all that reads datagrams: codecs, seals and both state machines.

    python tests/fuzz/fuzz_wire.py -runs=1000000
    python tests/fuzz/fuzz_wire.py -max_total_time=600 --json docs/results/reliability/fuzz.json
    python tests/fuzz/fuzz_wire.py runs/fuzz/crash-...        (one input again)

Needs Atheris (`pip install atheris`: libFuzzer for Python; Linux and macOS). All options but
`--json` are libFuzzer's. Its findings are written to `runs/fuzz`, where the corpus grows too.
`targets.py` says what is tested; `tests/udp/test_fuzz.py` gives it changed inputs without Atheris.
NumPy raises here where it would only warn.
"""

import argparse
import json
import platform
import re
import subprocess
import sys
import time
import warnings
from importlib import metadata
from pathlib import Path
from typing import Final

import atheris
import numpy as np

sys.path.append(str(Path(__file__).parent.parent))

with atheris.instrument_imports(include=["rotorgram.udp", "rotorgram.envs.spec"]):
    from targets import fuzz_one, seeds

ROOT: Final = Path(__file__).parent.parent.parent
FOUND: Final = ROOT / "runs" / "fuzz"


def fuzz(arguments: list[str]) -> None:
    """In a process of its own, which libFuzzer ends."""
    warnings.simplefilter("error")
    np.seterr(all="raise")
    atheris.Setup([sys.argv[0], *arguments], fuzz_one)
    atheris.Fuzz()


def main() -> int:
    parser = argparse.ArgumentParser(usage="fuzz_wire.py [--json FILE] [libFuzzer's arguments]")
    parser.add_argument("--json", type=Path, help="write the executions and findings here")
    options, arguments = parser.parse_known_args()
    corpus = FOUND / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(seeds()):
        (corpus / f"seed-{number:03d}").write_bytes(seed)
    if all(argument.startswith("-") for argument in arguments):
        arguments.append(str(corpus))
    command = [sys.executable, __file__, "--here", f"-artifact_prefix={FOUND}/", "-max_len=1024",
               "-rss_limit_mb=0",  # Atheris 3.0.0 leaks what comparisons of arrays give
               "-print_final_stats=1", *arguments]  # fmt: skip
    begun = time.monotonic()
    done = ""
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        for line in process.stderr:
            print(line, end="", file=sys.stderr)
            if found := re.match(r"stat::number_of_executed_units: *(\d+)", line):
                done = found[1]
    result = {
        "executions": int(done or 0),
        "seconds": round(time.monotonic() - begun),
        "findings": int(process.returncode != 0),
        "python": platform.python_version(),
        "atheris": metadata.version("atheris"),
    }
    print(f"{result['executions']:,} executions, {result['findings']} findings")
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    return process.returncode


if __name__ == "__main__":
    if sys.argv[1:2] == ["--here"]:
        fuzz(sys.argv[2:])
    else:
        sys.exit(main())

"""Size and time per call of an exported policy, beside the policy in NumPy.

`python studies/export.py` writes `docs/results/export.json`, which `docs/export.md` shows. It
needs gcc. One observation at a time, each another one, on one thread: processor time,
the least of several rounds in which the targets take turns. The compiled bytes of C are those of
the code and the constants that gcc -Os makes of a function that calls the policy.

It takes about a minute on two cores.
"""

import json
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
import onnxruntime
from measuring import RESULTS, in_turns, options, write
from rotorgram.agents import Checkpoint, Config
from rotorgram.agents.episodes import Position
from rotorgram.agents.export import TARGETS, c, metadata, onnx
from rotorgram.agents.policies import NetworkPolicy, flat_size
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec

POLICIES: Final = {
    "16 relu, Elevation-v0": ("rotorgram/Elevation-v0", (16,), "relu"),
    "64 × 64 tanh, Hover-v0": ("rotorgram/Hover-v0", (64, 64), "tanh"),
}
SEEN: Final = 256  # observations, over and over
PYTHON_CALLS, COMPILED_WEIGHTS = 5_000, 4e8  # in a round

C_LOOP: Final = """
#include <stdio.h>
#include <time.h>
#include "rotorgram_policy.h"
static float seen[SEEN][ROTORGRAM_OBSERVATIONS];
int main(void)
{
    float action[ROTORGRAM_ACTIONS], sum = 0;
    if (fread(seen, sizeof seen, 1, stdin) != 1)
        return 1;
    clock_t start = clock();
    for (int i = 0; i < CALLS; i++) {
        rotorgram_policy(seen[i % SEEN], action);
        sum += action[0];
    }
    double seconds = (double)(clock() - start) / CLOCKS_PER_SEC;
    fprintf(stderr, "%g", sum); /* so that it is computed */
    printf("%.17g", seconds / CALLS);
    return 0;
}
"""
C_CALL: Final = """
#include "rotorgram_policy.h"
void act(const float *observation, float *action);
void act(const float *observation, float *action) { rotorgram_policy(observation, action); }
"""
Clock = Callable[[], float]
"""Runs many calls; seconds of one."""


def policy_of(env: str, hidden: tuple[int, ...], activation: str) -> NetworkPolicy:
    """With random weights: time and size do not depend on them."""
    spec = env_spec(EnvConfig(env_id=env))
    rng = np.random.default_rng(0)
    k = spec.action.size  # type: ignore[union-attr]
    sizes = [flat_size(spec), *hidden, k]
    weights = {"log_std": np.zeros(k)}
    for i, (inputs, units) in enumerate(pairwise(sizes)):
        weight = np.zeros((units, 1 + inputs))
        weight[:, 1:] = rng.normal(size=(units, inputs)) / np.sqrt(inputs)
        weights[f"layers.{i}.weight"] = weight
    config = Config(hidden=hidden, activation=activation)  # type: ignore[arg-type]
    return NetworkPolicy.load({n: w.astype(np.float32) for n, w in weights.items()}, spec, config)


def clock(act: Callable[[object], object], seen: Sequence[object]) -> float:
    start = time.process_time()
    for i in range(PYTHON_CALLS):
        act(seen[i % SEEN])
    return (time.process_time() - start) / PYTHON_CALLS


def said(words: list[str], data: bytes) -> float:
    return float(subprocess.run(words, input=data, capture_output=True, check=True).stdout)


def compiled(*words: object) -> None:
    subprocess.run([str(word) for word in words], check=True)


def clocks(policy: NetworkPolicy, folder: Path) -> tuple[dict[str, Clock], dict[str, int]]:
    """Of each target, and the bytes of its file."""
    position = Position(env_steps=0, seconds=0.0)
    about = {"algorithm": "a2c", "config": {}, "seed": 0, "env_steps": 0, "position": position}
    told = metadata(Checkpoint(spec=policy.spec, actor={}, state={}, **about))
    files = {}
    for target, module in {"onnx": onnx, "c": c}.items():
        files[target] = folder / TARGETS[target]
        files[target].write_bytes(module.write(policy, told))
    seen = np.random.default_rng(1).uniform(-1, 1, (SEEN, flat_size(policy.spec)))
    rows = seen.astype(np.float32)
    (folder / "loop.c").write_text(C_LOOP)
    (folder / "call.c").write_text(C_CALL)
    calls = int(COMPILED_WEIGHTS / policy.weights.values.size)
    sizes = [f"-DSEEN={SEEN}", f"-DCALLS={calls}"]
    compiled("gcc", "-std=c99", "-O2", *sizes, "-o", folder / "loop", folder / "loop.c")
    compiled("gcc", "-std=c99", "-Os", "-c", "-o", folder / "call.o", folder / "call.c")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(files["onnx"], options)
    singles = [row[np.newaxis] for row in rows]
    feeds = [{"observation": row} for row in singles]
    sections = subprocess.run(["size", folder / "call.o"], capture_output=True, check=True).stdout
    text_and_data = sections.decode().splitlines()[1].split()[:2]
    linked = sum(map(int, text_and_data))
    return {
        "NumPy": lambda: clock(policy.act, list(rows)),
        "onnx": lambda: clock(lambda feed: session.run(None, feed), feeds),
        "c": lambda: said([str(folder / "loop")], rows.tobytes()),
    }, {**{target: path.stat().st_size for target, path in files.items()}, "c, compiled": linked}


def main() -> None:
    args = options(__doc__, rounds=15, out=RESULTS / "export.json").parse_args()
    policies = {}
    with tempfile.TemporaryDirectory() as folder:
        for i, (name, settings) in enumerate(POLICIES.items()):
            place = Path(folder) / str(i)
            place.mkdir()
            timed, sizes = clocks(policy_of(*settings), place)
            rounds = in_turns(timed, args.rounds, lambda seconds: 1e6 * seconds())
            least = {target: round(min(all_), 3) for target, all_ in rounds.items()}
            policies[name] = {"microseconds": least, "bytes": sizes}
            print(name, json.dumps(policies[name], indent=2))
    gcc = subprocess.run(["gcc", "-dumpversion"], capture_output=True, text=True).stdout.strip()
    tools = {"onnxruntime": onnxruntime.__version__, "gcc": gcc}
    write(args.out, {"policies": policies, "tools": tools})


if __name__ == "__main__":
    main()

"""The measures of the paper's claims on the backends `rigid` and `mujoco`, over the same seeds.

    python studies/claims_on_mujoco.py NAME=RIGID,MUJOCO … --out FILE.csv

RIGID and MUJOCO are folders of `rotorgram compare` with the same settings but for the backend and
the number of seeds. Of the seeds that both have, the file has a row for each agent and measure: the
interquartile means, the difference `mujoco` - `rigid`, and its 95 % bootstrap interval.

It takes a few seconds on two cores.
"""

from pathlib import Path

import pandas as pd
from measuring import options
from rotorgram.models.errors import InputError
from rotorgram.training import claims, metrics
from rotorgram.training.results import Results
from rotorgram.training.statistics import bootstrap_difference, iqm

MEASURES = {
    "convergence, env steps": claims.convergence_step,
    "long-run return": claims.long_run_return,
    "fluctuation of the return": claims.fluctuation,
}


def values(folder: Path, seeds: set[int]) -> dict[tuple[str, str], list[float]]:
    """Of each agent and measure, one for each of these seeds, in their order."""
    found = Results.read(folder)
    final = found.runs
    episodes = found.episodes[found.episodes["seed"].isin(seeds)]
    table: dict[tuple[str, str], list[float]] = {}
    for agent in sorted(set(episodes["row"])):
        runs = metrics.training_runs(episodes, agent)
        own = final[(final["row"] == agent) & final["seed"].isin(seeds)]
        for name, measure in MEASURES.items():
            table[agent, name] = [measure(run) for run in runs]
        table[agent, "steady |E|, m"] = own["steady"].tolist()
    return table


def compared(name: str, rigid: Path, mujoco: Path) -> list[dict[str, object]]:
    """The rows of a pair of folders."""
    seeds = [set(Results.read(folder).runs["seed"]) for folder in (rigid, mujoco)]
    both = seeds[0] & seeds[1]
    if len(both) < 2:
        raise InputError(
            f"{name}: expected folders with two seeds or more in common, got {len(both)}"
        )
    ours, theirs = (values(folder, both) for folder in (rigid, mujoco))
    rows = []
    for (agent, measure), numbers in ours.items():
        if (agent, measure) not in theirs:
            continue
        others = theirs[agent, measure]
        difference, low, high = bootstrap_difference(others, numbers)
        rows.append(
            {"setting": name, "agent": agent, "measure": measure, "seeds": len(both),
             "rigid": iqm(numbers), "mujoco": iqm(others), "difference": difference,
             "low": low, "high": high}
        )  # fmt: skip
    return rows


def main() -> None:
    """Compare the pairs of the command line, and write the file."""
    parser = options(__doc__)
    parser.add_argument("pairs", nargs="+", metavar="NAME=RIGID,MUJOCO")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    rows = []
    for pair in args.pairs:
        name, _, folders = pair.partition("=")
        rigid, _, mujoco = folders.partition(",")
        rows += compared(name, Path(rigid), Path(mujoco))
    table = pd.DataFrame(rows)
    table.to_csv(args.out, index=False, float_format="%.6g")
    print(table.to_string(index=False))


if __name__ == "__main__":
    main()

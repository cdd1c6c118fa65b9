"""How the policies that we ship fly where the world is not as in their training.

    python studies/shipped.py [--flights 200] [--policies universal ...] [--only-sums]

Each policy of the board, and `universal`, flies what `rotorgram evaluate FILE --robustness` does.
Flights of policies that are not named stay.
`docs/results/shipped_flights.npz` gets the steady headline metric of every flight, in thousandths,
65535 of one that crashed, from which `--only-sums` computes `docs/results/shipped.json` again.

It takes some 15 minutes on two cores.
"""

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from measuring import RESULTS, options, table, write_sums
from rotorgram.agents import load
from rotorgram.cli._env import UNIVERSAL
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.perturbations import check
from rotorgram.flights.executors import WorkersConfig
from rotorgram.models import InputError
from rotorgram.training.robustness import NOMINAL, TOGETHER, cells_of, fly, jobs_of

FILE = RESULTS / "shipped.json"
FLIGHTS = RESULTS / "shipped_flights.npz"
BOARD = RESULTS / "baselines" / "checkpoints"
CRASHED = 65535


def policies() -> dict[str, Path]:
    """Files of the policies, by name."""
    return {file.stem: file for file in (UNIVERSAL, *sorted(BOARD.glob("*.safetensors")))}


def env_of(file: Path) -> EnvConfig:
    """The env of a policy, with nothing drawn, on `rigid` where that flies it; that of `universal`
    has a Crazyflie.
    """
    env = load(file).env
    assert env is not None
    plain = env.changed(randomize={}, observe_drawn=False)
    if file == UNIVERSAL:
        plain = plain.changed(vehicle="crazyflie2", effects={"motor_lag": True})
    with suppress(InputError):
        rigid = plain.changed(backend="rigid")
        check(rigid)
        return rigid
    return plain


def measure(args: Any) -> None:
    """Fly; write every flight."""
    arrays: dict[str, np.ndarray] = {}
    if FLIGHTS.is_file():
        with np.load(FLIGHTS) as kept:
            arrays.update(kept)
    for name in args.policies:
        file = policies()[name]
        cells, _ = cells_of(env_of(file))
        jobs = jobs_of(str(file), cells, args.flights)
        rows = fly(jobs, WorkersConfig(), lambda *_: None)
        found = []
        for cell in cells:
            own = rows[(rows["row"] == cell.row) & (rows["size"] == cell.size)]
            steady = np.minimum(np.rint(1000 * own["steady"].to_numpy()), CRASHED - 1)
            found.append(np.where(own["crashed"], CRASHED, steady).astype(np.uint16))
        arrays[f"{name}/cells"] = np.array([f"{cell.row}={cell.size:g}" for cell in cells])
        arrays[f"{name}/counts"] = np.array([len(errors) for errors in found])
        arrays[f"{name}/errors"] = np.concatenate(found)
        np.savez_compressed(FLIGHTS, **arrays)
        print(name, flush=True)


def sums() -> dict[str, Any]:
    """Of each policy and cell, from the flights."""
    result: dict[str, Any] = {}
    with np.load(FLIGHTS) as arrays:
        for name in [one for one in policies() if f"{one}/cells" in arrays]:
            ends = np.cumsum(arrays[f"{name}/counts"])[:-1]
            errors = np.split(arrays[f"{name}/errors"], ends)
            cells = arrays[f"{name}/cells"].tolist()
            found: dict[str, dict[str, Any]] = {"flights": {}, "crashes": {}, "median": {}}
            for cell, own in zip(cells, errors, strict=True):
                whole = own[own != CRASHED]
                found["flights"][cell] = len(own)
                found["crashes"][cell] = len(own) - len(whole)
                found["median"][cell] = float(np.median(whole)) / 1000 if len(whole) else None
            result[name] = found
    return result


def page(result: dict[str, Any]) -> str:
    """The table of docs/robustness.md: crashes, %."""
    head = ["", NOMINAL, "worst alone, least size", "all, 1 of 3", "all, 2 of 3", "all, 3 of 3"]
    rows = []
    for name, found in result.items():
        flights = found["flights"]
        shares = {cell: 100 * own / flights[cell] for cell, own in found["crashes"].items()}
        least: dict[str, float] = {}
        for cell, share in shares.items():
            row = cell.partition("=")[0]
            if row not in (NOMINAL, TOGETHER):
                least.setdefault(row, share)
        worst = max(least, key=lambda row: least[row])
        told = f"{least[worst]:.3g} ({worst.replace('_', ' ')})" if least[worst] else "0"
        every = [f"{shares[f'{TOGETHER}={number}']:.3g}" for number in (1, 2, 3)]
        label = name.removesuffix("-seed5000").replace("-tuned-", ", ")
        rows.append([label, f"{shares[f'{NOMINAL}=0']:.3g}", told, *every])
    return table(head, rows)


def main() -> None:
    parser = options(__doc__, flights=200, policies=list(policies()), only_sums=False)
    args = parser.parse_args()
    write_sums(args, FILE, measure, sums, page)


if __name__ == "__main__":
    main()

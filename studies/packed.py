"""A study as small files: the form in which `docs/results` has it.

    python studies/packed.py FOLDER OUT

OUT gets the settings, the table, and of each run, evaluation flight and training episode its
numbers: one Parquet file for each table, numbers as float32. Tables of steps stay behind: they have
hundreds of megabytes. `rotorgram report OUT` makes tables, figures and verdicts anew from them.

It takes a few seconds on two cores.
"""

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
from measuring import options
from rotorgram.training.results import CONFIG_FILE, Results

COPIED = (CONFIG_FILE, "results.csv", "runs.csv")
LEVEL = 19  # of zstd


def small(table: pd.DataFrame) -> pd.DataFrame:
    """The table with numbers of half the size."""
    kinds = {np.dtype("float64"): "float32", np.dtype("int64"): "int32"}
    known = {name: kinds[kind] for name, kind in table.dtypes.items() if kind in kinds}
    return table.astype(known).astype({"row": "category"})


def main() -> None:
    """Write the files."""
    parser = options(__doc__)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("out", type=Path, metavar="OUT")
    args = parser.parse_args()
    results = Results.read(args.folder)
    tables = {"runs": results.runs, "evaluations": results.evaluations}
    if len(results.episodes):
        tables["episodes"] = results.episodes
    args.out.mkdir(parents=True, exist_ok=True)
    for name in COPIED:
        shutil.copyfile(args.folder / name, args.out / name)
    for name, table in tables.items():
        file = args.out / name / "all.parquet"
        file.parent.mkdir(exist_ok=True)
        table = small(table)
        numbers = list(table.columns[table.dtypes == "float32"])
        # Bytes of the same place side by side: of floats the first ones repeat.
        table.to_parquet(
            file, index=False, compression="zstd", compression_level=LEVEL,
            use_dictionary=["row"], use_byte_stream_split=numbers,
        )  # fmt: skip
        print(f"{file}: {len(table):,} rows, {file.stat().st_size / 1024:,.0f} KiB")


if __name__ == "__main__":
    main()

"""The report of a comparison: one HTML page, the table as CSV and Markdown, the verdicts as JSON.

All of it is written from the comparison's files, into the comparison's folder; the page refers to
nothing outside itself.
"""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Final

import pandas as pd

from .claims import judge_claims
from .curves import make_curves
from .figures import FIGURE_FILES, draw_figures
from .metrics import results_table
from .page import FolderFile, render_page
from .records import (
    CONFIG_FILE,
    EPISODES_FILE,
    EVALUATIONS_FILE,
    RUNS_FILE,
    STEPS_FILE,
    Records,
    read_records,
)
from .tables import markdown_table, result_rows, terminal_table

__all__ = [
    "CLAIMS_FILE",
    "REPORT_FILE",
    "RESULTS_CSV",
    "RESULTS_MARKDOWN",
    "VIDEO_FILE",
    "result_rows",
    "terminal_table",
    "write_report",
]

REPORT_FILE: Final = "report.html"
RESULTS_CSV: Final = "results.csv"
RESULTS_MARKDOWN: Final = "results.md"
CLAIMS_FILE: Final = "claims.json"
VIDEO_FILE: Final = "video.mp4"
"""The agents side by side; the page has it in itself where it lies in the folder."""

_FILES: Final = (
    (CONFIG_FILE, "every setting, the seeds, the versions and the machine"),
    (EPISODES_FILE, "a row per training episode"),
    (EVALUATIONS_FILE, "a row per evaluation episode of every snapshot"),
    (RUNS_FILE, "a row per training run, with its times"),
    (STEPS_FILE, "a row per env step of training and of the final evaluation"),
    ("checkpoints", "the trained policies; fly one with rotorgram serve or rotorgram evaluate"),
    (RESULTS_CSV, "the table of results, all digits"),
    (RESULTS_MARKDOWN, "the table of results, for reading"),
    (CLAIMS_FILE, "the verdicts with their definitions and evidence"),
    *((f"figures/{name}", "a figure, as a picture") for name in FIGURE_FILES),
    (VIDEO_FILE, "the agents side by side"),
)


def write_report(
    folder: Path | str, records: Records | None = None, results: pd.DataFrame | None = None
) -> Path:
    """Draw the figures and write the page, the table and the verdicts into the folder.

    Args:
        folder: Where `rotorgram compare` wrote its records.
        records: What `records.read_records(folder)` gave, where it is at hand.
        results: What `metrics.results_table` made of them, where it is at hand.

    Returns:
        The path of the page.

    Raises:
        RecordsError: If a file or a column of the records is missing.
    """
    folder = Path(folder)
    records = records or read_records(folder)
    if results is None:
        results = results_table(records.evaluations, records.runs)
    verdicts = judge_claims(records.episodes, records.evaluations, records.config["preset"])
    curves = make_curves(folder, records)
    draw_figures(folder, records, curves)
    results.to_csv(folder / RESULTS_CSV)
    (folder / RESULTS_MARKDOWN).write_text(markdown_table(results), encoding="utf-8")
    claims = json.dumps([asdict(verdict) for verdict in verdicts], indent=2, ensure_ascii=False)
    (folder / CLAIMS_FILE).write_text(claims + "\n", encoding="utf-8")
    video = folder / VIDEO_FILE
    page = render_page(
        records.config,
        results,
        verdicts,
        curves,
        video=video.read_bytes() if video.is_file() else None,
        files=[FolderFile(name, text) for name, text in _FILES if (folder / name).exists()],
    )
    report = folder / REPORT_FILE
    report.write_text(page, encoding="utf-8")
    return report

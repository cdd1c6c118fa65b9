"""The report of a comparison: one HTML page, the table as CSV and Markdown, the verdicts as JSON.

All of it is written from the comparison's files, into the comparison's folder; the page refers to
nothing outside itself.
"""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Final

import pandas as pd

from ..envs.spec import canonical_id
from .claims import Verdict, judge_claims, judge_no_worse
from .curves import make_curves
from .figures import draw_figures
from .metrics import results_table
from .page import render_page
from .results import Results, read_results
from .tables import markdown_table, terminal_table

__all__ = ["VIDEO_FILE", "table_of", "terminal_table", "write_report"]

VIDEO_FILE: Final = "video.mp4"
"""The agents side by side; the page has it in itself where it lies in the folder."""


def table_of(results: Results) -> pd.DataFrame:
    """The table of results, with the bounds of the task behind the agents."""
    bounds = results.config.get("bounds")
    return results_table(results.evaluations, results.runs, results.headline, bounds)


def _verdicts(results: Results) -> list[Verdict]:
    """The paper's claims, for the paper's task; and whether our A2C is no worse than SB3's."""
    preset, headline = results.config["preset"], results.headline
    verdicts = []
    if canonical_id(results.spec.env_id) == "rotorgram/Elevation-v0":  # of which the paper is
        verdicts = judge_claims(results.episodes, results.evaluations, preset, headline)
    if headline.held is not None:
        trained = set(results.runs["agent"])
        verdicts.append(judge_no_worse(results.evaluations, trained, preset, headline))
    return verdicts


def write_report(folder: Path | str, results: Results | None = None) -> Path:
    """Draw the figures and write the page, the table and the verdicts into the folder; the path of
    the page. Raises `ResultsError` if a file or a column is missing.
    """
    folder = Path(folder)
    results = results or read_results(folder)
    table, verdicts = table_of(results), _verdicts(results)
    curves = make_curves(folder, results)
    draw_figures(folder, results, curves)
    table.to_csv(folder / "results.csv")
    markdown = markdown_table(table, results.headline)
    (folder / "results.md").write_text(markdown, encoding="utf-8")
    claims = json.dumps([asdict(verdict) for verdict in verdicts], indent=2, ensure_ascii=False)
    (folder / "claims.json").write_text(claims + "\n", encoding="utf-8")
    video, report = folder / VIDEO_FILE, folder / "report.html"
    film = video.read_bytes() if video.is_file() else None
    files = {path.relative_to(folder).as_posix() for path in folder.rglob("*")}
    report.write_text(render_page(results, table, verdicts, curves, film, files), encoding="utf-8")
    return report

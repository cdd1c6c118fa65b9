"""The report of a study, from its files: figures, tables as CSV and Markdown, verdicts as JSON."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final

import pandas as pd

from ..models.errors import require
from .claims import Verdict, judge_claims, judge_no_worse
from .figures import draw_figures
from .results import Results
from .tables import markdown, results_table

PAGE_FILE: Final = "results.md"


def write_report(results: Results, page: Path | None = None) -> pd.DataFrame:
    """Draw the figures and write tables and verdicts into the folder; the table.

    `page` is a Markdown file that gets the tables too.
    """
    require("matplotlib", "report", "a report")
    folder = results.folder
    table = results_table(results)
    table.to_csv(folder / "results.csv")
    verdicts = judge(results)
    text = _head(results) + markdown(results, table) + _claims(verdicts)
    (folder / PAGE_FILE).write_text(text, encoding="utf-8")
    if page:
        page.write_text(text, encoding="utf-8")
    if verdicts:
        claims = json.dumps([asdict(verdict) for verdict in verdicts], indent=2, ensure_ascii=False)
        (folder / "claims.json").write_text(claims + "\n", encoding="utf-8")
    if len(table):
        draw_figures(results, table)
    return table


def judge(results: Results) -> list[Verdict]:
    """Verdicts on the paper's claims, and whether our A2C is no worse than SB3's."""
    if results.study.kind != "paper" or results.runs.empty:
        return []
    row = results.study.rows[0]
    headline = results.headline(row)
    preset = row.preset
    verdicts = judge_claims(results.episodes, results.runs, preset, headline)
    return [*verdicts, judge_no_worse(results.runs, preset, headline)]


def _head(results: Results) -> str:
    """Title, command and origin of the numbers, in Markdown."""
    study = results.study
    config = results.config
    last = study.first_seed + study.seeds - 1
    machine = config["machine"]
    versions = config["versions"]
    lines = [
        "# Results",
        "",
        "```sh",
        config["command"],
        "```",
        "",
        f"Seeds {study.first_seed} to {last}; {study.episodes} evaluation episodes each; "
        f"{config['created'][:10]}, {machine['cores']} cores ({machine['processor']}), MuJoCo "
        f"{versions.get('mujoco', '?')}.",
    ]
    missing = len(study.runs()) - len(results.runs)
    if missing:
        lines.append(f"{missing} of {len(study.runs())} runs are missing.")
    if study.seeds < 5:
        lines.append("Fewer than five seeds decide nothing.")
    return "\n".join(lines) + "\n\n"


def _claims(verdicts: Sequence[Verdict]) -> str:
    """The verdicts in Markdown."""
    text = "\n## Claims\n" if verdicts else ""
    for one in verdicts:
        text += f"\n* {one.claim} ({one.source}; preset {one.preset}.)\n"
        text += f"  **{one.verdict}**: {one.evidence} {one.definition}\n"
    return text

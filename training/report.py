"""The report of a study: figures, a page, the table as CSV and Markdown, the verdicts as JSON.

All of it is written from the study's files, into the study's folder; the page refers to nothing
outside itself.
"""

import base64
import html
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final

import pandas as pd

from ..models.errors import require
from .claims import Verdict, judge_claims, judge_no_worse
from .figures import PAPER, draw_figures
from .results import Results
from .tables import html_table, markdown, results_table, task_tables

VIDEO_FILE: Final = "video.mp4"
"""The agents side by side; the page has it in itself if it lies in the folder."""
PAGE_FILE: Final = "report.html"


def write_report(results: Results, page: Path | None = None) -> pd.DataFrame:
    """Draw the figures and write page, table and verdicts into the folder; the table.

    `page` is a Markdown file that gets the tables too.
    """
    require("matplotlib", "report", "a report")
    folder = results.folder
    table = results_table(results)
    table.to_csv(folder / "results.csv")
    text = markdown(results, table)
    for path in (folder / "results.md", *([page] if page else [])):
        path.write_text(_head(results) + text, encoding="utf-8")
    verdicts = judge(results)
    if verdicts:
        claims = json.dumps([asdict(verdict) for verdict in verdicts], indent=2, ensure_ascii=False)
        (folder / "claims.json").write_text(claims + "\n", encoding="utf-8")
    names = draw_figures(results, table) if len(table) else []
    content = "\n".join(_page(results, table, verdicts, names))
    (folder / PAGE_FILE).write_text(content, encoding="utf-8")
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


# ---- the page


def _page(
    results: Results, table: pd.DataFrame, verdicts: Sequence[Verdict], figures: Sequence[str]
) -> Iterator[str]:
    style = (Path(__file__).parent / "assets" / "report.css").read_text(encoding="utf-8")
    policy = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; media-src data:"
    yield "<!doctype html>"
    yield '<html lang="en"><head><meta charset="utf-8"><title>rotorgram: results</title>'
    yield f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
    yield '<meta name="viewport" content="width=device-width, initial-scale=1">'
    yield f"<style>{style}</style></head><body>"
    yield f"<h1>Results</h1><pre>{html.escape(results.config['command'])}</pre>"
    yield from _film(results.folder / VIDEO_FILE)
    for task in task_tables(results, table):
        yield f"<h2>{html.escape(task.task)}</h2>{html_table(task)}"
    for name in figures:
        yield _figure(results.folder / "figures" / f"{name}.svg", PAPER.get(name, ""))
    if verdicts:
        yield f"<h2>Claims</h2>{''.join(map(_verdict, verdicts))}"
    yield "</body></html>"


def _film(video: Path) -> Iterator[str]:
    if video.is_file():
        data = base64.b64encode(video.read_bytes()).decode("ascii")
        yield f'<video controls loop muted src="data:video/mp4;base64,{data}"></video>'


def _figure(file: Path, caption: str) -> str:
    data = base64.b64encode(file.read_bytes()).decode("ascii")
    name = html.escape(caption or file.stem)
    image = f'<img alt="{name}" src="data:image/svg+xml;base64,{data}">'
    return f"<figure>{image}<figcaption>{name}</figcaption></figure>"


def _verdict(verdict: Verdict) -> str:
    return (
        f"<section><h3>{html.escape(verdict.claim)}</h3>"
        f"<p><strong>{verdict.verdict}</strong> ({html.escape(verdict.source)}; preset "
        f"{verdict.preset}). {html.escape(verdict.evidence)}</p>"
        f"<p>{html.escape(verdict.definition)}</p></section>"
    )

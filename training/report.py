"""The report of a study: figures, a page, tables and verdicts as Markdown, tables as CSV.

All of it is written from the study's files, into the study's folder; the page refers to nothing
outside itself.
"""

import base64
from collections.abc import Sequence
from pathlib import Path
from string import Template

import pandas as pd
from markdown_it import MarkdownIt

from ..models.errors import require
from .claims import Verdict, judge_claims
from .figures import PAPER, draw_figures
from .results import Results
from .tables import markdown, results_table

PAGE_FILE = "report.html"
VIDEO_FILE = "video.mp4"
"""The rows side by side; the page has it in itself if it lies in the folder."""
_PAGE = Path(__file__).parent / "assets" / "report.html"


def write_report(results: Results) -> pd.DataFrame:
    """Draw the figures and write page, tables and verdicts into the folder; the table."""
    require("matplotlib", "report", "a report")
    folder = results.folder
    table = results_table(results)
    table.to_csv(folder / "results.csv")
    results.runs.to_csv(folder / "runs.csv", index=False)
    text = (
        _head(results)
        + markdown(results, table)
        + _claims(judge(results), results.study.rows[0].preset)
    )
    (folder / "results.md").write_text(text, encoding="utf-8")
    figures = draw_figures(results, table) if len(table) else []
    parts = [MarkdownIt("js-default").render(text)]  # HTML in a name stays text
    video = folder / VIDEO_FILE
    if video.is_file():
        parts.append(f'<video controls loop muted src="{_embedded(video, "video/mp4")}"></video>')
    for name in figures:
        source = _embedded(folder / "figures" / f"{name}.svg", "image/svg+xml")
        parts.append(f'<figure><img alt="{name}" src="{source}">')
        parts.append(f"<figcaption>{PAPER.get(name, name)}</figcaption></figure>")
    content = "\n".join(parts)
    page_text = Template(_PAGE.read_text(encoding="utf-8")).substitute(content=content)
    (folder / PAGE_FILE).write_text(page_text, encoding="utf-8")
    return table


def judge(results: Results) -> list[Verdict]:
    """Verdicts on the paper's claims, and whether our A2C is no worse than SB3's."""
    if results.study.kind != "paper" or results.runs.empty:
        return []
    headline = results.headline(results.study.rows[0])
    return judge_claims(results.episodes, results.runs, headline)


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


def _claims(verdicts: Sequence[Verdict], preset: str) -> str:
    """The verdicts on agents that were trained with a preset, in Markdown."""
    text = "\n## Claims\n" if verdicts else ""
    for one in verdicts:
        text += f"\n* {one.claim} ({one.source}; preset {preset}.)\n"
        text += f"  **{one.verdict}**: {one.evidence} {one.definition}\n"
    return text


def _embedded(file: Path, kind: str) -> str:
    """A file as an address that holds it."""
    return f"data:{kind};base64,{base64.b64encode(file.read_bytes()).decode('ascii')}"

"""The page of a comparison's report: one HTML file that needs no other, nor a network."""

import base64
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any, Final, NamedTuple, get_args

import jinja2
import pandas as pd
from markupsafe import Markup

from .charts import chart_data, make_charts
from .claims import Outcome, Verdict
from .curves import Curves
from .figures import agent_color, agent_label
from .records import sort_agents
from .tables import HEADINGS, NOTHING, TABLE_NOTE, count_text, number_text, result_rows

__all__ = ["FolderFile", "render_page"]

PAPER: Final = "https://doi.org/10.3390/drones7040225"

_ASSETS: Final = {
    "style": "report.css",
    "script": "report.js",
    "uplot_style": "uplot/uPlot.min.css",
    "uplot_script": "uplot/uPlot.iife.min.js",
    "uplot_licence": "uplot/LICENSE",
}


class FolderFile(NamedTuple):
    """A file of the comparison's folder: its name there, and what it holds."""

    name: str
    text: str


def render_page(
    config: Mapping[str, Any],
    results: pd.DataFrame,
    verdicts: Sequence[Verdict],
    curves: Curves,
    video: bytes | None = None,
    files: Sequence[FolderFile] = (),
) -> str:
    """Make the page.

    Args:
        config: The comparison's `config.json`.
        results: What `metrics.results_table` gave.
        verdicts: What `claims.judge_claims` gave.
        curves: What `curves.make_curves` gave.
        video: An MP4 of the agents side by side, shown where there is one.
        files: What lies beside the page.
    """
    agents = sort_agents(results.index)
    charts = make_charts(curves)
    return _template().render(
        **{name: _asset(path) for name, path in _ASSETS.items()},
        paper=PAPER,
        config=config,
        outcome=_outcome(results, verdicts, config["env_steps"]),
        extent=_extent(config),
        colors=[agent_color(agent) for agent in agents],
        dark_colors=[agent_color(agent, dark=True) for agent in agents],
        headings=HEADINGS,
        rows=result_rows(results.loc[agents]),
        note=TABLE_NOTE,
        verdicts=verdicts,
        schedule=_schedule(config["agents"]),
        charts=charts,
        data={
            "agents": [agent_label(agent) for agent in agents],
            "charts": chart_data(charts, agents),
        },
        video=base64.b64encode(video).decode("ascii") if video else None,
        hyperparameters=_hyperparameters(config["agents"]),
        settings=_settings(config),
        surroundings=_surroundings(config),
        files=files,
    )


def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    # What is not a number has no place in JSON: better an error here than a page without charts.
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    return environment.from_string(_read("report.html"))


def _read(path: str) -> str:
    return resources.files(__package__).joinpath(path).read_text(encoding="utf-8")


def _asset(path: str) -> Markup:
    """Ours or uPlot's, and so not to be escaped."""
    return Markup(_read(f"assets/{path}"))


def _outcome(results: pd.DataFrame, verdicts: Sequence[Verdict], env_steps: int) -> str:
    """What came out, in one sentence."""
    seen = results[results["steady_error"].notna()]
    trained = _ends(seen[seen["steps_per_second"].notna()])
    others = _ends(seen[seen["steps_per_second"].isna()])
    parts = []
    if trained:
        parts.append(
            f"After {count_text(env_steps)} env steps of training, episodes end on average "
            f"{trained} from the target"
        )
    if others:
        parts.append(f"without training, they end {others} from it")
    counts = Counter(verdict.verdict for verdict in verdicts)
    found = [f"{counts[name]} {'is' if counts[name] == 1 else 'are'} {name}"
             for name in get_args(Outcome) if counts[name]]  # fmt: skip
    parts.append(f"of the paper's {len(verdicts)} claims, {_listed(found)}")
    text = "; ".join(parts) + "."
    return text[0].upper() + text[1:]


def _ends(results: pd.DataFrame) -> str:
    values = results["steady_error"].items()
    return _listed([f"{number_text(value)} m ({agent_label(str(name))})" for name, value in values])


def _listed(words: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(words[:-1]), *words[-1:])))


def _extent(config: Mapping[str, Any]) -> str:
    seeds, env = config["seeds"], config["env"]
    text = (
        f"{len(seeds)} seed{'s' * (len(seeds) != 1)}, {count_text(config['env_steps'])} env steps"
    )
    if "episode_length" in env and "control_period" in env:
        duration = env["episode_length"] * env["control_period"]
        text += f" per run, episodes of {duration:g} s at {env['control_period']:g} s per step"
    return text


def _schedule(agents: Mapping[str, Mapping[str, Any]]) -> str:
    """What an annealed learning rate means for the claims; "" if the judged agents have none."""
    annealed = [agent_label(name) for name in ("vpg", "a2c") if agents.get(name, {}).get("anneal")]
    if not annealed:
        return ""
    return (
        f"Here the learning rate of {' and '.join(annealed)} falls to 0 over the run, which fixes "
        "roughly when a curve settles and damps its late fluctuation; the paper's rate is constant."
    )


def _hyperparameters(
    agents: Mapping[str, Mapping[str, Any]],
) -> tuple[list[str], list[tuple[str, list[str]]]]:
    """The names of the agents, and for each hyperparameter its name and its value per agent."""
    shown = sort_agents(agents)
    names = list(dict.fromkeys(name for agent in shown for name in agents[agent]))
    rows = [
        (name, [_written(agents[agent][name]) if name in agents[agent] else NOTHING
                for agent in shown])
        for name in names
    ]  # fmt: skip
    return [agent_label(agent) for agent in shown], rows


def _settings(config: Mapping[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """What was asked for, less the hyperparameters: titled lists of names and values."""
    general = {name: config[name] for name in ("created", "preset", "seeds", "env_steps")}
    return [
        ("Comparison", _pairs(general | config.get("evaluation", {}))),
        ("Task", _pairs(config["env"])),
    ]


def _surroundings(config: Mapping[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Where it ran: titled lists of names and values."""
    return [
        ("Versions", _pairs(config["versions"])),
        ("Machine", _pairs(config["machine"])),
        ("Model", _pairs({"hash": config["model_hash"]})),
    ]


def _pairs(values: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [(name, _written(value)) for name, value in values.items()]


def _written(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)

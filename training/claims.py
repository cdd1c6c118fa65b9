"""Do the paper's claims about VPG and A2C hold in a comparison's data, and is ours no worse?

Each claim of the paper's section 3 becomes one number per training run; the two agents' numbers are
compared by the bootstrap of the difference between their interquartile means over seeds. The
paper shows one run of each agent and gives no definitions, so the definitions here are ours, and
every verdict states its own. The report adds with which preset the agents were trained.

The paper's claims are four, and three comparisons judge them (presets `tuned` and `paper`, and the
task that observes the error alone). Each is judged by an interval of 1 - 0.05 / 12 = 99.58 %
(Bonferroni), so the chance of a wrong verdict among the twelve is 5 % at most.

Overlapping intervals do not show that two agents are alike. Our own claim, that our A2C is no worse
than SB3's, is shown by a margin of non-inferiority: the whole interval of the difference has to lie
on the good side of it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pandas import DataFrame, Series

from ..models.files import read_own_toml
from .metrics import Headline, episode_ends, mean_returns, training_runs
from .statistics import Floats, bootstrap_difference, finite, iqm, share_interval
from .tables import seeds_text

MIN_SEEDS = 30
"""Seeds with a value that each agent needs before a claim is decided.

Fewer are too few for what differs between seeds: one seed in ten on which an agent fails is missing
from ten seeds in a third of the cases, from thirty in a twenty-fifth; and a claim decided on ten
seeds became undecided on ten fresh ones.
"""
LEVEL = 1 - 0.05 / 12
"""Level of the interval of each verdict: of four claims in three comparisons."""
_INTERVAL = f"{100 * LEVEL:.2f} % interval"
HOLDING_SHARE = 0.9
"""Share of its seeds that an agent holds the target in, for the paper's claim. Ours: 74 seeds that
all hold show it, and no number of seeds shows that every seed does."""
MARGIN_SHARE = 0.2
"""Margin of non-inferiority, as a share of the bound below which a goal counts as held. Ours: for
the elevation task 0.02 m, a hundredth of the craft's width and far above what its agents differ by.
"""
MIN_EPISODES = 10
"""Training episodes below which a run's curve says nothing."""
CONVERGENCE_BAND = 0.1
"""Share of the smoothed curve's range within which it counts as converged."""
SMOOTHING_SHARE = 0.1
"""Share of training over which the episode return is averaged."""
LEARNING_RISE = 3.0
"""Rise, in standard deviations of the late level, above which a curve counts as learning.

About 7 % of curves of uncorrelated noise without any trend exceed it (simulated).
"""
FLUCTUATION_WINDOW = 11
"""Episodes in the centred moving average around which the fluctuation is measured."""
_GRID = 100

_TOO_FEW = f"fewer than {MIN_SEEDS} seeds with a value decide nothing"
_TEXTS = read_own_toml(__file__, "assets/claims")
_NUMBERS = {
    "smoothing": 100 * SMOOTHING_SHARE,
    "band": 100 * CONVERGENCE_BAND,
    "rise": LEARNING_RISE,
    "window": FLUCTUATION_WINDOW,
    "share": HOLDING_SHARE,
    "interval": _INTERVAL,
    "seeds": MIN_SEEDS,
    "margin_share": MARGIN_SHARE,
}

Outcome = Literal["borne out", "not borne out", "undecided", "not tested"]
_Judged = tuple[Outcome, str]


@dataclass(frozen=True)
class Verdict:
    """The verdict on one claim of the paper."""

    verdict: Outcome
    evidence: str
    """The numbers."""
    claim: str
    """With the paper's words."""
    source: str
    """Place in the paper."""
    definition: str
    """Of its measure and of the decision."""


def _late_returns(run: DataFrame, returns: Series) -> Series:
    """Returns of the episodes that ended in the last quarter; none of a run of too few episodes."""
    ends = episode_ends(run)
    return returns[(ends > 0.75 * ends.max(initial=0.0)) & (len(run) >= MIN_EPISODES)]


def convergence_step(run: DataFrame) -> float:
    """Env step from which one run's smoothed training return stays near its final level.

    The band around the final level is a share of the curve's own range, so a curve that only
    fluctuates would "converge" too, and late. It counts only if training raised the level: from
    the first tenth of training to the last by more than `LEARNING_RISE` standard deviations of
    the level in the last quarter. A run that did not converge, or of fewer than `MIN_EPISODES`
    episodes, has nan.
    """
    if len(run) < MIN_EPISODES:
        return np.nan
    ends = episode_ends(run)
    grid = ends[-1] * np.arange(1, _GRID + 1) / _GRID
    # Episodes first..last-1 ended within the window behind each grid point.
    last = np.searchsorted(ends, grid, side="right")
    first = np.searchsorted(ends, grid - SMOOTHING_SHARE * ends[-1], side="right")
    filled = last > first  # no episode ended in the window: the level is unknown there
    level = mean_returns(run, first[filled], last[filled])
    steps = grid[filled]
    begin = int(np.searchsorted(steps, grid[round(SMOOTHING_SHARE * _GRID) - 1]))
    if level[-1] - level[begin] <= LEARNING_RISE * level[steps > 0.75 * ends[-1]].std():
        return np.nan
    away = np.abs(level - level[-1]) > CONVERGENCE_BAND * np.ptp(level)
    start = away.nonzero()[0].max(initial=-1) + 1
    return float(steps[start])


def long_run_return(run: DataFrame) -> float:
    """Mean return of one run's episodes in the last quarter of training; nan if too few."""
    return float(_late_returns(run, run["return"]).mean())


def fluctuation(run: DataFrame) -> float:
    """Standard deviation of one run's episode returns around their moving average, over the last
    quarter of training; nan if it has fewer than `MIN_EPISODES` episodes, or two in that quarter.
    """
    moving = run["return"].rolling(FLUCTUATION_WINDOW, center=True, min_periods=1).mean()
    return float(_late_returns(run, run["return"] - moving).std())


# ---- verdicts


def judge_claims(episodes: DataFrame, runs: DataFrame, headline: Headline) -> list[Verdict]:
    """Judge the paper's four claims from the tables `episodes` and `runs` of `results`, and then
    whether our A2C is no worse than SB3's after as many env steps.

    The headline metric has a bound of its goal.
    """
    converges = _compare(episodes, convergence_step, True, " env steps", "did not converge")
    judged = {
        "converges": converges,
        "reward": _compare(episodes, long_run_return, True),
        "fluctuates": _compare(episodes, fluctuation, False),
        "holds": _both_hold(runs, headline),
        "no_worse": _no_worse(runs, headline),
    }
    return [_verdict(name, headline, outcome) for name, outcome in judged.items()]


def _verdict(name: str, headline: Headline, judged: _Judged) -> Verdict:
    """With the texts of a claim."""
    margin = headline.amount(_number(_margin(headline)))
    words = {"size": headline.size_symbol, "held": headline.held_text, "margin": margin}
    texts = {key: text.format(**_NUMBERS, **words) for key, text in _TEXTS[name].items()}
    return Verdict(*judged, **texts)


def _margin(headline: Headline) -> float:
    return MARGIN_SHARE * (headline.held or np.nan)


def _compare(
    episodes: DataFrame,
    measure: Callable[[DataFrame], float],
    larger: bool,
    unit: str = "",
    without: str = "",
) -> _Judged:
    """Judge a claim that A2C's measure of a run is larger (or smaller) than VPG's; the numbers.

    `without` says why a run that is long enough has no number.
    """
    runs = {name: training_runs(episodes, name.lower()) for name in ("A2C", "VPG")}
    missing = [name for name, own in runs.items() if not own]
    if missing:
        return "not tested", _untrained(missing)
    values = []
    parts = []
    for name, own in runs.items():
        numbers = np.array([measure(run) for run in own])
        known = finite(numbers).size
        details = _seeds(known, len(own))
        failed = sum(len(run) >= MIN_EPISODES for run in own) - known
        if without and failed:
            details += f", {failed} {without}"
        parts.append(f"{name} {_number(iqm(numbers))}{unit if known else ''} ({details})")
        values.append(numbers)
    evidence = f"{', '.join(parts)}; "
    if _are_few(values):
        return "undecided", f"{evidence}{_TOO_FEW}."
    difference, low, high = bootstrap_difference(values[0], values[1], LEVEL)
    evidence += f"difference {_number(difference)}, {_INTERVAL} {_range(low, high)}."
    if low <= 0.0 <= high:
        return "undecided", evidence
    return "borne out" if (low > 0.0) == larger else "not borne out", evidence


def _are_few(values: Sequence[Floats]) -> bool:
    """Whether an agent has too few seeds with a value."""
    return min(finite(numbers).size for numbers in values) < MIN_SEEDS


def _both_hold(runs: DataFrame, headline: Headline) -> _Judged:
    outcomes = []
    texts = []
    for name in ("a2c", "vpg"):
        outcome, text = _holds(runs[runs["row"] == name], headline)
        outcomes.append(outcome)
        texts.append(f"{name.upper()} {text}")
    # One agent that fails, fails the claim about both, whatever the other does.
    order: tuple[Outcome, ...] = ("not borne out", "not tested", "undecided", "borne out")
    return min(outcomes, key=order.index), f"{'; '.join(texts)}."


def _holds(runs: DataFrame, headline: Headline) -> _Judged:
    """Whether one agent holds its goal in its final evaluations, and the numbers."""
    if runs.empty:
        return "not tested", "not trained"
    count = len(runs)
    held = int(runs["held"].sum())
    crashed = int(runs["crashed"].sum())
    episodes = int(runs["episodes"].sum())
    low, high = share_interval(held, count, LEVEL)
    steady = headline.amount(_number(iqm(runs["steady"].to_numpy())))
    text = f"{steady}, holds in {held} of {_seeds(count, count)}"
    text += f", {_INTERVAL} of the share {low:.1%} to {high:.1%}"
    if crashed:
        text += f", {crashed} of {episodes} episodes crashed"
    if count >= MIN_SEEDS and low > HOLDING_SHARE:
        return "borne out", text
    if count >= MIN_SEEDS and high < HOLDING_SHARE:
        return "not borne out", text
    return "undecided", text


def _no_worse(runs: DataFrame, headline: Headline) -> _Judged:
    both = {name: runs[runs["row"] == name] for name in ("a2c", "sb3-a2c")}
    missing = [name for name, own in both.items() if own.empty]
    if missing:
        return "not tested", _untrained(missing)
    ours, theirs = both.values()
    pair = ours["steady"].to_numpy(), theirs["steady"].to_numpy()
    difference, low, high = bootstrap_difference(*pair)
    evidence = (
        f"A2C {_number(iqm(pair[0]))}, SB3 A2C {_number(iqm(pair[1]))}; difference "
        f"{headline.amount(_number(difference))}"
    )
    if _are_few(pair):
        return "undecided", f"{evidence}; {_TOO_FEW}."
    held = ours["held"].mean()
    their_held = theirs["held"].mean()
    evidence += f", 95 % interval {headline.amount(_range(low, high))}; "
    evidence += f"{held:.0%} of the seeds of A2C hold, {their_held:.0%} of SB3's."
    best, worst = (-high, -low) if headline.high else (low, high)
    margin = _margin(headline)
    if best > margin:
        return "not borne out", evidence
    if worst < margin and held >= their_held:
        return "borne out", evidence
    return "undecided", evidence


def _number(value: float) -> str:
    if not np.isfinite(value):
        return "no value"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def _range(low: float, high: float) -> str:
    return f"{_number(low)} to {_number(high)}"


def _seeds(count: int, total: int) -> str:
    return f"{count} of {total} seeds" if count < total else seeds_text(total)


def _untrained(names: list[str]) -> str:
    return f"{' and '.join(names)} {'were' if len(names) > 1 else 'was'} not trained."

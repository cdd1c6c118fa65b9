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

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pandas import DataFrame, Series

from .metrics import Headline, episode_ends, mean_returns, training_runs
from .statistics import Floats, bootstrap_difference, iqm, share_interval
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
OURS = "A claim of this software, not of the paper"

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

Outcome = Literal["borne out", "not borne out", "undecided", "not tested"]
_Judged = tuple[Outcome, str]


@dataclass(frozen=True)
class Verdict:
    """The verdict on one claim of the paper."""

    claim: str
    """With the paper's words."""
    source: str
    """Place in the paper."""
    definition: str
    """Of its measure and of the decision."""
    verdict: Outcome
    evidence: str
    """The numbers."""


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
    start = int(away.nonzero()[0][-1]) + 1 if away.any() else 0
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


def judge_claims(episodes: DataFrame, runs: DataFrame, headline: Headline) -> list[Verdict]:
    """Judge the paper's four claims from the tables `episodes` and `runs` of `results`."""
    return [
        Verdict(*_CONVERGES, *_compare(episodes, convergence_step, True, _LATER)),
        Verdict(*_REWARD, *_compare(episodes, long_run_return, True)),
        Verdict(*_FLUCTUATES, *_compare(episodes, fluctuation, False)),
        Verdict(*_holding_claim(headline), *_both_hold(runs, headline)),
    ]


_CONVERGES = (
    "A2C converges later than VPG: it “takes much more episodes to converge”.",
    "Section 3, Figure 6 (“A2C converge slower than VPG”)",
    f"Convergence: the env step from which the training return, averaged over "
    f"{100 * SMOOTHING_SHARE:.0f} % of training, stays within {100 * CONVERGENCE_BAND:.0f} % of "
    "its own range around its final level. A run that does not raise this average, from the first "
    f"tenth of training to the last, by more than {LEARNING_RISE:g} times its standard deviation "
    "in the last quarter did not converge and is left out. Env steps are compared, not episodes, "
    "because crashes make episodes of unequal length.",
)
_REWARD = (
    "A2C's long-run average reward is higher: it “can reach to higher average reward”.",
    "Section 3, Figures 6 and 7 (“A2C outperform the VPG on the long run”)",
    "Long run: the mean return of the episodes in the last quarter of training.",
)
_FLUCTUATES = (
    "A2C fluctuates less than VPG: “with much more stability”, “with minimum fluctuation”.",
    "Section 3, Figures 6 and 8",
    "Fluctuation: the standard deviation of the episode return around its centred moving average "
    f"over {FLUCTUATION_WINDOW} episodes, in the last quarter of training.",
)
_LATER = (" env steps", "did not converge")


def _holding_claim(headline: Headline) -> tuple[str, str, str]:
    return (
        "Both agents hold the target: “both implemented algorithms achieve high stability, by "
        "achieving convergence to the required performance”.",
        "Abstract; section 3, Figure 8",
        f"Holding: the steady state (mean {headline.size_symbol} over the last quarter of each "
        f"episode) of a seed's final deterministic evaluation fulfils {headline.held_text}, and no "
        f"episode of it crashes. Each agent holds in at least {HOLDING_SHARE:.0%} of its seeds, by "
        f"Wilson's {_INTERVAL} of the share. Fewer than {MIN_SEEDS} seeds decide nothing.",
    )


def _compare(
    episodes: DataFrame,
    measure: Callable[[DataFrame], float],
    larger: bool,
    words: tuple[str, str] = ("", ""),
) -> _Judged:
    """Judge a claim that A2C's measure of a run is larger (or smaller) than VPG's; the numbers.

    The words are the unit, after a space, and why a run that is long enough has no number.
    """
    runs = {name: training_runs(episodes, name.lower()) for name in ("A2C", "VPG")}
    missing = [name for name, own in runs.items() if not own]
    if missing:
        return "not tested", _untrained(missing)
    values = {name: np.array([measure(run) for run in own]) for name, own in runs.items()}
    parts = [_measured(name, values[name], own, words) for name, own in runs.items()]
    evidence = f"{', '.join(parts)}; "
    if min(np.isfinite(numbers).sum() for numbers in values.values()) < MIN_SEEDS:
        return "undecided", f"{evidence}{_TOO_FEW}."
    difference, low, high = bootstrap_difference(values["A2C"], values["VPG"], level=LEVEL)
    evidence += f"difference {_number(difference)}, {_INTERVAL} {_range(low, high)}"
    if low <= 0.0 <= high:
        return "undecided", f"{evidence}."
    agrees = (low > 0.0) == larger
    outcome: Outcome = "borne out" if agrees else "not borne out"
    return outcome, f"{evidence}."


def _measured(name: str, numbers: Floats, runs: list[DataFrame], words: tuple[str, str]) -> str:
    unit, without = words
    known = np.isfinite(numbers)
    long = np.array([len(run) >= MIN_EPISODES for run in runs])
    text = _seeds(int(known.sum()), len(numbers))
    failed = int((long & ~known).sum())
    if without and failed:
        text += f", {failed} {without}"
    return f"{name} {_number(iqm(numbers))}{unit if known.any() else ''} ({text})"


def _both_hold(runs: DataFrame, headline: Headline) -> _Judged:
    outcomes: list[Outcome] = []
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


def judge_no_worse(runs: DataFrame, headline: Headline) -> Verdict:
    """Judge whether our A2C is no worse than SB3's after as many env steps, from the table `runs`.
    The headline metric has a bound of its goal.
    """
    margin = MARGIN_SHARE * (headline.held or np.nan)
    claim = (
        "Our A2C is no worse than Stable-Baselines3's after as many env steps.",
        OURS,
        "No worse: of the interquartile means of the steady "
        f"{headline.size_symbol} in the final deterministic evaluation, that of our A2C minus that "
        f"of SB3's lies on the better side of a margin of {headline.amount(_number(margin))} with "
        f"its whole 95 % interval, and no smaller share of its seeds holds. The margin is ours: "
        f"{MARGIN_SHARE:.0%} of the bound for holding the goal. It says nothing of other measures.",
    )
    return Verdict(*claim, *_no_worse(runs, margin, headline))


def _no_worse(runs: DataFrame, margin: float, headline: Headline) -> _Judged:
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
    if min(np.isfinite(values).sum() for values in pair) < MIN_SEEDS:
        return "undecided", f"{evidence}; {_TOO_FEW}."
    held = ours["held"].mean()
    their_held = theirs["held"].mean()
    evidence += f", 95 % interval {headline.amount(_range(low, high))}; "
    evidence += f"{held:.0%} of the seeds of A2C hold, {their_held:.0%} of SB3's."
    best, worst = (-high, -low) if headline.high else (low, high)
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

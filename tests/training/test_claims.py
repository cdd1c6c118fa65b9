"""Verdicts on the paper's claims, for training curves of which the answer is known."""

import math
from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest
from comparisons import GATES, HEADLINE, spec_of
from rotorgram.training.claims import (
    Verdict,
    convergence_step,
    fluctuation,
    judge_claims,
    long_run_return,
)
from rotorgram.training.metrics import Headline
from rotorgram.training.results import COLUMNS

LENGTH = 10
COUNT = 100


def run(returns: np.ndarray, agent: str = "a2c", seed: int = 0) -> pd.DataFrame:
    """The training episodes of a run, of 10 steps each."""
    number = np.arange(len(returns))
    begin = number * LENGTH
    frame = pd.DataFrame({"episode": number, "first_step": begin, "return": returns})
    frame["last_step"] = begin + LENGTH
    frame = frame.assign(row=agent, seed=seed, length=LENGTH, mean_size=0.0, seconds=0.0)
    frame = frame.assign(terminated=False, truncated=True)
    return frame[list(COLUMNS["episodes"])]


def step_at(episode: int, top: float = 1.0) -> np.ndarray:
    return np.where(np.arange(COUNT) < episode, 0.0, top)


def training(make: Callable[[str, int], np.ndarray], seeds: int = 50) -> pd.DataFrame:
    runs = []
    for agent in ("a2c", "vpg"):
        runs += [run(make(agent, seed), agent, seed) for seed in range(seeds)]
    return pd.concat(runs)


def evaluated(**errors: list[float]) -> pd.DataFrame:
    """The table `runs`, of steady errors by agent; a seed holds below 0.1 m."""
    tables = []
    for agent, values in errors.items():
        table = pd.DataFrame({"steady": values}).rename_axis("seed").reset_index()
        table["held"] = (table["steady"] < 0.1).astype(int)
        tables.append(table.assign(row=agent, episodes=1, crashed=0))
    return pd.concat(tables, ignore_index=True)


HELD = evaluated(a2c=[0.01] * 80, vpg=[0.02] * 80)


def judged(episodes: pd.DataFrame, evaluations: pd.DataFrame = HELD) -> list[Verdict]:
    """The verdicts on the paper's claims."""
    return judge_claims(episodes, evaluations, HEADLINE)[:4]


def no_worse(evaluations: pd.DataFrame, headline: Headline) -> Verdict:
    """The verdict on the claim about SB3's A2C."""
    *_, verdict = judge_claims(run(np.zeros(0)), evaluations, headline)
    return verdict


def outcomes(episodes: pd.DataFrame, evaluations: pd.DataFrame = HELD) -> list[str]:
    return [verdict.verdict for verdict in judged(episodes, evaluations)]


def test_convergence_step_of_a_step_curve():
    # The step comes at env step 500; the mean over 100 steps is within 10 % of the new level
    # when 9 of its 10 episodes lie behind the step.
    assert convergence_step(run(step_at(50))) == 590.0
    lower = step_at(50, top=3.0) - 100.0
    assert convergence_step(run(lower)) == 590.0
    short = step_at(5)[:9]
    assert math.isnan(convergence_step(run(short)))


def test_what_does_not_rise_does_not_converge():
    flat = np.full(COUNT, 7.0)
    unlearning = step_at(50, top=-3.0)
    assert math.isnan(convergence_step(run(flat)))
    assert math.isnan(convergence_step(run(unlearning)))
    # Blocks of ten episodes at 0 and 1 in turn. The level ends where the last block lies, and its
    # standard deviation in the last quarter is 0.28 or, with a last block of 1.0, 0.29: the rise
    # is 2.9 of them, or 3.4.
    swinging = np.repeat(np.resize([0.0, 1.0], 10), 10)
    assert convergence_step(run(swinging)) == 990.0
    swinging[90:] = 0.8
    assert math.isnan(convergence_step(run(swinging)))


def test_flat_noise_does_not_converge_and_a_rise_in_the_same_noise_does():
    noise = [np.random.default_rng(seed).normal(size=COUNT) for seed in range(100)]
    flat = [convergence_step(run(values)) for values in noise]
    assert np.isnan(flat).sum() >= 85
    rising = [convergence_step(run(step_at(30, top=10.0) + values)) for values in noise]
    assert np.isfinite(rising).all()
    # Without noise it would be 390; with it, the level's last excursion from the band counts.
    assert 370.0 <= np.median(rising) <= 450.0


def test_convergence_step_where_windows_are_empty():
    # Ten episodes, the windows of a tenth hold one each; the return rises at the last.
    assert convergence_step(run(step_at(9)[:10])) == 100.0
    # Nothing ended before env step 60 of 105: the curve begins there.
    # It leaves the first episode, of return 0, behind when that window ends beyond 70.5.
    late = run(step_at(1)[:10]).assign(last_step=range(60, 110, 5))
    assert convergence_step(late) == pytest.approx(71.4)


def test_long_run_return_is_the_mean_of_the_last_quarter():
    returns = np.concatenate([np.full(75, -100.0), np.arange(25.0)])
    assert long_run_return(run(returns)) == 12.0
    few = run(np.ones(9))
    assert math.isnan(long_run_return(few))


def test_fluctuation_ignores_trends_and_sees_alternation():
    flat = run(np.full(COUNT, 3.0))
    assert fluctuation(flat) == 0.0
    # A ramp equals its centred mean but for the last five episodes, whose window is cut: they lie
    # 2.5, 2, 1.5, 1 and 0.5 above it, in a quarter of 25 episodes.
    ends = np.array([0.0] * 20 + [0.5, 1.0, 1.5, 2.0, 2.5])
    ramp = run(np.arange(float(COUNT)))
    assert fluctuation(ramp) == pytest.approx(ends.std(ddof=1))
    alternating = np.resize([1.0, -1.0], COUNT)
    # Eleven alternating values have the mean -1/11 of the middle one, so it lies 12/11 off; the
    # last five windows are cut and differ a little.
    once = fluctuation(run(alternating))
    assert once == pytest.approx(12 / 11, rel=0.05)
    five_times = fluctuation(run(5 * alternating))
    assert five_times == pytest.approx(5 * once, rel=1e-12)
    few = run(np.ones(9))
    assert math.isnan(fluctuation(few))


def paper_like(agent: str, seed: int) -> np.ndarray:
    noise = np.resize([1.0, -1.0], COUNT)
    if agent == "a2c":
        return step_at(50 + seed % 5, top=10.0) + 0.1 * noise
    return step_at(20 + seed % 5, top=8.0) + 0.5 * noise


def swapped(agent: str, seed: int) -> np.ndarray:
    return paper_like("vpg" if agent == "a2c" else "a2c", seed)


def test_data_as_in_the_paper_bear_its_claims_out():
    assert outcomes(training(paper_like)) == ["borne out"] * 4


def test_data_with_the_agents_swapped_do_not():
    assert outcomes(training(swapped)) == ["not borne out"] * 3 + ["borne out"]


def test_alike_agents_leave_claims_undecided():
    def alike(agent: str, seed: int) -> np.ndarray:
        noise = np.random.default_rng([seed, agent == "vpg"]).normal(size=COUNT)
        return step_at(40 + seed, top=10.0) + noise

    assert outcomes(training(alike))[:3] == ["undecided"] * 3


@pytest.mark.parametrize("seeds", [1, 5, 29])
def test_few_seeds_decide_nothing(seeds):
    errors = evaluated(a2c=[0.01] * seeds, vpg=[0.01] * seeds)
    verdicts = judged(training(paper_like, seeds), errors)
    assert [verdict.verdict for verdict in verdicts] == ["undecided"] * 4
    for verdict in verdicts[:3]:
        assert "fewer than 30 seeds with a value decide nothing" in verdict.evidence
    assert "Fewer than 30 seeds decide nothing" in verdicts[3].definition


def test_runs_that_did_not_converge_are_counted_and_left_out():
    def one_flat(agent: str, seed: int) -> np.ndarray:
        flat = agent == "a2c" and seed == 0
        return np.zeros(COUNT) if flat else paper_like(agent, seed)

    verdict = judged(training(one_flat, seeds=31))[0]
    assert verdict.verdict == "borne out"
    assert "(30 of 31 seeds, 1 did not converge), VPG" in verdict.evidence
    assert "(31 seeds);" in verdict.evidence
    assert outcomes(training(one_flat, seeds=30))[0] == "undecided"
    flat = training(lambda agent, seed: np.zeros(COUNT))
    verdict = judged(flat)[0]
    assert "A2C no value (0 of 50 seeds, 50 did not converge), VPG no value" in verdict.evidence


def test_an_agent_that_was_not_trained_is_not_tested():
    episodes = training(paper_like)
    only = episodes[episodes["row"] == "a2c"]
    verdicts = judged(only, evaluated(a2c=[0.01] * 30))
    assert [verdict.verdict for verdict in verdicts] == ["not tested"] * 4
    assert verdicts[0].evidence == "VPG was not trained."
    none = episodes.iloc[:0]
    assert outcomes(none, evaluated(pid=[0.0])) == ["not tested"] * 4


def test_one_agent_that_fails_refutes_both_even_if_the_other_was_not_trained():
    episodes = training(paper_like)
    only = episodes[episodes["row"] == "a2c"]
    failed = evaluated(a2c=[0.5] * 30)
    verdict = judged(only, failed)[3]
    assert verdict.verdict == "not borne out"
    assert "VPG not trained" in verdict.evidence
    # What is merely open leaves the claim about both untested.
    few = evaluated(a2c=[0.01] * 4)
    assert outcomes(only, few)[3] == "not tested"


@pytest.mark.parametrize(
    ("vpg", "expected"),
    [
        ([0.02, 0.03, 0.04, 0.05, 0.06] * 16, "borne out"),
        # Of n that all hold Wilson's interval begins at n / (n + z²), z = 2.8652: 73 / 81.21 is
        # 89.9 %, 74 / 82.21 is 90.01 %.
        ([0.02] * 73, "undecided"),
        ([0.02] * 74, "borne out"),
        ([0.2, 0.3, 0.4, 0.5, 0.6] * 10, "not borne out"),
        ([0.02] * 25 + [0.4] * 25, "not borne out"),  # the interval ends at 69 %
        ([0.02] * 50 + [math.nan], "undecided"),  # a seed without a value does not hold
        ([0.02] * 48 + [0.9] * 2, "undecided"),  # and the mean hides them
    ],
)
def test_holding_the_target(vpg, expected):
    errors = evaluated(a2c=[0.01] * 80, vpg=vpg)
    verdict = judged(training(paper_like), errors)[3]
    assert verdict.verdict == expected
    a2c = "A2C 0.01 m, holds in 80 of 80 seeds, 99.58 % interval of the share 90.7% to 100.0%"
    assert a2c in verdict.evidence


def test_a_crash_in_the_evaluation_is_not_holding():
    errors = HELD.assign(crashed=[1, *[0] * 159], held=[0, *[1] * 159])
    verdict = judged(training(paper_like), errors)[3]
    assert verdict.verdict == "undecided"
    assert "holds in 79 of 80 seeds" in verdict.evidence
    assert "1 of 80 episodes crashed" in verdict.evidence


def test_runs_that_are_too_short_are_named():
    episodes = training(paper_like, seeds=31)
    of_vpg = (episodes["row"] == "vpg") & (episodes["seed"] == 3)
    short = of_vpg & (episodes["episode"] >= 5)
    convergence, verdict, *_ = judged(episodes[~short])
    assert verdict.verdict == "borne out"
    # 8, and 25 alternating halves that begin and end with -0.5.
    assert "A2C 10 (31 seeds), VPG 7.98 (30 of 31 seeds)" in verdict.evidence
    # Too short to tell is not the same as not converging.
    assert "did not converge" not in convergence.evidence


def test_verdicts_state_their_source():
    for verdict in judged(training(paper_like)):
        assert "ection 3" in verdict.source
        assert verdict.definition


@pytest.mark.parametrize(
    ("ours", "theirs", "expected"),
    [
        ([0.03] * 30, [0.02] * 30, "borne out"),  # worse by 0.01 m, and the margin is 0.02 m
        ([0.05] * 30, [0.02] * 30, "not borne out"),
        # Alike on average, but the interval reaches beyond the margin: overlap shows nothing.
        ([0.0, 0.3] * 15, [0.0, 0.3] * 15, "undecided"),
        ([0.01] * 29, [0.02] * 29, "undecided"),
        ([0.01] * 28 + [3.0] * 2, [0.02] * 30, "undecided"),  # two seeds hold no more
    ],
)
def test_no_worse_is_shown_by_a_margin(ours, theirs, expected):
    evaluations = evaluated(a2c=ours, **{"sb3-a2c": theirs})
    verdict = no_worse(evaluations, HEADLINE)
    assert verdict.verdict == expected
    assert "margin of 0.02 m" in verdict.definition


def test_no_worse_of_what_is_to_be_high_and_of_what_was_not_trained():
    high = Headline.of(spec_of(GATES))  # held from 3 gates on: the margin is 0.6 of a gate
    theirs = {"sb3-a2c": [5.0] * 30}
    alike = evaluated(a2c=[4.5] * 30, **theirs)
    assert no_worse(alike, high).verdict == "borne out"
    worse = evaluated(a2c=[4.0] * 30, **theirs)
    assert no_worse(worse, high).verdict == "not borne out"
    alone = evaluated(a2c=[4.5] * 30)
    verdict = no_worse(alone, high)
    assert verdict.verdict == "not tested"
    assert verdict.evidence == "sb3-a2c was not trained."

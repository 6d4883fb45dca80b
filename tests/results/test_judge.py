"""Judging: verdicts by the intervals that the summary, the curves and `compare` print; and what they may never do."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

import copem_replay as cr
from copem_replay.metrics.limits import Clusters, limit_share_of_runs
from copem_replay.metrics.row_figures import JUDGED, PER_MINUTE, SUMMED, FigureRows
from copem_replay.results.compare import compare_folders
from copem_replay.results.judge import find_judged_clusters
from copem_replay.results.read import Results, read_results
from copem_replay.results.verdicts import (
    MET,
    NOT_MEASURED,
    NOT_MET,
    UNDECIDED,
    Judgement,
    Verdict,
    judge_limits,
    verdicts_jsonl,
)
from tests.helpers.report_pages import changed, replayed
from tests.oracles import intervals as oracle

LOGS = "logs: [drive.mcap]"


@pytest.fixture(scope="module")
def several(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three logs, of two objects each, six runs."""
    logs = [f"drive{k}.mcap" for k in range(3)]
    return replayed(tmp_path_factory.mktemp("several"), changed((LOGS, f"logs: [{', '.join(logs)}]")), *logs)


def judged(folder: Path | Results, *, before: Path | None = None, **criterion: Any) -> dict[str, Verdict]:
    """Judgement of one criterion, by configuration and group."""
    verdicts = cr.judge(folder, {"it": criterion}, before=before).all
    return {f"{one.configuration}/{one.group}" if one.group else one.configuration: one for one in verdicts}


# ------------------------------------------------------------------------------------ as printed elsewhere


def measured(summary: pd.DataFrame) -> list[str]:
    return [name for name in (*JUDGED, *SUMMED, *PER_MINUTE) if name in summary]


def test_every_figure_is_that_of_the_summary(several: Path) -> None:
    summary = read_results(several).summary.set_index("configuration")
    names = measured(summary)
    assert len(names) > 20
    for name in names:
        for configuration, verdict in judged(several, metric=name, at_most=1.0).items():
            expected = summary.loc[configuration, name]
            if pd.isna(expected):
                assert verdict.estimate is None, name
            else:
                assert verdict.estimate == pytest.approx(float(expected), abs=1e-9), (name, configuration)


@pytest.mark.parametrize("share", ["detected_share", "pass_share"])
def test_limits_of_shares_are_those_of_the_summary(several: Path, share: str) -> None:
    summary = read_results(several).summary.set_index("configuration")
    for configuration, verdict in judged(several, metric=share, at_least=0.5).items():
        low, high = (float(summary.loc[configuration, f"{share}_{end}"]) for end in ("low", "high"))
        assert (verdict.low, verdict.high) == pytest.approx((low, high), abs=1e-8)
        assert (verdict.over, verdict.clusters) == ("logs", 3)
        assert verdict.verdict == (MET if low >= 0.5 else NOT_MET if high < 0.5 else UNDECIDED)


@pytest.mark.parametrize("metric", ["ttd_rmst_s", "detected_share", "dad_median_m", "position_rmse_held_m"])
def test_differences_are_those_of_compare(several: Path, metric: str) -> None:
    table = compare_folders([several], baseline="half").overall
    table = table[table["metric"] == metric].set_index("configuration")
    found = judged(several, metric=metric, at_most=0.0, against="half")
    assert found
    for configuration, verdict in found.items():
        row = table.loc[configuration]  # met by the wider limits of a mean between bounds alone
        high = "high" if metric in ("dad_median_m", "position_rmse_held_m") else "high_bounded"
        numbers = [None if pd.isna(row[name]) else float(row[name]) for name in ("difference", "low", high)]
        assert [verdict.estimate, verdict.low, verdict.high] == numbers
        if verdict.high is not None and high == "high_bounded":
            assert verdict.interval == "bounded"


def test_a_group_is_judged_by_its_rows_alone(several: Path) -> None:
    results = read_results(several)
    for configuration in ("half",):
        found = judged(several, metric="detected_share", at_least=0.5, each="log", population="these_logs")
        for log in results.rows.logs:
            tally = results.counted(results.tally[results.tally["event"] == "detected"])
            rows = tally[(tally["configuration"] == configuration) & (tally["log"] == log)]
            known = rows["time_to_detection_s"].notna()
            expected = rows.loc[known, "runs"].sum() / rows["runs"].sum()
            assert found[f"{configuration}/{log}"].estimate == pytest.approx(expected)
            alone = judged(several, metric="detected_share", at_least=0.5, logs=[log], population="these_logs")
            assert alone[configuration].estimate == pytest.approx(expected)
            of_log = judged(several, metric="detected_share", at_least=0.5, by={"log": log}, population="these_logs")
            assert of_log[f"{configuration}/{log}"].low == alone[configuration].low


# ------------------------------------------------------------------------------------- point-blank cases


def test_no_row_is_never_0_and_never_100(several: Path) -> None:
    for metric in ("detected_share", "ttd_p95_s", "unknown_s", "position_rmse_m", "pass_share"):
        for bound in ({"at_most": 0.0}, {"at_least": 1.0}, {"at_least": 0.0}):
            for one in judged(several, metric=metric, objects={"classes": ["bus"]}, **bound).values():
                assert (one.verdict, one.passes, one.estimate) == (NOT_MEASURED, False, None)
    absent = judged(several, metric="detected_share", at_least=0.5, by={"class": "bus"}, if_absent="pass")
    assert {(one.verdict, one.passes) for one in absent.values()} == {(NOT_MEASURED, True)}


def test_two_logs_decide_nothing_of_such_traffic(several: Path) -> None:
    for one in judged(several, metric="detected_share", at_least=0.0, logs=["drive[01]"]).values():
        assert one.verdict == NOT_MEASURED
        assert "2 logs, fewer than 3" in one.why


def test_few_runs_of_several_objects_decide_nothing(several: Path) -> None:
    for one in judged(several, metric="detected_share", at_least=0.0, population="these_logs").values():
        expected = NOT_MEASURED if one.interval is None else MET
        assert one.verdict == expected
        assert "6 runs, fewer than 30" in one.why or one.interval == "nothing drawn"


def test_criteria_that_differ_in_their_population_alone_are_judged_each_by_its_own(several: Path) -> None:
    asked: dict[str, Any] = {"metric": "detected_share", "at_least": 0.5, "configurations": ["half"]}
    of_runs = {"runs": asked | {"population": "these_logs"}}
    for criteria in ({"traffic": asked} | of_runs, of_runs | {"traffic": asked}):
        found = {one.criterion: one for one in cr.judge(several, criteria).all}
        assert (found["traffic"].over, found["traffic"].clusters) == ("logs", 3)
        assert (found["runs"].over, found["runs"].why) == (None, "6 runs, fewer than 30: `runs: 30` or more")


def test_objects_and_logs_together_are_the_objects_of_these_logs(several: Path) -> None:
    """Six runs: of one of two objects in one of three logs 6 rows, of both 12, of one in all logs 18."""
    asked: dict[str, Any] = {"metric": "detected_share", "at_least": 0.5, "configurations": ["half"]}
    one, here = {"objects": {"ids": ["2"]}}, {"logs": ["drive1"]}
    for narrowed, rows in ((one | here, 6), (here, 12), (one, 18), ({}, 36)):
        assert judged(several, **asked, **narrowed)["half"].n == rows


def test_what_is_the_same_in_all_logs_has_limits_by_a_log_that_was_not_seen(several: Path) -> None:
    """In three equal logs all are known half a second after the onset; another may have any time from the latency, half
    a second, up to the horizon, and an object that is there for less be unknown for less.
    """
    results = read_results(several)
    horizon_s = float(results.summary["ttd_rmst_horizon_s"].iloc[0])
    for metric, least_s, below in (("unknown_to_horizon_s", 0.0, UNDECIDED), ("ttd_rmst_s", 0.5, NOT_MET)):
        expected = oracle.bounded(0.5, [0.5] * 3, [12.0] * 3, least_s, horizon_s)
        for bound, word in ((horizon_s, MET), (0.6, UNDECIDED), (0.4, below)):
            one = judged(several, metric=metric, at_most=bound, configurations=["late"])["late"]
            assert (one.estimate, one.low, one.high) == pytest.approx((0.5, *expected), abs=1e-9)
            assert (one.verdict, one.interval, one.over) == (word, "bounded", "logs")


def test_identical_results_are_not_refuted(several: Path, tmp_path: Path) -> None:
    logs = [f"drive{k}.mcap" for k in range(3)]
    again = replayed(tmp_path, changed((LOGS, f"logs: [{', '.join(logs)}]")), *logs)
    for metric in ("ttd_rmst_s", "detected_share", "unknown_to_horizon_s"):  # of six objects a median has no limits
        found = judged(again, before=several, metric=metric, at_most=0.0, against="before")
        assert found
        assert {name: (one.passes, one.estimate) for name, one in found.items()} == dict.fromkeys(found, (True, 0.0))


def test_a_difference_is_met_by_the_limits_between_bounds_and_not_met_by_students(several: Path) -> None:
    """`late` is later than `half` in each of three logs: how much later another may be, three do not tell."""
    results = read_results(several)
    table = compare_folders([several], baseline="half").overall.set_index(["configuration", "metric"])
    row = table.loc[("late", "unknown_to_horizon_s")]
    horizon_s = float(results.summary["ttd_rmst_horizon_s"].iloc[0])
    asked: dict[str, Any] = {"metric": "unknown_to_horizon_s", "configurations": ["late"], "against": "half"}
    assert row["high_bounded"] > max(row["high"] if pd.notna(row["high"]) else row["difference"], row["difference"])
    for bound, word in ((horizon_s, MET), (float(row["high_bounded"]) - 0.01, UNDECIDED)):
        one = judged(several, at_most=bound, **asked)["late"]
        assert (one.verdict, one.high) == (word, row["high_bounded"])
        other = judged(several, at_least=-bound, **asked)["late"]
        assert other.low == row["low_bounded"]
    far = judged(several, at_most=-horizon_s, **asked)["late"]
    assert far.verdict == NOT_MET


def test_the_same_twice(several: Path) -> None:
    criteria = {"a": {"metric": "ttd_p95_s", "at_most": 1.0}, "b": {"metric": "unknown_s", "at_most": 1.0}}
    assert verdicts_jsonl(cr.judge(several, criteria)) == verdicts_jsonl(cr.judge(several, criteria))


UNKNOWN = {
    "a column of summary.csv, found ttd_p96_s; did you mean ttd_p95_s?": {"metric": "ttd_p96_s"},
    "configurations[0]: expected names of configurations, found halff": {"configurations": ["halff"]},
    "against: half@before: give the folder with --before": {"against": "half@before"},
    "criteria.it.logs[0]: no log is named 'drive9*'": {"logs": ["drive9*"]},
    "tags.weather: expected a tag that some log has": {"by": {"tags.weather": "rain"}},
    "criteria.it.by.log: no group is named 'drive9'": {"by": {"log": "drive9"}},
}


@pytest.mark.parametrize("says", UNKNOWN)
def test_what_does_not_exist_is_said(several: Path, says: str) -> None:
    with pytest.raises(cr.InputError) as caught:
        cr.judge(several, {"it": {"metric": "ttd_rmst_s", "at_most": 1.0} | UNKNOWN[says]})
    assert says in str(caught.value)


# ------------------------------------------------------------------------------------------- by hand


def rows_of(times_s: list[float | None], clusters: list[str], over: str = "logs") -> FigureRows:
    """Rows of one run each, onset 0, looked at for 10 s; None: the object left."""
    table = pd.DataFrame(
        {
            "time_to_detection_s": pd.Series(times_s, dtype=float),
            "onset_s": 0.0,
            "ended_s": 10.0,
            "ended_by": "object_left",
            "distance_at_detection_m": [math.nan if t is None else 100.0 - 10.0 * t for t in times_s],
        }
    )
    units = np.zeros(len(times_s), dtype=int) if over == "runs" else np.arange(len(times_s))
    return FigureRows(table, np.ones(len(table)), Clusters(over, pd.factorize(np.array(clusters), sort=True)[0], units))


def test_a_share_over_runs_of_one_object_is_that_of_clopper_and_pearson() -> None:
    rows = rows_of([1.0] * 18 + [None, None], [str(k) for k in range(20)], "runs")
    found = rows.limit_share(rows.known.astype(float), 0.9)
    expected = binomtest(18, 20).proportion_ci(0.9, "exact")
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high), abs=1e-9)


def test_runs_that_are_alike_count_once_each() -> None:
    low, high = limit_share_of_runs(np.asarray(1.0), np.zeros(40), 5)
    expected = binomtest(40, 40).proportion_ci(0.95, "exact")
    assert (float(low), float(high)) == pytest.approx((expected.low, expected.high), abs=1e-9)


def test_runs_of_many_objects_are_worth_what_their_spread_says() -> None:
    """40 runs of 10 objects, of which each 9 or all are known: 950 trials by Σ(y − p)², far more than 40."""
    successes = np.array([9.0, 10.0] * 20)
    share = 0.95
    low, high = limit_share_of_runs(np.asarray(share), successes - share * 10, 10)
    variance = 40 / 39 * (0.05**2) / 40  # of the mean of 40 runs, all 0.05 away
    ratio = 1.9659 / 2.0227  # t of 399 degrees of freedom over that of 39
    n = min(400.0, share * (1 - share) / variance * ratio**2)
    assert n == 400.0
    expected = binomtest(380, 400).proportion_ci(0.95, "exact")
    assert (float(low), float(high)) == pytest.approx((expected.low, expected.high), abs=1e-9)


def test_a_quantile_is_judged_as_a_share() -> None:
    """12 logs of an object each: 11 known within 1 s. Exact limits of 11 of 12: .615 … .998; 95 % are not shown."""
    rows = rows_of([0.5] * 6 + [1.0] * 5 + [4.0], [f"{k:02}" for k in range(12)])
    p95 = rows.limit_time_quantile(0.95, 0.95, 1.0)
    assert p95.value == 4.0
    assert p95.share is not None
    # The spread of logs that are all or nothing leaves 12 − 1 of 12 trials.
    assert p95.share[0] < 0.95 < p95.share[2]
    assert judge_limits(p95.low, p95.high, 1.0, "at_most") == UNDECIDED
    assert (p95.low, p95.high) == (1.0, math.inf)
    median = rows.limit_time_quantile(0.5, 0.95, 1.0)
    assert (median.value, judge_limits(median.low, median.high, 1.0, "at_most")) == (0.5, MET)
    never = rows_of([None] * 12, [f"{k:02}" for k in range(12)]).limit_time_quantile(0.5, 0.95, 1.0)
    assert (never.value, judge_limits(never.low, never.high, 1.0, "at_most")) == (math.inf, NOT_MET)


@pytest.mark.parametrize(
    ("runs", "objects", "why"),
    [
        (29, 2, "29 runs, fewer than 30: `runs: 30` or more"), (30, 2, ""), (2, 1, ""),
        (1, 1, "1 run, fewer than 30: `runs: 30` or more"),
    ],
)  # fmt: skip
def test_thirty_runs_of_several_objects_or_two_of_one_have_an_interval(runs: int, objects: int, why: str) -> None:
    pairs = [(run, str(one)) for run in range(runs) for one in range(objects)]
    table = pd.DataFrame(pairs, columns=["run", "object_id"]).assign(log="drive")
    clusters, said = find_judged_clusters(table, of_runs=True)
    assert said == why
    assert (clusters is None) == bool(why)
    if clusters is not None:
        assert (clusters.over, clusters.count, clusters.units) == ("runs", runs, objects)


def test_who_is_known_at_the_very_bound_is_known_by_it() -> None:
    """12 logs of an object each: 11 known after 1 s, 90 m away, one after 4 s, 60 m away."""
    rows = rows_of([1.0] * 11 + [4.0], [f"{k:02}" for k in range(12)])
    share = rows.limit_share(np.array([1.0] * 11 + [0.0]), 0.95)
    for within, bound in ((rows.limit_time_quantile, 1.0), (rows.limit_distance_quantile, 90.0)):
        found = within(0.5, 0.95, bound)
        assert found.value == bound
        assert found.share == pytest.approx((share.low, share.value, share.high), abs=1e-9)
    nobody = rows.limit_distance_quantile(0.5, 0.95, 90.0 + 1e-6).share
    assert nobody is not None
    assert nobody[0] == 0.0


# ------------------------------------------------------------------------------------------ properties

limits = st.tuples(st.floats(-1e6, 1e6) | st.just(-math.inf), st.floats(-1e6, 1e6) | st.just(math.inf)).map(sorted)
_RANK = {NOT_MET: 0, UNDECIDED: 1, MET: 2}


@given(limits, st.floats(-1e6, 1e6), st.floats(0.0, 1e6))
def test_a_bound_that_moves_in_the_good_direction_never_worsens(of: list[float], bound: float, more: float) -> None:
    for direction, moved in (("at_most", bound + more), ("at_least", bound - more)):
        assert _RANK[judge_limits(*of, moved, direction)] >= _RANK[judge_limits(*of, bound, direction)]


@given(limits, st.floats(-1e6, 1e6))
def test_at_most_is_at_least_of_the_negative(of: list[float], bound: float) -> None:
    assert judge_limits(*of, bound, "at_most") == judge_limits(-of[1], -of[0], -bound, "at_least")


@given(limits, st.floats(-1e6, 1e6))
def test_what_is_met_is_not_unmet_the_other_way_round(of: list[float], bound: float) -> None:
    both = {judge_limits(*of, bound, "at_most"), judge_limits(*of, bound, "at_least")}
    if both == {MET}:  # the interval is the bound itself
        assert of[1] - of[0] <= 3e-9
    assert both != {NOT_MET}


drawn = st.lists(
    st.tuples(st.integers(0, 3), st.one_of(st.none(), st.integers(0, 20))), min_size=6, max_size=30
).filter(lambda rows: len({log for log, _ in rows}) >= 3)


@given(drawn, st.sampled_from([0.05, 0.5, 0.95]), st.integers(0, 9))
def test_a_quantile_is_within_its_limits_and_these_say_what_the_share_says(
    rows: list[tuple[int, int | None]], q: float, half_s: int
) -> None:
    times_s = [None if t is None else t / 2 for _, t in rows]
    figures = rows_of(times_s, [f"log {log}" for log, _ in rows])
    found = figures.limit_time_quantile(q, 0.95, half_s / 2)
    assert found.value is not None
    assert found.low <= found.value <= found.high
    assert found.share is not None
    verdict = judge_limits(found.low, found.high, half_s / 2, "at_most")
    if verdict == MET:
        assert found.share[0] >= q - 1e-9
    if verdict == NOT_MET:
        assert found.share[1] < q
    distance = figures.limit_distance_quantile(q, 0.95, 50.0)
    assert distance.value is not None
    assert distance.low <= distance.value <= distance.high


@given(drawn, st.floats(0.6, 0.99))
def test_less_confidence_is_narrower(rows: list[tuple[int, int | None]], confidence: float) -> None:
    figures = rows_of([None if t is None else t / 2 for _, t in rows], [f"log {log}" for log, _ in rows])
    known = figures.known.astype(float)
    wide, narrow = (figures.limit_share(known, level) for level in (0.995, confidence))
    assert wide.low <= narrow.low + 1e-12
    assert narrow.high <= wide.high + 1e-12


@pytest.mark.parametrize("looks", [1, 5, 40])
@pytest.mark.parametrize("together", [False, True])
def test_verdicts_over_runs_are_seldom_wrong_at_the_bound(looks: int, together: bool) -> None:
    """2,000 studies of 60 runs at a share of .9: rows of a run are independent, or one and the same."""
    rng = np.random.default_rng([looks, together])
    studies, runs = 2000, 60
    known = rng.random((studies, runs, 1 if together else looks)) < 0.9
    successes = np.broadcast_to(known, (studies, runs, looks)).sum(axis=-1).astype(float)
    share = successes.mean(axis=-1) / looks
    low, high = limit_share_of_runs(share, successes - (share * looks)[:, None], looks)
    wrong = max((low > 0.9).mean(), (high < 0.9).mean())
    assert wrong <= 0.035 + 3 * math.sqrt(0.035 * 0.965 / studies)
    assert (high - low).mean() < (0.2 if looks == 1 or together else 0.2 / math.sqrt(looks / 1.5))


def test_no_verdict_passes_where_one_does_not() -> None:
    assert Judgement("none", ()).passes

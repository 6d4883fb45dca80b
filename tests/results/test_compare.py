"""Comparisons of detections: differences computed in the head, intervals by a plain loop."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binomtest

from copem_replay.core.errors import InputError
from copem_replay.metrics.survival import CENSORED, DETECTED, LEFT, cumulative_incidence, restricted_mean
from copem_replay.results.compare import Comparison, compare_folders
from copem_replay.results.compare.tables import comparison_text
from copem_replay.results.read import open_results
from tests.helpers.compare_folders import BRAKING, Row, limits_of, row, write_folder


def compared(path: Path, rows: Sequence[Row], **given: Any) -> Comparison:
    return compare_folders([write_folder(path / "study", rows, **given)])


def of(comparison: Comparison, metric: str, log: str = "all") -> Any:
    """The one row of a metric."""
    table = comparison.table
    found = table[(table["metric"] == metric) & (table["log"] == log)]
    assert len(found) == 1
    return found.iloc[0]


THREE = [
    row("ideal", 1.0, 30.0),
    row("ideal", 2.0, 20.0, object_id="8"),
    row("ideal", None, object_id="9"),
    row("late", 1.5, 25.0),
    row("late", None, object_id="8"),
    row("late", None, object_id="9"),
]
"""One object seen half a second later, one no more, one by nobody."""


def test_the_share_detected_loses_the_one_that_is_not_seen(tmp_path):
    share = of(compared(tmp_path, THREE), "detected_share")
    assert (share["value"], share["baseline_value"]) == pytest.approx((1 / 3, 2 / 3))
    assert share["difference"] == pytest.approx(-1 / 3)
    assert share["n"] == 3
    assert (share["only_configuration"], share["only_baseline"]) == (0, 1)
    assert share["p_value"] == 1.0


def test_each_episode_of_an_object_has_its_partner_and_they_are_one_object(tmp_path):
    """Twice after 1 and 2 s, on the other side after 2 and 5 s: 2 s later on average, over one object's runs."""
    times = {"ideal": (1.0, 2.0), "late": (2.0, 5.0)}
    rows = [row(name, s, episode=k) for name, both in times.items() for k, s in enumerate(both)]
    time = of(compared(tmp_path, rows), "ttd_rmst_s")
    assert (time["n"], time["difference"]) == (2, pytest.approx(2.0))
    assert pd.isna(time["interval_over"]), "one run of one object is no sample"


def test_only_rows_that_count_are_compared(tmp_path):
    """Of two objects the one that was there at the log's start has no say in times and shares."""
    rows = [row("ideal", 1.0), row("late", 2.0)]
    rows += [row(name, 9.0, object_id="8", began="log_start") for name in ("ideal", "late")]
    time = of(compared(tmp_path / "a", rows), "ttd_rmst_s")
    assert (time["n"], time["difference"]) == (1, pytest.approx(1.0))
    every = {"began": ["log_start", "crossed", "appeared"]}
    time = of(compared(tmp_path / "b", rows, measure=every), "ttd_rmst_s")
    assert (time["n"], time["difference"]) == (2, pytest.approx(0.5))


GNN_IS = {"ideal": "ideal", "ideal_of": "inputs"}


@pytest.mark.parametrize(
    ("facts", "sign", "end"),
    [
        ({}, 1, None),
        ({"gnn": GNN_IS}, 1, 0.0),
        ({"ideal": {"truth": True}}, 1, 0.0),
        ({"gnn": GNN_IS | {"ideal_of": "units"}}, 1, None),
        ({"gnn": GNN_IS | {"recorded": True}}, 1, None),
        ({"gnn": {"truth": True}}, -1, 0.0),
        ({"gnn": {"truth": True}}, 1, None),
    ],
)
def test_no_limit_is_where_the_difference_cannot_be(tmp_path, facts, sign, end):
    """gnn knows one of five objects 2 s later, or sooner: 0.4 ± 2.776 · 0.4 s, by Student's t. It is no sooner than
    ideal fusion of the same inputs, nor is this than the truth; whatever is found against that is left as it is.
    """
    late, soon = ([row(name, 1.0 if k else at, object_id=str(k)) for k in range(5)] for name, at in
                  (("gnn" if sign > 0 else "ideal", 3.0), ("ideal" if sign > 0 else "gnn", 1.0)))  # fmt: skip
    time = of(compared(tmp_path, late + soon, facts=facts), "ttd_rmst_s")
    ends = sorted([sign * time["low"], sign * time["high"]])
    assert time["difference"] == pytest.approx(sign * 0.4)
    assert ends == pytest.approx([-0.4 * 1.77645 if end is None else end, 0.4 * 3.77645], abs=1e-4)


def test_never_detected_counts_as_the_horizon(tmp_path):
    time = of(compared(tmp_path, THREE), "ttd_rmst_s")
    assert time["value"] == pytest.approx((1.5 + 10 + 10) / 3)
    assert time["baseline_value"] == pytest.approx((1 + 2 + 10) / 3)
    assert time["difference"] == pytest.approx((0.5 + 8 + 0) / 3)


def test_the_horizon_that_was_given_cuts_all_times(tmp_path):
    comparison = compared(tmp_path, THREE, measure={"horizon_used_s": 1.25})
    assert comparison.horizon_s == 1.25
    # 1.5 and never are 1.25 now, and so is the baseline's 2.
    assert of(comparison, "ttd_rmst_s")["difference"] == pytest.approx((0.25 + 0 + 0) / 3)


def test_who_was_still_there_is_censored(tmp_path):
    """Looked at until 4 s: as the other, who is detected at 6 s, for all that is known of later times."""
    still = {"ended_by": "log_end", "ended_s": 4.0}
    others = [row(name, 6.0, 30.0, object_id="8") for name in ("ideal", "late")]
    comparison = compared(tmp_path, [row("ideal", 1.0, 30.0, **still), row("late", None, **still), *others])
    time = of(comparison, "ttd_rmst_s")
    assert (time["value"], time["baseline_value"], time["difference"]) == (6.0, 3.5, 2.5)
    away = [row("ideal", 1.0, 30.0, ended_s=4.0), row("late", None, ended_s=4.0), *others]
    assert of(compared(tmp_path / "away", away), "ttd_rmst_s")["value"] == 8.0


def test_times_of_both_are_of_those_that_both_detect_and_say_who_is_missing(tmp_path):
    """.5 s later, whatever the horizon and however many are never detected; of three rows one is the ideal's alone."""
    for horizon_s in (1.25, 20.0):
        folder = tmp_path / str(horizon_s)
        comparison = compared(folder, THREE, measure={"horizon_s": horizon_s})
        time = of(comparison, "ttd_both_s")
        assert (time["value"], time["baseline_value"], time["difference"], time["n"]) == (1.5, 1.0, 0.5, 1)
        assert (time["only_configuration"], time["only_baseline"]) == (0, 1)
        assert pd.isna(time["p_value"])
        assert "+0.5 (only it 0 %, only the baseline 33.3 %)" in comparison_text(comparison)
    nobody = of(compared(tmp_path, [*THREE[:1], row("late", None)]), "ttd_both_s")
    assert pd.isna(nobody["difference"])
    assert (nobody["n"], nobody["only_baseline"]) == (0, 1)


def test_unknown_until_the_detection_or_the_end_of_the_episode(tmp_path):
    """Episodes from 2 to 10, 2 to 6 and 2 to 3 s, up to a horizon of 6 s; one is known before, one after the end."""
    rows = [
        row("ideal", 3.0, 30.0, onset_s=2.0),
        row("ideal", None, object_id="8", onset_s=2.0, ended_s=6.0),
        row("ideal", 1.0, 30.0, object_id="9", onset_s=2.0, ended_s=3.0),
        row("late", None, onset_s=2.0, ended_by="log_end"),
        row("late", 6.5, 20.0, object_id="8", onset_s=2.0, ended_s=6.0),
        row("late", 2.5, 20.0, object_id="9", onset_s=2.0, ended_s=3.0),
    ]
    unknown = of(compared(tmp_path, rows, measure={"horizon_used_s": 6.0}), "unknown_to_horizon_s")
    assert unknown["baseline_value"] == pytest.approx((1 + 4 + 0) / 3)
    assert unknown["value"] == pytest.approx((6 + 4 + 0.5) / 3)
    assert unknown["difference"] == pytest.approx((5 + 0 + 0.5) / 3)
    assert unknown["n"] == 3


def test_times_count_from_the_onset(tmp_path):
    rows = [row("ideal", 5.0, 30.0, onset_s=5.0), row("late", 5.5, 30.0, onset_s=5.0)]
    time = of(compared(tmp_path, rows), "ttd_rmst_s")
    assert (time["value"], time["baseline_value"]) == (0.5, 0.0)


def test_the_median_is_of_the_differences_with_never_below_every_distance(tmp_path):
    # −5 m, −∞ and 0, where both have nothing: the one in the middle.
    distance = of(compared(tmp_path, THREE), "dad_median_m")
    assert distance["difference"] == -5.0
    assert distance["n"] == 3
    assert pd.isna(distance["value"])  # 25 m, never, never
    assert distance["baseline_value"] == 20.0


def test_an_infinite_median_is_none(tmp_path):
    lost = of(compared(tmp_path, [*THREE[:2], *THREE[3:5]]), "dad_median_m")
    assert pd.isna(lost["difference"])
    assert lost["n"] == 2


def test_detected_where_the_truth_has_a_gap_has_no_distance_to_compare(tmp_path):
    rows = [*THREE, row("ideal", 1.0, 30.0, object_id="10"), row("late", 1.0, None, object_id="10")]
    comparison = compared(tmp_path, rows)
    assert of(comparison, "dad_median_m")["n"] == 3
    assert of(comparison, "ttd_rmst_s")["n"] == 4


def test_pass_share_is_of_those_in_conflict(tmp_path):
    verdicts = [
        (True, True, False),
        (True, True, False),
        (True, False, False),
        (True, False, True),
        (False, True, True),
    ]
    rows = [
        row(name, 1.0, 30.0, object_id=str(k), conflict=conflict, braking_pass=passes if conflict else None)
        for k, (conflict, *of_sides) in enumerate(verdicts)
        for name, passes in zip(("ideal", "late"), of_sides, strict=True)
    ]
    share = of(compared(tmp_path, rows, braking=BRAKING), "pass_share")
    assert (share["value"], share["baseline_value"], share["difference"]) == (0.25, 0.5, -0.25)
    assert share["n"] == 4
    assert (share["only_configuration"], share["only_baseline"]) == (1, 2)
    assert share["p_value"] == pytest.approx(binomtest(1, 3).pvalue)
    assert pd.isna(share["interval_over"])  # four objects are too few


def test_without_braking_there_is_no_pass_share(tmp_path):
    assert "pass_share" not in set(compared(tmp_path, THREE).table["metric"])


# ----------------------------------------------------------------------------------------------- intervals


def limits_by_a_loop(clusters: dict[str, list[tuple[float, float]]]) -> tuple[float, float]:
    """From the mean of all differences in all clusters, and in all but one."""

    def mean(drawn: list[str]) -> float:
        pairs = [pair for name in drawn for pair in clusters[name]]
        return float(np.mean([first for first, _ in pairs]) - np.mean([second for _, second in pairs]))

    return limits_of(list(clusters), mean)


def pairs_of(times: Sequence[tuple[float, float]], **where: Any) -> list[Row]:
    """Run after run, detected by `late` and by `ideal`."""
    return [
        row(name, time, 30.0 - time, run=run, **where)
        for run, both in enumerate(times)
        for name, time in zip(("late", "ideal"), both, strict=True)
    ]


def test_objects_are_left_out_whole(tmp_path):
    rng = np.random.default_rng(7)
    of_objects = {str(k): [(float(a) + k, float(b)) for a, b in rng.uniform(0, 2, (3, 2))] for k in range(6)}
    rows = [r for name, times in of_objects.items() for r in pairs_of(times, object_id=name)]
    time = of(compared(tmp_path, rows), "ttd_rmst_s")
    expected = limits_by_a_loop({f"a\n{name}": times for name, times in of_objects.items()})
    assert time["interval_over"] == "objects"
    assert (time["low"], time["high"]) == pytest.approx(expected, abs=1e-8)


def test_five_logs_are_left_out_whole_and_each_has_limits_by_what_it_has(tmp_path):
    rng = np.random.default_rng(8)
    of_logs = {f"log{k}": [(float(a) + k, float(b)) for a, b in rng.uniform(0, 2, (6, 2))] for k in range(5)}
    rows = [r for name, times in of_logs.items() for r in pairs_of(times, log=name)]
    comparison = compared(tmp_path, rows)
    time = of(comparison, "ttd_rmst_s")
    assert time["interval_over"] == "logs"
    assert (time["low"], time["high"]) == pytest.approx(limits_by_a_loop(of_logs), abs=1e-8)
    one = of(comparison, "ttd_rmst_s", "log3")
    times = of_logs["log3"]
    assert one["interval_over"] == "runs"
    assert one["difference"] == pytest.approx(np.mean([a - b for a, b in times]), abs=1e-8)
    expected = limits_by_a_loop({str(run): [both] for run, both in enumerate(times)})
    assert (one["low"], one["high"]) == pytest.approx(expected, abs=1e-8)


def test_the_median_has_limits_too(tmp_path):
    # Of six objects three are 1 m and three 2 m nearer: the limits are these, and no mean of any. None of six: up to
    # .459 may be; half of them: .147 to .853.
    rows = [r for k in range(6) for r in pairs_of([(1.0 + k % 2, 0.0)], object_id=str(k))]
    distance = of(compared(tmp_path, rows), "dad_median_m")
    assert (distance["difference"], distance["low"], distance["high"]) == (-2.0, -2.0, -1.0)


def test_shares_that_differ_alike_in_five_objects_have_exact_limits(tmp_path):
    """1 − 0.025^(1/5) = 0.521824; late never detects what the other does, then both detect the same."""
    for late, expected in ((None, (-1.0, -0.478176)), (1.0, (-0.521824, 0.521824))):
        rows = [r for k in range(5) for r in (row("ideal", 1.0, 30.0, object_id=str(k)),
                                              row("late", late, late, object_id=str(k)))]  # fmt: skip
        share = of(compared(tmp_path / str(late), rows), "detected_share")
        assert (share["low"], share["high"]) == pytest.approx(expected, abs=1e-6)
        assert (share["interval"], share["interval_over"]) == ("exact", "objects")


def test_exact_limits_count_objects_by_what_they_weigh(tmp_path):
    """One object in 20 runs, four in one each: w = 20/4.8, 4 · 1/4.8, m = Σw²/5 = 3.507, 5/(1 + .2 · 2.507) objects."""
    rows = [row(name, 1.0, 30.0, object_id="0", run=run) for run in range(20) for name in ("ideal", "late")]
    rows += [row(name, 1.0, 30.0, object_id=str(k)) for k in range(1, 5) for name in ("ideal", "late")]
    share = of(compared(tmp_path, rows), "detected_share")
    limit = 1 - 0.025 ** ((1 + 0.2 * (404 / 4.8**2 / 5 - 1)) / 5)
    assert (share["low"], share["high"]) == pytest.approx((-limit, limit))


def test_means_that_are_all_alike_have_no_interval_and_one_that_is_not_brings_it_back(tmp_path):
    rows = [r for k in range(9) for r in pairs_of([(1.5, 1.0), (2.5, 2.0)], object_id=str(k))]
    time = of(compared(tmp_path / "alike", rows), "ttd_rmst_s")
    assert time["difference"] == 0.5
    assert time["interval"] == "all clusters alike"
    assert time[["low", "high", "interval_over"]].isna().all()
    time = of(compared(tmp_path / "other", [*rows, *pairs_of([(1.75, 1.0)], object_id="9")]), "ttd_rmst_s")
    assert (time["interval"], time["interval_over"]) == ("jackknife", "objects")
    assert 0.48 < time["low"] < 0.5 < time["high"] < 0.75


def test_a_median_of_which_nearly_all_are_alike_has_no_interval_either(tmp_path):
    rows = [r for k in range(20) for r in pairs_of([(1.0 + (k == 3), 1.0)], object_id=str(k))]
    distance = of(compared(tmp_path, rows), "dad_median_m")
    assert (distance["difference"], distance["interval"]) == (0.0, "all clusters alike")
    assert distance[["low", "high", "interval_over"]].isna().all()


def test_few_objects_have_no_interval_and_that_is_said(tmp_path):
    comparison = compared(tmp_path, [r for k in range(4) for r in pairs_of([(1.0, 0.0)] * 50, object_id=str(k))])
    assert comparison.table["low"].isna().all()
    assert comparison.table["interval_over"].isna().all()
    assert any(
        "no interval of detected_share, ttd_rmst_s, ttd_both_s, unknown_to_horizon_s, dad_median_m" in note
        for note in comparison.notes
    )


def test_a_single_run_of_a_single_object_has_no_interval(tmp_path):
    assert pd.isna(of(compared(tmp_path, pairs_of([(1.0, 0.0)])), "ttd_rmst_s")["interval_over"])


# --------------------------------------------------------------------------------------------------- always

RANDOM = np.random.default_rng(11)


def random_rows(names: Sequence[str], logs: int = 2) -> list[Row]:
    rows = []
    for log in range(logs):
        for name in names:
            for k in range(4):
                for run in range(3):
                    time = None if RANDOM.random() < 0.3 else float(RANDOM.uniform(0, 10))
                    verdict = {"conflict": k < 3, "braking_pass": bool(RANDOM.random() < 0.5)}
                    where = {"log": f"log{log}", "object_id": str(k), "run": run}
                    rows.append(row(name, time, None if time is None else 50 - time, **where, **verdict))
    return rows


def test_a_difference_of_means_is_the_difference_of_the_values(tmp_path):
    table = compared(tmp_path, random_rows(["ideal", "b", "c"]), braking=BRAKING).table
    means = table[table["metric"].isin(["detected_share", "ttd_rmst_s", "pass_share"])]
    assert set(means["log"]) == {"all", "log0", "log1"}
    assert len(means) == 3 * 2 * 3
    assert (means["value"] - means["baseline_value"]).tolist() == means["difference"].tolist()


def test_means_of_all_logs_are_those_of_the_logs_by_their_rows(tmp_path):
    table = compared(tmp_path, random_rows(["ideal", "b"], logs=3)).table
    times = table[table["metric"] == "ttd_rmst_s"].set_index("log")
    weighted = times["difference"] * times["n"]
    assert weighted.drop("all").sum() == pytest.approx(weighted["all"])


def test_the_same_rows_in_another_folder_differ_in_nothing(tmp_path):
    rows = [r | {"configuration": "x"} for r in random_rows(["x"], logs=3)]
    folders = [write_folder(tmp_path / name, rows, braking=BRAKING) for name in ("first", "second")]
    table = compare_folders(folders, baseline="first:x").table
    assert set(table["metric"]) == {
        "detected_share", "ttd_rmst_s", "ttd_both_s", "unknown_to_horizon_s", "dad_median_m", "pass_share",
    }  # fmt: skip
    assert (table["difference"] == 0.0).all()
    table = table[table["log"] == "all"].set_index("metric")
    # None of twelve objects in three logs differs, and of the nine in conflict none: 12/1.6 and 9/1.4 of them count.
    for metric, limit in (("detected_share", 1 - 0.025 ** (1.6 / 12)), ("pass_share", 1 - 0.025 ** (1.4 / 9))):
        assert tuple(table.loc[metric, ["low", "high"]]) == pytest.approx((-limit, limit), abs=1e-6)
        assert table.loc[metric, "interval"] == "exact"
    others = table.loc[["ttd_rmst_s", "ttd_both_s", "unknown_to_horizon_s", "dad_median_m"]]
    assert (others["interval"] == "all clusters alike").all()
    assert others[["low", "high", "interval_over"]].isna().all(axis=None)


def test_the_order_of_rows_does_not_matter(tmp_path):
    rows = random_rows(["ideal", "b"])
    straight = compared(tmp_path, rows, braking=BRAKING).table
    others = [rows[k] for k in np.random.default_rng(1).permutation(len(rows))]
    logs = {"log0": "content of log0", "log1": "content of log1"}
    shuffled = compared(tmp_path / "shuffled", others, braking=BRAKING, logs=logs).table
    numbers = ["value", "baseline_value", "difference", "low", "high"]
    assert shuffled[numbers].to_numpy() == pytest.approx(straight[numbers].to_numpy(), nan_ok=True)
    assert shuffled["metric"].tolist() == straight["metric"].tolist()


def test_rows_are_in_the_order_of_logs_configurations_and_metrics(tmp_path):
    table = compared(tmp_path, random_rows(["ideal", "z", "b"])).table
    assert table["log"].drop_duplicates().tolist() == ["all", "log0", "log1"]
    assert table["configuration"].drop_duplicates().tolist() == ["z", "b"]
    assert (
        table["metric"].tolist()
        == ["detected_share", "ttd_rmst_s", "ttd_both_s", "unknown_to_horizon_s", "dad_median_m"] * 6
    )
    assert (table["baseline"] == "ideal").all()


def test_censored_times_are_estimated_as_in_the_summary_and_without_each_object(tmp_path):
    """Without each object by itself: the rows of the others through the estimator of one sample."""
    rng = np.random.default_rng(12)
    rows, sides = [], {"late": {}, "ideal": {}}
    endings = {"log_end": CENSORED, "ego_left": CENSORED, "object_left": LEFT}
    for k in range(6):
        until, ended_by = float(rng.choice([3.0, 5.0, 7.0])), str(rng.choice(list(endings)))
        for run in range(4):
            for name in sides:
                at = round(float(rng.uniform(0, 8)), 3)
                known = at <= until
                rows.append(
                    row(name, at if known else None, 5.0 if known else None, object_id=str(k), run=run,
                        ended_s=until, ended_by=ended_by)
                )  # fmt: skip
                sides[name].setdefault(f"a\n{k}", []).append((at, DETECTED) if known else (until, endings[ended_by]))
    time = of(compared(tmp_path, rows), "ttd_rmst_s")

    def mean(name: str, drawn: Sequence[str]) -> float:
        times = [pair for key in drawn for pair in sides[name][key]]
        found = cumulative_incidence(np.array([t for t, _ in times]), np.array([e for _, e in times]))
        return restricted_mean(*found, 10.0)

    keys = sorted(sides["ideal"])
    assert time["value"] == pytest.approx(mean("late", keys))
    assert time["baseline_value"] == pytest.approx(mean("ideal", keys))
    expected = limits_of(keys, lambda drawn: mean("late", drawn) - mean("ideal", drawn))
    assert (time["low"], time["high"]) == pytest.approx(expected, abs=1e-9)


def test_all_metrics_of_a_pair_have_the_same_clusters_or_none(tmp_path):
    """Six logs, of which two have a distance: that is too few of them, not an occasion to take objects."""
    rows = [
        row(name, time if k < 4 else 2.0, 9.0 if k < 2 else None, log=f"log{k}")
        for k in range(6)
        for name, time in (("ideal", 1.0), ("late", 2.0))
    ]
    rows += [row(name, 1.0, None, log="log5", object_id="8") for name in ("ideal", "late")]
    comparison = compared(tmp_path, rows)
    assert of(comparison, "ttd_rmst_s")["interval_over"] == "logs"
    assert pd.isna(of(comparison, "dad_median_m")["interval_over"])
    assert set(comparison.table[comparison.table["log"] == "all"]["interval_over"].dropna()) == {"logs"}


def test_of_a_detection_and_a_censoring_at_one_time_the_detection_comes_first(tmp_path):
    """Both after 0.2 s: of two who are looked at then one is detected. 1 − 0.8 is less than that by a rounding."""
    assert 1 - 0.8 < 0.2
    censored = {"onset_s": 0.8, "ended_s": 1.0, "ended_by": "log_end"}
    rows = [row("ideal", 0.2, 30.0), row("late", 0.2, 30.0)]
    rows += [row(name, None, object_id="8", **censored) for name in ("ideal", "late")]
    time = of(compared(tmp_path, rows, measure={"horizon_used_s": 1.0}), "ttd_rmst_s")
    assert time["value"] == pytest.approx(0.2 + 0.5 * 0.8)


def test_some_metrics_are_those_of_all_and_an_open_folder_is_as_its_path(tmp_path):
    folder = write_folder(tmp_path / "study", random_rows(["ideal", "late", "later"]))
    every = compare_folders([folder]).table
    some = compare_folders([open_results(folder)], metrics=("dad_median_m", "ttd_rmst_s")).table
    expected = every[every["metric"].isin(["dad_median_m", "ttd_rmst_s"])].reset_index(drop=True)
    assert set(every["metric"]) > set(some["metric"])
    pd.testing.assert_frame_equal(some, expected)
    with pytest.raises(InputError, match="expected each folder once, found it twice"):
        compare_folders([open_results(folder), folder])

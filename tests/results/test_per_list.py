"""Comparisons of what is held at frames of the truth: errors, GOSPA; of ghosts, and of times at equal ghosts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from pyarrow import parquet

from copem_replay.results.compare import Comparison, compare_folders
from copem_replay.results.compare import pairing as lists_module
from tests.helpers.compare_folders import Row, ghosts, limits_of, row, seen, step, write_folder

FOUR = [None] * 4


def compared(
    path: Path, rows: Sequence[Row], *, false_positives_per_min: float | None = None, **given: Any
) -> Comparison:
    return compare_folders(
        [write_folder(path / "study", rows, **given)], false_positives_per_min=false_positives_per_min
    )


def of(comparison: Comparison, metric: str) -> Any:
    table = comparison.table
    found = table[(table["metric"] == metric) & (table["log"] == "all")]
    assert len(found) == 1
    return found.iloc[0]


# ------------------------------------------------------------------------------------------------- errors


def test_errors_are_compared_where_both_list_the_object(tmp_path):
    rows = [
        seen("ideal", [0, 1, None, 2], [*FOUR[:3], 1.0], age_s=0.125),
        seen("late", [3, None, 1, 4], [1.0] * 4, age_s=0.5),
    ]
    error = of(compared(tmp_path, rows), "position_rmse_held_m")
    assert error["n"] == 2
    assert error["value"] == pytest.approx(math.sqrt((9 + 16) / 2))
    assert error["baseline_value"] == pytest.approx(math.sqrt(4 / 2))
    assert error["difference"] == pytest.approx(math.sqrt(12.5) - math.sqrt(2))
    assert (error["only_configuration"], error["only_baseline"]) == (1, 1)
    assert (error["age_s"], error["baseline_age_s"]) == (0.5, 0.125)
    assert pd.isna(error["p_value"])


def test_frames_count_from_the_first_list_of_both_on_whatever_their_instants(tmp_path):
    """No list of the one is at an instant of the other. Of the late one none is there by 1 s, to a microsecond."""
    rows = [seen("ideal", [9, 9, 1, 2], [1.0] * 4), seen("late", [None, None, 3, 4], [1.0] * 4)]
    instants = {"ideal": [-0.5, 0.5, 1.5, 2.5], "late": [1.000002, 2.25]}
    comparison = compared(tmp_path, rows, available_s=instants)
    error = of(comparison, "position_rmse_held_m")
    assert (error["n"], error["frames"]) == (2, 2)
    assert error["value"] == pytest.approx(math.sqrt((9 + 16) / 2))
    assert error["baseline_value"] == pytest.approx(math.sqrt((1 + 4) / 2))
    assert not any("no frame" in note for note in comparison.notes)
    back = compare_folders([tmp_path / "study"], baseline="late")
    assert of(back, "position_rmse_held_m")["difference"] == pytest.approx(-error["difference"])


def test_a_list_at_a_frame_to_a_microsecond_is_there(tmp_path):
    rows = [seen(name, [1] * 4, [1.0] * 4) for name in ("ideal", "late")]
    late = {"late": [1.0000005, 2.0, 3.0]}
    assert of(compared(tmp_path, rows, available_s=late), "position_rmse_held_m")["frames"] == 3


def test_columns_begin_at_the_frame_they_say(tmp_path):
    rows = [
        seen("ideal", [1, 2], [1.0] * 2, first_frame=1), seen("late", [3, 5], [1.0] * 2, first_frame=1),
    ]  # fmt: skip
    error = of(compared(tmp_path, rows, available_s={"late": [1.5]}), "position_rmse_held_m")  # the frame 2 s
    assert (error["value"], error["baseline_value"], error["n"]) == (5.0, 2.0, 1)


def test_frames_without_a_list_stay_and_are_counted(tmp_path):
    """The late list of 0 s is 2 s old at the third frame: nothing is held, GOSPA has the miss."""
    rows = [seen("ideal", [1] * 4, [1.0] * 4), seen("late", [1, 1, None, None], [4.0, 4.0, 9.0, 9.0])]
    comparison = compared(tmp_path, rows, available_s={"late": [0.0]})
    for metric in ("position_rmse_held_m", "gospa_held_m"):
        row = of(comparison, metric)
        assert (row["frames"], row["no_list_share"], row["baseline_no_list_share"]) == (4, 0.5, 0.0)
    assert of(comparison, "position_rmse_held_m")["n"] == 2
    assert of(comparison, "gospa_held_m")["value"] == pytest.approx(math.sqrt((4 + 4 + 9 + 9) / 4))


def test_who_has_issued_nothing_is_not_compared(tmp_path):
    rows = [seen("ideal", [1] * 4, [1] * 4), seen("late", FOUR, [1] * 4)]
    comparison = compared(tmp_path, rows, available_s={"late": []})
    for metric in ("position_rmse_held_m", "gospa_held_m"):
        assert of(comparison, metric)["n"] == of(comparison, metric)["frames"] == 0
        assert pd.isna(of(comparison, metric)["difference"])
    assert "late: no frame at which an object is measured and both sides have issued a list" in comparison.notes


def test_entries_without_a_true_object_are_counted(tmp_path):
    rows = [seen(name, [1] * 4, [1.0] * 4) for name in ("ideal", "late")]
    lists = [ghosts("ideal", 0), ghosts("late", 0, without_truth=7)]
    error = of(compared(tmp_path, rows, lists=lists), "position_rmse_held_m")
    assert (error["without_truth"], error["baseline_without_truth"]) == (7, 0)


def test_a_log_that_lacks_a_configuration_adds_nothing(tmp_path):
    rows = [seen("ideal", [1] * 4, [1.0] * 4, log=log) for log in ("a", "b")]
    rows.append(seen("late", [2] * 4, [1.0] * 4, log="a"))
    folder = write_folder(tmp_path / "study", rows)
    table = parquet.read_table(folder / "instants.parquet").to_pandas()
    kept = table[(table["log"] == "a") | (table["configuration"] == "ideal")]
    parquet.write_table(pa.Table.from_pandas(kept, preserve_index=False), folder / "instants.parquet")
    comparison = compare_folders([folder])
    error = of(comparison, "position_rmse_held_m")
    assert (error["n"], error["frames"], error["value"]) == (4, 4, 2.0)
    assert "log b: late: no frame at which an object is measured and both sides have issued a list" in comparison.notes


def test_counts_of_several_logs_add_up(tmp_path):
    rows = [
        seen("ideal", [1] * 4, [1.0] * 4, log="a"), seen("late", [1, 1, None, None], [1.0] * 4, log="a", age_s=1.0),
        seen("ideal", [1] * 4, [1.0] * 4, log="b"), seen("late", [1] * 4, [1.0] * 4, log="b", age_s=0.25),
    ]  # fmt: skip
    error = of(compared(tmp_path, rows), "position_rmse_held_m")
    assert (error["n"], error["frames"], error["only_baseline"]) == (6, 8, 2)
    assert error["age_s"] == pytest.approx((2 * 1.0 + 4 * 0.25) / 6)


def test_errors_of_objects_are_left_out_whole(tmp_path):
    rng = np.random.default_rng(3)
    errors = {str(k): rng.uniform(0, 2 + k, (2, 4)).astype(np.float32) for k in range(5)}
    rows = [
        seen(name, [float(e) for e in errors[key][side]], FOUR, object_id=key)
        for key in errors
        for side, name in enumerate(("late", "ideal"))
    ]
    error = of(compared(tmp_path, rows), "position_rmse_held_m")

    def regret(drawn: list[str]) -> float:
        both = np.concatenate([errors[key[2:]] for key in drawn], axis=1).astype(float)
        first, second = np.sqrt((both**2).mean(axis=1))
        return float(first - second)

    assert (error["interval"], error["interval_over"]) == ("jackknife", "objects")
    expected = limits_of([f"a\n{key}" for key in errors], regret)
    assert (error["low"], error["high"]) == pytest.approx(expected, abs=1e-8)


# -------------------------------------------------------------------------------------------------- GOSPA


def two_objects() -> list[Row]:
    return [
        seen("ideal", FOUR, [1, 1, 1, 1]),
        seen("ideal", FOUR, [None, None, 3, 3], object_id="8"),
        seen("late", FOUR, [4, 4, 4, 4]),
        seen("late", FOUR, [None, None, 0, 0], object_id="8"),
    ]


def test_gospa_is_the_root_of_the_mean_over_frames_of_the_sum_over_objects(tmp_path):
    gospa = of(compared(tmp_path, two_objects()), "gospa_held_m")
    assert gospa["n"] == 4
    assert gospa["value"] == pytest.approx(math.sqrt(16 / 4))
    assert gospa["baseline_value"] == pytest.approx(math.sqrt(10 / 4))
    assert gospa["difference"] == pytest.approx(2 - math.sqrt(2.5))


def test_gospa_has_the_power_of_the_experiment(tmp_path):
    of_power = {"gospa": {"cutoff_m": 2.0, "power": 1.0}}
    assert of(compared(tmp_path, two_objects(), measure=of_power), "gospa_held_m")["difference"] == 4.0 - 2.5


def test_frames_at_which_nobody_is_measured_do_not_count(tmp_path):
    rows = [seen(name, FOUR, [None, None, part, part]) for name, part in (("ideal", 1), ("late", 9))]
    gospa = of(compared(tmp_path, rows), "gospa_held_m")
    assert (gospa["value"], gospa["baseline_value"], gospa["n"]) == (3.0, 1.0, 2)


def test_an_object_that_no_frame_measures_is_no_cluster(tmp_path):
    rows = [
        seen(name, FOUR, [1.0 if k < 4 else None] * 4, object_id=str(k)) for k in range(5) for name in ("ideal", "late")
    ]
    comparison = compared(tmp_path, rows)
    assert of(comparison, "detected_share")["interval_over"] == "objects"
    assert pd.isna(of(comparison, "gospa_held_m")["interval_over"])


def test_each_run_has_its_frames(tmp_path):
    rows = [
        seen(name, FOUR[:2], [part + run] * 2, run=run) for name, part in (("ideal", 1), ("late", 4)) for run in (0, 1)
    ]
    gospa = of(compared(tmp_path, rows), "gospa_held_m")
    assert gospa["n"] == 4
    assert gospa["difference"] == pytest.approx(math.sqrt(4.5) - math.sqrt(1.5))


def test_without_an_object_the_number_of_frames_is_as_it_was(tmp_path):
    parts = {str(k): (float(k), 1.0) for k in range(5)}
    rows = [
        seen(name, FOUR, [parts[key][side]] * 4, object_id=key)
        for key in parts
        for side, name in enumerate(("late", "ideal"))
    ]
    gospa = of(compared(tmp_path, rows), "gospa_held_m")
    # Every frame has five objects: without one the others stand for it.

    def regret(drawn: list[str]) -> float:
        some, times = [parts[key[2:]] for key in drawn], 5 / len(drawn)
        return math.sqrt(times * sum(a for a, _ in some)) - math.sqrt(times * sum(b for _, b in some))

    expected = limits_of([f"a\n{key}" for key in parts], regret)
    assert gospa["difference"] == pytest.approx(math.sqrt(10) - math.sqrt(5))
    assert (gospa["low"], gospa["high"]) == pytest.approx(expected, abs=1e-8)


def test_frames_are_paired_part_by_part_as_well_as_at_once(tmp_path, monkeypatch):
    rng = np.random.default_rng(4)
    rows = [
        seen(
            name, [float(e) if e > 0.5 else None for e in rng.uniform(0, 3, 4)], [1.0, 2.0, 3.0, 4.0], object_id=str(k)
        )
        for k in range(7)
        for name in ("ideal", "late")
    ]
    whole = compared(tmp_path, rows).table
    monkeypatch.setattr(lists_module, "_VALUES", 5)
    assert compare_folders([tmp_path / "study"]).table.equals(whole)


# ------------------------------------------------------------------------------------------------- ghosts


def test_ghosts_per_minute_are_of_all_minutes(tmp_path):
    rows = [row(name, 1.0, 30.0, run=run) for name in ("ideal", "late") for run in (0, 1)]
    half = {"minutes": 0.5}
    lists = [
        ghosts("ideal", 1, **half), ghosts("ideal", 1, run=1, **half),
        ghosts("late", 3, **half), ghosts("late", 5, run=1, **half),
    ]  # fmt: skip
    rate = of(compared(tmp_path, rows, lists=lists), "false_positives_per_min")
    assert (rate["value"], rate["baseline_value"], rate["difference"], rate["n"]) == (8.0, 2.0, 6.0, 2)
    assert pd.isna(rate["interval_over"])


def test_ghosts_go_with_the_object_that_is_nearest_and_the_others_stay(tmp_path):
    nearest = {str(k): k for k in range(5)}  # ten of them; three more are near nobody
    rows = [
        seen(name, FOUR, FOUR, object_id=key, ghosts=near if name == "late" else 0)
        for key, near in nearest.items()
        for name in ("ideal", "late")
    ]
    rate = of(compared(tmp_path, rows, lists=[ghosts("ideal", 0), ghosts("late", 13)]), "false_positives_per_min")
    expected = limits_of(
        [f"a\n{key}" for key in nearest], lambda drawn: 3 + sum(nearest[key[2:]] for key in drawn) * 5 / len(drawn)
    )
    assert rate["difference"] == 13.0
    assert rate["interval_over"] == "objects"
    assert (rate["low"], rate["high"]) == pytest.approx(expected)


def test_where_it_is_not_known_whose_ghosts_they_are_objects_are_no_clusters(tmp_path):
    rows = [row(name, 1.0, 30.0, object_id=str(k)) for name in ("ideal", "late") for k in range(5)]
    comparison = compared(tmp_path, rows, lists=[ghosts("ideal", 0), ghosts("late", 13)])
    assert of(comparison, "detected_share")["interval_over"] == "objects"
    assert pd.isna(of(comparison, "false_positives_per_min")["interval_over"])
    assert [note for note in comparison.notes if note.startswith("no interval of false")] == [
        "no interval of false_positives_per_min: without accuracy.parquet it is not known which object a ghost is "
        "nearest to"
    ]


def test_ghosts_of_one_object_are_left_out_by_run(tmp_path):
    counts = [0, 2, 4, 6, 8]
    rows = [row(name, 1.0, 30.0, run=run) for name in ("ideal", "late") for run in range(5)]
    lists = [ghosts("late", n, run=run) for run, n in enumerate(counts)]
    lists += [ghosts("ideal", 1, run=run) for run in range(5)]
    rate = of(compared(tmp_path, rows, lists=lists), "false_positives_per_min")
    expected = limits_of(
        [str(k) for k in range(5)], lambda drawn: float(np.mean([counts[int(run)] for run in drawn])) - 1
    )
    assert (rate["difference"], rate["interval_over"]) == (3.0, "runs")
    assert (rate["low"], rate["high"]) == pytest.approx(expected)


# -------------------------------------------------------------------------------------- at equal ghosts

LISTS = [ghosts("ideal", 0), ghosts("late", 60, existence=[0.0, 0.5, 0.9], ghosts_at=[60, 20, 0])]
STEPS = [step("ideal", 1.0, 0.5), step("late", 0.4, 1.0), step("late", 0.7, 3.0)]


def at_equal_ghosts(path: Path, per_min: float | None, *, lists: Sequence[Row] = LISTS, **of_late: Any) -> Comparison:
    rows = [row("ideal", 0.5, 30.0), row("late", 1.0, 30.0, **of_late)]
    return compared(path, rows, lists=lists, steps=STEPS, false_positives_per_min=per_min)


@pytest.mark.parametrize(
    ("per_min", "existence", "time_s", "kept"),
    [
        (60, 0.0, 1.0, 60),
        (90, 0.0, 1.0, 60),  # there are no more
        (
            50,
            0.0,
            0.75 * 1.0 + 0.25 * 3.0,
            50,
        ),  # (50 − 20) / (60 − 20) of the drives with 60 a minute, the rest with 20
        (20, 0.5, 3.0, 20),
        (10, 0.5, 0.5 * 3.0 + 0.5 * 10.0, 10),
    ],
)
def test_times_are_at_exactly_so_many_ghosts(tmp_path, per_min, existence, time_s, kept):
    comparison = at_equal_ghosts(tmp_path, per_min)
    time = of(comparison, "ttd_rmst_s_equal_ghosts")
    assert time["existence"] == existence
    assert time["baseline_existence"] == 0.0
    assert (time["ghosts_kept_per_min"], time["baseline_ghosts_kept_per_min"]) == (kept, 0)
    assert (time["value"], time["baseline_value"], time["difference"]) == (time_s, 0.5, time_s - 0.5)
    said = [note for note in comparison.notes if "all entries make only" in note]
    assert [note for note in said if note.startswith("late")] == (
        ["late: all entries make only 60 ghosts per minute: ttd_rmst_s_equal_ghosts is at that rate"]
        if kept < per_min
        else []
    )


def test_the_rate_is_the_baselines_own_unless_given(tmp_path):
    lists = [ghosts("ideal", 20, existence=[0.0, 0.5, 0.9], ghosts_at=[20, 0, 0]), LISTS[1]]
    comparison = at_equal_ghosts(tmp_path, None, lists=lists)
    assert comparison.false_positives_per_min == 20.0
    assert of(comparison, "ttd_rmst_s_equal_ghosts")["existence"] == 0.5
    back = compare_folders([tmp_path / "study"], baseline="late")
    assert back.false_positives_per_min == 60.0
    assert of(back, "ttd_rmst_s_equal_ghosts")["difference"] == -0.5


def test_an_entry_at_the_threshold_is_not_left_out(tmp_path):
    lists = [LISTS[0], ghosts("late", 60, existence=[0.0, 0.7], ghosts_at=[60, 20])]
    assert of(at_equal_ghosts(tmp_path, 20, lists=lists), "ttd_rmst_s_equal_ghosts")["value"] == 3.0


def test_who_is_no_longer_detected_is_censored_as_in_any_other_mean(tmp_path):
    still = {"ended_by": "log_end", "ended_s": 7.0}
    lists = [LISTS[0], ghosts("late", 60, existence=[0.0, 0.8], ghosts_at=[60, 20])]
    assert of(at_equal_ghosts(tmp_path, 20, lists=lists, **still), "ttd_rmst_s_equal_ghosts")["value"] == 10.0


def test_where_no_threshold_is_clean_enough_nothing_is_listed_in_some_drives(tmp_path):
    lists = [LISTS[0], ghosts("late", 60, existence=[0.0, 0.5], ghosts_at=[60, 20])]
    time = of(at_equal_ghosts(tmp_path, 10, lists=lists), "ttd_rmst_s_equal_ghosts")
    assert (time["existence"], time["ghosts_kept_per_min"]) == (0.5, 10)
    assert time["value"] == 0.5 * 3.0 + 0.5 * 10.0  # half of the drives at 20 a minute, in half of them nothing


NONE = "no ttd_rmst_s_equal_ghosts: "
SURE = [step("ideal", 1.0, 0.5), step("late", 0.9, 3.0)]


@pytest.mark.parametrize(
    ("per_min", "lists", "steps", "why"),
    [
        (0, LISTS, STEPS, f"late: {NONE}fewer than 10 ghosts would decide"),
        (9.9, LISTS, STEPS, f"late: {NONE}fewer than 10 ghosts would decide"),
        (None, [ghosts("ideal", 9), LISTS[1]], STEPS, f"late: {NONE}fewer than 10 ghosts would decide"),
        (
            20,
            [ghosts("ideal", 0), ghosts("late", 60, existence=[0.0, 0.89, 0.91], ghosts_at=[60, 60, 0])],
            SURE,
            f"late: {NONE}all entries claim the same existence, so that none is left out before the others",
        ),
        (
            20,
            [ghosts("ideal", 60, existence=[0.0, 1.0], ghosts_at=[60, 60]), ghosts("late", 20)],
            SURE,
            f"late: {NONE}of the baseline, all entries claim the same existence, so that none is left out before "
            "the others",
        ),
    ],
)
def test_where_equal_ghosts_say_nothing_there_is_none(tmp_path, per_min, lists, steps, why):
    rows = [row("ideal", 0.5, 30.0), row("late", 1.0, 30.0)]
    comparison = compared(tmp_path, rows, lists=lists, steps=steps, false_positives_per_min=per_min)
    assert why in comparison.notes
    assert "ttd_rmst_s_equal_ghosts" not in set(comparison.table["metric"])
    assert "false_positives_per_min" in set(comparison.table["metric"])


def test_of_the_truth_nothing_is_at_equal_ghosts(tmp_path):
    rows = [row("ideal", 0.5, 30.0), row("late", 1.0, 30.0)]
    folder = write_folder(tmp_path / "study", rows, lists=LISTS, steps=STEPS, facts={"ideal": {"truth": True}})
    comparison = compare_folders([folder], false_positives_per_min=20)
    assert f"late: {NONE}the baseline is the truth, which has no ghosts" in comparison.notes
    assert "ttd_rmst_s_equal_ghosts" not in set(comparison.table["metric"])


def test_the_threshold_is_that_of_all_logs_in_each_of_them(tmp_path):
    rows = [row(name, 1.0, 30.0, log=log) for name in ("ideal", "late") for log in ("a", "b")]
    steps = [step(name, 1.0, 1.0, log=log) for name in ("ideal", "late") for log in ("a", "b")]
    lists = [ghosts("ideal", 20, log=log) for log in ("a", "b")]
    lists += [
        ghosts("late", n, log=log, existence=[0.0, 0.5, 0.8], ghosts_at=[n, at, 0])
        for log, n, at in (("a", 90, 40), ("b", 10, 0))
    ]
    table = compared(tmp_path, rows, lists=lists, steps=steps).table
    times = table[table["metric"] == "ttd_rmst_s_equal_ghosts"]
    # 20 a minute of both logs: 40 of `a` and none of `b`, though one log alone has more and the other fewer.
    assert times["existence"].tolist() == [0.5, 0.5, 0.5]
    assert times["ghosts_kept_per_min"].tolist() == [20.0, 20.0, 20.0]


def test_the_same_folder_again_differs_in_nothing(tmp_path):
    rng = np.random.default_rng(9)
    where = [{"object_id": str(k), "run": run} for k in range(6) for run in range(2)]
    rows = [
        seen("x", [float(e) for e in rng.uniform(0, 2, 4)], [float(g) for g in rng.uniform(0, 4, 4)], ghosts=1, **w)
        for w in where
    ]
    lists = [ghosts("x", 20 + run, run=run, existence=[0.0, 0.5], ghosts_at=[20 + run, 3]) for run in range(2)]
    steps = [step("x", 0.9, 0.0, **w) for w in where]
    folders = [write_folder(tmp_path / name, rows, lists=lists, steps=steps) for name in ("first", "second")]
    comparison = compare_folders(folders, baseline="first:x")
    assert comparison.table["metric"].tolist() == [
        "detected_share", "ttd_rmst_s", "ttd_both_s", "unknown_to_horizon_s", "ttd_rmst_s_equal_ghosts",
        "dad_median_m",
        "position_rmse_held_m", "gospa_held_m", "false_positives_per_min",
    ]  # fmt: skip
    assert (comparison.table["difference"] == 0.0).all()
    # None of six can differ, one way or the other, where up to 46 % of all do: 1 − 0.025^(1/6).
    share = of(comparison, "detected_share")
    assert (share["low"], share["high"]) == pytest.approx((-0.459258, 0.459258), abs=1e-6)
    assert share["interval"] == "exact"
    others = comparison.table[comparison.table["metric"] != "detected_share"]
    assert (others["interval"] == "all clusters alike").all()
    assert others[["low", "high", "interval_over"]].isna().all(axis=None)
    assert comparison.notes == ()

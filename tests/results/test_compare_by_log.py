"""Log by log is the same as pair by pair: random studies against plain loops, in files and folders, in any order."""

from __future__ import annotations

from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyarrow import compute, parquet

from copem_replay.results.compare import compare_folders
from copem_replay.results.compare.compare import PairsAsked
from copem_replay.results.table_files import table_file
from tests.helpers.compare_folders import BRAKING, Row, ghosts, limits_of, row, step, write_folder
from tests.oracles import compare as oracle
from tests.oracles import intervals

OF_INTERVALS = (
    "low_bounded",
    "high_bounded",
    "star",
    "low",
    "high",
    "interval",
    "interval_over",
    "clusters",
    "logs_better",
    "hangs_on",
    "difference_without_it",
)
INSTANTS = {"ideal": [0.0, 1.0, 2.0, 3.0], "late": [0.5, 1.0]}
"""At the frame 0 s the late one has issued nothing, at 3 s its newest list is too old to be held."""


def study(seed: int, logs: int, fewest: int = 0) -> dict[str, Any]:
    """Rows of every table, on grids: ties, never, gaps, objects that one side lacks, a log without any."""
    rnd = Random(seed)
    runs = rnd.randint(1, 3)
    rows: list[Row] = []
    for log in "abcdef"[:logs]:
        for thing in range(rnd.randint(fewest if rows else 1, 3)):
            of = {"onset_s": rnd.choice([0.0, 1.0]), "ended_s": rnd.choice([6.0, 10.0]), "object_id": str(thing)}
            of |= {"ended_by": rnd.choice(["object_left", "log_end"]), "log": log, "conflict": rnd.random() < 0.7}
            of["first_frame"] = rnd.randint(0, 2)
            present = [rnd.random() < 0.8 for _ in range(rnd.randint(0, 4 - of["first_frame"]))]
            rows += [
                one(rnd, name, run, of, present)
                for name in (["ideal", "late"] if not rows or rnd.random() < 0.8 else [rnd.choice(["ideal", "late"])])
                for run in range(runs)
            ]
    lists, steps = [], []
    for name in ("ideal", "late"):
        for log in "abcdef"[:logs]:
            for run in range(runs):
                near = sum(r["ghosts"] for r in rows if (r["configuration"], r["log"], r["run"]) == (name, log, run))
                count = near + rnd.randint(0, 30)
                at = {"existence": [0.0, 0.5], "ghosts_at": [count, rnd.randint(0, count)]}
                lists.append(ghosts(name, count, log=log, run=run, minutes=rnd.choice([0.25, 0.5, 1.0]), **at))
    for r in rows:
        if r["detected"]:
            seen = {name: r[name] for name in ("log", "run", "object_id")}
            steps.append(step(r["configuration"], rnd.choice([0.25, 0.75]), r["detection_s"], **seen))
    names = {log: f"content of {log}" for log in "abcdef"[:logs]}
    return {"rows": rows, "lists": lists, "steps": steps, "logs": names, "available_s": INSTANTS, "braking": BRAKING}


def one(rnd: Random, name: str, run: int, of: Row, present: list[bool]) -> Row:
    """A row, and what is held of it; `present`: frames at which the truth has the object."""
    seen_s = rnd.choice([None, of["onset_s"] + 0.5, of["onset_s"] + 2.0, of["onset_s"] + 2.25])
    error_m = [rnd.choice([None, 0.5, 1.0, 3.0]) if there else None for there in present]
    return row(name, seen_s, rnd.choice([None, 10.0, 20.0, 20.5]), run=run, **of) | {
        "braking_pass": rnd.random() < 0.5,
        "error_held_m": error_m,
        "age_held_s": [None if error is None else rnd.choice([0.0, 0.25, 0.5]) for error in error_m],
        "gospa_held_m2": [rnd.choice([1.0, 2.25]) if there else None for there in present],
        "ghosts": rnd.randint(0, 3),
    }


seeds, log_counts = st.integers(0, 2**32 - 1), st.sampled_from([1, 2, 3, 5])


@settings(max_examples=25)  # each writes folders and compares them
@given(seeds, log_counts)
def test_figures_are_those_of_pairs_one_by_one(seed, count):
    given_study = study(seed, count)
    rows, lists = given_study["rows"], given_study["lists"]
    with TemporaryDirectory() as scratch:
        table = compare_folders([write_folder(Path(scratch) / "study", **given_study)]).table
    logs = list(given_study["logs"])
    for log in ["all", *(logs if len(logs) > 1 else [])]:
        there = [log] if log != "all" else logs
        mine = table[table["log"] == log].set_index("metric")
        found = [pair for pair in oracle.pairs(rows, "late", "ideal") if pair[0]["log"] in there]
        judged = [pair for pair in found if pair[0]["conflict"]]
        both = [of for of in lists if of["log"] in there]

        def is_as(metric: str, expected: Any, n: int, mine: pd.DataFrame = mine) -> None:
            got = mine.loc[metric, ["value", "baseline_value", "difference"]].tolist()
            if expected is None:
                assert np.isnan(np.array(got, dtype=float)).all()
            else:
                value, other, *difference = expected
                wanted = [value, other, *(difference or [value - other])]
                wanted = [v if np.isfinite(v) else np.nan for v in wanted]
                assert got == pytest.approx(wanted, abs=1e-9, nan_ok=True), metric
            assert mine.loc[metric, "n"] == n

        is_as("detected_share", oracle.share(found, "detected") if found else None, len(found))
        is_as("ttd_rmst_s", oracle.restricted_means(found) if found else None, len(found))
        is_as("dad_median_m", oracle.medians(found), len(oracle.distances(found)))
        is_as("pass_share", oracle.share(judged, "braking_pass") if judged else None, len(judged))
        only = [(pair[0]["braking_pass"], pair[1]["braking_pass"]) for pair in judged]
        counts = mine.loc["pass_share", ["only_configuration", "only_baseline"]].tolist()
        assert counts == [only.count((True, False)), only.count((False, True))]
        is_as("position_rmse_held_m", *oracle.position_rmse(found, INSTANTS))
        is_as("gospa_held_m", *oracle.gospa(found, INSTANTS))
        beside = oracle.beside_held(found, INSTANTS)
        assert mine.loc["position_rmse_held_m", list(beside)].astype(float).to_dict() == pytest.approx(
            beside, nan_ok=True
        )
        minutes = len({(of["log"], of["run"]) for of in both})
        is_as("false_positives_per_min", oracle.ghosts_per_min(both, "late", "ideal"), minutes)


@settings(max_examples=8)  # each writes folders and compares them
@given(seeds, st.sampled_from([3, 5]))
def test_intervals_leave_out_whole_logs(seed, count):
    given_study = study(seed, count, fewest=2)
    with TemporaryDirectory() as scratch:
        table = compare_folders([write_folder(Path(scratch) / "study", **given_study)]).overall.set_index("metric")
    found = oracle.pairs(given_study["rows"], "late", "ideal")
    logs = sorted({pair[0]["log"] for pair in found})
    if len(logs) < 3:
        assert table["interval_over"].isna().all()
        return
    of_log = {log: [pair for pair in found if pair[0]["log"] == log] for log in logs}
    objects = [len({pair[0]["object_id"] for pair in of}) for of in of_log.values()]
    of_metric = {"detected_share": lambda drawn: oracle.share(drawn, "detected"), "ttd_rmst_s": oracle.restricted_means}
    for metric, figure in of_metric.items():

        def difference(names: list[str], figure: Any = figure) -> float:
            return figure([pair for name in names for pair in of_log[name]])[2]

        row = table.loc[metric]
        if row["interval"] == "jackknife":
            bound = (
                1.0 if metric == "detected_share" else 10.0
            )  # never counts as 10 s, the earliest time is not below 0
            wanted = np.clip(limits_of(logs, difference, objects), -bound, bound)
            assert [row["low"], row["high"]] == pytest.approx(wanted, abs=1e-9)
            assert (row["interval_over"], row["clusters"]) == ("logs", len(logs))
            better = 1 if metric == "detected_share" else -1
            assert row["logs_better"] == sum(better * difference([log]) > 1e-12 for log in logs)
            left = {log: difference([other for other in logs if other != log]) for log in logs}
            signed = {log: value * np.sign(row["difference"]) for log, value in left.items()}
            if abs(row["difference"]) > 1e-9 and min(signed.values()) < abs(row["difference"]) / 2 - 1e-9:
                assert signed[row["hangs_on"]] == pytest.approx(min(signed.values()))
                assert row["difference_without_it"] == pytest.approx(left[row["hangs_on"]])
            elif min(signed.values()) > abs(row["difference"]) / 2 + 1e-9:
                assert pd.isna(row["hangs_on"])


@settings(max_examples=8)  # each writes folders and compares them
@given(seeds, st.sampled_from([2, 3, 5]))
def test_where_drives_weigh_alike_shares_are_means_of_the_drives_own(seed, count):
    """What is over lists, pairs and minutes stays as it is."""
    with TemporaryDirectory() as scratch:
        folder = write_folder(Path(scratch) / "study", **study(seed, count, fewest=1))
        once, rows = (compare_folders([folder], asked=PairsAsked(weigh=weigh)).table for weigh in ("drives", "objects"))
    overall = once[once["log"] == "all"].set_index("metric")
    for metric in ("detected_share", "pass_share", "unknown_to_horizon_s"):
        of_logs = once.loc[(once["log"] != "all") & (once["metric"] == metric), ["value", "baseline_value"]].dropna()
        wanted = of_logs.astype(float).mean().tolist()
        assert overall.loc[metric, ["value", "baseline_value"]].tolist() == pytest.approx(wanted, nan_ok=True), metric
    held = ["position_rmse_held_m", "gospa_held_m", "false_positives_per_min"]
    as_before = (of[of["metric"].isin(held)].drop(columns="star") for of in (once, rows))  # of the whole table
    pd.testing.assert_frame_equal(*as_before)
    assert once["n"].tolist() == rows["n"].tolist()


@settings(max_examples=6)  # each writes folders and compares them
@given(seeds)
def test_more_runs_do_not_narrow_intervals_over_logs(seed):
    """The same again as further runs, as often: no limit moves."""
    once = study(seed, 3, fewest=2)
    runs = max(of["run"] for of in once["rows"]) + 1
    twice = once | {
        name: [of | {"run": of["run"] + k * runs} for k in range(2) for of in once[name]]
        for name in ("rows", "lists", "steps")
    }
    with TemporaryDirectory() as scratch:
        one, two = (
            compare_folders([write_folder(Path(scratch) / name, **of)]).overall.set_index("metric")
            for name, of in (("once", once), ("twice", twice))
        )
    over_logs = one.index[one["interval_over"] == "logs"].difference(["ttd_rmst_s_equal_ghosts"])
    for name in ("low", "high", "clusters", "difference_without_it"):
        found = two.loc[over_logs, name].astype(float).to_numpy()
        assert found == pytest.approx(one.loc[over_logs, name].astype(float).to_numpy(), abs=1e-9, nan_ok=True)


@settings(max_examples=10)  # each writes folders and compares them
@given(seeds)
def test_limits_of_medians_are_those_of_shares_inverted(seed):
    rnd = Random(seed)
    of_log: dict[str, list[tuple[float, str]]] = {}
    rows = []
    for log in "abcd":
        for thing in "12345"[: rnd.randint(2, 5)]:
            for run in range(2):
                far_m = rnd.choice([10.0, 12.0, 15.0, 15.5, 30.0])
                of_log.setdefault(log, []).append((far_m - 11.0, thing))
                of = {"log": log, "object_id": thing, "run": run}
                rows += [row("late", 1.0, far_m, **of), row("ideal", 1.0, 11.0, **of)]
    with TemporaryDirectory() as scratch:
        found = compare_folders([write_folder(Path(scratch) / "study", rows)]).overall.set_index("metric")
    of_median = found.loc["dad_median_m"]
    low, high = intervals.median(of_log)
    if low == high:
        assert of_median["interval"] == "all clusters alike"
        return
    wanted = [limit if np.isfinite(limit) else np.nan for limit in (low, high)]
    assert [of_median["low"], of_median["high"]] == pytest.approx(wanted, nan_ok=True)
    if np.isfinite(low) or np.isfinite(high):
        assert (of_median["interval"], of_median["interval_over"]) == ("inverted", "logs")


@settings(max_examples=15)  # each writes folders and compares them
@given(seeds, log_counts)
def test_files_folders_and_orders_are_alike(seed, count):
    """Rows of logs among each other, of small row groups, or in a file for each log."""
    given_study, rnd = study(seed, count), Random(seed)
    with TemporaryDirectory() as scratch:
        folder = write_folder(Path(scratch) / "study", **given_study)
        whole = compare_folders([folder], false_positives_per_min=5.0)
        order = list(range(len(given_study["rows"])))
        rnd.shuffle(order)
        for name in ("detections.parquet", "accuracy.parquet"):
            table = parquet.read_table(folder / name).take(order)
            parquet.write_table(table, folder / name, row_group_size=rnd.randint(1, 4))
        shuffled = compare_folders([folder], false_positives_per_min=5.0)
        table = parquet.read_table(folder / "detections.parquet")
        (folder / "detections.parquet").unlink()
        (folder / "detections.parquet").mkdir()
        for log in table["log"].unique().to_pylist():
            mine = table.filter(compute.equal(table["log"], log))
            parquet.write_table(mine, table_file(folder / "detections.parquet", log))
        apart = compare_folders([folder], false_positives_per_min=5.0)
    for other in (shuffled, apart):
        pd.testing.assert_frame_equal(other.table, whole.table, check_exact=True)
        assert other.notes == whole.notes


@settings(max_examples=15)  # each writes folders and compares them
@given(seeds)
def test_runs_told_as_logs_give_the_same_over_all(seed):
    """What one log says in several runs several logs say in one run each."""
    given_study = study(seed, 1)
    rows = given_study["rows"]
    runs = sorted({of["run"] for of in rows})
    logs = {name: f"content of {name}" for name in (f"run {run}" for run in runs)}
    apart = (
        given_study
        | {"logs": logs}
        | {
            name: [of | {"log": f"run {of['run']}", "run": 0} for of in given_study[name]]
            for name in ("rows", "lists", "steps")
        }
    )
    with TemporaryDirectory() as scratch:
        one, several = (
            compare_folders([write_folder(Path(scratch) / name, **of)], false_positives_per_min=5.0).overall
            for name, of in (("one", given_study), ("several", apart))
        )
    columns = [name for name in one.columns if name not in OF_INTERVALS]
    pd.testing.assert_frame_equal(
        one[columns].reset_index(drop=True), several[columns].reset_index(drop=True), rtol=1e-12
    )

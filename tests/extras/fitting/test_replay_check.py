"""The replay check: statistics of a pass by hand, uniform ranks of a right model, what a memoryless one fails at."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from copem_replay.core.memory import MemoryPart
from copem_replay.core.tracks import CLASSES
from copem_replay.extras.fitting.replay_check import (
    STATISTICS,
    TOTALS,
    Statistics,
    compare_statistics,
    compare_totals,
    compute_statistics,
    compute_totals,
    remove_memory,
    replay_check,
    simulate_lists,
)
from copem_replay.extras.fitting.rows import FitLists, FitRows
from copem_replay.perception.config import PoseError
from copem_replay.perception.pem.model import Pem
from tests.extras.fitting import fit_rows
from tests.extras.fitting.detection_rows import lists_of, passes, rows_of, view_of

SHARE, TAU_S = 0.8, 1.0


def flat(view: object) -> np.ndarray:
    return np.full(len(view.range_m), 0.7)  # type: ignore[attr-defined]


def pem_of(probability: float = 0.7, sigma_m: float = 0.5) -> Pem:
    error = {"kind": "gaussian", "covariance_m2": [[sigma_m**2, 0.0], [0.0, sigma_m**2]]}
    couple = {"detection": {"kind": "constant", "probability": probability}, "error": error}
    memory = {
        "detection": [{"share": SHARE, "correlation_s": TAU_S}],
        "position": [{"share": 1.0, "correlation_s": 1.0}],
    }
    return Pem.model_validate({"couples": [couple], "memory": memory})


def two_passes(listed: str) -> FitRows:
    """Of `0110` lists with and without the object; a pass for each word."""
    words = listed.split()
    n = sum(map(len, words))
    pass_ix = np.repeat(np.arange(len(words)), [len(word) for word in words])
    return rows_of(pass_ix, np.array([mark == "1" for mark in "".join(words)]), view_of(np.ones(n), np.ones(n)))


def test_statistics_by_hand() -> None:
    """0.1 s apart: listed after 0.1 s, one gap of 0.4 s; never listed; errors 3, 3, 3, −3 about their mean 1.5."""
    rows = two_passes("01000110 0000 1111")
    along = np.full(16, np.nan)
    along[[1, 5, 6]], along[12:] = 1.0, [3, 3, 3, -3]
    found = compute_statistics(rows.listed[None], along[None], np.where(np.isnan(along), np.nan, 0.0)[None], rows)
    expected = {
        "first listed, s": [0.1, np.inf, 0],
        "longest run of misses": [3, 4, 0],
        "share listed": [3 / 8, 0, 1],
        "RMSE, m": [1, np.nan, 3],
        "lag-1 correlation": [np.nan, np.nan, (2.25 + 2.25 - 6.75) / 3 / 6.75],
        "gap, s": [0.4, np.nan, np.nan],
    }
    assert tuple(expected) == STATISTICS
    for name, values in expected.items():
        np.testing.assert_allclose(found[name][0], values, err_msg=name)


def test_entries_whose_error_is_not_known() -> None:
    """They are hits; RMSE and correlation are those of the others: 3, 4 and 5, 12."""
    rows = two_passes("111")
    along, across = np.array([[3.0, np.nan, 5.0]]), np.array([[4.0, np.nan, 12.0]])
    found = compute_statistics(rows.listed[None], along, across, rows)
    assert found["share listed"][0] == [1.0]
    assert found["RMSE, m"][0] == pytest.approx(np.sqrt((25 + 169) / 2))
    assert np.isnan(found["lag-1 correlation"][0])


def test_ranks_by_hand() -> None:
    """Above 3 of 4 runs; alike with all: anywhere; never listed as two of four runs: in the upper part."""
    recorded = np.array([[2.5, 1.0, np.inf] + [0.5] * 5])
    runs = np.tile(np.array([[1.0, 1.0, 0.0], [2.0, 1.0, 1.0], [2.2, 1.0, np.inf], [3.0, 1.0, np.inf]]), (5, 1))
    runs = np.concatenate([runs, np.tile(np.linspace(0, 1, 20)[:, None], 5)], axis=1)
    nothing: Statistics = {name: np.full((20, 8), np.nan) for name in STATISTICS}
    none = {name: values[:1] for name, values in nothing.items()}
    check, *more = compare_statistics(none | {"first listed, s": recorded}, nothing | {"first listed, s": runs})
    assert not more
    assert 15 / 21 <= check.pit[0] <= 16 / 21
    assert 0 <= check.pit[1] <= 1
    assert 10 / 21 <= check.pit[2] <= 1
    assert check.verdict in ("holds", "too sure")
    few = {name: values[:, :7] for name, values in (none | {"first listed, s": recorded}).items()}
    less = {name: values[:, :7] for name, values in (nothing | {"first listed, s": runs}).items()}
    assert compare_statistics(few, less)[0].verdict == "too few passes to tell"


def test_simulated_as_the_model_says() -> None:
    """Share listed, P(listed | listed before), and the errors' spread and correlation from list to list."""
    rows = passes(0, 20, 50, flat)
    listed, along, across = simulate_lists(pem_of(), rows, lists_of(rows), np.arange(200), seed=3)
    assert listed.mean() == pytest.approx(0.7, abs=0.01)
    both = (listed[:, 1:] & listed[:, :-1])[:, np.diff(rows.pass_ix) == 0].mean()
    assert both == pytest.approx(0.49 + SHARE**2 * np.exp(-0.1 / TAU_S) * 0.21, abs=0.01)
    for error in (along, across):
        assert error[listed].std() == pytest.approx(0.5, rel=0.03)
    pair = (listed[:, 1:] & listed[:, :-1]) & (np.diff(rows.pass_ix) == 0)
    assert (along[:, 1:] * along[:, :-1])[pair].mean() == pytest.approx(0.25 * np.exp(-0.1), rel=0.05)


def test_a_right_model_holds_and_ranks_are_uniform() -> None:
    """Of 40 recordings of 25 passes each, drawn by the model: p is uniform, 95 % of the ranks are inside."""
    pem, rows = pem_of(), passes(0, 25, 40, flat)
    runs = compute_statistics(*simulate_lists(pem, rows, lists_of(rows), np.arange(240), 1), rows)
    p, inside = [], []
    for k in range(40):
        others = {name: np.delete(values, k, axis=0) for name, values in runs.items()}
        checks = compare_statistics({name: values[k : k + 1] for name, values in runs.items()}, others, seed=k)
        p += [check.p for check in checks]
        inside += [check.inside / len(check.pit) for check in checks]
    assert np.mean(inside) == pytest.approx(0.95, abs=0.01)
    assert np.mean(p) == pytest.approx(0.5, abs=0.06)
    assert 0.01 < np.mean(np.array(p) < 0.05) < 0.1


def test_without_memory_is_too_sure() -> None:
    """What lasts is recorded: the memoryless model fails at runs of misses, and at shares, the model does not."""
    rows, pem = passes(6, 40, 60, flat, (SHARE, TAU_S)), pem_of()
    holds = {check.statistic: check.verdict for check in replay_check(pem, rows, lists_of(rows), runs=200)}
    fails = {
        check.statistic: check.verdict for check in replay_check(remove_memory(pem), rows, lists_of(rows), runs=200)
    }
    for name in ("longest run of misses", "share listed", "gap, s"):
        assert (holds[name], fails[name]) == ("holds", "too sure"), name
    assert "RMSE, m" not in holds  # as recorded there are no errors


def test_a_class_that_differs_is_seen() -> None:
    """Half of the passes are pedestrians', listed with .5 and .9 in place of .7: together neither is told."""
    rows = passes(0, 40, 60, flat)
    kind = np.array([CLASSES.index("car"), CLASSES.index("pedestrian")], dtype=np.int8)[rows.pass_ix % 2]
    listed = np.random.default_rng(0).random(2400) < np.where(rows.pass_ix % 2 == 0, 0.9, 0.5)
    rows = replace(rows, view=replace(rows.view, class_ix=kind), listed=listed)
    checks = {one.statistic: one for one in replay_check(remove_memory(pem_of()), rows, lists_of(rows), runs=200)}
    assert {"share listed", "share listed, car", "share listed, pedestrian"} <= checks.keys()
    of_class = [one for name, one in checks.items() if name.endswith(", car")]
    assert {one.among for one in of_class} == {2 * len(of_class)}
    assert {one.among for one in checks.values()} == {2 * len(of_class), len(checks) - 2 * len(of_class)}
    assert checks["share listed, car"].p < 0.01
    assert len(checks["share listed, car"].pit) == 20
    few = rows.take(rows.pass_ix < 14)
    assert not [one for one in replay_check(pem_of(), few, lists_of(rows), runs=50) if "car" in one.statistic]
    alone = replace(rows, view=replace(rows.view, class_ix=0 * kind))
    names = {one.statistic for one in replay_check(pem_of(), alone, lists_of(rows), runs=50)}
    assert names <= {*STATISTICS, *TOTALS}


def test_totals_by_hand() -> None:
    """Two objects in three lists, expected in half: both missed, one, none: ¼ − ¼ + ¼; by azimuth 1 of 2, 1, ⋯."""
    view = replace(view_of(np.ones(6), np.ones(6)), azimuth_rad=np.array([0.0, 1, 2, 3, 4, 5]))
    rows = rows_of(np.repeat([0, 1], 3), np.ones(6, dtype=bool), view)
    listed = np.array([[False, True, True, False, False, True], [True] * 6])
    found = compute_totals(listed, rows, np.full(6, 0.5))
    assert found[:, 0].tolist() == [0.25 - 0.25 + 0.25, 0.75]
    assert found[0, 1:].tolist() == [0.5, 1.0, 0.0, 0.5]
    alone = replace(rows, list=np.arange(6))
    assert np.isnan(compute_totals(listed, alone, np.full(6, 0.5))[:, 0]).all()
    totals = np.column_stack([np.r_[9.0, np.tile([4.0, 5, 6], 33)], np.full((100, 4), 0.5)])
    [check] = compare_totals(totals, 12)
    assert (check.statistic, check.p, check.verdict) == ("misses at once", 0.01, "too sure")
    assert compare_totals(totals, 7)[0].verdict == "too few passes to tell"


def test_misses_of_all_objects_at_once_are_no_memory_of_each() -> None:
    """Recorded with a number that all objects share; a model that holds one for each has the same passes."""
    rows = passes(0, 40, 60, flat)
    tree = pem_of().model_dump(mode="json")["memory"]["detection"]
    common = pem_of().model_copy(update={"memory": {"detection": (MemoryPart(**tree[0] | {"of": "unit"}),)}})
    listed, _, _ = simulate_lists(common, rows, lists_of(rows), np.array([7]), seed=5)
    rows = replace(rows, listed=listed[0])
    right = {one.statistic: one.p for one in replay_check(common, rows, lists_of(rows), runs=200)}
    wrong = {one.statistic: one.p for one in replay_check(pem_of(), rows, lists_of(rows), runs=200)}
    assert right["misses at once"] > 0.05
    assert wrong["misses at once"] < 0.01


def test_same_bits() -> None:
    """Runs do not depend on how many there are, nor rows on the others of their log."""
    pem, rows = pem_of(), passes(0, 6, 30, flat)
    all_runs = simulate_lists(pem, rows, lists_of(rows), np.arange(5), seed=0)
    few = simulate_lists(pem, rows, lists_of(rows), np.array([3]), seed=0)
    some = simulate_lists(pem, rows.take(rows.pass_ix > 2), lists_of(rows), np.arange(5), seed=0)
    for whole, one, part in zip(all_runs, few, some, strict=True):
        np.testing.assert_array_equal(whole[3:4], one)
        np.testing.assert_array_equal(whole[:, rows.pass_ix > 2], part)


def test_the_pose_of_the_unit_moves_all_of_a_list_alike() -> None:
    """Own errors of a centimetre; the pose is off by 0.3 m and 2°: 0.09 m² along, and r² (2°)² more across."""
    rows, lists = fit_rows.rows_of(0, passes=2, lists_each=30, listed=1.0)
    once = np.arange(30)
    rows = replace(rows, list=np.tile(once, 2), captured_s=np.tile(rows.captured_s[:30], 2))
    lists = FitLists(*(getattr(lists, field.name)[:30] for field in fields(FitLists)))
    placed = PoseError(position_sigma_m=0.3, yaw_sigma_deg=2.0)
    _, along, across = simulate_lists(pem_of(sigma_m=0.01), rows, lists, np.arange(400), 0, placed)
    assert along.var() == pytest.approx(0.09, rel=0.05)
    expected = 0.09 + np.deg2rad(2.0) ** 2 * (rows.view.range_m**2).mean()
    assert across.var() == pytest.approx(expected, rel=0.05)
    for one in (along, across):  # the second pass goes the same way, so it is moved alike
        assert np.corrcoef(one[:, :30].ravel(), one[:, 30:].ravel())[0, 1] > 0.98

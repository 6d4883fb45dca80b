"""The page of a fit: its figures are read back from their artists and compared with what can be counted by hand."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from copem_replay.core.tracks import CLASSES
from copem_replay.extras.fitting.detection import fit_detection
from copem_replay.extras.fitting.diagnostics import (
    FIT_FIGURES,
    _mean_products,
    calibration_figure,
    error_map_figure,
    gaussian_figure,
    ranks_figure,
)
from copem_replay.extras.fitting.errors import fit_errors
from copem_replay.extras.fitting.estimate import Estimate
from copem_replay.extras.fitting.fit import Fit, FitOptions, FittedParts, ReplayChecks, judge_use
from copem_replay.extras.fitting.gather import FitReach, Gathered
from copem_replay.extras.fitting.page import describe_name, fit_page, list_estimates
from copem_replay.extras.fitting.pose import DelayFit
from copem_replay.extras.fitting.replay_check import StatisticCheck
from copem_replay.extras.fitting.rest import fit_rest
from tests.extras.fitting.fit_rows import nothing_else, rows_of


def check_of(name: str, p: float, passes: int = 12) -> StatisticCheck:
    verdict = "too few passes to tell" if passes < 8 else "holds" if p >= 0.05 else "too sure"
    return StatisticCheck(name, np.linspace(0, 1, passes), passes, p, verdict)  # type: ignore[arg-type]


@cache
def _fit() -> Fit:
    rows, lists = rows_of(3, passes=12, lists_each=40)
    rows = replace(rows, view=replace(rows.view, speed_mps=np.full(len(rows.log), 8.0)))
    parts = FittedParts(
        fit_detection(rows, intervals=False), fit_errors(rows),
        fit_rest(rows, lists, nothing_else(), truth="partial"),
    )  # fmt: skip
    gathered = Gathered(lists, rows, nothing_else(), FitReach((0.0, 45.0), None), 384, 0.0, False, ())
    delay = DelayFit(Estimate(1.0, why="no <i>miss</i>"))
    checks = ReplayChecks(True, (check_of("longest run", 0.5),), (check_of("longest run", 0.001),))
    return Fit(
        "rsu", ("drive",), (), FitOptions(), "partial", delay, Estimate(10.0, 9.9, 10.1, 479, 479.0), parts, gathered,
        None, (), ("a note",), checks,
    )  # fmt: skip


def test_the_page_has_all_and_loads_nothing() -> None:
    page = fit_page(_fit())
    assert set(FIT_FIGURES) == {"ranks", "calibration", "error_map", "autocorrelation", "gaussian"}
    for name in FIT_FIGURES:
        assert page.count(f'id="section-{name}"') == 1
        assert f'id="{name}" class="plot"' in page
    assert len(page.encode()) < 1_500_000
    assert not re.search(r'(?:src|href)="(?!#|data:)', page)
    assert "&lt;i&gt;" in page
    assert "<i>" not in page
    assert fit_page(_fit()) == page  # the same bytes


def test_what_the_model_is_for_stands_on_top() -> None:
    fit = _fit()
    page = fit_page(fit)
    said = judge_use(fit)
    assert said.startswith(f"Use it for {CLASSES[3]} at 0 to 45 m, where no statistic of the replay check contradicts")
    assert "logs held out" in said
    assert "nor for ghosts" in said
    assert page.index("Use it for") < page.index("<h2")
    wrong = ReplayChecks(True, (check_of("gap, s", 0.001), check_of("RMSE, m", 0.6)), ())
    assert "differ from the recording" in judge_use(replace(fit, checks=wrong))
    assert "in gap, s." in judge_use(replace(fit, checks=wrong))
    few = ReplayChecks(True, (check_of("gap, s", 0.001, passes=5),), ())
    assert judge_use(replace(fit, checks=few)).endswith(
        "5 passes cannot tell whether it behaves like the recording, 8 could."
    )
    assert judge_use(replace(fit, checks=None)).startswith("Use it for nothing yet")


def test_every_number_has_a_name_in_words() -> None:
    fit = _fit()
    names = {name: describe_name(fit, name) for name, _ in list_estimates(fit)}
    assert not [
        words for words in names.values() if re.search(r"[._][0-9a-z]", words.replace("0.", "").replace(".5", ""))
    ]
    far_m = fit.parts.errors.bins[0].where.range_m[1]
    axes = ("along", "across") if fit.parts.errors.frame == "line_of_sight" else ("east", "north")
    assert names["errors.bins.0.mean_m.0"] == f"error, 0 to {far_m:g} m: mean {axes[0]}, m"
    assert names["errors.bins.0.covariance_m2.2"] == f"error, 0 to {far_m:g} m: variance {axes[1]}, m²"
    assert names["errors.memory.position.0.correlation_s"] == "memory of position, part 1: correlation time, s"
    assert names["rate_hz"] == "lists per second"
    assert len(set(names.values())) == len(names)


def test_nothing_is_no_number() -> None:
    assert Estimate(0.3, 0.1, 0.5).words() == "not identifiable: no rows"
    assert Estimate(0.3, 0.1, 0.5, n=1, n_effective=1.0).words() == "0.3 (95 %: 0.1 … 0.5, n 1, effective 1)"
    assert Estimate(0.5, chosen=True).words() == "chosen"
    near = Estimate(0.0315, 0.03149, 0.03151, n=9, n_effective=9.0)
    assert near.words() == "0.0315 (95 %: 0.03149 … 0.03151, n 9, effective 9)"
    assert Estimate(0.9, 0.9, 0.9, n=9, n_effective=9.0).words() == "0.9 (the same in all 9)"
    rate = Estimate(10.0, 10.0 - 1e-13, 10.0 + 1e-13, n=558, n_effective=float("nan"))
    assert rate.words() == "10 (the same in all 558)"
    assert Estimate(3.0, 2.0, float("inf"), n=9, n_effective=1.0).words() == "3 (95 %: 2 … ∞, n 9, effective 1)"


def test_no_interval_of_the_page_has_two_equal_ends() -> None:
    near = replace(_fit(), rate_hz=Estimate(10.0, 9.9999, 10.0001, 479, 479.0))
    page = fit_page(near)
    assert ">9.9999 … 10<" in page
    assert not re.search(r">(\S+) … \1<", page)


def test_what_is_missing_is_said() -> None:
    page = fit_page(replace(_fit(), checks=None))
    assert "No figure: nothing was replayed beside what was recorded." in page


def test_calibration_counts_rows() -> None:
    fit = _fit()
    [axes] = calibration_figure(fit).axes
    points = axes.containers[0].lines[0].get_xydata()
    line = axes.lines[0].get_xydata()
    range_m, listed = fit.gathered.rows.view.range_m, fit.gathered.rows.listed
    assert points[:, 1].mean() == pytest.approx(listed.mean(), abs=0.02)  # bins of about equal numbers
    assert line[:, 1].mean() == pytest.approx(fit.parts.detection.probability(fit.gathered.rows.view).mean(), abs=0.02)
    near = range_m < np.quantile(range_m, 1 / 12)
    assert points[0, 1] == pytest.approx(listed[near].mean(), abs=0.03)
    assert points[0, 0] == pytest.approx(range_m[near].mean(), abs=0.2)


def test_the_map_has_every_row() -> None:
    rows = _fit().gathered.rows
    axes = error_map_figure(_fit()).axes[0]
    listed, missed = (collection.get_offsets() for collection in axes.collections[:2])
    assert (len(listed), len(missed)) == (rows.listed.sum(), (~rows.listed).sum())
    centre = rows.state_m.mean(axis=0)
    np.testing.assert_allclose(np.asarray(missed), rows.state_m[~rows.listed] - centre)


def test_quantiles_are_those_of_the_errors() -> None:
    left, _ = gaussian_figure(_fit()).axes
    z = _fit().parts.errors.shape.z
    along = left.lines[1].get_xydata()
    assert along[len(along) // 2, 1] == pytest.approx(np.median(z[:, 0]), abs=0.05)
    assert along[0, 1] >= z[:, 0].min()


def test_correlations_are_within_series_and_at_their_lags() -> None:
    z = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, -1.0]])
    found, n = _mean_products(z, np.array([0, 0, 0, 1]), np.array([0.0, 0.1, 0.2, 0.3]), np.array([1, 2]), 0.1)
    assert n.tolist() == [2, 1]
    np.testing.assert_allclose(found, [[0.0, -1.0], [-1.0, 1.0]])


def test_correlations_of_lists_that_say_one_time_have_no_points() -> None:
    fit = _fit()
    rows = replace(fit.gathered.rows, captured_s=np.zeros(len(fit.gathered.rows.log)))
    [axes] = FIT_FIGURES["autocorrelation"].draw(replace(fit, gathered=replace(fit.gathered, rows=rows))).axes
    assert [len(line.get_xdata()) for line in axes.lines if line.get_label() in ("along", "across")] == [0, 0]


def test_ranks_are_a_point_each() -> None:
    [axes] = ranks_figure(_fit()).axes
    assert [len(line.get_xdata()) for line in axes.lines] == [12, 12]
    assert [text.get_text().strip() for text in axes.texts] == ["holds"]

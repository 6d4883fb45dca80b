"""The page of a fit: its figures are read back from their artists and compared with what can be counted by hand."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from copem_replay.fitting.detection import fit_detection
from copem_replay.fitting.diagnostics import (
    FIT_FIGURES,
    FitStudy,
    _count_longer,
    _draw_hits,
    _find_runs,
    _mean_products,
    _rmse_by_delay,
    calibration_figure,
    probability_map_figure,
    ranks_figure,
)
from copem_replay.fitting.errors import fit_errors
from copem_replay.fitting.estimate import Estimate
from copem_replay.fitting.page import fit_page
from copem_replay.fitting.rest import fit_rest
from tests.helpers.fit_rows import nothing_else, rows_of


@cache
def _study() -> FitStudy:
    rows, lists = rows_of(3, passes=12, lists_each=40)
    rows = replace(rows, view=replace(rows.view, speed_mps=np.full(len(rows.log), 8.0)))
    detection, errors = fit_detection(rows, lists, intervals=False), fit_errors(rows, lists)
    rest = fit_rest(rows, lists, nothing_else(), truth="partial")
    ranks = {"longest run": np.linspace(0, 1, 12)}
    estimates = {"delay_s": Estimate(0.13, 0.1, 0.16, 480, 40.0), "<b>": Estimate(1.0, why="no <i>miss</i>")}
    return FitStudy(
        "rsu", ["drive"], rows, lists, detection, errors, rest, 0.13, estimates, ranks, ranks,
        {"longest run": "holds"}, ["a note"],
    )  # fmt: skip


def test_the_page_has_all_and_loads_nothing() -> None:
    page = fit_page(_study())
    for name in FIT_FIGURES:
        assert page.count(f'id="section-{name}"') == 1
        assert f'id="{name}" class="plot"' in page
    assert len(page.encode()) < 1_500_000
    assert not re.search(r'(?:src|href)="(?!#|data:)', page)
    assert "&lt;b&gt;" in page
    assert "<i>" not in page
    assert fit_page(_study()) == page  # the same bytes


def test_what_is_missing_is_said() -> None:
    study = _study()
    all_listed = replace(study.rows, listed=np.ones(len(study.rows.log), dtype=bool))
    page = fit_page(replace(study, ranks={}, rows=all_listed))
    assert "No figure: nothing was replayed beside what was recorded." in page
    assert "No figure: no miss in 480 rows." in page


def test_calibration_counts_rows() -> None:
    study = _study()
    [axes] = calibration_figure(study).axes
    points = axes.containers[0].lines[0].get_xydata()
    assert np.average(points[:, 0]) == pytest.approx(study.probability.mean(), abs=0.02)
    if len(points) == 1:
        assert points[0, 1] == pytest.approx(study.rows.listed.mean())


def test_the_map_has_the_number_of_rows_of_each_cell() -> None:
    study = _study()
    left, right = probability_map_figure(study).axes
    said = [text.get_text().split("\n") for text in left.texts]
    assert sum(int(n) for _, n in said) == len(study.rows.log)
    assert [n for _, n in said] == [text.get_text().split("\n")[1] for text in right.texts]
    hits = sum(float(share) * int(n) for share, n in said)
    assert hits == pytest.approx(study.rows.listed.sum(), abs=0.005 * len(study.rows.log))


def test_strips_are_runs_of_hits() -> None:
    which = np.array([True, True, False, True, False])
    since_s = np.array([0.0, 0.1, 0.2, 0.3, 2.0])  # a gap
    found = _find_runs(which, since_s, 0.1)
    np.testing.assert_allclose(found, [(0.0, 0.2), (0.3, 0.2)])
    np.testing.assert_allclose(_find_runs(~which, since_s, 0.1), [(0.2, 0.1), (2.0, 0.1)])


def test_runs_of_misses_are_counted() -> None:
    missed = np.array([[1, 0], [1, 1], [0, 1], [1, 1], [1, 0]], dtype=bool)
    new = np.array([True, False, False, True, False])
    # First column: 2 and, in another pass, 2; second: 2, then 1 in the other pass.
    assert _count_longer(missed, new).tolist() == [[2, 2], [2, 1]]


def test_drawn_again_has_the_share_and_the_memory_of_the_model() -> None:
    p, gap_s = np.full(400, 0.6), np.full(400, 0.1)
    new = np.arange(400) % 100 == 0
    for share, expected in ((0.0, 0.0), (1.0, np.exp(-0.1))):
        hits = _draw_hits(p, gap_s, new, share, 1.0).astype(float)
        assert hits.mean() == pytest.approx(0.6, abs=0.02)
        later = ~new[1:]
        lag = np.corrcoef(hits[:-1][later].ravel(), hits[1:][later].ravel())[0, 1]
        assert lag == pytest.approx(expected, abs=0.02)


def test_correlations_are_within_series_and_at_their_lags() -> None:
    z = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, -1.0]])
    found, n = _mean_products(z, np.array([0, 0, 0, 1]), np.array([0.0, 0.1, 0.2, 0.3]), np.array([1, 2]), 0.1)
    assert n.tolist() == [2, 1]
    np.testing.assert_allclose(found, [[0.0, -1.0], [-1.0, 1.0]])


def test_a_delay_moves_entries_along_the_way() -> None:
    heading, speed = np.full(3, np.pi / 2), np.array([1.0, 2.0, 3.0])
    north_m = 0.2 * speed  # entries are ahead, as if the lists were 0.2 s younger than is taken
    plain, centred = _rmse_by_delay(np.zeros(3), north_m, heading, speed, np.array([-0.2, 0.0]))
    np.testing.assert_allclose(plain, [0.0, 0.2 * np.sqrt(14 / 3)], atol=1e-12)
    np.testing.assert_allclose(centred, [0.0, 0.2 * np.sqrt(2 / 3)], atol=1e-12)


def test_ranks_are_a_point_each() -> None:
    [axes] = ranks_figure(_study()).axes
    assert [len(line.get_xdata()) for line in axes.lines] == [12, 12]
    assert [text.get_text().strip() for text in axes.texts] == ["holds"]

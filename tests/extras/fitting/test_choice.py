"""The choice among models: Breiman's rule by hand, its standard error against a closed form, and BIC."""

from __future__ import annotations

import math

import numpy as np
import pytest

from copem_replay.extras.fitting.estimate import Rung, choose_by_bic, choose_rung, held_out_possible

NAMES = ("constant", "range", "range × visible share")
EQUAL = np.full(40, 10)


def passes(mean: float, spread: float) -> np.ndarray:
    """Sums of 40 passes of ten lists: mean and standard deviation over passes as said, exactly."""
    z = np.tile([-1.0, 1.0], 20)
    return 10 * mean + spread * z


def test_simplest_within_one_standard_error() -> None:
    """Of 40 passes the difference per list has the standard error spread / (10 √40)."""
    best = passes(-0.3, 0.0)
    one = 1 / (10 * math.sqrt(40))
    for far, expected in ((0.9 * one, 1), (1.1 * one, 2)):
        scores = np.stack([passes(-9.0, 1.0), passes(-0.3 - far, 1.0), best])
        index, table = choose_rung(NAMES, scores, EQUAL)
        assert index == expected
        assert table[1].below == pytest.approx(far, rel=1e-9)
        assert table[1].below_se == pytest.approx(one, rel=0.05)
        assert [rung.chosen for rung in table] == [k == expected for k in range(3)]
        assert table[2].score == pytest.approx(-0.3)
        assert (table[2].below, table[2].below_se) == (0, 0)


def test_passes_weigh_by_their_lists() -> None:
    """Nine lists at −1 and one at −11 are −2 per list, whatever passes they lie in."""
    index, table = choose_rung(("a",), np.array([[-9.0, -11.0]]), np.array([9, 1]))
    assert (index, table[0].score) == (0, -2.0)


def test_impossible_is_below_all() -> None:
    scores = np.stack([np.full(40, -np.inf), np.full(40, -5.0), np.full(40, -4.0)])
    index, table = choose_rung(NAMES, scores, EQUAL)
    assert index == 2
    assert table[0].below == math.inf
    assert choose_rung(NAMES, scores, EQUAL, simplest=True)[0] == 0


def test_same_table_every_time() -> None:
    scores = np.random.default_rng(0).normal(-5, 1, (3, 40))
    assert choose_rung(NAMES, scores, EQUAL) == choose_rung(NAMES, scores, EQUAL)


def test_bic() -> None:
    """400 rows worth 100: −2 · 50 + k ln 100 for the log-likelihood of 200, as of the rows that count."""
    index, table = choose_by_bic(("a", "b"), np.array([-200.0, -180.0]), np.array([1, 4]), 400, 100.0)
    by_hand = [2 * 50 + 1 * math.log(100), 2 * 45 + 4 * math.log(100)]
    assert [-200 * rung.score for rung in table] == pytest.approx(by_hand)
    assert index == 0
    assert table[0].by == "BIC"
    assert choose_by_bic(("a", "b"), np.array([-200.0, -160.0]), np.array([1, 4]), 400, 100.0)[0] == 1


def test_when_passes_can_be_held_out() -> None:
    assert held_out_possible(np.array([0, 1, 2, 3]), np.array([0, 1, 0, 1]))
    assert not held_out_possible(np.array([0, 1, 2, 2]), np.array([0, 1, 0, 1]))
    assert not held_out_possible(np.array([0, 1, 2, 3]), np.zeros(4, dtype=int))


def test_words() -> None:
    best, other = Rung("range", -0.25, 0.0, 0.0, True, "held out"), Rung("constant", -0.5, 0.25, 0.03, False, "BIC")
    assert best.words() == "range: -0.25 nats per list (held out), the best, chosen"
    assert other.words() == "constant: -0.5 nats per list (BIC), 0.25 ± 0.03 below the best"

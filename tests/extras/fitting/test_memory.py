"""Memory of detection: the filter over many passes, known values, limits that hold them, what cannot be told."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from copem_replay.extras.fitting.detection import (
    build_sequences,
    design_effect,
    explain_no_memory,
    fit_detection_memory,
    pass_starts,
)
from copem_replay.extras.fitting.rows import count_rows_per_effective
from copem_replay.metrics.exact_survival import Sequences, log_sequence
from tests.extras.fitting.detection_rows import passes, view_of


def half(view: object) -> np.ndarray:
    return np.full(len(view.range_m), 0.5)  # type: ignore[attr-defined]


def falling(view: object) -> np.ndarray:
    return 0.95 - 0.7 * view.range_m / 60  # type: ignore[attr-defined,no-any-return]


def test_many_sequences_are_each_as_one() -> None:
    rng = np.random.default_rng(0)
    start = np.array([0, 1, 30, 32, 70])
    p, held, at = rng.integers(0, 9, 70) / 8, rng.random(70) < 0.5, np.cumsum(rng.integers(1, 9, 70) / 10)
    p = np.clip(p, 0.01, 0.99)
    seen = Sequences.of(start, p, held, at)
    found = seen.log_probability(0.7, 0.6)
    for a, b in itertools.pairwise(start.tolist()):
        gap_s = np.diff(at[a:b], prepend=at[a])
        np.testing.assert_array_equal(found[a:b], log_sequence(p[a:b], held[a:b], gap_s, np.full(b - a, 0.7), 0.6))


def test_putting_probabilities_together_loses_little() -> None:
    """50 of them instead of 4,800: some 1e-4 nats per list."""
    rows = passes(0, 60, 80, falling, (0.6, 0.8))
    p = falling(rows.view)
    exact = Sequences.of(pass_starts(rows.pass_ix), p, rows.listed, rows.captured_s)
    fewer = build_sequences(rows.listed, p, rows.captured_s, rows.pass_ix)
    assert len(np.unique(fewer.listed)) <= 50
    assert fewer.listed.mean() == pytest.approx(p.mean(), rel=1e-12)
    lost = exact.log_probability(0.6, 0.8).mean() - fewer.log_probability(0.6, 0.8).mean()
    assert abs(lost) < 3e-4


@pytest.mark.parametrize(
    ("true", "gain"), [((0.8, 1.0), 0.14), ((0.5, 0.3), 0.019)]
)  # the design's, of p that rise and fall
def test_known_values(true: tuple[float, float], gain: float) -> None:
    """60 passes of 80 lists, p from .25 to .95: the values within three standard errors, in the mean of 6 seeds."""
    found = []
    for seed in range(6):
        rows = passes(seed, 60, 80, falling, true)
        seen = build_sequences(rows.listed, falling(rows.view), rows.captured_s, rows.pass_ix)
        found.append(fit_detection_memory(seen, intervals=False))
    share = np.array([one.share.value for one in found])
    tau = np.log([one.correlation_s.value for one in found])
    for values, expected, width in ((share, true[0], 0.035), (tau, np.log(true[1]), 0.2)):
        assert values.mean() == pytest.approx(expected, abs=3 * width / np.sqrt(6))
    assert np.mean([one.gain for one in found]) == pytest.approx(gain, rel=0.5)


def test_limits_hold_the_values() -> None:
    """95 % over 20 seeds each of 40 passes: at least 16 (less with probability .0003)."""
    inside = np.zeros(2)
    for seed in range(20):
        rows = passes(seed, 40, 60, half, (0.7, 0.6))
        found = fit_detection_memory(build_sequences(rows.listed, half(rows.view), rows.captured_s, rows.pass_ix))
        pair = (found.share, 0.7), (found.correlation_s, 0.6)
        inside += [one.low <= value <= one.high for one, value in pair]
        assert all(one.low < one.value < one.high for one, _ in pair)
    assert (inside >= 16).all()


def test_nothing_lasts_and_all_lasts() -> None:
    """Fresh in every list: the share's limits reach to 0. One number for each pass: the time has no upper limit."""
    rows = passes(1, 30, 60, half)
    fresh = fit_detection_memory(build_sequences(rows.listed, half(rows.view), rows.captured_s, rows.pass_ix))
    assert fresh.share.low == 0
    assert fresh.gain < 2e-3
    once = np.repeat(np.random.default_rng(0).random(30), 60) < 0.5
    always = fit_detection_memory(build_sequences(once, half(rows.view), rows.captured_s, rows.pass_ix))
    assert always.correlation_s.value == np.inf
    assert always.correlation_s.high == np.inf
    assert always.share.high == 1


def test_design_effect() -> None:
    """s .8, τ 1, Δ .1: one effective of 13.1 rows of a very long pass (the design's .076), fewer of a short one."""
    for m, expected in ((20_000, 1 + 2 * 0.64 * np.exp(-0.1) / (1 - np.exp(-0.1))), (3, None)):
        seen = Sequences.of(np.array([0, m]), np.full(m, 0.5), np.zeros(m, dtype=bool), np.arange(m) * 0.1)
        by_hand = 1 + 2 * sum((1 - k / m) * 0.64 * np.exp(-0.1 * k) for k in range(1, min(m, 400)))
        assert design_effect(0.8, 1.0, seen) == pytest.approx(by_hand, rel=1e-9 if m == 3 else 1e-3)
        if expected is not None:
            assert 1 / design_effect(0.8, 1.0, seen) == pytest.approx(0.076, abs=5e-4)
            assert design_effect(0.8, 1.0, seen) == pytest.approx(expected, rel=1e-3)


def test_rows_per_effective_row() -> None:
    """As the model that they are drawn from says; 1 where nothing lasts, and where nothing is left."""
    rows = passes(2, 400, 80, half, (0.8, 1.0))
    seen = build_sequences(rows.listed, half(rows.view), rows.captured_s, rows.pass_ix)
    assert count_rows_per_effective(rows.listed - 0.5, rows.pass_ix) == pytest.approx(
        design_effect(0.8, 1.0, seen), rel=0.2
    )
    fresh = passes(2, 400, 80, half)
    assert count_rows_per_effective(fresh.listed - 0.5, fresh.pass_ix) == pytest.approx(1, abs=0.05)
    assert count_rows_per_effective(np.zeros(5), np.zeros(5, dtype=int)) == 1


def test_what_cannot_be_told() -> None:
    view = view_of(np.ones(161), np.ones(161))
    always = np.ones(len(view.range_m), dtype=bool)
    mixed = np.arange(161) % 2 == 0
    one, two = np.zeros(161, dtype=int), np.arange(161) // 81
    assert explain_no_memory(always, one) == "no miss in 161 lists"
    assert explain_no_memory(~always, one) == "no hit in 161 lists"
    assert explain_no_memory(mixed, two) == "2 passes: no correlation time of detection can be told"
    assert explain_no_memory(mixed, one) == "1 pass: no correlation time of detection can be told"
    assert explain_no_memory(~always[:1], one[:1]) == "no hit in 1 list"
    assert explain_no_memory(mixed, np.arange(161)) == "161 passes: no correlation time of detection can be told"
    assert explain_no_memory(mixed, np.arange(161) // 20) is None

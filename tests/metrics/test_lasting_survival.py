"""The filter over cells of U: the design's vectors, other people's hidden Markov models, brute force, tails."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mpmath import mp, mpf

from copem_replay.core.tracks import Float
from copem_replay.metrics.exact_survival import LastingDetection, first_known, log_sequence, scale_odds
from tests.helpers.drawn import examples

P = np.array([0.2, 0.5, 0.3, 0.6])
GAP = np.array([0.0, 0.1, 0.1, 0.1])
CASES: dict[tuple[float, float], tuple[list[float], float]] = {
    (1.0, 0.8): ([0.8, 0.48825, 0.471038, 0.346591], 0.010901),
    (0.6, 0.8): ([0.8, 0.43177, 0.35326, 0.195144], 0.039766),
    (1.0, math.inf): ([0.8, 0.5, 0.5, 0.4], 0.0),
    (0.0, 0.8): ([0.8, 0.4, 0.28, 0.112], 0.042),
}


def logs(p: Float, held: Any, gap_s: Float, share: float, tau_s: float) -> Float:
    return log_sequence(p, np.array(held, dtype=bool), gap_s, np.full(len(p), share), tau_s)


@pytest.mark.parametrize("case", CASES)
def test_vectors(case: tuple[float, float]) -> None:
    """Four lists 0.1 s apart: P(no hit in the first 1, 2, 3, 4), and P(hit, hit, miss, hit). By hand for `always`."""
    misses, mixed = CASES[case]
    survival = np.exp(np.cumsum(logs(P, [0, 0, 0, 0], GAP, *case)))
    np.testing.assert_allclose(survival, misses, atol=6e-7)
    assert math.exp(logs(P, [1, 1, 0, 1], GAP, *case).sum()) == pytest.approx(mixed, abs=6e-7)


@pytest.mark.parametrize("case", CASES)
def test_all_sequences_sum_to_one(case: tuple[float, float]) -> None:
    total = sum(np.exp(logs(P, held, GAP, *case).sum()) for held in itertools.product((0, 1), repeat=4))
    assert total == pytest.approx(1, abs=1e-12)


def brute(p: Float, held: Any, gap_s: Float, share: float, tau_s: float) -> Any:
    """The same to 60 digits: over all ways in which lists are fresh or held, and the held number is renewed or not."""
    n, total = len(p), mpf(0)
    mp.dps = 60
    for renewed in itertools.product((0, 1), repeat=n - 1):
        blocks: list[list[int]] = [[0]]
        weight = mpf(1)
        for i, new in enumerate(renewed, start=1):
            same = mp.exp(-mpf(float(gap_s[i])) / mpf(tau_s)) if math.isfinite(tau_s) else mpf(1)
            weight *= 1 - same if new else same
            if new:
                blocks.append([i])
            else:
                blocks[-1].append(i)
        for block in blocks:
            cuts = sorted({mpf(0), mpf(1), *(mpf(float(p[i])) for i in block)})
            inside = mpf(0)
            for low, high in itertools.pairwise(cuts):
                factor = high - low
                for i in block:
                    hit = (1 - mpf(share)) * mpf(float(p[i])) + (mpf(share) if low < mpf(float(p[i])) else 0)
                    factor *= hit if held[i] else 1 - hit
                inside += factor
            weight *= inside
        total += weight
    return total


@given(
    p=st.lists(st.sampled_from([0.0, 1e-12, 0.2, 0.5, 0.5000001, 0.97, 1 - 1e-9]), min_size=1, max_size=6),
    share=st.sampled_from([0.0, 0.3, 0.999, 1.0]),
    tau_s=st.sampled_from([0.01, 0.7, 300.0, math.inf]),
    data=st.data(),
)
@settings(max_examples=examples(120), deadline=None)  # each counts all ways with 60 digits
def test_against_all_ways_to_60_digits(p: list[float], share: float, tau_s: float, data: Any) -> None:
    held = data.draw(st.lists(st.booleans(), min_size=len(p), max_size=len(p)))
    gap = np.array(
        [0.0, *data.draw(st.lists(st.sampled_from([0.0, 0.1, 2.5]), min_size=len(p) - 1, max_size=len(p) - 1))]
    )
    ours = logs(np.array(p), held, gap, share, tau_s).sum()
    plain = brute(np.array(p), held, gap, share, tau_s)
    if plain < mpf("1e-300"):
        assert ours < -600
    else:
        assert ours == pytest.approx(float(mp.log(plain)), rel=1e-10, abs=1e-15)


def test_a_tail_is_not_lost() -> None:
    """Two thousand lists of p = .9, held 1 s, 0.1 s apart: ln P = ln .1 + 1999 ln(φ + (1 − φ) .1)."""
    p, gap = np.full(2000, 0.9), np.full(2000, 0.1)
    same = math.exp(-0.1)
    expected = math.log(0.1) + 1999 * math.log(same + (1 - same) * 0.1)
    assert logs(p, [0] * 2000, gap, 1.0, 1.0).sum() == pytest.approx(expected, rel=1e-12)
    fresh = logs(p, [0] * 2000, gap, 0.0, 1.0).sum()
    assert fresh == pytest.approx(2000 * math.log(0.1), rel=1e-12)
    seldom = logs(np.full(100, 1e-14), [0] * 100, np.full(100, 10.0), 1.0, 0.001).sum()
    assert seldom == pytest.approx(-1e-12, rel=1e-9)  # nothing is 1 minus something near 1


def test_a_hidden_markov_model_says_the_same() -> None:
    """With one p, listed or not is a chain: stationary p, P(1|1) = φ + (1 − φ) p. Oracle: hmmlearn.

    With a share of fresh draws it is a chain of the held number below or above p, seen with errors.
    """
    hmm = pytest.importorskip("hmmlearn.hmm", reason="hmmlearn is not installed")
    p, tau_s = 0.3, 0.8
    for share in (1.0, 0.6):
        same = math.exp(-0.1 / tau_s)
        model = hmm.CategoricalHMM(n_components=2, init_params="", n_features=2)
        model.startprob_ = np.array([1 - p, p])
        model.transmat_ = np.array(
            [[same + (1 - same) * (1 - p), (1 - same) * p], [(1 - same) * (1 - p), same + (1 - same) * p]]
        )
        hit = np.array([(1 - share) * p, (1 - share) * p + share])
        model.emissionprob_ = np.stack([1 - hit, hit], axis=1).clip(1e-300)
        rng = np.random.default_rng(0)
        for _ in range(20):
            held = rng.random(30) < p
            theirs = model.score(held[:, None].astype(int))
            assert logs(np.full(30, p), held, np.full(30, 0.1), share, tau_s).sum() == pytest.approx(theirs, rel=1e-9)


def test_log_odds_by_central_difference() -> None:
    """Against differences of the 60-digit sum, five lists of two units, one of which is not remembered."""
    p = np.array([0.2, 0.5, 0.3, 0.6, 0.7])
    lasts = LastingDetection(
        np.array([0, 0, 0, 0, -1]), np.full(5, 0.8), np.full(5, 0.5), np.array([0, 0.1, 0.2, 0.3, 0.15])
    )
    known = first_known(lasts.captured_s, p, np.array([0, 0, 0, 0, 1]), np.ones(2), lasts)

    def plain(delta: float) -> float:
        moved = scale_odds(p, math.exp(delta))
        gap = np.array([0.0, 0.1, 0.1, 0.1])
        return float(mp.log(brute(moved[:4], [0] * 4, gap, 0.8, 0.5))) + math.log1p(-moved[4])

    assert known.log_never == pytest.approx(plain(0), rel=1e-12)
    assert known.per_logit == pytest.approx((plain(1e-5) - plain(-1e-5)) / 2e-5, rel=1e-6)
    assert known.log_never_half == pytest.approx(plain(-math.log(2)), rel=1e-12)
    assert known.probability.sum() + math.exp(known.log_never) == pytest.approx(1, abs=1e-12)


def test_a_unit_that_may_not_be_there() -> None:
    """P(never) = (1 − q) + q F, by instant as well; q of the unit that lasts."""
    lasts = LastingDetection(np.zeros(4, dtype=np.int64), np.ones(4), np.full(4, 0.8), np.cumsum(GAP))
    known = first_known(np.cumsum(GAP) + 0.5, P, np.zeros(4, dtype=np.int64), np.array([0.3]), lasts)
    survival = 0.7 + 0.3 * np.array(CASES[1.0, 0.8][0])
    np.testing.assert_allclose(1 - np.cumsum(known.probability), survival, atol=1e-6)
    assert math.exp(known.log_never) == pytest.approx(survival[-1], abs=1e-6)

"""Numbers that last: bits against plainly written ones, laws against SciPy, the same however they are asked for."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from copem_replay.core.lasting import (
    LEAF,
    ListStamps,
    draw_births,
    draw_correlated_normals,
    draw_held_uniforms,
    drop_capture,
    drop_unshared,
    dyadic_level,
    renewal_stamps,
)
from copem_replay.core.random import CounterRng, RandomKey, object_words, stable_hash
from copem_replay.core.tracks import Float, Int
from tests.oracles.lasting import Series

T0 = 1_700_000_000_000_000_000
DICE = CounterRng(7, "log")
RUNS = np.arange(3)
TAUS = (0.001, 0.05, 0.8, 2.0, 30.0)


def row_address(stamps: Int, unit: str = "u", word: str = "o") -> RandomKey:
    """One object in lists of one unit."""
    zero = np.zeros(len(stamps), dtype=np.int64)
    return RandomKey((unit,), zero, np.repeat(object_words([word]), len(stamps)), stamps)


def lists_of(stamps: Int) -> ListStamps:
    return ListStamps(stamps, np.zeros(len(stamps), dtype=np.int64), np.arange(len(stamps)))


def series(run: int, purpose: str = "p", unit: str = "u", word: str = "o") -> Series:
    return Series(7, "log", purpose, unit, stable_hash("object", word), run)


def stamps_at(rate_hz: float, until_s: float, seed: int | None = None, from_s: float = 0.0) -> Int:
    times = np.arange(from_s, until_s, 1 / rate_hz)
    if seed is not None:
        times = np.sort(times + np.random.default_rng(seed).uniform(0, 0.9 / rate_hz, len(times)))
    return T0 + np.rint(times * 1e9).astype(np.int64)


# ---- bits ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tau_s", TAUS)
def test_held_is_what_its_definition_says(tau_s: float) -> None:
    stamps = stamps_at(10, 4, seed=1)
    ours = draw_held_uniforms(DICE, "p", row_address(stamps), RUNS, tau_s)
    drawn_by = renewal_stamps(DICE, "p", row_address(stamps), RUNS, tau_s)
    for run in RUNS.tolist():
        plain = [series(run).held(tau_s * 1e9, int(t)) for t in stamps]
        assert [(v, at) for v, at in zip(ours[run], drawn_by[run], strict=True)] == plain


@pytest.mark.parametrize("tau_s", TAUS)
def test_drifting_is_what_its_definition_says(tau_s: float) -> None:
    stamps = stamps_at(23, 2.5, seed=1)
    stamps[7] = (stamps[7] >> LEAF) << LEAF  # right at a leaf's end
    stamps.sort()
    ours = draw_correlated_normals(DICE, "p", row_address(stamps), RUNS, tau_s, lists=lists_of(stamps))
    common = draw_correlated_normals(DICE, "p", row_address(stamps), RUNS, tau_s, lists=None)
    for run in RUNS.tolist():
        plain = [series(run).path(tau_s * 1e9, int(t), stamps.tolist()) for t in stamps]
        np.testing.assert_allclose(ours[run], plain, rtol=1e-9, atol=1e-9)
        plain = [series(run).path(tau_s * 1e9, int(t), None) for t in stamps]
        np.testing.assert_allclose(common[run], plain, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("every_s", "lasts_s"), [(0.5, 0.2), (0.05, 1.0), (3.0, 0.4)])
def test_births_are_what_their_definition_says(every_s: float, lasts_s: float) -> None:
    from_ns, until_ns = T0, T0 + 2_000_000_000
    random_key = row_address(np.zeros(1, dtype=np.int64))
    ours = draw_births(
        DICE, "p", random_key, RUNS, every_s=every_s, lasts_s=lasts_s, from_ns=from_ns, until_ns=until_ns
    )
    plain = [
        (run, 0, *one)
        for run in RUNS.tolist()
        for one in series(run).births(every_s * 1e9, lasts_s * 1e9, from_ns, until_ns)
    ]
    columns = (ours.run_ix, ours.row_ix, ours.address_ns, ours.born_ns, ours.gone_ns)
    found = list(zip(*(column.tolist() for column in columns), strict=True))
    assert plain
    assert [one[:3] for one in found] == [one[:3] for one in plain]
    np.testing.assert_allclose(np.array(found)[:, 3:] - T0, np.array(plain)[:, 3:] - T0, atol=2)


def both(tau_s: float, random_key: RandomKey, lists: ListStamps, runs: Int = RUNS, **more: Any) -> Float:
    """Both kinds of numbers, one above the other."""
    return np.concatenate([
        draw_held_uniforms(DICE, "p", random_key, runs, tau_s, **more),
        draw_correlated_normals(DICE, "p", random_key, runs, tau_s, lists=lists, **more),
        draw_correlated_normals(DICE, "p", random_key, runs, tau_s, lists=None, **more),
    ])  # fmt: skip


@given(
    tau_s=st.sampled_from(TAUS),
    rate_hz=st.sampled_from([3.0, 10.0, 47.0]),
    pick=st.lists(st.booleans(), min_size=60, max_size=60),
    order=st.randoms(use_true_random=False),
)
def test_rows_asked_for_in_any_way_have_the_same_bits(
    tau_s: float, rate_hz: float, pick: list[bool], order: Any
) -> None:
    """Some rows only, begun anywhere, in any order, of two objects mixed, or masked: lists are always all there."""
    stamps = stamps_at(rate_hz, 30 / rate_hz, seed=2)[:30]
    random_key = RandomKey(
        ("u",),
        np.zeros(60, dtype=np.int64),
        np.repeat(object_words(["a", "b"]), 30),
        np.tile(stamps, 2),
    )
    lists = ListStamps(stamps, np.zeros(30, dtype=np.int64), np.tile(np.arange(30), 2))
    whole = both(tau_s, random_key, lists)
    rows = np.flatnonzero(pick)
    np.testing.assert_array_equal(both(tau_s, random_key.take(rows), lists.take(rows)), whole[:, rows])
    shuffled = rows.tolist()
    order.shuffle(shuffled)
    rows = np.array(shuffled, dtype=np.int64)
    np.testing.assert_array_equal(both(tau_s, random_key.take(rows), lists.take(rows)), whole[:, rows])
    where = np.array([order.random() < 0.5 for _ in range(180)]).reshape(3, 60)
    masked = both(tau_s, random_key, lists, where=where)
    np.testing.assert_array_equal(masked, np.where(np.tile(where, (3, 1)), whole, 0))
    alone = both(tau_s, random_key, lists, runs=np.array([2]))
    np.testing.assert_array_equal(alone, whole[2::3])


def test_other_units_in_the_batch_change_nothing() -> None:
    stamps, others = stamps_at(10, 3), stamps_at(7, 3, seed=4)
    random_key = RandomKey(
        ("other", "u"),
        np.repeat([0, 1], [len(others), len(stamps)]),
        np.repeat(object_words(["o"]), len(others) + len(stamps)),
        np.concatenate([others, stamps]),
    )
    lists = ListStamps(random_key.stamp_ns, random_key.unit_ix, np.arange(len(random_key.stamp_ns)))
    together = both(0.8, random_key, lists)[:, len(others) :]
    np.testing.assert_array_equal(together, both(0.8, row_address(stamps), lists_of(stamps)))


def test_held_is_the_same_at_any_list_rate() -> None:
    """Twenty lists a second, every other one of them: the bits of ten."""
    for tau_s in TAUS:
        twice = draw_held_uniforms(DICE, "p", row_address(stamps_at(20, 10)), RUNS, tau_s)
        np.testing.assert_array_equal(
            twice[:, ::2], draw_held_uniforms(DICE, "p", row_address(stamps_at(10, 10)), RUNS, tau_s)
        )


def test_a_window_changes_draws_of_the_leaf_it_cuts_only() -> None:
    stamps = stamps_at(50, 3)
    whole = draw_correlated_normals(DICE, "p", row_address(stamps), RUNS, 0.5, lists=lists_of(stamps))
    for first in range(1, 30):
        rest = stamps[first:]
        cut = draw_correlated_normals(DICE, "p", row_address(rest), RUNS, 0.5, lists=lists_of(rest))
        later = (rest >> LEAF) > (rest[0] >> LEAF)
        np.testing.assert_array_equal(cut[:, later], whole[:, first:][:, later])


def test_common_addresses() -> None:
    """What has no unit in its address is common to units, what has no object is common to objects."""
    stamps = stamps_at(10, 1)
    pairs = {(u, o): row_address(stamps, u, o) for u in "uv" for o in "ab"}

    def alike(of: Any, one: tuple[str, str], two: tuple[str, str]) -> bool:
        a, b = (draw_held_uniforms(DICE, "p", drop_unshared(pairs[pair], of), RUNS, 1.0) for pair in (one, two))
        return bool((a == b).all())

    u_a, u_b, v_a, v_b = ("u", "a"), ("u", "b"), ("v", "a"), ("v", "b")
    expected = {
        "pair": (False, False, False),
        "unit": (True, False, False),
        "object": (False, True, False),
        "all": (True, True, True),
    }
    for of, (objects, units, both_differ) in expected.items():
        assert (alike(of, u_a, u_b), alike(of, u_a, v_a), alike(of, u_a, v_b)) == (objects, units, both_differ), of
    forever = DICE.uniform("p", drop_capture(pairs[u_a]), RUNS)
    assert (forever == forever[:, :1]).all()


# ---- laws ---------------------------------------------------------------------------------------------------------

MANY = np.arange(4000)


@pytest.mark.parametrize("tau_s", [0.05, 1.0, 10.0])
def test_marginals(tau_s: float) -> None:
    """From the first list on; at a list in the middle of a leaf, and at one after a gap of 3 s."""
    stamps = np.concatenate([stamps_at(10, 0.4, seed=5), stamps_at(10, 4, seed=6, from_s=3.5)])
    u = draw_held_uniforms(DICE, "p", row_address(stamps), MANY, tau_s)
    z = draw_correlated_normals(DICE, "p", row_address(stamps), MANY, tau_s, lists=lists_of(stamps))
    common = draw_correlated_normals(DICE, "q", row_address(stamps), MANY, tau_s, lists=None)
    for k in (0, 2, 3, 4, len(stamps) - 1):
        assert stats.kstest(u[:, k], stats.uniform.cdf).pvalue > 1e-4
        assert stats.kstest(z[:, k], stats.norm.cdf).pvalue > 1e-4
        assert stats.kstest(common[:, k], stats.norm.cdf).pvalue > 1e-4
    assert 0 < u.min() < u.max() < 1


@pytest.mark.parametrize("tau_s", [0.05, 1.0, 10.0])
@pytest.mark.parametrize("rate_hz", [1.0, 7.0, 10.0, 50.0])
def test_autocorrelation(tau_s: float, rate_hz: float) -> None:
    """e^(−Δ/τ) between any two stamps, jittered, and across a gap of 3 s; over 4000 independent runs."""
    stamps = np.concatenate([
        stamps_at(rate_hz, 6 / rate_hz, seed=7), stamps_at(rate_hz, 9 / rate_hz + 3, seed=8, from_s=6 / rate_hz + 3),
    ])  # fmt: skip
    expected = np.exp(-np.abs(np.subtract.outer(stamps, stamps)) * 1e-9 / tau_s)
    u = draw_held_uniforms(DICE, "p", row_address(stamps), MANY, tau_s)
    for values, se_of in (
        ((u - 0.5) * np.sqrt(12), 1.2),
        (draw_correlated_normals(DICE, "p", row_address(stamps), MANY, tau_s, lists=lists_of(stamps)), 1.5),
    ):
        found = values.T @ values / len(MANY)  # a dense sample covariance; the means are known
        assert np.abs(found - expected).max() < 4.5 * se_of / np.sqrt(len(MANY))


def test_a_shared_path_is_off_by_its_millisecond_only() -> None:
    stamps = stamps_at(10, 1.2, seed=9)
    z = draw_correlated_normals(DICE, "p", row_address(stamps), MANY, 0.5, lists=None)
    expected = np.exp(-np.abs(np.subtract.outer(stamps, stamps)) * 1e-9 / 0.5)
    assert np.abs(z.T @ z / len(MANY) - expected).max() < 4.5 * 1.5 / np.sqrt(len(MANY)) + 0.002


@pytest.mark.parametrize("rate_hz", [10.0, 50.0])
def test_drifting_is_normal_jointly(rate_hz: float) -> None:
    """Whitened by the covariance of the process, all coordinates are independent standard normals: χ² of their sum."""
    stamps = stamps_at(rate_hz, 20 / rate_hz, seed=3)[:20]
    z = draw_correlated_normals(DICE, "p", row_address(stamps), MANY, 0.7, lists=lists_of(stamps))
    covariance = np.exp(-np.abs(np.subtract.outer(stamps, stamps)) * 1e-9 / 0.7)
    white = np.linalg.solve(np.linalg.cholesky(covariance), z.T)
    assert stats.kstest((white**2).sum(axis=0), stats.chi2(len(stamps)).cdf).pvalue > 1e-4
    assert stats.kstest(white.ravel(), stats.norm.cdf).pvalue > 1e-4
    step = np.diff(z, axis=1)
    assert abs(stats.kurtosis(step, axis=0, fisher=False).mean() - 3) < 0.1


def test_renewals_are_poisson() -> None:
    """Gaps between them are exponential, counts per cell and per second are Poisson's."""
    stamps = T0 + np.arange(0, 200_000_000_000, 5_000_000)  # every 5 ms
    drawn_by = renewal_stamps(DICE, "p", row_address(stamps), np.arange(8), 0.5)
    changes = np.diff(drawn_by, axis=1) != 0
    at = [np.flatnonzero(one) * 0.005 for one in changes]
    gaps = np.concatenate([np.diff(one) for one in at])
    assert abs(gaps.mean() - 0.5) < 4 * 0.5 / np.sqrt(len(gaps))
    jitter = np.random.default_rng(0).uniform(-0.0025, 0.0025, len(gaps))  # seen every 5 ms only
    assert stats.kstest(gaps + jitter, stats.expon(scale=0.5).cdf).statistic < 0.02
    per_second = np.concatenate([np.histogram(one, np.arange(0, 200))[0] for one in at])
    observed = np.bincount(np.minimum(per_second, 6), minlength=7)
    law = stats.poisson(2)
    expected = len(per_second) * np.append(law.pmf(np.arange(6)), law.sf(5))
    assert stats.chisquare(observed, expected).pvalue > 1e-4


def test_births_are_as_many_and_as_old_as_said() -> None:
    """At any instant Poisson(lasts / every) live; born ones of a second are Poisson(1 / every); lives exponential."""
    random_key = row_address(np.zeros(1, dtype=np.int64))
    at = T0 + 1_234_567_890
    alive = draw_births(DICE, "p", random_key, MANY, every_s=0.5, lasts_s=0.8, from_ns=at, until_ns=at + 1)
    counts = np.bincount(np.bincount(alive.run_ix, minlength=len(MANY)), minlength=8)
    law = stats.poisson(1.6)
    expected = len(MANY) * np.append(law.pmf(np.arange(7)), law.sf(6))
    assert stats.chisquare(np.append(counts[:7], counts[7:].sum()), expected).pvalue > 1e-4
    assert ((alive.born_ns <= at) & (alive.gone_ns > at)).all()
    second = draw_births(DICE, "p", random_key, MANY, every_s=0.5, lasts_s=0.8, from_ns=T0, until_ns=T0 + 10**9)
    born = second.born_ns >= T0
    assert stats.kstest((second.gone_ns - second.born_ns)[born] * 1e-9, stats.expon(scale=0.8).cdf).pvalue > 1e-4
    assert abs(born.sum() - 2 * len(MANY)) < 4 * np.sqrt(2 * len(MANY))
    keys = set(zip(second.run_ix.tolist(), second.address_ns.tolist(), strict=True))
    assert len(keys) == len(second.run_ix)


def test_births_of_parts_of_the_time_are_those_of_the_whole() -> None:
    random_key = RandomKey(("u",), np.zeros(2, dtype=np.int64), object_words(["a", "b"]), np.zeros(2, dtype=np.int64))

    def found(from_ns: int, until_ns: int) -> set[tuple[int, ...]]:
        one = draw_births(DICE, "p", random_key, RUNS, every_s=0.3, lasts_s=0.4, from_ns=from_ns, until_ns=until_ns)
        return {
            (int(a), int(b), int(c), int(d), int(e))
            for a, b, c, d, e in zip(one.run_ix, one.row_ix, one.address_ns, one.born_ns, one.gone_ns, strict=True)
        }

    cut, end = T0 + 1_300_000_001, T0 + 3_000_000_000
    assert found(T0, cut) | found(cut, end) == found(T0, end)
    assert {one[1] for one in found(T0, end)} == {0, 1}


def test_levels() -> None:
    assert [dyadic_level(x) for x in (1.0, 2.0, 3.0, 1e9)] == [0, 1, 2, 30]

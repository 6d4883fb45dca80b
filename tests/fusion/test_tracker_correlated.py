"""The tracker where errors last and are common: limits, numbers by hand, and the filter written out plainly."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import njit
from pydantic import ValidationError
from scipy.optimize import minimize_scalar

from copem_replay.core.object_list import Entries, Inputs
from copem_replay.fusion.tracker import Tracker
from copem_replay.fusion.tracker_kernel import propagate_covariance, update_split
from tests.fusion.test_tracker import LATE, fuse, fuse_one, street
from tests.helpers.reports import entry, inputs_of

propagate_covariance, update_split = map(njit, (propagate_covariance, update_split))  # as kernels call them

Array = npt.NDArray[Any]
STILL: dict[str, Any] = {
    "acceleration_psd_m2ps3": 1e-12, "speed_sigma_mps": 1e-6, "confirm_s": 0.0, "publish": 0.0, "drop": 0.0,
}  # fmt: skip


def looks(times_s: list[float], units: list[str], x_m: list[float] | None = None) -> Inputs:
    """One object at rest, as many lists, each at once there."""
    places = x_m or [0.0] * len(times_s)
    return inputs_of([[entry(x) for x in places]], units, times_s, times_s)


def last_variance(inputs: Inputs, **settings: Any) -> float:
    return float(fuse_one(inputs, **STILL, **settings)[-1]["cov_ee_m2"][0])


# ------------------------------------------------------------------------------------------------ errors that last


@pytest.mark.parametrize("late", LATE)
@pytest.mark.parametrize("times_s", [[0.0, 0.1, 0.2, 0.3], [0.0, 0.05, 0.5, 0.6, 3.0]])
def test_an_object_at_rest_gets_the_variance_of_the_best_linear_estimate(late: str, times_s: list[float]):
    # Errors of unit variance with correlation e^(−Δ/τ): 1/Σᵢⱼ(S⁻¹)ᵢⱼ, however uneven the times are.
    tau_s = 0.4
    t = np.array(times_s)
    S = np.exp(-np.abs(t[:, None] - t) / tau_s)
    best = 1 / np.linalg.inv(S).sum()
    found = last_variance(looks(times_s, ["a"] * len(t)), late=late, errors_last_s=tau_s)
    assert found == pytest.approx(best, rel=1e-6)


def test_a_second_entry_counts_as_one_of_more_variance():
    # φ = e^(−1): R (1 + φ)/(1 − φ) = 2.16395; 1/(1 + 1/2.16395).
    found = last_variance(looks([0.0, 0.5], ["a", "a"]), errors_last_s=0.5)
    assert found == pytest.approx(1 / (1 + 1 / 2.16395), rel=1e-5)


def test_units_do_not_share_what_lasts():
    one_after_the_other = looks([0.0, 0.1, 0.2], ["a", "b", "c"])
    assert last_variance(one_after_the_other, errors_last_s=10.0) == pytest.approx(1 / 3, rel=1e-6)


def test_what_lasts_far_longer_than_the_time_between_lists_says_nothing_new():
    many = looks([k / 10 for k in range(11)], ["a"] * 11, [0.0] + [0.5] * 10)
    (found,) = fuse_one(many, **STILL, errors_last_s=1e12)[-1]
    assert found["cov_ee_m2"] == pytest.approx(1.0, rel=1e-6)
    assert found["x_m"] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("late", LATE)
def test_what_hardly_lasts_is_fresh(late: str):
    inputs = street(4, runs=2)
    plain, found = fuse(inputs, late=late), fuse(inputs, late=late, errors_last_s=1e-4)
    assert sum(len(one) for run in plain for one in run) > 20
    for run, other in zip(plain, found, strict=True):
        for one, two in zip(run, other, strict=True):
            assert one.tobytes() == two.tobytes()


def test_claims_count_whatever_the_errors_do():
    # What is the same once more adds nothing to the place, but that it is there.
    twice = looks([0.0, 0.9], ["a", "a"])
    plain, lasting = (fuse_one(twice, **STILL, **more)[-1] for more in ({}, {"errors_last_s": 1e12}))
    assert lasting["existence"] == plain["existence"]
    assert lasting["captured_s"] == [0.9]


# ------------------------------------------------------------------------------------------------ common errors


def plain_split(
    x: Array, P: Array, common: Array, z: Array, R: Array, share: float, grown: float
) -> tuple[Array, Array, Array]:
    """The filter as its authors wrote it, ω by a bounded search."""
    H = np.eye(2, 4)

    def parts(omega: float) -> tuple[Array, Array, Array, Array]:
        P1 = common / omega + (P - common)
        R1 = share * R / (1 - omega) + (1 - share) * grown * R
        K = P1 @ H.T @ np.linalg.inv(H @ P1 @ H.T + R1)
        return P1, R1, K, (np.eye(4) - K @ H) @ P1

    found = minimize_scalar(
        lambda omega: np.linalg.slogdet(parts(omega)[3])[1], bounds=(1e-6, 1 - 1e-6), method="bounded",
        options={"xatol": 1e-10},
    )  # fmt: skip
    _, _, K, after = parts(found.x)
    left = np.eye(4) - K @ H
    own = left @ (P - common) @ left.T + K @ ((1 - share) * grown * R) @ K.T
    return x + K @ (z - H @ x), after, after - own


@given(st.integers(0, 2**32 - 1), st.floats(0.05, 1.0), st.floats(0.1, 0.9), st.sampled_from([1.0, 3.0]))
def test_the_update_is_the_one_written_out(seed: int, share: float, of_track: float, grown: float):
    rng = np.random.default_rng(seed)
    root, small = rng.normal(size=(4, 4)), rng.normal(size=(2, 2))
    P, R = root @ root.T + 0.1 * np.eye(4), small @ small.T + 0.1 * np.eye(2)
    x, z, common = rng.normal(size=4), rng.normal(size=2), of_track * P
    expected = plain_split(x, P, common, z, R, share, grown)
    state, after, held = x.copy(), P.copy(), common.copy()
    update_split(state, after, held, np.array([*z, R[0, 0], R[0, 1], R[1, 1]]), share, grown)
    assert np.linalg.slogdet(after)[1] <= np.linalg.slogdet(expected[1])[1] + 1e-6
    assert state == pytest.approx(expected[0], abs=2e-3)
    assert after == pytest.approx(expected[1], abs=2e-3 * np.trace(P))
    assert held == pytest.approx(expected[2], abs=2e-3 * np.trace(P))
    for whole in (after, held, after - held):
        assert np.linalg.eigvalsh(whole).min() >= -1e-9 * np.trace(P)


def test_the_common_part_passes_time_without_noise():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(4, 4))
    common = root @ root.T
    F = np.eye(4) + 0.3 * np.eye(4, k=2)
    expected = F @ common @ F.T
    propagate_covariance(common, 0.3)
    assert common == pytest.approx(expected)


@pytest.mark.parametrize("n", [2, 5, 20])
def test_the_common_part_of_equal_entries_does_not_shrink_and_the_rest_does(n: int):
    # At rest, n units at one instant: share + (1 − share)/n, as by split covariance intersection of all at once.
    names = [f"unit {k}" for k in range(n)]
    found = last_variance(looks([0.0] * n, names), common_share=0.4)
    assert found == pytest.approx(0.4 + 0.6 / n, rel=1e-4)


def test_nothing_common_is_the_filter_as_it_was():
    inputs = street(5, runs=2)
    for run, other in zip(fuse(inputs), fuse(inputs, common_share=0.0), strict=True):
        for one, two in zip(run, other, strict=True):
            assert one.tobytes() == two.tobytes()


def test_a_small_share_is_nearly_the_filter_as_it_was():
    inputs = street(6)
    for one, two in zip(fuse_one(inputs), fuse_one(inputs, common_share=1e-9), strict=True):
        assert two["x_m"] == pytest.approx(one["x_m"], abs=1e-2)
        assert two["cov_ee_m2"] == pytest.approx(one["cov_ee_m2"], rel=1e-2)


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_repeating_what_is_common_never_makes_sure(share: float):
    many = looks([k / 10 for k in range(31)], ["a"] * 31)
    found = last_variance(many, common_share=share)
    assert share * (1 - 1e-6) <= found <= 1 + 1e-6


def test_with_both_the_rest_lasts_and_the_common_part_stays():
    # Common .4; of the rest .6, the second counts as R (1 + φ)/(1 − φ) with φ = e^(−1).
    found = last_variance(looks([0.0, 0.5], ["a", "a"]), common_share=0.4, errors_last_s=0.5)
    grown = (1 + math.exp(-1)) / (1 - math.exp(-1))
    best = minimize_scalar(
        lambda w: 1 / (1 / (0.4 / w + 0.6) + 1 / (0.4 / (1 - w) + 0.6 * grown)), bounds=(1e-6, 1 - 1e-6),
        method="bounded", options={"xatol": 1e-10},
    )  # fmt: skip
    assert found == pytest.approx(best.fun, rel=1e-5)


# ------------------------------------------------------------------------------------------------ what it is for


def nees(runs: int, tau_s: float | None, common: float, **settings: Any) -> float:
    """Mean NEES (2: honest) of the last place of objects at rest, which three units list ten times a second for 3 s.

    Of each error, unit variance per axis, `common` is one for all units and lists; the rest decays with τ.
    """
    rng = np.random.default_rng(1)
    n, units = 31, 3
    decay = math.exp(-0.1 / tau_s) if tau_s else 0.0
    shared = rng.normal(size=(runs, 2)) * math.sqrt(common)
    error = rng.normal(size=(runs, units, 2))
    lists: list[list[Entries]] = [[] for _ in range(runs)]
    for k in range(n):
        if k:
            error = decay * error + math.sqrt(1 - decay**2) * rng.normal(size=error.shape)
        for run in range(runs):
            for place in shared[run] + math.sqrt(1 - common) * error[run]:
                lists[run].append(entry(*place))
    at_s = np.repeat(np.arange(n) / 10, units).tolist()
    found = fuse(inputs_of(lists, ["a", "b", "c"] * n, at_s, at_s), **STILL, **settings)
    last = [run[-1] for run in found]
    assert all(len(one) == 1 for one in last)
    return float(np.mean([one["x_m"][0] ** 2 / one["cov_ee_m2"][0] + one["y_m"][0] ** 2 / one["cov_nn_m2"][0]
                          for one in last]))  # fmt: skip


def test_said_that_they_last_and_are_common_they_are_judged_honestly():
    # In every list fresh and independent, they would be averaged away: far too sure.
    wide: dict[str, Any] = {"gate": 1 - 1e-12}
    assert nees(100, 1.0, 0.0, **wide) > 6
    assert 1.4 < nees(100, 1.0, 0.0, **wide, errors_last_s=1.0) < 2.6
    assert nees(100, None, 0.5, **wide) > 20
    assert 1.0 < nees(100, None, 0.5, **wide, common_share=0.5) < 2.8


# ------------------------------------------------------------------------------------------------ the keys


def test_an_experiment_that_is_written_back_says_them_only_where_they_were_said():
    assert not {"errors_last_s", "common_share"} & set(Tracker().model_dump())
    assert Tracker(errors_last_s=0.5).model_dump()["errors_last_s"] == 0.5
    assert Tracker(common_share=0.0).model_dump()["common_share"] == 0.0


@pytest.mark.parametrize(
    "settings", [{"errors_last_s": 0.0}, {"errors_last_s": -1.0}, {"common_share": 1.1}, {"common_share": -0.1}]
)
def test_settings_that_make_no_sense_are_refused(settings: dict[str, Any]):
    with pytest.raises(ValidationError):
        Tracker(**settings)

"""The offset between two lists of the same traffic: put in, and found again, with an interval; or said not to be told.

Over more seeds and recordings: tools/check_time_offsets.py.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from copem_replay.core.tracks import Float
from copem_replay.io.clock_offset import TimeOffset, estimate_time_offset, find_half_width
from copem_replay.io.short_tracks import ListPoints, follow_points, short_tracks
from tools.check_time_offsets import listed, tried

CROSSING = Path(__file__).parents[2] / "logs/crossing.mcap"


def way(time_s: Float, speed_mps: float, start_m: float = 0.0) -> tuple[Float, Float]:
    """An object that brakes and goes on, and turns a little."""
    along_m = start_m + speed_mps * time_s + 4.0 * np.sin(time_s / 2.0) * speed_mps / 10.0
    return along_m, 10.0 * np.sin(along_m / 40.0)


def entries(
    rate_hz: float, ahead_s: float = 0.0, *, speeds: tuple[float, ...] = (8.0, -6.0, 11.0), sigma_m: float = 0.0,
    seed: int = 0, long_s: float = 20.0, ids: bool = True, rate_of_clock: float = 0.0,
) -> ListPoints:  # fmt: skip
    """Lists of objects that drive side by side, by a clock that is ahead."""
    rng = np.random.default_rng(seed)
    since_s = np.arange(0.0, long_s, 1 / rate_hz)
    rows = []
    for k, speed_mps in enumerate(speeds):
        x, y = way(since_s, speed_mps)
        rows.append(np.stack([since_s, np.arange(len(since_s)), x, y + 30.0 * k, np.full(len(since_s), k)]))
    time_s, list_ix, x, y, track = np.concatenate(rows, axis=1)
    order = np.argsort(list_ix, kind="stable")
    error_m = rng.normal(0, sigma_m, (2, len(order))) if sigma_m else np.zeros((2, len(order)))
    clock_s = time_s + ahead_s + rate_of_clock * time_s
    ident = track[order].astype(np.int64) if ids else np.full(len(order), -1)
    return ListPoints(
        clock_s[order], list_ix[order].astype(np.int64), x[order] + error_m[0], y[order] + error_m[1], ident
    )


@settings(max_examples=15, deadline=None)  # each estimates the offset of 20 s of lists twice
@given(st.floats(-1.5, 1.5), st.sampled_from([5.0, 10.0, 25.0]), st.sampled_from([4.0, 10.0, 20.0]))
def test_exact_lists_give_the_offset_that_was_put_in(offset_s: float, first_hz: float, second_hz: float) -> None:
    found = estimate_time_offset(entries(first_hz), entries(second_hz, offset_s))
    assert found.untold is None
    assert found.offset_s == pytest.approx(offset_s, abs=0.003)
    turned = estimate_time_offset(entries(second_hz, offset_s), entries(first_hz))
    assert turned.offset_s == pytest.approx(-offset_s, abs=0.003)


@pytest.mark.long
def test_pairs_of_lists_with_errors_of_half_a_metre() -> None:
    """A few seeds of what the tool tries forty of: rates, misses, ids or none, offsets from -1 to 1 s."""
    from copem_replay.io.recording import read_log

    recording = read_log(CROSSING, name="crossing")
    found = [tried(recording, seed, truth=truth) for seed in range(8) for truth in (False, True)]
    assert all(one.untold is None for _, one in found)
    assert max(abs(one.offset_s - true_s) for true_s, one in found) <= 0.02
    assert sum(one.low_s <= true_s <= one.high_s for true_s, one in found) >= 14


def test_the_interval_widens_with_the_errors() -> None:
    widths = []
    for sigma_m in (0.2, 0.8):
        found = estimate_time_offset(entries(10, sigma_m=0.0), entries(10, 0.3, sigma_m=sigma_m, seed=4))
        assert found.low_s < 0.3 < found.high_s
        widths.append(found.high_s - found.low_s)
    assert 2.5 < widths[1] / widths[0] < 6.0


def test_what_is_shifted_along_the_way_is_not_late_where_speeds_tell() -> None:
    """A unit that reports the front of an object that is two metres long each way."""
    straight = entries(10)
    ahead_m = 0.6
    heading = np.sign(np.array([8.0, -6.0, 11.0]))[straight.track]
    shifted = replace(entries(10, 0.2, sigma_m=0.1), x_m=entries(10, 0.2, sigma_m=0.1).x_m + ahead_m * heading)
    found = estimate_time_offset(straight, shifted, shifted=True)
    assert not found.unbiased
    assert found.offset_s == pytest.approx(0.2, abs=0.02)


def test_at_one_speed_a_shift_cannot_be_told_from_an_offset_and_it_is_said() -> None:
    def steady(ahead_s: float) -> ListPoints:
        t = np.arange(0, 20, 0.1)
        jitter = np.random.default_rng(3).normal(0, 0.1, (2, len(t)))
        return ListPoints(
            t + ahead_s, np.arange(len(t)), 10 * t + jitter[0], jitter[1], np.zeros(len(t), dtype=np.int64)
        )

    found = estimate_time_offset(steady(0.0), steady(0.25), shifted=True)
    assert found.untold is None
    assert found.unbiased
    assert found.offset_s == pytest.approx(0.25, abs=0.01)


def test_the_width_of_an_interval_by_hand() -> None:
    """Three blocks and one coefficient leave two degrees of freedom: t(2) = 4.303, over √3 of the blocks."""
    score, information = np.array([[1.0], [-1.0], [0.0]]), np.ones((3, 1, 1))
    # Blocks move it by 1/3, −1/3, 0, each with a variance of 1/9: a ratio of (1 + 1 + 0) / 2 = 1.
    assert find_half_width(score, information, 0) == pytest.approx(4.302653 / math.sqrt(3))
    assert find_half_width(2 * score, information, 0) == pytest.approx(2 * 4.302653 / math.sqrt(3))  # Birge: √4
    assert find_half_width(0.1 * score, information, 0) == pytest.approx(4.302653 / math.sqrt(3))  # never narrower
    # Of two coefficients one degree is left: t(1) = 12.706.
    two = np.array([np.eye(2)] * 3)
    assert find_half_width(np.zeros((3, 2)), two, 1) == pytest.approx(12.7062 / math.sqrt(3), rel=1e-5)


def test_reversed() -> None:
    """Clock a against clock b, from b against a: limits change sides with their signs."""
    turned = TimeOffset(0.2, 0.1, 0.5, entries=7, drift=(1e-3, 5e-4, 2e-3), unbiased=True).reversed()
    assert turned == TimeOffset(-0.2, -0.5, -0.1, entries=7, drift=(-1e-3, -2e-3, -5e-4), unbiased=True)
    assert TimeOffset(untold="why").reversed().drift is None


def test_drift_is_told_of_a_minute_and_no_less() -> None:
    long = estimate_time_offset(
        entries(5, long_s=90.0), entries(10, 0.1, long_s=90.0, sigma_m=0.3, rate_of_clock=0.001)
    )
    assert long.drift is not None
    drift, low, high = long.drift
    assert low < 0.001 < high
    assert drift == pytest.approx(0.001, abs=0.0004)
    assert estimate_time_offset(entries(5), entries(10, 0.1)).drift is None


@pytest.mark.parametrize(
    ("other", "why"),
    [
        (entries(10, 4.0), "it is not within -2 … 2 s"),
        (entries(10, speeds=(0.2, 0.1)), "fewer than 20 entries of moving objects are in both"),
        (replace(entries(10), x_m=entries(10).x_m + 5000), "fewer than 20 entries of moving objects are in both"),
        (entries(10).take(np.arange(6)), "fewer than 20 entries of moving objects are in both"),
    ],
)
def test_what_cannot_be_told_is_said(other: ListPoints, why: str) -> None:
    reference = entries(10, speeds=(0.2, 0.1)) if other.x_m.max() < 20 and len(other.x_m) > 20 else entries(10)
    found = estimate_time_offset(reference, other)
    assert found.untold is not None
    assert found.untold == why or "not within" in why


def test_a_row_of_equal_gaps_fits_at_several_offsets() -> None:
    """Cars at 10 m/s, one every 10 m: the one behind is where the one ahead was a second ago."""
    t = np.repeat(np.arange(0, 20, 0.1), 30)
    k = np.tile(np.arange(30), 200)
    column = ListPoints(t, np.repeat(np.arange(200), 30), 10 * t - 10.0 * k, np.zeros(len(t)), k)
    found = estimate_time_offset(column, column)
    assert found.untold is not None
    assert found.untold.endswith("fit equally well")


class TestFollowed:
    def test_without_ids_tracks_are_those_of_the_objects(self) -> None:
        known, blind = entries(10, sigma_m=0.2), entries(10, sigma_m=0.2, ids=False)
        track = follow_points(blind, 0.5)
        assert len(np.unique(track)) == 3
        assert len(np.unique(np.stack([track, known.track]), axis=1).T) == 3

    def test_what_is_gone_for_long_is_another_one(self) -> None:
        whole = entries(10, speeds=(8.0,), ids=False)
        track = follow_points(whole.take(np.flatnonzero((whole.time_s < 5) | (whole.time_s > 8))), 0.5)
        assert len(np.unique(track)) == 2

    def test_velocities_are_those_of_the_way(self) -> None:
        tracks = short_tracks(entries(10, speeds=(9.0,), sigma_m=0.1))
        expected = 9.0 + 2.0 * np.cos(tracks.time_s / 2.0) * 0.9
        assert np.abs(tracks.velocity[0] - expected).max() < 0.4

    def test_what_is_listed_many_times_at_one_time_has_no_velocity(self) -> None:
        """One object at 3 m/s in eleven lists; another nine times in the sixth of them, and nowhere else."""
        time_s = np.append(np.arange(11) * 0.1, np.full(9, 0.5))
        list_ix = np.append(np.arange(11), np.full(9, 5))
        order = np.argsort(list_ix, kind="stable")
        points = ListPoints(time_s, list_ix, 3.0 * time_s, np.zeros(20), np.append(np.zeros(11, int), np.ones(9, int)))
        tracks = short_tracks(points.take(order))
        assert tracks.time_s == pytest.approx([0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8])
        assert tracks.velocity[0] == pytest.approx([3.0] * 7)


def test_the_tool_lists_with_misses_and_errors() -> None:
    from copem_replay.io.recording import read_log

    recording = read_log(CROSSING, name="crossing")
    found = listed(recording, np.random.default_rng(1), 10.0, 0.5, ids=False, ahead_s=0.5)
    every = listed(recording, np.random.default_rng(1), 10.0, 1.0, ids=True, ahead_s=0.5)
    assert 0.4 < len(found.x_m) / len(every.x_m) < 0.6
    assert isinstance(estimate_time_offset(every, every), TimeOffset)

"""One way through two lists: the offset it tells, and how certain it says that is, against closed forms and repeats."""

from __future__ import annotations

import numpy as np
import pytest

from copem_replay.core.tracks import Float
from copem_replay.io.clock_offset import PIECE_S, JointWays, TrackPieces, cut_into_pieces, estimate_time_offset
from copem_replay.io.short_tracks import ListPoints

SPEED_MPS, LONG_S = 10.0, 3 * PIECE_S


def steady(count: int, ahead_s: float = 0.0, error_m: Float | float = 0.0) -> ListPoints:
    """A car at one speed, listed so many times by a clock that is ahead."""
    time_s = (np.arange(count) + 0.5) * LONG_S / count
    x_m, y_m = np.stack([SPEED_MPS * time_s, np.zeros(count)]) + error_m
    return ListPoints(time_s + ahead_s, np.arange(count), x_m, y_m, np.zeros(count, dtype=np.int64))


def cut(first: ListPoints, other: ListPoints, offset_s: float, faster_mps: float = 1.0) -> TrackPieces | None:
    return cut_into_pieces(first, other, np.zeros(len(other.time_s), dtype=np.int64), offset_s, faster_mps)


def test_exact_lists_tell_the_offset_from_wherever_the_search_begins() -> None:
    found = cut(steady(90), steady(60, 0.3), 0.35)
    assert found is not None
    assert len(found.middle_s) == 4  # what both have is 9 s and as much beside as counts
    fit = JointWays(found, 0.35, biased=False)
    assert fit.offset_s == pytest.approx(0.3, abs=1e-6)


def test_what_is_slow_is_in_no_piece() -> None:
    assert cut(steady(90), steady(60), 0.0, faster_mps=SPEED_MPS + 0.1) is None
    assert cut(steady(90), steady(60), 0.0, faster_mps=SPEED_MPS - 0.1) is not None


def test_the_offset_is_as_certain_as_mean_places_at_that_speed() -> None:
    """Two lists of n and m entries with errors of σ: σ √(1/n + 1/m) / v, and 6 % more by weights of Student's t."""
    found = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        lists = steady(90, error_m=rng.normal(0, 0.5, (2, 90))), steady(60, error_m=rng.normal(0, 0.5, (2, 60)))
        cuts = cut(*lists, 0.0)
        assert cuts is not None
        found.append(JointWays(cuts, 0.0, biased=False).offset_s)
    assert np.std(found) == pytest.approx(1.06 * 0.5 * np.sqrt(1 / 90 + 1 / 60) / SPEED_MPS, rel=0.15)


@pytest.mark.long
@pytest.mark.parametrize("lasting_s", [0.0, 1.0])
def test_intervals_hold_the_offset_whether_errors_last_or_not(lasting_s: float) -> None:
    """Four cars for a minute against the truth; errors are an Ornstein-Uhlenbeck process or new in every list."""
    inside = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        time_s = np.arange(0.0, 60.0, 0.2)
        kept = np.exp(-0.2 / lasting_s) if lasting_s else 0.0
        error_m = rng.normal(0, 0.5, (2, 4, len(time_s)))
        for k in range(1, len(time_s)):
            error_m[:, :, k] = kept * error_m[:, :, k - 1] + np.sqrt(1 - kept**2) * error_m[:, :, k]
        speed_mps = np.array([6.0, -8.0, 10.0, 12.0])[:, None]
        x_m, y_m = speed_mps * time_s, np.broadcast_to(40.0 * np.arange(4)[:, None], (4, len(time_s)))

        def of(east: Float, north: Float, ahead_s: float, stamps: Float = time_s) -> ListPoints:
            list_ix, track = np.repeat(np.arange(len(stamps)), 4), np.tile(np.arange(4), len(stamps))
            return ListPoints(stamps[list_ix] + ahead_s, list_ix, east.T.ravel(), north.T.ravel(), track)

        found = estimate_time_offset(of(x_m, y_m, 0.0), of(x_m + error_m[0], y_m + error_m[1], 0.2))
        assert found.untold is None
        inside += found.low_s <= 0.2 <= found.high_s
    assert inside >= 36

"""How far one object list's clock is ahead of another's, told by traffic that both list.

An entry of the one at stamp t shows what the other has at t − offset. Entries are matched at the offsets of a grid; at
the best, offset and what may be confused with it (a shift of the place, a bias along the way) are regressed on the
residuals of matched entries of moving objects, with weights of Student's t. Errors are correlated from list to list, so
that intervals come from leaving out blocks of time that are longer than that. Units are seconds and metres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from copem_replay.core.tracks import Float, Int
from copem_replay.io.short_tracks import Entries, ShortTracks, short_tracks

STEP_S = 0.05
"""Between the offsets that are tried (chosen: at 30 m/s no more than the width of the kernel)."""
KERNEL_M = 1.5
"""So far apart two entries of one object may well be (chosen)."""
GATE_M = 3.0
"""Farther apart no two entries are of one object: the gate of `match`."""
SLOW_MPS = 1.0
"""What is slower tells nothing of time (chosen)."""
FAST_MPS = 3.0
"""What is faster tells enough, where there is any: errors of half a metre are no velocity of that size (chosen)."""
FEWEST = 20
"""Matched entries, at least (chosen)."""
WIDEST_S = 0.1
"""An interval that reaches farther to a side tells nothing (chosen: two standard errors of 0.05 s)."""
BIAS_S = 0.05
"""A shift of the place and a bias along the way are told apart from the offset where its interval, with both of them
regressed, reaches no farther to a side (chosen)."""
DRIFT_FROM_S = 60.0
"""Of a shorter overlap no drift is told."""
RIVAL = 0.9
"""A second offset that fits so much as well as the best makes both doubtful (chosen)."""
_AT_MOST = 20_000  # entries of a list that are looked at (chosen)
_FOLLOWED = 0.5  # of the entries, at least, are followed in the list that the other is held against (chosen)
_SCORED = 2_000  # of them at every offset of the grid (chosen)
_STUDENT = 4.0  # degrees of freedom of the weights
_SHORTEST_S, _BLOCKS = 2.0, 6  # of a block; and so many there are at least, if they are not shorter (chosen)
_FEWEST_BLOCKS = 4
_FINEST_S = 0.001  # what smoothing and interpolation leave (chosen: the last digit that is said)
_CERTAIN = 1.7  # so many half intervals biases move the offset: else they would cost precision for nothing (chosen)


@dataclass(frozen=True)
class TimeOffset:
    """An offset with its 95 % interval, and `drift` in seconds per second with its own; or `untold`, why there is none.

    `entries`: how many matched entries of moving objects it is from. `unbiased`: it goes by entries that are not
    shifted along the way, which nothing in them tells from an offset.
    """

    offset_s: float = 0.0
    low_s: float = -np.inf
    high_s: float = np.inf
    entries: int = 0
    drift: tuple[float, float, float] | None = None  # and its interval; None: the overlap is too short to tell
    untold: str | None = None
    unbiased: bool = False


@dataclass(frozen=True)
class _Pairs:
    """Matched entries of moving objects, (K,) each: residuals along and across the way, and where and when."""

    along_m: Float
    across_m: Float
    speed_mps: Float
    heading: Float  # (2, K) unit vectors
    time_s: Float
    track: Int


def time_offset(
    reference: Entries, other: Entries, *, from_s: float = -2.0, to_s: float = 2.0, shifted: bool = False
) -> TimeOffset:
    """How far the clock of `other` is ahead of that of `reference`, if it is from `from_s` to `to_s`.

    `shifted`: entries are expected to be shifted, as of real units against the truth, and it is regressed wherever that
    can be told from an offset; else only where it is plain.
    """
    tracks = short_tracks(reference)
    if len(tracks.time_s) < _FOLLOWED * len(reference.time_s):
        turned = short_tracks(other)
        if len(turned.time_s) > len(tracks.time_s):
            return _turned(_offset(turned, reference.thinned(_AT_MOST), (-to_s, -from_s), shifted))
    return _offset(tracks, other.thinned(_AT_MOST), (from_s, to_s), shifted)


def _turned(found: TimeOffset) -> TimeOffset:
    """The same of lists in the other order."""
    drift = None if found.drift is None else (-found.drift[0], -found.drift[2], -found.drift[1])
    return replace(found, offset_s=-found.offset_s, low_s=-found.high_s, high_s=-found.low_s, drift=drift)


def _offset(tracks: ShortTracks, other: Entries, within_s: tuple[float, float], shifted: bool) -> TimeOffset:
    """How far the clock of `other` is ahead of that of the tracks."""
    from_s, to_s = within_s
    if not len(tracks.time_s) or not len(other.time_s):
        return TimeOffset(untold="nothing in them can be followed from list to list")
    grid = np.arange(round(from_s / STEP_S), round(to_s / STEP_S) + 1) * STEP_S
    few = other.thinned(_SCORED)
    score = np.array([_score(tracks, few, float(offset_s)) for offset_s in grid])
    best = int(score.argmax())
    if score[best] < FEWEST / 2:
        return TimeOffset(untold=f"fewer than {FEWEST} entries of moving objects are in both")
    if (rival := _rival(score, best)) is not None:
        return TimeOffset(untold=f"{grid[best]:.2f} s and {grid[rival]:.2f} s fit equally well")
    if best in (0, len(grid) - 1):
        return TimeOffset(untold=f"it is not within {from_s:g} … {to_s:g} s")
    found = TimeOffset(untold=f"fewer than {FEWEST} entries of moving objects are in both")
    # What is slow, too, where it is needed: to tell a shift from an offset speeds have to vary.
    for faster_mps in (SLOW_MPS,) if shifted else (FAST_MPS, SLOW_MPS):
        simple = _solved(tracks, other, float(grid[best]), faster_mps, biased=False)
        if simple is None:
            continue
        full = _solved(tracks, other, simple.offset_s, faster_mps, biased=True)
        if full is None or full.half_width(0) > BIAS_S:
            found = _told(simple, unbiased=True)
        else:
            biased = shifted or abs(full.offset_s - simple.offset_s) > _CERTAIN * full.half_width(0)
            found = _told(full if biased else simple)
        if found.untold is None:
            break
    return found


def _solved(tracks: ShortTracks, other: Entries, offset_s: float, faster_mps: float, *, biased: bool) -> _Fit | None:
    """The fit at the offset that it leads to; None: too little to go by."""
    for _ in range(20):
        pairs = _pairs(tracks, other, offset_s, faster_mps)
        if len(pairs.along_m) < FEWEST:
            return None
        fit = _Fit(pairs, offset_s, biased=biased)
        if abs(fit.solved[0]) < 1e-5:
            break
        offset_s += float(np.clip(fit.solved[0], -0.1, 0.1))
    return fit


def _told(fit: _Fit, *, unbiased: bool = False) -> TimeOffset:
    """The estimate with its interval, unless that is too wide."""
    if fit.blocks < _FEWEST_BLOCKS:
        return TimeOffset(untold="too short a time with moving objects in both")
    half_s, pairs = float(np.hypot(fit.half_width(0), _FINEST_S)), fit.pairs
    offset_s = fit.offset_s + float(fit.solved[0])
    found = TimeOffset(offset_s, offset_s - half_s, offset_s + half_s, len(pairs.along_m), unbiased=unbiased)
    if not half_s <= WIDEST_S:
        why = "nothing in both is fast enough, or varies enough in speed and direction"
        return replace(found, untold=f"{offset_s:.3f} ± {half_s:.3f} s, which is too wide: {why}")
    if np.ptp(pairs.time_s) < DRIFT_FROM_S:
        return found
    drifting = _Fit(pairs, fit.offset_s, biased=fit.biased, drift=True)
    drift, half = float(drifting.solved[-1]), drifting.half_width(-1)
    return replace(found, drift=(drift, drift - half, drift + half))


def _score(tracks: ShortTracks, other: Entries, offset_s: float) -> float:
    """How many entries lie near something that moves, at an offset."""
    _, _, away_m = tracks.nearest(other, offset_s, gate_m=GATE_M, faster_mps=SLOW_MPS)
    return float(np.exp(-0.5 * (away_m / KERNEL_M) ** 2).sum())


def _rival(score: Float, best: int) -> int | None:
    """Another offset that fits nearly as well, with worse ones in between; None: there is none."""
    for k in np.flatnonzero(score >= RIVAL * score[best]).tolist():
        between = score[min(k, best) : max(k, best) + 1]
        if between.min() < RIVAL * score[k]:
            return int(k)
    return None


def _pairs(tracks: ShortTracks, other: Entries, offset_s: float, faster_mps: float) -> _Pairs:
    """Entries that are nearest to each other, both ways, and what moves there."""
    mine, state, _ = tracks.nearest(other, offset_s, gate_m=GATE_M, faster_mps=faster_mps, mutual=True)
    velocity = state.velocity
    speed_mps = np.hypot(*velocity)
    heading = velocity / speed_mps
    east, north = other.x_m[mine] - state.x_m, other.y_m[mine] - state.y_m
    return _Pairs(
        east * heading[0] + north * heading[1],
        north * heading[0] - east * heading[1],
        speed_mps,
        heading,
        other.time_s[mine],
        state.track,
    )


class _Fit:
    """Robust least squares of residuals on what is missing of an offset, on biases, and on a drift, in this order."""

    def __init__(self, pairs: _Pairs, offset_s: float, *, biased: bool, drift: bool = False) -> None:
        self.pairs, self.offset_s, self.biased = pairs, offset_s, biased
        none, one = np.zeros_like(pairs.speed_mps), np.ones_like(pairs.speed_mps)
        cos, sin = pairs.heading
        along, across = [-pairs.speed_mps], [none]
        if biased:  # a shift to the east, to the north, along the way
            along, across = [*along, cos, sin, one], [*across, -sin, cos, none]
        if drift:
            along, across = [*along, -pairs.speed_mps * (pairs.time_s - pairs.time_s.mean())], [*across, none]
        self._weigh(np.stack(along, axis=1), np.stack(across, axis=1))
        self.block_of = self._blocks()
        self.blocks = int(self.block_of.max()) + 1

    def _weigh(self, along: Float, across: Float) -> None:
        """Weights and scales that go with the solution, a few times over."""
        pairs = self.pairs
        self.solved = np.zeros(along.shape[1])
        for _ in range(10):
            left = np.stack([pairs.along_m - along @ self.solved, pairs.across_m - across @ self.solved])
            scale_m = np.maximum(np.median(np.abs(left), axis=1) / 0.6745, 1e-3)
            weight = (_STUDENT + 2) / (_STUDENT + ((left / scale_m[:, None]) ** 2).sum(axis=0))
            self._each = _information(along, weight / scale_m[0] ** 2) + _information(across, weight / scale_m[1] ** 2)
            self._right = (
                along * (weight * pairs.along_m / scale_m[0] ** 2)[:, None]
                + across * (weight * pairs.across_m / scale_m[1] ** 2)[:, None]
            )
            self.solved = np.linalg.lstsq(self._each.sum(axis=0), self._right.sum(axis=0), rcond=None)[0]
        self._left_m = pairs.along_m - along @ self.solved
        # Weights follow what they weigh: a block that is left out moves the solution more than with its weights kept.
        far = ((left / scale_m[:, None]) ** 2).sum(axis=0)
        bent = weight - 2 * (_STUDENT + 2) * (left[0] / scale_m[0]) ** 2 / (_STUDENT + far) ** 2
        self._stretch = float(weight.sum() / max(bent.sum(), 0.3 * weight.sum()))

    def _blocks(self) -> Int:
        """(K,) the block of each pair: one track in a time that is longer than errors last."""
        pairs = self.pairs
        span_s = max(float(np.ptp(pairs.time_s)), 1e-9)
        longest_s = max(span_s / _BLOCKS, _SHORTEST_S)
        count = max(1, round(span_s / np.clip(5 * _memory_s(pairs, self._left_m), _SHORTEST_S, longest_s)))
        into = np.minimum((pairs.time_s - pairs.time_s.min()) / span_s * count, count - 1)
        return np.unique(np.stack([into.astype(np.int64), pairs.track]), axis=1, return_inverse=True)[1].ravel()

    def half_width(self, k: int, certain: float = 0.975) -> float:
        """Half of the 95 % interval of a coefficient: blocks are left out one by one (jackknife)."""
        from scipy.stats import t

        size = self.blocks
        each = np.zeros((size, *self._each.shape[1:]))
        right = np.zeros((size, self._right.shape[1]))
        np.add.at(each, self.block_of, self._each)
        np.add.at(right, self.block_of, self._right)
        without = [
            np.linalg.lstsq(each.sum(axis=0) - each[g], right.sum(axis=0) - right[g], rcond=None)[0][k]
            for g in range(size)
        ]
        spread = np.sqrt((size - 1) / size * ((np.array(without) - self.solved[k]) ** 2).sum())
        told = each[:, k, k]  # blocks that tell little are not as good as a block
        freedom = max(float(told.sum() ** 2 / (told**2).sum()) - 1, 1.0)
        return float(t.ppf(certain, freedom) * spread * self._stretch)


def _information(columns: Float, weight: Float) -> Float:
    """(K, C, C) of each pair."""
    return weight[:, None, None] * columns[:, :, None] * columns[:, None, :]


def _memory_s(pairs: _Pairs, left_m: Float) -> float:
    """How long errors last: from the correlation of residuals about half a second apart, of one track."""
    order = np.lexsort((pairs.time_s, pairs.track))
    time_s, track, left_m = pairs.time_s[order], pairs.track[order], np.clip(left_m[order], -GATE_M, GATE_M)
    axis = time_s + track * (np.ptp(time_s) + 10)
    later = np.searchsorted(axis, axis + 0.5)
    found = np.flatnonzero(later < len(axis))
    found = found[axis[later[found]] - axis[found] < 0.8]
    if len(found) < FEWEST:
        return 0.0
    lag_s = float(np.mean(axis[later[found]] - axis[found]))
    correlation = float(np.mean(left_m[found] * left_m[later[found]]) / np.mean(left_m**2))
    return 0.0 if correlation < 0.05 else lag_s / -np.log(min(correlation, 0.95))

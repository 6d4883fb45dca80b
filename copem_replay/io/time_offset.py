"""How far one object list's clock is ahead of another's, told by traffic that both list.

An entry of the one at stamp t shows what the other has at t − offset. Entries are matched at the offsets of a grid; at
the best, tracks of the other list are matched with tracks of the first, and offset and what may be confused with it (a
shift of the place, a bias along the way) are those with which moving objects have one way through the entries of both.
Intervals go by how far blocks of a track and a time, longer than errors last, disagree. Units are seconds and metres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from copem_replay.core.tracks import Float, Int
from copem_replay.io.joint_ways import PIECE_S, JointWays, Pieces, pieces
from copem_replay.io.short_tracks import Entries, ShortTracks, chained, short_tracks

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
NEARLY = 0.7
"""A track is one of the other list where so many of its entries in the time of that are nearest to it (chosen)."""
_MATCHES = 3  # at least
_SETTLED_S = 0.01  # tracks are not matched again where the offset has moved by less (chosen)
_BLOCKS = 6  # there are at least, if they are no shorter than a piece (chosen)
_FEWEST_BLOCKS = 3
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
    chains = chained(other)
    if not len(chains.time_s):
        chains = replace(other, track=np.arange(len(other.time_s)))
    for faster_mps in (SLOW_MPS,) if shifted else (FAST_MPS, SLOW_MPS):
        simple = _solved(tracks, chains, float(grid[best]), faster_mps)
        if simple is None:
            continue
        full = _Fit(simple.ways.pieces, simple.ways.offset_s, biased=True)
        if full.half_width(0) > BIAS_S:
            found = _told(simple, unbiased=True)
        else:
            moved_s = abs(full.ways.offset_s - simple.ways.offset_s)
            found = _told(full if shifted or moved_s > _CERTAIN * full.half_width(0) else simple)
        if found.untold is None:
            break
    return found


def _solved(tracks: ShortTracks, other: Entries, offset_s: float, faster_mps: float) -> _Fit | None:
    """The fit at the offset that it leads to, with the tracks that match there; None: too little to go by."""
    for _ in range(4):
        rows, track = _same(tracks, other, offset_s)
        found = pieces(tracks.entries, other.take(rows), track, offset_s, faster_mps)
        if found is None or found.other.sum() < FEWEST:
            return None
        fit = _Fit(found, offset_s, biased=False)
        moved_s, offset_s = abs(fit.ways.offset_s - offset_s), fit.ways.offset_s
        if moved_s < _SETTLED_S:
            break
    return fit


def _same(tracks: ShortTracks, other: Entries, offset_s: float) -> tuple[Int, Int]:
    """Entries of tracks of the other list that are nearest to one track nearly always, and that track."""
    near, state, _ = tracks.nearest(other, offset_s, gate_m=GATE_M, faster_mps=-1.0, mutual=True)
    pair, count = np.unique(np.stack([state.track, other.track[near]]), axis=1, return_counts=True)
    edge = [np.searchsorted(tracks.track, pair[0], side=side) for side in ("left", "right")]
    from_s, to_s = tracks.time_s[edge[0]] + offset_s, tracks.time_s[edge[1] - 1] + offset_s
    begin, end = (np.searchsorted(other.track, pair[1], side=side) for side in ("left", "right"))
    rows, of = [], []
    for k in range(len(count)):
        during = np.searchsorted(other.time_s[begin[k] : end[k]], [from_s[k], to_s[k]])
        if count[k] >= max(NEARLY * (during[1] - during[0]), min(_MATCHES, end[k] - begin[k])):
            rows.append(np.arange(begin[k], end[k]))
            of.append(np.full(end[k] - begin[k], pair[0, k]))
    none = np.empty(0, dtype=np.int64)
    return np.concatenate([none, *rows]), np.concatenate([none, *of])


def _told(fit: _Fit, *, unbiased: bool = False) -> TimeOffset:
    """The estimate with its interval, unless that is too wide."""
    if fit.blocks < _FEWEST_BLOCKS:
        return TimeOffset(untold="too short a time with moving objects in both")
    found, offset_s = fit.ways.pieces, fit.ways.offset_s
    half_s = float(np.hypot(fit.half_width(0), _FINEST_S))
    told = TimeOffset(offset_s, offset_s - half_s, offset_s + half_s, int(found.other.sum()), unbiased=unbiased)
    if not half_s <= WIDEST_S:
        why = "nothing in both is fast enough, or varies enough in speed and direction"
        return replace(told, untold=f"{offset_s:.3f} ± {half_s:.3f} s, which is too wide: {why}")
    if np.ptp(found.time_s) < DRIFT_FROM_S:
        return told
    drifting = _Fit(found, offset_s, biased=fit.ways.biased, drift=True)
    drift, half = float(drifting.ways.solved[-1]), drifting.half_width(-1)
    return replace(told, drift=(drift, drift - half, drift + half))


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


class _Fit:
    """One way of each object through both lists, and how certain it is."""

    def __init__(self, found: Pieces, offset_s: float, *, biased: bool, drift: bool = False) -> None:
        self.ways = JointWays(found, offset_s, biased=biased, drift=drift)
        memory_s = _memory_s(found, self.ways.left_m)
        long_s = max(5 * memory_s, PIECE_S)
        block_of = _blocks(found, long_s)
        while block_of.max() + 1 < _BLOCKS and long_s > PIECE_S:
            long_s = max(long_s / 2, PIECE_S)
            block_of = _blocks(found, long_s)
        self.blocks = int(block_of.max()) + 1
        # Errors go on into the next block: a mean over many blocks varies so much more than if they did not. Exact for
        # exponential memory (2 τ T against 2 τ (L - τ) T / L); too short a block counts as five τ.
        self._beyond = long_s / max(long_s - memory_s, 0.8 * long_s)
        self._score = np.zeros((self.blocks, self.ways.score.shape[1]))
        self._information = np.zeros((self.blocks, *self.ways.information.shape[1:]))
        np.add.at(self._score, block_of, self.ways.score)
        np.add.at(self._information, block_of, self.ways.information)

    def half_width(self, k: int, certain: float = 0.975) -> float:
        """Half of the 95 % interval of a coefficient.

        Blocks move it by so much, and would by errors of entries that know nothing of each other: where they do by
        more, the interval is wider in proportion (Birge's ratio). It is never narrower than those errors make it.
        """
        from scipy.stats import t

        inverse = np.linalg.pinv(self._information.sum(axis=0))[k]
        moved, variance = self._score @ inverse, np.einsum("c,gcd,d->g", inverse, self._information, inverse)
        freedom = max(self.blocks - len(inverse), 1)
        ratio = self._beyond * (moved**2 / np.maximum(variance, 1e-12 * variance.sum())).sum() / freedom
        return float(t.ppf(certain, freedom) * np.sqrt(max(ratio, 1.0) * variance.sum()) * self.ways.stretch)


def _blocks(found: Pieces, long_s: float) -> Int:
    """(P,) the block of each piece: of one track, and so long."""
    into = ((found.middle_s - found.middle_s.min()) / long_s).astype(np.int64)
    blocks: Int = np.unique(np.stack([found.track, into]), axis=1, return_inverse=True)[1].ravel()
    return blocks


def _memory_s(found: Pieces, left_m: Float) -> float:
    """How long errors last: from the correlation of residuals about half a second apart, of one track."""
    mine = np.flatnonzero(found.other)
    time_s, track = found.time_s[mine], found.track[found.of[mine]]
    order = np.lexsort((time_s, track))
    time_s, track, left_m = time_s[order], track[order], np.clip(left_m[mine[order]], -GATE_M, GATE_M)
    axis = time_s + track * (np.ptp(time_s) + 10)
    later = np.searchsorted(axis, axis + 0.5)
    pair = np.flatnonzero(later < len(axis))
    pair = pair[axis[later[pair]] - axis[pair] < 0.8]
    if len(pair) < FEWEST:
        return 0.0
    lag_s = float(np.mean(axis[later[pair]] - axis[pair]))
    correlation = float(np.mean(left_m[pair] * left_m[later[pair]]) / np.mean(left_m**2))
    return 0.0 if correlation < 0.05 else lag_s / -np.log(min(correlation, 0.95))

"""How far one object list's clock is ahead of another's, told by traffic that both list.

An entry of the other list at stamp t shows what the first list has at t − offset. Entries are matched at the offsets of
a grid. At the best of them, tracks of the other list are matched with tracks of the first, and one path per object is
fitted through the entries of both, together with the offset and with what may be confused with it: a shift of the
position and a bias along the path.

A track is cut into short pieces. In each the object moves on a polynomial in time that is fitted to the entries of both
lists, those of the other list shifted by the offset and by biases that all pieces share; the polynomials are eliminated
piece by piece. No entry is in two pieces, so the pieces' errors in the offset are their own. Weights are those of
Student's t, and the scales of both lists, along and across the path, are estimated with them, so that an exact list
decides on the path. Intervals follow from how far blocks of one track and a time longer than errors last disagree.

`tools/check_time_offsets.py` measures the errors of the estimate and how often its interval holds the true offset.
Units are seconds and metres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.io.short_tracks import ListPoints, ShortTracks, chain_points, short_tracks

# One path of each object through the entries of two lists.

PIECE_S = 3.0
"""Longest piece: a cubic leaves 3 cm of a turn at 4 m/s² in it."""
_TERMS = 4  # of a cubic; pieces shorter than 2 s have three, pieces shorter than 1 s two
_BESIDE_S = 0.3  # entries of one list count this far beyond the time in which both have the object: shorter than a gap
_FEWEST = (3, 3, 8)  # entries of a piece: of the first list, of the other, together; four determine a cubic
_STUDENT = 4.0  # degrees of freedom of the weights
_FINEST_M = 0.01  # least scale of a list's errors: keeps the weights of an exact list (the truth) finite
_ROUNDS = 15  # of the fit, at most; it ends when the offset moves by less than 1e-5 s


@dataclass(frozen=True)
class TrackPieces:
    """Entries of moving objects in pieces of tracks: entries (K,), pieces (P,). `of`: the piece of each entry."""

    time_s: Float  # by the clock of the entry's own list
    along_m: Float  # from the mean position of the piece, in the direction of its displacement
    across_m: Float
    other: Bool  # of the other list
    of: Int
    track: Int
    heading: Float  # (2, P) unit vectors
    middle_s: Float
    half_s: Float


def cut_into_pieces(
    first: ListPoints, other: ListPoints, track: Int, offset_s: float, faster_mps: float
) -> TrackPieces | None:
    """Cut matched tracks into pieces in which the object is faster than `faster_mps`; None: there is no such piece.

    `first`: entries in order of tracks. `track`: the track of `first` that each entry of `other` is matched with.
    """
    count = int(first.track.max(initial=-1)) + 1
    when_s = other.time_s - offset_s
    first_span, other_span = _piece_spans(first.time_s, first.track, count), _piece_spans(when_s, track, count)
    begin = np.maximum(first_span[0], other_span[0]) - _BESIDE_S
    end = np.minimum(first_span[1], other_span[1]) + _BESIDE_S
    in_first = (first.time_s >= begin[first.track]) & (first.time_s <= end[first.track])
    in_other = (when_s >= begin[track]) & (when_s <= end[track])
    time_s = np.append(first.time_s[in_first], when_s[in_other])
    of_track = np.append(first.track[in_first], track[in_other])
    place = np.stack([np.append(a[in_first], b[in_other]) for a, b in ((first.x_m, other.x_m), (first.y_m, other.y_m))])
    is_other = np.repeat([False, True], [in_first.sum(), in_other.sum()])
    if not len(time_s):
        return None
    track_s = (end - begin)[of_track]
    cut = np.minimum((time_s - begin[of_track]) / track_s, 1 - 1e-9) * np.ceil(track_s / PIECE_S)
    piece = np.unique(np.stack([of_track, cut.astype(np.int64)]), axis=1, return_inverse=True)[1].ravel()
    is_long = (np.bincount(piece, ~is_other) >= _FEWEST[0]) & (np.bincount(piece, is_other) >= _FEWEST[1])
    is_long &= np.bincount(piece) >= _FEWEST[2]
    if not is_long.any():
        return None
    time_s, of_track, place, is_other, piece = _keep_pieces(is_long, time_s, of_track, place, is_other, piece)
    low_s, high_s = _piece_spans(time_s, piece, len(np.unique(piece)))
    step = _piece_displacements(time_s, place, piece, low_s, high_s)
    moved_m = np.hypot(*step)
    is_long = moved_m > faster_mps * (high_s - low_s)
    if not is_long.any():
        return None
    time_s, of_track, place, is_other, piece = _keep_pieces(is_long, time_s, of_track, place, is_other, piece)
    low_s, high_s, heading = low_s[is_long], high_s[is_long], (step / moved_m)[:, is_long]
    place = place - np.stack([np.bincount(piece, values) for values in place])[:, piece] / np.bincount(piece)[piece]
    cos, sin = heading[:, piece]
    along_m, across_m = cos * place[0] + sin * place[1], cos * place[1] - sin * place[0]
    track_of = of_track[np.unique(piece, return_index=True)[1]]
    half_s = np.maximum((high_s - low_s) / 2, 0.1)
    by_clock_s = time_s + is_other * offset_s
    return TrackPieces(by_clock_s, along_m, across_m, is_other, piece, track_of, heading, (low_s + high_s) / 2, half_s)


def _keep_pieces(
    enough: Bool, time_s: Float, track: Int, place: Float, is_other: Bool, piece: Int
) -> tuple[Float, Int, Float, Bool, Int]:
    """The entries of the pieces that are `enough (P,)`, with these pieces renumbered from 0."""
    kept = enough[piece]
    return time_s[kept], track[kept], place[:, kept], is_other[kept], np.unique(piece[kept], return_inverse=True)[1]


def _piece_spans(time_s: Float, piece: Int, count: int) -> tuple[Float, Float]:
    """(count,) first and last instant of each piece; inf and −inf for a number without entries."""
    low_s, high_s = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(low_s, piece, time_s)
    np.maximum.at(high_s, piece, time_s)
    return low_s, high_s


def _piece_displacements(time_s: Float, place: Float, piece: Int, low_s: Float, high_s: Float) -> Float:
    """(2, P) displacement of each piece from its begin to its end, by a polynomial through its entries."""
    terms = _polynomial_terms(time_s, piece, (low_s + high_s) / 2, np.maximum((high_s - low_s) / 2, 0.1))[0]
    normal = _normal_equations(terms, np.ones_like(time_s), piece)
    solved = np.linalg.solve(normal, _sum_by_piece(terms[:, :, None] * place.T[:, None], piece))
    step: Float = 2 * solved[:, 1::2].sum(axis=1).T
    return step


def _polynomial_terms(time_s: Float, piece: Int, middle_s: Float, half_s: Float) -> tuple[Float, Float]:
    """(K, T) powers of the time in a piece, and their rates per second; 0 for the terms that a short piece lacks."""
    phase = (time_s - middle_s[piece]) / half_s[piece]
    power = np.arange(_TERMS)
    used = power <= np.ceil(2 * half_s[piece])[:, None]
    rate = power * phase[:, None] ** np.maximum(power - 1, 0) / half_s[piece][:, None]
    return phase[:, None] ** power * used, rate * used


def _sum_by_piece(values: Float, piece: Int) -> Float:
    """(P, …) sums of values (K, …) over the entries of each piece."""
    flat = values.reshape(len(values), -1)
    sums: Float = np.stack([np.bincount(piece, column) for column in flat.T], axis=-1).astype(np.float64)
    return sums.reshape((-1, *values.shape[1:]))


def _normal_equations(terms: Float, weight: Float, piece: Int) -> Float:
    """(P, T, T) normal equations; the identity in the terms that a piece lacks."""
    normal = _sum_by_piece((weight[:, None] * terms)[:, :, None] * terms[:, None, :], piece)
    empty = np.diagonal(normal, axis1=1, axis2=2) == 0
    filled: Float = normal + empty[:, :, None] * np.eye(_TERMS)
    return filled


class JointWays:
    """The joint fit of paths, offset, biases and drift. Its C coefficients: offset, three biases, drift, in this order.

    `information (P, C, C)` and `score (P, C)` are those of each piece at the solution `solved (C,)`. `offset_s` is
    moved round by round until its coefficient is 0. `left_m (K,)`: residuals along the path.
    """

    def __init__(self, pieces: TrackPieces, offset_s: float, *, biased: bool, drift: bool = False) -> None:
        self.pieces, self.offset_s, self.biased, self.drift = pieces, offset_s, biased, drift
        self._weight = np.ones(len(pieces.time_s))
        self._scale_m = np.full((2, 2), 0.5)  # along and across, of the first list and of the other
        self.solved = np.zeros(1 + 3 * biased + drift)
        self._ways = np.zeros((2, len(pieces.middle_s), _TERMS))
        for turn in range(_ROUNDS):
            self._round(start=turn == 0)
            missing_s, self.solved[0] = float(self.solved[0]), 0.0
            self.offset_s += float(np.clip(missing_s, -0.1, 0.1))
            if turn > 4 and abs(missing_s) < 1e-5:
                break

    def _round(self, *, start: bool) -> None:
        """Solve for the coefficients and all paths, then reweigh; `start`: no paths from a former round.

        Axes: a along and across, k entries, p pieces, t terms of a path's polynomial, c coefficients.
        """
        p, piece = self.pieces, self.pieces.of
        terms, rates = _polynomial_terms(p.time_s - p.other * self.offset_s, piece, p.middle_s, p.half_s)
        weight = self._weight / self._scale_m[:, p.other.astype(np.int64)] ** 2
        position = (p.along_m, p.across_m)
        normal = [_normal_equations(terms, w, piece) for w in weight]
        right = [_sum_by_piece((w * y)[:, None] * terms, piece) for w, y in zip(weight, position, strict=True)]
        if start:
            self._ways = np.stack([_solve_each(n, r) for n, r in zip(normal, right, strict=True)])
        columns = self._columns(np.einsum("akt,kt->ak", self._ways[:, piece], rates))
        mixed = [
            _sum_by_piece(terms[:, :, None] * (w[:, None] * z)[:, None, :], piece)
            for w, z in zip(weight, columns, strict=True)
        ]
        information, score_by_axis = [], []
        for w, y, z, n, r, h in zip(weight, position, columns, normal, right, mixed, strict=True):
            eliminated, wz = np.linalg.solve(n, h), w[:, None] * z
            information.append(_sum_by_piece(wz[:, :, None] * z[:, None, :], piece) - h.transpose(0, 2, 1) @ eliminated)
            score_by_axis.append(_sum_by_piece(wz * y[:, None], piece) - np.einsum("ptc,pt->pc", eliminated, r))
        self.information = information[0] + information[1]
        score = score_by_axis[0] + score_by_axis[1]
        self.solved = np.linalg.lstsq(self.information.sum(axis=0), score.sum(axis=0), rcond=None)[0]
        self.score = score - self.information @ self.solved
        self._ways = np.stack(
            [_solve_each(n, r - h @ self.solved) for n, r, h in zip(normal, right, mixed, strict=True)]
        )
        residual = np.stack(position) - np.einsum("akt,kt->ak", self._ways[:, piece], terms) - columns @ self.solved
        bound = [
            w * np.einsum("kt,ktu,ku->k", terms, np.linalg.inv(n)[piece], terms)
            for w, n in zip(weight, normal, strict=True)
        ]
        self._weigh(residual, np.stack(bound))
        self.left_m = residual[0]

    def _columns(self, velocity: Float) -> Float:
        """(2, K, C) derivatives of positions along and across by the coefficients; 0 for the first list."""
        p = self.pieces
        columns = [-velocity]
        if self.biased:  # a shift to the east, to the north, along the way
            cos, sin = p.heading[:, p.of]
            speed = np.maximum(np.hypot(*velocity), 0.5)
            columns += [np.stack([cos, -sin]), np.stack([sin, cos]), velocity / speed]
        if self.drift:
            columns.append(-velocity * (p.time_s - p.time_s.mean()))
        return np.stack(columns, axis=-1) * p.other[None, :, None]

    def _weigh(self, residual: Float, bound: Float) -> None:
        """Sets weights and scales from residuals (2, K); `bound (2, K)`: the leverage of each entry on its own
        residual.

        Weights depend on the residuals that they weigh, so errors move the solution more than fixed weights would: by
        `stretch`, the mean of both lists' factors, weighted by what their errors add to the variance of the solution.
        """
        variance, stretch = np.empty(2), np.empty(2)
        for k, rows in enumerate((~self.pieces.other, self.pieces.other)):
            squared: Float = (residual[:, rows] / self._scale_m[:, k, None]) ** 2
            weight = (_STUDENT + 2) / (_STUDENT + squared.sum(axis=0))
            slope = weight - 2 * (_STUDENT + 2) * squared[0] / (_STUDENT + squared.sum(axis=0)) ** 2
            free = np.maximum((1 - bound[:, rows]).sum(axis=1), 1.0)
            self._scale_m[:, k] = np.maximum(np.sqrt((weight * residual[:, rows] ** 2).sum(axis=1) / free), _FINEST_M)
            self._weight[rows] = weight
            stretch[k] = weight.sum() / max(slope.sum(), 0.3 * weight.sum())
            variance[k] = self._scale_m[0, k] ** 2 / rows.sum()
        self.stretch = float(np.average(stretch, weights=variance))


def _solve_each(normal: Float, right: Float) -> Float:
    """(P, T) solutions of P systems: `normal (P, T, T)`, `right (P, T)`."""
    return np.asarray(np.linalg.solve(normal, right[:, :, None])[:, :, 0], dtype=np.float64)


# The offset: the best of a grid, then that of the joint fit, with its interval.

STEP_S = 0.05
"""Step of the grid of offsets: at 30 m/s an object moves by the width of the kernel."""
KERNEL_M = 1.5
"""Standard deviation of the score by distance: two entries of one object may well be that far apart."""
GATE_M = 3.0
"""Farther apart no two entries are of one object: the gate of `match`."""
SLOW_MPS = 1.0
"""Slower objects are left out: at 1 m/s an error of half a metre is one of half a second."""
FAST_MPS = 3.0
"""Faster objects suffice where there are any: errors of half a metre are no velocity of that size."""
FEWEST = 20
"""Matched entries, at least; fewer: no offset is stated."""
WIDEST_S = 0.1
"""An interval that reaches farther to a side is not stated: two standard errors of 0.05 s."""
BIAS_S = 0.05
"""A shift of the position and a bias along the path count as told apart from the offset where the offset's interval,
with both of them regressed, reaches no farther to a side: half of `WIDEST_S`."""
DRIFT_FROM_S = 60.0
"""No drift is stated of a shorter overlap."""
RIVAL = 0.9
"""A second offset with this share of the best score makes both doubtful, as in a column of cars."""
_AT_MOST = 20_000  # entries of the other list that are used; more: slower
_FOLLOWED = 0.5  # least share of the first list's entries in tracks; below it the list with more of them is followed
_SCORED = 2_000  # entries that are scored at every offset of the grid; more: slower
NEARLY = 0.7
"""Two tracks match where this share of the other one's entries, in the time of the first, is nearest to the first."""
_MATCHES = 3  # matched entries of two tracks, at least
_SETTLED_S = 0.01  # tracks are not matched again after a smaller move: 0.3 m at 30 m/s, a tenth of the gate
_BLOCKS = 6  # blocks that the interval is from, at least, unless they would be shorter than a piece
_FEWEST_BLOCKS = 3  # fewer disagree too seldom to tell an interval
_FINEST_S = 0.001  # error that smoothing and interpolation leave: the last digit that is printed
_CERTAIN = 1.7  # half 95 % intervals, about 99.9 %, that biases must move the offset; else they only cost precision


@dataclass(frozen=True)
class TimeOffset:
    """An offset with its 95 % interval, and `drift` in seconds per second with its own; or `untold`, why there is none.

    `entries`: number of matched entries of moving objects. `unbiased`: the estimate assumes that no entry is shifted
    along its path, since these entries cannot tell such a shift from an offset.
    """

    offset_s: float = 0.0
    low_s: float = -np.inf
    high_s: float = np.inf
    entries: int = 0
    drift: tuple[float, float, float] | None = None  # drift, low, high; None: the overlap is too short
    untold: str | None = None
    unbiased: bool = False

    def reversed(self) -> TimeOffset:
        """The offset of the first list's clock against the other one's, from the other's against the first's."""
        drift = None if self.drift is None else (-self.drift[0], -self.drift[2], -self.drift[1])
        return replace(self, offset_s=-self.offset_s, low_s=-self.high_s, high_s=-self.low_s, drift=drift)


def estimate_time_offset(
    reference: ListPoints, other: ListPoints, *, from_s: float = -2.0, to_s: float = 2.0, shifted: bool = False
) -> TimeOffset:
    """How far the clock of `other` is ahead of that of `reference`, if it is from `from_s` to `to_s`.

    `shifted`: entries are expected to be shifted along their path, as those of real units against the truth, and the
    shift is regressed wherever it can be told from an offset; else only where it is significant.
    """
    tracks = short_tracks(reference)
    if len(tracks.time_s) < _FOLLOWED * len(reference.time_s):
        turned = short_tracks(other)
        if len(turned.time_s) > len(tracks.time_s):
            return _estimate_offset(turned, reference.thinned(_AT_MOST), (-to_s, -from_s), shifted).reversed()
    return _estimate_offset(tracks, other.thinned(_AT_MOST), (from_s, to_s), shifted)


def _estimate_offset(
    tracks: ShortTracks, other: ListPoints, within_s: tuple[float, float], shifted: bool
) -> TimeOffset:
    """How far the clock of `other` is ahead of that of the tracks (s), sought `within_s`; `untold`: why not known.
    `shifted`: positions of one list may be off by a constant vector.
    """
    from_s, to_s = within_s
    if not len(tracks.time_s) or not len(other.time_s):
        return TimeOffset(untold="nothing in them can be followed from list to list")
    grid = np.arange(round(from_s / STEP_S), round(to_s / STEP_S) + 1) * STEP_S
    thinned_points = other.thinned(_SCORED)
    score = np.array([_score_offset(tracks, thinned_points, float(offset_s)) for offset_s in grid])
    best = int(score.argmax())
    if score[best] < FEWEST / 2:
        return TimeOffset(untold=f"fewer than {FEWEST} entries of moving objects are in both")
    if (rival_ix := _find_rival(score, best)) is not None:
        return TimeOffset(untold=f"{grid[best]:.2f} s and {grid[rival_ix]:.2f} s fit equally well")
    if best in (0, len(grid) - 1):
        return TimeOffset(untold=f"it is not within {from_s:g} … {to_s:g} s")
    estimate = TimeOffset(untold=f"fewer than {FEWEST} entries of moving objects are in both")
    # Slow objects take part where they are needed: to tell a shift from an offset speeds have to vary.
    chains = chain_points(other)
    if not len(chains.time_s):
        chains = replace(other, track=np.arange(len(other.time_s)))
    for faster_mps in (SLOW_MPS,) if shifted else (FAST_MPS, SLOW_MPS):
        plain_fit = _solve_offset(tracks, chains, float(grid[best]), faster_mps)
        if plain_fit is None:
            continue
        full = _Fit(plain_fit.ways.pieces, plain_fit.ways.offset_s, biased=True)
        if full.half_width(0) > BIAS_S:
            estimate = _state_estimate(plain_fit, unbiased=True)
        else:
            moved_s = abs(full.ways.offset_s - plain_fit.ways.offset_s)
            estimate = _state_estimate(full if shifted or moved_s > _CERTAIN * full.half_width(0) else plain_fit)
        if estimate.untold is None:
            break
    return estimate


def _solve_offset(tracks: ShortTracks, other: ListPoints, offset_s: float, faster_mps: float) -> _Fit | None:
    """The fit of offset and paths, tracks matched anew until the offset settles; None: too few matched entries."""
    for _ in range(4):
        rows, track = _match_tracks(tracks, other, offset_s)
        pieces = cut_into_pieces(tracks.entries, other.take(rows), track, offset_s, faster_mps)
        if pieces is None or pieces.other.sum() < FEWEST:
            return None
        fit = _Fit(pieces, offset_s, biased=False)
        moved_s, offset_s = abs(fit.ways.offset_s - offset_s), fit.ways.offset_s
        if moved_s < _SETTLED_S:
            break
    return fit


def _match_tracks(tracks: ShortTracks, other: ListPoints, offset_s: float) -> tuple[Int, Int]:
    """(K,) rows of `other` whose track is nearly always nearest to one track of `tracks`, and (K,) that track."""
    near_row, state, _ = tracks.nearest(other, offset_s, gate_m=GATE_M, faster_mps=-1.0, mutual=True)
    pair, count = np.unique(np.stack([state.track, other.track[near_row]]), axis=1, return_counts=True)
    track_edges = [np.searchsorted(tracks.track, pair[0], side=side) for side in ("left", "right")]
    from_s, to_s = tracks.time_s[track_edges[0]] + offset_s, tracks.time_s[track_edges[1] - 1] + offset_s
    begin, end = (np.searchsorted(other.track, pair[1], side=side) for side in ("left", "right"))
    rows, matched = [], []
    for k in range(len(count)):
        rows_during = np.searchsorted(other.time_s[begin[k] : end[k]], [from_s[k], to_s[k]])
        if count[k] >= max(NEARLY * (rows_during[1] - rows_during[0]), min(_MATCHES, end[k] - begin[k])):
            rows.append(np.arange(begin[k], end[k]))
            matched.append(np.full(end[k] - begin[k], pair[0, k]))
    empty = np.empty(0, dtype=np.int64)
    return np.concatenate([empty, *rows]), np.concatenate([empty, *matched])


def _state_estimate(fit: _Fit, *, unbiased: bool = False) -> TimeOffset:
    """The offset (s) with interval and drift; `untold` says why not: too few blocks, or the interval is too wide."""
    if fit.blocks < _FEWEST_BLOCKS:
        return TimeOffset(untold="too short a time with moving objects in both")
    pieces, offset_s = fit.ways.pieces, fit.ways.offset_s
    half_s = float(np.hypot(fit.half_width(0), _FINEST_S))
    estimate = TimeOffset(offset_s, offset_s - half_s, offset_s + half_s, int(pieces.other.sum()), unbiased=unbiased)
    if not half_s <= WIDEST_S:
        reason = "nothing in both is fast enough, or varies enough in speed and direction"
        return replace(estimate, untold=f"{offset_s:.3f} ± {half_s:.3f} s, which is too wide: {reason}")
    if np.ptp(pieces.time_s) < DRIFT_FROM_S:
        return estimate
    drifting = _Fit(pieces, offset_s, biased=fit.ways.biased, drift=True)
    drift, half_drift = float(drifting.ways.solved[-1]), drifting.half_width(-1)
    return replace(estimate, drift=(drift, drift - half_drift, drift + half_drift))


def _score_offset(tracks: ShortTracks, other: ListPoints, offset_s: float) -> float:
    """Score of an offset: the sum over entries of exp(−½ (distance / KERNEL_M)²) to the nearest moving track."""
    _, _, away_m = tracks.nearest(other, offset_s, gate_m=GATE_M, faster_mps=SLOW_MPS)
    return float(np.exp(-0.5 * (away_m / KERNEL_M) ** 2).sum())


def _find_rival(score: Float, best: int) -> int | None:
    """Index of another offset that fits nearly as well, with worse ones in between; None: there is none."""
    for k in np.flatnonzero(score >= RIVAL * score[best]).tolist():
        between = score[min(k, best) : max(k, best) + 1]
        if between.min() < RIVAL * score[k]:
            return int(k)
    return None


class _Fit:
    """A joint fit and how certain its coefficients are."""

    def __init__(self, pieces: TrackPieces, offset_s: float, *, biased: bool, drift: bool = False) -> None:
        self.ways = JointWays(pieces, offset_s, biased=biased, drift=drift)
        memory_s = _residual_correlation_s(pieces, self.ways.left_m)
        long_s = max(5 * memory_s, PIECE_S)
        block_of = _number_blocks(pieces, long_s)
        while block_of.max() + 1 < _BLOCKS and long_s > PIECE_S:
            long_s = max(long_s / 2, PIECE_S)
            block_of = _number_blocks(pieces, long_s)
        self.blocks = int(block_of.max()) + 1
        # Errors last into the next block, so a mean over many blocks varies more than if they did not. The factor is
        # exact for exponential memory (2 τ T against 2 τ (L − τ) T / L); a block that is too short counts as five τ.
        self._beyond = long_s / max(long_s - memory_s, 0.8 * long_s)
        self._score = np.zeros((self.blocks, self.ways.score.shape[1]))
        self._information = np.zeros((self.blocks, *self.ways.information.shape[1:]))
        np.add.at(self._score, block_of, self.ways.score)
        np.add.at(self._information, block_of, self.ways.information)

    def half_width(self, k: int) -> float:
        """Half of the 95 % interval of coefficient `k`."""
        return find_half_width(self._score, self._information, k, self._beyond) * float(self.ways.stretch)


def find_half_width(score: Float, information: Float, k: int, factor: float = 1.0) -> float:
    """Half of the 95 % interval of coefficient `k`, from scores (G, C) and information (G, C, C) of G blocks.

    Where blocks move the coefficient by more than independent errors of entries would, the interval is wider in
    proportion (Birge's ratio, times `factor`). It is never narrower than independent errors make it.
    """
    from scipy.special import stdtrit  # of Student's t; scipy.stats takes long to import

    inverse = np.linalg.pinv(information.sum(axis=0))[k]
    moved, variance = score @ inverse, np.einsum("c,gcd,d->g", inverse, information, inverse)
    freedom = max(len(score) - len(inverse), 1)
    ratio = factor * (moved**2 / np.maximum(variance, 1e-12 * variance.sum())).sum() / freedom
    return float(stdtrit(freedom, 0.975) * np.sqrt(max(ratio, 1.0) * variance.sum()))


def _number_blocks(pieces: TrackPieces, long_s: float) -> Int:
    """(P,) the block of each piece: a block holds pieces of one track within `long_s` seconds."""
    block_of_time = ((pieces.middle_s - pieces.middle_s.min()) / long_s).astype(np.int64)
    blocks: Int = np.unique(np.stack([pieces.track, block_of_time]), axis=1, return_inverse=True)[1].ravel()
    return blocks


def _residual_correlation_s(pieces: TrackPieces, left_m: Float) -> float:
    """Correlation time (s) of errors, from residuals `left_m` of one track about half a second apart; 0: hardly any."""
    rows = np.flatnonzero(pieces.other)
    time_s, track = pieces.time_s[rows], pieces.track[pieces.of[rows]]
    order = np.lexsort((time_s, track))
    time_s, track, left_m = time_s[order], track[order], np.clip(left_m[rows[order]], -GATE_M, GATE_M)
    axis = time_s + track * (np.ptp(time_s) + 10)
    later_row = np.searchsorted(axis, axis + 0.5)
    pair = np.flatnonzero(later_row < len(axis))
    pair = pair[axis[later_row[pair]] - axis[pair] < 0.8]
    if len(pair) < FEWEST:
        return 0.0
    lag_s = float(np.mean(axis[later_row[pair]] - axis[pair]))
    correlation = float(np.mean(left_m[pair] * left_m[later_row[pair]]) / np.mean(left_m**2))
    return 0.0 if correlation < 0.05 else lag_s / -np.log(min(correlation, 0.95))

"""One way of each object through the entries of two lists, and how far the clocks of the lists are apart along it.

A track is cut into short pieces. In each the object moves on a polynomial in time that the entries of both lists are
fitted to at once, those of the other list shifted by the offset and by biases that all pieces share; polynomials are
eliminated piece by piece. No entry is in two pieces, so that what pieces say of the offset differs by their own errors
alone. Weights are of Student's t; the scales of both lists, along and across the way, are estimated with them, so that
an exact list decides on the way. Units are seconds and metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.io.short_tracks import Entries

PIECE_S = 3.0
"""No piece is longer (chosen: a cubic leaves 3 cm of a turn at 4 m/s²)."""
_TERMS = 4  # of a cubic; of pieces shorter than 2 s and 1 s one and two less
_BESIDE_S = 0.3  # so far beyond the time that both lists have an object entries of one still count (chosen)
_FEWEST = (3, 3, 8)  # entries of a piece: of the first list, of the other, together (chosen)
_STUDENT = 4.0  # degrees of freedom of the weights
_FINEST_M = 0.01  # no list is better (chosen)
_ROUNDS = 15


@dataclass(frozen=True)
class Pieces:
    """Entries of moving objects in pieces of tracks: entries (K,), pieces (P,). `of`: the piece of each entry."""

    time_s: Float  # by its own clock
    along_m: Float  # from the middle of its piece, in the direction that the piece takes
    across_m: Float
    other: Bool  # of the other list
    of: Int
    track: Int
    heading: Float  # (2, P) unit vectors
    middle_s: Float
    half_s: Float


def pieces(first: Entries, other: Entries, track: Int, offset_s: float, faster_mps: float) -> Pieces | None:
    """Entries in order of tracks, and entries of the other list that are of some `track`; None: nothing moves."""
    count = int(first.track.max(initial=-1)) + 1
    when_s = other.time_s - offset_s
    span = [_span(time_s, of, count) for time_s, of in ((first.time_s, first.track), (when_s, track))]
    begin = np.maximum(span[0][0], span[1][0]) - _BESIDE_S
    end = np.minimum(span[0][1], span[1][1]) + _BESIDE_S
    mine = (first.time_s >= begin[first.track]) & (first.time_s <= end[first.track])
    theirs = (when_s >= begin[track]) & (when_s <= end[track])
    at_s, of_track = np.append(first.time_s[mine], when_s[theirs]), np.append(first.track[mine], track[theirs])
    place = np.stack([np.append(a[mine], b[theirs]) for a, b in ((first.x_m, other.x_m), (first.y_m, other.y_m))])
    late = np.repeat([False, True], [mine.sum(), theirs.sum()])
    if not len(at_s):
        return None
    long_s = (end - begin)[of_track]
    cut = np.minimum((at_s - begin[of_track]) / long_s, 1 - 1e-9) * np.ceil(long_s / PIECE_S)
    of = np.unique(np.stack([of_track, cut.astype(np.int64)]), axis=1, return_inverse=True)[1].ravel()
    enough = (np.bincount(of, ~late) >= _FEWEST[0]) & (np.bincount(of, late) >= _FEWEST[1])
    enough &= np.bincount(of) >= _FEWEST[2]
    if not enough.any():
        return None
    at_s, of_track, place, late, of = _kept(enough, at_s, of_track, place, late, of)
    low_s, high_s = _span(at_s, of, len(np.unique(of)))
    step = _step(at_s, place, of, low_s, high_s)
    away_m = np.hypot(*step)
    enough = away_m > faster_mps * (high_s - low_s)
    if not enough.any():
        return None
    at_s, of_track, place, late, of = _kept(enough, at_s, of_track, place, late, of)
    low_s, high_s, heading = low_s[enough], high_s[enough], (step / away_m)[:, enough]
    place = place - np.stack([np.bincount(of, values) for values in place])[:, of] / np.bincount(of)[of]
    cos, sin = heading[:, of]
    along_m, across_m = cos * place[0] + sin * place[1], cos * place[1] - sin * place[0]
    track_of = of_track[np.unique(of, return_index=True)[1]]
    half_s = np.maximum((high_s - low_s) / 2, 0.1)
    by_clock_s = at_s + late * offset_s
    return Pieces(by_clock_s, along_m, across_m, late, of, track_of, heading, (low_s + high_s) / 2, half_s)


def _kept(
    enough: Bool, time_s: Float, track: Int, place: Float, late: Bool, of: Int
) -> tuple[Float, Int, Float, Bool, Int]:
    """Entries of some pieces, which are counted anew."""
    kept = enough[of]
    return time_s[kept], track[kept], place[:, kept], late[kept], np.unique(of[kept], return_inverse=True)[1]


def _span(time_s: Float, of: Int, count: int) -> tuple[Float, Float]:
    """(count,) first and last instants."""
    low_s, high_s = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(low_s, of, time_s)
    np.maximum.at(high_s, of, time_s)
    return low_s, high_s


def _step(time_s: Float, place: Float, of: Int, low_s: Float, high_s: Float) -> Float:
    """(2, P) from where pieces begin to where they end, by polynomials through them."""
    terms = _terms(time_s, of, (low_s + high_s) / 2, np.maximum((high_s - low_s) / 2, 0.1))[0]
    normal = _normal(terms, np.ones_like(time_s), of)
    solved = np.linalg.solve(normal, _sums(terms[:, :, None] * place.T[:, None], of))
    step: Float = 2 * solved[:, 1::2].sum(axis=1).T
    return step


def _terms(time_s: Float, of: Int, middle_s: Float, half_s: Float) -> tuple[Float, Float]:
    """(K, T) powers of the time in a piece, and their rates: as many as the piece is long enough for."""
    at = (time_s - middle_s[of]) / half_s[of]
    power = np.arange(_TERMS)
    there = power <= np.ceil(2 * half_s[of])[:, None]
    rate = power * at[:, None] ** np.maximum(power - 1, 0) / half_s[of][:, None]
    return at[:, None] ** power * there, rate * there


def _sums(values: Float, of: Int) -> Float:
    """(P, …) sums over the entries of pieces."""
    flat = values.reshape(len(values), -1)
    sums: Float = np.stack([np.bincount(of, column) for column in flat.T], axis=-1).astype(np.float64)
    return sums.reshape((-1, *values.shape[1:]))


def _normal(terms: Float, weight: Float, of: Int) -> Float:
    """(P, T, T) normal equations; of terms that a piece has not, the identity."""
    normal = _sums((weight[:, None] * terms)[:, :, None] * terms[:, None, :], of)
    empty = np.diagonal(normal, axis1=1, axis2=2) == 0
    filled: Float = normal + empty[:, :, None] * np.eye(_TERMS)
    return filled


class JointWays:
    """The fit: what is missing of an offset, and biases, and a drift, in this order. Coefficients are C in number.

    `information (P, C, C)` and `score (P, C)` are what each piece says of them where they are `solved (C,)`. The offset
    is moved until nothing is missing of it. `left_m (K,)`: residuals along the way.
    """

    def __init__(self, found: Pieces, offset_s: float, *, biased: bool, drift: bool = False) -> None:
        self.pieces, self.offset_s, self.biased, self.drift = found, offset_s, biased, drift
        self._weight = np.ones(len(found.time_s))
        self._scale_m = np.full((2, 2), 0.5)  # along and across, of the first list and of the other
        self.solved = np.zeros(1 + 3 * biased + drift)
        self._ways = np.zeros((2, len(found.middle_s), _TERMS))
        for turn in range(_ROUNDS):
            self._round(start=turn == 0)
            missing_s, self.solved[0] = float(self.solved[0]), 0.0
            self.offset_s += float(np.clip(missing_s, -0.1, 0.1))
            if turn > 4 and abs(missing_s) < 1e-5:
                break

    def _round(self, *, start: bool) -> None:
        p, of = self.pieces, self.pieces.of
        terms, rates = _terms(p.time_s - p.other * self.offset_s, of, p.middle_s, p.half_s)
        weight = self._weight / self._scale_m[:, p.other.astype(np.int64)] ** 2
        there = (p.along_m, p.across_m)
        normal = [_normal(terms, w, of) for w in weight]
        right = [_sums((w * y)[:, None] * terms, of) for w, y in zip(weight, there, strict=True)]
        if start:
            self._ways = np.stack([_solve(n, r) for n, r in zip(normal, right, strict=True)])
        columns = self._columns(np.einsum("akt,kt->ak", self._ways[:, of], rates))
        mixed = [
            _sums(terms[:, :, None] * (w[:, None] * z)[:, None, :], of) for w, z in zip(weight, columns, strict=True)
        ]
        told, said = [], []
        for w, y, z, n, r, h in zip(weight, there, columns, normal, right, mixed, strict=True):
            gone, wz = np.linalg.solve(n, h), w[:, None] * z
            told.append(_sums(wz[:, :, None] * z[:, None, :], of) - h.transpose(0, 2, 1) @ gone)
            said.append(_sums(wz * y[:, None], of) - np.einsum("ptc,pt->pc", gone, r))
        self.information = told[0] + told[1]
        score = said[0] + said[1]
        self.solved = np.linalg.lstsq(self.information.sum(axis=0), score.sum(axis=0), rcond=None)[0]
        self.score = score - self.information @ self.solved
        self._ways = np.stack([_solve(n, r - h @ self.solved) for n, r, h in zip(normal, right, mixed, strict=True)])
        left = np.stack(there) - np.einsum("akt,kt->ak", self._ways[:, of], terms) - columns @ self.solved
        bound = [
            w * np.einsum("kt,ktu,ku->k", terms, np.linalg.inv(n)[of], terms)
            for w, n in zip(weight, normal, strict=True)
        ]
        self._weigh(left, np.stack(bound))
        self.left_m = left[0]

    def _columns(self, velocity: Float) -> Float:
        """(2, K, C) along and across, of entries of the other list."""
        p = self.pieces
        columns = [-velocity]
        if self.biased:  # a shift to the east, to the north, along the way
            cos, sin = p.heading[:, p.of]
            speed = np.maximum(np.hypot(*velocity), 0.5)
            columns += [np.stack([cos, -sin]), np.stack([sin, cos]), velocity / speed]
        if self.drift:
            columns.append(-velocity * (p.time_s - p.time_s.mean()))
        return np.stack(columns, axis=-1) * p.other[None, :, None]

    def _weigh(self, left: Float, bound: Float) -> None:
        """Weights and scales that go with residuals, of which the ways leave so much free.

        Weights follow what they weigh, so that errors move the solution more than with weights kept: by `stretch`, to
        which a list adds as its errors add to those of the solution.
        """
        variance, stretch = np.empty(2), np.empty(2)
        for k, mine in enumerate((~self.pieces.other, self.pieces.other)):
            far: Float = (left[:, mine] / self._scale_m[:, k, None]) ** 2
            weight = (_STUDENT + 2) / (_STUDENT + far.sum(axis=0))
            bent = weight - 2 * (_STUDENT + 2) * far[0] / (_STUDENT + far.sum(axis=0)) ** 2
            free = np.maximum((1 - bound[:, mine]).sum(axis=1), 1.0)
            self._scale_m[:, k] = np.maximum(np.sqrt((weight * left[:, mine] ** 2).sum(axis=1) / free), _FINEST_M)
            self._weight[mine] = weight
            stretch[k] = weight.sum() / max(bent.sum(), 0.3 * weight.sum())
            variance[k] = self._scale_m[0, k] ** 2 / mine.sum()
        self.stretch = float(np.average(stretch, weights=variance))


def _solve(normal: Float, right: Float) -> Float:
    """(P, T) of (P, T, T) and (P, T)."""
    return np.asarray(np.linalg.solve(normal, right[:, :, None])[:, :, 0], dtype=np.float64)

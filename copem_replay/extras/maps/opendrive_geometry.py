"""Geometry of OpenDRIVE roads: the reference line, cubics along it, and points so close that chords stay near curves.

A road is followed by s, metres along its reference line in the plane; t is metres to the left of it. Headings in
radians. K places along a road, B curves beside one another.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from copem_replay.core.errors import InputError
from copem_replay.core.tracks import Float

CHORD_M: Final = 0.05
"""A chord is at most this far from the curve that it stands for."""
_MOST_PLACES: Final = 50_000
"""Places on all curves of one section of a road together: with ten lanes 50 km in chords of 10 m."""
_SAME_S_M: Final = 1e-9
_SHORT_M: Final = 1e-9
"""Shorter pieces are points: what is divided by their length may be beyond all numbers."""
_NO_SPIRAL_RAD: Final = 1e-7
"""A curvature that changes the heading by less over its whole length is constant: 3e-5 m in a kilometre."""


@dataclass(frozen=True)
class Cubics:
    """A piecewise cubic: N pieces from `start`, each a + b·ds + c·ds² + d·ds³. It is 0 before the first."""

    start: Float  # (N,), ascending
    terms: Float  # (N, 4)

    @staticmethod
    def of_rows(rows: Sequence[tuple[float, ...]]) -> Cubics:
        """Cubics of rows (start, a, b, c, d) in any order; of several at one start the last counts."""
        table = np.array(sorted(rows, key=lambda row: row[0]), dtype=np.float64).reshape(-1, 5)
        return Cubics(table[:, 0], table[:, 1:])

    def at(self, s: Float) -> Float:
        """Values at places (K,)."""
        if not len(self.start):
            return np.zeros_like(s)
        piece = np.searchsorted(self.start, s + _SAME_S_M, side="right") - 1
        ds = s - self.start[np.maximum(piece, 0)]
        a, b, c, d = self.terms[np.maximum(piece, 0)].T
        return np.where(piece >= 0, a + ds * (b + ds * (c + ds * d)), 0.0)


@dataclass(frozen=True)
class Piece:
    """One geometry of a reference line: where it starts, and its shape with the numbers that the shape has."""

    s: float
    x_m: float
    y_m: float
    heading_rad: float
    length_m: float
    shape: str
    numbers: Mapping[str, float]

    @property
    def sharpest_per_m(self) -> float:
        """The largest curvature, 1/m; of cubics a value sharper than any bend that is driven."""
        bends = [abs(self.numbers[name]) for name in ("curvature", "curvStart", "curvEnd") if name in self.numbers]
        return max(bends, default=0.0 if self.shape == "line" else 0.1)

    def follow(self, ds: Float) -> tuple[Float, Float, Float]:
        """Place ahead, place to the left and turn, (K,) each, at distances along the piece from its start."""
        return SHAPES[self.shape][1](ds, self.length_m, self.numbers)


def follow_clothoid(ds: Float, curvature: float, change: float) -> tuple[Float, Float, Float]:
    """Along a curve of curvature `curvature + change·s` from the origin ahead: closed form by Fresnel's integrals."""
    turn = curvature * ds + 0.5 * change * ds * ds
    longest_m = float(np.abs(ds).max(initial=0.0))
    if abs(change) * longest_m**2 < _NO_SPIRAL_RAD:
        half = 0.5 * curvature * ds
        near = np.sinc(half / np.pi) * ds  # length of the chord
        return near * np.cos(half), near * np.sin(half), turn
    from scipy.special import fresnel

    scale, sign = math.sqrt(math.pi / abs(change)), math.copysign(1.0, change)
    before_m = curvature / change  # of a clothoid that starts straight
    y0, x0 = fresnel(before_m / scale)
    y, x = fresnel((before_m + ds) / scale)
    x, y = scale * (x - x0), sign * scale * (y - y0)
    back = -0.5 * change * before_m**2
    cos, sin = math.cos(back), math.sin(back)
    return cos * x - sin * y, sin * x + cos * y, turn


def _follow_line(ds: Float, _length_m: float, _numbers: Mapping[str, float]) -> tuple[Float, Float, Float]:
    return ds, np.zeros_like(ds), np.zeros_like(ds)


def _follow_arc(ds: Float, _length_m: float, numbers: Mapping[str, float]) -> tuple[Float, Float, Float]:
    return follow_clothoid(ds, numbers["curvature"], 0.0)


def _follow_spiral(ds: Float, length_m: float, numbers: Mapping[str, float]) -> tuple[Float, Float, Float]:
    change = (numbers["curvEnd"] - numbers["curvStart"]) / length_m if length_m > _SHORT_M else 0.0
    return follow_clothoid(ds, numbers["curvStart"], change)


def _follow_poly3(ds: Float, length_m: float, numbers: Mapping[str, float]) -> tuple[Float, Float, Float]:
    """V is a cubic of u; u at a distance along the curve is interpolated between 2,001 of them."""
    a, b, c, d = (numbers[name] for name in "abcd")
    u = np.linspace(0.0, length_m, 2001)
    v = a + u * (b + u * (c + u * d))
    u = np.interp(ds, np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(u), np.diff(v)))]), u)
    return u, a + u * (b + u * (c + u * d)), np.arctan(b + u * (2 * c + 3 * u * d))


def _follow_param_poly3(ds: Float, length_m: float, numbers: Mapping[str, float]) -> tuple[Float, Float, Float]:
    p = ds / length_m if numbers["normalized"] and length_m > _SHORT_M else ds
    (au, bu, cu, du), (av, bv, cv, dv) = ([numbers[name + axis] for name in "abcd"] for axis in "UV")
    turn = np.arctan2(bv + p * (2 * cv + 3 * p * dv), bu + p * (2 * cu + 3 * p * du))
    return au + p * (bu + p * (cu + p * du)), av + p * (bv + p * (cv + p * dv)), turn


_Follow = Callable[[Float, float, Mapping[str, float]], tuple[Float, Float, Float]]
SHAPES: Final[dict[str, tuple[tuple[str, ...], _Follow]]] = {
    "line": ((), _follow_line),
    "arc": (("curvature",), _follow_arc),
    "spiral": (("curvStart", "curvEnd"), _follow_spiral),
    "poly3": (tuple("abcd"), _follow_poly3),
    "paramPoly3": (tuple(name + axis for axis in "UV" for name in "abcd"), _follow_param_poly3),
}
"""By the name of the element: the attributes that it must have, and the function that follows it."""


@dataclass(frozen=True)
class RoadLine:
    """The reference line of a road in space: its pieces in the plane, its height and how far it is tilted."""

    name: str  # with file and line, for errors
    length_m: float
    pieces: tuple[Piece, ...]  # ascending, one at least
    height: Cubics
    tilt: Cubics  # superelevation, rad

    def follow(self, s: Float) -> tuple[Float, Float, Float]:
        """x, y (m) and heading (rad) (K,) of the reference line at s (K,)."""
        starts = np.array([piece.s for piece in self.pieces])
        piece_ix = np.clip(np.searchsorted(starts, s + _SAME_S_M, side="right") - 1, 0, len(starts) - 1)
        x, y, heading = np.empty((3, *s.shape))
        for k in np.unique(piece_ix):
            piece, in_piece = self.pieces[k], piece_ix == k
            ahead, left, turn = piece.follow(s[in_piece] - piece.s)
            cos, sin = math.cos(piece.heading_rad), math.sin(piece.heading_rad)
            x[in_piece] = piece.x_m + cos * ahead - sin * left
            y[in_piece] = piece.y_m + sin * ahead + cos * left
            heading[in_piece] = piece.heading_rad + turn
        return x, y, heading

    def place(self, s: Float, t: Float) -> Float:
        """Points (…, K, 3) on the surface of the road at s (K,) and t (…, K)."""
        x, y, heading = self.follow(s)
        tilt = self.tilt.at(s)
        level = t * np.cos(tilt)
        up = self.height.at(s) + t * np.sin(tilt)
        return np.stack([x - np.sin(heading) * level, y + np.cos(heading) * level, up], axis=-1)

    def sample(
        self, start: float, end: float, curves: Callable[[Float], Float], breaks: Sequence[float] = (),
        chord_m: float = CHORD_M,
    ) -> Float:  # fmt: skip
        """Places (K,) from `start` to `end`, at `breaks` and between, so that chords stay within `chord_m`.

        `curves`: t (B, K) of curves at places (K,). A chord is held against a quarter, half and three quarters of
        the way. Raises InputError: the road asks for too many places.
        """
        inner = [s for s in (*breaks, *(piece.s for piece in self.pieces)) if start < s < end]
        places = np.unique(np.array([start, *inner, end]))
        most = _MOST_PLACES // len(curves(places[:1]))
        self._check_places(len(places), most)
        places = self._split_turns(places, most)
        open_ = np.ones(len(places) - 1, dtype=bool)
        while open_.any():
            first, last = places[:-1][open_], places[1:][open_]
            is_far = self._is_far(first, last, curves, chord_m) & (last - first > 0.01)
            new = ((first + last) / 2)[is_far]
            self._check_places(len(places) + len(new), most)
            is_split = np.zeros(len(open_), dtype=bool)
            is_split[np.flatnonzero(open_)[is_far]] = True
            split_ix = np.flatnonzero(is_split)
            places, open_ = np.insert(places, split_ix + 1, new), np.repeat(is_split, 1 + is_split)
        return places

    def _check_places(self, number: float, most: int) -> None:
        if number > most:
            raise InputError(f"{self.name}: expected at most {most:,} places along a section to follow it, found more")

    def _split_turns(self, places: Float, most: int) -> Float:
        """Cut stretches longer than 100 m or turning by over a radian: chords of full circles would look exact."""
        starts = np.array([piece.s for piece in self.pieces])
        which = np.clip(np.searchsorted(starts, places[:-1] + _SAME_S_M, side="right") - 1, 0, len(starts) - 1)
        bends = np.array([piece.sharpest_per_m for piece in self.pieces])[which]
        counts = np.ceil(np.diff(places) * np.maximum(bends, 0.01))
        self._check_places(float(counts.sum()), most)
        cut = [np.linspace(a, b, int(n), endpoint=False) for a, b, n in zip(places, places[1:], counts, strict=False)]
        return np.concatenate([*cut, places[-1:]])

    def _is_far(self, first: Float, last: Float, curves: Callable[[Float], Float], chord_m: float) -> np.ndarray:
        """(K,) whether any curve is farther than `chord_m` from its chord between `first` and `last` (K,)."""
        a, b = (self.place(s, curves(s)) for s in (first, last))
        along = b - a
        length2 = np.maximum((along**2).sum(axis=-1), 1e-18)
        is_far = np.zeros(len(first), dtype=bool)
        for share in (0.25, 0.5, 0.75):
            s = first + share * (last - first)
            offset = self.place(s, curves(s)) - a
            along_share = np.clip((offset * along).sum(axis=-1) / length2, 0.0, 1.0)
            distance2 = ((offset - along_share[..., None] * along) ** 2).sum(axis=-1)
            is_far |= (distance2 > chord_m**2).reshape(-1, len(first)).any(axis=0)
        return is_far

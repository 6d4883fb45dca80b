"""How wrong a unit is about its own pose: what the errors of different objects in one list have in common.

A pose off by a shift δ and a turn θ moves each entry by δ + θ·J d, d being where the object is from the unit. Errors of
the objects' own do not correlate between objects, so products over pairs tell the variances of δ and θ without them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2, t

from copem_replay.core.tracks import Float, Int
from copem_replay.pipeline.fit.error_memory import LastingPart
from copem_replay.pipeline.fit.estimate import Estimate, Note, digits, plain
from copem_replay.pipeline.fit.rows import FitLists, FitRows

FEWEST_LISTS = 50
"""Lists with two listed objects or more below which nothing is told."""
FEWEST_BLOCKS = 4
"""Of time, each left out in turn (chosen)."""
_BLOCK_S = 10.0
"""Lists of so long are left out together (chosen)."""
_SURE = 0.99
"""How sure it must be that there is one at all."""
_LAGS = (1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144, 233)
"""Lists between the two of a product."""


@dataclass(frozen=True)
class PoseFit:
    """Standard deviations of the pose and the part of it that lasts; or why there is none."""

    position_sigma_m: Estimate | None = None
    yaw_sigma_deg: Estimate | None = None
    memory: LastingPart | None = None
    untold: str | None = None

    def keys(self, note: Note = plain) -> dict[str, Any]:
        """A unit's `placed`; empty where nothing is told."""
        if self.untold is not None:
            return {}
        out: dict[str, Any] = {}
        for name in ("position_sigma_m", "yaw_sigma_deg"):
            if (one := getattr(self, name)) is not None and one.value > 0:
                out[name] = note(digits(one.value), one.words())
        return out | ({} if self.memory is None else {"memory": [self.memory.keys(note)]})


def fit_pose(rows: FitRows, lists: FitLists) -> PoseFit:
    """Fit the pose of a unit from listed rows. What all rows have in common (their mean) is no pose."""
    count = np.bincount(rows.list, minlength=len(lists.log))
    enough = int((count >= 2).sum())
    if enough < FEWEST_LISTS:
        return PoseFit(untold=f"{enough} lists have two objects or more; a pose needs {FEWEST_LISTS}")
    some = rows.take(count[rows.list] >= 2)
    if (three := int((count >= 3).sum())) < FEWEST_LISTS:
        return PoseFit(untold=f"{three} lists have three objects: what two of them share need not be the unit's")
    b = some.view.bearing_rad
    cos, sin, range_m = np.cos(b), np.sin(b), some.view.range_m
    along, across = (one - one.mean() for one in (some.along_m, some.across_m))
    L = len(lists.log)
    block = (lists.captured_s / _BLOCK_S).astype(np.int64) + 1_000_000 * lists.log
    _, block = np.unique(block, return_inverse=True)

    def pairs(column: Float) -> Float:
        """(L,) Σ over pairs of different objects in a list."""
        whole: Float = (np.bincount(some.list, column, L) ** 2 - np.bincount(some.list, column**2, L)) / 2
        return whole

    # Products along have l·l' of the shift, those across the same and r r' of the turn, l being the lines of sight.
    a11 = 2 * (pairs(cos * cos) + 2 * pairs(cos * sin) + pairs(sin * sin))
    a12, a22 = pairs(cos * range_m) + pairs(sin * range_m), pairs(range_m * range_m)
    b1 = sum(pairs(one * way) for one in (along, across) for way in (cos, sin))
    b2 = pairs(across * range_m)
    sums = np.array([np.bincount(block, one) for one in (a11, a12, a22, b1, b2)])
    lags = _lagged(some, lists, block, cos * along - sin * across, sin * along + cos * across)
    B = sums.shape[1]
    if B < FEWEST_BLOCKS:
        return PoseFit(untold=f"{enough} lists in {B} × {_BLOCK_S:g} s; a pose needs {FEWEST_BLOCKS} such times")
    without = [sums.sum(axis=1) - sums[:, k] for k in range(B)]
    free, error = _jackknifed(_both(sums.sum(axis=1)), np.array([_both(one) for one in without]))
    if not (free > t.ppf(_SURE, B - 1) * error).any():
        whole = np.maximum(free, 0)
        most = np.sqrt(np.maximum(whole + 1.96 * error, 0))
        why = f"errors of different objects hang together no more than by chance (pose: < {most[0]:.2g} m, "
        return PoseFit(untold=f"{why}< {np.rad2deg(most[1]):.2g}°, {enough} lists)")
    whole, error = _jackknifed(_solved(sums.sum(axis=1)), np.array([_solved(one) for one in without]))
    shift, turn = (_sigma(value, off, enough, B) for value, off in zip(whole, error, strict=True))
    value, low, high = np.rad2deg([turn.value, turn.low, turn.high]).tolist()
    memory = _memory(lags, float(np.median(np.diff(lists.captured_s)[np.diff(lists.log) == 0])), enough)
    return PoseFit(shift, Estimate(value, low, high, turn.n, turn.n_effective), memory)


def _jackknifed(whole: Float, each: Float) -> tuple[Float, Float]:
    """A value (2,) and its standard error, from the same without each block (B, 2)."""
    B = len(each)
    error: Float = np.sqrt((B - 1) / B * ((each - each.mean(axis=0)) ** 2).sum(axis=0))
    return whole, error


def _both(sums: Float) -> Float:
    """(2,) variances of shift (m²) and turn (rad²) from the normal equations; may be below 0."""
    a11, a12, a22, b1, b2 = sums
    both: Float = np.linalg.lstsq(np.array([[a11, a12], [a12, a22]]), np.array([b1, b2]), rcond=None)[0]
    return both  # of objects in one direction and at one range the two are one


def _solved(sums: Float) -> Float:
    """The same; where one would be below 0 the other alone."""
    both, (a11, _, a22, b1, b2) = _both(sums), sums
    if both[1] < 0:
        return np.array([max(b1 / a11, 0.0), 0.0])
    return both if both[0] >= 0 else np.array([0.0, max(b2 / a22, 0.0)])


def _sigma(variance: float, error: float, n: int, blocks: int) -> Estimate:
    """Of a variance with its standard error: as of a sample with as many degrees of freedom as give that error."""
    if variance <= error:
        return Estimate(float(np.sqrt(variance)), 0.0, float(np.sqrt(variance + 1.96 * error)), n, blocks)
    freedom = 2 * (variance / error) ** 2 * (blocks - 1) / (blocks + 1)
    low, high = np.sqrt(freedom * variance / chi2.ppf([0.975, 0.025], freedom))
    return Estimate(float(np.sqrt(variance)), float(low), float(high), n, blocks)


def _lagged(rows: FitRows, lists: FitLists, block: Int, east_m: Float, north_m: Float) -> Float:
    """(1 + lags, 2, blocks): Σ eᵢ(t)·eⱼ(t + lag) over different objects, and how many such pairs; first of lag 0."""
    L, B = len(lists.log), int(block.max()) + 1
    key = rows.object * L + rows.list + rows.log * L * (int(rows.object.max()) + 1)
    order = np.argsort(key)
    total = [np.bincount(rows.list, one, L) for one in (east_m, north_m, np.ones(len(east_m)))]
    out = np.zeros((1 + len(_LAGS), 2, B))
    for k, lag in enumerate((0, *_LAGS)):
        if lag >= L:
            break
        here = lists.log[: L - lag] == lists.log[lag:]
        product, number = (
            np.where(here, sum(one[: L - lag] * one[lag:] for one in ones), 0.0) for ones in (total[:2], total[2:])
        )
        at = np.clip(np.searchsorted(key[order], key + lag), 0, len(key) - 1)
        again = order[at]
        same = (key[again] == key + lag) & (rows.list + lag < L)
        own = east_m * east_m[again] + north_m * north_m[again]
        product -= np.bincount(rows.list[same], own[same], L)[: L - lag]
        number -= np.bincount(rows.list[same], minlength=L)[: L - lag]
        out[k] = [np.bincount(block[: L - lag], one, B) for one in (product, number)]
    return out


def _memory(lags: Float, period_s: float, n: int) -> LastingPart | None:
    """A drift by least squares of the correlations at lags, or what lasts always; None: none is seen."""
    from scipy.optimize import least_squares

    B = lags.shape[2]
    delta_s = period_s * np.array(_LAGS)

    def fitted(sums: Float) -> Float:
        mean = sums[:, 0] / np.maximum(sums[:, 1], 1)
        weight = np.sqrt(sums[1:, 1] / max(sums[0, 1], 1))

        def off(x: Float) -> Float:
            rest: Float = weight * (mean[1:] / mean[0] - np.clip(x[0], 0, 1) * np.exp(-delta_s / np.exp(x[1])))
            return rest

        found: Float = least_squares(off, [0.7, np.log(10 * period_s)], bounds=([0, -5], [1, 9])).x
        return found

    whole = fitted(lags.sum(axis=2))
    each = np.array([fitted(lags.sum(axis=2) - lags[:, :, k]) for k in range(B)])
    error = 1.96 * np.sqrt((B - 1) / B * ((each - each.mean(axis=0)) ** 2).sum(axis=0))
    if whole[0] - error[0] <= 0:
        return None
    share = Estimate(float(whole[0]), float(whole[0] - error[0]), float(min(whole[0] + error[0], 1.0)), n, B)
    low, middle, high = np.exp([whole[1] - error[1], whole[1], whole[1] + error[1]])
    if middle > 3 * delta_s[-1]:
        return LastingPart(share, "always")
    return LastingPart(share, Estimate(float(middle), float(low), float(high), n, B))

"""Maximum likelihood over a few numbers, and profile intervals: what the data leave open when all else adapts."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from copem_replay.core.tracks import Float

LogLikelihood = Callable[[Float], float]
Bounds = Sequence[tuple[float, float]]
DROP = 1.9207294
"""By how much the log-likelihood falls at the ends of a 95 % interval: half of χ²₁."""
_H = 1e-3
"""Step of derivatives (chosen: parameters are logarithms and log-odds)."""
_GAIN = 1e-3
"""The maximum is found when no more than this is to be had (chosen)."""
_FAR = 3.0
"""No step is longer."""


def maximum(of: LogLikelihood, starts: Sequence[Sequence[float] | Float], bounds: Bounds) -> tuple[Float, float]:
    """Where a log-likelihood of a few numbers is largest, and how large: the best of Newton's method from each start.

    By differences, along the eigenvectors of the curvature, damped where a step does not gain: for so few numbers that
    takes fewer calls than L-BFGS.
    """
    low, high = np.array(bounds, dtype=float).reshape(-1, 2).T
    found = [_climbed(of, np.clip(np.asarray(start, dtype=float), low, high), low, high) for start in starts]
    return max(found, key=lambda one: one[1])


def _climbed(of: LogLikelihood, at: Float, low: Float, high: Float) -> tuple[Float, float]:
    value, damping = of(at), 1e-3
    for _ in range(60 if len(at) else 0):
        slope, curvature = _derivatives(of, at, value, low, high)
        free = ~(((at <= low) & (slope < 0)) | ((at >= high) & (slope > 0)))
        slope = np.where(free, slope, 0.0)
        curvature *= np.outer(free, free)
        size, axes = np.linalg.eigh(curvature)
        along = axes.T @ slope
        while True:
            step = axes @ (along / (np.abs(size) * (1 + damping) + damping + 1e-9))
            step *= min(1.0, _FAR / max(np.abs(step).max(), 1e-12))
            there = np.clip(at + step, low, high)
            if slope @ (there - at) < _GAIN:
                return at, value
            if (better := of(there)) > value:
                at, value, damping = there, better, damping / 8
                break
            damping *= 10
    return at, value


def _derivatives(of: LogLikelihood, at: Float, value: float, low: Float, high: Float) -> tuple[Float, Float]:
    """Gradient (k,) and curvature (k, k), just inside the bounds."""
    steps = _H * np.eye(len(at))
    at = np.clip(at, low + _H, high - _H)
    up, down = ([of(at + sign * step) for step in steps] for sign in (1, -1))
    curvature = np.diag([(u + d - 2 * value) / _H**2 for u, d in zip(up, down, strict=True)])
    for i in range(len(at)):
        for j in range(i):
            both = of(at + steps[i] + steps[j])
            curvature[i, j] = curvature[j, i] = (both - up[i] - up[j] + value) / _H**2
    return (np.array(up) - np.array(down)) / (2 * _H), curvature


def profile_limits(of: LogLikelihood, best: Float, value: float, k: int, bounds: Bounds) -> tuple[float, float]:
    """The 95 % profile interval of parameter k about the maximum; a bound where the likelihood never falls enough."""
    others = [j for j in range(len(best)) if j != k]
    rest = [bounds[j] for j in others]
    # Near its bounds a log-likelihood of log-odds is flat: what begins there would stay.
    low, high = ([(1 - a) * one + a * two for one, two in rest] for a in (0.3, 0.7))

    def limit(towards: float) -> float:
        starts = [best[others], np.clip(best[others], low, high)]

        def fall(at: float) -> float:
            nonlocal starts
            if np.array_equal(starts[0], starts[-1]):
                starts = starts[:1]
            warm, highest = maximum(lambda x: of(np.insert(x, k, at)), starts, rest)
            starts = [warm]
            return value - highest - DROP

        end, step, inner = bounds[k][0 if towards < 0 else 1], 0.25, float(best[k])
        while True:  # outwards until it has fallen
            outer = min(inner + step, end) if towards > 0 else max(inner - step, end)
            if (below := fall(outer)) > 0:
                break
            if outer == end:
                return end
            inner, step = outer, 2 * step
        before = fall(inner) if inner != best[k] else -DROP
        for _ in range(6):  # the profile is about a parabola: secants of its root meet fast
            near, far = np.sqrt(max(before + DROP, 0.0)), np.sqrt(below + DROP)
            at = inner + (outer - inner) * np.clip((np.sqrt(DROP) - near) / (far - near), 0.02, 0.98)
            here = fall(at)
            if abs(here) < 0.02:
                return float(at)
            inner, before, outer, below = (at, here, outer, below) if here < 0 else (inner, before, at, here)
        return float(inner)

    return limit(-1.0), limit(1.0)

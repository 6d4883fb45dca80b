"""The existence that a unit claims, of real objects and of others, and its calibration."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from copem_replay.core.tracks import Float, Int
from copem_replay.pipeline.fit.estimate import Estimate, Note, digits, plain
from copem_replay.pipeline.fit.profile import maximum

CURVE_BINS = 12
_FEWEST = 8


@dataclass(frozen=True)
class ExistenceFit:
    """Beta shapes (a, b) of matched entries and of others, None where that cannot be told; or one `number` for all.

    `curve`: columns claimed, real, low, high, n of bins of what is claimed; empty where the truth is not complete.
    """

    real: tuple[Estimate, Estimate] | None = None
    ghost: tuple[Estimate, Estimate] | None = None
    number: Estimate | None = None
    curve: Float | None = None
    untold: str | None = None

    def keys(self, note: Note = plain) -> Any:
        """A couple's `existence`, None: nothing to say. Ghosts that are not known claim what objects do."""
        if self.number is not None:
            return note(round(self.number.value, 4), "the same of every entry")
        if self.real is None:
            return None

        def shapes(two: tuple[Estimate, Estimate], more: str = "") -> Any:
            return note([digits(one.value) for one in two], more + "; ".join(one.words() for one in two))

        ghost = shapes(self.real, "chosen, as of objects: ") if self.ghost is None else shapes(self.ghost)
        return {"kind": "scores", "real": shapes(self.real), "ghost": ghost}


def fit_existence(real: Float, series_ix: Int, other: Float | None) -> ExistenceFit:
    """Fit what is claimed of real objects (n,), of series, and of `other` entries (None: the truth is not complete)."""
    there = np.isfinite(real)
    claimed, series_ix = real[there], series_ix[there]
    if len(claimed) < _FEWEST:
        return ExistenceFit(untold="the lists have no existence" if not len(claimed) else f"{len(claimed)} entries")
    others = None if other is None else other[np.isfinite(other)]
    if claimed.std() < 1e-6:
        mean = float(claimed.mean())
        return ExistenceFit(number=Estimate(mean, mean, mean, len(claimed), len(claimed)))
    ghost = None
    if others is not None and len(others) >= _FEWEST and others.std() > 1e-6:
        ghost = beta_shapes(others, np.arange(len(others)))
    curve = None if others is None else _curve(claimed, others)
    real_shapes = beta_shapes(claimed, series_ix)
    if ghost is not None:
        real_shapes = _without_ghosts(claimed, real_shapes, (ghost[0].value, ghost[1].value))
    return ExistenceFit(real_shapes, ghost, None, curve)


def beta_shapes(values: Float, cluster: Int) -> tuple[Estimate, Estimate]:
    """(a, b) of a Beta by moments; intervals of their logarithms by leaving out a cluster (of rows, few: a tenth)."""
    names, which = np.unique(cluster, return_inverse=True)
    if len(names) < 8 or len(names) > 400:
        which = np.arange(len(values)) * (10 if len(names) < 8 else 200) // len(values)
    groups = int(which.max()) + 1
    sums = np.array([np.bincount(which, weights, groups) for weights in (np.ones(len(values)), values, values**2)])
    found = _shapes(sums.sum(axis=1))
    each = np.log([_shapes(sums.sum(axis=1) - sums[:, g]) for g in range(groups)])
    error = np.sqrt((groups - 1) / groups * ((each - each.mean(axis=0)) ** 2).sum(axis=0))
    far = np.exp(2.0 * error)
    return tuple(  # type: ignore[return-value]
        Estimate(a, float(a / f), float(a * f), len(values), groups) for a, f in zip(found, far, strict=True)
    )


def _without_ghosts(
    claimed: Float, shapes: tuple[Estimate, Estimate], ghost: tuple[float, float]
) -> tuple[Estimate, Estimate]:
    """The shapes (a, b) if some of what is matched are ghosts that were near an object: by likelihood, as a mixture."""
    from scipy.special import expit
    from scipy.stats import beta

    values = np.clip(claimed, 1e-6, 1 - 1e-6)
    false = beta.pdf(values, *ghost)

    def of(x: Float) -> float:
        share = float(expit(x[2]))
        return float(np.log((1 - share) * beta.pdf(values, *np.exp(x[:2])) + share * false + 1e-300).sum())

    start = [float(np.log(one.value)) for one in shapes]
    limits = (float(np.log(0.1)), float(np.log(1000)))
    best, _ = maximum(of, [(*start, -6.0), (*start, -3.0)], (limits, limits, (-9.0, 0.0)))
    moved = np.exp(best[:2]) / [one.value for one in shapes]
    one, two = (
        replace(old, value=old.value * by, low=old.low * by, high=old.high * by)
        for old, by in zip(shapes, moved.tolist(), strict=True)
    )
    return one, two


def _shapes(sums: Float) -> tuple[float, float]:
    n, first, second = sums
    mean = float(np.clip(first / n, 1e-4, 1 - 1e-4))
    variance = max(float(second / n - (first / n) ** 2), 1e-9)
    strength = max(mean * (1 - mean) / variance - 1, 1e-3)
    return float(np.clip(mean * strength, 0.1, 1000)), float(np.clip((1 - mean) * strength, 0.1, 1000))


def _curve(real: Float, others: Float) -> Float:
    from scipy.stats import beta

    every = np.concatenate([real, others])
    edges = np.unique(np.quantile(every, np.linspace(0, 1, CURVE_BINS + 1)))
    bin_ix = np.clip(np.searchsorted(edges, every, side="right") - 1, 0, max(len(edges) - 2, 0))
    rows = []
    for b in np.unique(bin_ix):
        mine = bin_ix == b
        n, k = int(mine.sum()), int(mine[: len(real)].sum())
        rows.append([every[mine].mean(), k / n, *beta.ppf([0.025, 0.975], k + 0.5, n - k + 0.5), n])
    return np.array(rows).T

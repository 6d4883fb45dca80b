"""What objects are taken for, and how long such a mistake lasts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.special import expit
from scipy.stats import beta

from copem_replay.core.tracks import CLASSES, Float
from copem_replay.pipeline.fit.error_memory import LastingPart, Series
from copem_replay.pipeline.fit.errors_kernel import squared_correlations
from copem_replay.pipeline.fit.estimate import Estimate, Note, plain
from copem_replay.pipeline.fit.profile import maximum, profile_limits
from copem_replay.pipeline.fit.rest_kernel import log_classes
from copem_replay.pipeline.fit.rows import FitRows

_BOUNDS = ((-8.0, 8.0), (np.log(0.01), np.log(1e4)))
_WORTH_IT = 2.996
"""By how much memory must explain more: half of the 95 % quantile of χ²₂."""


@dataclass(frozen=True)
class ClassesFit:
    """By true class and listed class the probability; the parts that last; or why nothing can be told."""

    confusion: Mapping[str, Mapping[str, Estimate]] = field(default_factory=dict)
    memory: tuple[LastingPart, ...] = ()
    untold: str | None = None

    def keys(self, note: Note = plain) -> dict[str, Any]:
        """A PEM's `classes`; empty where no class is mistaken."""
        rows = {}
        for true, row in self.confusion.items():
            shares = {name: round(one.value, 4) for name, one in row.items()}
            shares[true] = round(1 - sum(share for name, share in shares.items() if name != true), 4)
            if len(shares) > 1:
                words = "; ".join(f"{name} {one.words()}" for name, one in row.items())
                rows[true] = note(shares, words)
        return {"confusion": rows} if rows else {}


def fit_classes(rows: FitRows, series: Series) -> ClassesFit:
    """Fit the classes of listed rows. Each probability has a Dirichlet(½) prior over the classes that are seen of it.

    A list goes by a held uniform with probability `share`, which lasts τ: (share, τ) by the likelihood of all listed
    classes, and a count is worth what such rows are.
    """
    if not (rows.class_ix >= 0).any():
        return ClassesFit(untold="the lists have no classes")
    true, listed = rows.view.class_ix.astype(np.int64), rows.class_ix
    if (true == listed).all():
        high = float(beta.ppf(0.95, 0.5, len(true) + 0.5))
        return ClassesFit(
            untold=f"no class mistaken in {len(true)} entries (mistaken: < {high:.2g}, were they independent)"
        )
    counts = np.zeros((len(CLASSES), len(CLASSES)))
    np.add.at(counts, (true, listed), 1.0)
    seen = (counts > 0) | (np.eye(len(CLASSES), dtype=bool) & (counts.sum(axis=1) > 0)[:, None])
    smooth = np.where(seen, counts + 0.5, 0.0)
    shares = np.ascontiguousarray((smooth / np.maximum(smooth.sum(axis=1), 1)[:, None])[true])

    def of(x: Float) -> float:
        return float(log_classes(shares, listed, series.decay(float(np.exp(x[1]))), series.new, float(expit(x[0]))))

    best, value = maximum(of, [(w, np.log(tau_s)) for w in (-1.0, 1.5) for tau_s in (0.3, 3.0)], _BOUNDS)
    fresh = float(log_classes(shares, listed, series.decay(1.0), series.new, 0.0))
    memory: tuple[LastingPart, ...] = ()
    share, tau_s = 0.0, 1.0
    if value - fresh > _WORTH_IT:
        share, tau_s = float(expit(best[0])), float(np.exp(best[1]))
        lasts = expit(profile_limits(of, best, value, 0, _BOUNDS)), np.exp(profile_limits(of, best, value, 1, _BOUNDS))
        n = len(true)
        memory = (
            LastingPart(
                *(Estimate(one, float(low), float(high), n, float(series.new.sum()))
                  for one, (low, high) in zip((share, tau_s), lasts, strict=True))
            ),
        )  # fmt: skip
    half = np.sqrt(series.decay(tau_s))
    pairs = squared_correlations(half, series.new, true, len(CLASSES), share, 0.0)
    confusion = {}
    for k in np.flatnonzero(counts.sum(axis=1)):
        n = int(counts[k].sum())
        worth = n * n / pairs[k]
        kinds = np.flatnonzero(seen[k])
        confusion[CLASSES[k]] = {CLASSES[j]: _share(counts[k, j], n, worth, len(kinds)) for j in kinds}
    return ClassesFit(confusion, memory)


def _share(count: float, n: int, worth: float, kinds: int) -> Estimate:
    k = count * worth / n
    low, high = beta.ppf([0.025, 0.975], k + 0.5, worth - k + 0.5)
    value = (k + 0.5) / (worth + 0.5 * kinds)
    return Estimate(float(value), float(min(low, value)), float(max(high, value)), n, float(worth))

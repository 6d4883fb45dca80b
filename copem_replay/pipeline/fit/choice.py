"""Which of several models is written, from the simplest to the richest: the simplest that predicts like the best.

*Held out*: each model is fitted without a part of the passes and scored there by the logarithm of the probability of
what was recorded. The differences of two models over passes say how sure the better one is: Breiman's rule takes the
simplest within one standard error of the best. *BIC* where there are too few passes to hold any out.

Source: L. Breiman, J. Friedman, R. Olshen, C. Stone, "Classification and Regression Trees", 1984, section 3.4.3 (the
rule); G. Schwarz, "Estimating the dimension of a model", Ann. Statist. 6 (1978) 461–464.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from copem_replay.core.tracks import Float, Int
from copem_replay.metrics.intervals import resamples

FEWEST_PASSES = 4
"""With fewer passes than this none is held out (chosen)."""


@dataclass(frozen=True)
class Rung:
    """One model of a ladder: what it scores per list, and how far that is below the best, ± one standard error.

    `score`: held-out log-likelihood (nats per list), or −BIC / 2n.
    """

    name: str
    score: float
    below: float
    below_se: float
    chosen: bool
    by: Literal["held out", "BIC"]

    def words(self) -> str:
        """As the files and the report say it."""
        far = "the best" if self.below == 0 else f"{self.below:.3g} ± {self.below_se:.2g} below the best"
        return f"{self.name}: {self.score:.4g} nats per list ({self.by}), {far}{', chosen' if self.chosen else ''}"


def held_out_possible(pass_ix: Int, fold: Int) -> bool:
    """Whether there are enough passes, in more than one fold."""
    return len(np.unique(pass_ix)) >= FEWEST_PASSES and len(np.unique(fold)) > 1


def choose(
    names: Sequence[str], scores: Float, weights: Float | Int, *, simplest: bool = False, seed: int = 0
) -> tuple[int, tuple[Rung, ...]]:
    """The simplest rung within one standard error of the best, and the table of all; `simplest`: the first in any case.

    `names` from the simplest to the richest; `scores (rungs, passes)`: held-out log-likelihood of each pass, summed;
    `weights (passes,)`: how many lists each has. The standard error is that of the difference to the best, over
    resamples of whole passes. A rung that holds something recorded for impossible (−inf) is below any other.
    """
    total = weights.sum()
    score = scores.sum(axis=1) / total
    best = int(np.argmax(score))
    count = resamples([str(k) for k in range(len(weights))], seed)
    times = count.times / count.times.sum()
    below, error = np.zeros(len(names)), np.zeros(len(names))
    for k in range(len(names)):
        if k == best:
            continue
        below[k] = score[best] - score[k]
        if np.isfinite(below[k]):
            drawn = count.count @ (scores[best] - scores[k]) / (count.count @ weights)
            error[k] = np.sqrt(times @ (drawn - times @ drawn) ** 2)
    return _chosen(names, score, below, error, "held out", simplest)


def choose_by_bic(
    names: Sequence[str], log_likelihood: Float, parameters: Int, n: int, n_effective: float, *, simplest: bool = False
) -> tuple[int, tuple[Rung, ...]]:
    """The rung of the least BIC, the simpler one of two alike, and the table of all; see `choose`.

    `log_likelihood (rungs,)` of `n` rows, that are worth `n_effective`, by each model fitted to all; `parameters`: how
    many numbers each has.
    """
    score = log_likelihood / n - parameters * np.log(max(n_effective, 1.0)) / (2 * n_effective)
    return _chosen(names, score, score.max() - score, np.zeros(len(names)), "BIC", simplest)


def _chosen(
    names: Sequence[str], score: Float, below: Float, error: Float, by: Literal["held out", "BIC"], simplest: bool
) -> tuple[int, tuple[Rung, ...]]:
    index = 0 if simplest else int(np.argmax(below <= error))
    columns = zip(names, score.tolist(), below.tolist(), error.tolist(), strict=True)
    return index, tuple(Rung(name, s, b, e, k == index, by) for k, (name, s, b, e) in enumerate(columns))

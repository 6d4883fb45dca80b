"""How often intervals of shares hold the true share, and how wide they are: over few clusters, near 0 and 1.

    python tools/coverage.py                       # all designs, 2,000 trials each: two minutes on one core

A trial draws the share of every cluster (a log, an object) from a distribution whose mean is the true share, and, where
weights are lognormal (σ = 1), how many rows each cluster has. `bootstrap`: percentiles alone; `reported`: as in
`summary.csv`, nowhere narrower than the exact limits where few clusters decide. 95 % is what is asked for. With 2,000
trials a coverage is off by .005 (one standard error at .95).
"""

from __future__ import annotations

if __name__ == "coverage":  # numba looks for the package of that name, and within tools/ this file comes first
    raise ImportError("tools/coverage.py is a program, not the package")

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import pandas as pd

from copem_replay.core.tracks import Float
from copem_replay.metrics.intervals import bootstrap_share, draw_resamples, share_limits
from copem_replay.metrics.summary import format_table

CLUSTERS: Final = (5, 8, 12, 20, 30, 60, 120)
Draw = Callable[[np.random.Generator, int], Float]


@dataclass(frozen=True)
class Design:
    """What shares clusters have: their mean, and how to draw (K,) of them."""

    name: str
    share: float
    draw: Draw


def _beta(a: float, b: float) -> Draw:
    return lambda rng, clusters: rng.beta(a, b, clusters)


def _all_or_nothing(share: float) -> Draw:
    return lambda rng, clusters: (rng.random(clusters) < share).astype(float)


DESIGNS: Final = (
    Design("Beta(.9, .1)", 0.9, _beta(0.9, 0.1)),
    Design("Beta(8, 1)", 8 / 9, _beta(8, 1)),
    Design("U(0, 1)", 0.5, _beta(1, 1)),
    *(Design(f"0/1 at {share:g}", share, _all_or_nothing(share)) for share in (0.5, 0.9, 0.97)),
)
WEIGHTS: Final[dict[str, Draw]] = {
    "equal": lambda rng, clusters: np.ones(clusters),
    "lognormal": lambda rng, clusters: rng.lognormal(0.0, 1.0, clusters),
}


def held(design: Design, weights: str, clusters: int, trials: int, seed: int) -> dict[str, object]:
    """How many of the trials' intervals hold the true share, and their mean width."""
    rng = np.random.default_rng([seed, clusters, *design.name.encode(), *weights.encode()])
    resampled = draw_resamples([str(k) for k in range(clusters)], seed)
    limits = np.empty((trials, 2, 2))
    for trial in range(trials):
        totals = WEIGHTS[weights](rng, clusters)
        successes = np.minimum(totals * design.draw(rng, clusters), totals)
        limits[trial, 0] = bootstrap_share(successes, totals, resampled)
        limits[trial, 1] = share_limits(successes, totals, resampled)[1:]
    # Sums of ones over sums of ones are 1 but for rounding.
    holds = (limits[:, :, 0] <= design.share + 1e-12) & (design.share - 1e-12 <= limits[:, :, 1])
    coverage, width = holds.mean(axis=0), np.diff(limits, axis=2)[:, :, 0].mean(axis=0)
    return {
        "shares": design.name,
        "weights": weights,
        "clusters": clusters,
        "bootstrap holds": float(coverage[0]),
        "width": float(width[0]),
        "reported holds": float(coverage[1]),
        "its width": float(width[1]),
    }


def coverage(clusters: Sequence[int] = CLUSTERS, trials: int = 2000, seed: int = 1) -> pd.DataFrame:
    """A row per design, kind of weights and number of clusters."""
    return pd.DataFrame(
        [
            held(design, weights, number, trials, seed)
            for weights in WEIGHTS
            for design in DESIGNS
            for number in clusters
        ]
    )


def cost(table: pd.DataFrame) -> pd.DataFrame:
    """How often each kind holds at least, and how wide it is on the average, by weights and number of clusters."""
    rows = []
    for (weights, number), of in table.groupby(["weights", "clusters"]):
        widths = of["width"].mean(), of["its width"].mean()
        least = of["bootstrap holds"].min(), of["reported holds"].min()
        rows.append(
            {
                "weights": weights,
                "clusters": number,
                "bootstrap holds, least": least[0],
                "mean width": widths[0],
                "reported holds, least": least[1],
                "its mean width": widths[1],
                "times as wide": round(widths[1] / widths[0], 2),
            }
        )
    return pd.DataFrame(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description="Coverage and mean width of the intervals of shares.")
    parser.add_argument("--trials", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--clusters", type=int, nargs="+", default=list(CLUSTERS))
    asked = parser.parse_args()
    table = coverage(asked.clusters, asked.trials, asked.seed)
    print(format_table(table.round(3)))
    print("\nOver all shares of clusters:")
    print(format_table(cost(table).round(3)))


if __name__ == "__main__":
    main()

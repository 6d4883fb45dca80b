"""Which configurations compete, which of them is the baseline, and in which order figures and words name them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from copem_replay.results.compare.labels import DEFAULT_BASELINE

if TYPE_CHECKING:
    from copem_replay.results.compare import Comparison
    from copem_replay.results.read import Results

RANKED_BY = "ttd_rmst_s"
"""What configurations are ranked by: the mean time that counts what was never detected, too."""


def truths(results: Results) -> tuple[str, ...]:
    """Configurations that are the ground truth, in their order."""
    return tuple(name for name, one in results.experiment.configurations.items() if one.units == "truth")


def contenders(results: Results, names: Sequence[str] | None = None) -> tuple[str, ...]:
    """Those of `names` (None: all) that are not the ground truth; all of them, if there is nothing else."""
    chosen, upper = results.chosen(names), truths(results)
    return tuple(name for name in chosen if name not in upper) or chosen


def soonest_first(results: Results, names: Sequence[str]) -> tuple[str, ...]:
    """By the mean time to detection; of equals the one with which more pass, then the first.

    Last come those that a log leaves out: their means are over fewer objects.
    """
    rows = results.summary.set_index("configuration")
    fewer = measured_elsewhere(results, names)

    def rank(name: str) -> tuple[bool, float, float]:
        row = rows.loc[name]
        mean_s, passes = float(row[RANKED_BY]), float(row.get("pass_share", math.nan))
        return name in fewer, math.inf if math.isnan(mean_s) else mean_s, 0.0 if math.isnan(passes) else -passes

    return tuple(sorted(names, key=rank))


def measured_elsewhere(results: Results, names: Sequence[str]) -> tuple[str, ...]:
    """Of some configurations those with fewer rows than others: logs that lack their units leave them out."""
    rows = results.summary.set_index("configuration")["n"].loc[list(names)]
    return tuple(name for name in names if rows[name] < rows.max())


def default_baseline(results: Results) -> str:
    """The configuration `ideal`; without one the first that is not the ground truth."""
    names = tuple(results.experiment.configurations)
    return DEFAULT_BASELINE if DEFAULT_BASELINE in names else contenders(results)[0]


def differences_of(results: Results, names: Sequence[str], metrics: Sequence[str]) -> Comparison:
    """Of some configurations, in some metrics, to the default baseline. Raises InputError."""
    from copem_replay.results.compare import compare  # which reads experiments and all that they need

    return compare([results], configurations=names, baseline=default_baseline(results), metrics=metrics)

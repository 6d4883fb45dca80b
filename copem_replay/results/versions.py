"""Versions: whether newer results are better or worse than older ones, in one line for a build.

Each configuration is held against itself. It is better or worse in a figure whose difference matters and is shown (all
differences together held at 95 %), or is the same in every cluster, so that there is no interval.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import pandas as pd

from copem_replay.core.errors import name_first
from copem_replay.metrics.braking.driving import SHARE
from copem_replay.metrics.summary_metrics import COMPARED
from copem_replay.results.compare.limits import BETTER, STAR, WORSE
from copem_replay.results.compare.tables import explain_no_interval
from copem_replay.results.decision import MATTERS
from copem_replay.results.screen import tell_difference

if TYPE_CHECKING:
    from copem_replay.results.compare import Comparison

_DECIDED_BY = {
    "pass_share": "brakes in time {}", "ttd_rmst_s": "{}", SHARE: "brakes for nothing {}",
    "position_rmse_held_m": "position error {} m", "false_positives_per_min": "false per minute {}",
}  # fmt: skip
"""Figures that decide, the first ones first, and their words."""
_NAMED = 3
_ALONE = "without an interval, on these objects alone"


class VersionChange(NamedTuple):
    """The answer in short, `new against old: worse`, and in one line; the configurations that differ."""

    head: str
    sentence: str
    differing: tuple[str, ...]


def tell_change(comparison: Comparison) -> VersionChange:
    """The change from older results to newer ones."""
    rows = {(row.configuration, row.metric): row for row in comparison.overall.itertuples(index=False)}
    known = [name for name in comparison.configurations if name not in comparison.truths]
    changed = [name for name in known if name not in comparison.unchanged]
    groups: dict[str, dict[str, list[str]]] = {word: {} for word in (WORSE, BETTER, _ALONE)}
    for name in changed:
        for metric, words in _DECIDED_BY.items():
            row = rows.get((name, metric))
            if (word := _judge_row(row, comparison.matters.get(metric, MATTERS[metric]))) is not None:
                size, *more = tell_difference(metric, row, alike=True).removesuffix(f" {STAR}").split(" ", 1)
                groups[word].setdefault(name, []).append(" ".join([words.format(size), *more]))
    differing = tuple(dict.fromkeys(name for of in groups.values() for name in of))
    sentences = [f"{word}: {name_first(_join_figures(of), 2)}" for word, of in groups.items() if of]
    if quiet := [name for name in changed if name not in differing]:
        sentences.append(f"no difference is shown: {name_first(quiet, _NAMED)}")
    short = " and ".join(word for word in (BETTER, WORSE) if groups[word])
    short = short or ("no interval" if groups[_ALONE] else "no difference is shown" if changed else "nothing changed")
    same = f"{len(known) - len(changed)} unchanged" if changed else f"nothing changed: {name_first(known, _NAMED)}"
    sentences += [same] if len(known) > len(changed) else []
    head = f"{', '.join(comparison.newer)} against {comparison.baseline}: "
    return VersionChange(head + short, head + "; ".join(sentences), differing)


def _judge_row(row: Any, least: float) -> str | None:
    """Whether a figure is better or worse, or differs on these objects alone; None: no difference is shown."""
    if row is None or pd.isna(row.difference) or abs(row.difference) < least:
        return None
    if row.star == STAR or explain_no_interval(row):
        return BETTER if row.difference * COMPARED[row.metric].better > 0 else WORSE
    return _ALONE if pd.isna(row.interval) else None


def _join_figures(figures: Mapping[str, Sequence[str]]) -> list[str]:
    """Each configuration with its first figure, and how many others it has."""
    more = {name: f" (+{len(of) - 1} figure{'s' * (len(of) > 2)})" if of[1:] else "" for name, of in figures.items()}
    return [f"{name} {of[0]}{more[name]}" for name, of in figures.items()]

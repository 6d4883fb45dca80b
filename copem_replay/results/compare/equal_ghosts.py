"""At which ghosts per minute times are compared, and where that says nothing, and why.

Ghosts are here those that were about no object at the instant they tell of either: a late list that was right then is
not cleaner for being left out. A side is *thinned* where it has more of them than is asked for.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.errors import InputError
from copem_replay.core.tracks import Float, Int
from copem_replay.results.compare.configuration_data import rows_of
from copem_replay.results.compare.labels import Named
from copem_replay.results.compare.pairing import lists, number, whole
from copem_replay.results.tables import AGAIN

if TYPE_CHECKING:
    import pyarrow as pa

FEWEST_GHOSTS = 10
"""Fewer entries than this decide nothing (chosen)."""
TRUTH = "the baseline is the truth, which has no ghosts"
ONE_VALUE = "all entries claim the same existence, so that none is left out before the others"
FEW = f"fewer than {FEWEST_GHOSTS} ghosts would decide"
_FILES = ("lists.parquet", "thresholds.parquet")


@dataclass(frozen=True)
class GhostTotals:
    """Ghosts of a configuration in all logs and runs, without stale ones; at which existence it detects anything."""

    minutes: float
    existence: Float  # (T,) ascending
    at: Int  # (T,) of at least each existence
    least: float  # inf: nothing
    most: float  # −inf: nothing

    @property
    def per_min(self) -> float | None:
        """At the lowest existence there is."""
        return float(self.at[0]) / self.minutes if len(self.existence) and self.minutes > 0 else None

    @property
    def tells_apart(self) -> bool:
        """Whether any threshold leaves out some of the entries but not all."""
        all_left = (self.at == self.at[:1]) & (self.least >= self.existence)
        none_left = (self.at == 0) & (self.most < self.existence)
        return not (all_left | none_left).all()


@dataclass(frozen=True)
class Kept:
    """Entries of at least `existence` are listed in a share of the drives, in the rest those of at least `above`."""

    existence: float
    above: float  # inf: nothing
    share: float
    false_positives_per_min: float


def ghost_totals(sides: Sequence[Named], logs: Sequence[str], runs: int) -> dict[Named, GhostTotals]:
    """Of the sides whose folders have what it takes. Raises InputError where their tables are damaged."""
    totals: dict[Named, GhostTotals] = {}
    for log in logs:
        for results in dict.fromkeys(one.results for one in sides if {*_FILES} <= set(one.results.by_log)):
            tables = results.rows_of(log, *_FILES)
            for one in (one for one in sides if one.results is results):
                rows, steps = rows_of(one, tables).values()
                totals[one] = _added(one, totals.get(one), rows, steps, runs)
    return totals


def _added(one: Named, before: GhostTotals | None, rows: pa.Table, steps: pa.Table, runs: int) -> GhostTotals:
    """The totals of the logs before and of one more, in the first `runs`."""
    of, existence = lists(rows["existence"])
    counts, at = lists(rows["ghosts_at"])
    known = existence[: of[0]] if len(of) else existence
    if before is not None and len(before.existence):
        known = before.existence if len(of) else known
    alike = (of == len(known)).all() and (counts == len(known)).all()
    size = len(of), len(known)
    if not alike or (existence.reshape(size) != known).any() or (np.diff(known) <= 0).any():
        raise InputError(
            f"{one.results.folder / _FILES[0]}: expected the same ascending existence and as many ghosts_at in all "
            f"rows, found others; {AGAIN}"
        )
    compared = whole(rows["run"], missing=runs) < runs
    minutes = float(number(rows["minutes"])[compared].sum())
    ghosts = at.reshape(size)[compared].sum(axis=0).astype(np.int64)
    steps_at = number(steps["existence"])[whole(steps["run"], missing=runs) < runs]
    least, most = float(steps_at.min(initial=np.inf)), float(steps_at.max(initial=-np.inf))
    if before is None or not len(before.existence):
        return GhostTotals(minutes, known, ghosts, least, most)
    ghosts = ghosts if len(of) else np.zeros_like(before.at)
    return GhostTotals(
        before.minutes + minutes,
        before.existence,
        before.at + ghosts,
        min(before.least, least),
        max(before.most, most),
    )


def kept_at(ghosts: GhostTotals, per_min: float) -> Kept | None:
    """What is listed with so many ghosts per minute, or with fewer where all have fewer; None: there is no minute."""
    if ghosts.per_min is None:
        return None
    rates = np.append(ghosts.at / ghosts.minutes, 0.0)
    limits = np.append(ghosts.existence, np.inf)
    k = int(np.argmax(rates <= per_min * (1 + 1e-9)))
    if k == 0 or rates[k] >= per_min * (1 - 1e-9):
        return Kept(float(limits[k]), float(limits[k]), 1.0, float(rates[k]))
    share = float((per_min - rates[k]) / (rates[k - 1] - rates[k]))
    return Kept(float(limits[k - 1]), float(limits[k]), share, per_min)


def kept_by(first: GhostTotals | None, second: GhostTotals | None, per_min: float | None) -> tuple[Kept, Kept] | None:
    """What is kept of both sides; None: times at equal ghosts are not known."""
    if first is None or second is None or per_min is None:
        return None
    kept = kept_at(first, per_min), kept_at(second, per_min)
    return None if kept[0] is None or kept[1] is None else (kept[0], kept[1])


def why_not(
    first: GhostTotals | None, second: GhostTotals | None, per_min: float | None, *, asked: bool, truth: bool
) -> str | None:
    """Why the times of two sides at so many ghosts per minute are no measure; None: they are, or there are none.

    `asked`: whether that rate was asked for, else it is the second side's own. `truth`: whether that one is the truth.
    """
    if per_min is None or first is None or second is None:
        return None
    if truth:
        return TRUTH
    if not asked and second.at[:1].sum() < FEWEST_GHOSTS:
        return FEW
    for side in (first, second):
        kept = kept_at(side, per_min)
        if side.per_min is None or kept is None or side.per_min <= per_min * (1 + 1e-9):
            continue
        if not side.tells_apart:
            return ONE_VALUE if side is first else f"of the baseline, {ONE_VALUE}"
        if kept.false_positives_per_min * side.minutes < FEWEST_GHOSTS * (1 - 1e-9):
            return FEW
    return None


def notes_on_equal_ghosts(reasons: Mapping[str, str | None]) -> Iterator[str]:
    """`reasons`: by label."""
    for reason in dict.fromkeys(reason for reason in reasons.values() if reason is not None):
        labels = ", ".join(label for label, why in reasons.items() if why == reason)
        yield f"{labels}: no ttd_rmst_s_equal_ghosts: {reason}"

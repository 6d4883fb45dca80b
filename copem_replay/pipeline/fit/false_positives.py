"""Ghosts: entries about no true object, chained from list to list. How many, how long they last, and where."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from copem_replay.core.tracks import CLASSES, Float, Int
from copem_replay.pipeline.fit.durations import garwood, lasting_time
from copem_replay.pipeline.fit.estimate import Estimate, Note, digits, plain
from copem_replay.pipeline.fit.rest_kernel import linked
from copem_replay.pipeline.fit.rows import FitLists, FitRows, OtherEntries

GATE_M = 3.0
"""An entry this near to one of the list before continues it, if no id says otherwise (chosen)."""
_NEAR_M = 5.0
"""Ghosts this near to an object's centre are held against chance (chosen)."""
_SURE = 1e-3
"""How improbable more of them must be in a Poisson field."""


@dataclass(frozen=True)
class GhostSort:
    """One sort: how many there are in a list (`beside`: of each object of its classes), how long each lasts, where."""

    in_list: Estimate
    lasts_s: Estimate
    where: dict[str, Any]
    classes: dict[str, float]

    def keys(self, note: Note = plain) -> dict[str, Any]:
        """One of a PEM's `ghosts`."""
        lasts_s = 0.0 if np.isnan(self.lasts_s.value) else digits(self.lasts_s.value)
        return {
            "in_list": note(digits(self.in_list.value), self.in_list.words()),
            "lasts_s": note(lasts_s, self.lasts_s.words()),
            "where": self.where,
            "classes": self.classes,
        }


@dataclass(frozen=True)
class GhostsFit:
    """The sorts of ghosts and how many are born in a minute; or why nothing can be told."""

    sorts: tuple[GhostSort, ...] = ()
    per_minute: Estimate | None = None
    untold: str | None = None


def fit_ghosts(rows: FitRows, lists: FitLists, other: OtherEntries) -> GhostsFit:
    """Fit the entries about no true object; the truth is complete."""
    L, E = len(lists.log), len(other.list)
    if L < 2:
        return GhostsFit(untold=f"{L} lists")
    step_s = np.diff(lists.captured_s)
    there = np.diff(lists.log) == 0
    watched_s, period_s = float(step_s[there].sum()), float(np.median(step_s[there]))
    if not E:
        most = garwood(0)[1]
        return GhostsFit(untold=f"no ghost in {L} lists (fewer than {60 * most / watched_s:.2g} per minute)")
    before, order = _chains(lists, other)
    some = _Some(other, order)
    ahead = np.zeros(E, dtype=bool)
    ahead[before[before >= 0]] = True
    at = other.list[order]
    next_there = np.append(there, False)[at]
    to_next_s = np.append(step_s, 0.0)[at]
    born = (before < 0) & (np.insert(there, 0, False)[at])
    lasts_s = lasting_time(to_next_s[ahead & next_there], to_next_s[~ahead & next_there], "ghost ends")
    n_born = int(born.sum())
    low, high = garwood(n_born)
    per_minute = Estimate(60 * n_born / watched_s, 60 * low / watched_s, 60 * high / watched_s, n_born, n_born)
    phi = 0.0 if np.isnan(lasts_s.value) else float(np.exp(-period_s / lasts_s.value))
    if phi < 0.05:
        lasts_s, phi = Estimate(0.0, 0.0, period_s / 3, E, n_born), 0.0
    first = np.flatnonzero(before < 0)
    return GhostsFit(_sorts(rows, L, some, first, lasts_s, phi), per_minute)


@dataclass(frozen=True)
class _Some:
    """The entries in the order of lists."""

    other: OtherEntries
    order: Int

    def __getattr__(self, name: str) -> Any:
        return getattr(self.other, name)[self.order]


def _chains(lists: FitLists, other: OtherEntries) -> tuple[Int, Int]:
    """(E,) which entry each continues, in the order of lists, which is given, too."""
    order = np.argsort(other.list, kind="stable")
    begin = np.searchsorted(other.list[order], np.arange(len(lists.log) + 1))
    follows = np.where(np.insert(np.diff(lists.log) == 0, 0, False), np.arange(len(lists.log)) - 1, -1)
    east_m, north_m, ids = other.east_m[order], other.north_m[order], other.track_id[order]
    before: Int = linked(follows, begin, east_m, north_m, ids, GATE_M)
    return before, order


def _sorts(rows: FitRows, L: int, some: _Some, first: Int, lasts_s: Estimate, phi: float) -> tuple[GhostSort, ...]:
    from scipy.stats import binom

    near = some.nearest_m[first] <= _NEAR_M
    field, area_m2 = _field(some, first)
    in_reach = len(rows.log) / L
    chance = min(in_reach * np.pi * _NEAR_M**2 / area_m2, 1.0)
    excess = 0.0
    if binom.sf(int(near.sum()) - 1, len(first), chance) < _SURE:
        excess = max((near.mean() - chance) / max(1 - chance, 1e-9), 0.0)
    worth = L * (1 - phi) / (1 + phi)

    def in_list(share: float, per: float) -> Estimate:
        mean = len(some.list) * share / L
        count = mean * worth
        low, high = garwood(count)
        return Estimate(mean / per, mean * low / max(count, 1e-9) / per, mean * high / max(count, 1e-9) / per,
                        round(len(some.list) * share), count)  # fmt: skip

    classes = _classes(some.class_ix[first])
    out = [GhostSort(in_list(1 - excess, 1.0), lasts_s, field, classes)] if excess < 0.95 else []
    if excess > 0:
        names, of_objects = _beside(rows, some, first[near])
        sides_m = np.median(np.concatenate([rows.view.length_m, rows.view.width_m])) / 2
        within_m = max(float(np.quantile(some.nearest_m[first[near]], 0.9)) - float(sides_m), 0.5)
        where = {"kind": "beside", "classes": names, "within_m": round(within_m, 1)}
        out.append(GhostSort(in_list(excess, of_objects / L), lasts_s, where, _classes(some.class_ix[first[near]])))
    return tuple(out)


def _field(some: _Some, first: Int) -> tuple[dict[str, Any], float]:
    """Where ghosts are born: an annulus, or a sector where a good part of the turn is empty; and its area."""
    range_m = some.range_m[first]
    n = len(first)
    far_m, near_m = float(range_m.max()) * (1 + 1 / (2 * n)), max(float(range_m.min()) * (1 - 1 / n), 0.0)
    azimuth = np.sort(np.mod(some.azimuth_rad[first], 2 * np.pi))
    gaps = np.diff(azimuth, append=azimuth[0] + 2 * np.pi)
    widest, usual = int(np.argmax(gaps)), 2 * np.pi / n
    where: dict[str, Any] = {"kind": "field", "range_m": [round(near_m, 1), round(far_m, 1)]}
    turn = 2 * np.pi
    if n >= 8 and gaps[widest] > max((np.log(n) + 7) * usual, np.pi / 6):
        aside = (turn - gaps[widest]) / n / 2
        start, turn = azimuth[(widest + 1) % n] - aside, turn - gaps[widest] + 2 * aside
        wrapped = [(np.rad2deg(angle) + 180) % 360 - 180 for angle in (start, start + turn)]
        where["azimuth_deg"] = [round(float(angle), 1) for angle in wrapped]
    return where, turn / 2 * (far_m**2 - near_m**2)


def _beside(rows: FitRows, some: _Some, near: Int) -> tuple[list[str], int]:
    """Classes of the objects that ghosts are beside, and how many rows are of these."""
    order = np.argsort(rows.list, kind="stable")
    found = []
    for e in near:
        low, high = np.searchsorted(rows.list[order], [some.list[e], some.list[e] + 1])
        if high > low:
            mine = order[low:high]
            apart = np.hypot(rows.state_m[mine, 0] - some.east_m[e], rows.state_m[mine, 1] - some.north_m[e])
            found.append(int(rows.view.class_ix[mine[np.argmin(apart)]]))
    count = np.bincount(np.array(found, dtype=np.int64), minlength=len(CLASSES))
    kinds = np.flatnonzero(count >= max(0.1 * count.sum(), 1))
    of_objects = int(np.isin(rows.view.class_ix, kinds).sum())
    return [CLASSES[k] for k in kinds] or ["car"], max(of_objects, 1)


def _classes(class_ix: Int) -> dict[str, float]:
    count = np.bincount(class_ix[class_ix >= 0], minlength=len(CLASSES)).astype(float)
    if not count.sum():
        return {"pedestrian": 1.0}
    shares: Float = np.round(count / count.sum(), 4)
    shares[int(np.argmax(shares))] += 1 - shares.sum()
    return {CLASSES[k]: round(float(shares[k]), 4) for k in np.flatnonzero(count)}

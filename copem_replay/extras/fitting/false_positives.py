"""Ghosts: entries about no true object, chained from list to list. How many, how long they last, and where."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2

from copem_replay.core.compiled import kernel
from copem_replay.core.tracks import CLASSES, Bool, Float, Int
from copem_replay.core.yaml import CommentedValue
from copem_replay.extras.fitting.estimate import Estimate
from copem_replay.extras.fitting.rows import FitLists, FitRows, OtherEntries

# Kernels: a filter over classes that last, and chains of entries from list to list.


@kernel
def log_classes(shares: Float, listed: Int, decay: Float, new: Bool, share: float) -> float:
    """Logarithm of the probability of listed classes (n,), by probabilities (n, C) that are the same within a series.
    With probability `share` a list uses the held uniform; the filter has the probability that it lies in each cell.
    """
    n, C = shares.shape
    cells, total = np.zeros(C), 0.0
    for t in range(n):
        f = 0.0 if new[t] else decay[t]
        class_ix = listed[t]
        p_new = (1.0 - share) * shares[t, class_ix]
        for k in range(C):
            cells[k] = f * cells[k] + (1.0 - f) * shares[t, k]
        probability = p_new + share * cells[class_ix]
        for k in range(C):
            cells[k] *= (p_new + share if k == class_ix else p_new) / probability
        total += np.log(probability)
    return total


@kernel
def link_entries(follows: Int, begin: Int, x_m: Float, y_m: Float, ids: Int, gate_m: float) -> Int:
    """(E,) the entry of the list before that each continues, −1: none. First by id, then the nearest within a gate.
    Entries lie list by list, those of list k from `begin[k]` on. `follows (L,)`: the list before each, −1: none.
    """
    out = np.full(len(x_m), -1)
    is_taken = np.zeros(len(x_m), dtype=np.bool_)
    for k in range(len(follows)):
        if follows[k] < 0:
            continue
        a, b = begin[follows[k]], begin[follows[k] + 1]
        for e in range(begin[k], begin[k + 1]):
            for p in range(a, b):
                if ids[e] >= 0 and ids[e] == ids[p] and not is_taken[p]:
                    out[e], is_taken[p] = p, True
                    break
        while True:
            best, entry, previous = gate_m * gate_m, -1, -1
            for e in range(begin[k], begin[k + 1]):
                if out[e] < 0:
                    for p in range(a, b):
                        far = (x_m[e] - x_m[p]) ** 2 + (y_m[e] - y_m[p]) ** 2
                        if not is_taken[p] and far < best:
                            best, entry, previous = far, e, p
            if entry < 0:
                break
            out[entry], is_taken[previous] = previous, True
    return out


# Durations of what is seen at lists alone: still there at the next one with probability e^(−Δ/τ).


def garwood_interval(count: float) -> tuple[float, float]:
    """The 95 % interval of a Poisson mean, of which `count` were seen; also of an effective count. Source: F. Garwood,
    "Fiducial limits for the Poisson distribution", Biometrika 28 (1936) 437–442.
    """
    return (float(chi2.ppf(0.025, 2 * count) / 2) if count else 0.0), float(chi2.ppf(0.975, 2 * count + 2) / 2)


def estimate_duration(stayed_s: Float, ended_s: Float, event: str) -> Estimate:
    """The mean duration τ (s) by maximum likelihood, of gaps over which it stayed and gaps in which it ended. The
    interval is that of the number of ends. Without an end only a lower limit can be told.
    """
    from scipy.optimize import brentq

    n, ends, total_s = len(stayed_s) + len(ended_s), len(ended_s), float(stayed_s.sum() + ended_s.sum())
    low, high = garwood_interval(ends)
    if not ends or not len(stayed_s):
        why = f"no {event} in {total_s:.3g} s" if not ends else f"{event} at every list"
        return Estimate(float("nan"), total_s / high if not ends else 0.0, float("inf"), n, ends, why)

    def slope(log_tau: float) -> float:
        x = ended_s / np.exp(log_tau)
        return float(stayed_s.sum() - (ended_s * np.exp(-x) / -np.expm1(-x)).sum())

    around = np.log(total_s / ends)
    tau_s = float(np.exp(brentq(slope, around - 12, around + 3)))
    return Estimate(tau_s, tau_s * ends / high, tau_s * ends / low if low > 0 else float("inf"), n, ends)


# Fits of ghosts.

GATE_M = 3.0
"""Distance within which an entry continues one of the list before, unless ids differ: some standard deviations of an
entry's position; faster ghosts are taken for new ones."""
_NEAR_M = 5.0
"""Distance from an object's centre within which ghosts count as near it: half a long vehicle."""
_SURE = 1e-3
"""Probability of so many ghosts near objects in a Poisson field, below which they are no chance."""


@dataclass(frozen=True)
class GhostSort:
    """One sort: the mean number in a list (`beside`: per object of its classes), how long each lasts, and where."""

    in_list: Estimate
    lasts_s: Estimate
    where: dict[str, Any]
    classes: dict[str, float]

    def keys(self) -> dict[str, Any]:
        """The sort as an item of a PEM's `ghosts`."""
        lasts_s = self.lasts_s
        return {
            "in_list": self.in_list.written(),
            "lasts_s": CommentedValue(0.0, lasts_s.words()) if np.isnan(lasts_s.value) else lasts_s.written(),
            "where": self.where,
            "classes": self.classes,
        }


@dataclass(frozen=True)
class GhostsFit:
    """The sorts of ghosts and how many begin in a minute; or why the data do not tell."""

    sorts: tuple[GhostSort, ...] = ()
    per_minute: Estimate | None = None
    untold: str | None = None


def fit_ghosts(rows: FitRows, lists: FitLists, other: OtherEntries) -> GhostsFit:
    """Fit the entries about no true object, where the truth is complete."""
    L, E = len(lists.log), len(other.list)
    if L < 2:
        return GhostsFit(untold=f"{L} lists")
    step_s = np.diff(lists.captured_s)
    same_log = np.diff(lists.log) == 0
    watched_s, period_s = float(step_s[same_log].sum()), float(np.median(step_s[same_log]))
    if not E:
        most = garwood_interval(0)[1]
        return GhostsFit(untold=f"no ghost in {L} lists (fewer than {60 * most / watched_s:.2g} per minute)")
    begin = np.searchsorted(other.list, np.arange(L + 1))
    follows = np.where(np.insert(same_log, 0, False), np.arange(L) - 1, -1)
    before: Int = link_entries(follows, begin, other.east_m, other.north_m, other.track_id, GATE_M)
    ahead = np.zeros(E, dtype=bool)
    ahead[before[before >= 0]] = True
    has_next = np.append(same_log, False)[other.list]
    to_next_s = np.append(step_s, 0.0)[other.list]
    born = (before < 0) & (np.insert(same_log, 0, False)[other.list])
    lasts_s = estimate_duration(to_next_s[ahead & has_next], to_next_s[~ahead & has_next], "ghost ends")
    n_born = int(born.sum())
    low, high = garwood_interval(n_born)
    per_minute = Estimate(60 * n_born / watched_s, 60 * low / watched_s, 60 * high / watched_s, n_born, n_born)
    phi = 0.0 if np.isnan(lasts_s.value) else float(np.exp(-period_s / lasts_s.value))
    if phi < 0.05:
        lasts_s, phi = Estimate(0.0, 0.0, period_s / 3, E, n_born), 0.0
    first = np.flatnonzero(before < 0)
    return GhostsFit(_fit_sorts(rows, L, other, first, lasts_s, phi), per_minute)


def _fit_sorts(
    rows: FitRows, L: int, entries: OtherEntries, first: Int, lasts_s: Estimate, phi: float
) -> tuple[GhostSort, ...]:
    """The sorts of ghosts: in a field, and `beside` objects if more are near them than by chance. `L`: lists; `first`:
    rows where ghosts begin; `phi`: correlation of their number from list to list.
    """
    from scipy.stats import binom

    is_near = entries.nearest_m[first] <= _NEAR_M
    field, area_m2 = _fit_field(entries, first)
    in_reach = len(rows.log) / L
    chance = min(in_reach * np.pi * _NEAR_M**2 / area_m2, 1.0)
    excess = 0.0
    if binom.sf(int(is_near.sum()) - 1, len(first), chance) < _SURE:
        excess = max((is_near.mean() - chance) / max(1 - chance, 1e-9), 0.0)
    effective_lists = L * (1 - phi) / (1 + phi)

    def in_list(share: float, per: float) -> Estimate:
        mean = len(entries.list) * share / L
        count = mean * effective_lists
        low, high = garwood_interval(count)
        return Estimate(mean / per, mean * low / max(count, 1e-9) / per, mean * high / max(count, 1e-9) / per,
                        round(len(entries.list) * share), count)  # fmt: skip

    classes = _count_classes(entries.class_ix[first])
    out = [GhostSort(in_list(1 - excess, 1.0), lasts_s, field, classes)] if excess < 0.95 else []
    if excess > 0:
        count = np.bincount(entries.nearest_class_ix[first[is_near]], minlength=len(CLASSES))
        near_classes = np.flatnonzero(count >= max(0.1 * count.sum(), 1))
        of_objects = max(int(np.isin(rows.view.class_ix, near_classes).sum()), 1)
        sides_m = np.median(np.concatenate([rows.view.length_m, rows.view.width_m])) / 2
        within_m = max(float(np.quantile(entries.nearest_m[first[is_near]], 0.9)) - float(sides_m), 0.5)
        where = {"kind": "beside", "classes": [CLASSES[k] for k in near_classes], "within_m": round(within_m, 1)}
        out.append(
            GhostSort(in_list(excess, of_objects / L), lasts_s, where, _count_classes(entries.class_ix[first[is_near]]))
        )
    return tuple(out)


def _fit_field(entries: OtherEntries, first: Int) -> tuple[dict[str, Any], float]:
    """Where ghosts begin, an annulus or a sector of it, as keys of the experiment file, and its area (m²)."""
    range_m = entries.range_m[first]
    n = len(first)
    far_m, near_m = float(range_m.max()) * (1 + 1 / (2 * n)), max(float(range_m.min()) * (1 - 1 / n), 0.0)
    azimuth = np.sort(np.mod(entries.azimuth_rad[first], 2 * np.pi))
    gaps = np.diff(azimuth, append=azimuth[0] + 2 * np.pi)
    widest_gap, usual_gap = int(np.argmax(gaps)), 2 * np.pi / n
    where: dict[str, Any] = {"kind": "field", "range_m": [round(near_m, 1), round(far_m, 1)]}
    angle_rad = 2 * np.pi
    if n >= 8 and gaps[widest_gap] > max((np.log(n) + 7) * usual_gap, np.pi / 6):
        margin_rad = (angle_rad - gaps[widest_gap]) / n / 2
        start, angle_rad = azimuth[(widest_gap + 1) % n] - margin_rad, angle_rad - gaps[widest_gap] + 2 * margin_rad
        wrapped = [(np.rad2deg(angle) + 180) % 360 - 180 for angle in (start, start + angle_rad)]
        where["azimuth_deg"] = [round(float(angle), 1) for angle in wrapped]
    return where, angle_rad / 2 * (far_m**2 - near_m**2)


def _count_classes(class_ix: Int) -> dict[str, float]:
    """The share of each listed class; pedestrian where no class is listed."""
    count = np.bincount(class_ix[class_ix >= 0], minlength=len(CLASSES)).astype(float)
    if not count.sum():
        return {"pedestrian": 1.0}
    shares: Float = np.round(count / count.sum(), 4)
    shares[int(np.argmax(shares))] += 1 - shares.sum()
    return {CLASSES[k]: round(float(shares[k]), 4) for k in np.flatnonzero(count)}

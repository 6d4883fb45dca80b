"""The replay check: whether a fitted model, replayed at the recorded lists, behaves like the recording.

Each pass is ranked among runs of the model (PIT, ties broken at random: a pass in which the object is never listed is
as late as the runs that never list it). Where the model is right, ranks are uniform. Over passes: Fisher's sum of
−2 ln p, its distribution that of the runs themselves, each ranked among all others. Beside it totals of all passes, for
what no pass tells by itself: how far they are from the mean, in standard deviations, among the runs.

Sources: A. P. Dawid, J. Roy. Statist. Soc. A 147 (1984) 278–292 (PIT); J. Besag, P. Clifford, Biometrika 76 (1989)
633–642 (Monte-Carlo p). A high p does not show that a model is right: only that these passes do not contradict it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Literal

import numpy as np

from copem_replay.core.compiled import kernel
from copem_replay.core.lasting import ListStamps, drop_unshared
from copem_replay.core.memory import Parts, UnitDraws
from copem_replay.core.random import CounterRng, RandomKey, object_words
from copem_replay.core.tracks import CLASSES, Bool, Float, Int
from copem_replay.extras.fitting.detection import pass_starts
from copem_replay.extras.fitting.rows import FitLists, FitRows
from copem_replay.perception.config import PoseError
from copem_replay.perception.pem.condition import find_couples, noise_quantity
from copem_replay.perception.pem.detection import ask_detection_probability
from copem_replay.perception.pem.error import ask_errors
from copem_replay.perception.pem.model import Pem

RUNS = 500
"""Runs of the model: p is known to about 0.01 at 0.05."""
FEWEST_PASSES = 8
"""Passes below which there is no verdict: the sum over so few passes hardly tells any model from another."""
STATISTICS = ("first listed, s", "longest run of misses", "share listed", "RMSE, m", "lag-1 correlation", "gap, s")
_CELLS = 4_000_000
"""Rows × runs that are simulated at once: 100 MB."""

Verdict = Literal["holds", "too sure", "too few passes to tell"]
Statistics = dict[str, Float]
"""By name (S, passes); NaN where a pass has none, ∞ for the first list of an object that is never listed."""


@dataclass(frozen=True)
class StatisticCheck:
    """The check of one statistic: `pit (passes,)` of passes that have it, those `inside` 95 %, Monte-Carlo `p`.

    `among`: how many checks share its level.
    """

    statistic: str
    pit: Float
    inside: int
    p: float
    verdict: Verdict
    among: int = 1


def replay_check(
    pem: Pem, rows: FitRows, lists: FitLists, *, placed: PoseError | None = None, runs: int = RUNS, seed: int = 0
) -> tuple[StatisticCheck, ...]:
    """Rank the recording among runs of the model at the same rows, which it should not have been fitted to.

    All passes, and where they are of several classes those of each with FEWEST_PASSES.

    `placed`: the error of the unit's pose, drawn beside the model's errors.
    """
    recorded = compute_statistics(rows.listed[None], rows.along_m[None], rows.across_m[None], rows)
    statistics, totals = [], list[Float]()
    step = max(1, _CELLS // len(rows.listed))  # runs at a time
    for first in range(0, runs, step):
        some = np.arange(first, min(first + step, runs))
        listed, along_m, across_m = simulate_lists(pem, rows, lists, some, seed, placed)
        if not totals:
            expected = listed.mean(axis=0)
            totals.append(compute_totals(rows.listed[None], rows, expected))
        statistics.append(compute_statistics(listed, along_m, across_m, rows))
        totals.append(compute_totals(listed, rows, expected))
    replayed = {name: np.concatenate([one[name] for one in statistics]) for name in STATISTICS}
    class_of_pass = rows.view.class_ix[pass_starts(rows.pass_ix)[:-1]]
    checks = compare_statistics(recorded, replayed, seed=seed)
    checks += compare_totals(np.concatenate(totals), len(class_of_pass))
    checks = tuple(replace(one, among=len(checks)) for one in checks)
    classes, count = np.unique(class_of_pass, return_counts=True)
    kinds = classes[count >= FEWEST_PASSES].tolist()
    for kind in kinds if len(classes) > 1 else []:
        both = ({name: of[:, class_of_pass == kind] for name, of in one.items()} for one in (recorded, replayed))
        of_class = compare_statistics(*both, seed=seed)
        among = len(of_class) * len(kinds)
        checks += tuple(replace(one, statistic=f"{one.statistic}, {CLASSES[kind]}", among=among) for one in of_class)
    return checks


def remove_memory(pem: Pem) -> Pem:
    """The model with all draws new in every list."""
    couples = tuple(couple.model_copy(update={"memory": None}) for couple in pem.couples)
    return pem.model_copy(update={"couples": couples, "memory": {}})


def simulate_lists(
    pem: Pem, rows: FitRows, lists: FitLists, runs: Int, seed: int, placed: PoseError | None = None
) -> tuple[Bool, Float, Float]:
    """What the model lists in the runs (S,): `listed`, `along_m`, `across_m` (S, R), NaN where it has no errors.

    Drawn as a replay does, at the captures of the recorded lists.
    """
    listed = np.zeros((len(runs), len(rows.listed)), dtype=np.bool_)
    along_m, across_m = np.full((2, *listed.shape), np.nan)
    couple_ix = find_couples(pem.couples, rows.view)
    for rows_of_log, draws in _split_draws(rows, lists, runs, seed):
        for c, couple in enumerate(pem.couples):
            applies = np.flatnonzero(couple_ix[rows_of_log] == c)
            if not len(applies):
                continue
            of_couple, drawn, memory = rows_of_log[applies], draws.take(applies), pem.memory_of(c)
            view = rows.view.take(of_couple)
            p = ask_detection_probability(couple.detection, view, f"couples[{c}].detection")
            valid = drawn.uniform("detection", memory.get("detection", ())) < p
            listed[:, of_couple] = valid
            if couple.error is None:
                continue
            noise = partial(_draw_noise, drawn, memory, valid)
            errors = ask_errors(couple.error, view, noise, len(runs), f"couples[{c}].error")
            cos, sin = np.cos(view.bearing_rad), np.sin(view.bearing_rad)
            along_m[:, of_couple] = errors.east_m * cos + errors.north_m * sin
            across_m[:, of_couple] = errors.north_m * cos - errors.east_m * sin
        if placed is not None:
            east_m, north_m, turn_rad = _draw_pose(draws, placed)
            cos, sin = np.cos(rows.view.bearing_rad[rows_of_log]), np.sin(rows.view.bearing_rad[rows_of_log])
            along_m[:, rows_of_log] += east_m * cos + north_m * sin
            across_m[:, rows_of_log] += north_m * cos - east_m * sin + turn_rad * rows.view.range_m[rows_of_log]
    if rows.apart is not None:
        along_m[:, ~rows.apart] = across_m[:, ~rows.apart] = np.nan
    return listed, along_m, across_m


def _split_draws(rows: FitRows, lists: FitLists, runs: Int, seed: int) -> Iterator[tuple[Int, UnitDraws]]:
    """Log by log, the indices of its rows and the random draws for them."""
    bounds = np.searchsorted(lists.log, np.arange(int(lists.log.max()) + 2))
    for log, (first, after) in enumerate(pairwise(bounds.tolist())):
        rows_of_log = np.flatnonzero(rows.log == log)
        stamp_ns = np.rint(lists.captured_s[first:after] * 1e9).astype(np.int64)
        frame_ix = rows.list[rows_of_log] - first
        words = object_words([str(k) for k in range(int(rows.object[rows_of_log].max(initial=0)) + 1)])[
            rows.object[rows_of_log]
        ]
        unit_ix, unit_of_row = np.zeros(after - first, dtype=np.int64), np.zeros(len(rows_of_log), dtype=np.int64)
        key = RandomKey(("unit",), unit_of_row, words, stamp_ns[frame_ix])
        yield rows_of_log, UnitDraws(CounterRng(seed, f"log {log}"), key, ListStamps(stamp_ns, unit_ix, frame_ix), runs)


def _draw_pose(draws: UnitDraws, placed: PoseError) -> tuple[Float, Float, Float]:
    """East, north (m) and turn (rad) of the pose error, (S, K) each: one draw for all rows of a list."""
    frames, of_row = np.unique(draws.lists.frame_ix, return_inverse=True)
    stamp_ns = draws.lists.stamp_ns[frames]
    zeros = np.zeros(len(frames), dtype=np.int64)
    key = drop_unshared(RandomKey(("unit",), zeros, zeros.astype(np.uint64), stamp_ns), "unit")
    times = ListStamps(draws.lists.stamp_ns, draws.lists.unit_ix, frames)
    list_draws = UnitDraws(draws.rng, key, times, draws.runs)
    east, north, turn = (
        list_draws.normal(f"placed {what}", placed.parts)[:, of_row] for what in ("east", "north", "yaw")
    )
    return placed.position_sigma_m * east, placed.position_sigma_m * north, np.deg2rad(placed.yaw_sigma_deg) * turn


def _draw_noise(draws: UnitDraws, memory: Mapping[str, Parts], valid: Bool, name: str) -> Float:
    return draws.normal(f"error {name}", memory.get(noise_quantity(name), ()), valid)


def compute_statistics(listed: Bool, along_m: Float, across_m: Float, rows: FitRows) -> Statistics:
    """By name (S, passes) of what is listed (S, R) with which errors; recorded (S = 1) or replayed.

    Times from the first list of a pass on; a run of misses counts lists; a gap lies between two lists that have the
    object. RMSE in the plane; the correlation is that of errors less their mean over the pass, in consecutive lists.
    """
    start = pass_starts(rows.pass_ix)
    out = np.empty((len(STATISTICS), len(listed), len(start) - 1))
    _fill_statistics(listed, along_m, across_m, rows.captured_s, start, out)
    return dict(zip(STATISTICS, out, strict=True))


@kernel
def _fill_statistics(listed: Bool, along: Float, across: Float, at_s: Float, start: Int, out: Float) -> None:
    """Fills `out (6, S, passes)`: first hit (s), most misses in a row, share, RMSE (m), correlation, mean gap (s)."""
    for s in range(listed.shape[0]):
        for k in range(len(start) - 1):
            a, b = start[k], start[k + 1]
            first, last = np.inf, -1
            miss_run = longest = hits = n_errors = gaps = pairs = 0
            gap_s = squares = east = north = product = 0.0
            for i in range(a, b):
                if not listed[s, i]:
                    miss_run += 1
                    longest = max(longest, miss_run)
                    continue
                if hits == 0:
                    first = at_s[i] - at_s[a]
                elif miss_run > 0:
                    gaps += 1
                    gap_s += at_s[i] - at_s[last]
                miss_run, last, hits = 0, i, hits + 1
                if np.isfinite(along[s, i]):  # entries beside another object have no error
                    n_errors += 1
                    squares += along[s, i] ** 2 + across[s, i] ** 2
                    east += along[s, i]
                    north += across[s, i]
            spread = np.nan
            if n_errors > 0:
                east, north = east / n_errors, north / n_errors
                spread = squares / n_errors - east**2 - north**2
            for i in range(a + 1, b):
                if np.isfinite(along[s, i]) and np.isfinite(along[s, i - 1]) and listed[s, i] and listed[s, i - 1]:
                    pairs += 1
                    product += (along[s, i] - east) * (along[s, i - 1] - east)
                    product += (across[s, i] - north) * (across[s, i - 1] - north)
            out[0, s, k] = first
            out[1, s, k] = longest
            out[2, s, k] = hits / (b - a)
            out[3, s, k] = np.sqrt(squares / n_errors) if n_errors else np.nan
            out[4, s, k] = product / pairs / spread if pairs > 2 and spread > 1e-12 else np.nan
            out[5, s, k] = gap_s / gaps if gaps else np.nan


def compare_statistics(recorded: Statistics, runs: Statistics, *, seed: int = 0) -> tuple[StatisticCheck, ...]:
    """The check of each statistic: the recording (1, passes) among runs (S, passes).

    Left out: passes that lack the statistic in the recording, or have it in fewer than 20 runs; statistics that no pass
    has.
    """
    checks = []
    for name in STATISTICS:
        usable = ~np.isnan(recorded[name][0]) & ((~np.isnan(runs[name])).sum(axis=0) >= 20)
        if not usable.any():
            continue
        values = np.concatenate([recorded[name], runs[name]])[:, usable]
        pit = _rank_values(values, name, np.flatnonzero(usable), seed)
        # Where a run lacks the statistic: the mean of −2 ln p.
        surprise = np.where(np.isnan(pit), 2.0, -2 * np.log(2 * np.minimum(pit, 1 - pit))).sum(axis=1)
        p = float((surprise >= surprise[0]).mean())
        recorded_pit = pit[0]
        inside = int(((recorded_pit >= 0.025) & (recorded_pit <= 0.975)).sum())
        checks.append(StatisticCheck(name, recorded_pit, inside, p, _judge_check(p, len(recorded_pit))))
    return tuple(checks)


def _judge_check(p: float, passes: int) -> Verdict:
    return "too few passes to tell" if passes < FEWEST_PASSES else "holds" if p >= 0.05 else "too sure"


# Totals: what no pass tells by itself.

TOTALS = ("misses at once", "share listed by azimuth")
_SECTORS = 4


def compute_totals(listed: Bool, rows: FitRows, expected: Float) -> Float:
    """(S, 1 + sectors) over all passes, of what is listed (S, R), of which the model expects `expected (R,)`.

    Σ d·d' over pairs of objects in a list, d = listed − expected, NaN where no list has two; and the share listed in
    each quarter of the rows by azimuth.
    """
    edges = np.quantile(rows.view.azimuth_rad, np.arange(1, _SECTORS) / _SECTORS)
    sector = np.searchsorted(edges, rows.view.azimuth_rad, side="right")
    size = np.bincount(sector, minlength=_SECTORS)
    shared = bool((np.bincount(rows.list) > 1).any())
    out = np.full((len(listed), 1 + _SECTORS), np.nan)
    for s, hits in enumerate(listed):
        out[s, 1:] = np.bincount(sector[hits], minlength=_SECTORS) / np.maximum(size, 1)
        if shared:
            d = hits - expected
            out[s, 0] = (np.bincount(rows.list, d) ** 2 - np.bincount(rows.list, d * d)).sum() / 2
    return out


def compare_totals(totals: Float, passes: int) -> tuple[StatisticCheck, ...]:
    """The check of totals (1 + S, 1 + sectors) of the recording, first, among those of runs."""
    checks = []
    for name, columns in zip(TOTALS, (totals[:, :1], totals[:, 1:]), strict=True):
        spread = columns.std(axis=0)
        if not np.isfinite(spread).all() or not (spread > 1e-12).any():
            continue
        moved = columns[:, spread > 1e-12]
        far = (((moved - moved.mean(axis=0)) / moved.std(axis=0)) ** 2).sum(axis=1)
        p = float((far >= far[0] - 1e-12).mean())
        checks.append(StatisticCheck(name, np.array([1 - p]), int(p > 0.05), p, _judge_check(p, passes)))
    return tuple(checks)


def _rank_values(values: Float, name: str, passes: Int, seed: int) -> Float:
    """(S + 1, passes) the rank of each value in its pass, 0 … 1, at random among equal ones; NaN: no value."""
    zero = np.zeros(len(passes), dtype=np.int64)
    key = RandomKey(("",), zero, object_words([str(k) for k in passes.tolist()]), zero)
    chance = CounterRng(seed, "replay check").uniform(name, key, np.arange(len(values)))
    out = np.full(values.shape, np.nan)
    for k in range(values.shape[1]):
        finite = ~np.isnan(values[:, k])
        column = values[finite, k]
        ranked = np.sort(column)
        below, up_to = np.searchsorted(ranked, column, side="left"), np.searchsorted(ranked, column, side="right")
        out[finite, k] = (below + chance[finite, k] * (up_to - below)) / len(column)
    return out

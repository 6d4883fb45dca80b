"""Whether a fitted model, replayed at the very lists that were recorded, does what the recording does.

For each pass the rank of what was recorded among runs of the model (PIT, ties broken by chance: a pass in which the
object is never listed is as late as the runs that never list it). Where the model is right ranks are uniform. Over
passes: Fisher's sum of −2 ln p, its distribution that of the runs themselves, each held against all others.

Sources: A. P. Dawid, J. Roy. Statist. Soc. A 147 (1984) 278–292 (PIT); J. Besag, P. Clifford, Biometrika 76 (1989)
633–642 (Monte-Carlo p). A high p does not say that a model is right: only that these passes do not tell otherwise.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Literal

import numba as nb
import numpy as np

from copem_replay.core.draws import Draws
from copem_replay.core.lasting import ListTimes, shared
from copem_replay.core.memory import Parts
from copem_replay.core.random import CounterRng, RandomKey, object_words
from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.perception.pem.condition import applies
from copem_replay.perception.pem.detection import probability_of
from copem_replay.perception.pem.error import errors_of
from copem_replay.perception.pem.memory import quantity_of
from copem_replay.perception.pem.model import Pem
from copem_replay.perception.unit_errors import PoseError
from copem_replay.pipeline.fit.memory import pass_starts
from copem_replay.pipeline.fit.rows import FitLists, FitRows

RUNS = 500
FEWEST_PASSES = 8
"""Of fewer nothing is said (chosen)."""
STATISTICS = ("first listed, s", "longest run of misses", "share listed", "RMSE, m", "lag-1 correlation", "gap, s")
_CELLS = 4_000_000
"""Rows × runs at a time (chosen: 100 MB)."""

Statistics = dict[str, Float]
"""By name (S, passes); NaN where a pass has none, ∞ for the first list of an object that is never listed."""


@dataclass(frozen=True)
class Check:
    """Of one statistic: `pit (passes,)` of those that have it, how many are `inside` 95 %, Monte-Carlo `p`."""

    statistic: str
    pit: Float
    inside: int
    p: float
    verdict: Literal["holds", "too sure", "too few passes to tell"]


def replay_check(
    pem: Pem, rows: FitRows, lists: FitLists, *, placed: PoseError | None = None, runs: int = RUNS, seed: int = 0
) -> tuple[Check, ...]:
    """What was recorded at rows that the model was not fitted to, among runs of it (`placed`: of its unit's pose, too)
    at the same rows.
    """
    recorded = statistics(rows.listed[None], rows.along_m[None], rows.across_m[None], rows)
    return compared(recorded, replayed(pem, rows, lists, placed=placed, runs=runs, seed=seed), seed=seed)


def without_memory(pem: Pem) -> Pem:
    """The same with all draws new in every list."""
    couples = tuple(couple.model_copy(update={"memory": None}) for couple in pem.couples)
    return pem.model_copy(update={"couples": couples, "memory": {}})


def replayed(
    pem: Pem, rows: FitRows, lists: FitLists, *, placed: PoseError | None = None, runs: int = RUNS, seed: int = 0
) -> Statistics:
    """The statistics (S, passes) of runs of the model."""
    step = max(1, _CELLS // len(rows.listed))
    some = [np.arange(first, min(first + step, runs)) for first in range(0, runs, step)]
    each = [statistics(*simulated(pem, rows, lists, block, seed, placed), rows) for block in some]
    return {name: np.concatenate([one[name] for one in each]) for name in STATISTICS}


def simulated(
    pem: Pem, rows: FitRows, lists: FitLists, runs: Int, seed: int, placed: PoseError | None = None
) -> tuple[Bool, Float, Float]:
    """What the model lists in the runs (S,): `listed`, `along_m`, `across_m` (S, R), NaN where it has no errors.

    Drawn as a replay does, at the captures of the recorded lists.
    """
    listed = np.zeros((len(runs), len(rows.listed)), dtype=np.bool_)
    along_m, across_m = np.full((2, *listed.shape), np.nan)
    couple_ix = applies(pem.couples, rows.view)
    for mine, draws in _draws(rows, lists, runs, seed):
        for c, couple in enumerate(pem.couples):
            here = np.flatnonzero(couple_ix[mine] == c)
            if not len(here):
                continue
            some, drawn, memory = mine[here], draws.take(here), pem.memory_of(c)
            view = rows.view.take(some)
            p = probability_of(couple.detection, view, f"couples[{c}].detection")
            valid = drawn.uniform("detection", memory.get("detection", ())) < p
            listed[:, some] = valid
            if couple.error is None:
                continue
            noise = partial(_noise, drawn, memory, valid)
            errors = errors_of(couple.error, view, noise, len(runs), f"couples[{c}].error")
            cos, sin = np.cos(view.bearing_rad), np.sin(view.bearing_rad)
            along_m[:, some] = errors.east_m * cos + errors.north_m * sin
            across_m[:, some] = errors.north_m * cos - errors.east_m * sin
        if placed is not None:
            east_m, north_m, turn_rad = _pose(draws, placed)
            cos, sin = np.cos(rows.view.bearing_rad[mine]), np.sin(rows.view.bearing_rad[mine])
            along_m[:, mine] += east_m * cos + north_m * sin
            across_m[:, mine] += north_m * cos - east_m * sin + turn_rad * rows.view.range_m[mine]
    if rows.apart is not None:
        along_m[:, ~rows.apart] = across_m[:, ~rows.apart] = np.nan
    return listed, along_m, across_m


def _draws(rows: FitRows, lists: FitLists, runs: Int, seed: int) -> Iterator[tuple[Int, Draws]]:
    """Of each log its rows and their numbers."""
    bounds = np.searchsorted(lists.log, np.arange(int(lists.log.max()) + 2))
    for log, (first, after) in enumerate(pairwise(bounds.tolist())):
        mine = np.flatnonzero(rows.log == log)
        stamp_ns = np.rint(lists.captured_s[first:after] * 1e9).astype(np.int64)
        frame_ix = rows.list[mine] - first
        words = object_words([str(k) for k in range(int(rows.object[mine].max(initial=0)) + 1)])[rows.object[mine]]
        one, many = np.zeros(after - first, dtype=np.int64), np.zeros(len(mine), dtype=np.int64)
        key = RandomKey(("unit",), many, words, stamp_ns[frame_ix])
        yield mine, Draws(CounterRng(seed, f"log {log}"), key, ListTimes(stamp_ns, one, frame_ix), runs)


def _pose(draws: Draws, placed: PoseError) -> tuple[Float, Float, Float]:
    """(S, K) each, east, north (m) and turn (rad): the same for all rows of a list, as a replay draws it."""
    frames, of_row = np.unique(draws.lists.frame_ix, return_inverse=True)
    stamp_ns = draws.lists.stamp_ns[frames]
    none = np.zeros(len(frames), dtype=np.int64)
    key = shared(RandomKey(("unit",), none, none.astype(np.uint64), stamp_ns), "unit")
    times = ListTimes(draws.lists.stamp_ns, draws.lists.unit_ix, frames)
    mine = Draws(draws.rng, key, times, draws.runs)
    east, north, turn = (mine.normal(f"placed {what}", placed.parts)[:, of_row] for what in ("east", "north", "yaw"))
    return placed.position_sigma_m * east, placed.position_sigma_m * north, np.deg2rad(placed.yaw_sigma_deg) * turn


def _noise(draws: Draws, memory: Mapping[str, Parts], valid: Bool, name: str) -> Float:
    return draws.normal(f"error {name}", memory.get(quantity_of(name), ()), valid)


def statistics(listed: Bool, along_m: Float, across_m: Float, rows: FitRows) -> Statistics:
    """By name (S, passes) of what is listed (S, R) with which errors; recorded (S = 1) or replayed.

    Times from the first list of a pass on; a run of misses counts lists; a gap lies between two lists that have the
    object. RMSE in the plane; the correlation is that of errors less their mean over the pass, in consecutive lists.
    """
    start = pass_starts(rows.pass_ix)
    out = np.empty((len(STATISTICS), len(listed), len(start) - 1))
    _statistics(listed, along_m, across_m, rows.captured_s, start, out)
    return dict(zip(STATISTICS, out, strict=True))


@nb.njit(cache=True, nogil=True)
def _statistics(listed: Bool, along: Float, across: Float, at: Float, start: Int, out: Float) -> None:
    for s in range(listed.shape[0]):
        for k in range(len(start) - 1):
            a, b = start[k], start[k + 1]
            first, last = np.inf, -1
            run = longest = hits = told = gaps = pairs = 0
            gap_s = squares = east = north = product = 0.0
            for i in range(a, b):
                if not listed[s, i]:
                    run += 1
                    longest = max(longest, run)
                    continue
                if hits == 0:
                    first = at[i] - at[a]
                elif run > 0:
                    gaps += 1
                    gap_s += at[i] - at[last]
                run, last, hits = 0, i, hits + 1
                if np.isfinite(along[s, i]):  # of some entries none can be told
                    told += 1
                    squares += along[s, i] ** 2 + across[s, i] ** 2
                    east += along[s, i]
                    north += across[s, i]
            spread = np.nan
            if told > 0:
                east, north = east / told, north / told
                spread = squares / told - east**2 - north**2
            for i in range(a + 1, b):
                if np.isfinite(along[s, i]) and np.isfinite(along[s, i - 1]) and listed[s, i] and listed[s, i - 1]:
                    pairs += 1
                    product += (along[s, i] - east) * (along[s, i - 1] - east)
                    product += (across[s, i] - north) * (across[s, i - 1] - north)
            out[0, s, k] = first
            out[1, s, k] = longest
            out[2, s, k] = hits / (b - a)
            out[3, s, k] = np.sqrt(squares / told) if told else np.nan
            out[4, s, k] = product / pairs / spread if pairs > 2 and spread > 1e-12 else np.nan
            out[5, s, k] = gap_s / gaps if gaps else np.nan


def compared(recorded: Statistics, runs: Statistics, *, seed: int = 0) -> tuple[Check, ...]:
    """Each statistic of what was recorded (1, passes) among that of runs (S, passes).

    Left out: passes that do not have it as recorded, or in fewer than 20 runs; statistics that no pass has.
    """
    found = []
    for name in STATISTICS:
        there = ~np.isnan(recorded[name][0]) & ((~np.isnan(runs[name])).sum(axis=0) >= 20)
        if not there.any():
            continue
        values = np.concatenate([recorded[name], runs[name]])[:, there]
        pit = _ranks(values, name, np.flatnonzero(there), seed)
        # As likely as not where a run has none: what −2 ln p is on average.
        surprise = np.where(np.isnan(pit), 2.0, -2 * np.log(2 * np.minimum(pit, 1 - pit))).sum(axis=1)
        p = float((surprise >= surprise[0]).mean())
        mine = pit[0]
        inside = int(((mine >= 0.025) & (mine <= 0.975)).sum())
        few = len(mine) < FEWEST_PASSES
        verdict: Literal["holds", "too sure", "too few passes to tell"]
        verdict = "too few passes to tell" if few else "holds" if p >= 0.05 else "too sure"
        found.append(Check(name, mine, inside, p, verdict))
    return tuple(found)


def _ranks(values: Float, name: str, passes: Int, seed: int) -> Float:
    """(S + 1, passes) the place of each value among all of its pass, 0 … 1, by chance among those that are alike."""
    zero = np.zeros(len(passes), dtype=np.int64)
    key = RandomKey(("",), zero, object_words([str(k) for k in passes.tolist()]), zero)
    chance = CounterRng(seed, "replay check").uniform(name, key, np.arange(len(values)))
    out = np.full(values.shape, np.nan)
    for k in range(values.shape[1]):
        some = ~np.isnan(values[:, k])
        column = values[some, k]
        ranked = np.sort(column)
        below, up_to = np.searchsorted(ranked, column, side="left"), np.searchsorted(ranked, column, side="right")
        out[some, k] = (below + chance[some, k] * (up_to - below)) / len(column)
    return out

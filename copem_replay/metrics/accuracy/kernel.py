"""The compiled sums of accuracy, in one pass over the lists of all runs; `metrics/accuracy/statistics.py` defines them.

The NEES of pairs is cut off by the gate. Of an error whose covariance is as stated, of eigenvalues λ₁ ≥ λ₂, eᵀP⁻¹e is
χ² of two degrees of freedom, and in direction φ of the whitened error its length squared is that times s(φ) = λ₁cos²φ +
λ₂sin²φ: within the gate g while eᵀP⁻¹e ≤ t = g²/s. The share e^(−t/2) of errors is beyond it; of those within, the
first and the second moment, not yet divided by the share within, are 2 − (t + 2)e^(−t/2) and 8 − (t² + 4t + 8)e^(−t/2).
All are means over φ, periodic and smooth: 64 equal steps give six digits where one axis is twenty times the other.
Source: χ² of two degrees of freedom is the exponential distribution of mean 2; the moments are its truncated ones.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.compiled import borrowing, borrowing_kernel
from copem_replay.core.geometry import is_in_area
from copem_replay.core.object_list import Entries, ObjectLists
from copem_replay.core.tracks import SAME_INSTANT_S, Bool, Float, Int
from copem_replay.metrics.gospa import gospa_pairs
from copem_replay.metrics.matching import DUPLICATE, GHOST, MATCH

# NEES, and its moments within a gate.

SMALLEST_VARIANCE_M2 = 1e-9
"""Eigenvalues of a covariance count as at least this, (0.03 mm)²: a claimed variance of 0 then has a finite NEES."""

_ROUND = np.cos((np.arange(16) + 0.5) * np.pi / 16)
"""cos 2φ at 64 equal steps of φ round the circle, each value once: each occurs four times."""
_NEARLY_ROUND = np.cos((np.arange(8) + 0.5) * np.pi / 8)
"""cos 2φ at 32 equal steps, which are enough where the axes are alike (`_ALIKE`)."""
_ALIKE = 5.0
"""Up to this ratio of eigenvalues 32 steps and 64 agree to five digits."""
_NONE = 80.0
"""From this t on no error is beyond the gate: e⁻⁴⁰ is below the rounding of 1."""
_SMALL = 1e-3
"""Below this g²/λ₂ the moments are the first terms of their series, which are good to 1e-7 there."""
_LEAST = 1e-30
"""t is at least this, so that the share within is not 0."""


@borrowing
def compute_nees(a: float, b: float, d: float, east_m: float, north_m: float) -> tuple[float, float, float]:
    """eᵀP⁻¹e of an error and P = ((a, b), (b, d)), and the eigenvalues of P, the larger first: (1, m², m²)."""
    half, turn = (a + d) / 2, np.hypot((a - d) / 2, b)
    along = 0.5 * np.arctan2(2 * b, a - d)  # the direction of the larger eigenvalue
    u, v = east_m * np.cos(along) + north_m * np.sin(along), north_m * np.cos(along) - east_m * np.sin(along)
    large, small = max(half + turn, SMALLEST_VARIANCE_M2), max(half - turn, SMALLEST_VARIANCE_M2)
    return float(u * u / large + v * v / small), large, small


@borrowing
def expect_gated_nees(large_m2: float, small_m2: float, gate_m: float) -> tuple[float, float, float]:
    """The share of errors beyond a gate, and mean NEES and mean squared NEES of those within, for two eigenvalues."""
    square = gate_m * gate_m
    if square >= _NONE * large_m2:
        return 0.0, 2.0, 8.0
    if square < _SMALL * small_m2:
        return _expand_small_gate(large_m2, small_m2, square)
    mean, half = (large_m2 + small_m2) / 2, (large_m2 - small_m2) / 2
    steps = _NEARLY_ROUND if large_m2 <= _ALIKE * small_m2 else _ROUND
    beyond = first = second = 0.0
    for step in steps:
        t = square / (mean + half * step)
        e = np.exp(-t / 2)
        beyond += e
        first += (t + 2) * e
        second += ((t + 4) * t + 8) * e
    n = len(steps)
    within = n - beyond
    return beyond / n, (2 * n - first) / within, (8 * n - second) / within


@borrowing
def _expand_small_gate(large_m2: float, small_m2: float, square: float) -> tuple[float, float, float]:
    # As `expect_gated_nees` for small t, where its differences are rounding only: the first terms of their series.
    within = first = second = 0.0
    for step in _ROUND:
        t = max(square / ((large_m2 + small_m2) / 2 + (large_m2 - small_m2) / 2 * step), _LEAST)
        within += t / 2 - t * t / 8
        first += t * t / 4 - t**3 / 12
        second += t**3 / 6 - t**4 / 16
    return 1.0 - within / len(_ROUND), first / within, second / within


Records = NDArray[Any]


class TruthByList(NamedTuple):
    """The truth sorted by list, then by object: list k has rows `start[k] : start[k + 1]`."""

    start: Int  # (K + 1,)
    object_ix: Int  # (P,), as all that follow
    x_m: Float
    y_m: Float
    vx_mps: Float
    vy_mps: Float


class EntryMatches(NamedTuple):
    """The matches of entries. All (N,)."""

    object_ix: Int
    role: NDArray[np.int8]
    x_m: Float  # of the matched object
    y_m: Float
    class_ix: NDArray[np.int8]  # the entry's own most probable class


class EpisodeLists(NamedTuple):
    """Which lists count for each episode. All (M,) but the first."""

    episode_of: Int  # (N,) by object, −1: not measured
    first_list: Int  # lists first_list … first_list + lists − 1
    lists: Int
    column: Int  # of the first list, in the arrays list by list
    onset_s: Float
    ended_s: Float


class AccuracyParameters(NamedTuple):
    """The settings of accuracy as arrays and numbers; `AccuracySettings` has their meaning."""

    cutoff_m: float
    power: float
    gate_m: float
    measured_class: Bool  # (C,)
    distance_edges_m: Float
    time_edges_s: Float
    existence_thresholds: Float
    annotated_m: Float  # (V, 2) corners; none: everywhere
    annotated_range_m: float


class AccuracySums(NamedTuple):
    """The arrays that sums are added to: fields and shapes are those of `Accuracy`."""

    error_m: NDArray[np.float32]
    gospa: NDArray[np.float32]
    by_object: Records
    by_run: Records
    ghosts_at: Int
    by_distance: Records
    by_time: Records
    by_existence: Records


class EpisodeStates(NamedTuple):
    """The state of each episode that carries over from list to list. All (S, M)."""

    last_track: Int  # the track of the object's last pair, −1: none
    unknown_since_s: Float  # NaN: known


class ListScratch(NamedTuple):
    """Scratch for one list: the objects whose stay includes it, and their matches in the current run."""

    episode: Int
    row: Int  # of the truth, −1: it has a gap there
    distance_band: Int
    pair: Int  # the entry that is about the object, −1: none
    match: Int  # the entry that is matched with it now, −1: none
    target: Int  # its place among the targets, −1: not looked at now
    place_of: Int  # by episode: its place in these arrays, −1: none


class Targets(NamedTuple):
    """The true objects of the current list that GOSPA counts, and what the division of GOSPA among them gives."""

    episode: Int
    column: Int  # of this list in the arrays list by list
    x_m: Float
    y_m: Float
    partner: Int
    located: Float  # the object's parts of GOSPAᵖ
    missed: Float
    false: Float


class Estimates(NamedTuple):
    """The entries of the current list that GOSPA counts."""

    x_m: Float
    y_m: Float
    paired: Bool


def make_targets(most: int) -> Targets:
    """Targets with room for `most` objects."""
    whole, real = np.empty((3, most), dtype=np.int64), np.empty((5, most))
    return Targets(whole[0], whole[1], real[0], real[1], whole[2], real[2], real[3], real[4])


def make_estimates(lists: ObjectLists) -> Estimates:
    """Estimates with room for the entries of the longest list."""
    x_m, y_m = np.empty((2, lists.longest))
    return Estimates(x_m, y_m, np.empty(lists.longest, dtype=bool))


def make_list_scratch(most: int) -> ListScratch:
    """Scratch with room for `most` objects."""
    episode, row, distance_band, pair, match, target = np.empty((6, most), dtype=np.int64)
    return ListScratch(episode, row, distance_band, pair, match, target, np.full(most, -1))


@borrowing_kernel
def add_up(
    start: Int, entries: Entries, matches: EntryMatches, now: EntryMatches, issue_s: Float, world: TruthByList,
    episodes: EpisodeLists, reference_x_m: Float, reference_y_m: Float, present: Bool, params: AccuracyParameters,
    so_far: EpisodeStates, out: AccuracySums, room: ListScratch, targets: Targets, estimates: Estimates,
) -> None:  # fmt: skip
    """Add the next K lists of S runs to `out`. Numbers of lists in `episodes` count from the first of them.

    `matches`: at the instants the entries tell of; `now`: at those the lists are available. `room`, `targets` and
    `estimates`: scratch for one list.
    """
    S = len(out.by_object)
    # The expected moments are kept while the covariance stays the same, which it mostly does from list to list.
    large_m2 = small_m2 = np.nan
    beyond = nees_expected = nees_square_expected = np.nan
    for k in range(len(issue_s)):
        if not present[k]:
            continue
        from_m = (reference_x_m[k], reference_y_m[k])
        n, n_true = _gather_targets(k, issue_s[k], world, episodes, from_m, params, room, targets)
        time_band = _find_band(params.time_edges_s, issue_s[k])
        for s in range(S):
            room.pair[:n] = -1
            room.match[:n] = -1
            count = _add_entries(
                s, start[s, k], start[s, k + 1], entries, matches, now, episodes, from_m, time_band, params,
                room, targets, n_true, estimates, out,
            )  # fmt: skip
            for h in range(n):
                m, match = room.episode[h], room.match[h]
                if room.target[h] >= 0:
                    _count_look(out.by_object[s], m, match)
                    _count_look(out.by_distance[s], room.distance_band[h], match)
                    _count_look(out.by_time[s], time_band, match)
                if room.row[h] >= 0:
                    _update_gap(out.by_object[s, m], m, match, issue_s[k], episodes, so_far.unknown_since_s[s])
                i, p = room.pair[h], room.row[h]
                if i < 0:
                    continue
                entry, sums = entries[i], out.by_object[s, m]
                then_east_m, then_north_m = entry.x_m - matches.x_m[i], entry.y_m - matches.y_m[i]
                nees, large, small = compute_nees(
                    entry.cov_ee_m2, entry.cov_en_m2, entry.cov_nn_m2, then_east_m, then_north_m
                )
                if large != large_m2 or small != small_m2:
                    large_m2, small_m2 = large, small
                    beyond, nees_expected, nees_square_expected = expect_gated_nees(large, small, params.gate_m)
                square_m2, age_of_information_s = then_east_m**2 + then_north_m**2, issue_s[k] - entry.captured_s
                _add_object_sums(
                    sums, entry, square_m2, beyond, nees_square_expected, age_of_information_s, m, so_far.last_track[s]
                )
                east_m = north_m = np.nan
                if p >= 0:
                    east_m, north_m = entry.x_m - world.x_m[p], entry.y_m - world.y_m[p]
                    out.error_m[s, episodes.column[m] + k - episodes.first_list[m]] = np.hypot(east_m, north_m)
                    vx_mps, vy_mps = entry.vx_mps - world.vx_mps[p], entry.vy_mps - world.vy_mps[p]
                    sums.velocity_square_m2ps2 += vx_mps**2 + vy_mps**2
                _add_pair(out.by_object[s], m, east_m, north_m, nees, nees_expected)
                _add_pair(out.by_distance[s], room.distance_band[h], east_m, north_m, nees, nees_expected)
                _add_pair(out.by_time[s], time_band, east_m, north_m, nees, nees_expected)
            _add_gospa(out.gospa[s], out.by_object[s], out.by_run[s], targets, n_true, estimates, count, params)
        for h in range(n):
            room.place_of[room.episode[h]] = -1


@borrowing_kernel
def close_episodes(episodes: EpisodeLists, so_far: EpisodeStates, out: AccuracySums) -> None:
    """Add the gaps that last until the episodes end, after all lists."""
    S, M = out.by_object.shape
    for s in range(S):
        for m in range(M):
            if not np.isnan(so_far.unknown_since_s[s, m]):
                sums = out.by_object[s, m]
                sums.longest_gap_s = max(sums.longest_gap_s, episodes.ended_s[m] - so_far.unknown_since_s[s, m])


@borrowing
def _gather_targets(
    k: int, issue_s: float, world: TruthByList, episodes: EpisodeLists, from_m: tuple[float, float],
    params: AccuracyParameters, room: ListScratch, targets: Targets,
) -> tuple[int, int]:  # fmt: skip
    """Fills `room` with the objects in whose stay list k falls, those in a gap of the truth last, and `targets` with
    those whose onset is past. Returns the number of both.
    """
    n = n_true = 0
    for p in range(world.start[k], world.start[k + 1]):
        m = episodes.episode_of[world.object_ix[p]]
        if m < 0 or k < episodes.first_list[m] or k >= episodes.first_list[m] + episodes.lists[m]:
            continue
        distance_m = np.hypot(world.x_m[p] - from_m[0], world.y_m[p] - from_m[1])
        room.episode[n], room.row[n], room.place_of[m] = m, p, n
        room.distance_band[n], room.target[n] = _find_band(params.distance_edges_m, distance_m), -1
        if issue_s >= episodes.onset_s[m] - SAME_INSTANT_S:
            room.target[n] = n_true
            targets.episode[n_true], targets.column[n_true] = m, episodes.column[m] + k - episodes.first_list[m]
            targets.x_m[n_true], targets.y_m[n_true] = world.x_m[p], world.y_m[p]
            n_true += 1
        n += 1
    for m in range(len(episodes.lists)):
        if room.place_of[m] < 0 and episodes.first_list[m] <= k < episodes.first_list[m] + episodes.lists[m]:
            room.episode[n], room.row[n], room.place_of[m] = m, -1, n
            room.distance_band[n] = room.target[n] = -1
            n += 1
    return n, n_true


@borrowing
def _add_entries(
    s: int, first: int, after: int, entries: Entries, matches: EntryMatches, now: EntryMatches, episodes: EpisodeLists,
    from_m: tuple[float, float], time_band: int, params: AccuracyParameters, room: ListScratch, targets: Targets,
    n_true: int, estimates: Estimates, out: AccuracySums,
) -> int:  # fmt: skip
    """Finds the matches in one list of run s and counts its other entries in `out`. Returns the number in GOSPA."""
    count = 0
    for i in range(first, after):
        if matches.role[i] == MATCH:
            m = episodes.episode_of[matches.object_ix[i]]
            if m >= 0 and room.place_of[m] >= 0:
                room.pair[room.place_of[m]] = i
        m = episodes.episode_of[now.object_ix[i]] if now.role[i] != GHOST else -1
        h = room.place_of[m] if m >= 0 else -1
        target = room.target[h] if h >= 0 else -1
        if now.role[i] == MATCH and h >= 0:
            room.match[h] = i
        elif now.role[i] == DUPLICATE and m >= 0:
            out.by_run[s].duplicates += 1
            if target >= 0:
                out.by_object[s, m].duplicates += 1
        measured = params.measured_class[matches.class_ix[i]]
        nowhere = now.role[i] == GHOST
        if (nowhere or matches.role[i] == GHOST) and measured:
            annotated = is_in_area(
                entries[i].x_m, entries[i].y_m, from_m[0], from_m[1], params.annotated_m, params.annotated_range_m
            )
            if not annotated and nowhere:
                out.by_run[s].unannotated += 1
                nowhere = False
            if not annotated and matches.role[i] == GHOST:
                measured = False
        if target >= 0 or (nowhere and measured):
            estimates.x_m[count], estimates.y_m[count] = entries[i].x_m, entries[i].y_m
            count += 1
        if measured:
            existence = entries[i].existence
            bins = out.by_existence.shape[1]
            claim = out.by_existence[s, min(max(int(existence * bins), 0), bins - 1)]
            claim.entries += 1
            claim.existence += existence
            claim.with_object += matches.role[i] != GHOST
            if nowhere and matches.role[i] == GHOST:
                _add_false_positive(
                    s, entries[i].x_m, entries[i].y_m, existence, from_m, time_band, params, targets, n_true, out
                )
            elif nowhere:
                out.by_run[s].stale_ghosts += 1
    return count


@borrowing
def _add_false_positive(
    s: int, x_m: float, y_m: float, existence: float, from_m: tuple[float, float], time_band: int,
    params: AccuracyParameters, targets: Targets, n_true: int, out: AccuracySums,
) -> None:  # fmt: skip
    """Counts one ghost: by run, threshold, distance and time band, and at the object nearest to it."""
    out.by_run[s].ghosts += 1
    for q in range(len(params.existence_thresholds)):
        out.ghosts_at[s, q] += existence >= params.existence_thresholds[q]
    distance_band = _find_band(params.distance_edges_m, np.hypot(x_m - from_m[0], y_m - from_m[1]))
    if distance_band >= 0:
        out.by_distance[s, distance_band].ghosts += 1
    if time_band >= 0:
        out.by_time[s, time_band].ghosts += 1
    nearest_target = find_nearest_target(x_m, y_m, targets, n_true)
    if nearest_target >= 0:
        out.by_object[s, targets.episode[nearest_target]].ghosts += 1


@borrowing
def _count_look(records: Records, band: int, match: int) -> None:
    if band >= 0:
        records[band].looked += 1
        if match < 0:
            records[band].missed += 1


@borrowing
def _update_gap(sums: Any, m: int, match: int, issue_s: float, stays: EpisodeLists, unknown_since_s: Float) -> None:
    # The time for which the object is unknown, carried from list to list. `match` −1: none.
    now_s = min(max(issue_s, stays.onset_s[m]), stays.ended_s[m])
    if match < 0:
        if np.isnan(unknown_since_s[m]):
            unknown_since_s[m] = now_s
    elif not np.isnan(unknown_since_s[m]):
        sums.longest_gap_s = max(sums.longest_gap_s, now_s - unknown_since_s[m])
        unknown_since_s[m] = np.nan


@borrowing
def _add_object_sums(
    sums: Any,
    entry: Any,
    square_then_m2: float,
    beyond: float,
    nees_square_expected: float,
    age_of_information_s: float,
    m: int,
    last_track: Int,
) -> None:
    """Adds a match to the sums of its object; a switch is counted where the track id is not that of `last_track[m]`."""
    sums.square_then_m2 += square_then_m2
    sums.beyond_gate += beyond
    sums.nees_square_expected += nees_square_expected
    sums.age_of_information_s += age_of_information_s
    track = entry.track_id
    if track >= 0:
        sums.tracked += 1
        sums.switches += last_track[m] >= 0 and last_track[m] != track
        last_track[m] = track


@borrowing
def _add_pair(records: Records, band: int, east_m: float, north_m: float, nees: float, nees_expected: float) -> None:
    """Adds a match to the sums of a band (−1: none); `east_m`, `north_m`: its error, NaN: the object is absent now."""
    if band < 0:
        return
    sums = records[band]
    sums.pairs += 1
    sums.nees += nees
    sums.nees_expected += nees_expected
    if not np.isnan(east_m):
        sums.placed += 1
        sums.square_m2 += east_m**2 + north_m**2
        sums.east_m += east_m
        sums.north_m += north_m


@borrowing
def _add_gospa(
    gospa: NDArray[np.float32], by_object: Records, sums: Any, targets: Targets, n_true: int,
    estimates: Estimates, count: int, params: AccuracyParameters,
) -> None:  # fmt: skip
    """Adds the GOSPA of one list, divided among the objects, and its OSPA; the same pairs are best for both."""
    if n_true == 0:
        return
    sums.lists_looked += 1
    localisation, pairs = divide_gospa(targets, n_true, estimates, count, params.cutoff_m, params.power)
    most = max(n_true, count)
    sums.ospa_m += ((localisation + params.cutoff_m**params.power * (most - pairs)) / most) ** (1.0 / params.power)
    for t in range(n_true):
        m = targets.episode[t]
        by_object[m].gospa_localisation += targets.located[t]
        by_object[m].gospa_missed += targets.missed[t]
        by_object[m].gospa_false += targets.false[t]
        gospa[targets.column[t]] = targets.located[t] + targets.missed[t] + targets.false[t]


@borrowing
def divide_gospa(
    targets: Targets, n_true: int, estimates: Estimates, count: int, cutoff_m: float, power: float
) -> tuple[float, int]:
    """Divide GOSPAᵖ among `n_true` objects, one at least, given `count` entries.

    Out: `targets.located`, `missed` and `false`. Returns Σ dᵖ over the pairs and their number.
    """
    unit = cutoff_m**power
    localisation, pairs = gospa_pairs(
        targets.x_m[:n_true], targets.y_m[:n_true], estimates.x_m[:count], estimates.y_m[:count],
        cutoff_m, power, targets.partner[:n_true],
    )  # fmt: skip
    estimates.paired[:count] = False
    for t in range(n_true):
        b = targets.partner[t]
        targets.located[t] = targets.missed[t] = targets.false[t] = 0.0
        if b >= 0:
            estimates.paired[b] = True
            square = (targets.x_m[t] - estimates.x_m[b]) ** 2 + (targets.y_m[t] - estimates.y_m[b]) ** 2
            targets.located[t] = square ** (power / 2)
        else:
            targets.missed[t] = unit / 2
    for b in range(count):
        if not estimates.paired[b]:
            targets.false[find_nearest_target(estimates.x_m[b], estimates.y_m[b], targets, n_true)] += 1
    for t in range(n_true):
        targets.false[t] *= unit / 2
    return localisation, pairs


@borrowing
def find_nearest_target(x_m: float, y_m: float, targets: Targets, wanted: int) -> int:
    """Index of the target nearest to a place, the first of equally near ones; −1: there are none."""
    best, least = -1, np.inf
    for t in range(wanted):
        square = (targets.x_m[t] - x_m) ** 2 + (targets.y_m[t] - y_m) ** 2
        if square < least:
            best, least = t, square
    return best


@borrowing
def _find_band(edges: Float, value: float) -> int:
    # The band that holds the value, its lower edge included, its upper one not; −1: none.
    band = -1
    while band < len(edges) - 1 and not value < edges[band + 1]:
        band += 1
    return band if band < len(edges) - 1 else -1

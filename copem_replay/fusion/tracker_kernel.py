"""The compiled kernel of fusion/tracker.py: see there for what it does.

Nothing here may depend on the order of units or of entries: lists and entries are brought into an order that only
their content decides, and tracks stand in the order in which they were founded.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from copem_replay.core.agree import most_probable
from copem_replay.core.assignment import assign_pairs, largest_around
from copem_replay.core.object_list import ENTRY, Entries
from copem_replay.core.tracks import CLASSES, SAME_INSTANT_NS, Bool, Float, Int
from copem_replay.fusion.content_order import compare_rows
from copem_replay.fusion.covariance import floored
from copem_replay.fusion.tracker_filter import carry, distance2, predict, update
from copem_replay.fusion.tracker_memory import CLAIM, TRACK, Memory, Remembered, recalled, remembered
from copem_replay.fusion.tracker_split import update_split

STALE, PREDICT, REPLAY = 0, 1, 2
ENTRIES_PER_LIST = 65536
"""Track ids: number of the founding list × this + place of the founding entry in it."""
SAME_OBJECT = 1.386
"""Tracks whose next entries would be as close as this, d², can be of one object: the median of χ² with 2 degrees of
freedom (chosen), so half of the pairs of entries of one object are closer."""
_SAME_S = SAME_INSTANT_NS * 1e-9
_NOTHING_NEW = 1e12
"""An entry that counts as one of so many times the variance says nothing new: errors last too long (chosen)."""
_LEAST_COST = 1e-6
"""What the worst pair within the gate is better than none (chosen: small against the differences between pairs)."""


class Said(NamedTuple):
    """What the units say in one run: lists f, `rows[start[f] : start[f + 1]]` their entries in order of content."""

    start: Int  # (F + 1,)
    rows: Int  # (N,) indices into entries
    entries: Entries  # (N,)
    content: Float  # (N, D) the entries as numbers, without times and ids
    captured_s: Float  # (F,)
    unit_ix: Int  # (F,)


class Rules(NamedTuple):
    """The tracker's settings, as the kernel wants them."""

    late: int
    q_m2ps3: float
    speed_var_m2ps2: float
    gate: float  # d²
    forget_s: float
    publish: float
    drop: float
    confirm_s: float
    buffer_s: float
    agree: Bool  # (C, C)
    errors_last_s: float  # 0: errors are fresh in every list
    common_share: float
    keeps_s: Float  # (U,) for how long what a unit's messages leave out may be there: no claim fades before
    apart_s: float  # a list that held two tracks tells for so long that they are two


# ------------------------------------------------------------------------------------------------------------- one run


@nb.njit(cache=True, nogil=True)
def fuse_run(
    said: Said, rules: Rules, so_far: Remembered, issue_s: Float, arrived: Int, arrived_start: Int
) -> tuple[Int, Entries, Remembered]:
    """Fused lists of one run at the next instants: where each begins (K + 1,), their entries, and what to remember."""
    memory, before, heard = recalled(so_far, said.captured_s)
    start, entries = np.zeros(len(issue_s) + 1, np.int64), np.zeros(256, ENTRY)
    for k in range(len(issue_s)):
        came = _in_order(said, arrived[arrived_start[k] : arrived_start[k + 1]])
        if rules.late == REPLAY:
            memory, before, heard = _replayed(memory, before, heard, came, said, rules)
        else:
            for f in came:
                memory = _hear(memory, said, rules, f, issue_s[k])
            memory = _settled(memory, rules, issue_s[k])
        if start[k] + len(memory.tracks) > len(entries):
            grown = np.zeros(2 * (start[k] + len(memory.tracks)), ENTRY)
            grown[: start[k]] = entries[: start[k]]
            entries = grown
        start[k + 1] = start[k] + _publish(memory, rules, issue_s[k], entries[start[k] :])
    return start, entries[: start[-1]].copy(), remembered(memory, before, heard, said.captured_s)


@nb.njit(cache=True, nogil=True)
def _replayed(
    memory: Memory, before: list[Memory], heard: Int, came: Int, said: Said, rules: Rules
) -> tuple[Memory, list[Memory], Int]:
    """Memory as if the lists `came` had been heard when they were captured, and the lists heard of late.

    Goes back to `before` the first list captured when the oldest of them was, or later, and hears all again.
    """
    if len(heard):
        oldest_s = said.captured_s[heard[-1]] - rules.buffer_s - _SAME_S
        came = came[said.captured_s[came] >= oldest_s]
    if len(came) == 0:
        return memory, before, heard
    back = len(heard)
    while back > 0 and said.captured_s[heard[back - 1]] >= said.captured_s[came[0]]:
        back -= 1
    while len(before) > back:
        memory = before.pop()
    again = _in_order(said, np.concatenate((heard[back:], came)))
    heard = np.concatenate((heard[:back], again))
    for k in range(len(again)):
        now_s = said.captured_s[again[k]]
        if k == 0 or said.captured_s[again[k - 1]] < now_s:
            saved = memory
            memory = Memory(saved.tracks.copy(), saved.claims.copy(), saved.together_s.copy())
        before.append(saved)
        memory = _hear(memory, said, rules, again[k], now_s)
        if k + 1 == len(again) or said.captured_s[again[k + 1]] > now_s:
            memory = _settled(memory, rules, now_s)
    done = 0
    while said.captured_s[heard[done]] < said.captured_s[heard[-1]] - rules.buffer_s - _SAME_S:
        done += 1
    return memory, before[done:], heard[done:]


@nb.njit(cache=True, nogil=True)
def _publish(memory: Memory, rules: Rules, now_s: float, out: Entries) -> int:
    """Writes the tracks there are now to the front of `out`, and says how much that is."""
    state, P = np.empty(4), np.empty((4, 4))
    n = 0
    for j in range(len(memory.tracks)):
        track = memory.tracks[j]
        existence = _existence(memory.claims[j], rules, now_s)
        if not existence > rules.publish or track.last_s - track.first_s < rules.confirm_s - _SAME_S:
            continue
        state[:], P[:] = track.state, track.P
        predict(state, P, max(now_s - track.at_s, 0.0), rules.q_m2ps3)
        entry = out[n]
        n += 1
        entry.x_m, entry.y_m, entry.vx_mps, entry.vy_mps = state[0], state[1], state[2], state[3]
        entry.cov_ee_m2, entry.cov_en_m2, entry.cov_nn_m2 = P[0, 0], P[0, 1], P[1, 1]
        entry.z_m, entry.yaw_rad, entry.existence = track.z_m, track.yaw_rad, existence
        entry.length_m, entry.width_m = track.length_m / track.count, track.width_m / track.count
        entry.height_m = track.height_m / track.count
        total = track.class_probability.sum()
        for c in range(len(CLASSES)):
            entry.class_probability[c] = track.class_probability[c] / total if total > 0 else 0.0
        entry.captured_s, entry.unit_ix, entry.track_id = track.last_s, track.unit_ix, track.track_id
    return n


# ------------------------------------------------------------------------------------------------------------ one list


@nb.njit(cache=True, nogil=True)
def _hear(memory: Memory, said: Said, rules: Rules, f: int, now_s: float) -> Memory:
    """Takes in list f as of `now_s`: every track is predicted to then, updated, or founded."""
    for track in memory.tracks:
        if track.at_s < now_s:
            predict(track.state, track.P, now_s - track.at_s, rules.q_m2ps3)
            if rules.common_share > 0.0:
                carry(track.common, now_s - track.at_s)
            track.at_s = now_s
    said_s = now_s if rules.late == STALE else said.captured_s[f]
    seen = _seen(said, rules, f, now_s)
    rows = said.rows[said.start[f] : said.start[f + 1]]
    partner = _partners(memory.tracks, said, rules, rows, seen)
    n = len(memory.tracks)
    memory = _with_room(memory, int((partner < 0).sum()))
    for i in range(len(rows)):
        entry, x, y, ee, en, nn = said.entries[rows[i]], seen[i, 0], seen[i, 1], seen[i, 2], seen[i, 3], seen[i, 4]
        if partner[i] >= 0:
            track = memory.tracks[partner[i]]
            # As much as fresh errors of so much more variance would say: those of a unit last, about each object.
            last_s = memory.claims[partner[i], said.unit_ix[f]].at_s
            grown = 1.0
            if rules.errors_last_s > 0.0 and last_s > -math.inf:
                grown = math.tanh(abs(said_s - last_s) / (2.0 * rules.errors_last_s))
                grown = 1.0 / grown if grown > 0.0 else math.inf
            if rules.common_share > 0.0:
                update_split(track.state, track.P, track.common, seen[i], rules.common_share, grown)
            elif grown < _NOTHING_NEW:
                update(track.state, track.P, x, y, grown * ee, grown * en, grown * nn)
        else:
            partner[i] = n
            n += 1
            track = memory.tracks[partner[i]]
            _found(track, entry, x, y, ee, en, nn, rules)
            track.at_s, track.first_s, track.last_s = now_s, said.captured_s[f], said.captured_s[f]
            track.unit_ix, track.track_id = said.unit_ix[f], f * ENTRIES_PER_LIST + i
        track.ee, track.en, track.nn = ee, en, nn
        _describe(track, entry, said.captured_s[f])
        claim = memory.claims[partner[i], said.unit_ix[f]]
        if said_s >= claim.at_s:
            claim.existence, claim.at_s = entry.existence, said_s
    for j in partner:
        for k in partner:
            memory.together_s[j, k] = now_s
    return memory


@nb.njit(cache=True, nogil=True)
def _seen(said: Said, rules: Rules, f: int, now_s: float) -> Float:
    """Places and their covariances (n, 5): x, y, ee, en, nn of the entries of list f as of `now_s`."""
    rows = said.rows[said.start[f] : said.start[f + 1]]
    seen = np.empty((len(rows), 5))
    age_of_information_s = max(now_s - said.captured_s[f], 0.0) if rules.late == PREDICT else 0.0
    grown = rules.q_m2ps3 * age_of_information_s**3 / 3
    for i in range(len(rows)):
        entry = said.entries[rows[i]]
        seen[i, 0], seen[i, 1] = (
            entry.x_m + age_of_information_s * entry.vx_mps,
            entry.y_m + age_of_information_s * entry.vy_mps,
        )
        ee, en, nn = floored(entry.cov_ee_m2, entry.cov_en_m2, entry.cov_nn_m2)
        seen[i, 2], seen[i, 3], seen[i, 4] = ee + grown, en, nn + grown
    return seen


@nb.njit(cache=True, nogil=True)
def _partners(tracks: NDArray[Any], said: Said, rules: Rules, rows: Int, seen: Float) -> Int:
    """The track of each entry (n,), −1: none. Least sum of d² + ln|S| over the pairs within the gate."""
    n, m = len(rows), len(tracks)
    partner = np.full(n, -1)
    if n == 0 or m == 0:
        return partner
    class_ix = np.empty(n, np.int64)
    for i in range(n):
        class_ix[i] = most_probable(said.entries[rows[i]].class_probability)
    row, col = np.empty(n * m, np.int64), np.empty(n * m, np.int64)
    cost, spread, pairs = np.empty(n * m), np.empty(n * m), 0
    for j in range(m):
        track = tracks[j]
        agree = rules.agree[track.class_ix]
        x, y, ee, en, nn = track.state[0], track.state[1], track.P[0, 0], track.P[0, 1], track.P[1, 1]
        for i in range(n):
            dx, dy = seen[i, 0] - x, seen[i, 1] - y
            a, b, d = seen[i, 2] + ee, seen[i, 3] + en, seen[i, 4] + nn
            # No eigenvalue of S is above its trace.
            if dx * dx + dy * dy > rules.gate * (a + d) or not agree[class_ix[i]]:
                continue
            d2 = distance2(dx, dy, a, b, d)
            if d2 <= rules.gate:
                row[pairs], col[pairs], spread[pairs] = i, j, math.log(a * d - b * b)
                cost[pairs] = d2 + spread[pairs]
                pairs += 1
    row, col, cost, spread = row[:pairs], col[:pairs], cost[:pairs], spread[:pairs]
    # Alone costs 0: shifted so that any pair within the gate is better than none.
    largest_around(row, col, spread, n, m)
    for p in range(pairs):
        cost[p] -= rules.gate + spread[p] + _LEAST_COST
    assign_pairs(row, col, cost, n, m, partner)
    return partner


@nb.njit(cache=True, nogil=True)
def _with_room(memory: Memory, more: int) -> Memory:
    """The same memory with room for `more` tracks at its end, of which nothing is known."""
    if more == 0:
        return memory
    n, units = memory.claims.shape
    tracks, claims = np.zeros(n + more, TRACK), np.zeros((n + more, units), CLAIM)
    together_s = np.full((n + more, n + more), -np.inf)
    for claim in claims[n:].flat:
        claim.at_s = -np.inf
    tracks[:n], claims[:n], together_s[:n, :n] = memory.tracks, memory.claims, memory.together_s
    return Memory(tracks, claims, together_s)


@nb.njit(cache=True, nogil=True)
def _found(track: Any, entry: Any, x: float, y: float, ee: float, en: float, nn: float, rules: Rules) -> None:
    track.state[0], track.state[1], track.state[2], track.state[3] = x, y, entry.vx_mps, entry.vy_mps
    track.P[0, 0], track.P[0, 1], track.P[1, 0], track.P[1, 1] = ee, en, en, nn
    track.P[2, 2] = track.P[3, 3] = rules.speed_var_m2ps2
    for a in range(2):
        for b in range(2):
            track.common[a, b] = rules.common_share * track.P[a, b]


@nb.njit(cache=True, nogil=True)
def _describe(track: Any, entry: Any, captured_s: float) -> None:
    """What the filter leaves out; of lists captured together the last one heard counts as the newest."""
    if captured_s >= track.last_s:
        track.z_m, track.yaw_rad = entry.z_m, entry.yaw_rad
    track.first_s, track.last_s = min(track.first_s, captured_s), max(track.last_s, captured_s)
    track.length_m += entry.length_m
    track.width_m += entry.width_m
    track.height_m += entry.height_m
    for c in range(len(CLASSES)):
        track.class_probability[c] += entry.class_probability[c]
    track.class_ix = most_probable(track.class_probability)
    track.count += 1


# ------------------------------------------------------------------------------------------------------ life and death


@nb.njit(cache=True, nogil=True)
def _existence(claims: NDArray[Any], rules: Rules, now_s: float) -> float:
    """1 − Πᵤ (1 − cᵤ e^(−(now − tᵤ)/forget)) of one track, `claims (U,)`."""
    none = 1.0
    for u in range(len(claims)):
        claim = claims[u]
        if claim.existence > 0.0:
            faded_s = max(now_s - claim.at_s - rules.keeps_s[u], 0.0)
            none *= 1.0 - claim.existence * math.exp(-faded_s / rules.forget_s)
    return 1.0 - none


@nb.njit(cache=True, nogil=True)
def _settled(memory: Memory, rules: Rules, now_s: float) -> Memory:
    """Without the tracks that have faded, and of two of one object without the younger (`now_s`: as of all tracks)."""
    n, units = memory.claims.shape
    keep = np.empty(n, np.bool_)
    for j in range(n):
        keep[j] = _existence(memory.claims[j], rules, now_s) > rules.drop
    for i in range(n):
        for j in range(i + 1, n):
            if keep[i] and keep[j] and _one_object(memory, rules, i, j, now_s):
                keep[_younger(memory.tracks, i, j)] = False
    left = np.flatnonzero(keep)
    if len(left) == n:
        return memory
    tracks, claims = np.empty(len(left), TRACK), np.empty((len(left), units), CLAIM)
    together_s = np.empty((len(left), len(left)))
    for a in range(len(left)):
        tracks[a], claims[a] = memory.tracks[left[a]], memory.claims[left[a]]
        together_s[a] = memory.together_s[left[a]][left]
    return Memory(tracks, claims, together_s)


@nb.njit(cache=True, nogil=True)
def _one_object(memory: Memory, rules: Rules, i: int, j: int, now_s: float) -> bool:
    """Classes agree, no list held both of late, and the tracks are as close as two entries of one object would be."""
    a, b = memory.tracks[i], memory.tracks[j]
    dx, dy = a.state[0] - b.state[0], a.state[1] - b.state[1]
    # Not only P: of two tracks that share the entries of one object each keeps to its side, and is too sure of it.
    ee, nn = a.P[0, 0] + a.ee + b.P[0, 0] + b.ee, a.P[1, 1] + a.nn + b.P[1, 1] + b.nn
    if dx * dx + dy * dy > SAME_OBJECT * (ee + nn) or not rules.agree[a.class_ix, b.class_ix]:
        return False
    if memory.together_s[i, j] >= now_s - rules.apart_s:
        return False
    return distance2(dx, dy, ee, a.P[0, 1] + a.en + b.P[0, 1] + b.en, nn) <= SAME_OBJECT


@nb.njit(cache=True, nogil=True)
def _younger(tracks: NDArray[Any], i: int, j: int) -> int:
    """Of tracks i < j the later captured first, then the one of fewer entries, then the one founded later."""
    a, b = tracks[i], tracks[j]
    if a.first_s != b.first_s:
        return i if a.first_s > b.first_s else j
    return i if a.count < b.count else j


# ------------------------------------------------------------------------------- an order that depends on content only


@nb.njit(cache=True, nogil=True)
def _comes_before(said: Said, f: int, g: int) -> bool:
    if said.captured_s[f] != said.captured_s[g]:
        return bool(said.captured_s[f] < said.captured_s[g])
    n, m = said.start[f + 1] - said.start[f], said.start[g + 1] - said.start[g]
    if n != m:
        return bool(n > m)
    for k in range(n):
        order = compare_rows(said.content, said.rows[said.start[f] + k], said.rows[said.start[g] + k])
        if order != 0:
            return bool(order < 0)
    # They are equal: their order only decides which unit's the track counts as.
    return bool(said.unit_ix[f] < said.unit_ix[g] or (said.unit_ix[f] == said.unit_ix[g] and f < g))


@nb.njit(cache=True, nogil=True)
def _in_order(said: Said, lists: Int) -> Int:
    """The same lists by capture, more entries first, then by content."""
    lists = lists.copy()
    for k in range(1, len(lists)):
        f, at = lists[k], k
        while at > 0 and _comes_before(said, f, lists[at - 1]):
            lists[at] = lists[at - 1]
            at -= 1
        lists[at] = f
    return lists

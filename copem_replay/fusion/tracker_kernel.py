"""The compiled kernel of the tracker: its memory, its Kalman filter, and one run list after list.

fusion/tracker.py says what the tracker does. Nothing here may depend on the order of units or of entries: lists and
entries are brought into an order that only their content decides, and tracks stand in the order in which they were
founded.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.assignment import assign_pairs, spread_component_maximum
from copem_replay.core.compiled import callee, kernel
from copem_replay.core.object_list import ENTRY, Entries, most_probable_class
from copem_replay.core.tracks import CLASSES, SAME_INSTANT_S, Bool, Float, Int
from copem_replay.fusion.covariance import floor_eigenvalues
from copem_replay.fusion.inputs import compare_rows

# Memory of one run, from instant to instant, and from one time chunk of instants to the next.

TRACK = np.dtype(
    [
        ("state", "f8", (4,)),  # x, y, vx, vy at `at_s`
        ("P", "f8", (4, 4)),
        ("common", "f8", (4, 4)),  # the part of P that may be correlated with later entries; 0 without a share
        ("at_s", "f8"),
        ("ee", "f8"), ("en", "f8"), ("nn", "f8"),  # R of the entry received last
        ("z_m", "f8"),  # z and yaw of the newest entry
        ("yaw_rad", "f8"),
        ("length_m", "f8"),  # sums over all entries, sizes and class
        ("width_m", "f8"),
        ("height_m", "f8"),
        ("class_probability", "f8", (len(CLASSES),)),
        ("class_ix", "i8"),  # the most probable
        ("count", "i8"),  # of entries
        ("first_s", "f8"),  # captures of the first and the last list in support
        ("last_s", "f8"),
        ("unit_ix", "i8"),  # the unit that founded it
        ("track_id", "i8"),
    ]
)  # fmt: skip
CLAIM = np.dtype([("existence", "f8"), ("at_s", "f8")])
"""The newest existence that a unit claimed of a track, and from when on it fades: its capture (`stale`: its arrival).
No claim yet: 0, −inf."""


class TrackerMemory(NamedTuple):
    """The tracker's state from one instant to the next; tracks stand in the order in which they were founded."""

    tracks: NDArray[Any]  # (T,) of TRACK
    claims: NDArray[Any]  # (T, U) of CLAIM
    together_s: Float  # (T, T) when one list last held both; −inf: never


class StoredMemory(NamedTuple):
    """The tracker's state from one time chunk to the next; all but `memory` serves `late: replay` alone.

    Lists captured at one instant have one memory before them. These are stored instant after instant: of instant b the
    next `sizes[b]` of `tracks` and `claims`, and the square of that of `together_s`.
    """

    memory: TrackerMemory
    received: Int  # (H,) the lists received of late, in order
    sizes: Int  # (B,)
    tracks: NDArray[Any]  # (Σ sizes,) of TRACK
    claims: NDArray[Any]  # (Σ sizes, U) of CLAIM
    together_s: Float  # (Σ sizes²,)


def empty_memory(units: int) -> StoredMemory:
    """The memory before the first instant."""
    memory = TrackerMemory(np.empty(0, TRACK), np.empty((0, units), CLAIM), np.empty((0, 0)))
    none = np.empty(0, np.int64)
    return StoredMemory(memory, none, none, memory.tracks, memory.claims, np.empty(0))


@callee
def recall_memory(so_far: StoredMemory, captured_s: Float) -> tuple[TrackerMemory, list[TrackerMemory], Int]:
    """A copy of the state, the state before each of the recently received lists, and these lists."""
    memory = _copy_memory(so_far.memory)
    before = [memory]
    before.pop()
    track = pair = b = 0
    for h in range(len(so_far.received)):
        if h > 0 and captured_s[so_far.received[h]] == captured_s[so_far.received[h - 1]]:
            before.append(before[h - 1])
            continue
        n = so_far.sizes[b]
        together_s = so_far.together_s[pair : pair + n * n].copy().reshape(n, n)
        before.append(
            TrackerMemory(so_far.tracks[track : track + n].copy(), so_far.claims[track : track + n].copy(), together_s)
        )
        track, pair, b = track + n, pair + n * n, b + 1
    return memory, before, so_far.received.copy()


@callee
def store_memory(memory: TrackerMemory, before: list[TrackerMemory], received: Int, captured_s: Float) -> StoredMemory:
    """The result of `recall_memory` in the form in which it is stored."""
    first = np.empty(len(received), np.int64)
    instants = tracks = pairs = 0
    for h in range(len(received)):
        if h == 0 or captured_s[received[h]] != captured_s[received[h - 1]]:
            first[instants] = h
            n = len(before[h].tracks)
            instants, tracks, pairs = instants + 1, tracks + n, pairs + n * n
    stored = StoredMemory(
        memory, received.copy(), np.empty(instants, np.int64), np.empty(tracks, TRACK),
        np.empty((tracks, memory.claims.shape[1]), CLAIM), np.empty(pairs),
    )  # fmt: skip
    track = pair = 0
    for b in range(instants):
        memory_before = before[first[b]]
        n = len(memory_before.tracks)
        stored.sizes[b] = n
        stored.tracks[track : track + n], stored.claims[track : track + n] = memory_before.tracks, memory_before.claims
        stored.together_s[pair : pair + n * n] = memory_before.together_s.copy().reshape(n * n)
        track, pair = track + n, pair + n * n
    return stored


@callee
def _copy_memory(memory: TrackerMemory) -> TrackerMemory:
    return TrackerMemory(memory.tracks.copy(), memory.claims.copy(), memory.together_s.copy())


# Kalman filter of a point that moves at constant velocity, its position measured.
#
# State (x, y, vx, vy) with covariance P (4, 4); every kernel changes both in place and leaves P symmetric.
# Acceleration is white noise of spectral density q [m²/s³] on each axis: Q = q [Δt³/3 Δt²/2; Δt²/2 Δt], so that two
# steps are as good as one. Measured is z = (x, y) with covariance R = (ee, en; en, nn).
#
# Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", Wiley
# 2001 (Kalman filter and its Joseph form, continuous white noise acceleration, gate).


@callee
def propagate_covariance(P: Float, dt_s: float) -> None:
    """Advance a covariance by `dt_s` ≥ 0 without acceleration: P ← F P Fᵀ, in place."""
    for i in range(2):
        for j in range(2):
            P[i, j] += dt_s * (P[i, 2 + j] + P[2 + i, j]) + dt_s * dt_s * P[2 + i, 2 + j]
    for i in range(2):
        for j in range(2):
            P[i, 2 + j] += dt_s * P[2 + i, 2 + j]
            P[2 + j, i] = P[i, 2 + j]


@callee
def predict_state(state: Float, P: Float, dt_s: float, q_m2ps3: float) -> None:
    """Advance a state by `dt_s` ≥ 0: x ← F x, P ← F P Fᵀ + Q."""
    for i in range(2):
        state[i] += dt_s * state[2 + i]
    propagate_covariance(P, dt_s)
    for i in range(2):
        P[i, i] += q_m2ps3 * dt_s**3 / 3
        P[i, 2 + i] += q_m2ps3 * dt_s**2 / 2
        P[2 + i, i] = P[i, 2 + i]
        P[2 + i, 2 + i] += q_m2ps3 * dt_s


@callee
def update_state(state: Float, P: Float, x_m: float, y_m: float, ee: float, en: float, nn: float) -> None:
    """Update a state by a measured position: x ← x + K ν, P ← (I − K H) P (I − K H)ᵀ + K R Kᵀ."""
    a, b, d = P[0, 0] + ee, P[0, 1] + en, P[1, 1] + nn
    det = a * d - b * b
    k_x = _gain_column(P, d / det, -b / det)
    k_y = _gain_column(P, -b / det, a / det)
    # I − K H in the measured rows is R S⁻¹: so written, nothing is left of a difference of nearly equal numbers.
    r00, r01 = (ee * d - en * b) / det, (en * a - ee * b) / det
    r10, r11 = (en * d - nn * b) / det, (nn * a - en * b) / det
    dx, dy = x_m - state[0], y_m - state[1]
    for i in range(4):
        state[i] += k_x[i] * dx + k_y[i] * dy
    for j in range(4):
        p0, p1 = P[0, j], P[1, j]
        P[0, j], P[1, j] = r00 * p0 + r01 * p1, r10 * p0 + r11 * p1
        P[2, j] -= k_x[2] * p0 + k_y[2] * p1
        P[3, j] -= k_x[3] * p0 + k_y[3] * p1
    for i in range(4):
        p0, p1 = P[i, 0], P[i, 1]
        noise_x, noise_y = k_x[i] * ee + k_y[i] * en, k_x[i] * en + k_y[i] * nn
        P[i, 0], P[i, 1] = r00 * p0 + r01 * p1, r10 * p0 + r11 * p1
        P[i, 2] -= p0 * k_x[2] + p1 * k_y[2]
        P[i, 3] -= p0 * k_x[3] + p1 * k_y[3]
        for j in range(4):
            P[i, j] += noise_x * k_x[j] + noise_y * k_y[j]
    for i in range(4):
        for j in range(i):
            P[i, j] = P[j, i] = (P[i, j] + P[j, i]) / 2


@callee
def _gain_column(P: Float, a: float, b: float) -> tuple[float, float, float, float]:
    """A column of K = P Hᵀ S⁻¹, (a, b) being that column of S⁻¹."""
    return (
        P[0, 0] * a + P[0, 1] * b,
        P[1, 0] * a + P[1, 1] * b,
        P[2, 0] * a + P[2, 1] * b,
        P[3, 0] * a + P[3, 1] * b,
    )


@callee
def mahalanobis2(dx_m: float, dy_m: float, a: float, b: float, d: float) -> float:
    """Mahalanobis distance d² = νᵀ S⁻¹ ν of ν = (dx, dy), S = (a, b; b, d)."""
    return (d * dx_m * dx_m - 2 * b * dx_m * dy_m + a * dy_m * dy_m) / (a * d - b * b)


# The update where a part of the errors is common: a split covariance intersection filter.
#
# Of the covariance P (4, 4) a part C, `common`, may be correlated in any way with the common part of the measurement,
# `share` · R; the rest of both is independent. With ω in (0, 1]: P₁ = C/ω + (P − C), R₁ = share · R/(1 − ω)
# + (1 − share) · R, K = P₁Hᵀ(HP₁Hᵀ + R₁)⁻¹, x ← x + Kν, P ← (1 − KH)P₁; the independent part becomes (1 − KH)(P −
# C)(1 − KH)ᵀ + K(1 − share)RKᵀ, the common part is the rest. ω is that of the least determinant of P, which is convex
# in it.
#
# Source: H. Li, F. Nashashibi, M. Yang, "Split covariance intersection filter: theory and its application to vehicle
# localization", IEEE T-ITS 14 (2013) 1860–1871.

_LEAST = 1e-6
"""ω is no smaller, and 1 − ω is 0 or no smaller: nearer to its ends the determinant no longer changes."""
_ROUNDS = 30
"""Golden sections: ω to .618³⁰ = 5e-7, where the determinant is flat."""
_GOLDEN = (math.sqrt(5) - 1) / 2


@callee
def update_split(state: Float, P: Float, common: Float, z: Float, share: float, grown: float) -> None:
    """Update a state by a position, in place. `z`: x, y, ee, en, nn; the independent part of R counts `grown` times.

    `grown`: from 1 to infinity, where the measurement tells nothing new but its common part.
    """
    own_share = (1.0 - share) * min(grown, 1e12)
    # The determinant is convex in ω: golden sections between its ends, which are then held against the best.
    low, high = _LEAST, 1.0 - _LEAST
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_left, at_right = (
        _updated_determinant(left, P, common, z, share, own_share),
        _updated_determinant(right, P, common, z, share, own_share),
    )
    for _ in range(_ROUNDS):
        if at_left <= at_right:
            high, right, at_right = right, left, at_left
            left = high - _GOLDEN * (high - low)
            at_left = _updated_determinant(left, P, common, z, share, own_share)
        else:
            low, left, at_left = left, right, at_right
            right = low + _GOLDEN * (high - low)
            at_right = _updated_determinant(right, P, common, z, share, own_share)
    omega = (low + high) / 2
    if omega >= 1.0 - 2.0 * _LEAST:  # the measurement would not help: it is left out
        return
    independent, inflated = np.empty((4, 4)), np.empty((4, 4))
    for i in range(4):
        for j in range(4):
            independent[i, j] = P[i, j] - common[i, j]
            inflated[i, j] = common[i, j] / omega + independent[i, j]
    scale = share / (1.0 - omega) + own_share
    gain = _split_gain(inflated, scale * z[2], scale * z[3], scale * z[4])
    update_state(state, inflated, z[0], z[1], scale * z[2], scale * z[3], scale * z[4])
    left_over = _update_covariance(independent, gain, own_share * z[2], own_share * z[3], own_share * z[4])
    for i in range(4):
        for j in range(4):
            P[i, j] = inflated[i, j]
            common[i, j] = inflated[i, j] - left_over[i, j]


@callee
def _updated_determinant(omega: float, P: Float, common: Float, z: Float, share: float, own_share: float) -> float:
    """The determinant of P after the update with weight ω: |P₁| |R₁| / |HP₁Hᵀ + R₁|, P₁ by blocks."""
    factor, scale = 1.0 / omega - 1.0, share / (1.0 - omega) + own_share
    a, b, d = P[0, 0] + factor * common[0, 0], P[0, 1] + factor * common[0, 1], P[1, 1] + factor * common[1, 1]
    det = a * d - b * b
    p, q = P[0, 2] + factor * common[0, 2], P[1, 2] + factor * common[1, 2]
    r, s = P[0, 3] + factor * common[0, 3], P[1, 3] + factor * common[1, 3]
    xx = P[2, 2] + factor * common[2, 2] - (d * p * p - 2.0 * b * p * q + a * q * q) / det
    xy = P[2, 3] + factor * common[2, 3] - (d * p * r - b * (p * s + q * r) + a * q * s) / det
    yy = P[3, 3] + factor * common[3, 3] - (d * r * r - 2.0 * b * r * s + a * s * s) / det
    ee, en, nn = scale * z[2], scale * z[3], scale * z[4]
    measured = (ee * nn - en * en) / ((a + ee) * (d + nn) - (b + en) * (b + en))
    return float(det * (xx * yy - xy * xy) * measured)


@callee
def _split_gain(inflated: Float, ee: float, en: float, nn: float) -> Float:
    """The gain K = P₁Hᵀ(HP₁Hᵀ + R₁)⁻¹, (4, 2), of P₁ `inflated` and R₁ = (ee, en; en, nn)."""
    a, b, d = inflated[0, 0] + ee, inflated[0, 1] + en, inflated[1, 1] + nn
    det = a * d - b * b
    gain = np.empty((4, 2))
    for i in range(4):
        gain[i, 0] = (inflated[i, 0] * d - inflated[i, 1] * b) / det
        gain[i, 1] = (inflated[i, 1] * a - inflated[i, 0] * b) / det
    return gain


@callee
def _update_covariance(independent: Float, gain: Float, ee: float, en: float, nn: float) -> Float:
    """(4, 4) covariance (1 − KH) N (1 − KH)ᵀ + K R Kᵀ, symmetric; N `independent`, K `gain`."""
    half, out = np.empty((4, 4)), np.empty((4, 4))
    for i in range(4):
        for j in range(4):
            half[i, j] = independent[i, j] - gain[i, 0] * independent[0, j] - gain[i, 1] * independent[1, j]
    for i in range(4):
        for j in range(i + 1):
            out[i, j] = half[i, j] - half[i, 0] * gain[j, 0] - half[i, 1] * gain[j, 1]
            out[i, j] += gain[i, 0] * (ee * gain[j, 0] + en * gain[j, 1])
            out[i, j] += gain[i, 1] * (en * gain[j, 0] + nn * gain[j, 1])
            out[j, i] = out[i, j]
    return out


# One run.

STALE, PREDICT, REPLAY = 0, 1, 2
"""Values of `TrackerRules.late`."""
ENTRIES_PER_LIST = 65536
"""Track ids: number of the founding list × this + place of the founding entry in it."""
SAME_OBJECT = 1.386
"""d² up to which two tracks can be of one object: the median of χ² with 2 degrees of freedom, so half of the pairs of
entries of one object are closer. docs/develop/decisions/fusion.md."""
_NOTHING_NEW = 1e12
"""An entry that counts as one of so many times its variance changes no state: it is left out."""
_LEAST_COST = 1e-6
"""By how much the worst pair within the gate is better than none: little beside the differences between pairs."""


class HeardLists(NamedTuple):
    """The lists of the units in one run; `rows[start[f] : start[f + 1]]`: the entries of list f in order of content."""

    start: Int  # (F + 1,)
    rows: Int  # (N,) indices into entries
    entries: Entries  # (N,)
    content: Float  # (N, D) the entries as numbers, without times and ids
    captured_s: Float  # (F,)
    unit_ix: Int  # (F,)


class TrackerRules(NamedTuple):
    """The settings of the tracker as numbers and arrays for the kernel."""

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
    keeps_s: Float  # (U,) for how long an object that a unit's messages leave out may be there: no claim fades before
    apart_s: float  # for so long after a list held two tracks they are two objects


@kernel
def track_run(
    unit_lists: HeardLists, rules: TrackerRules, so_far: StoredMemory, issue_s: Float, arrived: Int, arrived_start: Int
) -> tuple[Int, Entries, StoredMemory]:
    """Fused lists of one run at the next instants: where each begins (K + 1,), their entries, and the next state."""
    memory, before, received = recall_memory(so_far, unit_lists.captured_s)
    start, entries = np.zeros(len(issue_s) + 1, np.int64), np.zeros(256, ENTRY)
    for k in range(len(issue_s)):
        arriving = _order_by_capture(unit_lists, arrived[arrived_start[k] : arrived_start[k + 1]])
        if rules.late == REPLAY:
            memory, before, received = _replay_memory(memory, before, received, arriving, unit_lists, rules)
        else:
            for f in arriving:
                memory = _hear_list(memory, unit_lists, rules, f, issue_s[k])
            memory = _settle_tracks(memory, rules, issue_s[k])
        if start[k] + len(memory.tracks) > len(entries):
            grown = np.zeros(2 * (start[k] + len(memory.tracks)), ENTRY)
            grown[: start[k]] = entries[: start[k]]
            entries = grown
        start[k + 1] = start[k] + _publish_tracks(memory, rules, issue_s[k], entries[start[k] :])
    return start, entries[: start[-1]].copy(), store_memory(memory, before, received, unit_lists.captured_s)


@callee
def _replay_memory(
    memory: TrackerMemory,
    before: list[TrackerMemory],
    received: Int,
    arriving: Int,
    unit_lists: HeardLists,
    rules: TrackerRules,
) -> tuple[TrackerMemory, list[TrackerMemory], Int]:
    """The memory as if the lists `arriving` had been received at their captures, those before each, and these lists.
    Goes back to the memory before the first list that was captured no earlier than the oldest arriving one, and hears
    all from there on again.
    """
    if len(received):
        oldest_s = unit_lists.captured_s[received[-1]] - rules.buffer_s - SAME_INSTANT_S
        arriving = arriving[unit_lists.captured_s[arriving] >= oldest_s]
    if len(arriving) == 0:
        return memory, before, received
    first_again = len(received)
    while first_again > 0 and unit_lists.captured_s[received[first_again - 1]] >= unit_lists.captured_s[arriving[0]]:
        first_again -= 1
    while len(before) > first_again:
        memory = before.pop()
    replayed = _order_by_capture(unit_lists, np.concatenate((received[first_again:], arriving)))
    received = np.concatenate((received[:first_again], replayed))
    for k in range(len(replayed)):
        now_s = unit_lists.captured_s[replayed[k]]
        if k == 0 or unit_lists.captured_s[replayed[k - 1]] < now_s:
            saved = memory
            memory = TrackerMemory(saved.tracks.copy(), saved.claims.copy(), saved.together_s.copy())
        before.append(saved)
        memory = _hear_list(memory, unit_lists, rules, replayed[k], now_s)
        if k + 1 == len(replayed) or unit_lists.captured_s[replayed[k + 1]] > now_s:
            memory = _settle_tracks(memory, rules, now_s)
    skip = 0
    while unit_lists.captured_s[received[skip]] < unit_lists.captured_s[received[-1]] - rules.buffer_s - SAME_INSTANT_S:
        skip += 1
    return memory, before[skip:], received[skip:]


@callee
def _publish_tracks(memory: TrackerMemory, rules: TrackerRules, now_s: float, out: Entries) -> int:
    """Fills the front of `out` with the tracks that are published, predicted to `now_s`; returns their number."""
    state, P = np.empty(4), np.empty((4, 4))
    n = 0
    for j in range(len(memory.tracks)):
        track = memory.tracks[j]
        existence = _track_existence(memory.claims[j], rules, now_s)
        if not existence > rules.publish or track.last_s - track.first_s < rules.confirm_s - SAME_INSTANT_S:
            continue
        state[:], P[:] = track.state, track.P
        predict_state(state, P, max(now_s - track.at_s, 0.0), rules.q_m2ps3)
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


# One list.


@callee
def _hear_list(
    memory: TrackerMemory, unit_lists: HeardLists, rules: TrackerRules, f: int, now_s: float
) -> TrackerMemory:
    """The memory after list f, as of `now_s`: tracks are predicted to then, and updated or founded by its entries."""
    for track in memory.tracks:
        if track.at_s < now_s:
            predict_state(track.state, track.P, now_s - track.at_s, rules.q_m2ps3)
            if rules.common_share > 0.0:
                propagate_covariance(track.common, now_s - track.at_s)
            track.at_s = now_s
    claimed_s = now_s if rules.late == STALE else unit_lists.captured_s[f]
    z = _entry_positions(unit_lists, rules, f, now_s)
    rows = unit_lists.rows[unit_lists.start[f] : unit_lists.start[f + 1]]
    partner = _assign_entries(memory.tracks, unit_lists, rules, rows, z)
    count = len(memory.tracks)
    memory = _make_room(memory, int((partner < 0).sum()))
    for i in range(len(rows)):
        entry, x, y, ee, en, nn = (
            unit_lists.entries[rows[i]],
            z[i, 0],
            z[i, 1],
            z[i, 2],
            z[i, 3],
            z[i, 4],
        )
        if partner[i] >= 0:
            track = memory.tracks[partner[i]]
            # Errors of a unit about one object last: the entry counts as one with fresh errors of more variance.
            last_s = memory.claims[partner[i], unit_lists.unit_ix[f]].at_s
            grown = 1.0
            if rules.errors_last_s > 0.0 and last_s > -math.inf:
                grown = math.tanh(abs(claimed_s - last_s) / (2.0 * rules.errors_last_s))
                grown = 1.0 / grown if grown > 0.0 else math.inf
            if rules.common_share > 0.0:
                update_split(track.state, track.P, track.common, z[i], rules.common_share, grown)
            elif grown < _NOTHING_NEW:
                update_state(track.state, track.P, x, y, grown * ee, grown * en, grown * nn)
        else:
            partner[i] = count
            count += 1
            track = memory.tracks[partner[i]]
            _start_track(track, entry, x, y, ee, en, nn, rules)
            track.at_s, track.first_s, track.last_s = now_s, unit_lists.captured_s[f], unit_lists.captured_s[f]
            track.unit_ix, track.track_id = unit_lists.unit_ix[f], f * ENTRIES_PER_LIST + i
        track.ee, track.en, track.nn = ee, en, nn
        _describe_track(track, entry, unit_lists.captured_s[f])
        claim = memory.claims[partner[i], unit_lists.unit_ix[f]]
        if claimed_s >= claim.at_s:
            claim.existence, claim.at_s = entry.existence, claimed_s
    for j in partner:
        for k in partner:
            memory.together_s[j, k] = now_s
    return memory


@callee
def _entry_positions(unit_lists: HeardLists, rules: TrackerRules, f: int, now_s: float) -> Float:
    """(n, 5) position and covariance (x, y, ee, en, nn) of the entries of list f, predicted to `now_s` if set so."""
    rows = unit_lists.rows[unit_lists.start[f] : unit_lists.start[f + 1]]
    z = np.empty((len(rows), 5))
    age_of_information_s = max(now_s - unit_lists.captured_s[f], 0.0) if rules.late == PREDICT else 0.0
    added_m2 = rules.q_m2ps3 * age_of_information_s**3 / 3
    for i in range(len(rows)):
        entry = unit_lists.entries[rows[i]]
        z[i, 0], z[i, 1] = (
            entry.x_m + age_of_information_s * entry.vx_mps,
            entry.y_m + age_of_information_s * entry.vy_mps,
        )
        ee, en, nn = floor_eigenvalues(entry.cov_ee_m2, entry.cov_en_m2, entry.cov_nn_m2)
        z[i, 2], z[i, 3], z[i, 4] = ee + added_m2, en, nn + added_m2
    return z


@callee
def _assign_entries(tracks: NDArray[Any], unit_lists: HeardLists, rules: TrackerRules, rows: Int, z: Float) -> Int:
    """(n,) the track of each entry, −1: none. Least sum of d² + ln|S| over the pairs within the gate."""
    n, m = len(rows), len(tracks)
    partner = np.full(n, -1)
    if n == 0 or m == 0:
        return partner
    class_ix = np.empty(n, np.int64)
    for i in range(n):
        class_ix[i] = most_probable_class(unit_lists.entries[rows[i]].class_probability)
    row, col = np.empty(n * m, np.int64), np.empty(n * m, np.int64)
    cost, spread, pairs = np.empty(n * m), np.empty(n * m), 0
    for j in range(m):
        track = tracks[j]
        agree = rules.agree[track.class_ix]
        x, y, ee, en, nn = track.state[0], track.state[1], track.P[0, 0], track.P[0, 1], track.P[1, 1]
        for i in range(n):
            dx, dy = z[i, 0] - x, z[i, 1] - y
            a, b, d = z[i, 2] + ee, z[i, 3] + en, z[i, 4] + nn
            # No eigenvalue of S is above its trace.
            if dx * dx + dy * dy > rules.gate * (a + d) or not agree[class_ix[i]]:
                continue
            d2 = mahalanobis2(dx, dy, a, b, d)
            if d2 <= rules.gate:
                row[pairs], col[pairs], spread[pairs] = i, j, math.log(a * d - b * b)
                cost[pairs] = d2 + spread[pairs]
                pairs += 1
    row, col, cost, spread = row[:pairs], col[:pairs], cost[:pairs], spread[:pairs]
    # A row left alone costs 0: costs are shifted so that any pair within the gate is better than none.
    spread_component_maximum(row, col, spread, n, m)
    for p in range(pairs):
        cost[p] -= rules.gate + spread[p] + _LEAST_COST
    assign_pairs(row, col, cost, n, m, partner)
    return partner


@callee
def _make_room(memory: TrackerMemory, added: int) -> TrackerMemory:
    """The memory with `added` empty tracks at its end."""
    if added == 0:
        return memory
    n, units = memory.claims.shape
    tracks, claims = np.zeros(n + added, TRACK), np.zeros((n + added, units), CLAIM)
    together_s = np.full((n + added, n + added), -np.inf)
    for claim in claims[n:].flat:
        claim.at_s = -np.inf
    tracks[:n], claims[:n], together_s[:n, :n] = memory.tracks, memory.claims, memory.together_s
    return TrackerMemory(tracks, claims, together_s)


@callee
def _start_track(
    track: Any, entry: Any, x: float, y: float, ee: float, en: float, nn: float, rules: TrackerRules
) -> None:
    """Writes the state of a track that an entry founds; (x, y) and (ee, en; en, nn): its position as of now."""
    track.state[0], track.state[1], track.state[2], track.state[3] = x, y, entry.vx_mps, entry.vy_mps
    track.P[0, 0], track.P[0, 1], track.P[1, 0], track.P[1, 1] = ee, en, en, nn
    track.P[2, 2] = track.P[3, 3] = rules.speed_var_m2ps2
    for a in range(2):
        for b in range(2):
            track.common[a, b] = rules.common_share * track.P[a, b]


@callee
def _describe_track(track: Any, entry: Any, captured_s: float) -> None:
    """Adds to a track what the filter leaves out: size, heading, class; of equal captures the last is newest."""
    if captured_s >= track.last_s:
        track.z_m, track.yaw_rad = entry.z_m, entry.yaw_rad
    track.first_s, track.last_s = min(track.first_s, captured_s), max(track.last_s, captured_s)
    track.length_m += entry.length_m
    track.width_m += entry.width_m
    track.height_m += entry.height_m
    for c in range(len(CLASSES)):
        track.class_probability[c] += entry.class_probability[c]
    track.class_ix = most_probable_class(track.class_probability)
    track.count += 1


# Existence and ends of tracks.


@callee
def _track_existence(claims: NDArray[Any], rules: TrackerRules, now_s: float) -> float:
    """1 − Πᵤ (1 − cᵤ e^(−(now − tᵤ)/forget)) of one track, `claims (U,)`."""
    p_none = 1.0
    for u in range(len(claims)):
        claim = claims[u]
        if claim.existence > 0.0:
            faded_s = max(now_s - claim.at_s - rules.keeps_s[u], 0.0)
            p_none *= 1.0 - claim.existence * math.exp(-faded_s / rules.forget_s)
    return 1.0 - p_none


@callee
def _settle_tracks(memory: TrackerMemory, rules: TrackerRules, now_s: float) -> TrackerMemory:
    """The memory as of `now_s` without faded tracks, and without the younger of two tracks of one object."""
    n, units = memory.claims.shape
    keep = np.empty(n, np.bool_)
    for j in range(n):
        keep[j] = _track_existence(memory.claims[j], rules, now_s) > rules.drop
    for i in range(n):
        for j in range(i + 1, n):
            if keep[i] and keep[j] and _is_one_object(memory, rules, i, j, now_s):
                keep[_younger_track(memory.tracks, i, j)] = False
    survivors = np.flatnonzero(keep)
    if len(survivors) == n:
        return memory
    tracks, claims = np.empty(len(survivors), TRACK), np.empty((len(survivors), units), CLAIM)
    together_s = np.empty((len(survivors), len(survivors)))
    for a in range(len(survivors)):
        tracks[a], claims[a] = memory.tracks[survivors[a]], memory.claims[survivors[a]]
        together_s[a] = memory.together_s[survivors[a]][survivors]
    return TrackerMemory(tracks, claims, together_s)


@callee
def _is_one_object(memory: TrackerMemory, rules: TrackerRules, i: int, j: int, now_s: float) -> bool:
    """Whether tracks i and j are of one object: classes agree, no list held both of late, they are close enough."""
    a, b = memory.tracks[i], memory.tracks[j]
    dx, dy = a.state[0] - b.state[0], a.state[1] - b.state[1]
    # P alone will not do: two tracks that share the entries of one object keep apart, and their P shrinks.
    ee, nn = a.P[0, 0] + a.ee + b.P[0, 0] + b.ee, a.P[1, 1] + a.nn + b.P[1, 1] + b.nn
    if dx * dx + dy * dy > SAME_OBJECT * (ee + nn) or not rules.agree[a.class_ix, b.class_ix]:
        return False
    if memory.together_s[i, j] >= now_s - rules.apart_s:
        return False
    return mahalanobis2(dx, dy, ee, a.P[0, 1] + a.en + b.P[0, 1] + b.en, nn) <= SAME_OBJECT


@callee
def _younger_track(tracks: NDArray[Any], i: int, j: int) -> int:
    """Of tracks i < j the one with the later first capture, else with fewer entries, else founded later."""
    a, b = tracks[i], tracks[j]
    if a.first_s != b.first_s:
        return i if a.first_s > b.first_s else j
    return i if a.count < b.count else j


# An order of lists that depends on their content only.


@callee
def _comes_before(unit_lists: HeardLists, f: int, g: int) -> bool:
    """Whether list f comes before list g: by capture, then the longer one, then by content, then by unit."""
    if unit_lists.captured_s[f] != unit_lists.captured_s[g]:
        return bool(unit_lists.captured_s[f] < unit_lists.captured_s[g])
    n, m = unit_lists.start[f + 1] - unit_lists.start[f], unit_lists.start[g + 1] - unit_lists.start[g]
    if n != m:
        return bool(n > m)
    for k in range(n):
        order = compare_rows(
            unit_lists.content, unit_lists.rows[unit_lists.start[f] + k], unit_lists.rows[unit_lists.start[g] + k]
        )
        if order != 0:
            return bool(order < 0)
    # The lists are equal: their order only decides which unit is stated for the track.
    return bool(
        unit_lists.unit_ix[f] < unit_lists.unit_ix[g] or (unit_lists.unit_ix[f] == unit_lists.unit_ix[g] and f < g)
    )


@callee
def _order_by_capture(unit_lists: HeardLists, lists: Int) -> Int:
    """Lists ordered by capture, of equal ones those with more entries first, then by content."""
    lists = lists.copy()
    for k in range(1, len(lists)):
        f, place = lists[k], k
        while place > 0 and _comes_before(unit_lists, f, lists[place - 1]):
            lists[place] = lists[place - 1]
            place -= 1
        lists[place] = f
    return lists

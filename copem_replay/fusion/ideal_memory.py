"""Ideal fusion that remembers: of each object a constant-velocity Kalman filter over all its entries, by truth id.

What the ideal lists when is the same with memory and without; the states differ. Each is the estimate at the instant
of the list from all entries about the object that had been taken in by then, in the order of their captures, whenever
they came: an overtaken list counts as if it had come in time. The motion is that of the tracker (white acceleration);
the first entry gives the velocity, with an uncertainty of its own. Of objects that no list in use holds nothing is
listed. The other columns are those of the ideal without memory. Assumes errors as stated, independent between lists.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from copem_replay.core.compiled import callee, kernel
from copem_replay.core.tracks import SAME_INSTANT_S, Bool, Float, Int, Tracks
from copem_replay.fusion.ideal import floor_covariances
from copem_replay.fusion.interface import ConstantVelocity
from copem_replay.fusion.tracker_kernel import predict_state, update_state


def remember_states(received: Tracks, fused: Tracks, motion: ConstantVelocity) -> Tracks:
    """The fused lists with filtered positions and velocities, at the instants `arrives_s` of the lists.

    `received`: all lists of the log that `fused` is made of, whose arrival times all runs share.
    """
    arrives_s, issue_s = received.common_arrives_s, fused.common_arrives_s
    rows = np.flatnonzero(np.isin(received.row_object_ix, fused.object_ix) & np.isfinite(arrives_s)[received.frame_ix])
    taken_in = np.searchsorted(issue_s + SAME_INSTANT_S, arrives_s[received.frame_ix])
    keys = (received.row_unit_ix, received.row_captured_s, taken_in, received.row_object_ix)
    rows = rows[np.lexsort([key[rows] for key in keys])]
    first, after = (np.searchsorted(received.row_object_ix[rows], fused.object_ix, side) for side in ("left", "right"))
    states = (received.x_m, received.y_m, received.vx_mps, received.vy_mps, *floor_covariances(received))
    heard = _Heard(
        received.valid, np.stack(np.broadcast_arrays(*states)), received.row_captured_s, taken_in, rows, first, after
    )
    listed = _Listed(fused.valid, fused.start, fused.frame_ix, issue_s)
    out = np.full((8, *fused.valid.shape), np.nan)
    _filter_objects(heard, listed, motion.acceleration_psd_m2ps3, motion.speed_sigma_mps**2, out)
    names = ("x_m", "y_m", "vx_mps", "vy_mps", "cov_ee_m2", "cov_en_m2", "cov_nn_m2", "speed_var_m2ps2")
    return replace(fused, **dict(zip(names, out, strict=True)))


class _Heard(NamedTuple):
    # Rows (P,) of units' lists; `rows[first[e] : after[e]]`: those about the object of track e, as they are taken in.
    valid: Bool  # (S, P)
    states: Float  # (7, S | 1, P) x, y, velocities, position covariance
    captured_s: Float
    taken_in: Int  # the number of the fused list
    rows: Int
    first: Int
    after: Int


class _Listed(NamedTuple):
    # Rows (Q,) of fused lists (K,), track by track.
    valid: Bool  # (S, Q)
    start: Int
    frame_ix: Int
    issue_s: Float


@kernel
def _filter_objects(heard: _Heard, listed: _Listed, q_m2ps3: float, speed_var_m2ps2: float, out: Float) -> None:
    """Fills `out (8, S, Q)` where an object is listed: x, y, vx, vy, position covariance, speed variance."""
    for e in range(len(heard.first)):
        most_rows = heard.after[e] - heard.first[e]
        sequence, states, P = np.empty(most_rows, np.int64), np.empty((most_rows, 4)), np.empty((most_rows, 4, 4))
        now, P_now = np.empty(4), np.empty((4, 4))
        for s in range(len(heard.valid)):
            n, i = 0, heard.first[e]
            for p in range(listed.start[e], listed.start[e + 1]):
                k, changed = listed.frame_ix[p], n
                while i < heard.after[e] and heard.taken_in[heard.rows[i]] <= k:
                    if heard.valid[s, heard.rows[i]]:
                        changed = min(changed, _insert(sequence, n, heard.rows[i], heard.captured_s))
                        n += 1
                    i += 1
                _filter(heard, s, sequence[:n], changed, q_m2ps3, speed_var_m2ps2, states, P)
                if n == 0 or not listed.valid[s, p]:
                    continue
                now[:], P_now[:] = states[n - 1], P[n - 1]
                predict_state(now, P_now, listed.issue_s[k] - heard.captured_s[sequence[n - 1]], q_m2ps3)
                for v in range(4):
                    out[v, s, p] = now[v]
                out[4, s, p], out[5, s, p], out[6, s, p] = P_now[0, 0], P_now[0, 1], P_now[1, 1]
                out[7, s, p] = (P_now[2, 2] + P_now[3, 3]) / 2


@callee
def _insert(sequence: Int, n: int, row: int, captured_s: Float) -> int:
    # Puts a row into the first n, which are in order of capture, after those of its own; the place.
    place = n
    while place > 0 and captured_s[sequence[place - 1]] > captured_s[row]:
        sequence[place] = sequence[place - 1]
        place -= 1
    sequence[place] = row
    return place


@callee
def _filter(
    heard: _Heard, s: int, sequence: Int, changed: int, q_m2ps3: float, speed_var_m2ps2: float, states: Float, P: Float
) -> None:
    """Fills `states`, P with the filter's state after each row of a sequence, from place `changed` on."""
    for j in range(changed, len(sequence)):
        r = sequence[j]
        x, y, vx, vy, ee, en, nn = heard.states[:, s if heard.states.shape[1] > 1 else 0, r]
        if j == 0:
            states[0, 0], states[0, 1], states[0, 2], states[0, 3] = x, y, vx, vy
            P[0] = 0.0
            P[0, 0, 0], P[0, 0, 1], P[0, 1, 0], P[0, 1, 1] = ee, en, en, nn
            P[0, 2, 2] = P[0, 3, 3] = speed_var_m2ps2
            continue
        states[j], P[j] = states[j - 1], P[j - 1]
        predict_state(states[j], P[j], heard.captured_s[r] - heard.captured_s[sequence[j - 1]], q_m2ps3)
        update_state(states[j], P[j], x, y, ee, en, nn)

"""Clusters that contradict each other about one object, joined and combined by covariance union.

Two clusters of one instant are one object in conflict where their classes agree, their boxes overlap, and no list has
an entry in both (a unit that lists two things says that they are two).
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np

from copem_replay.core.agree import most_probable
from copem_replay.core.object_list import Entries
from copem_replay.core.overlap import rotated_iou
from copem_replay.core.tracks import CLASSES, Bool, Float, Int
from copem_replay.fusion.covariance_union import covariance_union
from copem_replay.fusion.gnn_kernel import POINT, Clusters, join, write_entry


@nb.njit(cache=True, nogil=True)
def unite(
    clusters: Clusters, fused: Entries, entries: Entries, arrives_s: Float, agree: Bool, gate: float
) -> tuple[Clusters, Entries]:
    """The clusters and what each says, those in conflict joined. `gate`: d² beyond which a member contradicts.

    Cluster after cluster joins the earlier one, as founded, whose box overlaps its own most. The members are taken in
    one after the other as they stand: within the gate of what is held so far by inverse variance, else by union.
    """
    instants = len(clusters.start) - 1
    host = _hosts(clusters, fused, agree)
    start, begin = np.zeros(instants + 1, np.int64), np.zeros(len(fused) + 1, np.int64)
    member, out = np.empty_like(clusters.member), np.empty(len(fused), entries.dtype)
    state, class_sum = np.empty(1, POINT), np.empty(len(CLASSES))
    made = filled = 0
    for k in range(instants):
        for c in range(clusters.start[k], clusters.start[k + 1]):
            if host[c] != c:
                continue
            for other in range(c, clusters.start[k + 1]):
                if host[other] == c:
                    for m in clusters.member[clusters.begin[other] : clusters.begin[other + 1]]:
                        member[filled] = m
                        filled += 1
            begin[made + 1] = filled
            members = member[begin[made] : filled]
            class_sum[:] = 0.0
            for i in range(len(members)):
                point = clusters.points[members[i]]
                if i == 0:
                    state[0] = point
                else:
                    _take_in(state[0], point, gate)
                for h in range(len(CLASSES)):
                    class_sum[h] += entries[point.row].class_probability[h]
            write_entry(out[made], state[0], class_sum, members, clusters.points, entries, arrives_s)
            made += 1
        start[k + 1] = made
    return Clusters(start, begin[: made + 1], member, clusters.points), out[:made]


@nb.njit(cache=True, nogil=True)
def _hosts(clusters: Clusters, fused: Entries, agree: Bool) -> Int:
    """The cluster that each becomes part of (itself: of none)."""
    host, kind = np.arange(len(fused)), np.empty(len(fused), np.int64)
    for c in range(len(fused)):
        kind[c] = most_probable(fused[c].class_probability)
    for k in range(len(clusters.start) - 1):
        first = clusters.start[k]
        for c in range(first, clusters.start[k + 1]):
            most, a = 0.0, fused[c]
            for other in range(first, c):
                b = fused[other]
                reach = np.hypot(a.length_m, a.width_m) / 2 + np.hypot(b.length_m, b.width_m) / 2
                apart = (a.x_m - b.x_m) ** 2 + (a.y_m - b.y_m) ** 2
                if host[other] != other or apart > reach * reach or not agree[kind[c], kind[other]]:
                    continue
                overlap = rotated_iou(
                    a.x_m, a.y_m, a.yaw_rad, a.length_m, a.width_m, b.x_m, b.y_m, b.yaw_rad, b.length_m, b.width_m
                )
                if overlap > most and not _share_a_list(clusters, host, c, other, first):
                    most = overlap
                    host[c] = other
    return host


@nb.njit(cache=True, nogil=True)
def _share_a_list(clusters: Clusters, host: Int, c: int, into: int, first: int) -> bool:
    """Whether a list has an entry in cluster c and in any that is part of `into`."""
    for other in range(first, c):
        if host[other] != into:
            continue
        for m in clusters.member[clusters.begin[other] : clusters.begin[other + 1]]:
            for n in clusters.member[clusters.begin[c] : clusters.begin[c + 1]]:
                if clusters.points[m].list == clusters.points[n].list:
                    return True
    return False


@nb.njit(cache=True, nogil=True)
def _take_in(state: Any, point: Any, gate: float) -> None:
    """A member into the state so far."""
    ee, en, nn = state.ee + point.ee, state.en + point.en, state.nn + point.nn
    dx, dy = point.x_m - state.x_m, point.y_m - state.y_m
    if nn * dx * dx - 2 * en * dx * dy + ee * dy * dy <= gate * (ee * nn - en * en):
        join(state, point, True)
        return
    a, b = np.array([state.x_m, state.y_m]), np.array([point.x_m, point.y_m])
    A = np.array([[state.ee, state.en], [state.en, state.nn]])
    mean, P = covariance_union(a, A, b, np.array([[point.ee, point.en], [point.en, point.nn]]))
    state.x_m, state.y_m = mean[0], mean[1]
    state.ee, state.en, state.nn = P[0, 0], P[0, 1], P[1, 1]

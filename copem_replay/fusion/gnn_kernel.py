"""The compiled kernel of global nearest neighbour fusion: entries in clusters, and the entry of each cluster.

The entries of every list are brought into an order that depends on their content only, once per run. At an instant the
lists are taken up one after the other (fusion/gnn.py says by which rules); candidates for pairs are found by sweeping
entries and clusters in the order of x, in windows as wide as the gate can reach.

Letters: N entries of one run, F lists, K instants, U units, C classes, M entries of the lists that count.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.assignment import assign_pairs, spread_component_maximum
from copem_replay.core.compiled import callee, kernel
from copem_replay.core.object_list import Entries, most_probable_class
from copem_replay.core.tracks import CLASSES, Bool, Float, Int
from copem_replay.fusion.covariance import covariance_intersection, fast_covariance_intersection, floor_eigenvalues
from copem_replay.fusion.inputs import WIDTH, compare_rows, sort_rows

_OPPOSED = 1e-9
"""Yaws whose mean vector is shorter than this cancel out: what is left is rounding."""
_SURPLUS = 1e-9
"""By how much the dearest allowed pair beats none; any positive number does."""

POINT = np.dtype(
    [
        ("x_m", "f8"), ("y_m", "f8"), ("ee", "f8"), ("en", "f8"), ("nn", "f8"),  # position, covariance in m²
        ("kind", "i8"),  # most probable class
        ("row", "i8"), ("list", "i8"),  # which entry it is, of which list; a cluster: its founder
    ]
)  # fmt: skip
"""What association uses of an entry, or of a cluster so far."""

Points = NDArray[Any]


class EntryClusters(NamedTuple):
    """The clusters of each instant in one run, each with its entries."""

    start: Int  # (K + 1,) where the clusters of each instant begin
    begin: Int  # (clusters + 1,) where the members of each begin
    member: Int  # into `points`
    points: Points  # (M,)


@kernel
def cluster_run(
    entries: Entries, numbers: Float, bounds: Int, captured_s: Float, arrives_s: Float, newest: Int,
    agree: Bool, gate: float, informed: bool, min_existence: float,
) -> tuple[EntryClusters, Entries]:  # fmt: skip
    """The clusters of one run, and the entry of each if its members are independent.

    `entries (N,)`, `numbers`: the entries as rows of numbers, list f between `bounds[f]` and `bounds[f + 1]` (F + 1,);
    `newest (K, U)`; `agree (C, C)`; `gate`: largest squared Mahalanobis distance of a pair; `informed`: the clusters'
    running states sum information, else they intersect pairwise.
    """
    content = numbers[:, :WIDTH]
    points, first = _collect_points(entries, content, bounds, newest, min_existence)
    instants, units = newest.shape
    most = total = 0
    for k in range(instants):
        here = 0
        for f in newest[k]:
            here += first[f + 1] - first[f] if f >= 0 else 0
        most, total = max(most, here), total + here
    states, class_sum = np.empty(most, POINT), np.empty((most, len(CLASSES)))
    by_x, partner, claimed = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most, np.int64)
    row, col = np.empty(most + 64, np.int64), np.empty(most + 64, np.int64)
    cost, spread = np.empty(most + 64), np.empty(most + 64)
    lists, joining = np.empty(units, np.int64), np.empty(most, np.int64)
    start, begin = np.zeros(instants + 1, np.int64), np.zeros(total + 1, np.int64)
    member, fused = np.empty(total, np.int64), np.empty(most, entries.dtype)
    for k in range(instants):
        count = joined = 0
        for q in range(_order_lists(newest[k], captured_s, arrives_s, points, first, content, lists)):
            a = first[lists[q]]
            entering = points[a : first[lists[q] + 1]]
            row, col, cost, spread, pairs = _find_allowed_pairs(
                entering, states, by_x[:count], agree, gate, row, col, cost, spread
            )
            assign_pairs(row[:pairs], col[:pairs], cost[:pairs], len(entering), count, partner)
            for i in range(len(entering)):
                c, point = partner[i], entering[i]
                if c < 0:
                    c = by_x[count] = count
                    states[c], class_sum[c] = point, 0.0
                    count += 1
                else:
                    join_entry(states[c], point, informed)
                for h in range(len(CLASSES)):
                    class_sum[c, h] += entries[point.row].class_probability[h]
                if states[c].kind != point.kind:
                    states[c].kind = most_probable_class(class_sum[c])
                joining[joined], claimed[joined] = a + i, c
                joined += 1
            _sort_by_x(states, by_x[:count])
        s = start[k]
        start[k + 1] = s + count
        _group_members(joining[:joined], claimed[:joined], member, begin[s : s + count + 1])
        fused = _lengthen_entries(fused, s, s + count)
        for c in range(count):
            members = member[begin[s + c] : begin[s + c + 1]]
            write_entry(fused[s + c], states[c], class_sum[c], members, points, entries, arrives_s)
    cluster_count = start[instants]
    return EntryClusters(start, begin[: cluster_count + 1], member, points), fused[:cluster_count]


@kernel
def intersect_clusters(clusters: EntryClusters, by_determinant: bool, fast: bool, fused: Entries) -> None:
    """Positions and covariances of the clusters by covariance intersection of all members at once, in place."""
    for c in range(len(fused)):
        members = clusters.member[clusters.begin[c] : clusters.begin[c + 1]]
        x, cov = np.empty((len(members), 2)), np.empty((len(members), 2, 2))
        for i in range(len(members)):
            point = clusters.points[members[i]]
            x[i, 0], x[i, 1] = point.x_m, point.y_m
            cov[i, 0, 0], cov[i, 0, 1], cov[i, 1, 0], cov[i, 1, 1] = point.ee, point.en, point.en, point.nn
        if fast:
            mean, P, _ = fast_covariance_intersection(x, cov, True)
        else:
            mean, P, _ = covariance_intersection(x, cov, by_determinant)
        fused[c].x_m, fused[c].y_m = mean[0], mean[1]
        fused[c].cov_ee_m2, fused[c].cov_en_m2, fused[c].cov_nn_m2 = P[0, 0], P[0, 1], P[1, 1]


@callee
def _collect_points(
    entries: Entries, content: Float, bounds: Int, newest: Int, min_existence: float
) -> tuple[Points, Int]:
    """Entries that count (M,), by list and in each by content, and (F + 1,) where each list begins."""
    needed = np.zeros(len(bounds) - 1, np.bool_)
    for frame in newest.flat:
        if frame >= 0:
            needed[frame] = True
    first, rows = np.zeros(len(bounds), np.int64), np.empty(len(entries), np.int64)
    n = 0
    for f in range(len(bounds) - 1):
        for r in range(bounds[f], bounds[f + 1]):
            if needed[f] and entries[r].existence >= min_existence:
                rows[n] = r
                n += 1
        first[f + 1] = n
        sort_rows(content, rows[first[f] : n])
    points = np.empty(n, POINT)
    for f in range(len(bounds) - 1):
        for i in range(first[f], first[f + 1]):
            point, entry = points[i], entries[rows[i]]
            point.x_m, point.y_m = entry.x_m, entry.y_m
            point.ee, point.en, point.nn = floor_eigenvalues(entry.cov_ee_m2, entry.cov_en_m2, entry.cov_nn_m2)
            point.kind = most_probable_class(entry.class_probability)
            point.row, point.list = rows[i], f
    return points, first


@callee
def _order_lists(
    newest: Int, captured_s: Float, arrives_s: Float, points: Points, first: Int, content: Float, lists: Int
) -> int:
    """Fills `lists` with lists that count, newest capture first, then longest, then by content; returns how many."""
    n = 0
    for f in newest:
        if f < 0 or first[f] == first[f + 1]:
            continue
        place = n
        while place > 0 and _list_before(f, lists[place - 1], captured_s, arrives_s, points, first, content):
            lists[place] = lists[place - 1]
            place -= 1
        lists[place] = f
        n += 1
    return n


@callee
def _list_before(
    f: Any, g: Any, captured_s: Float, arrives_s: Float, points: Points, first: Int, content: Float
) -> bool:
    """Whether list f comes before list g: by newer capture, then more entries, then content, then arrival."""
    if captured_s[f] != captured_s[g]:
        return bool(captured_s[f] > captured_s[g])
    n, m = first[f + 1] - first[f], first[g + 1] - first[g]
    if n != m:
        return bool(n > m)
    for i in range(n):
        order = compare_rows(content, points[first[f] + i].row, points[first[g] + i].row)
        if order != 0:
            return order < 0
    return bool(arrives_s[f] < arrives_s[g])


# Association.


@callee
def _find_allowed_pairs(
    new: Points, clusters: Points, by_x: Int, agree: Bool, gate: float, row: Int, col: Int, cost: Float, spread: Float
) -> tuple[Int, Int, Float, Float, int]:
    """Pairs within the gate whose classes agree: entry, cluster, cost below 0, largest ln|S| of the component. The
    arrays returned are those handed in, or longer ones. The last number is how many pairs there are.
    """
    n = low = 0
    widest = 0.0
    for c in by_x:
        widest = max(widest, clusters[c].ee)
    for i in range(len(new)):
        entry = new[i]
        reach = np.sqrt(gate * (widest + entry.ee))
        # The window of a later entry may begin further left where its covariance is larger.
        while low > 0 and clusters[by_x[low - 1]].x_m >= entry.x_m - reach:
            low -= 1
        while low < len(by_x) and clusters[by_x[low]].x_m < entry.x_m - reach:
            low += 1
        for p in range(low, len(by_x)):
            cluster = clusters[by_x[p]]
            dx, dy = cluster.x_m - entry.x_m, cluster.y_m - entry.y_m
            if dx > reach:
                break
            ee, en, nn = cluster.ee + entry.ee, cluster.en + entry.en, cluster.nn + entry.nn
            if dy * dy > gate * nn or not agree[cluster.kind, entry.kind]:
                continue
            det = ee * nn - en * en
            d2 = (nn * dx * dx - 2 * en * dx * dy + ee * dy * dy) / det
            if d2 > gate:
                continue
            if n == len(row):
                row, col = np.append(row, row), np.append(col, col)
                cost, spread = np.append(cost, cost), np.append(spread, spread)
            volume = np.log(det)
            row[n], col[n], cost[n], spread[n] = i, by_x[p], d2 + volume, volume
            n += 1
    spread_component_maximum(row[:n], col[:n], spread[:n], len(new), len(by_x))
    for p in range(n):
        cost[p] -= gate + spread[p] + _SURPLUS
    return row, col, cost, spread, n


@callee
def join_entry(cluster: Any, entry: Any, informed: bool) -> None:
    """Add an entry to a cluster's running state: P⁻¹ = αA⁻¹ + βB⁻¹, x = a + PβB⁻¹(b − a).

    α = β = 1, or in proportion to 1/tr A, 1/tr B with sum 1.
    """
    alpha = beta = 1.0
    if not informed:
        spread, other = cluster.ee + cluster.nn, entry.ee + entry.nn
        alpha, beta = other / (spread + other), spread / (spread + other)
    a, b = alpha / (cluster.ee * cluster.nn - cluster.en**2), beta / (entry.ee * entry.nn - entry.en**2)
    b_ee, b_en, b_nn = b * entry.nn, -b * entry.en, b * entry.ee
    ee, en, nn = a * cluster.nn + b_ee, -a * cluster.en + b_en, a * cluster.ee + b_nn
    det = ee * nn - en * en
    cluster.ee, cluster.en, cluster.nn = nn / det, -en / det, ee / det
    dx, dy = entry.x_m - cluster.x_m, entry.y_m - cluster.y_m
    u, v = b_ee * dx + b_en * dy, b_en * dx + b_nn * dy
    cluster.x_m += cluster.ee * u + cluster.en * v
    cluster.y_m += cluster.en * u + cluster.nn * v


@callee
def _sort_by_x(clusters: Points, by_x: Int) -> None:
    """Sorts the clusters `by_x`, in place, by insertion: little has moved since the last time."""
    for p in range(1, len(by_x)):
        c, place = by_x[p], p
        while place > 0 and clusters[by_x[place - 1]].x_m > clusters[c].x_m:
            by_x[place] = by_x[place - 1]
            place -= 1
        by_x[place] = c


@callee
def _group_members(joining: Int, claimed: Int, member: Int, begin: Int) -> None:
    """Fills `member` with the entries `joining`, those of cluster c from `begin[c]` on; `begin[0]` is set before."""
    count = len(begin) - 1
    for c in range(count):
        begin[c + 1] = 0
    for c in claimed:
        begin[c + 1] += 1
    for c in range(count):
        begin[c + 1] += begin[c]
    fill = begin.copy()
    for p in range(len(claimed)):
        member[fill[claimed[p]]] = joining[p]
        fill[claimed[p]] += 1


@callee
def _lengthen_entries(entries: Entries, used: int, needed: int) -> Entries:
    """The entries, copied where there is no room for `needed` of them; the first `used` are kept."""
    if needed <= len(entries):
        return entries
    longer = np.empty(2 * needed, entries.dtype)
    for i in range(used):
        longer[i] = entries[i]
    return longer


# The entry of a cluster.


@callee
def write_entry(
    out: Any, state: Any, class_sum: Float, members: Int, points: Points, entries: Entries, arrives_s: Float
) -> None:
    """Write the fused entry of a cluster, with the position of its running state."""
    out.x_m, out.y_m = state.x_m, state.y_m
    out.cov_ee_m2, out.cov_en_m2, out.cov_nn_m2 = state.ee, state.en, state.nn
    total = sin = cos = z = vx = vy = length = width = height = 0.0
    no_object, newest_s, earliest_s = 1.0, -np.inf, np.inf
    out.unit_ix = -1
    for i in members:
        point = points[i]
        entry = entries[point.row]
        w = 1 / (point.ee + point.nn)
        total += w
        sin, cos = sin + w * np.sin(entry.yaw_rad), cos + w * np.cos(entry.yaw_rad)
        z, vx, vy = z + w * entry.z_m, vx + w * entry.vx_mps, vy + w * entry.vy_mps
        length, width, height = length + w * entry.length_m, width + w * entry.width_m, height + w * entry.height_m
        no_object *= 1 - entry.existence
        newest_s = max(newest_s, entry.captured_s)
        at_s = arrives_s[point.list]
        if at_s < earliest_s or (at_s == earliest_s and entry.unit_ix < out.unit_ix):
            earliest_s = at_s
            out.unit_ix = entry.unit_ix
    out.z_m, out.vx_mps, out.vy_mps = z / total, vx / total, vy / total
    out.length_m, out.width_m, out.height_m = length / total, width / total, height / total
    opposed = sin * sin + cos * cos < (_OPPOSED * total) ** 2
    yaw_rad = entries[points[members[0]].row].yaw_rad
    out.yaw_rad = np.arctan2(np.sin(yaw_rad), np.cos(yaw_rad)) if opposed else np.arctan2(sin, cos)
    out.existence = 1 - no_object
    for h in range(len(CLASSES)):
        out.class_probability[h] = class_sum[h] / len(members)
    out.captured_s, out.track_id = newest_s, -1

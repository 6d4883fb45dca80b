"""Optimal assignment where most pairs are ruled out: the pairs of least total cost, no row and no column twice.

A row or column left alone costs 0, so a pair of cost 0 or more is never chosen: callers take the price of leaving both
alone off the cost of each pair. The price may differ between connected components of the pairs, which do not compete:
`spread_component_maximum` gives each component its own. A row and a column that are each other's only choice are
settled at once; the rest is solved row after row by shortest augmenting paths over the allowed pairs, which never leave
the row's connected component. Every row has, beside its pairs, a way out of its own at cost 0.

Ties: of equally good assignments one is chosen by the indices alone, whatever the order of the pairs. Rows enter in
their order, and one with which the total would not fall stays alone; of columns that are worth as much to it, a row
takes one that is free, then the first.

Letters: n rows, m columns, P pairs. Costs are finite, +inf or NaN (as +inf); indices are not checked.

Source: R. Jonker, A. Volgenant, "A shortest augmenting path algorithm for dense and sparse linear assignment
problems", Computing 38 (1987) 325–340; D. F. Crouse, "On implementing 2D rectangular assignment algorithms", IEEE
Trans. Aerosp. Electron. Syst. 52 (2016) 1679–1696.
"""

from __future__ import annotations

import numpy as np

from copem_replay.core.compiled import callee, kernel, making
from copem_replay.core.tracks import Float, Int


@kernel
def assign(cost: Float, partner: Int) -> None:
    """Optimal assignment of a matrix `cost (n, m)`; +inf: not allowed.

    Out: `partner (n,)`, the column of each row, −1: left alone.
    """
    n, m = cost.shape
    allowed = 0
    for i in range(n):
        for j in range(m):
            if cost[i, j] < 0.0:
                allowed += 1
    row, col, pair_cost = np.empty(allowed, np.int64), np.empty(allowed, np.int64), np.empty(allowed)
    k = 0
    for i in range(n):
        for j in range(m):
            if cost[i, j] < 0.0:
                row[k], col[k], pair_cost[k] = i, j, cost[i, j]
                k += 1
    assign_pairs(row, col, pair_cost, n, m, partner)


@making
def assign_pairs(row: Int, col: Int, cost: Float, n: int, m: int, partner: Int) -> None:
    """Optimal assignment of the pairs `row, col, cost (P,)`, in any order; of a pair given twice the cheaper counts.

    Out: `partner (n,)`, the column of each row, −1: left alone.
    """
    partner[:n] = -1
    of_row, of_col = np.zeros(n, np.int64), np.zeros(m, np.int64)
    for k in range(len(cost)):
        if cost[k] < 0.0:
            of_row[row[k]] += 1
            of_col[col[k]] += 1
    contested = 0
    for k in range(len(cost)):
        if cost[k] < 0.0:
            if of_row[row[k]] == 1 and of_col[col[k]] == 1:
                partner[row[k]] = col[k]
                of_row[row[k]] = 0
            else:
                contested += 1
    if contested == 0:
        return
    start, fill = np.zeros(n + 1, np.int64), np.empty(n, np.int64)
    for i in range(n):
        fill[i] = start[i]
        start[i + 1] = start[i] + of_row[i]
    choice, price = np.empty(contested, np.int64), np.empty(contested)
    for k in range(len(cost)):
        i = row[k]
        if cost[k] < 0.0 and of_row[i] > 0:
            choice[fill[i]], price[fill[i]] = col[k], cost[k]
            fill[i] += 1
    _augment_rows(start, choice, price, n, m, partner)


@callee
def spread_component_maximum(row: Int, col: Int, value: Float, n: int, m: int) -> None:
    """Replace each `value (P,)` by the largest of its pair's connected component."""
    parent, top = np.empty(n, np.int64), np.empty(n)
    for i in range(n):
        parent[i], top[i] = i, -np.inf
    of_col = np.full(m, -1)  # a row of the component of each column
    for k in range(len(value)):
        i, j = _find_root(parent, row[k]), col[k]
        if of_col[j] >= 0:
            other = _find_root(parent, of_col[j])
            if other != i:
                parent[other] = i
                if top[other] > top[i]:
                    top[i] = top[other]
        of_col[j] = i
        if value[k] > top[i]:
            top[i] = value[k]
    for k in range(len(value)):
        value[k] = top[_find_root(parent, row[k])]


@callee
def _find_root(parent: Int, i: int) -> int:
    """The row that stands for the component of row i; the way there gets shorter."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@making
def _augment_rows(start: Int, choice: Int, price: Float, n: int, m: int, partner: Int) -> None:
    """Enters row after row: the pairs of row i are `choice, price[start[i] : start[i + 1]]`; rows without are left.

    Duals u, v: price − u − v ≥ 0 for every pair of the rows entered so far, = 0 for the chosen; v ≤ 0, u ≤ 0.
    """
    u, v = np.zeros(n), np.zeros(m)
    owner = np.full(m, -1)
    length = np.full(m, np.inf)  # of the shortest path to a column so far; −inf: settled
    before = np.empty(m, np.int64)  # the row from which that path comes
    columns, settled_length = (
        np.empty(m, np.int64),
        np.empty(m),
    )  # columns seen, the settled ones first, with their lengths
    for new in range(n):
        if start[new] == start[new + 1]:
            continue
        n_settled = count = 0
        i, free, reached, out, leaving = new, -1, 0.0, np.inf, new
        while True:
            # Strictly: no row gives way to a newcomer with which the total does not fall.
            if reached - u[i] < out:
                out, leaving = reached - u[i], i
            offset = reached - u[i]
            for k in range(start[i], start[i + 1]):
                j = choice[k]
                path = offset + (price[k] - v[j])
                if path < length[j]:
                    if length[j] == np.inf:
                        columns[count] = j
                        count += 1
                    length[j], before[j] = path, i
            if n_settled == count:
                break
            best, j, shortest = n_settled, -1, np.inf
            for q in range(n_settled, count):
                c = columns[q]
                path = length[c]
                if path < shortest or (
                    path == shortest and (owner[c] < 0, -c) > (owner[j] < 0, -j)  # a free one first
                ):
                    best, j, shortest = q, c, path
            if shortest >= out:
                break
            columns[best], columns[n_settled] = columns[n_settled], j
            reached = settled_length[n_settled] = shortest
            length[j] = -np.inf
            n_settled += 1
            if owner[j] < 0:
                free = j
                break
            i = owner[j]
        end = reached if free >= 0 else out
        u[new] = end
        for q in range(n_settled):
            j = columns[q]
            if owner[j] >= 0:
                u[owner[j]] += end - settled_length[q]
                v[j] -= end - settled_length[q]
        for q in range(count):
            length[columns[q]] = np.inf
        # Along the path every row hands its column on to the row before.
        j = free
        if free < 0:
            j = partner[leaving]
            partner[leaving] = -1
        while j >= 0:
            i = before[j]
            owner[j], partner[i], j = i, j, partner[i]

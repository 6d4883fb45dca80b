"""The compiled kernel of `metrics/detection/by_match.py`: at which existence each object is known, look by look."""

from __future__ import annotations

from typing import Any, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from copem_replay.core.object_list import Entries
from copem_replay.core.tracks import Float, Int
from copem_replay.metrics.matching import DUPLICATE, MATCH

HELD = np.dtype([("run_ix", "i8"), ("look_ix", "i8"), ("capture", "i8"), ("existence", "f8")])
"""With which existence, the highest there was, a capture holds the object of a look."""


class Matched(NamedTuple):
    """Lists of S runs and what their entries are about, as `Lists` and `Matches`. `issue_s (K,)`: when available."""

    start: Int  # (S, K + 1)
    entries: Entries  # (N,)
    object_ix: Int  # (N,)
    role: NDArray[np.int8]  # (N,)
    issue_s: Float  # (K,)


class Stays(NamedTuple):
    """Looks by object, −1: none, and from which capture until which list each counts."""

    look_of: Int  # (C,)
    not_before_s: Float  # (M,)
    until_s: Float  # (M,)


@nb.njit(cache=True, nogil=True)
def levels(
    lists: Matched, stays: Stays, source: Int, group: Int, hits: int, of: int, best: Float, held: NDArray[Any],
    level: Float,
) -> NDArray[Any]:  # fmt: skip
    """At each entry that makes an object known at a higher existence than before: that existence, in `level (N,)`.

    `source (N, 2)`: captures an entry goes back to, −1: none; `group` says of each capture whose it is, (captures,).
    Carried over: `best (S, M)`, the existence at which each is known; `held`, by run and look, which is given back as
    it is after these lists. A capture that holds an object no more surely than it is known makes it no surer: whatever
    it would confirm, the same number of hits has confirmed already.
    """
    start, entries, role = lists.start, lists.entries, lists.role
    S, M = best.shape
    most = 0
    for s in range(S):
        most = max(most, start[s, -1] - start[s, 0])
    look, first = np.empty(most, np.int64), np.empty(M + 1, np.int64)
    row, number = np.empty(most, np.int64), np.empty(most, np.int64)
    holds = np.full(len(group) if hits > 1 else 0, -np.inf)  # by capture, of the look at hand
    used = np.empty(len(held) + 2 * most if hits > 1 else 0, np.int64)
    within = np.empty(of)
    left, kept, h = np.empty(len(held), HELD), 0, 0
    for s in range(S):
        _by_look(s, lists, stays, look, first, row, number)
        for m in range(M):
            n = 0
            while h < len(held) and held[h].run_ix == s and held[h].look_ix == m:
                used[n] = held[h].capture
                holds[used[n]] = held[h].existence
                n += 1
                h += 1
            at = first[m]
            while at < first[m + 1]:
                # What one list says of the object, and the entry that stands for it.
                k, standing, reached = number[at], row[at], -np.inf
                while at < first[m + 1] and number[at] == k:
                    i = row[at]
                    at += 1
                    if _stands_before(entries, role, i, standing):
                        standing = i
                    existence = entries[i].existence
                    if hits == 1:
                        reached = max(reached, existence)
                        continue
                    for c in source[i]:
                        if c < 0 or existence <= max(holds[c], best[s, m]):
                            continue
                        if holds[c] == -np.inf:
                            used[n] = c
                            n += 1
                        holds[c] = existence
                        reached = max(reached, _confirmed(holds, c, hits, of, group, within))
                if reached > best[s, m]:
                    best[s, m] = level[standing] = reached
            if kept + n > len(left):
                grown = np.empty(2 * (kept + n), HELD)
                grown[:kept] = left[:kept]
                left = grown
            for c in used[:n]:
                if holds[c] > best[s, m]:
                    one = left[kept]
                    one.run_ix, one.look_ix, one.capture, one.existence = s, m, c, holds[c]
                    kept += 1
                holds[c] = -np.inf
    return left[:kept].copy()


@nb.njit(cache=True, nogil=True)
def _by_look(s: int, lists: Matched, stays: Stays, look: Int, first: Int, row: Int, number: Int) -> None:
    # The entries of run s that count, look by look and in each list by list: `row`, and `number` of its list.
    start, entries, object_ix, role, issue_s = lists.start[s], lists.entries, lists.object_ix, lists.role, lists.issue_s
    look_of, not_before_s, until_s = stays.look_of, stays.not_before_s, stays.until_s
    first[:] = 0
    for k in range(len(issue_s)):
        for i in range(start[k], start[k + 1]):
            about = role[i] == MATCH or role[i] == DUPLICATE
            m = look_of[object_ix[i]] if about and object_ix[i] < len(look_of) else -1
            if m >= 0 and (issue_s[k] > until_s[m] or entries[i].captured_s < not_before_s[m]):
                m = -1
            look[i - start[0]] = m
            if m >= 0:
                first[m] += 1
    n = 0
    for m in range(len(first)):
        n, first[m] = n + first[m], n
    for k in range(len(issue_s)):
        for i in range(start[k], start[k + 1]):
            m = look[i - start[0]]
            if m >= 0:
                row[first[m]], number[first[m]] = i, k
                first[m] += 1
    # Each has gone on to where the next one begins.
    for m in range(len(first) - 1, 0, -1):
        first[m] = first[m - 1]
    first[0] = 0


@nb.njit(cache=True, nogil=True)
def _stands_before(entries: Entries, role: NDArray[np.int8], i: int, j: int) -> bool:
    # Of two entries about one object: the match, the surer, the newer, the first unit's.
    one, other = entries[i], entries[j]
    if role[i] != role[j]:
        return bool(role[i] < role[j])
    if one.existence != other.existence:
        return bool(one.existence > other.existence)
    if one.captured_s != other.captured_s:
        return bool(one.captured_s > other.captured_s)
    return bool(one.unit_ix < other.unit_ix)


@nb.njit(cache=True, nogil=True)
def _confirmed(existence: Float, at: int, hits: int, of: int, group: Int, held: Float) -> float:
    # With at most which existence do `hits` of some `of` consecutive captures of a group, this one among them, hold it?
    found = -np.inf
    for first in range(max(at - of + 1, 0), at + 1):
        n = 0
        for q in range(first, min(first + of, len(existence))):
            if group[q] == group[at] and existence[q] > -np.inf:
                held[n] = existence[q]
                n += 1
        if n >= hits:
            held[:n].sort()
            found = max(found, held[n - hits])
    return found

"""The compiled kernel of `metrics/detection/by_match.py`: the existence at which each object is known, by episode."""

from __future__ import annotations

from typing import Any, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from copem_replay.core.object_list import Entries
from copem_replay.core.tracks import Float, Int
from copem_replay.metrics.matching import DUPLICATE, MATCH

HELD = np.dtype([("run_ix", "i8"), ("episode_ix", "i8"), ("capture", "i8"), ("existence", "f8")])
"""With which existence, the highest there was, a capture holds the object of an episode."""


class Matched(NamedTuple):
    """Lists of S runs and their matches, as `ObjectLists` and `Matches`. `issue_s (K,)`: when available."""

    start: Int  # (S, K + 1)
    entries: Entries  # (N,)
    object_ix: Int  # (N,)
    role: NDArray[np.int8]  # (N,)
    issue_s: Float  # (K,)


class Stays(NamedTuple):
    """Episodes by object, −1: none, and from which capture until which list each counts."""

    episode_of: Int  # (C,)
    not_before_s: Float  # (M,)
    until_s: Float  # (M,)


@nb.njit(cache=True, nogil=True)
def levels(
    lists: Matched, stays: Stays, source: Int, group: Int, hits: int, of: int, best: Float, held: NDArray[Any],
    level: Float,
) -> NDArray[Any]:  # fmt: skip
    """At each entry that makes an object known at a higher existence than before: that existence, in `level (N,)`.

    `source (N, 2)`: captures an entry goes back to, −1: none; `group (captures,)`: whose capture each is.
    Carried over: `best (S, M)`, the existence at which each is known; `held`, by run and episode, given back as it
    is after these lists. A capture that holds an object no more surely than it is known makes it no surer: whatever
    it would confirm, the same number of hits has confirmed already.
    """
    start, entries, role = lists.start, lists.entries, lists.role
    S, M = best.shape
    most = 0
    for s in range(S):
        most = max(most, start[s, -1] - start[s, 0])
    episode, first = np.empty(most, np.int64), np.empty(M + 1, np.int64)
    row, number = np.empty(most, np.int64), np.empty(most, np.int64)
    holds = np.full(len(group) if hits > 1 else 0, -np.inf)  # by capture, of the episode at hand
    used = np.empty(len(held) + 2 * most if hits > 1 else 0, np.int64)
    within = np.empty(of)
    left, kept, h = np.empty(len(held), HELD), 0, 0
    for s in range(S):
        _by_episode(s, lists, stays, episode, first, row, number)
        for m in range(M):
            n = 0
            while h < len(held) and held[h].run_ix == s and held[h].episode_ix == m:
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
                    one.run_ix, one.episode_ix, one.capture, one.existence = s, m, c, holds[c]
                    kept += 1
                holds[c] = -np.inf
    return left[:kept].copy()


@nb.njit(cache=True, nogil=True)
def _by_episode(s: int, lists: Matched, stays: Stays, episode: Int, first: Int, row: Int, number: Int) -> None:
    # The entries of run s that count, episode by episode and in each list by list: `row`, and `number` of its list.
    start, entries, object_ix, role, issue_s = lists.start[s], lists.entries, lists.object_ix, lists.role, lists.issue_s
    episode_of, not_before_s, until_s = stays.episode_of, stays.not_before_s, stays.until_s
    first[:] = 0
    for k in range(len(issue_s)):
        for i in range(start[k], start[k + 1]):
            about = role[i] == MATCH or role[i] == DUPLICATE
            m = episode_of[object_ix[i]] if about and object_ix[i] < len(episode_of) else -1
            if m >= 0 and (issue_s[k] > until_s[m] or entries[i].captured_s < not_before_s[m]):
                m = -1
            episode[i - start[0]] = m
            if m >= 0:
                first[m] += 1
    n = 0
    for m in range(len(first)):
        n, first[m] = n + first[m], n
    for k in range(len(issue_s)):
        for i in range(start[k], start[k + 1]):
            m = episode[i - start[0]]
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

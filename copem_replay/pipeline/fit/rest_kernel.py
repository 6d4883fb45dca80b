"""Kernels of what else a unit gets wrong: a filter over classes that last, and links from list to list."""

from __future__ import annotations

import numba as nb
import numpy as np

from copem_replay.core.tracks import Bool, Float, Int


@nb.njit(cache=True)
def log_classes(shares: Float, listed: Int, decay: Float, new: Bool, share: float) -> float:
    """Logarithm of the probability of listed classes (n,), by probabilities (n, C) that are the same within a series.

    With probability `share` a list goes by the held uniform, of which the filter knows in whose cell it lies.
    """
    n, C = shares.shape
    cells, total = np.zeros(C), 0.0
    for t in range(n):
        f = 0.0 if new[t] else decay[t]
        at = listed[t]
        fresh = (1.0 - share) * shares[t, at]
        for k in range(C):
            cells[k] = f * cells[k] + (1.0 - f) * shares[t, k]
        probability = fresh + share * cells[at]
        for k in range(C):
            cells[k] *= (fresh + share if k == at else fresh) / probability
        total += np.log(probability)
    return total


@nb.njit(cache=True)
def linked(follows: Int, begin: Int, x_m: Float, y_m: Float, ids: Int, gate_m: float) -> Int:
    """(E,) the entry of the list before that each continues, −1: none. First by id, then the nearest within a gate.

    Entries lie list by list, those of list k from `begin[k]` on; `follows (L,)`: which list is before, −1: none.
    """
    out = np.full(len(x_m), -1)
    taken = np.zeros(len(x_m), dtype=np.bool_)
    for k in range(len(follows)):
        if follows[k] < 0:
            continue
        a, b = begin[follows[k]], begin[follows[k] + 1]
        for e in range(begin[k], begin[k + 1]):
            for p in range(a, b):
                if ids[e] >= 0 and ids[e] == ids[p] and not taken[p]:
                    out[e], taken[p] = p, True
                    break
        while True:
            best, one, other = gate_m * gate_m, -1, -1
            for e in range(begin[k], begin[k + 1]):
                if out[e] < 0:
                    for p in range(a, b):
                        far = (x_m[e] - x_m[p]) ** 2 + (y_m[e] - y_m[p]) ** 2
                        if not taken[p] and far < best:
                            best, one, other = far, e, p
            if one < 0:
                break
            out[one], taken[other] = other, True
    return out

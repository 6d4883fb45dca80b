"""Classes of entries: the most probable one, and which classes of two lists can be of one object."""

from __future__ import annotations

import numba as nb
import numpy as np

from copem_replay.core.kernels import borrowing
from copem_replay.core.tracks import CLASS_GROUPS, CLASSES, Bool, Float, Int

_OTHER = CLASSES.index("other")


def _agree() -> Bool:
    found = np.eye(len(CLASSES), dtype=np.bool_)
    other, vehicle = CLASSES.index("other"), CLASSES.index("vehicle")
    found[other] = found[:, other] = True
    for name in CLASS_GROUPS["vehicles"]:
        found[vehicle, CLASSES.index(name)] = found[CLASSES.index(name), vehicle] = True
    return found


AGREE: Bool = _agree()
"""(C, C) by indices into CLASSES: the same class, or one is `other`, which says nothing, or one is `vehicle`, not said
which, and the other one of the vehicles. Symmetric, not transitive: a car and a bicycle both agree with `other`."""


@borrowing
def most_probable(probability: Float) -> int:
    """Index of the largest of the probabilities `(C,)`, the first of equals; `other` where nothing is said."""
    best = 0
    for c in range(1, len(probability)):
        if probability[c] > probability[best]:
            best = c
    return best if probability[best] > 0 else _OTHER


@nb.njit(cache=True, nogil=True)
def most_probable_of_each(probability: Float) -> Int:
    """(N,) the same of each row of `probability (N, C)`."""
    best = np.empty(len(probability), np.int64)
    for i in range(len(probability)):
        best[i] = most_probable(probability[i])
    return best

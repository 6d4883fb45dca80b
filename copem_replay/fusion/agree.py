"""Which classes can be of one object: what two lists call it need not be the same word."""

from __future__ import annotations

import numpy as np

from copem_replay.tracks import CLASS_GROUPS, CLASSES, Bool


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

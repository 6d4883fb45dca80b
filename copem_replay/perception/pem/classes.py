"""Classes that units list objects as, and the probabilities that they state."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field

from copem_replay.core.components import Frozen, Share
from copem_replay.core.tracks import CLASSES, Float, Int


def _one_class(value: str) -> str:
    if value not in CLASSES:
        raise ValueError(f"expected one of {', '.join(CLASSES)}; found {value!r}")
    return value


OneClass = Annotated[str, AfterValidator(_one_class)]


def _whole(shares: dict[str, float]) -> dict[str, float]:
    total = math.fsum(shares.values())
    if abs(total - 1) > 1e-9:
        raise ValueError(f"sums to {total:g}, expected 1")
    return shares


Shares = Annotated[dict[OneClass, Share], Field(min_length=1), AfterValidator(_whole)]
"""By class how probable it is; the probabilities sum to 1."""


class Classes(Frozen):
    """The listed classes of objects, by true class; a class that is left out is always listed correctly.

    `confidence`: the stated probability of the listed class; the rest is spread evenly over the others.
    """

    confusion: dict[OneClass, Shares] = Field(default_factory=dict)
    confidence: Share = 1.0

    def listed(self, class_ix: Int, uniform: Float) -> Int:
        """(P,) what objects of true classes (P,) are taken for, by the inverse of the cumulated row of CLASSES."""
        return drawn_class(self._rows, class_ix, uniform)

    def stated(self, class_ix: Int) -> Float:
        """(P, C) the class probabilities that are stated of listed classes (P,)."""
        stated = np.full((len(class_ix), len(CLASSES)), (1 - self.confidence) / (len(CLASSES) - 1))
        stated[np.arange(len(class_ix)), class_ix] = self.confidence
        return stated

    @property
    def _rows(self) -> Float:
        rows = np.eye(len(CLASSES))
        for name, shares in self.confusion.items():
            rows[CLASSES.index(name)] = row_of(shares)
        return rows


def row_of(shares: dict[str, float]) -> Float:
    """(C,) probabilities in the order of CLASSES."""
    return np.array([shares.get(name, 0.0) for name in CLASSES])


def drawn_class(rows: Float, which: Int, uniform: Float) -> Int:
    """(P,) a class for each uniform (P,), by row `which` (P,) of probabilities (R, C)."""
    cumulated = np.cumsum(rows, axis=1)
    cumulated[:, -1] = 1.0
    last = np.array([np.flatnonzero(row)[-1] for row in rows])  # what rounding leaves belongs to none that is not there
    found: Int = np.minimum((uniform[:, None] >= cumulated[which]).sum(axis=1), last[which])
    return found

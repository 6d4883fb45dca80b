"""Messages of units: how often they are sent, and which objects are in them. docs/guide/sends.md.

A message that leaves objects out is *partial*: an object left out is not gone. The rules of `kind: cpm` are those that
open simulators of cooperative perception have; they were not checked against a standard.
"""

from __future__ import annotations

from typing import Annotated, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from copem_replay.core.compiled import callee, kernel
from copem_replay.core.components import Count, Frozen
from copem_replay.core.tracks import SAME_INSTANT_S, Bool, Float, Int

MOVED_M, FASTER_MPS, TURNED_RAD, AGAIN_S, AGAIN_VRU_S = 4.0, 0.5, np.radians(4.0), 1.0, 0.5
"""An object is sent again when it differs by more than this from what was last sent of it, or is as old as this."""
SMALLEST_S = 0.1
"""Seconds; from this age on an object is worth more, and most at `AGAIN_S`. By its other differences it is worth most
at twice their limits."""
_MORE = 1e-6
"""A difference exceeds its limit by more than this (metres, m/s, radians), so that rounding does not decide."""


class Sends(Frozen):
    """Which lists and objects a unit sends.

    `interval_s`: shortest time between messages. `kind: cpm`: a new object is sent at once, and again after it has
    moved by more than 4 m, changed its speed by more than 0.5 m/s, turned by more than 4°, or after 1 s; all vulnerable
    road users are sent together, when one of them is new or was last sent 0.5 s ago. `max_objects`: the most objects in
    a message, new ones first, then those that changed most.
    """

    kind: Literal["all", "cpm"] = "all"
    interval_s: Annotated[float, Field(strict=True, gt=0, le=3600)] | None = None
    max_objects: Count | None = None

    @model_validator(mode="after")
    def _something(self) -> Self:
        if self.kind == "all" and self.interval_s is None and self.max_objects is None:
            raise ValueError("expected kind: cpm, interval_s or max_objects; without any every list is sent as it is")
        return self

    @property
    def partial(self) -> bool:
        """Whether an object that a message leaves out may still be there."""
        return self.kind == "cpm" or self.max_objects is not None


class ListedObjects(NamedTuple):
    """Lists (L,) of one run in order of capture, and their rows (R,), `start[l] : start[l + 1]`, as units list them."""

    start: Int  # (L + 1,)
    unit_ix: Int  # (L,)
    captured_s: Float  # (L,)
    slot: Int  # (R,) what the unit takes for one object
    word: NDArray[np.uint64]  # (R,) decides between rows of equal worth
    vru: Bool  # (R,)
    state: Float  # (R, 4) x, y, speed, heading
    existence: Float  # (R,)


class LastSent:
    """What units (U,) sent last: each object, and any message. Lists are handed over in order of capture."""

    def __init__(self, units: list[Sends | None]) -> None:
        self._interval_s = np.array([0.0 if of is None else of.interval_s or 0.0 for of in units])
        self._cpm = np.array([of is not None and of.kind == "cpm" for of in units], dtype=bool)
        self._most = np.array([-1 if of is None else of.max_objects or -1 for of in units], dtype=np.int64)
        self._message_s = np.full(len(units), -np.inf)
        self._objects = np.empty((0, 5))  # capture, x, y, speed, heading

    def choose(self, listed: ListedObjects) -> tuple[Bool, Bool]:
        """Which lists (L,) are sent, and which of their rows (R,) are in them."""
        grown = np.full((max(int(listed.slot.max(initial=-1)) + 1, len(self._objects)), 5), -np.inf)
        grown[: len(self._objects)] = self._objects
        self._objects = grown
        sent, included = np.zeros(len(listed.unit_ix), dtype=bool), np.zeros(len(listed.slot), dtype=bool)
        _choose_objects(listed, self._interval_s, self._cpm, self._most, self._message_s, self._objects, sent, included)
        return sent, included


@kernel
def _choose_objects(
    listed: ListedObjects,
    interval_s: Float,
    cpm: Bool,
    most: Int,
    message_s: Float,
    objects: Float,
    sent: Bool,
    included: Bool,
) -> None:
    """Fill `sent (L,)` and `included (R,)`; `message_s (U,)` and `objects` become what was sent last, in place."""
    for k in range(len(sent)):
        unit, now_s = listed.unit_ix[k], listed.captured_s[k]
        if now_s < message_s[unit] + interval_s[unit] - SAME_INSTANT_S:
            continue
        message_s[unit], sent[k] = now_s, True
        first, after = listed.start[k], listed.start[k + 1]
        vrus_due, n = False, 0
        differences = np.empty((after - first, 4))
        for r in range(first, after):
            last, state, d = objects[listed.slot[r]], listed.state[r], differences[r - first]
            d[0] = now_s - last[0]  # inf: new
            d[1] = np.hypot(state[0] - last[1], state[1] - last[2])
            d[2] = abs(state[2] - last[3])
            d[3] = abs((state[3] - last[4] + np.pi) % (2 * np.pi) - np.pi) if d[0] < np.inf else np.inf
            vrus_due |= listed.vru[r] and d[0] >= AGAIN_VRU_S - SAME_INSTANT_S
        for r in range(first, after):
            d = differences[r - first]
            if not cpm[unit]:
                included[r] = True
            elif listed.vru[r]:
                included[r] = vrus_due
            else:
                included[r] = (
                    d[0] >= AGAIN_S - SAME_INSTANT_S or d[1] > MOVED_M + _MORE
                    or d[2] > FASTER_MPS + _MORE or d[3] > TURNED_RAD + _MORE
                )  # fmt: skip
            n += included[r]
        if 0 <= most[unit] < n:
            _keep_most(listed, differences, first, after, most[unit], included)
        for r in range(first, after):
            if included[r]:
                objects[listed.slot[r], 0] = now_s
                objects[listed.slot[r], 1:] = listed.state[r]


@callee
def _keep_most(listed: ListedObjects, differences: Float, first: int, after: int, most: int, included: Bool) -> None:
    """Of the rows `first` … `after` − 1 that are `included`, keep the `most` that are worth most, in place.

    New objects have the worth of all differences, and come before those that only changed as much.
    """
    worth = np.empty(after - first)
    for r in range(first, after):
        d = differences[r - first]
        worth[r - first] = listed.existence[r] + min(max((d[0] - SMALLEST_S) / (AGAIN_S - SMALLEST_S), 0.0), 1.0)
        worth[r - first] += min(d[1] / (2 * MOVED_M), 1.0) + min(d[2] / (2 * FASTER_MPS), 1.0)
        worth[r - first] += min(d[3] / (2 * TURNED_RAD), 1.0) + (10.0 if d[0] == np.inf else 0.0)
    is_kept = np.zeros(after - first, dtype=np.bool_)
    for _ in range(most):
        best = -1
        for i in range(after - first):
            if included[first + i] and not is_kept[i]:
                alike = best >= 0 and worth[i] == worth[best]
                if best < 0 or worth[i] > worth[best] or (alike and listed.word[first + i] < listed.word[first + best]):
                    best = i
        is_kept[best] = True
    included[first:after] &= is_kept

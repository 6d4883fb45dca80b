"""What entries go back to and what turns are, from the sentences of `origin.py` and `turns.py`; lists by hand."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import median
from typing import Any

import numpy as np

from copem_replay.core.object_list import ObjectLists
from copem_replay.core.tracks import VALUES, Tracks
from copem_replay.metrics.origin import GoesBack, OriginLists, Origins

SAME_S = 1e-6


@dataclass(frozen=True)
class Heard:
    """A list of a unit and, by run, the objects that it holds; runs beyond the last one are as the last."""

    unit: int
    captured_s: float
    arrives_s: float
    holds: tuple[frozenset[int], ...]

    def holds_in(self, run: int, object_ix: int) -> bool:
        return object_ix in self.holds[min(run, len(self.holds) - 1)]


def going_back(
    heard: Sequence[Heard], captured_s: float, now_s: float, *, max_age_s: float, partial: Collection[int] = (),
    to: GoesBack = GoesBack.TO_NEWEST, own: bool = False,
) -> list[list[int]]:  # fmt: skip
    """By unit, the newest first, which lists an entry of a list that is available at `now_s` goes back to."""
    result = []
    for unit in sorted({one.unit for one in heard}):
        taken_in = [a for a, one in enumerate(heard) if one.unit == unit and one.arrives_s <= now_s + SAME_S]
        taken_in.sort(key=lambda a: -heard[a].captured_s)
        if to is GoesBack.UNKNOWN:
            taken_in = [a for a in taken_in if abs(heard[a].captured_s - captured_s) <= SAME_S]
        if to is GoesBack.TO_NEWEST:
            taken_in = [a for a in taken_in if heard[a].captured_s <= captured_s + SAME_S]
            if unit not in partial and not own:
                taken_in = taken_in[:1]
            taken_in = [a for a in taken_in if captured_s <= heard[a].arrives_s + max_age_s + 2 * SAME_S]
        result.append(taken_in)
    return result


def holding(heard: Sequence[Heard], lists: list[list[int]], run: int, object_ix: int, own: bool = False) -> list[int]:
    """Of the lists of each unit the newest that holds the object, of an entry with a truth id all."""
    held = [[a for a in of_unit if heard[a].holds_in(run, object_ix)] for of_unit in lists]
    return [a for of_unit in held for a in (of_unit if own else of_unit[:1])]


def numbered(heard: Sequence[Heard]) -> tuple[list[tuple[int, int]], list[int]]:
    """Of each list its turn (unit, number), and its instant; of those that never arrive as it happens."""
    turn_s: dict[int, list[float]] = {}
    for unit in sorted({one.unit for one in heard}):
        own = [one for one in heard if one.unit == unit and np.isfinite(one.arrives_s)]
        turns: list[float] = []
        for now_s in sorted({one.arrives_s for one in own}):
            newest_s = max(one.captured_s for one in own if one.arrives_s <= now_s + SAME_S)
            if not turns or newest_s > turns[-1] + SAME_S:
                turns.append(newest_s)
        turn_s[unit] = turns
    periods = [median(b - a for a, b in pairwise(turns)) for turns in turn_s.values() if len(turns) > 1]
    instants: list[list[tuple[float, int, int]]] = []
    for t, unit, k in sorted((t, unit, k) for unit, turns in turn_s.items() for k, t in enumerate(turns)):
        joins = instants and t - instants[-1][0][0] <= min(periods, default=0.0) / 2 + SAME_S
        if joins and unit not in [other for _, other, _ in instants[-1]]:
            instants[-1].append((t, unit, k))
        else:
            instants.append([(t, unit, k)])
    instant_of = {(unit, k): i for i, members in enumerate(instants) for _, unit, k in members}
    turn = []
    for one in heard:
        after = [k for k, t in enumerate(turn_s[one.unit]) if t >= one.captured_s - SAME_S]
        turn.append((one.unit, after[0] if after else len(turn_s[one.unit]) - 1))
    return turn, [instant_of.get(one, 0) for one in turn]


def enough(places: Collection[int], hits: int, of: int) -> bool:
    """Whether `of` places in a row hold `hits` of these."""
    return any(len([p for p in set(places) if first <= p < first + of]) >= hits for first in places)


def tracks_of(heard: Sequence[Heard], runs: int = 1) -> Tracks:
    """The lists as tracks, in the order given; each unit has a track of every object in all its lists."""
    units, objects = sorted({one.unit for one in heard}), sorted({o for one in heard for run in one.holds for o in run})
    rows = [(u, o, a) for u in units for o in objects for a, one in enumerate(heard) if one.unit == u]
    pairs = [(u, o) for k, (u, o, _) in enumerate(rows) if k == 0 or rows[k - 1][:2] != (u, o)]
    values: dict[str, Any] = {name: np.zeros((1, len(rows))) for name in VALUES}
    captured_s = np.array([one.captured_s for one in heard], dtype=float)
    valid = [[heard[a].holds_in(run, o) for _, o, a in rows] for run in range(runs)]
    return Tracks(
        units=tuple(f"u{k}" for k in range(max(units, default=0) + 1)),
        start=np.searchsorted([pairs.index(row[:2]) for row in rows], np.arange(len(pairs) + 1)),
        unit_ix=np.array([u for u, _ in pairs], dtype=int),
        object_ix=np.array([o for _, o in pairs], dtype=int),
        frame_ix=np.array([a for *_, a in rows], dtype=int),
        stamp_ns=np.rint(captured_s * 1e9).astype(np.int64),
        captured_s=captured_s,
        frame_unit_ix=np.array([one.unit for one in heard], dtype=int),
        arrives_s=np.array([[one.arrives_s for one in heard]], dtype=float),
        valid=np.array(valid, dtype=bool).reshape(runs, len(rows)),
        **values,
    )


def origins_of(
    lists: ObjectLists, issue_s: Sequence[float], heard: Sequence[Heard] = (), *, max_age_s: float = 1.0,
    partial: Collection[int] = (), to: GoesBack = GoesBack.TO_NEWEST, own_ix: Sequence[int] = (), own_body_ix: int = -1,
) -> Origins:  # fmt: skip
    """What the entries of fused lists go back to, of lists heard."""
    received = tracks_of(heard, len(lists.start))
    marked = np.isin(np.arange(len(received.units)), list(partial))
    of = OriginLists(received, received, to, max_age_s, marked, own_body_ix)
    holdings = of.find_holdings(np.array(issue_s, dtype=float))
    return Origins(lists.entries, np.array(own_ix, dtype=np.int64), holdings)


def unknown_origins(lists: ObjectLists) -> Origins:
    """Of entries that may be about any object."""
    return origins_of(lists, (), to=GoesBack.UNKNOWN)

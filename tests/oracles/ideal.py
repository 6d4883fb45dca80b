"""What ideal fusion knows at each instant of the receiver, computed plainly: list by list, object by object.

Times are whole milliseconds. At an instant it goes by all lists that are taken in then, and by each unit's newest list
taken in so far, unless that is too old. Of a unit it has the newest of these that holds an object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class SentList:
    """One list of a unit, and the objects that it holds; `arrives` None: never."""

    unit: int
    captured: int
    arrives: int | None
    holds: frozenset[int]


def taken_in(one: SentList, tick: int | None) -> int | None:
    """When the receiver takes a list in: at the first tick at which it is there."""
    if one.arrives is None or tick is None:
        return one.arrives
    return -(-one.arrives // tick) * tick


Known = dict[int, dict[int, dict[int, int]]]
"""By instant, object and unit: the capture of the entry that ideal fusion has."""


def known(lists: Sequence[SentList], tick: int | None, max_age: int) -> Known:
    """At each instant; a unit captures no two lists at once."""
    result: Known = {}
    for now in sorted({at for one in lists if (at := taken_in(one, tick)) is not None}):
        there = [(one, at) for one in lists if (at := taken_in(one, tick)) is not None and at <= now]
        used = [one for one, at in there if at == now]
        for unit in {one.unit for one, _ in there}:
            newest, since = max(((one, at) for one, at in there if one.unit == unit), key=lambda pair: pair[0].captured)
            if now <= since + max_age:
                used.append(newest)
        entries: dict[int, dict[int, int]] = {}
        for one in used:
            for k in one.holds:
                by_unit = entries.setdefault(k, {})
                by_unit[one.unit] = max(by_unit.get(one.unit, one.captured), one.captured)
        result[now] = entries
    return result


def first_known(found: Known, k: int, onset: int, end: int) -> tuple[int, int] | None:
    """When an object is first known by a list captured at or after its onset, and the newest such capture."""
    for now, entries in found.items():
        captured = max(entries.get(k, {}).values(), default=-1)
        if onset <= captured and now <= end:
            return now, captured
    return None

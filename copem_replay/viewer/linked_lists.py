"""What became of the lists that units send by a link, in the run that is shown: lost, late or overtaken.

In words among the events, and as lanes, `lists/2_bursts/rsu1`, under those of the objects. Nothing where a
configuration has no link, no lane where all lists of a unit come in time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from copem_replay.communication.arrivals import overtaken
from copem_replay.core.colours import Rgb
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import SAME_INSTANT_NS, Float, Int
from copem_replay.viewer.palette import STATUS
from copem_replay.viewer.sink import Out, distinct, ns, part_of, plain
from copem_replay.viewer.statuses import CAPTURED, UNMATCHED
from copem_replay.viewer.statuses import LOST as LIST_LOST

FATES = ("in time", "lost", "late", "overtaken")
IN_TIME, LOST, LATE, OVERTAKEN = range(len(FATES))
COLOURS: dict[int, Rgb] = {LOST: STATUS[LIST_LOST], LATE: STATUS[CAPTURED], OVERTAKEN: STATUS[UNMATCHED]}
"""Of lanes: as in an object's lane a lost list, one under way, and one that no entry is matched with."""
QUIET_S, TOLD_S = 1.0, 5.0
"""Lists no more than the first apart are told in one row, up to the second after its first one; whenever there is no
other list between them (chosen: a burst is a row, and ten minutes of single losses are 120)."""
_TOLERANCE_S = SAME_INSTANT_NS * 1e-9
LANES = 13
"""Lanes of so many configurations and units at an object (chosen: all of them are seen at 720 points)."""


@dataclass(frozen=True)
class UnitLists:
    """The lists (L,) that one unit sends by a link in one run, in order of capture: when they arrive, inf: never.

    `fate`: index into FATES. `path`: the entity of the lane.
    """

    unit: str
    path: tuple[str, ...]
    captured_s: Float
    arrives_s: Float
    fate: Int
    interval_s: float

    @property
    def elapsed_ns(self) -> Int:
        """(L,) captures."""
        result: Int = ns(self.captured_s)
        return result


def linked_lists(fused_tracks: FusedTracks, place: int, name: str, max_age_s: float) -> list[UnitLists]:
    """Of each unit of a configuration that sends by a link; `place`: the configuration's among those of the file.

    Late: longer on its way than `max_age_s`, or by more than an interval of the unit's lists longer than half of them.
    Overtaken: it arrives later than a newer list of the unit; what comes in at one tick comes together.
    """
    heard, by_link = fused_tracks.heard, fused_tracks.by_link
    if by_link is None:
        return []
    late_after_newer, found = overtaken(heard), []
    for k, entity in enumerate(distinct([plain(unit) for unit in heard.units])):
        mine = np.flatnonzero(by_link & (heard.frame_unit_ix == k))
        if not len(mine):
            continue
        mine = mine[np.argsort(heard.captured_s[mine], kind="stable")]
        captured_s, arrives_s = heard.captured_s[mine], heard.common_arrives_s[mine]
        way_s, came = arrives_s - captured_s, np.isfinite(arrives_s)
        interval_s = float(np.median(np.diff(captured_s))) if len(mine) > 1 else np.inf
        usual_s = float(np.median(way_s[came])) if came.any() else np.inf
        late = way_s > min(max_age_s, usual_s + interval_s) + _TOLERANCE_S
        fate = np.select([~came, late_after_newer[mine], late], [LOST, OVERTAKEN, LATE], IN_TIME)
        path = ("lists", f"{place + 1}_{plain(name)}", entity)
        found.append(UnitLists(heard.units[k], path, captured_s, arrives_s, fate, interval_s))
    return found


def lists_in_words(out: Out, name: str, lists: Sequence[UnitLists]) -> None:
    """A row for each list of a configuration that was lost, late or overtaken, or for several in a row."""
    import rerun as rr

    told = sorted(
        (float(of.captured_s[some[0]]), "WARN" if fate == LOST else "INFO", f"{name}: {_sentence(of, fate, some)}")
        for of in lists
        for fate in (LOST, LATE, OVERTAKEN)
        for some in _together(of, fate)
    )
    columns = rr.TextLog.columns(text=[text for _, _, text in told], level=[level for _, level, _ in told])
    out.columns(["events", part_of(name), "lists"], ns([time_s for time_s, _, _ in told]), columns)


def _together(of: UnitLists, fate: int) -> Iterator[list[int]]:
    """Numbers of the lists with one fate that are told in one row."""
    some: list[int] = []
    for k in np.flatnonzero(of.fate == fate).tolist():
        if some and k != some[-1] + 1:
            since_s = of.captured_s[k] - of.captured_s[[some[-1], some[0]]] - _TOLERANCE_S
            if since_s[0] > QUIET_S or since_s[1] > TOLD_S:
                yield some
                some = []
        some.append(k)
    if some:
        yield some


def _sentence(of: UnitLists, fate: int, some: list[int]) -> str:
    """“rsu1: 7 lists lost, captured 3.20 to 3.80 s, next arrival 3.95 s”."""
    first, last, n = some[0], some[-1], len(some)
    of_so_many = f"{n} of {last - first + 1} lists" if last - first >= n else f"{n} lists" if n > 1 else "list"
    said = [f"{of.unit}: {of_so_many} {FATES[fate]}", f"captured {_from_to(of.captured_s[some])}"]
    if fate == LOST:
        next_s = of.arrives_s[last + 1 :].min(initial=np.inf)
        said.append(f"next arrival {next_s:.2f} s" if np.isfinite(next_s) else "none arrives after")
    else:
        said.append(f"arrived {_from_to(of.arrives_s[some])}")
    return ", ".join(said)


def _from_to(time_s: Float) -> str:
    first, last = f"{time_s.min():.2f}", f"{time_s.max():.2f}"
    return f"{first} s" if first == last else f"{first} to {last} s"


def list_lanes(out: Out, lists: Sequence[UnitLists]) -> None:
    """A lane for each unit of which a list was lost, late or overtaken: from its capture to that of the next one."""
    import rerun as rr

    for of in lists:
        if not of.fate.any():
            continue
        first = np.flatnonzero(np.diff(of.fate, prepend=IN_TIME))
        many = np.diff(first, append=len(of.fate))
        fate, begins = of.fate[first], of.elapsed_ns[first]
        texts = [FATES[f] if n == 1 else f"{n} {FATES[f]}" for f, n in zip(fate.tolist(), many.tolist(), strict=True)]
        if fate[-1] != IN_TIME:  # nothing is known of what comes after
            fate, begins = np.append(fate, IN_TIME), np.append(begins, of.elapsed_ns[-1] + ns(min(of.interval_s, 1.0)))
        told = fate != IN_TIME
        said = [text for text, is_told in zip(texts, told.tolist(), strict=False) if is_told]
        states = rr.StateChange.columns(state=pa.array(said, pa.string()))
        out.columns(of.path, begins, states.partition(told.astype(np.int64)))
        style = dict(zip(said, (COLOURS[f] for f in fate[told].tolist()), strict=True))
        values = list(style)
        out.static(of.path, rr.StateConfiguration(values=values, labels=values, colors=list(style.values())))


def shown_under(lists: Mapping[str, Sequence[UnitLists]], axis_s: tuple[float, float]) -> list[tuple[str, ...]]:
    """Entities of the lanes that are shown under an object that is looked at from when to when.

    Those with a mark then; where that makes more than `LANES`, those with the most. In the order of configurations.
    """
    marked = [
        (int(np.count_nonzero(of.fate[(of.captured_s >= axis_s[0]) & (of.captured_s <= axis_s[1])])), of.path)
        for units in lists.values()
        for of in units
    ]
    most = sorted(marked, key=lambda one: -one[0])[: LANES - len(lists)]
    return [path for count, path in marked if count and (count, path) in most]

"""JSON beside a fused list: `…/detail`, what its objects have no fields for, and `…/status`, what is known.

`detail` has one message per list: the full covariance and variances of each object, the entries of the units' lists it
was made of (parallel lists of unit, capture, range, visible share), and what was detected with it. With a fusion
without truth ids it has the claimed existence, and no entries. `newest_captured_ns` of an object is the newest capture
that contributed, which tells whether it was captured after an onset; `stated_captured_ns`, the same as units state it,
is there where a fusion was told of clocks that are off. Objects are in the order of the list. Where units have ghosts
or outages, `ghosts` are the entries about no object in the lists that came in with this one, and `down` the units whose
last list was not made.

`status` has the status of each measured object at each list, for State Transitions panels. An object is known as the
detections table has it: from `detection_s` on, while the newest list holds it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import orjson

from copem_replay.core.tracks import (
    NO_CAPTURE_NS,
    SAME_INSTANT_NS,
    SAME_INSTANT_S,
    UNCERTAINTIES,
    Bool,
    Float,
    Int,
    Scene,
)
from copem_replay.io.encodings.column_bytes import (
    RecordPart,
    RowGroups,
    TextPool,
    encode_arrays,
    encode_numbers,
    encode_records,
    encode_texts,
    expand_ranges,
    repeat_text,
    split_into_blocks,
    start_offsets,
)
from copem_replay.io.schemas.registry import DETAIL_SCHEMA

if TYPE_CHECKING:
    import pandas as pd

    from copem_replay.core.fused_tracks import FusedTracks

# Statuses.

STATUS_SCHEMA = "copem_replay.Status"
STATUSES = NOT_LISTED, LISTED, KNOWN = "not listed", "listed, not known", "known"


def _describe_messages(title: str, **fields: dict[str, Any]) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": {"available_ns": _INTEGER, **fields}}


def _list_of(**fields: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": {"type": "object", "properties": fields}}


_INTEGER, _TEXT, _NUMBER = {"type": "integer"}, {"type": "string"}, {"type": ["number", "null"]}
STATUS_JSON = _describe_messages(STATUS_SCHEMA, objects=_list_of(id=_TEXT, status=_TEXT, age_s=_NUMBER))


class Statuses:
    """The statuses of the measured objects of one run; `table`: the rows of this log, configuration and run."""

    def __init__(self, scene: Scene, fused_tracks: FusedTracks, table: pd.DataFrame) -> None:
        self._fused_tracks, self._t0_ns, self._count = fused_tracks, scene.t0_ns, len(scene.object_ids)
        never = np.iinfo(np.int64).max
        known_ns = {
            scene.object_number[row.object_id]: scene.t0_ns + round(row.detection_s * 1e9) if row.detected else never
            for row in table[["object_id", "detected", "detection_s"]].itertuples(index=False)
        }
        self._objects = np.array([*known_ns], dtype=np.int64)
        self._known_ns = np.array([*known_ns.values()], dtype=np.int64)
        self.names = [scene.object_ids[number] for number in known_ns]

    def at(self, available_ns: Int) -> tuple[Int, Float]:
        """(F, K) index into STATUSES, and (F, K) age of the entry in s, NaN: none; of each list and object."""
        rows, bounds = self._fused_tracks.listed_rows
        frame, number = np.repeat(np.arange(len(available_ns)), np.diff(bounds)), self._fused_tracks.fused.row_object_ix
        available_s = (available_ns - self._t0_ns) * 1e-9
        ages_s = np.fmax(0.0, available_s[frame] - self._fused_tracks.captured_s[0, rows])
        every = np.full((len(available_ns), self._count + 1), np.nan)  # a column for each object, the last for none
        every[frame, number[rows]] = _round_to_us(ages_s)
        age_s = every[:, self._objects]
        is_known = available_ns[:, None] >= self._known_ns - SAME_INSTANT_NS
        return np.where(np.isnan(age_s), 0, np.where(is_known, 2, 1)), np.where(np.isfinite(age_s), age_s, np.nan)


def _round_to_us(time_s: Float) -> Float:
    """Times (N,) with six decimals, as `round` gives them."""
    us = time_s * 1e6
    rounded: Float = np.rint(us) / 1e6
    with np.errstate(invalid="ignore"):  # some are not finite
        unsure = np.flatnonzero(np.abs(us - np.floor(us) - 0.5) <= 1e-3 + 1e-15 * us)  # the product may be off
    rounded[unsure] = [round(time, 6) for time in time_s[unsure].tolist()]
    return rounded


class StatusWriter:
    """Turns statuses into messages of JSON, one per list."""

    def __init__(self, statuses: Statuses) -> None:
        self._statuses = statuses

    def messages(self, available_ns: Int) -> Iterator[bytes]:
        """The lists as they became available at these instants of the log's clock, (F,)."""
        names = self._statuses.names
        lists, objects = len(available_ns), len(names)
        status, age_s = self._statuses.at(available_ns)
        parts: list[RecordPart] = [
            repeat_text(b'{"id":', lists * objects),
            encode_texts(names).at(np.tile(np.arange(objects), lists)),
            repeat_text(b',"status":', lists * objects),
            encode_texts(STATUSES).at(status.ravel()),
            repeat_text(b',"age_s":', lists * objects),
            encode_numbers(age_s.ravel(), lists * objects),
            repeat_text(b"}", lists * objects),
        ]
        whole: list[RecordPart] = [
            repeat_text(b'{"available_ns":', lists),
            encode_numbers(available_ns, lists),
            repeat_text(b',"objects":', lists),
            *encode_arrays(np.arange(lists + 1) * objects, parts),
            repeat_text(b"}", lists),
        ]
        yield from encode_records(whole, lists)


# Faults of the units' lists.


def faults_by_list(fused_tracks: FusedTracks) -> list[dict[str, Any]]:
    """For each fused list `ghosts`, entries about no object in the lists that came in with it, and `down`, units.

    A unit is down while the last list that it should have captured was not made. Empty: no unit has such faults.
    """
    faults, received = fused_tracks.faults, fused_tracks.received
    if faults is None:
        return []
    issue_s = fused_tracks.fused.common_arrives_s
    faults_of_list: list[dict[str, Any]] = [{"ghosts": [], "down": []} for _ in issue_s]
    arrives_s = received.common_arrives_s[received.frame_ix[faults.ghosts]]
    came = faults.ghosts[np.isfinite(arrives_s) & received.valid[0, faults.ghosts]]
    # A list belongs to the last instant within a microsecond of its arrival, or the next.
    number = np.searchsorted(issue_s, received.common_arrives_s[received.frame_ix[came]] - SAME_INSTANT_S)
    for row, k in zip(came.tolist(), number.tolist(), strict=True):
        if k < len(faults_of_list):
            frame = received.frame_ix[row]
            faults_of_list[k]["ghosts"].append(
                {
                    "unit": received.units[received.frame_unit_ix[frame]],
                    "captured_ns": int(received.stamp_ns[frame]),
                    **{name: float(getattr(received, name)[0, row]) for name in ("x_m", "y_m", "z_m")},
                }
            )
    for unit_ix, unit in enumerate(received.units):
        lists = np.flatnonzero(received.frame_unit_ix == unit_ix)
        if not faults.not_made[lists].any():
            continue
        last = np.searchsorted(received.captured_s[lists], issue_s + SAME_INSTANT_S, side="right") - 1
        for k in np.flatnonzero((last >= 0) & faults.not_made[lists[np.maximum(last, 0)]]):
            faults_of_list[k]["down"].append(unit)
    return faults_of_list


# Details.

Event = Mapping[str, Any]
"""A detection: `object`, `first_unit`, `onset_s`, `captured_s`, `time_to_detection_s`, `distance_at_detection_m`."""

DETAIL_JSON = _describe_messages(
    DETAIL_SCHEMA,
    captured_ns={"type": ["integer", "null"]},
    objects=_list_of(
        id=_TEXT,
        existence={"type": "number"},
        **dict.fromkeys(UNCERTAINTIES, _NUMBER),
        newest_captured_ns={"type": ["integer", "null"]},
        stated_captured_ns=_INTEGER,
        units={"type": "array", "items": _TEXT},
        captured_ns={"type": "array", "items": _INTEGER},
        range_m={"type": "array", "items": _NUMBER},
        visible_share={"type": "array", "items": _NUMBER},
    ),
    events={"type": "array", "items": {"type": "object"}},
)


def _encode_captures(captured_ns: Int) -> list[RecordPart]:
    """Stamps, null where there is no capture."""
    known = start_offsets(captured_ns != NO_CAPTURE_NS)
    stamps = encode_numbers(captured_ns[np.diff(known) > 0], int(known[-1]))
    return [RowGroups(known, [stamps]), TextPool.of([b"null", b""]).at(np.diff(known))]


class DetailWriter:
    """Turns the fused lists of one run (values (1, P)) into messages, many lists at once.

    `events[k]`: the detections with list k. `sizes_of` (P,): the objects whose length and width the list beside does
    not state.
    """

    def __init__(
        self,
        scene: Scene,
        fused_tracks: FusedTracks,
        events: Mapping[int, Sequence[Event]],
        sizes_of: Bool | None = None,
    ) -> None:
        self._fused_tracks, self._events, self._t0_ns = fused_tracks, events, scene.t0_ns
        names, self._name = fused_tracks.names_of(scene)
        self._names, self._units = encode_texts(names), encode_texts(fused_tracks.received.units)
        self._faults = faults_by_list(fused_tracks)
        self._sizes_of = np.zeros(len(self._name), dtype=bool) if sizes_of is None else sizes_of

    def messages(self, available_ns: Int) -> Iterator[bytes]:
        """The lists as they became available at these instants of the log's clock, (F,)."""
        rows, bounds = self._fused_tracks.listed_rows
        for first, last in split_into_blocks(bounds):
            captured_ns, lists = self._fused_tracks.fused.stamp_ns[first:last], last - first
            start = bounds[first : last + 1] - bounds[first]
            parts: list[RecordPart] = [
                repeat_text(b'{"available_ns":', lists),
                encode_numbers(available_ns[first:last], lists),
                repeat_text(b',"captured_ns":', lists),
                *_encode_captures(captured_ns),
                repeat_text(b',"objects":', lists),
                *encode_arrays(start, self._objects(rows[bounds[first] : bounds[last]])),
                TextPool.of([self._besides(frame) for frame in range(first, last)]).at(np.arange(lists)),
            ]
            yield from encode_records(parts, lists)

    def _objects(self, rows: Int) -> list[RecordPart]:
        """The parts of the objects of some rows."""
        fused, claims, count = self._fused_tracks.fused, self._fused_tracks.said, len(rows)
        parts: list[RecordPart] = [repeat_text(b'{"id":', count), self._names.at(self._name[rows])]
        if claims is not None:
            parts += [repeat_text(b',"existence":', count), encode_numbers(claims["existence"][rows], count)]
        sized = self._sizes_of[rows]
        sides: list[RecordPart] = []
        for name in ("length_m", "width_m"):
            values = getattr(fused, name)[0, rows[sized]]
            sides += [repeat_text(f',"{name}":'.encode(), len(values)), encode_numbers(values, len(values))]
        parts.append(RowGroups(start_offsets(sized), sides))
        for name in UNCERTAINTIES:
            variance = getattr(fused, name)
            parts += [
                repeat_text(f',"{name}":'.encode(), count),
                encode_numbers(None if variance is None else variance[0, rows], count),
            ]
        return [*parts, *self._captures(rows), *self._entries(rows), repeat_text(b"}", count)]

    def _captures(self, rows: Int) -> list[RecordPart]:
        """The parts of the newest captures that the objects of some rows go back to."""
        newest_s, stated_s = self._fused_tracks.captured_s[0, rows], self._fused_tracks.stated_s
        parts = [
            repeat_text(b',"newest_captured_ns":', len(rows)),
            *_encode_captures(self._stamps(newest_s)),
        ]
        if stated_s is not None:
            stamps_ns = self._stamps(stated_s[rows])
            parts += [repeat_text(b',"stated_captured_ns":', len(rows)), encode_numbers(stamps_ns, len(rows))]
        return parts

    def _stamps(self, captured_s: Float) -> Int:
        """Instants of the log as stamps; −∞ is no capture."""
        known = np.isfinite(captured_s)
        since_ns = np.rint(np.where(known, captured_s, 0.0) * 1e9).astype(np.int64)
        return np.where(known, self._t0_ns + since_ns, NO_CAPTURE_NS)

    def _entries(self, rows: Int) -> list[RecordPart]:
        """The parts of the entries that the objects of some rows were made of."""
        received, view = self._fused_tracks.received, self._fused_tracks.view
        start, places = expand_ranges(self._fused_tracks.used_start, rows)
        used = self._fused_tracks.used[places]
        columns = {
            "units": self._units.at(received.row_unit_ix[used]),
            "captured_ns": encode_numbers(received.stamp_ns[received.frame_ix[used]], len(used)),
            "range_m": encode_numbers(None if view is None else view.range_m[used], len(used)),
            "visible_share": encode_numbers(None if view is None else view.visible_share[used], len(used)),
        }
        parts: list[RecordPart] = []
        for name, column in columns.items():
            parts += [repeat_text(f',"{name}":'.encode(), len(rows)), *encode_arrays(start, [column])]
        return parts

    def _besides(self, frame: int) -> bytes:
        """The end of a message: detections with its list, and faults of the units' lists."""
        content = {"events": list(self._events.get(frame, ())), **(self._faults[frame] if self._faults else {})}
        return b"," + orjson.dumps(content)[1:]

"""JSON beside a fused list: `…/detail`, what its objects have no fields for, and `…/status`, what is known.

`detail` has one message per list: the full covariance and variances of each object, the entries of the units' lists it
was made of (parallel lists of unit, capture, range, visible share), and what was detected with it. With a fusion
without truth ids it has the claimed existence, and no entries. `newest_captured_ns` of an object is the newest capture
that contributed, which tells whether it was captured after an onset; `stated_captured_ns`, the same as units state it,
is there where a fusion was told of clocks that are off. Objects are in the order of the list. Where units have ghosts
or outages, `ghosts` are the entries about no object in the lists that came in with this one, and `down` the units whose
last list was not made.

Beside the lists of a unit, `copem/units/<name>/objects`, it has what their messages leave out (`ReadyLists`).

`status` has the status of each measured object at each list, for State Transitions panels. An object is known as the
detections table has it: from `detection_s` on, while the newest list holds it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
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
    Content,
    JsonContent,
    RepeatedMessages,
    StatedRows,
    TextPool,
    encode_json,
    expand_ranges,
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

_STATUSES = TextPool.of(STATUSES)


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
        self._names = TextPool.of([scene.object_ids[number] for number in known_ns])

    def at(self, available_ns: Int) -> RepeatedMessages:
        """For each list, available at `available_ns`: the status of each object, and its entry's age (s; NaN: none)."""
        rows, bounds = self._fused_tracks.listed_rows
        frame, number = np.repeat(np.arange(len(available_ns)), np.diff(bounds)), self._fused_tracks.fused.row_object_ix
        available_s = (available_ns - self._t0_ns) * 1e-9
        ages_s = np.fmax(0.0, available_s[frame] - self._fused_tracks.captured_s[0, rows])
        table = np.full((len(available_ns), self._count + 1), np.nan)  # a column for each object, the last for none
        table[frame, number[rows]] = _round_to_us(ages_s)
        age_s = table[:, self._objects]
        is_known = available_ns[:, None] >= self._known_ns - SAME_INSTANT_NS
        status = np.where(np.isnan(age_s), 0, np.where(is_known, 2, 1))
        objects: Content = {
            "id": self._names.at(np.tile(np.arange(len(self._objects)), len(available_ns))),
            "status": _STATUSES.at(status.ravel()),
            "age_s": np.where(np.isfinite(age_s), age_s, np.nan).ravel(),
        }
        return RepeatedMessages(np.arange(len(available_ns) + 1) * len(self._objects), objects)


def _round_to_us(time_s: Float) -> Float:
    """Times (N,) with six decimals, as `round` gives them."""
    us = time_s * 1e6
    rounded: Float = np.rint(us) / 1e6
    with np.errstate(invalid="ignore"):  # some are not finite
        unsure = np.flatnonzero(np.abs(us - np.floor(us) - 0.5) <= 1e-3 + 1e-15 * us)  # the product may be off
    rounded[unsure] = [round(time, 6) for time in time_s[unsure].tolist()]
    return rounded


def encode_statuses(available_ns: Int, objects: RepeatedMessages) -> list[bytes]:
    """Messages of JSON."""
    return encode_json({"available_ns": available_ns, "objects": objects}, len(available_ns))


class StatusWriter:
    """Turns statuses into messages, one per list; `encode`: of the instants and the statuses at each."""

    def __init__(
        self, statuses: Statuses, encode: Callable[[Int, RepeatedMessages], list[bytes]] = encode_statuses
    ) -> None:
        self._statuses, self._encode = statuses, encode

    def messages(self, available_ns: Int) -> Iterator[bytes]:
        """The lists as they became available at these instants of the log's clock, (F,)."""
        yield from self._encode(available_ns, self._statuses.at(available_ns))


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
    true_captured_ns=_INTEGER,
    arrives_ns={"type": "object", "additionalProperties": {"type": ["integer", "null"]}},
    objects=_list_of(
        id={"type": ["string", "null"]},
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


def _state_instants(t0_ns: int, time_s: Float) -> StatedRows:
    """Instants of the log as stamps, null where they are not finite: there is none."""
    known = np.isfinite(time_s)
    return StatedRows(known, t0_ns + np.rint(time_s[known] * 1e9).astype(np.int64))


def _stated_captures(captured_ns: Int) -> StatedRows:
    """Stamps, null where there is no capture."""
    known = captured_ns != NO_CAPTURE_NS
    return StatedRows(known, captured_ns[known])


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
        self._names, self._units = (TextPool.of(of) for of in (names, fused_tracks.received.units))
        self._faults = faults_by_list(fused_tracks)
        self._sizes_of = np.zeros(len(self._name), dtype=bool) if sizes_of is None else sizes_of

    def messages(self, available_ns: Int) -> Iterator[bytes]:
        """The `…/detail` messages of the lists, available at these instants (F,) of the log's clock (ns)."""
        rows, bounds = self._fused_tracks.listed_rows
        for first, last in split_into_blocks(bounds):
            objects = self._objects(rows[bounds[first] : bounds[last]])
            content: JsonContent = {
                "available_ns": available_ns[first:last],
                "captured_ns": _stated_captures(self._fused_tracks.fused.stamp_ns[first:last]),
                "objects": RepeatedMessages(bounds[first : last + 1] - bounds[first], objects),
            }
            for frame, message in enumerate(encode_json(content, last - first), start=first):
                yield message[:-1] + self._besides(frame)

    def _objects(self, rows: Int) -> JsonContent:
        """The objects of some rows as content of JSON."""
        fused, claims, stated_s = self._fused_tracks.fused, self._fused_tracks.said, self._fused_tracks.stated_s
        sized = self._sizes_of[rows]
        sides = {n: StatedRows(sized, getattr(fused, n)[0, rows[sized]], null=False) for n in ("length_m", "width_m")}
        spread = {name: getattr(fused, name) for name in UNCERTAINTIES}
        return {
            "id": self._names.at(self._name[rows]),
            **({} if claims is None else {"existence": claims["existence"][rows]}),
            **(sides if sized.any() else {}),
            **{name: None if variance is None else variance[0, rows] for name, variance in spread.items()},
            "newest_captured_ns": _state_instants(self._t0_ns, self._fused_tracks.captured_s[0, rows]),
            **({} if stated_s is None else {"stated_captured_ns": _state_instants(self._t0_ns, stated_s[rows])}),
            **self._entries(rows),
        }

    def _entries(self, rows: Int) -> JsonContent:
        """The entries that the objects of some rows were made of."""
        received, view = self._fused_tracks.received, self._fused_tracks.view
        start, places = expand_ranges(self._fused_tracks.used_start, rows)
        entry_rows = self._fused_tracks.used[places]
        return {
            "units": RepeatedMessages(start, self._units.at(received.row_unit_ix[entry_rows])),
            "captured_ns": RepeatedMessages(start, received.stamp_ns[received.frame_ix[entry_rows]]),
            "range_m": RepeatedMessages(start, None if view is None else view.range_m[entry_rows]),
            "visible_share": RepeatedMessages(start, None if view is None else view.visible_share[entry_rows]),
        }

    def _besides(self, frame: int) -> bytes:
        """The end of a message: detections with its list, and faults of the units' lists."""
        content = {"events": list(self._events.get(frame, ())), **(self._faults[frame] if self._faults else {})}
        return b"," + orjson.dumps(content)[1:]


# Lists of units.


@dataclass(frozen=True)
class ReadyLists:
    """The lists (F,) of one unit in one run, in the order in which it has them ready, entry by entry in `lists.fused`.

    Without the entry about the ego, which no receiver here takes in. `lists.fused.stamp_ns`: captures as the unit
    states them; `true_captured_ns`: as they are, None: the same. `arrives_s`: when each reaches the receiver of a
    configuration, inf: never. `fields`: polygons (K, 2) of its field of view, ahead along x; `poses (4, F)`:
    east, north, ground and heading at the captures. `has_ids`: whether entries have track ids.
    """

    name: str
    lists: FusedTracks
    true_captured_ns: Int | None
    arrives_s: Mapping[str, Float]
    fields: Sequence[Float]
    poses: Float
    has_ids: bool

    def draw_areas(self, first: int, last: int) -> RepeatedMessages:
        """The field of view in the world at lists first … last − 1, as osi3.SensorData.VirtualDetectionArea polygons.
        Places are rounded to 1/64 m: the other digits are most of what compression leaves of a field that moves.
        """
        x, y, z, heading = self.poses[:, first:last, None]
        ahead, left = np.concatenate(self.fields).T
        cos, sin = np.cos(heading), np.sin(heading)
        places = x + cos * ahead - sin * left, y + sin * ahead + cos * left, z + 0 * ahead
        corners = {axis: np.rint(64 * place.ravel()) / 64 for axis, place in zip("xyz", places, strict=True)}
        sizes = np.tile([len(border) for border in self.fields], last - first)
        polygons = {"vertex": RepeatedMessages(start_offsets(sizes), corners)}
        return RepeatedMessages(np.arange(last - first + 1) * len(self.fields), polygons)


class UnitDetailWriter:
    """Turns the lists of a unit into messages. `beside (P,)`: what its entries have no fields for, left out where 0.

    The `id` of an entry is that of the true object it is about, null: of none.
    """

    def __init__(self, scene: Scene, unit: ReadyLists, beside: Mapping[str, Float]) -> None:
        self._names, self._unit, self._beside = TextPool.of(scene.object_ids), unit, beside
        self._stamp = partial(_state_instants, scene.t0_ns)

    def messages(self, available_ns: Int) -> Iterator[bytes]:
        """The `…/detail` messages of a unit's lists, ready at these instants (F,) of the log's clock (ns)."""
        unit, fused = self._unit, self._unit.lists.fused
        bounds, true_ns = fused.by_frame[1], unit.true_captured_ns
        for first, last in split_into_blocks(bounds):
            rows, lists = slice(bounds[first], bounds[last]), slice(first, last)
            has_id = fused.row_object_ix[rows] >= 0
            names = self._names.at(fused.row_object_ix[rows][has_id])
            other_columns = {name: of[rows] for name, of in self._beside.items()}
            objects = {
                "id": StatedRows(has_id, names),
                **{name: StatedRows(of != 0, of[of != 0], null=False) for name, of in other_columns.items()},
            }
            content: JsonContent = {
                "available_ns": available_ns[lists],
                "captured_ns": fused.stamp_ns[lists],
                **({} if true_ns is None else {"true_captured_ns": true_ns[lists]}),
                "arrives_ns": {name: self._stamp(of[lists]) for name, of in unit.arrives_s.items()},
                "objects": RepeatedMessages(bounds[first : last + 1] - bounds[first], objects),
            }
            yield from encode_json(content, last - first)

"""What a list of objects cannot carry of a fused list, losslessly, as JSON beside it.

One message per list on `copem/<configuration>/detail`: the full covariance and variances of each object, the entries of
the units' lists it was made of (parallel lists of unit, capture, range, visible share), and what was detected with it.
Of a fusion without truth ids: what it claims of the existence, and no entries. Objects are in the order of the list.
Where units have ghosts or outages, `ghosts` are the entries about no object in the lists that came in with this one,
and `down` the units whose last list was not made.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import orjson

from copem_replay.core.tracks import NO_CAPTURE_NS, UNCERTAINTIES, Bool, Int, Scene
from copem_replay.io.encodings.column_bytes import Each, Part, Texts, constant, records, starts
from copem_replay.io.encodings.json_columns import array, numbers, texts
from copem_replay.io.write.detail_json import Event
from copem_replay.io.write.fault_details import faults_by_list
from copem_replay.io.write.list_blocks import blocks, ranges

if TYPE_CHECKING:
    from copem_replay.core.fused_tracks import FusedTracks


class DetailWriter:
    """Turns the fused lists of one run (values (1, P)) into messages, many lists at once.

    `events[k]` is what was detected with list k. `sizes_of` (P,): of which objects the list beside does not say how
    long and how wide they are.
    """

    def __init__(
        self,
        scene: Scene,
        fused_tracks: FusedTracks,
        events: Mapping[int, Sequence[Event]],
        sizes_of: Bool | None = None,
    ) -> None:
        self._fused_tracks, self._events = fused_tracks, events
        names, self._name = fused_tracks.names_of(scene)
        self._names, self._units = texts(names), texts(fused_tracks.heard.units)
        self._faults = faults_by_list(fused_tracks)
        self._sizes_of = np.zeros(len(self._name), dtype=bool) if sizes_of is None else sizes_of

    def messages(self, available_ns: Int) -> Iterator[bytes]:
        """The lists as they became available at these instants of the log's clock, (F,)."""
        rows, bounds = self._fused_tracks.listed_rows
        for first, last in blocks(bounds):
            captured_ns, lists = self._fused_tracks.fused.stamp_ns[first:last], last - first
            captured = starts(captured_ns != NO_CAPTURE_NS)
            said = Each(captured, [numbers(captured_ns[np.diff(captured) > 0], int(captured[-1]))])
            start = bounds[first : last + 1] - bounds[first]
            parts: list[Part] = [
                constant(b'{"available_ns":', lists),
                numbers(available_ns[first:last], lists),
                constant(b',"captured_ns":', lists),
                said,
                Texts.of([b"null", b""]).at(np.diff(captured)),
                constant(b',"objects":', lists),
                *array(start, self._objects(rows[bounds[first] : bounds[last]])),
                Texts.of([self._besides(frame) for frame in range(first, last)]).at(np.arange(lists)),
            ]
            yield from records(parts, lists)

    def _objects(self, rows: Int) -> list[Part]:
        fused, said, of = self._fused_tracks.fused, self._fused_tracks.said, len(rows)
        parts: list[Part] = [constant(b'{"id":', of), self._names.at(self._name[rows])]
        if said is not None:
            parts += [constant(b',"existence":', of), numbers(said["existence"][rows], of)]
        sized = self._sizes_of[rows]
        sides: list[Part] = []
        for name in ("length_m", "width_m"):
            values = getattr(fused, name)[0, rows[sized]]
            sides += [constant(f',"{name}":'.encode(), len(values)), numbers(values, len(values))]
        parts.append(Each(starts(sized), sides))
        for name in UNCERTAINTIES:
            variance = getattr(fused, name)
            parts += [
                constant(f',"{name}":'.encode(), of),
                numbers(None if variance is None else variance[0, rows], of),
            ]
        return [*parts, *self._entries(rows), constant(b"}", of)]

    def _entries(self, rows: Int) -> list[Part]:
        """Of what each object was made."""
        heard, view = self._fused_tracks.heard, self._fused_tracks.view
        start, places = ranges(self._fused_tracks.used_start, rows)
        used = self._fused_tracks.used[places]
        columns = {
            "units": self._units.at(heard.row_unit_ix[used]),
            "captured_ns": numbers(heard.stamp_ns[heard.frame_ix[used]], len(used)),
            "range_m": numbers(None if view is None else view.range_m[used], len(used)),
            "visible_share": numbers(None if view is None else view.visible_share[used], len(used)),
        }
        parts: list[Part] = []
        for name, column in columns.items():
            parts += [constant(f',"{name}":'.encode(), len(rows)), *array(start, [column])]
        return parts

    def _besides(self, frame: int) -> bytes:
        """What a message ends with: what was detected with its list, and what went wrong."""
        content = {"events": list(self._events.get(frame, ())), **(self._faults[frame] if self._faults else {})}
        return b"," + orjson.dumps(content)[1:]

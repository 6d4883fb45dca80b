"""What a list of objects cannot carry of a fused list, losslessly, as JSON beside it.

One message per list on `copem/<configuration>/detail`: the full covariance and variances of each object, the entries of
the units' lists it was made of (parallel lists of unit, capture, range, visible share), and what was detected with it.
Of a fusion without truth ids: what it claims of the existence, and no entries. Objects are in the order of the list.
Where units have ghosts or outages, `ghosts` are the entries about nobody in the lists that came in with this one, and
`down` the units whose last list was not made.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import orjson

from copem_replay.core.tracks import NO_CAPTURE_NS, UNCERTAINTIES, Bool, Scene
from copem_replay.io.write.fault_details import faults_by_list

if TYPE_CHECKING:
    from copem_replay.core.fused_tracks import FusedTracks

SCHEMA = "copem_replay.ListDetail"
Event = Mapping[str, Any]
"""What was detected: `object`, `first_unit`, `onset_s`, `captured_s`, `time_to_detection_s`, and how far away."""

_NUMBER = {"type": ["number", "null"]}
JSON_SCHEMA = {
    "title": SCHEMA,
    "type": "object",
    "properties": {
        "available_ns": {"type": "integer"},
        "captured_ns": {"type": ["integer", "null"]},
        "objects": {
            "type": "array",
            "items": {
                "type": "object",
                "properties": {
                    "id": {"type": "string"},
                    "existence": {"type": "number"},
                    **dict.fromkeys(UNCERTAINTIES, _NUMBER),
                    "units": {"type": "array", "items": {"type": "string"}},
                    "captured_ns": {"type": "array", "items": {"type": "integer"}},
                    "range_m": {"type": "array", "items": _NUMBER},
                    "visible_share": {"type": "array", "items": _NUMBER},
                },
            },
        },
        "events": {"type": "array", "items": {"type": "object"}},
    },
}


class DetailWriter:
    """Turns the fused lists of one run (values (1, P)) into messages, list by list.

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
        fused, heard, used = fused_tracks.fused, fused_tracks.heard, fused_tracks.used
        self._fused, self._listed, self._events = fused, fused_tracks.listed, events
        self._ids = [fused_tracks.name_of(scene, row) for row in range(len(fused.frame_ix))]
        unsaid = [None] * len(fused.frame_ix)
        variances = (getattr(fused, name) for name in UNCERTAINTIES)
        self._variances = list(zip(*(unsaid if a is None else a[0].tolist() for a in variances), strict=True))
        nothing: list[float | None] = [None] * len(used)
        self._entries: dict[str, list[Any]] = {
            "units": [heard.units[k] for k in heard.row_unit_ix[used]],
            "captured_ns": heard.stamp_ns[heard.frame_ix[used]].tolist(),
            "range_m": nothing if fused_tracks.view is None else fused_tracks.view.range_m[used].tolist(),
            "visible_share": nothing if fused_tracks.view is None else fused_tracks.view.visible_share[used].tolist(),
        }
        self._start = fused_tracks.used_start.tolist()
        self._said = fused_tracks.said
        self._faults = faults_by_list(fused_tracks)
        self._sizes_of = np.zeros(len(fused.frame_ix), dtype=bool) if sizes_of is None else sizes_of

    def message(self, frame: int, available_ns: int) -> bytes:
        """List number `frame` as it became available at `available_ns` of the log's clock."""
        captured_ns = int(self._fused.stamp_ns[frame])
        content = {
            "available_ns": available_ns,
            "captured_ns": None if captured_ns == NO_CAPTURE_NS else captured_ns,
            "objects": [self._object(row) for row in self._listed(frame)],
            "events": list(self._events.get(frame, ())),
            **(self._faults[frame] if self._faults else {}),
        }
        return orjson.dumps(content)

    def _object(self, row: int) -> dict[str, Any]:
        first, last = self._start[row], self._start[row + 1]
        claimed = {} if self._said is None else {"existence": float(self._said["existence"][row])}
        sides = ("length_m", "width_m") if self._sizes_of[row] else ()
        return {
            "id": self._ids[row],
            **claimed,
            **{name: float(getattr(self._fused, name)[0, row]) for name in sides},
            **dict(zip(UNCERTAINTIES, self._variances[row], strict=True)),
            **{name: values[first:last] for name, values in self._entries.items()},
        }


def parse(payload: bytes) -> dict[str, Any]:
    """A message as it was written."""
    content: dict[str, Any] = json.loads(payload)
    return content

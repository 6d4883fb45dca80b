"""What osi3.SensorData cannot carry of a fused list, losslessly, as JSON beside it.

One message per list on `copem/<configuration>/detail`: the full covariance and variances of each object, the entries of
the units' lists it was made of (unit, capture, range, visible share), and what was detected with this list.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from copem_replay.fusion.ideal import Belief
from copem_replay.tracks import UNCERTAINTIES, Scene

SCHEMA = "copem_replay.ListDetail"
Event = Mapping[str, Any]
"""What was detected: `object`, `first_unit`, `onset_s`, `captured_s`, `time_to_detection_s`, and how far away."""

_NUMBER = {"type": ["number", "null"]}
JSON_SCHEMA = {
    "title": SCHEMA,
    "type": "object",
    "properties": {
        "available_ns": {"type": "integer"},
        "captured_ns": {"type": "integer"},
        "objects": {
            "type": "array",
            "items": {
                "type": "object",
                "properties": {
                    "id": {"type": "string"},
                    **dict.fromkeys(UNCERTAINTIES, _NUMBER),
                    "entries": {
                        "type": "array",
                        "items": {
                            "type": "object",
                            "properties": {
                                "unit": {"type": "string"},
                                "captured_ns": {"type": "integer"},
                                "range_m": _NUMBER,
                                "visible_share": _NUMBER,
                            },
                        },
                    },
                },
            },
        },
        "events": {"type": "array", "items": {"type": "object"}},
    },
}


class DetailWriter:
    """Turns the fused lists of one run (values (1, P)) into messages, list by list.

    `events[k]` is what was detected with list k.
    """

    def __init__(self, scene: Scene, belief: Belief, events: Mapping[int, Sequence[Event]]) -> None:
        self._scene, self._belief, self._events = scene, belief, events
        self._order, self._bounds = belief.fused.by_frame
        self._variances = {
            name: [None] * len(belief.fused.frame_ix) if (a := getattr(belief.fused, name)) is None else a[0].tolist()
            for name in UNCERTAINTIES
        }

    def message(self, frame: int, available_ns: int) -> bytes:
        """List number `frame` as it became available at `available_ns` of the log's clock."""
        fused = self._belief.fused
        rows = self._order[self._bounds[frame] : self._bounds[frame + 1]]
        content = {
            "available_ns": available_ns,
            "captured_ns": int(fused.stamp_ns[frame]),
            "objects": [self._object(row) for row in rows[fused.valid[0, rows]].tolist()],
            "events": list(self._events.get(frame, ())),
        }
        return json.dumps(content, allow_nan=False, separators=(",", ":"), ensure_ascii=False).encode()

    def _object(self, row: int) -> dict[str, Any]:
        belief = self._belief
        heard, look = belief.heard, belief.look
        entries = belief.entries[belief.start[row] : belief.start[row + 1]]
        return {
            "id": self._scene.object_ids[belief.fused.row_object_ix[row]],
            **{name: values[row] for name, values in self._variances.items()},
            "entries": [
                {
                    "unit": heard.units[heard.row_unit_ix[k]],
                    "captured_ns": int(heard.stamp_ns[heard.frame_ix[k]]),
                    "range_m": None if look is None else float(look.range_m[k]),
                    "visible_share": None if look is None else float(look.visible_share[k]),
                }
                for k in entries[heard.valid[0, entries]].tolist()
            ],
        }


def parse(payload: bytes) -> dict[str, Any]:
    """A message as it was written."""
    content: dict[str, Any] = json.loads(payload)
    return content

"""How far each measured object has come in a configuration, at each of its lists, for State Transitions panels.

Known is what the table says: from `detection_s` on, and never before, while the newest list holds the object.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import orjson
import pandas as pd

from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import SAME_INSTANT_NS, Scene

SCHEMA = "copem_replay.Status"
NOT_LISTED, LISTED, KNOWN = "not listed", "listed, not known", "known"
JSON_SCHEMA = {
    "title": SCHEMA,
    "type": "object",
    "properties": {
        "available_ns": {"type": "integer"},
        "objects": {
            "type": "array",
            "items": {
                "type": "object",
                "properties": {
                    "id": {"type": "string"},
                    "status": {"type": "string"},
                    "age_s": {"type": ["number", "null"]},
                },
            },
        },
    },
}


class Statuses:
    """The statuses of the measured objects of one run; `table`: its rows of this log and configuration."""

    def __init__(self, scene: Scene, fused_tracks: FusedTracks, table: pd.DataFrame) -> None:
        self._fused_tracks = fused_tracks
        self._known_ns = {
            scene.object_number[row.object_id]: scene.t0_ns + round(row.detection_s * 1e9) if row.detected else None
            for row in table[["object_id", "detected", "detection_s"]].itertuples(index=False)
        }
        self._names, self._t0_ns = scene.object_ids, scene.t0_ns

    def at(self, frame: int, available_ns: int) -> Iterator[tuple[str, str, float | None]]:
        """Id and status of each object, and how old its entry is, with list `frame` as it became available."""
        rows = self._fused_tracks.listed(frame)
        available_s = (available_ns - self._t0_ns) * 1e-9
        captured_s = self._fused_tracks.captured_s[0]
        ages = {
            number: round(max(0.0, available_s - float(captured_s[row])), 6)
            for row, number in zip(rows, self._fused_tracks.fused.row_object_ix[rows].tolist(), strict=True)
        }
        for number, known_ns in self._known_ns.items():
            known = known_ns is not None and available_ns >= known_ns - SAME_INSTANT_NS
            status = NOT_LISTED if number not in ages else KNOWN if known else LISTED
            age_s = ages.get(number, math.inf)
            yield self._names[number], status, age_s if math.isfinite(age_s) else None


class StatusWriter:
    """The same as JSON, list by list."""

    def __init__(self, statuses: Statuses) -> None:
        self._statuses = statuses

    def message(self, frame: int, available_ns: int) -> bytes:
        """List number `frame` as it became available at `available_ns` of the log's clock."""
        found = self._statuses.at(frame, available_ns)
        objects = [{"id": name, "status": status, "age_s": age_s} for name, status, age_s in found]
        return orjson.dumps({"available_ns": available_ns, "objects": objects})

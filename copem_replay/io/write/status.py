"""How far each measured object has come in a configuration, at each of its lists, for State Transitions panels.

Known is what the table says: from `detection_s` on, and never before, while the newest list holds the object.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pandas as pd

from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import SAME_INSTANT_NS, Float, Int, Scene
from copem_replay.io.encodings.column_bytes import Part, constant, records
from copem_replay.io.encodings.json_columns import array, numbers, texts

SCHEMA = "copem_replay.Status"
STATUSES = NOT_LISTED, LISTED, KNOWN = "not listed", "listed, not known", "known"
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
        """Of each list and object, (F, K), index into STATUSES, and age of the entry, NaN: none, or not told."""
        rows, bounds = self._fused_tracks.listed_rows
        frame, number = np.repeat(np.arange(len(available_ns)), np.diff(bounds)), self._fused_tracks.fused.row_object_ix
        available_s = (available_ns - self._t0_ns) * 1e-9
        ages_s = np.fmax(0.0, available_s[frame] - self._fused_tracks.captured_s[0, rows])
        every = np.full((len(available_ns), self._count + 1), np.nan)  # of objects; the last: of none
        every[frame, number[rows]] = [round(age_s, 6) if math.isfinite(age_s) else age_s for age_s in ages_s.tolist()]
        age_s = every[:, self._objects]
        known = available_ns[:, None] >= self._known_ns - SAME_INSTANT_NS
        return np.where(np.isnan(age_s), 0, np.where(known, 2, 1)), np.where(np.isfinite(age_s), age_s, np.nan)


class StatusWriter:
    """The same as JSON, list by list."""

    def __init__(self, statuses: Statuses) -> None:
        self._statuses = statuses

    def messages(self, available_ns: Int) -> Iterator[bytes]:
        """The lists as they became available at these instants of the log's clock, (F,)."""
        names = self._statuses.names
        lists, objects = len(available_ns), len(names)
        status, age_s = self._statuses.at(available_ns)
        parts: list[Part] = [
            constant(b'{"id":', lists * objects),
            texts(names).at(np.tile(np.arange(objects), lists)),
            constant(b',"status":', lists * objects),
            texts(STATUSES).at(status.ravel()),
            constant(b',"age_s":', lists * objects),
            numbers(age_s.ravel(), lists * objects),
            constant(b"}", lists * objects),
        ]
        whole: list[Part] = [
            constant(b'{"available_ns":', lists),
            numbers(available_ns, lists),
            constant(b',"objects":', lists),
            *array(np.arange(lists + 1) * objects, parts),
            constant(b"}", lists),
        ]
        yield from records(whole, lists)

"""Tally: in how many runs each object is detected at each instant, or never. The summary and `compare` are made of it.

Whole numbers, so that counts of any runs in any order add up to the same.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from copem_replay.core.tracks import Int

DETECTED = "detected"
"""The event of the first list that confirms the object."""
CONFLICT = "conflict"
"""The event of the first list that implies a collision."""

_OF_EVENT = {
    DETECTED: {
        "detection_s": "detection_s",
        "time_to_detection_s": "time_to_detection_s",
        "distance_at_detection_m": "distance_at_detection_m",
        "gap_at_detection_m": "gap_at_detection_m",
    },
    CONFLICT: {
        "detection_s": "conflict_detection_s",
        "time_to_detection_s": "time_to_conflict_detection_s",
        "distance_at_detection_m": "distance_at_conflict_detection_m",
    },
}
"""Columns of the tally, and which of `detections.parquet` they are; empty in the row for never."""
_OF_OBJECT = ("object_id", "object_class", "onset_s", "ended_s", "ended_by")


def tally(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows of `tally.parquet` of rows of `detections.parquet`, in their order of logs, configurations and objects.

    What is known of an object at an instant is the same in all runs: of the rows that share both one stands for `runs`.
    """
    parts = [_of_event(rows, event) for event in _OF_EVENT if event == DETECTED or "conflict_detected" in rows]
    found = pd.concat(parts, ignore_index=True)
    order = np.lexsort([pd.factorize(found[name])[0] for name in ("configuration", "log")])  # stable: events stay
    return found.iloc[order].reset_index(drop=True)


def _of_event(rows: pd.DataFrame, event: str) -> pd.DataFrame:
    columns = {name: of for name, of in _OF_EVENT[event].items() if of in rows}
    time_s = rows[columns["time_to_detection_s"]].to_numpy(dtype=float)
    known = rows["detected" if event == DETECTED else "conflict_detected"].to_numpy(dtype=bool)
    time_s = np.where(known, time_s + 0.0, np.inf)  # −0 is 0, and never comes last
    episode = np.zeros(len(rows), dtype=np.int64)
    for name in ("log", "configuration", "object_id"):
        episode = _pairs(episode, rows[name])[0]
    group, number, instant_s = _pairs(episode, time_s)
    first_of = np.empty(len(number), dtype=np.int64)
    first_of[group[::-1]] = np.arange(len(rows))[::-1]
    order = np.lexsort((instant_s, number))
    first_of, runs = first_of[order], np.bincount(group, minlength=len(order))[order]
    found = {
        **{name: rows[name].take(first_of).to_numpy() for name in ("log", "configuration")},
        "event": np.full(len(order), event, dtype=object),
        **{name: rows[name].take(first_of).to_numpy() for name in _OF_OBJECT if name in rows},
        **{name: rows[of].take(first_of).to_numpy() for name, of in columns.items()},
        "runs": runs,
    }
    if "conflict" in rows:
        passed = rows["braking_pass"].fillna(False).to_numpy(dtype=bool)
        found["in_conflict"] = rows["conflict"].to_numpy(dtype=bool)[first_of]
        found["passed"] = np.bincount(group, passed, minlength=len(order)).astype(np.int64)[order]
    return pd.DataFrame(found)


def _pairs(number: Int, values: Any) -> tuple[Int, Int, Any]:
    """Which pair of number and value each row (n,) has, counted as pairs appear, and the pairs. By hash, not sorted."""
    of, found = pd.factorize(values)
    pair, pairs = pd.factorize(number * max(len(found), 1) + of)
    return pair, pairs // max(len(found), 1), found[pairs % max(len(found), 1)]

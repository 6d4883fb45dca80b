"""Why a configuration does not know an object, or how it does: a short label in the picture, a sentence on demand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from copem_replay.core.tracks import TRUTH, Bool, Int, Scene
from copem_replay.experiment.schema import Experiment
from copem_replay.viewer.sink import short_ids
from copem_replay.viewer.statuses import (
    CAPTURED,
    EARLY,
    HIDDEN,
    KNOWN,
    LOST,
    STATUSES,
    TOO_LATE,
    UNCONFIRMED,
    UNLISTED,
    UNMATCHED,
    VISIBLE,
)

if TYPE_CHECKING:
    from copem_replay.viewer.line_of_sight import Sight
    from copem_replay.viewer.status import Status

OLD_S = 0.05
"""What is younger than this is not said to be old (chosen: less than a list)."""


@dataclass(frozen=True)
class Reasons:
    """Of (P,) instants and objects: what is drawn over each, and what is told when it is selected.

    `number`: the same for the same sentence.
    """

    labels: pa.Array
    sentences: pa.Array
    number: Int


def reasons(
    scene: Scene, experiment: Experiment, seen: Sight, made: Status, rows: Int, column: Int, started: Bool
) -> Reasons:
    """(P,) in words; each sentence is made once. `started`: whether the object's clock runs."""
    frame, status, unit = np.maximum(made.frame[rows], 0), made.status[rows, column], made.unit_ix[rows, column]
    hidden = np.flatnonzero(status == HIDDEN)
    by = unit[hidden], frame[hidden], column[hidden]
    share, body = np.zeros(len(rows)), np.zeros(len(rows), dtype=np.int64)
    share[hidden], body[hidden] = seen.share[by], seen.body_ix[by]
    time_s = np.nan_to_num(
        np.where(status >= EARLY, made.age_of_information_s[rows, column], made.until_s[rows, column])
    )
    near = seen.in_range[:, frame, column].any(axis=0)
    whole = [np.rint(value).astype(np.int64) for value in (time_s * 10, share * 100)]
    columns = np.stack([column, status, unit, *whole, body, near, started], axis=-1)
    keys, which = _distinct(columns)
    ids, units = short_ids(scene), [*experiment.units, TRUTH]  # −1: the truth, or no unit
    asked = [
        (ids[seen.object_ix[key[0]]], units[key[2]], body_name(ids, seen.solids, key[5]), key) for key in keys.tolist()
    ]
    taken = pa.array(which)
    labels = [_label(name, unit, what, key) for name, unit, what, key in asked]
    sentences = [_sentence(name, unit, what, key) for name, unit, what, key in asked]
    return Reasons(pa.array(labels, pa.string()).take(taken), pa.array(sentences, pa.string()).take(taken), which)


def body_name(ids: Sequence[str], solids: Sequence[str], body: int) -> str:
    """What hides an object: an object by its index, or −1 − k: the solid k."""
    return ids[body] if body >= 0 else solids[-1 - body]


def _distinct(columns: Int) -> tuple[Int, Int]:
    """Rows (D, C) that differ, and which of them each is (P,). As one number each: rows sort slowly."""
    low = columns.min(axis=0, initial=0)
    span = columns.max(axis=0, initial=0) - low + 1
    packed = np.ravel_multi_index(tuple((columns - low).T), tuple(span.tolist()))
    _, first, which = np.unique(packed, return_index=True, return_inverse=True)
    return columns[first], which.reshape(-1)


def _label(name: str, unit: str, what: str, key: list[int]) -> str:
    """“58 behind 41”; what is known is only named."""
    _, status, _, _, _, _, near, started = key
    said = {
        KNOWN: "",
        EARLY: " listed, onset not known" if started else " listed",
        UNCONFIRMED: " not confirmed",
        TOO_LATE: " too late",
        CAPTURED: " on its way",
        UNMATCHED: " unmatched",
        LOST: " list lost",
        UNLISTED: " not listed",
        VISIBLE: " not listed yet" if unit == TRUTH else " not listed",
        HIDDEN: f" behind {what}",
    }
    return name + said.get(status, " out of view" if near else " out of range")


def _sentence(name: str, unit: str, what: str, key: list[int]) -> str:
    """“58 hidden from ego by 41 (share 0.21)”."""
    _, status, _, tenths, hundredths, _, near, started = key
    if status >= EARLY:
        old = "" if tenths * 0.1 <= OLD_S else f", {tenths / 10:.1f} s old"
        early = ", onset not known yet" if started else ""
        after = {EARLY: f"{old}{early}", UNCONFIRMED: f"{old}, not confirmed yet", TOO_LATE: f" too late{old}"}
        return f"{name} known{old}" if status == KNOWN else f"{name} listed{after[status]}"
    if status == CAPTURED:
        return f"{name} listed by {unit}, arrives in {tenths / 10:.1f} s"
    if status == UNMATCHED:
        return f"{name} listed by {unit}, no entry matched"
    if status == LOST:
        return f"{name} listed by {unit}, list lost"
    if status == VISIBLE:
        return f"{name} not listed yet" if unit == TRUTH else f"{name} seen by {unit}, not listed"
    if status == UNLISTED:
        return f"{name} not listed"
    if status == HIDDEN:
        return f"{name} hidden from {unit} by {what} (share {hundredths / 100:.2f})"
    return f"{name} outside fields of view" if near else f"{name} out of range"


def lane_text(status: int, unit: str, what: str) -> str:
    """What a lane says of a while: “behind 41 (from ego)”."""
    if status == HIDDEN:
        return f"behind {what} (from {unit})"
    if status == VISIBLE:
        return "not listed yet" if unit == TRUTH else f"seen by {unit}, not listed"
    if status == CAPTURED:
        return f"on its way from {unit}"
    return "listed, captured before the onset" if status == EARLY else STATUSES[status]

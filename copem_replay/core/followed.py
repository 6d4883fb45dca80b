"""Rows of the same lists, those of one bag of tracks after those of another."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from copem_replay.core.tracks import UNCERTAINTIES, VALUES, Tracks


def followed_by(tracks: Tracks, others: Tracks) -> Tracks:
    """The tracks and then the others, in the lists that both have; variances that one does not state are 0 there.

    Both are of one run.
    """
    columns: dict[str, Any] = {}
    for name in ("valid", *VALUES, *UNCERTAINTIES):
        stated = [getattr(part, name) for part in (tracks, others)]
        if all(column is None for column in stated):
            continue
        parts = zip((tracks, others), stated, strict=True)
        filled = [np.zeros((1, len(part.frame_ix))) if column is None else column for part, column in parts]
        columns[name] = np.concatenate(filled, axis=1)
    for name in ("unit_ix", "object_ix", "frame_ix"):
        columns[name] = np.concatenate([getattr(tracks, name), getattr(others, name)])
    return replace(tracks, start=np.concatenate([tracks.start, others.start[1:] + tracks.start[-1]]), **columns)

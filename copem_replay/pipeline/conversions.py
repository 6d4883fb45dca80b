"""Between tracks with truth ids and lists without: so that every fusion is measured, written and shown alike."""

from __future__ import annotations

import numpy as np

from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.object_list import COVARIANCES, ObjectLists
from copem_replay.core.tracks import CLASSES, NO_CAPTURE_NS, VALUES, Float, Int, Scene, Tracks
from copem_replay.fusion.inputs import Claims, gathered
from copem_replay.metrics.matching import MATCH, Matches


def as_lists(fused_tracks: FusedTracks, scene: Scene) -> ObjectLists:
    """Fused tracks of ideal fusion, or of the truth itself, as lists: existence is 1 and the class is certain.

    Its truth ids are no tracks: it is not it that would confuse two objects.
    """
    fused = fused_tracks.fused
    object_ix = fused.row_object_ix
    likely = np.eye(len(CLASSES))[scene.object_class[object_ix]]
    claims = Claims(np.ones(len(object_ix)), likely, np.full(len(object_ix), -1))
    lists, run, row = gathered(fused, claims, np.zeros(fused.valid.shape), fused.valid)
    lists.entries["captured_s"] = fused_tracks.captured_s[run, row]
    lists.entries["unit_ix"] = fused_tracks.first_unit_ix[run, row]
    return lists


def as_fused_tracks(
    lists: ObjectLists, run: int, matches: Matches, heard: Tracks, issue_s: Float, newest: Int
) -> FusedTracks:
    """The lists of one run as tracks: one of each matched object, one of each identity else, one of each entry else.

    `issue_s (K,)`, `newest (K, U)`: the receiver's instants.
    """
    first, last = int(lists.start[run, 0]), int(lists.start[run, -1])
    said = lists.entries[first:last]
    frame = np.repeat(np.arange(len(issue_s)), np.diff(lists.start[run]))
    object_ix = np.where(matches.role[first:last] == MATCH, matches.object_ix[first:last], -1)
    # Whoever is matched goes by its object, else by the fusion's own identity, else by itself.
    alone = (object_ix < 0) & (said["track_id"] < 0)
    ident = np.where(object_ix >= 0, 0, np.where(alone, np.arange(len(said)), said["track_id"]))
    order = np.lexsort((frame, ident, alone, object_ix))
    new = np.ones(len(order), dtype=bool)
    for key in (object_ix, alone, ident):
        new[1:] &= key[order][1:] == key[order][:-1]
    new[1:] = ~new[1:]
    start = np.append(np.flatnonzero(new), len(order))
    stamps = np.where(newest >= 0, heard.stamp_ns[newest], NO_CAPTURE_NS).max(axis=1, initial=NO_CAPTURE_NS)
    captured = np.where(newest >= 0, heard.captured_s[newest], -np.inf).max(axis=1, initial=-np.inf)
    fused = Tracks(
        units=("fused",),
        start=start,
        unit_ix=np.zeros(len(start) - 1, dtype=np.int64),
        object_ix=object_ix[order][start[:-1]],
        frame_ix=frame[order],
        stamp_ns=stamps,
        captured_s=captured,
        frame_unit_ix=np.zeros(len(issue_s), dtype=np.int64),
        arrives_s=issue_s[None],
        valid=np.ones((1, len(order)), dtype=bool),
        **{name: said[name][order][None] for name in (*VALUES, *COVARIANCES)},
    )
    none = np.zeros(len(order) + 1, dtype=np.int64)
    return FusedTracks(fused, heard, none[:0], none, None, said[order])

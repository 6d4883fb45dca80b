"""Between tracks with truth ids and lists without: so that every fusion is measured, written and shown alike."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.fused_tracks import FusedTracks, Sources, newest_and_first
from copem_replay.core.kernels import borrowing
from copem_replay.core.object_list import COVARIANCES, ENTRY, ObjectLists
from copem_replay.core.tracks import NO_CAPTURE_NS, VALUES, Bool, Float, Int, Scene, Tracks
from copem_replay.fusion.ideal import floored
from copem_replay.metrics.matching import MATCH, Matches


def as_lists(fused_tracks: FusedTracks, scene: Scene) -> ObjectLists:
    """Fused tracks of ideal fusion, or of the truth itself, as lists: existence is 1 and the class is certain.

    Its truth ids are no tracks: it is not it that would confuse two objects.
    """
    fused = fused_tracks.fused
    order, bounds = fused.by_frame
    start = np.zeros((len(fused.valid), len(bounds)), dtype=np.int64)
    entries = np.empty(int(fused.valid.sum()), dtype=ENTRY)
    states = np.stack(np.broadcast_arrays(*(getattr(fused, name) for name in VALUES), *floored(fused)))
    words = entries.view(np.float64).reshape(len(entries), ENTRY.itemsize // 8)
    ids = entries.view(np.int64).reshape(words.shape)
    _fill(
        fused.valid,
        order,
        bounds,
        states,
        scene.object_class[fused.row_object_ix],
        fused_tracks.sources,
        start,
        words,
        ids,
    )
    return ObjectLists(start, entries)


_CAPTURED = ENTRY.itemsize // 8 - 3
_UNIT, _TRACK = _CAPTURED + 1, _CAPTURED + 2
_EXISTENCE = len(VALUES) + len(COVARIANCES)
_CLASS = _EXISTENCE + 1
"""Places in an entry, in words of eight bytes; the states are at its beginning."""


@borrowing
def _fill(
    valid: Bool, order: Int, bounds: Int, states: Float, classes: NDArray[np.int8], source: Sources,
    start: Int, words: Float, ids: Int,
) -> None:  # fmt: skip
    # Entries run by run and list by list, as numbers and as integers of the same memory. States are (12, S | 1, P).
    n = 0
    for s in range(valid.shape[0]):
        start[s, 0] = n
        for f in range(len(bounds) - 1):
            for p in order[bounds[f] : bounds[f + 1]]:
                if not valid[s, p]:
                    continue
                for v in range(_EXISTENCE):
                    words[n, v] = states[v, s if states.shape[1] > 1 else 0, p]
                words[n, _EXISTENCE] = 1.0
                words[n, _CLASS:_CAPTURED] = 0.0
                words[n, _CLASS + classes[p]] = 1.0
                words[n, _CAPTURED], ids[n, _UNIT] = newest_and_first(source, s, p)
                ids[n, _TRACK] = -1
                n += 1
            start[s, f + 1] = n


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
    # Tracks: the matched object, else the fusion's own identity, else the entry itself.
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

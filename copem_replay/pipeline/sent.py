"""What units send of what they list in one run: decided list by list over the whole log, by what the units themselves
list, errors, false positives and all.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.communication.sends import LastSent, Listed
from copem_replay.core.random import Words, object_words
from copem_replay.core.tracks import CLASSES, Bool, Float, Int, Tracks, class_indices
from copem_replay.perception.claims import DrawnClaims, claims_of
from copem_replay.perception.ghosts import GhostRows, ghost_draws
from copem_replay.perception.perceive import draws_of

if TYPE_CHECKING:
    from copem_replay.pipeline.expansion import ExpandedExperiment
    from copem_replay.pipeline.receiver import WorldChunk

_VRU = class_indices(("vru",))


@dataclass(frozen=True)
class ClaimedRows:
    """What the modelled units claim of their rows (P,), ghosts last, in one run, and the object of each row.

    `words`: the object or the ghost; `same`: what the unit takes for one object, a number that is no index.
    """

    words: Words
    claims: DrawnClaims
    same: Words


def claimed_rows(world: WorldChunk, runs: Int, ghosts: GhostRows | None) -> ClaimedRows:
    """Of the rows of a time chunk. Where nothing of it is drawn it is the same in all runs."""
    found, experiment = world.found, world.experiment
    words = object_words(world.scene.object_ids)[found.tracks.row_object_ix]
    claims = DrawnClaims(found.existence, np.eye(len(CLASSES))[found.view.class_ix], np.full(len(words), -1))
    if experiment.runs_apart and experiment.draws_claims:  # else no receiver needs it
        claims = claims_of(found, experiment, draws_of(world.scene, found, experiment, runs))
    same = words
    if ghosts is not None:
        drawn = ghost_draws(world.scene, ghosts, experiment, int(runs[0]))
        of_ghosts = claims_of(ghosts.found, experiment, drawn, ghosts.sort)
        claims = DrawnClaims(
            np.concatenate([claims.existence, of_ghosts.existence]),
            np.concatenate([claims.class_probability, of_ghosts.class_probability]),
            np.concatenate([claims.track_id, of_ghosts.track_id]),
        )
        words = np.concatenate([words, ghosts.words])
        same = words
    # With ids of its own a unit takes for one object what has one id.
    same = np.where(claims.track_id >= 0, claims.track_id.astype(np.uint64), same)
    return ClaimedRows(words, claims, same)


@dataclass(frozen=True)
class SentObjects:
    """Of one run: lists (F,) that are not held back, and `keys` of the rows that `partial (U,)` units send."""

    lists: Bool
    partial: Bool
    keys: Words

    def of(self, seen: Tracks, words: Words) -> Tracks:
        """What is sent of the rows of the modelled units; `words (P,)`: the words of their objects."""
        left_out = self.partial[seen.row_unit_ix] & ~np.isin(_keys(seen.frame_ix, words), self.keys)
        arrives_s = np.where(self.lists, seen.common_arrives_s, np.inf)
        return replace(seen, valid=seen.valid & ~left_out & self.lists[seen.frame_ix], arrives_s=arrives_s[None])


def _keys(frame_ix: Int, words: Words) -> Words:
    """(P,) a number for each row: two of one list are never equal, two of others as good as never."""
    return words ^ _mixed(frame_ix.astype(np.uint64))


def _mixed(numbers: Words) -> Words:
    result: Words = numbers * np.uint64(0x9E3779B97F4A7C15)  # odd: no two become one
    return result


def sent_objects(
    experiment: ExpandedExperiment, chunks: Iterable[tuple[WorldChunk, Tracks, ClaimedRows]]
) -> SentObjects:
    """What is sent of the lists of one run, chunk after chunk: as the units list it, with errors, and what they claim.

    Lists have the same numbers in all chunks.
    """
    units = list(experiment.modelled)
    last = LastSent([experiment.sends.get(name) for name in units])
    sending = np.array([name in experiment.sends for name in units], dtype=bool)
    partial = np.array([name in experiment.partial for name in units], dtype=bool)
    slots: dict[tuple[int, int], int] = {}
    lists, keys = np.zeros(0, dtype=bool), [np.zeros(0, dtype=np.uint64)]
    for world, seen, rows in chunks:
        if not len(lists):
            lists = np.ones(len(seen.stamp_ns), dtype=bool)
        chunk = world.chunk
        mine = np.flatnonzero(
            sending[seen.frame_unit_ix] & np.isfinite(seen.common_arrives_s)
            & (seen.captured_s >= chunk.from_s) & (seen.captured_s < chunk.until_s)
        )  # fmt: skip
        mine = mine[np.argsort(seen.captured_s[mine], kind="stable")]
        order, bounds = seen.by_frame
        counts = np.diff(bounds)[mine]
        begin = np.cumsum(counts) - counts
        listed = order[np.repeat(bounds[mine] - begin, counts) + np.arange(counts.sum())]
        there = seen.valid[0, listed]
        start = np.append(0, np.cumsum(there))[np.append(begin, len(listed))]
        listed = listed[there]
        pairs, which = np.unique(
            np.stack([seen.row_unit_ix[listed].astype(np.uint64), rows.same[listed]]), axis=1, return_inverse=True
        )
        slot = np.array([slots.setdefault((u, w), len(slots)) for u, w in pairs.T.tolist()], dtype=np.int64)
        sent, included = last.choose(
            Listed(
                start, seen.frame_unit_ix[mine], seen.captured_s[mine], slot[which.ravel()], rows.words[listed],
                np.isin(rows.claims.class_probability[listed].argmax(axis=1), _VRU), _states(seen, listed),
                rows.claims.existence[listed],
            )
        )  # fmt: skip
        lists[mine[~sent]] = False
        keys.append(_keys(seen.frame_ix[listed[included]], rows.words[listed[included]]))
    return SentObjects(lists, partial, np.sort(np.concatenate(keys)))


def _states(seen: Tracks, rows: Int) -> Float:
    """(R, 4) x, y, speed and heading in one run."""
    vx_mps, vy_mps = seen.vx_mps[0, rows], seen.vy_mps[0, rows]
    return np.stack([seen.x_m[0, rows], seen.y_m[0, rows], np.hypot(vx_mps, vy_mps), seen.yaw_rad[0, rows]], axis=1)

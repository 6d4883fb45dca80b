"""What recorded lists tell when they are held against the truth: how late they are, and what is odd about them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.text import counted
from copem_replay.core.tracks import Bool, Int, Scene, Tracks
from copem_replay.io.short_tracks import entries_of
from copem_replay.io.time_offset import TimeOffset, time_offset

if TYPE_CHECKING:
    from copem_replay.io.recorded_osi import RecordedLists

LONGEST_S = 1.0
"""No list is later than this, as far as it is estimated (chosen)."""
EARLIEST_S = -0.2
"""Nor earlier: what shows the future has a clock of its own (chosen)."""
MANY = 0.2
"""More than this share of entries is no chance (chosen)."""
MOVING_MPS = 2.0
"""A track moves that is faster than this, and its unit says so (chosen: jitter of a place is not)."""
CHANGES_PER_MIN = 6.0
"""An object whose id changes more often is no longer one to what follows ids (chosen)."""


def delay_of(found: RecordedLists, scene: Scene, truth: Tracks) -> TimeOffset:
    """How long before their stamps lists were captured that do not say it, as their entries fit the truth best.

    Entries are taken as shifted along the way wherever that can be told from a delay.
    """
    unsaid = ~found.capture_said[found.tracks.frame_ix]
    lists = entries_of(found.tracks, scene.t0_ns, found.track_id)
    order = np.argsort(np.unique(found.tracks.stamp_ns, return_inverse=True)[1][found.tracks.frame_ix], kind="stable")
    lists = lists.take(np.flatnonzero(unsaid[order]))
    return time_offset(entries_of(truth, scene.t0_ns), lists, from_s=EARLIEST_S, to_s=LONGEST_S, shifted=True)


def delay_words(found: TimeOffset) -> str:
    """`0.148 s (95 %: 0.123 … 0.172 s, …)`, or that it cannot be told."""
    if found.untold is not None:
        return f"cannot be told: {found.untold}"
    said = f"{found.offset_s:.3f} s (95 %: {found.low_s:.3f} … {found.high_s:.3f} s"
    return said + (", if no entry is shifted along its way, which cannot be told apart)" if found.unbiased else ")")


def odd_about(found: RecordedLists, object_ix: Int, scene: Scene) -> Iterator[str]:
    """Velocities that point backwards, ids that change, entries about others than the truth: one line each.

    `object_ix (P,)`: which true object each entry is about, −1: none.
    """
    backwards = backwards_share(found)
    if backwards is not None and backwards > MANY:
        yield (
            f"its velocities point against the way its own tracks move ({backwards:.0%} of its entries); what goes by "
            "them (`tracker` with `late: predict`, new tracks) is led astray"
        )
    yield from _changing_ids(found, object_ix, scene)
    there = len(object_ix)
    unknown = int((object_ix < 0).sum())
    if there and unknown > MANY * there:
        yield (
            f"{unknown} of {counted(there, 'entry', 'entries')} are about no object of the truth: others that it "
            "does not have, or false ones; both count as false positives"
        )


def _changing_ids(found: RecordedLists, object_ix: Int, scene: Scene) -> Iterator[str]:
    """The object whose id changes most often."""
    known = np.flatnonzero((object_ix >= 0) & (found.track_id >= 0))
    time_s = found.tracks.row_captured_s
    order = known[np.lexsort((time_s[known], object_ix[known]))]
    same = np.diff(object_ix[order]) == 0
    changed = same & (np.diff(found.track_id[order]) != 0)
    if not changed.any():
        return
    changes = np.bincount(object_ix[order][1:][changed], minlength=len(scene.object_ids))
    worst = int(changes.argmax())
    mine = time_s[order[object_ix[order] == worst]]
    span_s = float(mine[-1] - mine[0])
    if changes[worst] > 1 and changes[worst] * 60 > CHANGES_PER_MIN * span_s:
        ids = len(np.unique(found.track_id[order[object_ix[order] == worst]]))
        yield (
            f"its ids change: object {scene.object_ids[worst]} has {ids} ids in {span_s:.1f} s and changes between "
            f"them {counted(int(changes[worst]), 'time')}"
        )


def backwards_share(found: RecordedLists) -> float | None:
    """Of the entries of moving tracks the share whose velocity points against their way; None: nothing moves."""
    tracks = found.tracks
    named = np.flatnonzero(found.track_id >= 0)
    order = named[np.lexsort((tracks.row_captured_s[named], found.track_id[named]))]
    same: Bool = (np.diff(found.track_id[order]) == 0) & (np.diff(tracks.row_captured_s[order]) > 0)
    before, after = order[:-1][same], order[1:][same]
    step_s = tracks.row_captured_s[after] - tracks.row_captured_s[before]
    east, north = ((getattr(tracks, n)[0, after] - getattr(tracks, n)[0, before]) / step_s for n in ("x_m", "y_m"))
    vx, vy = tracks.vx_mps[0, after], tracks.vy_mps[0, after]
    moving = (np.hypot(east, north) > MOVING_MPS) & (np.hypot(vx, vy) > MOVING_MPS)
    if not moving.any():
        return None
    return float(((east * vx + north * vy) < 0)[moving].mean())


def captured_before(found: RecordedLists, scene: Scene, delay_s: float) -> RecordedLists:
    """The lists captured so long before their stamps where they do not say it."""
    late_ns = np.where(found.capture_said, 0, round(delay_s * 1e9))
    stamp_ns = found.tracks.stamp_ns - late_ns
    captured_s = (stamp_ns - scene.t0_ns) * np.float64(1e-9)
    return replace(found, tracks=replace(found.tracks, stamp_ns=stamp_ns, captured_s=captured_s))

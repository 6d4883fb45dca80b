"""Visible share of an object over time, from the ego's units and from all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from copem_replay.core.tracks import Float, Int, Tracks
from copem_replay.perception.observation import Observations
from copem_replay.perception.sensor_poses import carrier
from copem_replay.pipeline.prepare import Replay

BY_EGO, BY_ANY = "ego", "any unit"
"""Names of curves: the best share of the ego's units, and of all."""


@dataclass(frozen=True)
class Curve:
    """Visible share of one object at instants (K,); NaN where no unit has a list of it."""

    elapsed_ns: Int
    share: Float


def share_curves(replay: Replay, found: Observations, object_ix: int) -> dict[str, Curve]:
    """The curves of an object, without those that no unit sees. `found`: its rows, at least."""
    scene, experiment, tracks = replay.scene, replay.expanded, found.tracks
    stamps, newest = _newest_lists(tracks, experiment.max_gap_s)
    carriers = np.array([carrier(scene, unit) for unit in experiment.modelled.values()], dtype=np.int64)
    own = (carriers == scene.ego_ix) & (scene.ego_ix >= 0)
    share = np.full(len(tracks.stamp_ns) + 1, np.nan)  # one more: what −1 points at
    rows = np.flatnonzero(tracks.row_object_ix == object_ix)
    share[tracks.frame_ix[rows]] = found.view.visible_share[rows]
    # A unit without a list of the object says nothing about it: the best of the others counts.
    return {
        name: Curve(stamps - scene.t0_ns, np.fmax.reduce(share[newest[units]], axis=0))
        for name, units in ((BY_EGO, own), (BY_ANY, np.ones_like(own)))
        if units.any()
    }


def _newest_lists(tracks: Tracks, max_gap_s: float) -> tuple[Int, Int]:
    """All capture instants (K,), and the newest list of each unit at each (U, K): −1, none for `max_gap_s`."""
    stamps = np.unique(tracks.stamp_ns)
    newest = np.full((len(tracks.units), len(stamps)), -1)
    for unit in range(len(tracks.units)):
        mine = np.flatnonzero(tracks.frame_unit_ix == unit)  # in order of capture
        at = np.searchsorted(tracks.stamp_ns[mine], stamps, side="right") - 1
        known = at >= 0
        known[known] = stamps[known] - tracks.stamp_ns[mine[at[known]]] <= max_gap_s * 1e9
        newest[unit, known] = mine[at[known]]
    return stamps, newest

"""Outages: for a while a unit makes no list at all, which is not an empty one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.lasting import held, shared
from copem_replay.core.random import CounterRng, RandomKey
from copem_replay.core.tracks import Bool, Int, Scene, Tracks

if TYPE_CHECKING:
    from copem_replay.perception.config import PerceptionSetup


def without_outages(scene: Scene, seen: Tracks, setup: PerceptionSetup, runs: Int) -> Tracks:
    """The lists of the units in one run, runs (1,), without those that are not made: they never arrive."""
    down = lists_not_made(scene, seen, setup, runs)
    if down is None:
        return seen
    [missing] = down
    arrives_s = np.where(missing, np.inf, seen.arrives_s)
    return seen.with_values(arrives_s=arrives_s, valid=seen.valid & ~missing[seen.frame_ix])


def lists_not_made(scene: Scene, tracks: Tracks, setup: PerceptionSetup, runs: Int) -> Bool | None:
    """(S, F) which lists of `tracks` are not made in the runs (S,), as their unit is down; None: all are made."""
    off = {name: unit.outages for name, unit in setup.modelled.items() if unit.outages is not None}
    if not off:
        return None
    down: Bool = np.zeros((len(runs), len(tracks.stamp_ns)), dtype=bool)
    for name, outages in off.items():
        mine = np.flatnonzero(tracks.frame_unit_ix == tracks.units.index(name))
        of_unit = np.zeros(len(mine), dtype=np.int64)
        random_key = shared(RandomKey((name,), of_unit, of_unit.astype(np.uint64), tracks.stamp_ns[mine]), "unit")
        drawn = held(CounterRng(setup.seed, scene.log), "outage", random_key, runs, outages.correlation_s)
        down[:, mine] = drawn < outages.down_share
    return down

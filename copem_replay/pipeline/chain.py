"""Chains: units that fuse the lists of others. A coPEM has the interface of a PEM (Piazzoni et al. 2022).

What such a unit lists is what a receiver of its members lists: each is a configuration of its members (`receiver.py`),
whose fused lists travel on as those of a recorded unit do, made anew in each run. An entry holds the object that it is
about by its members' lists, so *known means listed* holds along the chain; it is as old as the newest of these that
contributed. A list is captured when the newest of its members' lists was, and 2 µs after the unit's list before where
that has the same capture: no two lists of a unit are of one instant.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from copem_replay.communication.arrivals import FusionSchedule
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import CLASSES, SAME_INSTANT_NS, STATES, VALUES, Int, Scene, Tracks, join_tracks
from copem_replay.experiment.schema import Experiment
from copem_replay.io.recorded_units import RecordedUnits
from copem_replay.perception.perceive import displace_rows
from copem_replay.perception.sensor_poses import compute_unit_poses
from copem_replay.pipeline.expansion import ExpandedExperiment, RunGroup, expand_members
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.receiver import Receivers
from copem_replay.pipeline.scoring import match_lists
from copem_replay.pipeline.world import Transmission


def fuse_members(log: Replay, experiment: Experiment, group: RunGroup, *, entries: bool = True) -> Replay:
    """The log in the one run of a group, with the lists of fusing units as recorded ones; empty without `entries`."""
    units = log.expand(experiment)
    if not units.fusing:
        return log
    inner = expand_members(units)
    kept = np.array([unit.fuses is None for unit in units.units.values()])
    members = RunGroup(group.runs, group.listing[:, kept], group.sending[kept])
    sent = Transmission(log.with_units(inner), inner, members)
    receivers, fused = Receivers(sent), [] if log.recorded is None else [log.recorded]
    worlds = list(receivers.worlds()) if entries else []
    for name in inner.configurations:
        lists = _find_lists(name, receivers.schedule(name), sent.lists.stamp_ns, log.scene)
        if not worlds:
            none = np.empty(0)
            fused.append(RecordedUnits(lists, none, np.empty((0, len(CLASSES))), none.astype(np.int64)))
        for world in worlds:
            output = receivers.fuse(world, name)
            matches = match_lists(log.truth_cache, output, units.measure) if output.fused_tracks is None else None
            [(_, fused_tracks)] = output.tracks_by_run(matches)
            fused.append(_list_fused(lists, fused_tracks, log.scene))
    joined = RecordedUnits(
        join_tracks(tuple(name for one in fused for name in one.tracks.units), [one.tracks for one in fused]),
        *(np.concatenate(columns) for columns in zip(*((one.existence, one.class_probability, one.track_id)
          for one in fused), strict=True)),
    )  # fmt: skip
    moved = _add_pose_errors(log, joined.tracks, units, group.runs)
    return log.with_recorded(replace(joined, tracks=moved))


def _add_pose_errors(log: Replay, lists: Tracks, units: ExpandedExperiment, runs: Int) -> Tracks:
    """The lists, in which those of fusing units are shifted and turned by their pose error about their first member."""
    for name, unit in units.fusing.items():
        if unit.placed is None or unit.fuses is None:
            continue
        rows = np.flatnonzero(lists.row_unit_ix == lists.units.index(name))
        poses = compute_unit_poses(log.scene, units.units[unit.fuses[0]], log.truth, ground_m=0.0)
        if len(rows):  # then it is there at least once
            times_s, is_present = lists.row_captured_s[rows], poses.present
            places = (axis[is_present] for axis in (poses.x_m, poses.y_m))
            at_m = np.stack([np.interp(times_s, log.truth.captured_s[is_present], place) for place in places])
            away_m = np.stack([lists.x_m[0, rows], lists.y_m[0, rows]]) - at_m
            lists = displace_rows(log.scene, lists, rows, at_m, away_m, unit.placed, (units.seed, name, runs))
    return lists


def _find_lists(name: str, schedule: FusionSchedule, stamp_ns: Int, scene: Scene) -> Tracks:
    """The lists (K,) of a unit that fuses, without entries; `stamp_ns (F,)`: captures of its members' lists."""
    newest_ns = np.where(schedule.newest >= 0, stamp_ns[schedule.newest], scene.t0_ns).max(axis=1, initial=scene.t0_ns)
    captures_ns, none, no_rows = _keep_apart(newest_ns), np.empty(0, dtype=np.int64), np.empty((1, 0))
    return Tracks(
        units=(name,), start=np.zeros(1, dtype=np.int64), unit_ix=none, object_ix=none, frame_ix=none,
        stamp_ns=captures_ns, captured_s=(captures_ns - scene.t0_ns) * np.float64(1e-9),
        frame_unit_ix=np.zeros(len(captures_ns), dtype=np.int64), arrives_s=schedule.issue_s[None],
        valid=no_rows.astype(bool), **dict.fromkeys(VALUES, no_rows),
    )  # fmt: skip


def _list_fused(lists: Tracks, tracks: FusedTracks, scene: Scene) -> RecordedUnits:
    """The fused lists of one run as a unit's recorded lists; each entry keeps the object that it holds."""
    fused, claims = tracks.fused, tracks.said
    rows = fused.by_frame[0][fused.valid[0, fused.by_frame[0]]]
    object_ix = fused.row_object_ix[rows]
    if tracks.second_of is not None:
        object_ix = np.where(object_ix < 0, tracks.second_of[rows], object_ix)
    states: dict[str, Any] = {name: None if (of := getattr(fused, name)) is None else of[:, rows] for name in STATES}
    states["entry_age_s"] = (lists.captured_s[fused.frame_ix[rows]] - tracks.captured_s[0, rows])[None]
    listed = replace(
        lists, start=np.arange(len(rows) + 1), unit_ix=np.zeros(len(rows), dtype=np.int64), object_ix=object_ix,
        frame_ix=fused.frame_ix[rows], valid=np.ones((1, len(rows)), dtype=bool), **states,
    )  # fmt: skip
    if claims is not None:
        return RecordedUnits(
            listed, *(np.array(claims[what][rows]) for what in ("existence", "class_probability", "track_id"))
        )
    certain = np.eye(len(CLASSES))[scene.object_class[object_ix]]
    return RecordedUnits(listed, np.ones(len(rows)), certain, np.full(len(rows), -1))


def _keep_apart(stamp_ns: Int) -> Int:
    """Captures (K,) of a unit's lists in their order, none within an instant of the one before."""
    step_ns = 2 * SAME_INSTANT_NS * np.arange(len(stamp_ns))
    apart: Int = np.maximum.accumulate(stamp_ns - step_ns) + step_ns
    return apart

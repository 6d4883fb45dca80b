"""Episodes: from when, and until when, an object is observed.

Onset: the first frame at which its condition holds while the ego is in the log. The episode ends at the object's own
last frame (`object_left`: not seen by then, it is never detected), the ego's (`ego_left`) or the log's (`log_end`);
only the last two are censoring. Source of the meanings: docs/guide/metrics.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from copem_replay.core.tracks import SAME_INSTANT_NS, Bool, Float, Int, Scene, Tracks, class_indices
from copem_replay.metrics.config import Measure, MetricsSetup
from copem_replay.metrics.end_reason import END_REASONS, EndReason
from copem_replay.metrics.onset import OnsetView, holds
from copem_replay.metrics.reference import reference_at
from copem_replay.perception.config import Carriers
from copem_replay.perception.sensor_poses import carrier, observers, poses, unit_ground
from copem_replay.perception.visibility import Statics, visible_shares

_TOLERANCE_S = SAME_INSTANT_NS * 1e-9


@dataclass(frozen=True)
class Episodes:
    """One episode per measured object that has an onset. All (M,)."""

    object_ix: Int
    onset_s: Float
    onset_at_start: Bool
    ended_s: Float
    ended_by: Int  # index into END_REASONS


def measured_objects(scene: Scene, measure: Measure) -> Int:
    """Indices of the objects to measure, ascending: by default all moving ones but the ego."""
    chosen = np.zeros(len(scene.object_ids), dtype=bool)
    if measure.objects.ids is not None:
        chosen[[scene.object_number[i] for i in measure.objects.ids if i in scene.object_number]] = True
    elif measure.objects.classes is not None:
        chosen = np.isin(scene.object_class, class_indices(measure.objects.classes))
    else:
        chosen = scene.moving.copy()
    if scene.ego_ix >= 0:
        chosen[scene.ego_ix] = False
    return np.flatnonzero(chosen)


def episodes(scene: Scene, truth: Tracks, static: Statics, experiment: MetricsSetup) -> Episodes:
    """Onset and end of every measured object that has an onset (`truth`: the world at its own frames)."""
    measure = experiment.measure
    wanted = np.isin(truth.object_ix, measured_objects(scene, measure))
    world = truth.take_tracks(wanted)
    ego_first_s, ego_last_s, ego_there = _ego_stay(scene, truth)
    first_s, last_s = world.row_captured_s[world.start[:-1]], world.row_captured_s[world.start[1:] - 1]
    instant_s = measure.onset.instant_s
    if instant_s is not None:
        onset_s = np.full(len(first_s), instant_s)
        found = (onset_s >= first_s - _TOLERANCE_S) & (onset_s <= last_s + _TOLERANCE_S)
        found &= (onset_s >= ego_first_s - _TOLERANCE_S) & (onset_s <= ego_last_s + _TOLERANCE_S)
        at_start = onset_s <= first_s + _TOLERANCE_S
    else:
        possible = ego_there[world.frame_ix]
        view = OnsetView(
            world,
            lambda of: _distance(scene, truth, world, experiment, of),
            lambda of: _best_share(scene, truth, static, experiment, of)[wanted[truth.track_ix]],
        )
        onset_row, found = _first_true(holds(measure.onset, view) & possible, world.start)
        first_possible, _ = _first_true(possible, world.start)
        onset_s = world.row_captured_s[onset_row]
        # Held already when it could first be asked: at the object's first frame that the ego shares.
        at_start = onset_row == first_possible
    end_s = scene.end_s
    ended_s = np.minimum(np.minimum(last_s, ego_last_s), end_s)
    object_left = (last_s < end_s - _TOLERANCE_S) & (last_s <= ego_last_s + _TOLERANCE_S)
    ego_left = ~object_left & (ego_last_s < end_s - _TOLERANCE_S)
    reasons = EndReason.OBJECT_LEFT, EndReason.EGO_LEFT, EndReason.LOG_END
    left, ego, end = (END_REASONS.index(reason) for reason in reasons)
    ended_by = np.where(object_left, left, np.where(ego_left, ego, end))
    order = np.flatnonzero(found)
    order = order[np.argsort(world.object_ix[order], kind="stable")]
    return Episodes(world.object_ix[order], onset_s[order], at_start[order], ended_s[order], ended_by[order])


def _ego_stay(scene: Scene, truth: Tracks) -> tuple[float, float, Bool]:
    """First and last instant of the ego, and at which frames (F,) it is there. Without an ego: the whole log."""
    if scene.ego_ix < 0:
        return 0.0, scene.end_s, np.ones(len(truth.stamp_ns), dtype=bool)
    frames = truth.frame_ix[truth.row_object_ix == scene.ego_ix]
    there = np.zeros(len(truth.stamp_ns), dtype=bool)
    there[frames] = True
    return float(truth.captured_s[frames[0]]), float(truth.captured_s[frames[-1]]), there


def _first_true(flags: Bool, start: Int) -> tuple[Int, Bool]:
    """First True row of every track (E,), and whether there is one."""
    rows = np.flatnonzero(flags)
    at = np.searchsorted(rows, start[:-1])
    found = at < len(rows)
    first = rows[np.minimum(at, len(rows) - 1)] if len(rows) else start[:-1]
    found &= first < start[1:]
    return np.where(found, first, start[:-1]), found


def _distance(scene: Scene, truth: Tracks, world: Tracks, experiment: MetricsSetup, from_: str) -> Float:
    """(P,) distance of each row, infinite where there is nothing to measure from."""
    per_frame = reference_at(scene, truth, experiment, truth.captured_s)
    f = world.frame_ix
    dx, dy = world.x_m[0] - per_frame.x_m[f], world.y_m[0] - per_frame.y_m[f]
    if from_ == "front":
        cos, sin = np.cos(per_frame.heading_rad[f]), np.sin(per_frame.heading_rad[f])
        distance = np.abs(dx * cos + dy * sin - per_frame.length_m[f] / 2)
    else:
        distance = np.hypot(dx, dy)
    return np.where(per_frame.present[f], distance, np.inf)


def _best_share(
    scene: Scene, truth: Tracks, static: Statics, experiment: MetricsSetup, of: Literal["ego", "any"]
) -> Float:
    """(P,) the largest visible share any unit (of the ego) has of each row of the truth; 0 where there is none.

    Units that only some runs have do not count: an onset is the same in all of them.
    """
    ego_carriers = {"ego", scene.object_ids[scene.ego_ix]} if scene.ego_ix >= 0 else set()
    chosen = {
        name: unit
        for name, unit in experiment.units.items()
        if not isinstance(unit.on, Carriers) and (of == "any" or unit.on in ego_carriers)
    }
    if not chosen:
        return np.zeros(len(truth.frame_ix))
    places = [poses(scene, u, truth, unit_ground(truth, n, u)) for n, u in chosen.items()]
    shares = visible_shares(
        truth,
        static,
        observers(places, np.array([carrier(scene, u) for u in chosen.values()])),
        experiment.visibility,
    )
    best: Float = np.max(np.where(np.isnan(shares), 0.0, shares), axis=0)
    return best

"""Only what matters: of the objects that have an onset those within an area, near the ego's way, or soon on it.

Decided on the truth. An area and the way: by the object's centre at the onset; a conflict: at any of its frames from
the onset to the end of its episode. The way is what lies ahead: what the ego has behind it at the onset no longer
matters, nor does a way that it takes when the object is gone.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.errors import ExperimentError
from copem_replay.core.interpolation import states_at
from copem_replay.core.tracks import SAME_INSTANT_NS, Bool, Float, Int, Scene, Tracks
from copem_replay.metrics.area import corners, in_areas
from copem_replay.metrics.braking.ego_path import EgoPath
from copem_replay.metrics.config import Conflict, MetricsSetup, Within
from copem_replay.metrics.detection.conflict import implied_by

if TYPE_CHECKING:
    from copem_replay.metrics.episodes import Episodes

_TOLERANCE_S = SAME_INSTANT_NS * 1e-9
_TOLERANCE_M = 1e-6


def only_within(scene: Scene, truth: Tracks, found: Episodes, experiment: MetricsSetup) -> tuple[Episodes, Int]:
    """The episodes that `measure.objects.within` keeps, and the objects of the others, (K,) indices.

    Raises ExperimentError where there is no ego, and so no path.
    """
    asked = experiment.measure.objects.within
    if asked is None:
        return found, np.empty(0, dtype=np.int64)
    if asked.of_ego and scene.ego_ix < 0:
        raise ExperimentError(f"{scene.log}: measure.objects.within: no ego in this study, and so no path of it")
    decide = _at_onset if asked.conflict_s is None else _conflicts
    kept = decide(scene, truth, found, experiment)
    return replace(found, **{f.name: getattr(found, f.name)[kept] for f in fields(found)}), found.object_ix[~kept]


def in_words(asked: Within) -> str:
    """Where the objects are that are left out, for a note."""
    if asked.polygon_m is not None:
        return "outside the polygon at their onset"
    if asked.corridor_m is not None:
        return f"more than {asked.corridor_m:g} m beside the ego's way ahead"
    return f"never within {asked.conflict_s:g} s of the ego's way"


def _at_onset(scene: Scene, truth: Tracks, found: Episodes, experiment: MetricsSetup) -> Bool:
    """(M,) by their centres; in a gap of the truth, where an instant may fall, an object is nowhere."""
    asked = experiment.measure.objects.within
    assert asked is not None
    at, there = states_at(
        truth, found.object_ix, found.onset_s, t0_ns=scene.t0_ns, max_gap_s=experiment.max_gap_s
    )  # fmt: skip
    x_m, y_m = at["x_m"], at["y_m"]
    if asked.polygon_m is not None:
        return there & in_areas(x_m, y_m, x_m, y_m, corners(asked.polygon_m), np.inf)
    assert asked.corridor_m is not None
    beside_m = _beside(EgoPath(scene, truth, experiment.max_gap_s), x_m, y_m, found)
    near: Bool = there & (beside_m <= asked.corridor_m + _TOLERANCE_M)
    return near


def _beside(ego: EgoPath, x_m: Float, y_m: Float, found: Episodes) -> Float:
    """(M,) how far places are from the way that the ego's centre takes from the onset to the end of each episode."""
    import shapely

    ends_m = [np.interp(time_s, ego.frame_s, ego.frame_m) for time_s in (found.onset_s, found.ended_s)]
    ways = []
    for from_m, to_m in zip(*ends_m, strict=True):
        first, after = np.searchsorted(ego.path[:, 0], (from_m, to_m))
        along_m = np.concatenate([[from_m], ego.path[first:after, 0], [to_m]])
        ways.append(np.stack([np.interp(along_m, ego.path[:, 0], ego.path[:, k]) for k in (1, 2)], axis=1))
    away_m: Float = shapely.distance([shapely.LineString(way) for way in ways], shapely.points(x_m, y_m))
    return away_m


def _conflicts(scene: Scene, truth: Tracks, found: Episodes, experiment: MetricsSetup) -> Bool:
    """(M,) whether the object, keeping its velocity, would at any of its frames soon be where the ego will sweep."""
    asked, measure = experiment.measure.objects.within, experiment.measure
    assert asked is not None
    assert asked.conflict_s is not None
    margin_m = (measure.conflict or Conflict()).margin_m
    ego = EgoPath(scene, truth, experiment.max_gap_s)
    mine = truth.take_tracks(np.isin(truth.object_ix, found.object_ix))
    implied = implied_by(mine, ego, Conflict(horizon_s=asked.conflict_s, margin_m=margin_m))[0]
    episode_of = np.full(len(scene.object_ids), -1)
    episode_of[found.object_ix] = np.arange(len(found.object_ix))
    episode, time_s = episode_of[mine.row_object_ix], mine.row_captured_s
    implied &= (time_s >= found.onset_s[episode] - _TOLERANCE_S) & (time_s <= found.ended_s[episode] + _TOLERANCE_S)
    kept = np.zeros(len(found.object_ix), dtype=bool)
    kept[episode[implied]] = True
    return kept

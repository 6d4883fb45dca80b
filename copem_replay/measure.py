"""Measure: one row per configuration × run × measured object. Never detected is kept, not dropped.

time_to_detection_s: from the onset to the instant the list that confirmed the object was available; null when never.
distance_at_detection_m: true horizontal distance between the centres of object and ego at that instant.
gap_at_detection_m: the same from box to box. Source: Piazzoni et al. 2022 (distance at detection), docs/measures.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from copem_replay.detect import Detections
from copem_replay.experiment import Experiment
from copem_replay.onset import ENDED_BY, Looks, Reference, reference_at
from copem_replay.resample import states_at
from copem_replay.tracks import CLASSES, Float, Int, Scene, Tracks
from copem_replay.visibility import rectangles

T = TypeVar("T", bound=np.generic)


def table(
    scene: Scene,
    truth: Tracks,
    experiment: Experiment,
    found: Looks,
    runs: Int,
    detections: Mapping[str, tuple[tuple[str, ...], Detections]],
) -> pd.DataFrame:
    """The rows of `detections.parquet` of one log and block of runs, by configuration, run and object.

    `detections`: for each configuration the names of its units and what was detected, (S, M) or (1, M) where all runs
    agree.
    """
    parts = [
        _rows(scene, truth, experiment, found, runs, name, units, result)
        for name, (units, result) in detections.items()
    ]
    return pd.concat(parts, ignore_index=True)


def _rows(
    scene: Scene, truth: Tracks, experiment: Experiment, found: Looks, runs: Int,
    configuration: str, units: tuple[str, ...], result: Detections,
) -> pd.DataFrame:  # fmt: skip
    S, M = len(runs), len(found.object_ix)

    def flat(values: NDArray[T]) -> NDArray[T]:
        return np.broadcast_to(values, (S, M)).ravel()

    detection_s = flat(result.detection_s)
    distance_m, gap_m = _distances(scene, truth, experiment, flat(found.object_ix), detection_s)
    onset_s = flat(found.onset_s)
    names = np.array([*units, None], dtype=object)  # −1: none
    return pd.DataFrame(
        {
            "log": pd.Categorical.from_codes(np.zeros(S * M, dtype=np.int8), [scene.log]),
            "configuration": pd.Categorical.from_codes(np.zeros(S * M, dtype=np.int8), [configuration]),
            "run": np.repeat(runs, M),
            "object_id": np.array(scene.object_ids, dtype=object)[flat(found.object_ix)],
            "object_class": np.array(CLASSES, dtype=object)[scene.object_class[flat(found.object_ix)]],
            "onset_s": onset_s,
            "onset_at_start": flat(found.onset_at_start),
            "detected": ~np.isnan(detection_s),
            "detection_s": detection_s,
            "captured_s": flat(result.captured_s),
            "time_to_detection_s": detection_s - onset_s,
            "distance_at_detection_m": distance_m,
            "gap_at_detection_m": gap_m,
            "ended_s": flat(found.ended_s),
            "ended_by": np.array(ENDED_BY, dtype=object)[flat(found.ended_by)],
            "first_unit": names[flat(result.first_unit_ix)],
        }
    ).astype({"log": object, "configuration": object})


def _distances(
    scene: Scene, truth: Tracks, experiment: Experiment, object_ix: Int, time_s: Float
) -> tuple[Float, Float]:
    """Centre distance and gap of objects (K,) at times (K,); NaN where the time is, or where one is absent.

    Runs share objects and instants: each pair is computed once.
    """
    distance_m, gap_m = np.full(len(time_s), np.nan), np.full(len(time_s), np.nan)
    known = np.flatnonzero(~np.isnan(time_s))
    if not len(known):
        return distance_m, gap_m
    pairs = np.empty(len(known), dtype=[("object", np.int64), ("time", np.float64)])
    pairs["object"], pairs["time"] = object_ix[known], time_s[known]
    unique, back = np.unique(pairs, return_inverse=True)
    ego = reference_at(scene, truth, experiment, unique["time"])
    at, present = states_at(truth, unique["object"], unique["time"], t0_ns=scene.t0_ns, max_gap_s=experiment.max_gap_s)
    distance = np.where(present & ego.present, np.hypot(at["x_m"] - ego.x_m, at["y_m"] - ego.y_m), np.nan)
    distance_m[known], gap_m[known] = distance[back], box_gap(at, ego, present & ego.present)[back]
    return distance_m, gap_m


def box_gap(at: Mapping[str, Float], ego: Reference, both: np.ndarray) -> Float:
    """(K,) horizontal distance between the boxes, 0 where they touch; NaN where `both` is False."""
    import shapely

    gap = np.full(len(both), np.nan)
    k = np.flatnonzero(both)
    box = shapely.polygons(rectangles(*(at[n][k] for n in ("x_m", "y_m", "yaw_rad", "length_m", "width_m"))))
    corners = rectangles(*(getattr(ego, n)[k] for n in ("x_m", "y_m", "heading_rad", "length_m", "width_m")))
    point = (ego.length_m[k] == 0) & (ego.width_m[k] == 0)
    other = np.where(point, shapely.points(ego.x_m[k], ego.y_m[k]), shapely.polygons(corners))
    gap[k] = shapely.distance(box, other)
    return gap

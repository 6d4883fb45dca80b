"""The detections: one row per configuration × run × measured object. Never detected is kept, not dropped.

time_to_detection_s: from the onset to the instant the list that confirmed the object was available; null when never.
distance_at_detection_m: true horizontal distance between the centres of object and ego at that instant.
gap_at_detection_m: the same from box to box.
Source: Piazzoni et al. 2022 (distance at detection); docs/guide/metrics.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from copem_replay.core.interpolation import states_at
from copem_replay.core.random import CounterRng, RandomKey, object_words
from copem_replay.core.tracks import CLASSES, Float, Int, Scene, Tracks
from copem_replay.metrics.braking.driver import delays_of
from copem_replay.metrics.braking.encounter import Encounter
from copem_replay.metrics.braking.verdict import Verdicts, judge
from copem_replay.metrics.columns import beneath
from copem_replay.metrics.config import MetricsSetup
from copem_replay.metrics.detection.by_truth_id import Detections
from copem_replay.metrics.end_reason import texts_of
from copem_replay.metrics.episodes import Episodes
from copem_replay.metrics.reference import Reference, reference_at
from copem_replay.metrics.way import WAY, Way
from copem_replay.perception.visibility import rectangles

T = TypeVar("T", bound=np.generic)


@dataclass(frozen=True)
class Events:
    """Detections of one configuration, run by run: (S, M), or (1, M) where all runs agree.

    `units`: names of those whose indices `detections` has. `in_sight_s`: when any of its units had the object in sight,
    NaN: never, or not known. `conflict_known_s`: when a collision was implied, NaN: never. `way`: None where lists have
    neither a link nor units that take their time or choose what they send.
    """

    units: tuple[str, ...]
    detections: Detections
    in_sight_s: Float
    conflict_known_s: Float | None = None
    way: Way | None = None


def stacked(runs: Sequence[Mapping[str, Events]]) -> dict[str, Events]:
    """Events by configuration of some runs after each other."""
    return {name: _stacked([one[name] for one in runs]) for name in runs[0]} if len(runs) > 1 else dict(runs[0])


def _stacked(parts: Sequence[Any]) -> Any:
    first: Any = parts[0]
    if isinstance(first, np.ndarray):
        return np.concatenate(parts)
    if hasattr(first, "_fields"):
        return type(first)(*map(_stacked, zip(*parts, strict=True)))
    if is_dataclass(first):
        columns = {f.name: _stacked([getattr(part, f.name) for part in parts]) for f in fields(first)}
        return replace(first, **columns)  # type: ignore[type-var]
    assert all(part == first for part in parts), f"{type(first).__name__} is not of all runs alike"
    return first


def table(
    scene: Scene,
    truth: Tracks,
    experiment: MetricsSetup,
    found: Episodes,
    meeting: Sequence[Encounter],
    runs: Int,
    events: Mapping[str, Events],
) -> dict[str, Any]:
    """The columns of `detections.parquet` of one log and block of runs, by configuration, run and object."""
    delay_s = _delays(scene, experiment, found, runs)
    parts = []
    for name, known in events.items():
        columns = _columns(scene, truth, experiment, found, runs, name, known)
        if delay_s is not None:
            columns |= _braking(experiment, found, meeting, delay_s, known)
        if any(of.way is not None for of in events.values()):
            shape, none = (len(runs), len(found.object_ix)), np.full((1, 1), np.nan)
            way = {name: none if known.way is None else getattr(known.way, name) for name in WAY}
            columns |= {name: np.broadcast_to(values, shape).ravel() for name, values in way.items()}
        parts.append(columns)
    return beneath(parts)


def _columns(
    scene: Scene, truth: Tracks, experiment: MetricsSetup, found: Episodes, runs: Int, configuration: str, known: Events
) -> dict[str, Any]:
    """Columns (S · M,) of one configuration: what was known, when and how far away."""
    S, M = len(runs), len(found.object_ix)

    def flat(values: NDArray[T]) -> NDArray[T]:
        return np.broadcast_to(values, (S, M)).ravel()

    result = known.detections
    detection_s = flat(result.detection_s)
    distance_m, gap_m = distances(scene, truth, experiment, flat(found.object_ix), detection_s)
    onset_s = flat(found.onset_s)
    names = np.array([*known.units, None], dtype=object)  # −1: none
    columns: dict[str, Any] = {
        "log": np.full(S * M, scene.log, dtype=object),
        "configuration": np.full(S * M, configuration, dtype=object),
        "run": np.repeat(runs, M),
        "object_id": np.array(scene.object_ids, dtype=object)[flat(found.object_ix)],
        "object_class": np.array(CLASSES, dtype=object)[scene.object_class[flat(found.object_ix)]],
        "onset_s": onset_s,
        "onset_at_start": flat(found.onset_at_start),
        "detected": ~np.isnan(detection_s),
        "detection_s": detection_s,
        "captured_s": flat(result.captured_s),
        "in_sight_s": flat(known.in_sight_s),
        "time_to_detection_s": detection_s - onset_s,
        "distance_at_detection_m": distance_m,
        "gap_at_detection_m": gap_m,
        "ended_s": flat(found.ended_s),
        "ended_by": texts_of(flat(found.ended_by)),
        "first_unit": names[flat(result.first_unit_ix)],
    }
    if known.conflict_known_s is not None:
        conflict_known_s = flat(known.conflict_known_s)
        away_m, _ = distances(scene, truth, experiment, flat(found.object_ix), conflict_known_s)
        columns |= {
            "conflict_detected": ~np.isnan(conflict_known_s),
            "conflict_detection_s": conflict_known_s,
            "time_to_conflict_detection_s": conflict_known_s - onset_s,
            "distance_at_conflict_detection_m": away_m,
        }
    return columns


def _delays(scene: Scene, experiment: MetricsSetup, found: Episodes, runs: Int) -> Float | None:
    """(S, M) seconds the driver takes to react to each object, the same in every configuration. None without braking.

    Addressed by the object and the onset's stamp: what is reacted to, not when it came to be known.
    """
    if experiment.braking is None:
        return None
    none = np.zeros(len(found.object_ix), dtype=np.int64)
    words = object_words([scene.object_ids[k] for k in found.object_ix])
    stamp_ns = scene.t0_ns + np.rint(found.onset_s * 1e9).astype(np.int64)
    uniform = CounterRng(experiment.seed, scene.log).uniform("reaction", RandomKey(("",), none, words, stamp_ns), runs)
    return delays_of(experiment.braking.driver.reaction, uniform.ravel()).reshape(uniform.shape)


def _braking(
    experiment: MetricsSetup, found: Episodes, meeting: Sequence[Encounter], delay_s: Float, known: Events
) -> dict[str, Any]:
    """Columns (S · M,) of one configuration: the verdicts of the episodes in conflict; null for the others."""
    braking = experiment.braking
    assert braking is not None
    shape = delay_s.shape
    event_s = known.detections.detection_s if braking.brakes_for == "object" else known.conflict_known_s
    assert event_s is not None
    # What is known before the onset is no hazard yet.
    brake_s = np.maximum(np.broadcast_to(event_s, shape), found.onset_s) + delay_s
    in_conflict = np.zeros(shape, dtype=bool)
    numbers = {name: np.full(shape, np.nan) for name in Verdicts.__dataclass_fields__}
    for encounter in meeting:
        m = encounter.episode_ix
        in_conflict[:, m] = True
        verdicts = judge(encounter, braking.driver, np.where(np.isnan(brake_s[:, m]), np.inf, brake_s[:, m]))
        for name, values in numbers.items():
            values[:, m] = getattr(verdicts, name)
    return {
        "conflict": in_conflict.ravel(),
        "brake_s": np.where(in_conflict, brake_s, np.nan).ravel(),
        "braking_pass": (numbers["min_distance_m"] > braking.margin_m).ravel(),  # null where not in conflict
        "min_distance_m": numbers["min_distance_m"].ravel(),
        "impact_s": numbers["impact_s"].ravel(),
        "impact_speed_mps": numbers["impact_speed_mps"].ravel(),
        "required_deceleration_mps2": numbers["required_mps2"].ravel(),
    }


def distances(
    scene: Scene, truth: Tracks, experiment: MetricsSetup, object_ix: Int, time_s: Float
) -> tuple[Float, Float]:
    """Centre distance and gap of objects (K,) at times (K,); NaN where the time is, or where one is absent.

    Runs share objects and instants: each pair is computed once.
    """
    distance_m, gap_m = np.full(len(time_s), np.nan), np.full(len(time_s), np.nan)
    known = np.flatnonzero(~np.isnan(time_s))
    if not len(known):
        return distance_m, gap_m
    # By hash: most rows share their pair with many others, and sorting them all took most of the time.
    number, times_s = pd.factorize(time_s[known])
    back, pairs = pd.factorize(object_ix[known] * len(times_s) + number)
    objects, at_s = pairs // len(times_s), times_s[pairs % len(times_s)]
    ego = reference_at(scene, truth, experiment, at_s)
    at, present = states_at(truth, objects, at_s, t0_ns=scene.t0_ns, max_gap_s=experiment.max_gap_s)
    distance = np.where(present & ego.present, np.hypot(at["x_m"] - ego.x_m, at["y_m"] - ego.y_m), np.nan)
    distance_m[known] = distance[back]
    if scene.ego_sized or experiment.measure.distance_to != "ego":
        gap_m[known] = box_gap(at, ego, present & ego.present)[back]
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

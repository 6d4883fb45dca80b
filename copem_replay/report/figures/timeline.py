"""The story of one run in one configuration: what happened when, and how it ended, in words.

A story is told from one row of `detections.parquet`. Perception is open-loop: what was seen is what an ego saw that did
not brake.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from copem_replay.core.tracks import CLASSES
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.braking.driver import Driver
from copem_replay.metrics.braking.encounter import Encounter
from copem_replay.metrics.end_reason import EndReason
from copem_replay.pipeline.prepare import Replay
from copem_replay.report.figures.trajectories import DrivenCourse, braked_course, recorded_course

_STOOD_MPS = 0.05
"""Slower than this the ego has stopped (chosen)."""
_LOOK_S = 0.05
"""Between instants at which the nearest approach of what is in no conflict is sought (chosen)."""

KINDS = ("onset", "captured", "arrives", "foreseen", "brakes", "outcome", "ended")
"""What can happen, in the order in which it is told where it happens at once."""


@dataclass(frozen=True)
class Event:
    """Something that happened, seconds since the onset; `kind` is one of `KINDS`."""

    time_s: float
    kind: str
    label: str


@dataclass(frozen=True)
class Story:
    """One run of one object in one configuration. `encounter`: None where there is no conflict to judge."""

    configuration: str
    onset_s: float
    object_ix: int
    brake_s: float  # since the log's start; inf: never
    impact_s: float  # since the log's start; inf: never
    encounter: Encounter | None
    events: tuple[Event, ...]  # in order
    result: str


def story(replay: Replay, experiment: Experiment, row: Any) -> Story:
    """What happened, by one row of `detections.parquet`."""
    object_ix = replay.scene.object_number[row.object_id]
    braking = experiment.braking
    encounter = next((e for e in replay.encounters if replay.episodes.object_ix[e.episode_ix] == object_ix), None)
    told = [(row.onset_s, "onset", experiment.measure.onset.label(CLASSES[replay.scene.object_class[object_ix]]))]
    result = "never known"
    if row.detected:
        told += [(row.captured_s, "captured", "captured"), (row.detection_s, "arrives", "list arrives")]
        result = f"known after {_number(row.time_to_detection_s)} s"
    brake_s = impact_s = np.inf
    if braking is not None and encounter is not None:
        brake_s, impact_s = _or_never(row.brake_s), _or_never(row.impact_s)
        if braking.brakes_for == "conflict" and _or_never(row.conflict_detection_s) < np.inf:
            told.append((row.conflict_detection_s, "foreseen", "collision foreseen"))
        if brake_s <= encounter.time_s[np.isfinite(encounter.course.bound_m)].max(initial=-np.inf):  # while it drives
            told.append((brake_s, "brakes", "brakes"))
        ended_s, label = _outcome(encounter, braking.driver, braking.margin_m, row, brake_s)
        told.append((ended_s, "outcome", label))
        result += ", passes" if row.braking_pass else ", fails"
    else:
        told += _nearest(replay, experiment.max_gap_s, object_ix, row)
        told += [] if row.detected else [(row.ended_s, "ended", EndReason(row.ended_by).label)]
        result += ", no conflict" if braking is not None else ""
    told.sort(key=lambda event: (event[0], KINDS.index(event[1])))
    events = tuple(Event(float(time_s - row.onset_s), kind, label) for time_s, kind, label in told)
    return Story(row.configuration, row.onset_s, object_ix, brake_s, impact_s, encounter, events, result)


def _or_never(time_s: float) -> float:
    return float(time_s) if time_s == time_s else np.inf


def _number(value: float) -> str:
    return f"{value:.2f}".rstrip("0").rstrip(".").replace("-", "−")


def _outcome(encounter: Encounter, driver: Driver, margin_m: float, row: Any, brake_s: float) -> tuple[float, str]:
    """When and how a conflict ends."""
    if row.impact_s == row.impact_s:
        return row.impact_s, f"hits at {row.impact_speed_mps:.1f} m/s"
    course = braked_course(encounter, driver, brake_s, encounter.time_s)
    nearest = int(np.nanargmin(course.gap_m))
    if not row.braking_pass:
        near = np.flatnonzero(course.gap_m <= margin_m)  # none where it was so only between two instants
        return course.time_s[near[0] if len(near) else nearest], f"too near: {row.min_distance_m:.2f} m"
    stood = _stands_from(course, brake_s)
    if stood is not None:
        return stood, "stops"
    return course.time_s[nearest], f"passes {row.min_distance_m:.1f} m away"


def _stands_from(course: DrivenCourse, brake_s: float) -> float | None:
    """When the ego that brakes stops for good; None: it does not."""
    there = np.flatnonzero(~np.isnan(course.speed_mps) & (course.time_s > brake_s))
    if not len(there) or course.speed_mps[there[-1]] >= _STOOD_MPS:
        return None
    moving = there[course.speed_mps[there] >= _STOOD_MPS]
    after = there[there > moving[-1]] if len(moving) else there
    return float(course.time_s[after[0]])


def _nearest(replay: Replay, max_gap_s: float, object_ix: int, row: Any) -> list[tuple[float, str, str]]:
    """Where there is no conflict to judge: when the two come nearest, as recorded."""
    count = int((row.ended_s - row.onset_s) / _LOOK_S)
    course = recorded_course(replay, max_gap_s, object_ix, row.onset_s + _LOOK_S * np.arange(count + 1))
    if np.isnan(course.gap_m).all():
        return []
    k = int(np.nanargmin(course.gap_m))
    return [(course.time_s[k], "outcome", f"nearest: {course.gap_m[k]:.1f} m")]

"""A log as its unit sees it: where the unit is at each of its lists, and how every true object looks then."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from copem_replay.core.errors import InputError
from copem_replay.core.interpolation import at_instants
from copem_replay.core.tracks import Float, Int, Scene, Tracks
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.experiment.drive import of_log
from copem_replay.experiment.schema import Experiment, Unit
from copem_replay.io.list_checks import captured_before
from copem_replay.io.recorded_osi import RecordedLists
from copem_replay.io.recorded_units import as_recorded
from copem_replay.io.recording import Recording
from copem_replay.perception.observation import from_unit
from copem_replay.perception.sensor_poses import (
    UnitPoses,
    carrier,
    observers,
    poses,
    solids_of,
    statics_of,
    unit_ground,
)
from copem_replay.perception.visibility import visible_shares


@dataclass(frozen=True)
class LogView:
    """One log from its unit: lists in order of capture, what they hold, and how each true object looks then."""

    scene: Scene
    truth: Tracks
    found: RecordedLists  # as captured
    place_of: Int  # (F,) in the order of `found`: where a list is in order of capture; −1: not within the truth
    captured_s: Float  # (L,) in order of capture
    east_m: Float
    north_m: Float
    heading_rad: Float
    carrier_ix: int
    list_ix: Int  # (R,) of true objects' rows, in order of object and list
    states: Tracks
    row: Int  # (R,) where in `states` and `view`
    view: ViewGeometry


@dataclass(frozen=True)
class _Parts:
    """What of a log is known before its lists are put in order."""

    scene: Scene
    truth: Tracks
    found: RecordedLists
    of_frame: Int  # (F,) which of `stamps` each list is of
    stamps: Int
    at: UnitPoses
    carrier_ix: int


def check_unit(experiment: Experiment, name: str) -> Unit:
    """The recorded unit that is to be fitted. Raises InputError: there is none, or nothing says where it is."""
    unit = experiment.units.get(name)
    if unit is None or unit.recorded is None:
        there = ", ".join(experiment.recorded) or "none"
        found = "found no such unit" if unit is None else "found one with a pem"
        raise InputError(f"unit {name}: expected a unit whose lists are recorded ({there}), {found}")
    if unit.on is None and unit.at is None:
        raise InputError(f"unit {name}: fit needs its place (`at` or `on`): range and azimuth are seen from there")
    if unit.at is not None and unit.height_m is None:
        raise InputError(f"unit {name}: fit needs its `height_m`: what hides an object depends on it")
    return unit


def raw_lists(recordings: Sequence[Recording], experiment: Experiment, name: str) -> list[RecordedLists]:
    """The lists of a unit in each log, with nothing added. Raises InputError, RecordingError."""
    units = [of_log(experiment, recording.scene.log).units.get(name) for recording in recordings]
    found = []
    for recording, unit in zip(recordings, units, strict=True):
        if unit is None or unit.recorded is None:
            raise InputError(f"unit {name}: expected its lists in every log, found none in {recording.scene.log}")
        found.append(as_recorded(recording, unit.recorded.topic))
    return found


def log_view(recording: Recording, found: RecordedLists, experiment: Experiment, name: str, delay_s: float) -> LogView:
    """A log as its unit sees it, with lists captured so long before their stamps where they do not say it."""
    alone = of_log(experiment, recording.scene.log)
    unit, scene = check_unit(alone, name), recording.scene
    found = captured_before(found, scene, delay_s)
    truth = at_instants(recording.truth, recording.truth.stamp_ns, t0_ns=scene.t0_ns, max_gap_s=alone.max_gap_s)
    stamps, of_frame = np.unique(found.tracks.stamp_ns, return_inverse=True)
    world = at_instants(truth, stamps, t0_ns=scene.t0_ns, max_gap_s=alone.max_gap_s)
    mine = carrier(scene, unit)
    host = world.take_tracks(world.object_ix == mine)
    at = poses(scene, unit, host, unit_ground(truth, name, unit))
    at = replace(at, present=at.present & (stamps >= scene.t0_ns) & (stamps <= scene.end_ns))
    shares = visible_shares(
        world,
        static=statics_of(solids_of(scene, truth, alone.obstacles)),
        observers=observers([at], np.array([mine])),
        model=alone.visibility,
    )[0]
    states, view = from_unit(world, at, mine, shares)
    view = replace(view, class_ix=scene.object_class[states.row_object_ix])
    return _placed(_Parts(scene, truth, found, of_frame, stamps, at, mine), states, view)


def _placed(log: _Parts, states: Tracks, view: ViewGeometry) -> LogView:
    """The same list by list: of lists captured at one instant each has rows of its own."""
    order = np.argsort(log.of_frame, kind="stable")
    order = order[log.at.present[log.of_frame[order]]]
    place_of = np.full(len(log.of_frame), -1)
    place_of[order] = np.arange(len(order))
    instant = log.of_frame[order]
    # Rows of `states` are numbered by the instants at which the unit is there.
    there = np.flatnonzero(log.at.present)
    first = np.searchsorted(instant, there)
    count = np.searchsorted(instant, there, side="right") - first
    times = count[states.frame_ix]
    row = np.repeat(np.arange(len(states.frame_ix)), times)
    within = np.arange(len(row)) - np.repeat(np.cumsum(times) - times, times)
    list_ix = first[states.frame_ix[row]] + within
    ordered = np.lexsort((list_ix, states.row_object_ix[row]))
    return LogView(
        log.scene, log.truth, log.found, place_of, (log.stamps[instant] - log.scene.t0_ns) * np.float64(1e-9),
        log.at.x_m[instant], log.at.y_m[instant], log.at.heading_rad[instant], log.carrier_ix,
        list_ix[ordered], states, row[ordered], view,
    )  # fmt: skip

"""Episodes: from when until when each measured object is observed, and when units first have it in sight.

Onset: the first frame at which its condition holds while the ego is in the log. An episode began at the log's start if
the condition held at the first instant at which it could be asked of any object; the object appeared if it held at its
own first frame, later; else it crossed. With `again_after_s` an object that comes back after so long has another
episode, and the one before ends with the last frame at which the condition held. Else it ends at the object's own
last frame (`object_left`: an object that leaves undetected is never detected), the ego's (`ego_left`) or the log's
(`log_end`); only the last two are censoring. An object is in sight of a unit when a list of the unit, at whatever range
and in whatever field of view, has a visible share of it above 0, detected or not. Definitions: docs/guide/metrics.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from copem_replay.core.errors import ExperimentError
from copem_replay.core.interpolation import interpolate_states, wrap_angles
from copem_replay.core.tracks import SAME_INSTANT_S, Bool, Float, Int, Scene, Tracks, class_indices
from copem_replay.metrics.config import Measure, MetricsSetup
from copem_replay.metrics.onset import APPEARED, BEGAN, CROSSED, LOG_START, OnsetView, evaluate_onset
from copem_replay.metrics.survival import END_REASONS, EndReason
from copem_replay.perception.config import Carriers
from copem_replay.perception.sensor_poses import (
    compute_unit_poses,
    find_carrier,
    make_observers,
    offset_places,
    unit_ground,
)
from copem_replay.perception.visibility import Statics, visible_shares


@dataclass(frozen=True)
class Reference:
    """The place that distances are measured from: the ego, or a unit where there is no ego. All (K,), NaN where absent.

    Its box is `length_m × width_m` around its place; a unit is a point.
    """

    x_m: Float
    y_m: Float
    heading_rad: Float
    length_m: Float
    width_m: Float
    present: Bool


def locate_reference(scene: Scene, truth: Tracks, experiment: MetricsSetup, time_s: Float) -> Reference:
    """The place that distances are measured from, at times (K,), s. Raises ExperimentError when there is none."""
    n = len(time_s)
    name = experiment.measure.distance_to
    if name == "ego":
        if scene.ego_ix < 0:
            raise ExperimentError(
                f"{scene.log}: no ego to measure distances from; give `ego:` or `distance_to: <unit>`"
            )
        state, present = _interpolate_state(scene, truth, scene.ego_ix, time_s, experiment.max_gap_s)
        return Reference(state["x_m"], state["y_m"], state["yaw_rad"], state["length_m"], state["width_m"], present)
    unit = experiment.units[name]
    point = np.zeros(n)
    if unit.at is not None:
        heading = np.full(n, np.deg2rad(unit.yaw_deg))
        x, y = offset_places(np.full(n, unit.at[0]), np.full(n, unit.at[1]), heading, unit.offset_m)
        return Reference(x, y, heading, point, point, np.ones(n, dtype=bool))
    state, present = _interpolate_state(scene, truth, find_carrier(scene, unit), time_s, experiment.max_gap_s)
    x, y = offset_places(state["x_m"], state["y_m"], state["yaw_rad"], unit.offset_m)
    return Reference(x, y, wrap_angles(state["yaw_rad"] + np.deg2rad(unit.yaw_deg)), point, point, present)


def _interpolate_state(
    scene: Scene, truth: Tracks, object_ix: int, time_s: Float, max_gap_s: float
) -> tuple[dict[str, Float], Bool]:
    return interpolate_states(truth, np.full(len(time_s), object_ix), time_s, t0_ns=scene.t0_ns, max_gap_s=max_gap_s)


AGAIN_AFTER_S = 10.0
"""Where `again_after_s` is not given, objects that come back after longer than this are said in a note."""


@dataclass(frozen=True)
class Episodes:
    """The episodes of measured objects that have an onset, object by object, of one object in order. All (M,).

    `number`: of the episode among those of its object, from 0 on. `before_s`: end of the episode before, −inf: there is
    none. `returns`: how often the object comes back during the episode after longer than `AGAIN_AFTER_S`.
    """

    object_ix: Int
    number: Int
    onset_s: Float
    began: Int  # index into BEGAN
    ended_s: Float
    ended_by: Int  # index into END_REASONS
    before_s: Float
    returns: Int

    def take(self, which: Int | Bool) -> Episodes:
        """The episodes of these indices."""
        return Episodes(**{f.name: getattr(self, f.name)[which] for f in fields(self)})

    @cached_property
    def passes(self) -> tuple[tuple[Int, Episodes], ...]:
        """Indices and episodes of each pass, which has at most one episode per object: all first ones, all second ones,
        … Code that looks up an object's episode goes pass by pass; `join_passes` puts the columns together.
        """
        if not len(self.object_ix):
            return ((np.empty(0, dtype=np.int64), self),)
        first = np.flatnonzero(np.diff(self.object_ix, prepend=-1) != 0)
        pass_number = np.arange(len(self.object_ix)) - np.repeat(first, np.diff(np.append(first, len(self.object_ix))))
        each = (np.flatnonzero(pass_number == k) for k in range(int(pass_number.max()) + 1))
        return tuple((episode_ix, self.take(episode_ix)) for episode_ix in each)

    def join_passes(self, parts: Sequence[np.ndarray]) -> np.ndarray:
        """(…, M) the columns of all episodes, from the columns of each pass (…, m)."""
        if len(parts) == 1:
            return parts[0]
        order = np.argsort(np.concatenate([which for which, _ in self.passes]))
        return np.concatenate(parts, axis=-1)[..., order]

    def number_rows(self, tracks: Tracks) -> Int:
        """(P,) the number of the episode during which each row was captured; −1: none."""
        numbers, captured_s = np.full(len(tracks.frame_ix), -1), tracks.row_captured_s
        of_object = np.empty(int(max(self.object_ix.max(initial=-1), tracks.object_ix.max(initial=-1))) + 1, np.int64)
        for episode_ix, one_pass in self.passes:
            of_object[:] = -1
            of_object[one_pass.object_ix] = episode_ix
            number = of_object[tracks.row_object_ix]
            rows = np.flatnonzero(number >= 0)
            number, at_s = number[rows], captured_s[rows]
            during = at_s >= self.onset_s[number] - SAME_INSTANT_S
            during &= at_s <= self.ended_s[number] + SAME_INSTANT_S
            numbers[rows[during]] = number[during]
        return numbers

    @property
    def firsts(self) -> Episodes:
        """One episode per object, from its first onset to the end of its last episode: accuracy is measured in it."""
        which, first = self.passes[0]
        ends = np.append(which, len(self.object_ix))[1:] - 1
        return replace(first, ended_s=self.ended_s[ends], ended_by=self.ended_by[ends])

    def count_began(self) -> tuple[int, ...]:
        """The number of episodes by how they began, in the order of `BEGAN`."""
        return tuple(np.bincount(self.began, minlength=len(BEGAN)).tolist())

    def counts_from_s(self, *, count_earlier: bool) -> Float:
        """(M,) captures from here on count: the onset, or with `count_earlier` all after the episode before."""
        earliest_s = np.where(np.isfinite(self.before_s), self.before_s + SAME_INSTANT_S, -np.inf)
        return earliest_s if count_earlier else self.onset_s - SAME_INSTANT_S


def measured_objects(scene: Scene, measure: Measure) -> Int:
    """Indices of the objects to measure, ascending: by default all moving ones but the ego."""
    measured = np.zeros(len(scene.object_ids), dtype=bool)
    if measure.objects.ids is not None:
        measured[[scene.object_number[i] for i in measure.objects.ids if i in scene.object_number]] = True
    elif measure.objects.classes is not None:
        measured = np.isin(scene.object_class, class_indices(measure.objects.classes))
    else:
        measured = scene.moving.copy()
    if scene.ego_ix >= 0:
        measured[scene.ego_ix] = False
    return np.flatnonzero(measured)


def find_episodes(scene: Scene, truth: Tracks, static: Statics, experiment: MetricsSetup) -> Episodes:
    """Onset and end of every measured object that has an onset. `truth`: the world at its own frames."""
    measure = experiment.measure
    is_measured = np.isin(truth.object_ix, measured_objects(scene, measure))
    world = truth.take_tracks(is_measured)
    stay = _ego_stay(scene, truth)
    if measure.onset.instant_s is not None:
        begun = _begin_at(measure.onset.instant_s, world, stay)
    else:
        possible = stay.there[world.frame_ix]
        view = OnsetView(
            world,
            lambda place: _measure_distance(scene, truth, world, experiment, place),
            lambda seen_by: _find_best_share(scene, truth, static, experiment, seen_by)[is_measured[truth.track_ix]],
        )
        holding = evaluate_onset(measure.onset, view) & possible
        begun = _begin_holding(world, holding, possible, truth.captured_s, stay, measure.onset.again_after_s)
    last_s = world.row_captured_s[world.start[begun.track + 1] - 1] if len(begun.track) else np.empty(0)
    ended_s, ended_by = _find_ends(last_s, stay.last_s, scene.end_s)
    leaves = np.isfinite(begun.held_until_s)
    ended_s = np.where(leaves, begun.held_until_s, ended_s)
    object_left, ego_left = END_REASONS.index(EndReason.OBJECT_LEFT), END_REASONS.index(EndReason.EGO_LEFT)
    ended_by = np.where(leaves, np.where(begun.ego_left, ego_left, object_left), ended_by)
    number = np.arange(len(begun.track)) - np.searchsorted(begun.track, begun.track)
    before_s = np.where(number > 0, np.append(-np.inf, ended_s)[:-1], -np.inf)
    object_ix = world.object_ix[begun.track]
    order = np.argsort(object_ix, kind="stable")
    return Episodes(
        object_ix, number, begun.onset_s, begun.began, ended_s, ended_by, before_s, begun.returns
    ).take(order)  # fmt: skip


class _Begun(NamedTuple):
    """Where episodes begin, track by track. All (M,). `held_until_s`: end of those before a return; inf: the others.

    `ego_left`: whether these end because the ego is absent, while the object is there.
    """

    track: Int
    onset_s: Float
    began: Int
    held_until_s: Float
    ego_left: Bool
    returns: Int


class _EgoStay(NamedTuple):
    """First and last instant of the ego, and whether it is there at each frame (F,). Without an ego: the whole log."""

    first_s: float
    last_s: float
    there: Bool


def _begin_at(instant_s: float, world: Tracks, stay: _EgoStay) -> _Begun:
    """The episodes of all objects that are there at an instant, with the ego."""
    first_s, last_s = world.row_captured_s[world.start[:-1]], world.row_captured_s[world.start[1:] - 1]
    track = np.flatnonzero((instant_s >= first_s - SAME_INSTANT_S) & (instant_s <= last_s + SAME_INSTANT_S))
    if not stay.first_s - SAME_INSTANT_S <= instant_s <= stay.last_s + SAME_INSTANT_S:
        track = track[:0]
    count = len(track)
    zeros = np.zeros(count, dtype=np.int64)
    begun = np.full(count, instant_s), np.full(count, CROSSED)
    return _Begun(track, *begun, np.full(count, np.inf), np.zeros(count, dtype=bool), zeros)


def _begin_holding(
    world: Tracks, holding: Bool, possible: Bool, frames_s: Float, stay: _EgoStay, again_after_s: float | None
) -> _Begun:
    """The episodes that begin at rows (P,) where the condition is `holding`; `possible`: where it can be evaluated.
    `again_after_s`: how long an object must have been away to begin another episode; None: it never does.
    """
    rows = np.flatnonzero(holding)
    track, time_s = world.track_ix[rows], world.row_captured_s[rows]
    first = np.diff(track, prepend=-1) != 0
    away_s = np.diff(time_s, prepend=-np.inf)
    # Away: at some frame in between the condition does not hold, or the object is absent.
    was_away = ~first & (np.diff(world.frame_ix[rows], prepend=-2) > 1)
    returned = was_away & (away_s > (AGAIN_AFTER_S if again_after_s is None else again_after_s) + SAME_INSTANT_S)
    begins = np.flatnonzero(first | returned if again_after_s is not None else first)
    onset_row, onset_first = rows[begins], first[begins]
    possible_from_s = frames_s[np.argmax(stay.there)] if stay.there.any() else np.inf
    first_possible_row, _ = _find_first_true(possible, world.start)
    own_first = first_possible_row[track[begins]] == onset_row
    # Who comes back crosses if it, and the ego, was there up to then, else it appears again.
    was_seen_before = (onset_row > 0) & (world.frame_ix[onset_row] - world.frame_ix[onset_row - 1] == 1)
    was_seen_before &= possible[onset_row - 1]
    began = np.where(np.where(onset_first, own_first, ~was_seen_before), APPEARED, CROSSED)
    began = np.where(onset_first & own_first & (time_s[begins] <= possible_from_s + SAME_INSTANT_S), LOG_START, began)
    held_until_s = np.full(len(begins), np.inf)
    return_ix = np.flatnonzero(~onset_first)
    held_until_s[return_ix - 1] = time_s[begins[return_ix] - 1]
    held_row, ego_left = rows[begins[return_ix] - 1], np.zeros(len(begins), dtype=bool)
    is_still_there = world.frame_ix[held_row + 1] - world.frame_ix[held_row] == 1
    ego_left[return_ix - 1] = is_still_there & ~possible[held_row + 1]
    count = np.append(0, np.cumsum(returned & ~np.isin(np.arange(len(rows)), begins)))
    returns = np.diff(count[np.append(begins, len(rows))])
    return _Begun(track[begins], time_s[begins], began, held_until_s, ego_left, returns)


def _find_ends(last_s: Float, ego_last_s: float, end_s: float) -> tuple[Float, Int]:
    """When and why episodes end that last as long as object and ego do. `last_s (M,)`: of the object."""
    ended_s = np.minimum(np.minimum(last_s, ego_last_s), end_s)
    object_left = (last_s < end_s - SAME_INSTANT_S) & (last_s <= ego_last_s + SAME_INSTANT_S)
    ego_left = ~object_left & (ego_last_s < end_s - SAME_INSTANT_S)
    reasons = EndReason.OBJECT_LEFT, EndReason.EGO_LEFT, EndReason.LOG_END
    left, ego, end = (END_REASONS.index(reason) for reason in reasons)
    return ended_s, np.where(object_left, left, np.where(ego_left, ego, end))


def _ego_stay(scene: Scene, truth: Tracks) -> _EgoStay:
    if scene.ego_ix < 0:
        return _EgoStay(0.0, scene.end_s, np.ones(len(truth.stamp_ns), dtype=bool))
    frames = truth.frame_ix[np.repeat(truth.object_ix == scene.ego_ix, np.diff(truth.start))]
    present = np.zeros(len(truth.stamp_ns), dtype=bool)
    present[frames] = True
    return _EgoStay(float(truth.captured_s[frames[0]]), float(truth.captured_s[frames[-1]]), present)


def _find_first_true(flags: Bool, start: Int) -> tuple[Int, Bool]:
    """First True row of every track (E,), and whether there is one."""
    rows = np.flatnonzero(flags)
    place = np.searchsorted(rows, start[:-1])
    exists = place < len(rows)
    first = rows[np.minimum(place, len(rows) - 1)] if len(rows) else start[:-1]
    exists &= first < start[1:]
    return np.where(exists, first, start[:-1]), exists


def _measure_distance(scene: Scene, truth: Tracks, world: Tracks, experiment: MetricsSetup, place: str) -> Float:
    """(P,) distance of each row, infinite where there is nothing to measure from."""
    per_frame = locate_reference(scene, truth, experiment, truth.captured_s)
    f = world.frame_ix
    dx, dy = world.x_m[0] - per_frame.x_m[f], world.y_m[0] - per_frame.y_m[f]
    if place == "front":
        cos, sin = np.cos(per_frame.heading_rad[f]), np.sin(per_frame.heading_rad[f])
        distance = np.abs(dx * cos + dy * sin - per_frame.length_m[f] / 2)
    else:
        distance = np.hypot(dx, dy)
    return np.where(per_frame.present[f], distance, np.inf)


def _find_best_share(
    scene: Scene, truth: Tracks, static: Statics, experiment: MetricsSetup, seen_by: Literal["ego", "any"]
) -> Float:
    """(P,) the largest visible share of each row of the truth for any unit (or those of the ego); 0: seen by none.
    Objects that are not measured have 0. Units that only some runs have do not count: an onset is the same in all runs.
    """
    ego_carriers = {"ego", scene.object_ids[scene.ego_ix]} if scene.ego_ix >= 0 else set()
    units = {
        name: unit
        for name, unit in experiment.units.items()
        if not isinstance(unit.on, Carriers) and (seen_by == "any" or unit.on in ego_carriers)
    }
    if not units:
        return np.zeros(len(truth.frame_ix))
    unit_poses = [compute_unit_poses(scene, u, truth, unit_ground(truth, n, u)) for n, u in units.items()]
    measured = np.isin(truth.row_object_ix, measured_objects(scene, experiment.measure))
    shares = visible_shares(
        truth,
        static,
        make_observers(unit_poses, np.array([find_carrier(scene, u) for u in units.values()])),
        experiment.visibility,
        np.tile(measured, (len(units), 1)),
    )
    best: Float = np.max(np.where(np.isnan(shares), 0.0, shares), axis=0)
    return best

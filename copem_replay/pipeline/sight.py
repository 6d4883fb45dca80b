"""Sight at the frames of the truth: how modelled units see the shown objects, and the body that hides most of each.

Lanes, stories and causes name what they name from here. Columns of tables come from the same states, at the lists of
units (`perception/sight.py`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from copem_replay.core.errors import is_own
from copem_replay.core.interpolation import interpolate_at_instants
from copem_replay.core.tracks import CLASSES, SAME_INSTANT_NS, SAME_INSTANT_S, Bool, Float, Int, Scene, Solid, Tracks
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.experiment.schema import Experiment, Unit
from copem_replay.perception.observation import Observations, compute_view
from copem_replay.perception.pem.condition import Condition, Couple, may_apply
from copem_replay.perception.sensor_poses import (
    UnitPoses,
    compute_unit_poses,
    find_carrier,
    make_observers,
    unit_ground,
)
from copem_replay.perception.sight import HIDDEN, NO_UNIT, judge_sight
from copem_replay.perception.visibility import VisibilityModel, find_blockers, visible_shares
from copem_replay.pipeline.expansion import give_views
from copem_replay.pipeline.one_run import BY_ANY, BY_EGO, Curve
from copem_replay.pipeline.prepare import Replay

ABSENT = 0
"""The state of an object that is not in the log; others are those of `perception/sight.py`."""

ROWS_AT_ONCE = 60_000
"""Rows of the world that are looked at together. It changes time and memory alone."""


@dataclass(frozen=True)
class Sight:
    """Objects (M,) as seen from the experiment's units (U,) at frames of the truth (K,).

    `state`: `ABSENT` of objects that are not there, and of recorded units without `views`. `share`: NaN outside the
    unit's field of view, while the unit is absent, and for its carrier. `body_ix`: the object that hides most of a
    hidden object, or −1 − k for the solid k; `body_m`: its centre.
    """

    elapsed_ns: Int  # (K,)
    object_ix: Int  # (M,)
    state: Int  # (U, K, M)
    share: Float  # (U, K, M)
    in_range: Bool  # (U, K, M)
    body_ix: Int  # (U, K, M)
    body_m: Float  # (U, K, M, 3)
    solids: tuple[str, ...]  # names
    place_m: Float  # (U, K, 3), of the units

    def find_best(self, units: Sequence[int], m: int) -> tuple[Int, Int]:
        """(K,) the best state of object m among modelled units, and its unit (K,): of equals the one that sees most."""
        state = self.state[units][:, :, m]
        best = np.argmax(state + 0.5 * np.nan_to_num(self.share[units][:, :, m]), axis=0)
        return state[best, np.arange(len(best))], np.array(units)[best]

    def find_hider(self, unit_ix: Int, frames: Int, m: int) -> tuple[int, int]:
        """The most frequent unit and body that hides object m from it, of pairs (n,) of a unit and a frame."""
        seen = np.unique(np.stack([unit_ix, frames]), axis=1)
        pairs, count = np.unique(np.stack([seen[0], self.body_ix[seen[0], seen[1], m]]), axis=1, return_counts=True)
        by, body = pairs[:, count.argmax()].tolist()
        return by, body


# Spans, as lanes show and stories tell them.

STEADY_S = 0.4
"""Shorter spans become part of those around them: their words could not be read."""


class Span(NamedTuple):
    """The prevailing status of the instants `first` to `end`, without `end`."""

    first: int
    end: int
    status: int


def smooth_status(elapsed_ns: Int, status: Int, *, end_ns: int | None = None, keep: int = -1) -> list[Span]:
    """The spans of a status (K,) until `end_ns`, none shorter than `STEADY_S`; 0: the object is absent.

    A sequence of shorter statuses becomes one span, of the status with the longest total duration. A sequence that is
    too short as a whole continues the span before, unless the object is absent then. The first span of the status
    `keep` stays, however short.
    """
    steady_ns = round(STEADY_S * 1e9)
    first = np.flatnonzero(np.diff(status, prepend=-1))
    end_ns = elapsed_ns[-1] + steady_ns if end_ns is None else end_ns
    values, lasts = status[first], np.diff(elapsed_ns[first], append=end_ns)
    long_enough = lasts >= steady_ns
    long_enough[np.flatnonzero(values == keep)[:1]] = True
    spans: list[Span] = []
    k = 0
    while k < len(first):
        end = k + 1
        if not long_enough[k]:
            end = next((n for n in range(k, len(first)) if long_enough[n]), len(first))
        duration_by_status = np.bincount(values[k:end], weights=lasts[k:end])
        alone = not spans or spans[-1].status == 0
        if long_enough[k] or alone or duration_by_status.sum() >= steady_ns:
            spans.append(Span(int(first[k]), len(status), int(duration_by_status.argmax())))
        k = end
    merged = [span for n, span in enumerate(spans) if n == 0 or span.status != spans[n - 1].status]
    return [span._replace(end=after.first) for span, after in pairwise([*merged, Span(len(status), 0, 0)])]


@dataclass(frozen=True)
class StatusSpan:
    """A time from `begin_s` to `end_s`, seconds since the log's start, in which an object has one status.

    `unit`: the one that it is mostly about, “”: none; of a hidden object from whom, and by what, `body`, in words and
    as in `Sight.body_ix`.
    """

    status: int
    begin_s: float
    end_s: float
    unit: str = ""
    body: str = ""
    body_ix: int = 0


class SpanNames(NamedTuple):
    """Names by unit, and by body as in `Sight.body_ix`."""

    units: Sequence[str]
    bodies: Sequence[str]


def list_spans(
    sight: Sight, m: int, timeline: tuple[Int, ...], names: SpanNames, until_s: float, keep: int = -1
) -> list[StatusSpan]:
    """The status spans of object m until `until_s`. `keep`: as in `smooth_status`.

    `timeline`: instants (K,) in ns since the log's start, and at each the status, its unit, −1: none, and the frame.
    """
    begins_ns, status, unit_ix, frame = timeline
    ends_s, spans = np.append(begins_ns * 1e-9, until_s).tolist(), list[StatusSpan]()
    for first, end, state in smooth_status(begins_ns, status, end_ns=round(until_s * 1e9), keep=keep):
        rows = np.arange(first, end)[status[first:end] == state]
        u, body_ix, body = int(np.bincount(unit_ix[rows] + 1).argmax()) - 1, 0, ""
        if state == HIDDEN:
            u, body_ix = sight.find_hider(unit_ix[rows], frame[rows], m)
            body = names.bodies[body_ix]
        spans.append(StatusSpan(state, ends_s[first], ends_s[end], names.units[u] if u >= 0 else "", body, body_ix))
    return spans


def within(elapsed_ns: Int, from_s: float, until_s: float) -> Int:
    """Indices of the instants, out of ascending ones (K,), that hold anywhere between two times."""
    time_s = elapsed_ns * 1e-9
    return np.flatnonzero(
        (time_s < until_s - SAME_INSTANT_S) & (np.append(time_s[1:], np.inf) > from_s + SAME_INSTANT_S)
    )


def list_sight_spans(
    replay: Replay, sight: Sight, m: int, names: Sequence[str], from_s: float, until_s: float
) -> list[StatusSpan]:
    """The sight of object m by the units `names` between two instants; nothing of recorded units without `views`."""
    unit_names = list(replay.expanded.units)
    sensing = replay.expanded.list_sensing(names)
    units = [unit_names.index(name) for name in sensing if name in replay.sighted.modelled]
    frames = within(sight.elapsed_ns, from_s, until_s)
    if not units or not len(frames):
        return []
    state, unit_ix = (values[frames] for values in sight.find_best(units, m))
    begins_ns = np.maximum(sight.elapsed_ns[frames], round(from_s * 1e9))
    bodies = name_bodies(replay.scene, sight.solids, replay.scene.object_ids)
    return list_spans(sight, m, (begins_ns, state, unit_ix, frames), SpanNames(unit_names, bodies), until_s)


def name_bodies(scene: Scene, solids: Sequence[str], ids: Sequence[str]) -> list[str]:
    """Names of bodies that may hide: “bus 12” of the object with that index, and of the solid k at −1 − k."""
    objects = [f"{CLASSES[k]} {name}" for name, k in zip(ids, scene.object_class, strict=True)]
    return [*objects, *reversed(solids)]


def compute_sight(
    replay: Replay, experiment: Experiment, shown: Sequence[int], observed: Observations | None = None
) -> Sight:
    """The sight of the shown objects, at the frames of the truth that have any of them.

    `observed`: observations whose visible shares are taken instead of being computed again.
    """
    scene, truth, experiment = replay.scene, replay.truth, give_views(experiment)
    stamps = truth.stamp_ns[np.unique(truth.frame_ix[np.isin(truth.row_object_ix, shown)])]
    shape = (len(experiment.units), len(stamps), len(shown))
    sight = Sight(
        elapsed_ns=stamps - scene.t0_ns,
        object_ix=np.array(shown, dtype=np.int64),
        state=np.full(shape, ABSENT),
        share=np.full(shape, np.nan),
        in_range=np.zeros(shape, dtype=bool),
        body_ix=np.zeros(shape, dtype=np.int64),
        body_m=np.full((*shape, 3), np.nan),
        solids=tuple(solid.name for solid in replay.placed.solids),
        place_m=np.full((*shape[:2], 3), np.nan),
    )
    centres = _centres(replay.placed.solids)
    known_shares = _known_shares(sight, experiment, observed, scene.t0_ns)
    # Frames with so many rows at once: every present object may hide another one.
    at_once = max(1, ROWS_AT_ONCE * len(truth.stamp_ns) // max(len(truth.frame_ix), 1))
    for first in range(0, len(stamps), at_once):
        _compute_part(replay, experiment, sight, known_shares, slice(first, first + at_once), centres)
    return sight


def find_looked_at(replay: Replay, sight: Sight, object_ix: int, curves: Mapping[str, Curve]) -> dict[str, Bool]:
    """(K,) by curve of the visible share, whether the object is in a field of view of the curve's units."""
    experiment, m = replay.expanded, int(np.flatnonzero(sight.object_ix == object_ix)[0])
    numbers = {name: u for u, name in enumerate(experiment.units)}
    ego = replay.scene.ego_ix
    own = [numbers[name] for name, unit in experiment.modelled.items() if ego == find_carrier(replay.scene, unit) >= 0]
    by_name = {BY_EGO: own, BY_ANY: [numbers[name] for name in experiment.modelled]}
    looked = {}
    for name, curve in curves.items():
        frame = np.searchsorted(sight.elapsed_ns, curve.elapsed_ns + SAME_INSTANT_NS, side="right") - 1
        seen = np.asarray((~np.isnan(sight.share[by_name[name], :, m])).any(axis=0))
        looked[name] = seen[np.maximum(frame, 0)] & (frame >= 0)
    return looked


def _known_shares(sight: Sight, experiment: Experiment, observed: Observations | None, t0_ns: int) -> Float:
    """(U, K, M) visible shares observed exactly at frames of the truth; NaN: not observed there, still to compute."""
    shares = np.full(sight.share.shape, np.nan)
    if observed is None or not len(sight.object_ix):
        return shares
    tracks = observed.tracks
    numbers = {name: u for u, name in enumerate(experiment.units)}
    unit = np.array([numbers.get(name, -1) for name in tracks.units], dtype=np.int64)[tracks.row_unit_ix]
    captured_ns = tracks.stamp_ns[tracks.frame_ix] - t0_ns
    frame = np.minimum(np.searchsorted(sight.elapsed_ns, captured_ns), max(len(sight.elapsed_ns) - 1, 0))
    column = (tracks.row_object_ix[:, None] == sight.object_ix).argmax(axis=1)
    rows = np.flatnonzero((unit >= 0) & np.isin(tracks.row_object_ix, sight.object_ix))
    rows = rows[sight.elapsed_ns[frame[rows]] == captured_ns[rows]]
    shares[unit[rows], frame[rows], column[rows]] = observed.view.visible_share[rows]
    return shares


def _compute_part(
    replay: Replay, experiment: Experiment, sight: Sight, known_shares: Float, part: slice, centres: np.ndarray
) -> None:
    """Fill `sight` at the frames of `part`: place, range, visible share and state of each unit, and what hides."""
    scene, shown = replay.scene, sight.object_ix.tolist()
    world = _world_at_frames(replay, experiment, sight.elapsed_ns[part])
    rows, column = _shown_rows(world, shown)
    if not len(rows):
        return
    frame = part.start + world.frame_ix[rows]
    for u, (name, unit) in enumerate(experiment.units.items()):
        if unit.pem is None:
            continue
        poses = _unit_poses(replay, name, unit, world)
        class_ix, unseen = scene.object_class[world.row_object_ix[rows]], np.full(len(rows), np.nan)
        with np.errstate(invalid="ignore"):  # where the unit is absent
            view = compute_view(world.take_rows(rows), poses, world.frame_ix[rows], unseen, class_ix)
            pem = experiment.pems[str(unit.pem)].couples
            in_field = may_apply(pem, view, scene.tags)
            sight.in_range[u, frame, column] = _is_in_range(pem, view)
        sight.place_m[u, part] = np.stack([poses.x_m, poses.y_m, poses.z_m], axis=-1)
        known_in_field = np.where(in_field, known_shares[u, frame, column], 0.0)
        share = _visible_shares(replay, experiment, unit, poses, world, rows, known_in_field)
        sight.share[u, frame, column] = share = np.where(in_field, share, np.nan)
        state = judge_sight(str(unit.pem), experiment, replace(view, visible_share=share), scene.tags)
        is_there = poses.present[world.frame_ix[rows]] & (world.row_object_ix[rows] != find_carrier(scene, unit))
        sight.state[u, frame, column] = np.where(is_there, state, NO_UNIT)
        _find_hiders(replay, experiment, unit, poses, sight, u, part, centres)


def _unit_poses(replay: Replay, name: str, unit: Unit, world: Tracks) -> UnitPoses:
    """The unit's poses at the frames of the world; those of a fixed unit with lists are repeated."""
    placed, count = replay.placed.poses[name], len(world.stamp_ns)
    if unit.at is None or not len(placed.x_m):
        return compute_unit_poses(replay.scene, unit, world, unit_ground(replay.truth, name, unit))
    fixed = placed.x_m, placed.y_m, placed.z_m, placed.heading_rad, placed.ground_m
    x, y, z, heading, ground = (np.full(count, values[0]) for values in fixed)
    return UnitPoses(x, y, z, heading, np.ones(count, dtype=bool), ground)


def _visible_shares(
    replay: Replay, experiment: Experiment, unit: Unit, poses: UnitPoses, world: Tracks, rows: Int, known_shares: Float
) -> Float:
    """(P,) visible shares of rows of the world as this unit has them: the known ones, and all others computed."""
    carrier_ix = find_carrier(replay.scene, unit)
    lacks = np.isnan(known_shares) & poses.present[world.frame_ix[rows]] & (world.row_object_ix[rows] != carrier_ix)
    if not lacks.any():
        return known_shares
    watching = make_observers([poses], np.array([carrier_ix]))
    near_world, rows = _keep_near_lines(world, poses, rows, lacks, experiment.visibility)
    needed = np.zeros((1, len(near_world.frame_ix)), dtype=bool)
    needed[0, rows[lacks]] = True
    [share] = visible_shares(near_world, replay.placed.static, watching, experiment.visibility, needed)
    return np.where(lacks, share[rows], known_shares)


def _keep_near_lines(
    world: Tracks, poses: UnitPoses, rows: Int, needed: Bool, model: VisibilityModel
) -> tuple[Tracks, Int]:
    """The world without bodies that cannot hide any `needed` row from the unit, and the indices of `rows` in it.

    A body hides nothing if it is farther from the line between unit and target than both radii together. A user's
    visibility model gets the whole world.
    """
    if is_own(type(model)):
        return world, rows
    radius_m = np.hypot(world.length_m[0], world.width_m[0]) / 2
    order, bounds = world.by_frame
    may_hide = np.zeros(len(world.frame_ix), dtype=bool)
    may_hide[rows] = True
    targets = rows[needed & poses.present[world.frame_ix[rows]]]
    frames = world.frame_ix[targets]
    count = np.diff(bounds)[frames]
    target = np.repeat(targets, count)
    body = order[np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + np.repeat(bounds[frames], count)]
    ux, uy = poses.x_m[world.frame_ix[target]], poses.y_m[world.frame_ix[target]]
    tx, ty = world.x_m[0, target] - ux, world.y_m[0, target] - uy
    ox, oy = world.x_m[0, body] - ux, world.y_m[0, body] - uy
    along = np.clip((ox * tx + oy * ty) / np.maximum(tx * tx + ty * ty, 1e-12), 0.0, 1.0)
    may_hide[body[np.hypot(ox - along * tx, oy - along * ty) <= radius_m[target] + radius_m[body] + 1e-6]] = True
    return world.take_rows(np.flatnonzero(may_hide)), np.cumsum(may_hide)[rows] - 1


def _world_at_frames(replay: Replay, experiment: Experiment, elapsed_ns: Int) -> Tracks:
    """The truth at ascending frames (K,), ns since the log's start."""
    t0_ns = replay.scene.t0_ns
    return interpolate_at_instants(replay.truth, t0_ns + elapsed_ns, t0_ns=t0_ns, max_gap_s=experiment.max_gap_s)


def _shown_rows(world: Tracks, shown: Sequence[int]) -> tuple[Int, Int]:
    """The rows of the shown objects, and the index of each row's object in `shown`."""
    rows = np.flatnonzero(np.isin(world.row_object_ix, shown))
    return rows, np.argsort(shown)[np.searchsorted(np.sort(shown), world.row_object_ix[rows])]


def _find_hiders(
    replay: Replay, experiment: Experiment, unit: Unit, poses: UnitPoses, sight: Sight, u: int, part: slice,
    centres: np.ndarray,
) -> None:  # fmt: skip
    """Fill `body_ix`, `body_m` of `sight` for unit u where it has a hidden object in `part`; `poses`: of its frames."""
    hidden_frames = np.flatnonzero((sight.state[u, part] == HIDDEN).any(axis=1))
    if not len(hidden_frames):
        return
    frames = part.start + hidden_frames
    world = _world_at_frames(replay, experiment, sight.elapsed_ns[frames])
    poses_then = UnitPoses(
        *(getattr(poses, name)[hidden_frames] for name in ("x_m", "y_m", "z_m", "heading_rad", "present", "ground_m"))
    )
    watching = make_observers([poses_then], np.array([find_carrier(replay.scene, unit)]))
    rows, column = _shown_rows(world, sight.object_ix.tolist())
    world, rows = _keep_near_lines(world, poses_then, rows, np.ones(len(rows), dtype=bool), experiment.visibility)
    [hides] = find_blockers(world, replay.placed.static, watching, experiment.visibility)
    is_hidden = hides[rows] != -1  # nothing hides any of it
    rows, column = rows[is_hidden], column[is_hidden]
    count = len(world.frame_ix)
    body = np.where(hides[rows] >= 0, hides[rows], count - 2 - hides[rows])
    bodies = np.concatenate([world.row_object_ix, -1 - np.arange(len(centres))])
    body_m = np.concatenate([np.stack([world.x_m[0], world.y_m[0], world.z_m[0]], axis=-1), centres])
    sight.body_ix[u, frames[world.frame_ix[rows]], column] = bodies[body]
    sight.body_m[u, frames[world.frame_ix[rows]], column] = body_m[body]


def _is_in_range(pem: tuple[Couple, ...], view: ViewGeometry) -> Bool:
    """(P,) whether the range of any couple holds."""
    held: Bool = np.any([Condition(range_m=couple.when.range_m).holds(view) for couple in pem], axis=0)
    return held & ~np.isnan(view.range_m)


def _centres(solids: Sequence[Solid]) -> np.ndarray:
    """(K, 3) centres of solids, at half their height."""
    import shapely

    middle = shapely.centroid([shapely.Polygon(solid.corners_m) for solid in solids])
    halfway_m = np.array([(solid.bottom_m + solid.top_m) / 2 for solid in solids])
    return np.stack([shapely.get_x(middle), shapely.get_y(middle), halfway_m], axis=-1)

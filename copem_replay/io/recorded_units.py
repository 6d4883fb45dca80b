"""Recorded units and recorded outputs: lists of a log as an experiment takes them, checked against the truth.

A unit's list is captured when its message says, else `delay_s` before its stamp, and arrives at its stamp. A covariance
and an existence that messages do not state come from the experiment. The fused list of a stack (an output) is available
at its stamp where the message states its capture, too, else when it was logged.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from copem_replay.core.assignment import assign
from copem_replay.core.errors import RecordingError, count_noun
from copem_replay.core.interpolation import interpolate_at_instants
from copem_replay.core.tracks import AGREE, SAME_INSTANT_NS, Bool, Float, Int, Scene, Tracks, join_tracks
from copem_replay.io.clock_offset import TimeOffset, estimate_time_offset
from copem_replay.io.config import RecordedOutput, RecordedTopic
from copem_replay.io.findings import Finding
from copem_replay.io.ground_truth import MAX_GAP_S
from copem_replay.io.recorded_lists import RecordedLists, read_unit_lists
from copem_replay.io.recording import Recording
from copem_replay.io.short_tracks import make_list_points

# Recorded lists held against the truth: their delay, and what is odd about them.

LONGEST_S = 1.0
"""Longest delay that is estimated: ten periods of lists at 10 Hz. A larger one is reported as not within the range."""
EARLIEST_S = -0.2
"""Least delay that is estimated, below 0 for small clock errors: a list that is earlier by more is of another clock."""
MANY = 0.2
"""A larger share of odd entries is reported: it is no chance."""
MOVING_MPS = 2.0
"""A track moves where its positions and its stated velocity are faster: jitter of positions is slower."""
CHANGES_PER_MIN = 6.0
"""An object whose id changes more often, every 10 s, is reported: a fusion that follows ids loses it each time."""


def estimate_delay(recorded: RecordedLists, scene: Scene, truth: Tracks) -> TimeOffset:
    """Time from capture to stamp of the lists that do not state their capture, as their entries fit the truth best.

    Entries are taken as shifted along their path wherever such a shift can be told from a delay.
    """
    unstated = ~recorded.capture_said[recorded.tracks.frame_ix]
    lists = make_list_points(recorded.tracks, scene.t0_ns, recorded.track_id)
    order = np.argsort(
        np.unique(recorded.tracks.stamp_ns, return_inverse=True)[1][recorded.tracks.frame_ix], kind="stable"
    )
    lists = lists.take(np.flatnonzero(unstated[order]))
    return estimate_time_offset(
        make_list_points(truth, scene.t0_ns), lists, from_s=EARLIEST_S, to_s=LONGEST_S, shifted=True
    )


def delay_words(delay: TimeOffset) -> str:
    """`0.148 s (95 %: 0.123 … 0.172 s, …)`, or `cannot be told: …`."""
    if delay.untold is not None:
        return f"cannot be told: {delay.untold}"
    words = f"{delay.offset_s:.3f} s (95 %: {delay.low_s:.3f} … {delay.high_s:.3f} s"
    return words + (", if no entry is shifted along its way, which cannot be told apart)" if delay.unbiased else ")")


def describe_oddities(lists: RecordedLists, object_ix: Int, scene: Scene) -> Iterator[str]:
    """A line each for velocities that point backwards, ids that change, and many entries about no true object.

    `object_ix (P,)`: the true object that each entry is about, −1: none.
    """
    backwards = backwards_share(lists)
    if backwards is not None and backwards > MANY:
        yield (
            f"in {backwards:.0%} of its entries the velocity points backwards, against the way its own tracks move; a "
            "fusion that uses velocities (`tracker` with `late: predict`, new tracks) will put objects in wrong places"
        )
    yield from _changing_ids(lists, object_ix, scene)
    count = len(object_ix)
    unknown = int((object_ix < 0).sum())
    if count and unknown > MANY * count:
        yield (
            f"{unknown} of {count_noun(count, 'entry', 'entries')} match nothing in the truth (not labelled, or false);"
            " those of a measured class count as false positives"
        )


def _changing_ids(lists: RecordedLists, object_ix: Int, scene: Scene) -> Iterator[str]:
    """A line on the object whose id changes most often, if that is more than `CHANGES_PER_MIN`; else none."""
    rows = np.flatnonzero((object_ix >= 0) & (lists.track_id >= 0))
    time_s = lists.tracks.row_captured_s
    order = rows[np.lexsort((time_s[rows], object_ix[rows]))]
    same = np.diff(object_ix[order]) == 0
    changed = same & (np.diff(lists.track_id[order]) != 0)
    if not changed.any():
        return
    changes = np.bincount(object_ix[order][1:][changed], minlength=len(scene.object_ids))
    worst = int(changes.argmax())
    row_times_s = time_s[order[object_ix[order] == worst]]
    span_s = float(row_times_s[-1] - row_times_s[0])
    if changes[worst] > 1 and changes[worst] * 60 > CHANGES_PER_MIN * span_s:
        ids = len(np.unique(lists.track_id[order[object_ix[order] == worst]]))
        yield (
            f"its ids change: object {scene.object_ids[worst]} has {ids} ids in {span_s:.1f} s and changes between "
            f"them {count_noun(int(changes[worst]), 'time')}"
        )


@np.errstate(over="ignore", invalid="ignore")  # a position may be any number
def backwards_share(lists: RecordedLists) -> float | None:
    """Share of the entries of moving tracks whose velocity points against their motion; None: nothing moves."""
    tracks = lists.tracks
    named = np.flatnonzero(lists.track_id >= 0)
    order = named[np.lexsort((tracks.row_captured_s[named], lists.track_id[named]))]
    same: Bool = (np.diff(lists.track_id[order]) == 0) & (np.diff(tracks.row_captured_s[order]) > 0)
    before, after = order[:-1][same], order[1:][same]
    step_s = tracks.row_captured_s[after] - tracks.row_captured_s[before]
    east, north = ((getattr(tracks, n)[0, after] - getattr(tracks, n)[0, before]) / step_s for n in ("x_m", "y_m"))
    vx, vy = tracks.vx_mps[0, after], tracks.vy_mps[0, after]
    moving = (np.hypot(east, north) > MOVING_MPS) & (np.hypot(vx, vy) > MOVING_MPS)
    if not moving.any():
        return None
    return float(((east * vx + north * vy) < 0)[moving].mean())


def shift_captures(lists: RecordedLists, scene: Scene, delay_s: float) -> RecordedLists:
    """The lists with captures `delay_s` before their stamps where they do not state their capture."""
    late_ns = np.where(lists.capture_said, 0, round(delay_s * 1e9))
    stamp_ns = lists.tracks.stamp_ns - late_ns
    captured_s = (stamp_ns - scene.t0_ns) * np.float64(1e-9)
    return replace(lists, tracks=replace(lists.tracks, stamp_ns=stamp_ns, captured_s=captured_s))


# Recorded units.

OWN_BODY_M = 0.5
"""Margin around the ego's box in which a listed centre is the ego's own body: no other centre can be that near."""


@dataclass(frozen=True)
class RecordedUnits:
    """The lists of all recorded units of an experiment over one log, one run; every row is a track of its own, (P,).

    `tracks.object_ix` is the true object by the gated optimal assignment at the row's capture, −1: none.
    """

    tracks: Tracks
    existence: Float
    class_probability: Float  # (P, C)
    track_id: Int

    @cached_property
    def _by_capture(self) -> tuple[Int, Float]:
        """(P,) rows in order of capture, and (P,) their captures in s."""
        order = np.argsort(self.tracks.row_captured_s, kind="stable")
        return order, self.tracks.row_captured_s[order]

    def captured_between(self, from_s: float, until_s: float) -> RecordedUnits:
        """Only rows captured at `from_s` or later and before `until_s`; all lists stay."""
        order, captured_s = self._by_capture
        first, after = np.searchsorted(captured_s, (from_s, until_s))
        if first == 0 and after == len(order):
            return self
        rows = np.sort(order[first:after])
        return RecordedUnits(
            self.tracks.take_rows(rows), self.existence[rows], self.class_probability[rows], self.track_id[rows]
        )


def read_as_recorded(recording: Recording, topic: str) -> RecordedLists:
    """The lists on a topic with what their messages state, and nothing else. Raises RecordingError."""
    return read_unit_lists(recording.local, topic, recording.scene, recording.around, recording.window)


def read_recorded_unit(
    recording: Recording,
    name: str,
    config: RecordedTopic,
    *,
    gate_m: float = 3.0,
    max_gap_s: float = MAX_GAP_S,
    noun: str = "unit",
    checked: bool = True,
) -> tuple[RecordedLists, list[str]]:
    """A unit's lists as the experiment asks for them, in the window and frames of the truth, and notes.

    `noun`: what the notes call it. `checked`: whether it is checked against the truth.
    Raises RecordingError: no such topic, a message that cannot be decoded, no covariance from anywhere.
    """
    path, scene = recording.path, recording.scene
    lists = read_as_recorded(recording, config.topic)
    tracks = lists.tracks
    if not len(tracks.stamp_ns):
        raise RecordingError(
            f"holds no list{' in the window' if recording.window else ''}", path=path, topic=config.topic
        )
    columns = _covariance_columns(lists, config, path)
    label = f"{noun} {name}"
    notes = [note.within(label) if isinstance(note, Finding) else f"{label}: {note}" for note in lists.notes]
    late_ns = np.where(lists.capture_said, 0, round(config.delay_s * 1e9))
    arrives_ns = scene.t0_ns + np.rint(tracks.common_arrives_s * 1e9).astype(np.int64)
    stamp_ns = np.minimum(tracks.stamp_ns - late_ns, arrives_ns)
    early = int((tracks.stamp_ns > arrives_ns + SAME_INSTANT_NS).sum())
    if early:
        statement = count_noun(early, "list says it was", "lists say they were")
        notes.append(f"{label}: {statement} captured after arriving; taken as captured then")
    tracks = replace(
        tracks, units=(name,), stamp_ns=stamp_ns, captured_s=(stamp_ns - scene.t0_ns) * np.float64(1e-9), **columns
    )
    if checked:
        statement = f"delay_s is {config.delay_s:g}"
        lines = check_against_truth(
            recording, lists, tracks, statement, config.delay_s, gate_m=gate_m, max_gap_s=max_gap_s
        )
        notes += [f"{label}: {line}" for line in lines]
    existence = np.where(np.isnan(lists.existence), config.existence, lists.existence)
    return replace(lists, tracks=tracks, existence=np.clip(existence, 0.0, 1.0)), notes


def _covariance_columns(lists: RecordedLists, config: RecordedTopic, path: Path) -> dict[str, Any]:
    """Columns of covariance (m²), with the experiment's where an entry states none; empty: nothing to fill in. Raises
    RecordingError: an entry states none, and the experiment gives none.
    """
    unstated = ~lists.spread_said
    if config.covariance_m2 is None:
        if unstated.any():
            raise RecordingError(
                f"{unstated.sum()} of {count_noun(len(unstated), 'entry', 'entries')} say nothing of their "
                "covariance; give `covariance_m2`, which `copem-replay fit` estimates",
                path=path,
                topic=config.topic,
            )
        return {}
    (ee, en), (_, nn) = config.covariance_m2
    values = (("cov_ee_m2", ee), ("cov_en_m2", en), ("cov_nn_m2", nn))
    return {column: np.where(unstated, value, getattr(lists.tracks, column)) for column, value in values}


def check_against_truth(
    recording: Recording,
    lists: RecordedLists,
    tracks: Tracks,
    statement: str,
    delay_s: float,
    *,
    gate_m: float,
    max_gap_s: float,
) -> Iterator[str]:
    """A line for a delay that the truth contradicts, and a line for each oddity.

    `lists`: captured at their stamps. `tracks`: the same rows at the instants that the experiment states,
    `delay_s` before the stamps; `statement` words that statement.
    """
    scene, truth = recording.scene, recording.truth
    if not lists.capture_said.all():
        delay = estimate_delay(lists, scene, truth)
        if delay.untold is None and not delay.low_s <= delay_s <= delay.high_s:
            yield f"{statement}, but its entries fit the truth at {delay_words(delay)}"
    matched = assign_truth_ids(replace(lists, tracks=tracks), scene, truth, gate_m=gate_m, max_gap_s=max_gap_s)
    yield from describe_oddities(lists, matched.row_object_ix, scene)


def assign_truth_ids(
    lists: RecordedLists, scene: Scene, truth: Tracks, *, gate_m: float, max_gap_s: float, confused: float = 0.0
) -> Tracks:
    """The unit's tracks with truth ids: list by list the optimal assignment by distance, classes agreeing, gated.

    An unmatched pair costs as much as the gate, so that no exact pair is given up for another one. The entry of the
    ego's own body is found first, from the ego alone (the nearest entry whose centre is in its box): it is left out of
    what fusions see, and what they see must not depend on the true positions of others. `confused`: the worth of a pair
    whose classes do not agree, as a share of that of one whose classes do; 0: no such pair.
    """
    tracks = lists.tracks
    stamps, instant = np.unique(tracks.stamp_ns, return_inverse=True)
    world = interpolate_at_instants(truth, stamps, t0_ns=scene.t0_ns, max_gap_s=max_gap_s)
    order, bounds = world.by_frame
    by_list, starts = tracks.by_frame
    object_ix = np.full(len(tracks.frame_ix), -1)
    class_ix = lists.class_probability.argmax(axis=1)
    for f in range(len(tracks.stamp_ns)):
        rows = by_list[starts[f] : starts[f + 1]]
        bodies = order[bounds[instant[f]] : bounds[instant[f] + 1]]
        if not len(rows) or not len(bodies):
            continue
        away_m = np.hypot(
            tracks.x_m[0, rows, None] - world.x_m[0, bodies], tracks.y_m[0, rows, None] - world.y_m[0, bodies]
        )
        agrees = AGREE[class_ix[rows][:, None], scene.object_class[world.row_object_ix[bodies]]]
        allowed = (away_m <= gate_m + 1e-9) & (agrees | (confused > 0))
        for ego in np.flatnonzero(world.row_object_ix[bodies] == scene.ego_ix):
            body_m = np.where(allowed[:, ego] & _is_inside(tracks, rows, world, bodies[ego]), away_m[:, ego], np.inf)
            if np.isfinite(body_m.min()):
                object_ix[rows[body_m.argmin()]] = scene.ego_ix
                allowed[body_m.argmin()] = False
            allowed[:, ego] = False
        partner = np.full(len(rows), -1)
        worth = (away_m - (gate_m + 2e-9)) * np.where(agrees, 1.0, confused)
        assign(np.ascontiguousarray(np.where(allowed, worth, np.inf)), partner)
        object_ix[rows[partner >= 0]] = world.row_object_ix[bodies[partner[partner >= 0]]]
    return replace(tracks, object_ix=object_ix)


def _is_inside(tracks: Tracks, rows: Int, world: Tracks, body: int) -> Bool:
    """(K,) whether the centres of `rows` lie in the box of row `body`, or beside it within a margin."""
    east, north = tracks.x_m[0, rows] - world.x_m[0, body], tracks.y_m[0, rows] - world.y_m[0, body]
    cos, sin = np.cos(world.yaw_rad[0, body]), np.sin(world.yaw_rad[0, body])
    ahead, left = np.abs(east * cos + north * sin), np.abs(north * cos - east * sin)
    inside: Bool = np.maximum(ahead - world.length_m[0, body] / 2, left - world.width_m[0, body] / 2) <= OWN_BODY_M
    return inside


def join_recorded_units(
    lists: Mapping[str, RecordedLists], scene: Scene, truth: Tracks, *, gate_m: float, max_gap_s: float
) -> RecordedUnits | None:
    """The lists of all recorded units of an experiment, joined and with truth ids; None where there are none."""
    if not lists:
        return None
    tracks = [
        assign_truth_ids(unit_lists, scene, truth, gate_m=gate_m, max_gap_s=max_gap_s) for unit_lists in lists.values()
    ]
    return RecordedUnits(
        join_tracks(tuple(lists), tracks),
        np.concatenate([unit_lists.existence for unit_lists in lists.values()]),
        np.concatenate([unit_lists.class_probability for unit_lists in lists.values()]),
        np.concatenate([unit_lists.track_id for unit_lists in lists.values()]),
    )


# Recorded outputs: the fused lists of a stack.

SAME_CLOCK_S = 60.0
"""Lists logged farther from their stamps were stamped by another clock: no stack takes a minute."""
_PREDICTED = "by `tells_of` its states are of when it is available, a delay of 0"


def read_recorded_output(
    recording: Recording, name: str, config: RecordedOutput, *, gate_m: float = 3.0, max_gap_s: float = MAX_GAP_S
) -> tuple[RecordedLists, list[str]]:
    """A stack's lists, captured at the instants that their states are of and arriving when available; and notes.

    Raises RecordingError: no such topic, a message that cannot be decoded, no covariance from anywhere.
    """
    predicted = config.tells_of == "available"
    lists, notes = read_recorded_unit(
        recording, name, config, gate_m=gate_m, max_gap_s=max_gap_s, noun="configuration", checked=not predicted
    )
    stamp_ns = recording.scene.t0_ns + np.rint(lists.tracks.common_arrives_s * 1e9).astype(np.int64)
    behind_ns = lists.logged_ns - stamp_ns
    asks = ~lists.capture_said & lists.stamped
    away_s = float(np.median(behind_ns[asks])) * 1e-9 if asks.any() else 0.0
    other_clock = abs(away_s) > SAME_CLOCK_S
    early = int((asks & (behind_ns < -SAME_INSTANT_NS)).sum())
    if other_clock:
        notes.append(
            f"configuration {name}: logged {away_s:.6g} s from its stamps, by another clock: its lists are taken as "
            "available at their stamps, and its latency is not known"
        )
    elif early:
        lists_early = count_noun(early, "list was logged before its stamp", "lists were logged before their stamps")
        notes.append(f"configuration {name}: {lists_early}; taken as available then")
    available_ns = stamp_ns if other_clock else np.where(asks, np.maximum(lists.logged_ns, stamp_ns), stamp_ns)
    arrives_s = (available_ns - recording.scene.t0_ns) * np.float64(1e-9)
    stamped = lists.stamped & (not other_clock)
    if predicted:  # states are of the instant at which the list is available, whatever its message states
        tracks = replace(lists.tracks, stamp_ns=available_ns, captured_s=arrives_s)
        shown = replace(lists, tracks=tracks, capture_said=np.zeros_like(lists.capture_said))
        lines = check_against_truth(recording, shown, tracks, _PREDICTED, 0.0, gate_m=gate_m, max_gap_s=max_gap_s)
        notes += [f"configuration {name}: {line}" for line in lines]
    return replace(lists, tracks=replace(lists.tracks, arrives_s=arrives_s[None]), stamped=stamped), notes

"""Recorded units: lists as they were recorded in the log, beside those of modelled units.

A list is captured at its `last_measurement_time`, else `delay_s` before its stamp, and arrives at its stamp. What the
messages don't say of the covariance and of the existence comes from the experiment.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from copem_replay.core.agree import AGREE
from copem_replay.core.assignment import assign
from copem_replay.core.errors import RecordingError
from copem_replay.core.interpolation import at_instants
from copem_replay.core.text import counted
from copem_replay.core.tracks import SAME_INSTANT_NS, Bool, Float, Int, Scene, Tracks, joined
from copem_replay.io.config import Recorded
from copem_replay.io.list_checks import delay_of, delay_words, odd_about
from copem_replay.io.plausibility import MAX_GAP_S
from copem_replay.io.recorded_lists import lists_on
from copem_replay.io.recorded_osi import RecordedLists
from copem_replay.io.recording import Recording

OWN_BODY_M = 0.5
"""So far beside the ego's box the centre of its own body is listed (chosen: no other body can be that near)."""


@dataclass(frozen=True)
class RecordedUnits:
    """The lists of all recorded units of an experiment over one log, one run; every row is a track of its own. (P,)

    Of `tracks`, `object_ix` is the truth id of the gated optimal assignment at its capture, −1: none.
    """

    tracks: Tracks
    existence: Float
    class_probability: Float  # (P, C)
    track_id: Int

    @cached_property
    def _by_capture(self) -> tuple[Int, Float]:
        """Rows in order of capture (P,), and when that was (P,)."""
        order = np.argsort(self.tracks.row_captured_s, kind="stable")
        return order, self.tracks.row_captured_s[order]

    def captured_between(self, from_s: float, until_s: float) -> RecordedUnits:
        """Only rows captured from an instant on and before another; all lists stay."""
        order, captured_s = self._by_capture
        first, after = np.searchsorted(captured_s, (from_s, until_s))
        if first == 0 and after == len(order):
            return self
        rows = np.sort(order[first:after])
        return RecordedUnits(
            self.tracks.take_rows(rows), self.existence[rows], self.class_probability[rows], self.track_id[rows]
        )


def as_recorded(recording: Recording, topic: str) -> RecordedLists:
    """The lists on a topic with what their messages say, and nothing else. Raises RecordingError."""
    return lists_on(recording.local, topic, recording.scene, recording.around, recording.window)


def recorded_unit(
    recording: Recording,
    name: str,
    asked: Recorded,
    *,
    gate_m: float = 3.0,
    max_gap_s: float = MAX_GAP_S,
    called: str = "unit",
    held: bool = True,
) -> tuple[RecordedLists, list[str]]:
    """A unit's lists with all that is asked for, in the window and frames of the truth, and what has to be said.

    `called`: what it is in notes. `held`: whether what is odd about it is told by the truth, too.
    Raises RecordingError: no such topic, a message that cannot be decoded, no covariance from anywhere.
    """
    path, scene = recording.path, recording.scene
    found = as_recorded(recording, asked.topic)
    tracks = found.tracks
    if not len(tracks.stamp_ns):
        raise RecordingError(
            f"holds no list{' in the window' if recording.window else ''}", path=path, topic=asked.topic
        )
    unsaid = ~found.spread_said
    if unsaid.any() and asked.covariance_m2 is None:
        raise RecordingError(
            f"{unsaid.sum()} of {counted(len(unsaid), 'entry', 'entries')} say nothing of their "
            "covariance; give `covariance_m2`",
            path=path,
            topic=asked.topic,
        )
    me = f"{called} {name}"
    notes = [f"{me}: {found.dropped} of its entries have no position and are left out"] if found.dropped else []
    columns: dict[str, Any] = {}
    if asked.covariance_m2 is not None:
        (ee, en), (_, nn) = asked.covariance_m2
        for column, value in (("cov_ee_m2", ee), ("cov_en_m2", en), ("cov_nn_m2", nn)):
            columns[column] = np.where(unsaid, value, getattr(tracks, column))
    late_ns = np.where(found.capture_said, 0, round(asked.delay_s * 1e9))
    arrives_ns = scene.t0_ns + np.rint(tracks.common_arrives_s * 1e9).astype(np.int64)
    stamp_ns = np.minimum(tracks.stamp_ns - late_ns, arrives_ns)
    early = int((tracks.stamp_ns > arrives_ns + SAME_INSTANT_NS).sum())
    if early:
        said = counted(early, "list says it was", "lists say they were")
        notes.append(f"{me}: {said} captured after arriving; taken as captured then")
    tracks = replace(
        tracks, units=(name,), stamp_ns=stamp_ns, captured_s=(stamp_ns - scene.t0_ns) * np.float64(1e-9), **columns
    )
    if held:
        said = f"delay_s is {asked.delay_s:g}"
        lines = beside_truth(recording, found, tracks, said, asked.delay_s, gate_m=gate_m, max_gap_s=max_gap_s)
        notes += [f"{me}: {line}" for line in lines]
    existence = np.where(np.isnan(found.existence), asked.existence, found.existence)
    return replace(found, tracks=tracks, existence=np.clip(existence, 0.0, 1.0)), notes


def beside_truth(
    recording: Recording,
    found: RecordedLists,
    tracks: Tracks,
    said: str,
    delay_s: float,
    *,
    gate_m: float,
    max_gap_s: float,
) -> Iterator[str]:
    """A delay that the truth belies, and oddities. `found`: by its stamps; `tracks`: when states are `said` to be."""
    scene, truth = recording.scene, recording.truth
    if not found.capture_said.all():
        delay = delay_of(found, scene, truth)
        if delay.untold is None and not delay.low_s <= delay_s <= delay.high_s:
            yield f"{said}, but its entries fit the truth at {delay_words(delay)}"
    told = with_truth_ids(replace(found, tracks=tracks), scene, truth, gate_m=gate_m, max_gap_s=max_gap_s)
    yield from odd_about(found, told.row_object_ix, scene)


def with_truth_ids(
    found: RecordedLists, scene: Scene, truth: Tracks, *, gate_m: float, max_gap_s: float, confused: float = 0.0
) -> Tracks:
    """The unit's tracks with truth ids: list by list the optimal assignment by distance, classes agreeing, gated.

    To leave a pair alone costs as much as the gate, so that no exact pair is given up for another one. Which entry is
    the ego's own body is settled before, by the ego alone (the nearest whose centre is in its box): it is left out of
    what fusions see, and what they see must not depend on where others truly are. `confused`: a pair whose classes do
    not agree counts so much as one whose do; 0: it is none.
    """
    tracks = found.tracks
    stamps, back = np.unique(tracks.stamp_ns, return_inverse=True)
    world = at_instants(truth, stamps, t0_ns=scene.t0_ns, max_gap_s=max_gap_s)
    order, bounds = world.by_frame
    mine, starts = tracks.by_frame
    object_ix = np.full(len(tracks.frame_ix), -1)
    likely = found.class_probability.argmax(axis=1)
    for f in range(len(tracks.stamp_ns)):
        rows = mine[starts[f] : starts[f + 1]]
        there = order[bounds[back[f]] : bounds[back[f] + 1]]
        if not len(rows) or not len(there):
            continue
        away_m = np.hypot(
            tracks.x_m[0, rows, None] - world.x_m[0, there], tracks.y_m[0, rows, None] - world.y_m[0, there]
        )
        alike = AGREE[likely[rows][:, None], scene.object_class[world.row_object_ix[there]]]
        allowed = (away_m <= gate_m + 1e-9) & (alike | (confused > 0))
        for ego in np.flatnonzero(world.row_object_ix[there] == scene.ego_ix):
            body_m = np.where(allowed[:, ego] & _inside(tracks, rows, world, there[ego]), away_m[:, ego], np.inf)
            if np.isfinite(body_m.min()):
                object_ix[rows[body_m.argmin()]] = scene.ego_ix
                allowed[body_m.argmin()] = False
            allowed[:, ego] = False
        partner = np.full(len(rows), -1)
        worth = (away_m - (gate_m + 2e-9)) * np.where(alike, 1.0, confused)
        assign(np.where(allowed, worth, np.inf), partner)
        object_ix[rows[partner >= 0]] = world.row_object_ix[there[partner[partner >= 0]]]
    return replace(tracks, object_ix=object_ix)


def _inside(tracks: Tracks, rows: Int, world: Tracks, body: int) -> Bool:
    """(K,) whether the centres of `rows` lie in the box of row `body`, or beside it within a margin."""
    east, north = tracks.x_m[0, rows] - world.x_m[0, body], tracks.y_m[0, rows] - world.y_m[0, body]
    cos, sin = np.cos(world.yaw_rad[0, body]), np.sin(world.yaw_rad[0, body])
    ahead, left = np.abs(east * cos + north * sin), np.abs(north * cos - east * sin)
    inside: Bool = np.maximum(ahead - world.length_m[0, body] / 2, left - world.width_m[0, body] / 2) <= OWN_BODY_M
    return inside


def recorded_units(
    lists: Mapping[str, RecordedLists], scene: Scene, truth: Tracks, *, gate_m: float, max_gap_s: float
) -> RecordedUnits | None:
    """All recorded units of an experiment as one; None where there are none."""
    if not lists:
        return None
    pieces = [with_truth_ids(found, scene, truth, gate_m=gate_m, max_gap_s=max_gap_s) for found in lists.values()]
    return RecordedUnits(
        joined(tuple(lists), pieces),
        np.concatenate([found.existence for found in lists.values()]),
        np.concatenate([found.class_probability for found in lists.values()]),
        np.concatenate([found.track_id for found in lists.values()]),
    )

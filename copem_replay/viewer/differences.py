"""Differences of configurations to a baseline, in the view of each: what only one of the two knows, and since when.

| entity | is |
|---|---|
| `world/<configuration>/difference/gained`, `lost` | objects that only it, or only the baseline, holds then |
| `world/<configuration>/difference/first` | the way an object went between both knowing it for the first time |
| `plots/error_difference/<object>/<configuration>` | of position errors, at instants at which both list it |
| `events/difference/<configuration>` | in words, which knew it first |
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from copem_replay.core.colours import Rgb
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.interpolation import states_at
from copem_replay.core.tracks import SAME_INSTANT_NS, Bool, Int, Tracks
from copem_replay.experiment.schema import Experiment
from copem_replay.pipeline.prepare import Replay
from copem_replay.viewer.curves import draw_quartiles, position_error
from copem_replay.viewer.palette import DIFFERENCE
from copem_replay.viewer.sink import Out, entity_names, f32, ns, part_of, table_rows

_ABOVE_M, _LOST_POINTS, _GAINED_POINTS = 3.5, 6.0, 3.0
"""How far marks are above a box, clear of its name, and how large they are (chosen: what is missing matters)."""


def differences(
    out: Out, replay: Replay, experiment: Experiment, run_tracks: Mapping[str, FusedTracks], table: pd.DataFrame,
    baseline: str, shown: Sequence[int], colours: Mapping[str, Rgb],
) -> None:  # fmt: skip
    """All of it, for every configuration but the baseline."""
    second = run_tracks[baseline].fused
    for name in run_tracks:
        if name != baseline:
            first = run_tracks[name].fused
            _who_knows(out, replay, experiment, name, first, baseline, second)
            _errors(out, replay, experiment, name, first, second, shown, colours[name])
            mine, other = (table[table["configuration"] == one] for one in (name, baseline))
            both = mine.merge(other, on="object_id", suffixes=("", "_baseline"))
            _ways(out, replay, experiment, both, name, baseline, shown)
            _words(out, both, name, baseline)


def _who_knows(
    out: Out, replay: Replay, experiment: Experiment, name: str, first: Tracks, baseline: str, second: Tracks
) -> None:
    """A point above the true place of each object that one newest list holds and the other does not."""
    import rerun as rr

    scene = replay.scene
    # A box moves with the frames of the truth, what is known changes with the lists of either.
    instants = np.unique(np.concatenate([ns(tracks.common_arrives_s) for tracks in (replay.truth, first, second)]))
    mine, other = (_held(tracks, instants, len(scene.object_ids)) for tracks in (first, second))
    ids = pa.array(scene.object_ids, pa.string())
    for part, only, size, words in (
        ("gained", mine & ~other, _GAINED_POINTS, f"not in {baseline}"),
        ("lost", other & ~mine, _LOST_POINTS, f"only in {baseline}"),
    ):
        row, object_ix = np.nonzero(only)
        at, there = states_at(
            replay.truth, object_ix, instants[row] / 1e9, t0_ns=scene.t0_ns, max_gap_s=experiment.max_gap_s
        )
        place = f32(at["x_m"], at["y_m"], at["z_m"] + at["height_m"] / 2 + _ABOVE_M)[there]
        counts = np.bincount(row[there], minlength=len(instants))
        kept = (counts > 0) | (np.append(0, counts[:-1]) > 0)  # an empty row ends what was
        labels = pc.binary_join_element_wise(ids.take(pa.array(object_ix[there])), words, " ")
        columns = rr.Points3D.columns(positions=place, labels=labels).partition(counts[kept])
        path = ["world", part_of(name), "difference", part]
        out.columns(path, instants[kept], columns)
        dot = rr.Radius.ui_points(size)
        out.static(path, rr.Points3D.from_fields(colors=[DIFFERENCE], radii=dot, show_labels=False))


def _held(tracks: Tracks, instants: Int, objects: int) -> Bool:
    """(K, N) whether the newest list at each instant holds each object."""
    rows = np.flatnonzero(tracks.valid[0] & (tracks.row_object_ix >= 0))
    held = np.zeros((len(tracks.stamp_ns) + 1, objects), dtype=bool)  # one more: −1, there is no list yet
    held[tracks.frame_ix[rows], tracks.row_object_ix[rows]] = True
    newest = np.searchsorted(ns(tracks.common_arrives_s), instants + SAME_INSTANT_NS, side="right") - 1
    there: Bool = held[newest]
    return there


def _errors(
    out: Out, replay: Replay, experiment: Experiment, name: str, first: Tracks, second: Tracks,
    shown: Sequence[int], colour: Rgb,
) -> None:  # fmt: skip
    """How much farther off, positive, or nearer than the baseline the lists of both have an object."""
    for k in shown:
        (mine_ns, mine_m), (other_ns, other_m) = (position_error(replay, experiment, k, one) for one in (first, second))
        near = np.searchsorted(other_ns, mine_ns - SAME_INSTANT_NS)
        both = near < len(other_ns)
        both[both] = other_ns[near[both]] <= mine_ns[both] + SAME_INSTANT_NS
        more_m = mine_m[both] - other_m[near[both]]
        path = ["plots", "error_difference", entity_names(replay.scene)[k], part_of(name)]
        draw_quartiles(out, path, mine_ns[both], more_m, colour)


def _ways(
    out: Out, replay: Replay, experiment: Experiment, both: pd.DataFrame, name: str, baseline: str,
    shown: Sequence[int],
) -> None:  # fmt: skip
    """Where each shown object went between the two instants, from the later one on. `both`: rows of both, joined."""
    import rerun as rr

    ways = both[both["detected"] & both["detected_baseline"] & ~_together(both)]
    ways = ways[ways["object_id"].isin([replay.scene.object_ids[k] for k in shown])]
    if not len(ways):
        return
    later_s = ways[["detection_s", "detection_s_baseline"]].max(axis=1)
    ways = ways.assign(later_s=later_s).sort_values("later_s", kind="stable")
    object_ix = ways["object_id"].map(replay.scene.object_number).to_numpy(dtype=np.int64)
    ends = [
        states_at(
            replay.truth, object_ix, ways[at].to_numpy(), t0_ns=replay.scene.t0_ns, max_gap_s=experiment.max_gap_s
        )
        for at in ("detection_s_baseline", "detection_s")
    ]
    there = ends[0][1] & ends[1][1]
    lines = np.stack([f32(at["x_m"], at["y_m"], at["z_m"]) for at, _ in ends], axis=1)[there]
    ways = ways[there]
    after_s = ways["detection_s"] - ways["detection_s_baseline"]
    labels = [f"{one} {s:+.2f} s to {baseline}" for one, s in zip(ways["object_id"], after_s, strict=True)]
    instants, last = np.unique(ns(ways["later_s"])[::-1], return_index=True)
    counts = len(lines) - last  # each row has all until then: the place of its last one, from the end
    _, way = np.nonzero(np.arange(len(lines)) < counts[:, None])
    path = ["world", part_of(name), "difference", "first"]
    strips = rr.LineStrips3D.columns(strips=lines[way], labels=pa.array(labels, pa.string()).take(pa.array(way)))
    out.columns(path, instants, strips.partition(counts))
    out.static(
        path, rr.LineStrips3D.from_fields(colors=[DIFFERENCE], radii=rr.Radius.ui_points(2.5), show_labels=False)
    )


def _words(out: Out, both: pd.DataFrame, name: str, baseline: str) -> None:
    """For each measured object, which configuration knew it first. `both`: rows of both, joined."""
    import rerun as rr

    told = sorted(_told(both.assign(together=_together(both)), name, baseline), key=lambda event: event[0])
    columns = rr.TextLog.columns(text=[text for *_, text in told], level=[level for _, level, _ in told])
    out.columns(["events", "difference", part_of(name)], ns([time_s for time_s, *_ in told]), columns)


def _together(both: pd.DataFrame) -> pd.Series:
    return (both["detection_s"] - both["detection_s_baseline"]).abs() <= SAME_INSTANT_NS / 1e9


def _told(both: pd.DataFrame, name: str, baseline: str) -> Iterator[tuple[float, str, str]]:
    """When it is settled, how serious, what: a sentence for every object that at least one of the two knew."""
    for episode in table_rows(both):
        one = f"{episode.object_id} {episode.object_class}"
        if episode.detected and episode.detected_baseline:
            after_s = episode.detection_s - episode.detection_s_baseline
            when = f"{abs(after_s):.2f} s {'after' if after_s > 0 else 'before'}"
            when = "as soon as" if episode.together else when
            yield max(episode.detection_s, episode.detection_s_baseline), "INFO", f"{name} knew {one} {when} {baseline}"
        elif episode.detected or episode.detected_baseline:
            knew, never = (name, baseline) if episode.detected else (baseline, name)
            yield episode.ended_s, "WARN", f"{never} never knew {one}, {knew} did"

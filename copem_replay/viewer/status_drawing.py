"""What a configuration knows of the shown objects, and why not: words, lines to what hides them, lines of sight."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from copem_replay.communication.arrivals import fusion_schedule
from copem_replay.core.colours import Rgb
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import Bool, Int, Tracks
from copem_replay.experiment.schema import Experiment
from copem_replay.pipeline.prepare import Replay
from copem_replay.viewer.palette import BEHIND, HIDES, NOTICED, WAITING
from copem_replay.viewer.reasons import reasons
from copem_replay.viewer.sensors import unit_places
from copem_replay.viewer.sink import Out, f32, ns, part_of
from copem_replay.viewer.statuses import ABSENT, HIDDEN, KNOWN

if TYPE_CHECKING:
    from copem_replay.viewer.line_of_sight import Sight
    from copem_replay.viewer.status import Clock, Status

ABOVE_M = 2.0
"""So far over an object is what is said of it (chosen)."""
RAY_ALPHA = 110
"""How opaque lines of sight are (chosen: what is behind them is seen)."""


def words(out: Out, name: str, replay: Replay, experiment: Experiment, seen: Sight, made: Status, clock: Clock) -> None:
    """Over each object, where it truly is: “58 behind 41”; and, for when it is selected, a sentence."""
    import rerun as rr

    rows, column = np.nonzero((made.status != ABSENT) & ~np.isnan(made.x_m))
    place = f32(*(getattr(made, n)[rows, column] for n in ("x_m", "y_m", "top_m")))
    place[:, 2] += ABOVE_M
    colours = np.full((len(rows), 3), WAITING, dtype=np.uint8)
    at = made.status[rows, column]
    colours[at == HIDDEN], colours[at == KNOWN] = BEHIND, NOTICED
    started = made.elapsed_ns[rows] >= clock.onset_ns[seen.object_ix[column]]
    told = reasons(replay.scene, experiment, seen, made, rows, column, started)
    counts = np.bincount(rows, minlength=len(made.elapsed_ns))
    said = np.full(made.status.shape, -1)
    said[rows, column] = told.number
    changes = np.append(True, (said[1:] != said[:-1]).any(axis=1))[: len(said)]
    # Boxes move with the frames of the truth, and words with the boxes; else only where they change.
    drawn = changes | np.isin(made.elapsed_ns, seen.elapsed_ns)
    mine = drawn[rows]
    columns = rr.Points3D.columns(
        positions=place[mine], labels=told.labels.filter(pa.array(mine)), colors=colours[mine]
    )
    path = ["world", part_of(name), "status"]
    out.columns(path, made.elapsed_ns[drawn], columns.partition(counts[drawn]))
    out.static(path, rr.Points3D.from_fields(radii=rr.Radius.ui_points(1.5), show_labels=True))
    # Sentences only where one changes: the viewer shows the newest.
    told_then = told.sentences.filter(pa.array(changes[rows]))
    sentences = rr.DynamicArchetype.columns(archetype="why", components={"why": told_then})
    out.columns(path, made.elapsed_ns[changes], sentences.partition(counts[changes]))


def hiding(out: Out, name: str, seen: Sight, made: Status) -> None:
    """Lines from the unit that sees most of a hidden object to what hides it."""
    import rerun as rr

    rows, column = np.nonzero(made.status == HIDDEN)
    if not len(rows):
        return
    by, frame = made.unit_ix[rows, column], made.frame[rows]
    lines = np.stack([seen.place_m[by, frame], seen.body_m[by, frame, column]], axis=1)
    counts = np.bincount(rows, minlength=len(made.elapsed_ns))
    told = np.flatnonzero((counts > 0) | (np.append(0, counts[:-1]) > 0))  # none: once is enough
    path = ["world", part_of(name), "hiding"]
    columns = rr.LineStrips3D.columns(strips=lines.astype(np.float32)).partition(counts[told])
    out.columns(path, made.elapsed_ns[told], columns)
    out.static(path, rr.LineStrips3D.from_fields(colors=[HIDES], radii=rr.Radius.ui_points(1.25)))


def listings(
    out: Out, name: str, replay: Replay, experiment: Experiment, fused_tracks: FusedTracks, seen: Sight, colour: Rgb,
    first_unit: Mapping[int, str],
) -> None:  # fmt: skip
    """Lines from where a unit was at capture to where it listed each shown object: the unit that did so first.

    `first_unit`: by object the one that the table names; of others, that whose list of it was the first to arrive.
    """
    import rerun as rr

    if not len(seen.object_ix):
        return
    heard = fused_tracks.heard
    at = fusion_schedule(heard, max_age_s=experiment.configurations[name].max_age_s)
    place = unit_places(replay, experiment, heard)
    row_of = np.full((len(heard.stamp_ns) + 1, len(seen.object_ix)), -1)  # one more: no list
    rows = np.flatnonzero(np.isin(heard.row_object_ix, seen.object_ix) & heard.valid[0])
    column = (heard.row_object_ix[rows, None] == seen.object_ix).argmax(axis=1)
    rows, column = (part[_of_first_units(heard, rows, column, seen, first_unit)] for part in (rows, column))
    row_of[heard.frame_ix[rows], column] = rows
    row_of[:-1][np.isnan(place[:, 0])] = -1
    k, u, m = np.nonzero(row_of[at.newest] >= 0)
    rows = row_of[at.newest[k, u], m]
    if not len(rows):
        return
    ends = f32(heard.x_m[0, rows], heard.y_m[0, rows], heard.z_m[0, rows])
    lines = np.stack([place[heard.frame_ix[rows]].astype(np.float32), ends], axis=1)
    counts = np.bincount(k, minlength=len(at.issue_s))
    told = np.flatnonzero((counts > 0) | (np.append(0, counts[:-1]) > 0))
    path = ["world", part_of(name), "listings"]
    out.columns(path, ns(at.issue_s[told]), rr.LineStrips3D.columns(strips=lines).partition(counts[told]))
    out.static(path, rr.LineStrips3D.from_fields(colors=[(*colour, RAY_ALPHA)], radii=rr.Radius.ui_points(0.75)))


def _of_first_units(heard: Tracks, rows: Int, column: Int, seen: Sight, first_unit: Mapping[int, str]) -> Bool:
    """Which rows (P,) are of the unit that listed their object first."""
    unit = heard.frame_unit_ix[heard.frame_ix[rows]]
    kept = np.zeros(len(rows), dtype=bool)
    for m, k in enumerate(seen.object_ix.tolist()):
        mine = np.flatnonzero(column == m)
        if not len(mine):
            continue
        named = first_unit.get(k)
        soonest = mine[np.argmin(heard.common_arrives_s[heard.frame_ix[rows[mine]]])]
        kept[mine] = unit[mine] == (heard.units.index(named) if named in heard.units else unit[soonest])
    return kept

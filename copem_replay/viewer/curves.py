"""Curves over time: how much of an object is seen, how far off its fused position is, how many are known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from copem_replay.core.colours import TRUTH, Rgb
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.interpolation import AROUND_S, at_instants, states_at
from copem_replay.core.tracks import Float, Int, Tracks
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.episodes import measured_objects
from copem_replay.metrics.gospa import gospa
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.scoring import settings_of
from copem_replay.pipeline.visibility_curves import BY_ANY, BY_EGO, Curve
from copem_replay.viewer.boxes import EGO
from copem_replay.viewer.sink import Out, by_frame, elapsed_ns, part_of

LISTS_AT_ONCE = 2_000
"""For so many lists the truth is interpolated at a time (chosen)."""

_LOOKS = {BY_EGO: (EGO, 3.0), BY_ANY: (TRUTH, 1.5)}


def visible_share(out: Out, name: str, curves: Mapping[str, Curve]) -> None:
    """The curves of the object `name`."""
    import rerun as rr

    for whose, curve in curves.items():
        known = ~np.isnan(curve.share)
        # An empty row breaks the line. NaN would, too, but no two recordings with NaN compare equal.
        kept = known | np.append(False, known[:-1])
        values = rr.Scalars.columns(scalars=curve.share[known]).partition(known[kept].astype(np.int64))
        path = ["plots", "visible_share", name, whose]
        out.columns(path, curve.elapsed_ns[kept], values)
        colour, width = _LOOKS[whose]
        out.static(path, rr.SeriesLines(names=whose, colors=colour, widths=width))


def position_errors(
    out: Out, replay: Replay, experiment: Experiment, name: str, fused: Tracks, shown: Sequence[int], colour: Rgb
) -> None:
    """Distance from fused to true position of the shown objects, list by list."""
    import rerun as rr

    # Points, as an error belongs to one list and to no time between two; no row where there is nothing to measure.
    style = rr.SeriesPoints(names=name, colors=colour, markers="circle", marker_sizes=2.5)
    for k in shown:
        rows = np.flatnonzero((fused.row_object_ix == k) & fused.valid[0])
        frames = fused.frame_ix[rows]
        at, there = states_at(
            replay.truth, np.full(len(rows), k), fused.arrives_s[0, frames],
            t0_ns=replay.scene.t0_ns, max_gap_s=experiment.max_gap_s,
        )  # fmt: skip
        error = np.hypot(fused.x_m[0, rows] - at["x_m"], fused.y_m[0, rows] - at["y_m"])[there]
        path = ["plots", "position_error", replay.scene.object_ids[k], name]
        out.columns(path, elapsed_ns(fused)[frames[there]], rr.Scalars.columns(scalars=error))
        out.static(path, style)


def known(
    out: Out, replay: Replay, name: str, tracks: Tracks, colour: Rgb | None = None, since_ns: Int | None = None
) -> None:
    """How many of all measured objects a configuration's newest list holds; without a colour: how many there are.

    `since_ns` (N + 1,): from when on each object counts, the last: no object.
    """
    import rerun as rr

    kept = tracks.valid[0] & np.isin(tracks.row_object_ix, replay.episodes.object_ix)
    if since_ns is not None:
        kept &= elapsed_ns(tracks)[tracks.frame_ix] >= since_ns[tracks.row_object_ix]
    _, counts = by_frame(tracks, kept)
    changes = np.flatnonzero(np.diff(counts, prepend=-1))  # a step lasts until the next
    rows = np.union1d(changes, [len(counts) - 1]) if len(counts) else changes
    path = ["plots", "known", name if colour is None else part_of(name)]
    out.columns(path, elapsed_ns(tracks)[rows], rr.Scalars.columns(scalars=counts[rows].astype(float)))
    until_next = rr.components.InterpolationMode.StepAfter
    colours, width = colour or TRUTH, 1.5 if colour else 4.0
    out.static(path, rr.SeriesLines(names=name, colors=colours, widths=width, interpolation_mode=until_next))


def gospa_of(replay: Replay, experiment: Experiment, fused_tracks: FusedTracks) -> tuple[Int, Float]:
    """GOSPA (m) of each list at the instant it is available: when (K,), and how much (K,).

    Of the measured objects that are in the log then against the entries that are about one of them, and the ghosts of
    their classes; cut-off and power as in `measure`.
    """
    scene, fused, measure = replay.scene, fused_tracks.fused, experiment.measure
    settings = settings_of(measure, scene.end_s)
    measured = np.isin(np.arange(len(scene.object_ids) + 1), measured_objects(scene, measure))  # the last: nobody
    ghosts = replay.truth_cache.classes(measure)[fused_tracks.class_of(scene)] & (fused.row_object_ix < 0)
    near_s, gap_s = fused.arrives_s[0], experiment.max_gap_s + AROUND_S
    near = replay.truth if not len(near_s) else replay.truth.captured_between(near_s[0] - gap_s, near_s[-1] + gap_s)
    truth = near.take_tracks(measured[near.object_ix])
    rows, listed = by_frame(fused, fused.valid[0] & (measured[fused.row_object_ix] | ghosts))
    elapsed, starts = elapsed_ns(fused), np.append(0, np.cumsum(listed))
    value_m = np.empty(len(listed))
    for first in range(0, len(listed), LISTS_AT_ONCE):
        stamps = scene.t0_ns + elapsed[first : first + LISTS_AT_ONCE]
        world = at_instants(truth, stamps, t0_ns=scene.t0_ns, max_gap_s=experiment.max_gap_s)
        order, bounds = world.by_frame
        for f in range(len(stamps)):
            there, said = order[bounds[f] : bounds[f + 1]], rows[starts[first + f] : starts[first + f + 1]]
            both = (np.stack([t.x_m[0, r], t.y_m[0, r]], axis=-1) for t, r in ((world, there), (fused, said)))
            value_m[first + f] = gospa(*both, cutoff_m=settings.cutoff_m, power=settings.power).value_m
    return elapsed, value_m


def gospas(out: Out, replay: Replay, experiment: Experiment, name: str, fused_tracks: FusedTracks, colour: Rgb) -> None:
    """The curve of one configuration."""
    import rerun as rr

    elapsed, value_m = gospa_of(replay, experiment, fused_tracks)
    path = ["plots", "gospa", part_of(name)]
    out.columns(path, elapsed, rr.Scalars.columns(scalars=value_m))
    until_next = rr.components.InterpolationMode.StepAfter
    out.static(path, rr.SeriesLines(names=name, colors=colour, widths=1.5, interpolation_mode=until_next))

"""Curves over time: how much of an object is seen, how far off its fused position is, how many are known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from copem_replay.core.colours import TRUTH, Rgb
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.interpolation import AROUND_S, at_instants, states_at
from copem_replay.core.tracks import Bool, Float, Int, Tracks
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.accuracy.statistics import Settings
from copem_replay.metrics.area import corners, in_areas
from copem_replay.metrics.episodes import measured_objects
from copem_replay.metrics.gospa import gospas_m
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.scoring import settings_of
from copem_replay.pipeline.visibility_curves import BY_ANY, BY_EGO, Curve
from copem_replay.viewer.palette import EGO
from copem_replay.viewer.running import break_lines, running
from copem_replay.viewer.sink import Out, by_frame, elapsed_ns, entity_names, ns, part_of, plain

LISTS_AT_ONCE = 2_000
"""For so many lists the truth is interpolated at a time (chosen)."""

NO_LIST = np.empty(0, dtype=np.int64), np.empty(0)
"""Where no time chunk comes before."""
_LOOKS = {BY_EGO: (EGO, 2.0), BY_ANY: (TRUTH, 1.0)}


def visible_share(out: Out, name: str, curves: Mapping[str, Curve]) -> None:
    """The curves of one object; `name`: of it in entity paths."""
    import rerun as rr

    for units, curve in curves.items():
        line = break_lines(curve.elapsed_ns, curve.share[:, None])
        share = np.full(len(line.counts), np.nan)
        share[line.counts > 0] = line.values
        known = ~np.isnan(share)
        kept = known | np.append(False, known[:-1])  # the first row without a value is an empty one
        value, instants = np.where(known, share, -1.0)[kept], line.elapsed_ns[kept]
        # Between two that are the same the line is the same without what is there.
        bends = np.append(True, value[1:] != value[:-1]) | np.append(value[:-1] != value[1:], True)[: len(value)]
        bends = bends[: len(value)]
        value, instants = value[bends], instants[bends]
        values = rr.Scalars.columns(scalars=value[value >= 0]).partition((value >= 0).astype(np.int64))
        path = ["plots", "visible_share", name, plain(units)]
        out.columns(path, instants, values)
        colour, width = _LOOKS[units]
        out.static(path, rr.SeriesLines(names=units, colors=colour, widths=width))


def position_errors(
    out: Out, replay: Replay, experiment: Experiment, name: str, fused: Tracks, shown: Sequence[int], colour: Rgb
) -> None:
    """Distance from fused to true position of the shown objects: running quartiles."""
    for k in shown:
        elapsed, error_m = position_error(replay, experiment, k, fused)
        path = ["plots", "position_error", entity_names(replay.scene)[k], part_of(name)]
        draw_quartiles(out, path, elapsed, error_m, colour)


def position_error(replay: Replay, experiment: Experiment, object_ix: int, fused: Tracks) -> tuple[Int, Float]:
    """When lists hold an object while it is there, ascending, and the distance from its true position then."""
    rows = np.flatnonzero((fused.row_object_ix == object_ix) & fused.valid[0])
    time_s = fused.common_arrives_s[fused.frame_ix[rows]]
    at, there = states_at(
        replay.truth, fused.row_object_ix[rows], time_s, t0_ns=replay.scene.t0_ns, max_gap_s=experiment.max_gap_s
    )
    error_m = np.hypot(fused.x_m[0, rows] - at["x_m"], fused.y_m[0, rows] - at["y_m"])[there]
    # Of several entries that are matched with it in one list, which fusions by match do not give, the first.
    times, first = np.unique(ns(time_s[there]), return_index=True)
    return times, error_m[first]


def draw_quartiles(out: Out, path: list[str], elapsed_ns: Int, values: Float, colour: Rgb) -> None:
    """A running median between the quartiles, thinner; nothing where there is nothing."""
    import rerun as rr

    of = running(elapsed_ns, values)
    if len(of.elapsed_ns):
        lines = break_lines(of.elapsed_ns, of.quartiles)
        out.columns(path, lines.elapsed_ns, rr.Scalars.columns(scalars=lines.values).partition(lines.counts))
        names = [f"{path[-1]}, {said}" for said in ("25 %", "median", "75 %")]
        out.static(path, rr.SeriesLines(names=names, colors=[colour] * 3, widths=[0.5, 1.5, 0.5]))


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
    colours, width = colour or TRUTH, 1.5 if colour else 1.0
    out.static(path, rr.SeriesLines(names=name, colors=colours, widths=width, interpolation_mode=until_next))


def gospa_of(replay: Replay, experiment: Experiment, fused_tracks: FusedTracks) -> tuple[Int, Float]:
    """GOSPA (m) of each list at the instant it is available: when (K,), and how much (K,).

    Of the measured objects that are in the log then against the entries that are about one of them, and the ghosts of
    their classes; cut-off and power as in `measure`.
    """
    scene, fused, measure = replay.scene, fused_tracks.fused, experiment.measure
    settings = settings_of(measure, scene.end_s)
    numbers = np.arange(len(scene.object_ids) + 1)  # the last: no object
    measured = np.isin(numbers, measured_objects(scene, measure)) & ~np.isin(numbers, replay.outside_ix)
    ghosts = replay.truth_cache.classes(measure)[fused_tracks.class_of(scene)] & (fused.row_object_ix < 0)
    if measure.annotated is not None:
        ghosts &= _annotated(replay, fused, settings)
    near_s, gap_s = fused.common_arrives_s, experiment.max_gap_s + AROUND_S
    near = replay.truth if not len(near_s) else replay.truth.captured_between(near_s[0] - gap_s, near_s[-1] + gap_s)
    truth = near.take_tracks(measured[near.object_ix])
    rows, listed = by_frame(fused, fused.valid[0] & (measured[fused.row_object_ix] | ghosts))
    elapsed, starts = elapsed_ns(fused), np.append(0, np.cumsum(listed))
    value_m = np.empty(len(listed))
    at = np.stack([fused.x_m[0, rows], fused.y_m[0, rows]])
    for first in range(0, len(listed), LISTS_AT_ONCE):
        stamps = scene.t0_ns + elapsed[first : first + LISTS_AT_ONCE]
        world = at_instants(truth, stamps, t0_ns=scene.t0_ns, max_gap_s=experiment.max_gap_s)
        order, bounds = world.by_frame
        there = np.stack([world.x_m[0, order], world.y_m[0, order]])
        mine = slice(first, first + len(stamps))
        value_m[mine] = gospas_m(
            there, bounds, at, starts[first : first + len(stamps) + 1], settings.cutoff_m, settings.power
        )
    return elapsed, value_m


def _annotated(replay: Replay, fused: Tracks, settings: Settings) -> Bool:
    """(P,) which entries of one run are where the truth is annotated."""
    near = replay.truth_cache.reference(fused.common_arrives_s)
    f = fused.frame_ix
    return in_areas(
        fused.x_m[0], fused.y_m[0], near.x_m[f], near.y_m[f], corners(settings.annotated_m), settings.annotated_range_m
    )


def gospas(
    out: Out, replay: Replay, experiment: Experiment, name: str, fused_tracks: FusedTracks, colour: Rgb,
    before: tuple[Int, Float],
) -> tuple[Int, Float]:  # fmt: skip
    """The curve of one configuration in a time chunk. `before`: what this gave of the chunk before, the last list."""
    import rerun as rr

    found = gospa_of(replay, experiment, fused_tracks)
    elapsed, value_m = (np.concatenate(pair) for pair in zip(before, found, strict=True))
    path, drawn = ["plots", "gospa", part_of(name)], len(before[0])
    lines = break_lines(elapsed, value_m[:, None], steps=True)
    columns = rr.Scalars.columns(scalars=lines.values[drawn:]).partition(lines.counts[drawn:])
    out.columns(path, lines.elapsed_ns[drawn:], columns)
    until_next = rr.components.InterpolationMode.StepAfter
    out.static(path, rr.SeriesLines(names=name, colors=colour, widths=1.5, interpolation_mode=until_next))
    return elapsed[-1:], value_m[-1:]

"""Curves over time: visible share, position error, GOSPA and number of known objects; and differences to a baseline.

Differences are points, paths and words in the view of each compared configuration:

| entity | what it shows |
|---|---|
| `world/<configuration>/difference/gained`, `lost` | objects that only it, or only the baseline, holds then |
| `world/<configuration>/difference/first` | an object's path between the instants at which both first knew it |
| `plots/error_difference/<object>/<configuration>` | of position errors, at instants at which both list the object |
| `events/difference/<configuration>` | in words, which knew an object first |
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from copem_replay.core.colours import TRUTH, Rgb
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.interpolation import AROUND_S, interpolate_at_instants, interpolate_states
from copem_replay.core.tracks import SAME_INSTANT_NS, SAME_INSTANT_S, Bool, Float, Int, Tracks
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.accuracy.aggregator import are_annotated
from copem_replay.metrics.episodes import measured_objects
from copem_replay.metrics.gospa import gospas_m
from copem_replay.pipeline.one_run import BY_ANY, BY_EGO, Curve
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.scoring import accuracy_settings
from copem_replay.pipeline.status import elapsed_ns, to_nanoseconds
from copem_replay.viewer.sink import (
    DIFFERENCE,
    EGO,
    RecordingSink,
    configuration_part,
    entity_names,
    join_points,
    plain_part,
    sort_by_frame,
    stack_float32,
    table_rows,
)

LISTS_AT_ONCE = 2_000
"""Lists for which the truth is interpolated at a time: more take more memory."""

NO_LIST = np.empty(0, dtype=np.int64), np.empty(0)
"""`before` of the first time chunk in `write_gospa`."""
HATCH_S, HATCH_SIZE = 0.1, 3.5
"""Crosses of the visible share outside the field of view: one per tenth of a second, and its size in points."""
_LOOKS = {BY_EGO: (EGO, 2.0), BY_ANY: (TRUTH, 1.0)}


def write_visible_share(out: RecordingSink, name: str, curves: Mapping[str, Curve], within: Mapping[str, Bool]) -> None:
    """Write the visible shares of one object; `name`: its part of entity paths.

    `within`: by curve (K,), whether the object is in a field of view of its units. A line where it is, crosses where it
    is not: what could be seen of it then is not looked at.
    """
    import rerun as rr

    for units, curve in curves.items():
        looked_at = np.where(within[units], curve.share, np.nan)
        _write_outside(
            out, ["plots", "visible_share", name, f"{plain_part(units)}_outside"], units, curve, within[units]
        )
        line = break_lines(curve.elapsed_ns, looked_at[:, None])
        share = np.full(len(line.counts), np.nan)
        share[line.counts > 0] = line.values
        has_value = ~np.isnan(share)
        rows = has_value | np.append(False, has_value[:-1])  # the first row without a value becomes an empty row
        value, instants = np.where(has_value, share, -1.0)[rows], line.elapsed_ns[rows]
        # A row between two of its own value does not change the line.
        bends = np.append(True, value[1:] != value[:-1]) | np.append(value[:-1] != value[1:], True)[: len(value)]
        bends = bends[: len(value)]
        value, instants = value[bends], instants[bends]
        values = rr.Scalars.columns(scalars=value[value >= 0]).partition((value >= 0).astype(np.int64))
        path = ["plots", "visible_share", name, plain_part(units)]
        out.columns(path, instants, values)
        colour, width = _LOOKS[units]
        out.static(path, rr.SeriesLines(names=units, colors=colour, widths=width))


def _write_outside(out: RecordingSink, path: list[str], units: str, curve: Curve, within: Bool) -> None:
    """Write a cross every `HATCH_S` on the curve where the object is outside all fields of view of `units`."""
    import rerun as rr

    rows = np.flatnonzero(~within & ~np.isnan(curve.share))
    if not len(rows):
        return
    step = curve.elapsed_ns[rows] // round(HATCH_S * 1e9)
    rows = rows[np.append(True, step[1:] != step[:-1])]
    out.columns(path, curve.elapsed_ns[rows], rr.Scalars.columns(scalars=curve.share[rows]))
    cross, names = rr.components.MarkerShape.Cross, f"{units}, outside the field of view"
    out.static(path, rr.SeriesPoints(colors=_LOOKS[units][0], markers=cross, marker_sizes=HATCH_SIZE, names=names))


def write_position_errors(
    out: RecordingSink,
    replay: Replay,
    experiment: Experiment,
    name: str,
    fused: Tracks,
    shown: Sequence[int],
    colour: Rgb,
) -> None:
    """Write the distance from fused to true position (m) of the shown objects, as running quartiles."""
    for k in shown:
        elapsed, error_m = measure_position_error(replay, experiment, k, fused)
        path = ["plots", "position_error", entity_names(replay.scene)[k], configuration_part(name)]
        draw_quartiles(out, path, elapsed, error_m, colour)


def measure_position_error(replay: Replay, experiment: Experiment, object_ix: int, fused: Tracks) -> tuple[Int, Float]:
    """Instants (K,), ascending, at which a list holds a present object, and the distance (m) from its true position."""
    rows = np.flatnonzero((fused.row_object_ix == object_ix) & fused.valid[0])
    time_s = fused.common_arrives_s[fused.frame_ix[rows]]
    states, present = interpolate_states(
        replay.truth, fused.row_object_ix[rows], time_s, t0_ns=replay.scene.t0_ns, max_gap_s=experiment.max_gap_s
    )
    error_m = np.hypot(fused.x_m[0, rows] - states["x_m"], fused.y_m[0, rows] - states["y_m"])[present]
    # The first of several entries of one list that are about the object; fusions by match give at most one.
    times, first = np.unique(to_nanoseconds(time_s[present]), return_index=True)
    return times, error_m[first]


def draw_quartiles(out: RecordingSink, path: list[str], elapsed_ns: Int, values: Float, colour: Rgb) -> None:
    """Write a running median between thinner quartiles; nothing without values."""
    import rerun as rr

    median = running_median(elapsed_ns, values)
    if len(median.elapsed_ns):
        lines = break_lines(median.elapsed_ns, median.quartiles)
        out.columns(path, lines.elapsed_ns, rr.Scalars.columns(scalars=lines.values).partition(lines.counts))
        names = [f"{path[-1]}, {said}" for said in ("25 %", "median", "75 %")]
        out.static(path, rr.SeriesLines(names=names, colors=[colour] * 3, widths=[0.5, 1.5, 0.5]))


def write_known_count(
    out: RecordingSink,
    replay: Replay,
    name: str,
    tracks: Tracks,
    colour: Rgb | None = None,
    since_ns: Int | None = None,
) -> None:
    """Write the number of measured objects in a configuration's newest list; without a colour: in the truth.

    `since_ns` (N + 1,): from when on each object counts; the last is of entries without an object.
    """
    import rerun as rr

    rows_held = tracks.valid[0] & np.isin(tracks.row_object_ix, replay.episodes.object_ix)
    if since_ns is not None:
        rows_held &= elapsed_ns(tracks)[tracks.frame_ix] >= since_ns[tracks.row_object_ix]
    _, counts = sort_by_frame(tracks, rows_held)
    changes = np.flatnonzero(np.diff(counts, prepend=-1))  # a step lasts until the next
    rows = np.union1d(changes, [len(counts) - 1]) if len(counts) else changes
    path = ["plots", "known", name if colour is None else configuration_part(name)]
    out.columns(path, elapsed_ns(tracks)[rows], rr.Scalars.columns(scalars=counts[rows].astype(float)))
    until_next = rr.components.InterpolationMode.StepAfter
    colours, width = colour or TRUTH, 1.5 if colour else 1.0
    out.static(path, rr.SeriesLines(names=name, colors=colours, widths=width, interpolation_mode=until_next))


def find_false_rows(replay: Replay, experiment: Experiment, fused_tracks: FusedTracks) -> Bool:
    """Mask (P,) of the false entries of one run: about no object, of a measured class, in the annotated area."""
    scene, fused, measure = replay.scene, fused_tracks.fused, experiment.measure
    false: Bool = fused.valid[0] & (fused.row_object_ix < 0)
    false &= replay.truth_cache.classes(measure)[fused_tracks.class_of(scene)]
    if fused_tracks.second_of is not None:
        false &= fused_tracks.second_of < 0
    if measure.annotated is not None:
        near, settings = replay.truth_cache.reference(fused.common_arrives_s), accuracy_settings(measure, scene.end_s)
        false &= are_annotated(fused.x_m[0], fused.y_m[0], fused.frame_ix, near, settings)
    return false


def measure_gospa(replay: Replay, experiment: Experiment, fused_tracks: FusedTracks) -> tuple[Int, Float]:
    """GOSPA (m) of each list (K,) at the instant (K,) at which it is available.

    It compares the measured objects that are in the log then with the entries about them and the ghosts of their
    classes; cut-off and power are those of `measure`.
    """
    scene, fused, measure = replay.scene, fused_tracks.fused, experiment.measure
    settings = accuracy_settings(measure, scene.end_s)
    numbers = np.arange(len(scene.object_ids) + 1)  # the last: no object
    measured = np.isin(numbers, measured_objects(scene, measure)) & ~np.isin(numbers, replay.outside_ix)
    ghosts, owner = find_false_rows(replay, experiment, fused_tracks), fused.row_object_ix
    owner = owner if fused_tracks.second_of is None else np.maximum(owner, fused_tracks.second_of)
    near_s, gap_s = fused.common_arrives_s, experiment.max_gap_s + AROUND_S
    near = replay.truth if not len(near_s) else replay.truth.captured_between(near_s[0] - gap_s, near_s[-1] + gap_s)
    truth = near.take_tracks(measured[near.object_ix])
    rows, listed = sort_by_frame(fused, fused.valid[0] & (measured[owner] | ghosts))
    elapsed, starts = elapsed_ns(fused), np.append(0, np.cumsum(listed))
    value_m = np.empty(len(listed))
    listed_m = np.stack([fused.x_m[0, rows], fused.y_m[0, rows]])
    for first in range(0, len(listed), LISTS_AT_ONCE):
        stamps = scene.t0_ns + elapsed[first : first + LISTS_AT_ONCE]
        world = interpolate_at_instants(truth, stamps, t0_ns=scene.t0_ns, max_gap_s=experiment.max_gap_s)
        order, bounds = world.by_frame
        true_m = np.stack([world.x_m[0, order], world.y_m[0, order]])
        part = slice(first, first + len(stamps))
        value_m[part] = gospas_m(
            true_m, bounds, listed_m, starts[first : first + len(stamps) + 1], settings.cutoff_m, settings.power
        )
    return elapsed, value_m


def write_gospa(
    out: RecordingSink, replay: Replay, experiment: Experiment, name: str, fused_tracks: FusedTracks, colour: Rgb,
    before: tuple[Int, Float],
) -> tuple[Int, Float]:  # fmt: skip
    """Write the curve of one configuration in a time chunk. Returns its last point, which is `before` of the next."""
    import rerun as rr

    chunk = measure_gospa(replay, experiment, fused_tracks)
    elapsed, value_m = (np.concatenate(pair) for pair in zip(before, chunk, strict=True))
    path, drawn = ["plots", "gospa", configuration_part(name)], len(before[0])
    lines = break_lines(elapsed, value_m[:, None], steps=True)
    columns = rr.Scalars.columns(scalars=lines.values[drawn:]).partition(lines.counts[drawn:])
    out.columns(path, lines.elapsed_ns[drawn:], columns)
    until_next = rr.components.InterpolationMode.StepAfter
    out.static(path, rr.SeriesLines(names=name, colors=colour, widths=1.5, interpolation_mode=until_next))
    return elapsed[-1:], value_m[-1:]


# Lines through values over time: running quartiles, and breaks where there are no values.

WINDOW_NS, STEP_NS = 1_000_000_000, 250_000_000
"""Width and step of the window of running quartiles: ten lists of 10 Hz, narrow enough to show a change of a second."""
QUARTILES = (0.25, 0.5, 0.75)
"""Shares of the values that lie below each line."""
GAP_NS = 500_000_000
"""A line breaks where its rows are farther apart: half a window, within which every row has a value."""


@dataclass(frozen=True)
class RunningMedian:
    """Quartiles (K, 3) of the values around each instant (K,); the median is in the middle."""

    elapsed_ns: Int
    quartiles: Float


@dataclass(frozen=True)
class BrokenCurve:
    """Lines with breaks as rows (R,): `counts` of values per row, 0 at a break, and all `values` in their order."""

    elapsed_ns: Int
    values: Float
    counts: Int


def running_median(elapsed_ns: Int, values: Float) -> RunningMedian:
    """Quartiles of the values (P,) within half of `WINDOW_NS`, at multiples of `STEP_NS` that have values so near.

    `elapsed_ns`: (P,), ascending. Between two values a quartile is interpolated linearly, as NumPy's quantiles are.
    """
    if not len(values):
        return RunningMedian(np.empty(0, dtype=np.int64), np.empty((0, len(QUARTILES))))
    steps = np.arange(-(-elapsed_ns[0] // STEP_NS), elapsed_ns[-1] // STEP_NS + 1) * STEP_NS
    steps = steps if len(steps) else elapsed_ns[:1]
    begin = np.searchsorted(elapsed_ns, steps - WINDOW_NS // 2)
    count = np.searchsorted(elapsed_ns, steps + WINDOW_NS // 2, side="right") - begin
    steps, begin, count = (values_of[count > 0] for values_of in (steps, begin, count))
    slots = np.arange(count.max(initial=0))
    filled = slots < count[:, None]
    window = np.where(filled, values[np.minimum(begin[:, None] + slots, len(values) - 1)], np.inf)
    window.sort(axis=1)
    row, place = np.arange(len(steps))[:, None], np.array(QUARTILES) * (count - 1)[:, None]
    lower = np.floor(place).astype(np.int64)
    low, high = window[row, lower], window[row, np.minimum(lower + 1, count[:, None] - 1)]
    return RunningMedian(steps, low + (place - lower) * (high - low))


def break_lines(elapsed_ns: Int, values: Float, *, steps: bool = False) -> BrokenCurve:
    """Lines through values (K, n), with an empty row `GAP_NS` after each row that the next one is farther away from.

    The viewer breaks a line at an empty row, and also at NaN, but recordings with NaN never compare equal. `steps`: a
    value holds until the next one, so it is repeated before a break.
    """
    ends = np.flatnonzero(np.diff(elapsed_ns) > GAP_NS)
    empty_ns, held = elapsed_ns[ends] + GAP_NS, ends[: len(ends) if steps else 0]
    times = np.concatenate([elapsed_ns, empty_ns[: len(held)] - 1, empty_ns])
    rows = np.concatenate([np.arange(len(elapsed_ns)), held, np.full(len(ends), -1)])
    order = np.argsort(times, kind="stable")
    rows = rows[order]
    lines = values.shape[1]
    return BrokenCurve(times[order], values[rows[rows >= 0]].ravel(), np.where(rows >= 0, lines, 0))


# Differences of configurations to a baseline.

_ABOVE_M, _LOST_POINTS, _GAINED_POINTS = 3.5, 6.0, 3.0
"""Height of marks above a box, clear of its name, and their sizes: larger for what the configuration misses."""


def write_differences(
    out: RecordingSink, replay: Replay, experiment: Experiment, run_tracks: Mapping[str, FusedTracks],
    table: pd.DataFrame, baselines: Mapping[str, str], shown: Sequence[int], colours: Mapping[str, Rgb],
) -> None:  # fmt: skip
    """Write the differences of every configuration to its baseline."""
    for name, baseline in baselines.items():
        if name in run_tracks:
            first, second = run_tracks[name].fused, run_tracks[baseline].fused
            pair = {name: colours[name], baseline: colours.get(baseline, DIFFERENCE)}
            _write_knowledge_points(out, replay, experiment, pair, first, second)
            _write_error_differences(out, replay, experiment, name, first, second, shown, colours[name])
            own, baseline_rows = (table[table["configuration"] == configuration] for configuration in (name, baseline))
            joined = own.merge(baseline_rows, on="object_id", suffixes=("", "_baseline"))
            _write_ways(out, replay, experiment, joined, name, baseline, shown)
            _write_sentences(out, joined, name, baseline)


def _write_knowledge_points(
    out: RecordingSink, replay: Replay, experiment: Experiment, pair: Mapping[str, Rgb], first: Tracks, second: Tracks
) -> None:
    """Write a point above the true place of each object that only one of the two newest lists holds, in its colour.

    `pair`: the configuration and its baseline.
    """
    import rerun as rr

    name, baseline = pair
    scene = replay.scene
    # Boxes move with the frames of the truth; what is held changes with the lists of both.
    instants = np.unique(
        np.concatenate([to_nanoseconds(tracks.common_arrives_s) for tracks in (replay.truth, first, second)])
    )
    is_held, held_by_baseline = (_is_held(tracks, instants, len(scene.object_ids)) for tracks in (first, second))
    ids = pa.array(scene.object_ids, pa.string())
    for part, is_in_one, size, words, colour in (
        ("gained", is_held & ~held_by_baseline, _GAINED_POINTS, f"not in {baseline}", pair[name]),
        ("lost", held_by_baseline & ~is_held, _LOST_POINTS, f"only in {baseline}", pair[baseline]),
    ):
        row, object_ix = np.nonzero(is_in_one)
        states, present = interpolate_states(
            replay.truth, object_ix, instants[row] / 1e9, t0_ns=scene.t0_ns, max_gap_s=experiment.max_gap_s
        )
        place = stack_float32(states["x_m"], states["y_m"], states["z_m"] + states["height_m"] / 2 + _ABOVE_M)[present]
        counts = np.bincount(row[present], minlength=len(instants))
        instants_drawn = (counts > 0) | (np.append(0, counts[:-1]) > 0)  # an empty row ends the row before
        labels = pc.binary_join_element_wise(ids.take(pa.array(object_ix[present])), words, " ")
        columns = rr.Points3D.columns(positions=place, labels=labels).partition(counts[instants_drawn])
        path = ["world", configuration_part(name), "difference", part]
        out.columns(path, instants[instants_drawn], columns)
        dot = rr.Radius.ui_points(size)
        out.static(path, rr.Points3D.from_fields(colors=[colour], radii=dot, show_labels=False))


def _is_held(tracks: Tracks, instants: Int, objects: int) -> Bool:
    """(K, N) whether the newest list at each instant holds each object."""
    rows = np.flatnonzero(tracks.valid[0] & (tracks.row_object_ix >= 0))
    held = np.zeros((len(tracks.stamp_ns) + 1, objects), dtype=bool)  # the row more, index −1: no list yet
    held[tracks.frame_ix[rows], tracks.row_object_ix[rows]] = True
    newest = np.searchsorted(to_nanoseconds(tracks.common_arrives_s), instants + SAME_INSTANT_NS, side="right") - 1
    held_then: Bool = held[newest]
    return held_then


def _write_error_differences(
    out: RecordingSink, replay: Replay, experiment: Experiment, name: str, first: Tracks, second: Tracks,
    shown: Sequence[int], colour: Rgb,
) -> None:  # fmt: skip
    """Write by how many metres an object's position is worse (positive) than in the baseline's list of that instant."""
    for k in shown:
        (mine_ns, mine_m), (other_ns, other_m) = (
            measure_position_error(replay, experiment, k, tracks) for tracks in (first, second)
        )
        match = np.searchsorted(other_ns, mine_ns - SAME_INSTANT_NS)
        in_both = match < len(other_ns)
        in_both[in_both] = other_ns[match[in_both]] <= mine_ns[in_both] + SAME_INSTANT_NS
        excess_m = mine_m[in_both] - other_m[match[in_both]]
        path = ["plots", "error_difference", entity_names(replay.scene)[k], configuration_part(name)]
        draw_quartiles(out, path, mine_ns[in_both], excess_m, colour)


def _write_ways(
    out: RecordingSink, replay: Replay, experiment: Experiment, joined: pd.DataFrame, name: str, baseline: str,
    shown: Sequence[int],
) -> None:  # fmt: skip
    """Write the line between an object's places at the two detections, from the later one on. `joined`: a row per
    object that is in both tables.
    """
    import rerun as rr

    ways = joined[joined["detected"] & joined["detected_baseline"] & ~_is_simultaneous(joined)]
    ways = ways[ways["object_id"].isin([replay.scene.object_ids[k] for k in shown])]
    if not len(ways):
        return
    later_s = ways[["detection_s", "detection_s_baseline"]].max(axis=1)
    ways = ways.assign(later_s=later_s).sort_values("later_s", kind="stable")
    object_ix = ways["object_id"].map(replay.scene.object_number).to_numpy(dtype=np.int64)
    places = [
        interpolate_states(
            replay.truth, object_ix, ways[column].to_numpy(), t0_ns=replay.scene.t0_ns, max_gap_s=experiment.max_gap_s
        )
        for column in ("detection_s_baseline", "detection_s")
    ]
    present = places[0][1] & places[1][1]
    lines = np.stack([stack_float32(column["x_m"], column["y_m"], column["z_m"]) for column, _ in places], axis=1)[
        present
    ]
    ways = ways[present]
    after_s = ways["detection_s"] - ways["detection_s_baseline"]
    labels = [f"{object_id} {s:+.2f} s to {baseline}" for object_id, s in zip(ways["object_id"], after_s, strict=True)]
    instants, last = np.unique(to_nanoseconds(ways["later_s"])[::-1], return_index=True)
    counts = len(lines) - last  # lines up to each instant: the index of its last one
    _, line_ix = np.nonzero(np.arange(len(lines)) < counts[:, None])
    path = ["world", configuration_part(name), "difference", "first"]
    strips = rr.LineStrips3D.columns(
        strips=join_points(lines[line_ix]), labels=pa.array(labels, pa.string()).take(pa.array(line_ix))
    )
    out.columns(path, instants, strips.partition(counts))
    out.static(
        path, rr.LineStrips3D.from_fields(colors=[DIFFERENCE], radii=rr.Radius.ui_points(2.5), show_labels=False)
    )


def _write_sentences(out: RecordingSink, joined: pd.DataFrame, name: str, baseline: str) -> None:
    """Write for each measured object which configuration knew it first. `joined`: a row per object in both tables."""
    import rerun as rr

    events = sorted(
        _difference_sentences(joined.assign(together=_is_simultaneous(joined)), name, baseline),
        key=lambda event: event[0],
    )
    columns = rr.TextLog.columns(text=[text for *_, text in events], level=[level for _, level, _ in events])
    out.columns(
        ["events", "difference", configuration_part(name)], to_nanoseconds([time_s for time_s, *_ in events]), columns
    )


def _is_simultaneous(joined: pd.DataFrame) -> pd.Series:
    return (joined["detection_s"] - joined["detection_s_baseline"]).abs() <= SAME_INSTANT_S


def _difference_sentences(joined: pd.DataFrame, name: str, baseline: str) -> Iterator[tuple[float, str, str]]:
    """Time (s), level and sentence on each object that at least one of the two configurations knew."""
    for episode in table_rows(joined):
        name_of_object = f"{episode.object_id} {episode.object_class}"
        if episode.detected and episode.detected_baseline:
            after_s = episode.detection_s - episode.detection_s_baseline
            when = f"{abs(after_s):.2f} s {'after' if after_s > 0 else 'before'}"
            when = "as soon as" if episode.together else when
            yield (
                max(episode.detection_s, episode.detection_s_baseline),
                "INFO",
                f"{name} knew {name_of_object} {when} {baseline}",
            )
        elif episode.detected or episode.detected_baseline:
            knew, never = (name, baseline) if episode.detected else (baseline, name)
            yield episode.ended_s, "WARN", f"{never} never knew {name_of_object}, {knew} did"

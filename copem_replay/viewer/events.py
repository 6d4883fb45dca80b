"""Onsets and detections: texts in the panels, and marks that stay, in the scene and on curves."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from copem_replay.core.colours import Rgb
from copem_replay.core.errors import ExperimentError
from copem_replay.core.interpolation import interpolate_states
from copem_replay.core.tracks import SAME_INSTANT_NS, Float, Int, Scene
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.episodes import Reference
from copem_replay.metrics.survival import EndReason
from copem_replay.perception.sensor_poses import find_carrier
from copem_replay.pipeline.one_run import BY_ANY, BY_EGO, Curve
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.status import to_nanoseconds
from copem_replay.viewer.sink import (
    DIFFERENCE_SHORT,
    DIFFERENCE_TEXT,
    ONSET,
    RecordingSink,
    configuration_part,
    entity_names,
    helps_path,
    join_points,
    short_ids,
    show_seconds,
    stack_float32,
    table_rows,
)

# Text panels: events, differences, summary, legend.

_BEGAN = {"log_start": ", there from the log's start", "appeared": ", as it appears", "crossed": ""}
"""What is added to an onset, by how the episode began."""


def write_onset_texts(out: RecordingSink, scene: Scene, table: pd.DataFrame) -> None:
    """Write an event per onset; onsets are the same in all configurations."""
    import rerun as rr

    episodes = table.drop_duplicates("object_id").sort_values("onset_s", kind="stable")
    text = [f"counts: {_name_object(episode, scene)}{_BEGAN[episode.began]}" for episode in table_rows(episodes)]
    out.columns(
        ["events", "onsets"],
        to_nanoseconds(episodes["onset_s"]),
        rr.TextLog.columns(text=text, level=["INFO"] * len(text)),
    )


def write_event_texts(out: RecordingSink, scene: Scene, name: str, part: pd.DataFrame) -> None:
    """Write an event per episode: detection, or its end without one. `part`: the rows of one configuration."""
    import rerun as rr

    events = sorted((_describe_ending(episode, scene) for episode in table_rows(part)), key=lambda event: event[0])
    text = [f"{name}: {sentence}" for _, _, sentence in events]
    columns = rr.TextLog.columns(text=text, level=[level for _, level, _ in events])
    out.columns(["events", configuration_part(name)], to_nanoseconds([time_s for time_s, _, _ in events]), columns)


_BRAKES_FOR = {
    "ghost": "nothing there", "duplicate": "a second entry of {}", "late": "where {} was",
    "misplaced": "a misplaced entry of {}",
}  # fmt: skip
"""What the driver brakes for who brakes for nothing, by the cause."""


def write_needless_braking(
    out: RecordingSink, replay: Replay, name: str, needless: pd.DataFrame, colour: Rgb
) -> None:  # fmt: skip
    """Write an event for each time that the driver brakes for nothing, and a mark where he brakes for, while it lasts.

    `needless`: rows of `needless.parquet` of one configuration in one run.
    """
    import rerun as rr

    rows, ids = table_rows(needless), short_ids(replay.scene)
    course = replay.ego.course(needless["begins_s"].to_numpy(dtype=float))
    x_m, y_m = replay.ego.locate(course.along_m)
    away_m = np.hypot(needless["x_m"] - x_m, needless["y_m"] - y_m).to_numpy(dtype=float)
    words, labels = [], []
    for row, away in zip(rows, away_m.tolist(), strict=True):
        about = "" if pd.isna(row.object_id) else ids[replay.scene.object_number[row.object_id]]
        what = _BRAKES_FOR[row.cause].format(about)
        labels.append(f"brakes for {what}")
        words.append(f"{labels[-1]}: {row.object_class}, {away:.0f} m away, for {row.lasts_s:.2f} s")
    lost = [f"; loses up to {row.speed_lost_mps:.1f} m/s" for row in rows]
    begins_s = needless["begins_s"].to_numpy(dtype=float)
    ends_s = begins_s + needless["lasts_s"].to_numpy(dtype=float)
    text = [f"{name}: {said}{more}" for said, more in zip(words, lost, strict=True)]
    columns = rr.TextLog.columns(text=text, level=["WARN"] * len(text))
    out.columns(["events", configuration_part(name), "needless"], to_nanoseconds(begins_s), columns)
    path = ["world", configuration_part(name), "needless"]
    states, _ = replay.ego.states(replay.scene.ego_ix, begins_s)
    place = stack_float32(needless["x_m"], needless["y_m"], states["z_m"])
    instants, counts = np.stack([begins_s, ends_s], axis=1).ravel(), np.tile([1, 0], len(rows))
    marks = rr.Points3D.columns(positions=place, labels=labels).partition(counts)
    out.columns(path, to_nanoseconds(instants), marks)
    size = rr.Radius.ui_points(8)
    out.static(path, rr.Points3D.from_fields(colors=[colour], radii=size, show_labels=True))


def write_false_tracks(out: RecordingSink, replay: Replay, name: str, false_tracks: pd.DataFrame) -> None:
    """Write an event for each false track of a configuration in one run: where, for how long, by whose entries."""
    import rerun as rr

    begins_s = false_tracks["begins_s"].to_numpy(dtype=float)
    try:
        near = replay.truth_cache.reference(begins_s)
        away_m = np.hypot(false_tracks["x_m"] - near.x_m, false_tracks["y_m"] - near.y_m).to_numpy(dtype=float)
    except ExperimentError:  # no distances are measured
        away_m = np.full(len(begins_s), np.nan)
    text = [
        f"{name}: false {row.object_class}"
        + (f", {away:.0f} m away" if np.isfinite(away) else "")
        + f", for {row.lasts_s:.2f} s"
        + (f", by {row.units}" if not pd.isna(row.units) else "")
        for row, away in zip(table_rows(false_tracks), away_m.tolist(), strict=True)
    ]
    columns = rr.TextLog.columns(text=text, level=["WARN"] * len(text))
    out.columns(["events", configuration_part(name), "false"], to_nanoseconds(begins_s), columns)


def _name_object(episode: Any, scene: Scene) -> str:
    return f"{short_ids(scene)[scene.object_number[episode.object_id]]} {episode.object_class}"


def _describe_ending(episode: Any, scene: Scene) -> tuple[float, str, str]:
    """Time (s), level and sentence on how one row of the detections ended: known, or never known."""
    name, verdict = _name_object(episode, scene), describe_verdict(episode)
    suffix = f"; the ego {verdict}" if verdict else ""
    if not episode.detected:
        why = EndReason(episode.ended_by)
        ending = f"not known when {why.past}" if why.censors else "never known"
        return episode.ended_s, "WARN", f"{name} {ending}{suffix}"
    late_s, far_m = episode.time_to_detection_s, episode.distance_at_detection_m
    when = f"{-late_s:.2f} s before it counts" if late_s < 0 else f"after {late_s:.2f} s"
    where = "" if np.isnan(far_m) else f", at {far_m:.1f} m"
    passed = verdict is None or episode.braking_pass
    return (
        episode.detection_s,
        "INFO" if passed else "WARN",
        f"{name} known {when} by {episode.first_unit}{where}{suffix}",
    )


def describe_verdict(episode: Any) -> str | None:
    """Whether the ego stays clear by braking, in words, for a detection in conflict; else None."""
    if not getattr(episode, "conflict", False):
        return None
    return "stays clear" if episode.braking_pass else "does not stay clear"


def write_difference_text(
    out: RecordingSink, replay: Replay, table: pd.DataFrame, shown: Mapping[int, str], left_out: Sequence[str],
    too_short: Sequence[str], counted: pd.DataFrame,
) -> None:  # fmt: skip
    """Write tables of times to detection in this run: over all objects, if there are several, then per object.

    `shown`: the objects, with a sentence of what would help, or “”, which is below the table of each; in the overview
    it is that of the first one. Below them are how many these are of those that count (rows `counted`), who else is
    never known, the objects `too_short` to judge, and the files with further configurations.
    """
    import rerun as rr

    by_object = [table[table["object_id"] == replay.scene.object_ids[k]] for k in shown]
    helps = [_escape_cell(words) for words in shown.values()]
    for k, words in zip(shown, helps, strict=True):
        out.static(helps_path(replay.scene, k), rr.TextDocument(words, media_type=rr.MediaType.MARKDOWN))
    tables = [
        "\n\n".join([_difference_table(episodes, replay.scene), words]).rstrip()
        for episodes, words in zip(by_object, helps, strict=True)
    ]
    first = tables[:1]
    if len(shown) > 1:
        name = _name_object(table_rows(by_object[0])[0], replay.scene)
        tables.insert(0, _overview_table(by_object, replay.scene))
        first = [tables[0], *([f"**{name}** · {helps[0]}"] if helps[0] else [])]
    ids = [short_ids(replay.scene)[replay.scene.object_number[name]] for name in too_short]
    among = "; what is shown here is among them" if {replay.scene.object_ids[k] for k in shown} & {*too_short} else ""
    said = "Too short to judge, seen for less than 2 s before or after it counts"
    short = [f"{said}: {_escape_cell(', '.join(ids))}{among}."] if ids else []
    others = [_escape_cell(line) for line in _describe_others(counted, replay.scene, shown)]
    for path, parts in ((DIFFERENCE_TEXT, tables), (DIFFERENCE_SHORT, first)):
        text = "\n\n".join([*parts, *others, *short, *_describe_left_out(left_out)])
        out.static(path, rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))


def _describe_others(counted: pd.DataFrame, scene: Scene, shown: Mapping[int, str]) -> Iterator[str]:
    """“Shown: 6 of 49 that count. Of the others never known: object 134, 99 with late.”; nothing: all are shown."""
    names, not_shown = (
        counted["configuration"].nunique(),
        counted[~counted["object_id"].isin([scene.object_ids[k] for k in shown])],
    )
    if not len(not_shown):
        return
    heading = f"Shown: {len(shown)} of {len(counted) // names} that count"
    missed = not_shown[~not_shown["detected"].astype(bool)].groupby("object_id", sort=False)["configuration"].unique()
    ids = {name: short_ids(scene)[scene.object_number[name]] for name in missed.index}
    words = [ids[name] + ("" if len(of) == names else f" with {', '.join(of)}") for name, of in missed.items()]
    yield f"{heading}." + (
        f" Of the others never known: object{'s' * (len(words) > 1)} {', '.join(words)}." if words else ""
    )


def _difference_table(episodes: pd.DataFrame, scene: Scene) -> str:
    """A Markdown table on one object: a row per configuration with when, where, by whom it was known."""
    first = table_rows(episodes)[0]
    braking = bool(getattr(first, "conflict", False))
    head = ["configuration", "after", "at", *(["the ego"] if braking else []), "by"]
    lines = [f"| {' | '.join(head)} |", "| --- |" + " ---: |" * (len(head) - 1)]
    for episode in table_rows(episodes):
        cells = [
            f"{show_seconds(episode.time_to_detection_s)} s" if episode.detected else "never",
            _format_metres(episode.distance_at_detection_m),
            *([_tell_outcome(episode)] if braking else []),
        ]
        unit = episode.first_unit if episode.detected else "–"
        lines.append(f"| {_escape_cell(episode.configuration)} | {' | '.join(cells)} | {_escape_cell(unit)} |")
    return f"**{_name_object(first, scene)}**, counts from {first.onset_s:.2f} s on\n\n" + "\n".join(lines)


def _tell_outcome(episode: Any) -> str:
    """What the ego comes to: `clear by 3.8 m`; in one cell, as the page is narrow."""
    if episode.braking_pass:
        return f"clear by {_format_metres(episode.min_distance_m)}"
    if episode.impact_speed_mps > 0:
        return f"**hits** at {episode.impact_speed_mps:.1f} m/s"
    return f"**too near**, {_format_metres(episode.min_distance_m)}"


def _overview_table(by_object: Sequence[pd.DataFrame], scene: Scene) -> str:
    """A row per configuration, a column per object: seconds until known, **fail** where the ego does not stay clear."""
    ids = [short_ids(scene)[scene.object_number[episodes["object_id"].iloc[0]]] for episodes in by_object]
    lines = [f"| known after, s | {' | '.join(map(_escape_cell, ids))} |", "| --- |" + " ---: |" * len(ids)]
    rows_by_object = [{episode.configuration: episode for episode in table_rows(episodes)} for episodes in by_object]
    for name in by_object[0]["configuration"]:
        cells = []
        for episodes in rows_by_object:
            after = show_seconds(episodes[name].time_to_detection_s) if episodes[name].detected else "never"
            cells.append(after + {None: "", "stays clear": ""}.get(describe_verdict(episodes[name]), " **fail**"))
        lines.append(f"| {_escape_cell(name)} | {' | '.join(cells)} |")
    return "\n".join(lines)


def write_legend_text(out: RecordingSink, links: bool) -> None:
    """Write what colours and lines mean; `links`: whether there are lanes of lists."""
    import rerun as rr

    text = LEGEND + LINKS if links else LEGEND
    out.static(["words"], rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))


def _escape_cell(text: object) -> str:
    return str(text).replace("|", "\\|")


def _format_metres(value: Any) -> str:
    return "–" if value is None or pd.isna(value) else f"{value:.1f} m"


def _describe_left_out(names: Sequence[str]) -> list[str]:
    if not names:
        return []
    return [f"In further files: {', '.join(names)}."]


LEGEND = """A configuration has one colour in every file and figure of its experiment.

- grey outlines: what was there, and the ways of those we look at; the white body: the ego; grey bodies: obstacles
- filled in colour: what is believed, where it is believed to be, paler the older it is (0 to 1 s); pale discs: 2σ of
  the position
- dashed with a cross: false, about nobody; `false: 24 m ahead, 6 m left`: where, seen from the ego; thin outlines: a
  second entry of somebody, or nobody of a class that is not measured
- words below an object we look at: only its name, it is known; else why it is not: `58 behind car 41`;
  a sentence, when it is selected
- red lines: from the unit that sees most of an object to what hides it
- lines of sight: from the unit that listed an object first, where it was at capture, to where it listed the object
- strong lines on the ground: distance when an object was first known
- an arrow at the edge of a view, `61 → 44 m`: object 61 is farther that way, 44 m from the ego
- white points: units; pale ground with an outline: their fields of view
- lanes: in full colour *known*, from the time of detection in the table on; darker *listed, not known*,
  since the list does not count: it is from before the object counts, not confirmed, or too late; grey and brown: why
  not; the white mark ends where the object begins to count
- compared with a baseline: a large white dot, only the baseline holds it; a small one, the baseline does not"""
LINKS = """
- lanes `lists/…` under those of an object: a unit that sends by a link; from the capture of a list to that of the next,
  if it was *lost*, *late* (longer on its way than `max_age_s`, or by an interval of its lists longer than usual) or
  *overtaken* by a newer one, which fusions of the newest lists then go by alone; else it came in time"""


def write_summary_text(
    out: RecordingSink, replay: Replay, experiment: Experiment, table: pd.DataFrame, run: int, left_out: Sequence[str]
) -> None:
    """Write which run this is, and the summary over all runs and logs, configurations side by side."""
    import rerun as rr

    heading = f"Run {run} of {replay.scene.log}, seed {experiment.seed}, visibility `{experiment.visibility.label}`"
    text = f"{heading}. The table is over all runs and logs.\n\n{_markdown_table(table)}"
    text = "\n\n".join([text, *_describe_left_out(left_out)])
    out.static(["summary"], rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))


def _markdown_table(frame: pd.DataFrame) -> str:
    """A Markdown table with a column for each row of `frame`, and a row for each column."""

    def cell(value: object) -> str:
        if value is None or value is pd.NA or (isinstance(value, float) and np.isnan(value)):
            return "–"
        text = f"{value:.4g}" if isinstance(value, float) else str(value)
        return _escape_cell(text)

    lines = [[name, *(cell(value) for value in frame[name])] for name in frame.columns]
    lines.insert(1, ["---"] + ["---:"] * len(frame))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


# Marks that stay from an instant on.

MARK_SIZE = 6.5
"""Size of marks on curves, in points."""
LINED = 3
"""Most marks with lines from the ego: more lines would cover each other."""


def mark_onsets(
    out: RecordingSink, replay: Replay, experiment: Experiment, table: pd.DataFrame, shown: Sequence[int]
) -> None:
    """Write “onset 2” at the place of the object at its onset."""
    part = _select_episodes(replay, table, shown).drop_duplicates("object_id")
    texts = [f"onset {short_ids(replay.scene)[replay.scene.object_number[name]]}" for name in part["object_id"]]
    _write_lasting_points(
        out,
        ["world", "truth", "onsets"],
        replay,
        experiment,
        part,
        "onset_s",
        texts,
        ONSET[0],
        side=-1,
    )


def mark_detections(
    out: RecordingSink,
    replay: Replay,
    experiment: Experiment,
    table: pd.DataFrame,
    name: str,
    shown: Sequence[int],
    colour: Rgb,
) -> None:
    """Write the true place of each object at its detection by the configuration `name`, and a line there from the ego.

    The middle of the line has the label, “2 detected +0.90 s, 13.5 m, stays clear”: its length is the distance at
    detection.
    """
    part = _select_episodes(replay, table, shown)
    part = part[(part["configuration"] == name) & part["detected"]]
    path = ["world", configuration_part(name), "marks"]
    reference = replay.truth_cache.reference
    order = np.argsort(part["detection_s"].to_numpy(), kind="stable")
    part = part.iloc[order]
    labels = [
        _label_detection(episode, short_ids(replay.scene)[replay.scene.object_number[episode.object_id]])
        for episode in table_rows(part)
    ]
    try:
        ego = reference(part["detection_s"].to_numpy(dtype=float))
    except ExperimentError:  # no distances are measured
        ego = None
    _write_lasting_points(
        out, path, replay, experiment, part, "detection_s", [""] * len(part) if ego else labels, colour, side=1
    )
    if ego is not None:
        _write_reference_lines(out, [*path, "from"], replay, experiment, part, ego, labels, colour)


def _write_reference_lines(
    out: RecordingSink, path: list[str], replay: Replay, experiment: Experiment, part: pd.DataFrame, ego: Reference,
    texts: Sequence[str], colour: Rgb,
) -> None:  # fmt: skip
    """Write lines on the ground from the reference to the objects at detection, with texts in their middle."""
    import rerun as rr

    object_ix = part["object_id"].map(replay.scene.object_number).to_numpy(dtype=np.int64)
    time_s = part["detection_s"].to_numpy(dtype=float)
    states, present = interpolate_states(
        replay.truth, object_ix, time_s, t0_ns=replay.scene.t0_ns, max_gap_s=experiment.max_gap_s
    )
    rows = np.flatnonzero(present & ego.present)
    ground = states["z_m"] - states["height_m"] / 2
    ends = [
        stack_float32(x[rows], y[rows], ground[rows]) for x, y in ((ego.x_m, ego.y_m), (states["x_m"], states["y_m"]))
    ]
    instants, last_of_instant = np.unique(to_nanoseconds(time_s[rows])[::-1], return_index=True)
    counts = len(rows) - last_of_instant
    _, line_ix = np.nonzero(np.arange(len(rows)) < counts[:, None])
    lines = np.stack(ends, axis=1)[line_ix]
    if len(rows) <= LINED:
        out.columns([*path, "line"], instants, rr.LineStrips3D.columns(strips=join_points(lines)).partition(counts))
        out.static([*path, "line"], rr.LineStrips3D.from_fields(colors=[colour], radii=rr.Radius.ui_points(1.0)))
    words = pa.array(texts, pa.string()).take(pa.array(rows[line_ix]))
    out.columns(path, instants, rr.Points3D.columns(positions=lines.mean(axis=1), labels=words).partition(counts))
    small = rr.Radius.ui_points(1)
    out.static(path, rr.Points3D.from_fields(colors=[colour], radii=small, show_labels=False))


def _select_episodes(replay: Replay, table: pd.DataFrame, shown: Sequence[int]) -> pd.DataFrame:
    return table[table["object_id"].isin([replay.scene.object_ids[k] for k in shown])]


def _label_detection(episode: Any, name: str) -> str:
    parts = [f"{name} detected {episode.time_to_detection_s:+.2f} s"]
    if not np.isnan(episode.distance_at_detection_m):
        parts.append(f"{episode.distance_at_detection_m:.1f} m")
    if (verdict := describe_verdict(episode)) is not None:
        parts.append(verdict)
    return ", ".join(parts)


def _write_lasting_points(
    out: RecordingSink, path: list[str], replay: Replay, experiment: Experiment, part: pd.DataFrame, column: str,
    texts: Sequence[str], colour: Rgb, *, side: int,
) -> None:  # fmt: skip
    """Write a point per row of `part`, on the object at the instant in column `column` (s), from that instant on. Each
    row of the entity holds all points up to its instant. `side`: 1 for the top of the box, −1 for the bottom.
    """
    import rerun as rr

    order = np.argsort(part[column].to_numpy(), kind="stable")
    object_ix = part["object_id"].map(replay.scene.object_number).to_numpy(dtype=np.int64)[order]
    time_s = part[column].to_numpy()[order]
    states, present = interpolate_states(
        replay.truth, object_ix, time_s, t0_ns=replay.scene.t0_ns, max_gap_s=experiment.max_gap_s
    )  # fmt: skip
    place = stack_float32(states["x_m"], states["y_m"], states["z_m"] + side * states["height_m"] / 2)[present]
    words = pa.array(texts, pa.string()).take(pa.array(order[present]))
    instants, last_of_instant = np.unique(to_nanoseconds(time_s[present])[::-1], return_index=True)
    counts = len(place) - last_of_instant  # marks up to each instant: the index of its last one, from the end
    _, point_ix = np.nonzero(np.arange(len(place)) < counts[:, None])
    columns = rr.Points3D.columns(positions=place[point_ix], labels=words.take(pa.array(point_ix)))
    out.columns(path, instants, columns.partition(counts))
    size = rr.Radius.ui_points(3)
    out.static(path, rr.Points3D.from_fields(colors=[colour], radii=size, show_labels=False))


def mark_curves(
    out: RecordingSink, replay: Replay, experiment: Experiment, table: pd.DataFrame, name: str,
    curves: Mapping[str, Curve], colours: Mapping[str, Rgb],
) -> None:  # fmt: skip
    """Write onset and detections as marks on the visible shares of the object `name`.

    A detection is on the ego's curve if the configuration has only units of the ego, else on that of all units. An
    entity has one mark per instant: several at one instant are in several entities, smaller ones on larger ones. An
    entity per configuration would cost more than all curves.
    """
    import rerun as rr

    if not curves:
        return
    entity = entity_names(replay.scene)[replay.scene.object_number[name]]
    episodes = table_rows(table[table["object_id"] == name])
    marks = [(BY_EGO, [episode.onset_s for episode in episodes[:1]], ONSET[0], rr.components.MarkerShape.Diamond)]
    for configuration, colour in colours.items():
        found = [episode for episode in episodes if episode.configuration == configuration and episode.detected]
        curve = BY_EGO if _has_only_ego(replay, experiment, configuration) else BY_ANY
        marks.append((curve, [episode.detection_s for episode in found], colour, rr.components.MarkerShape.Circle))
    rows: list[tuple[int, float, Rgb, Any]] = []
    for curve, time_s, colour, shape in marks:
        known_ns, heights = _sample_curve(curves.get(curve, curves[BY_ANY]), to_nanoseconds(time_s))
        rows += [
            (times_ns, height, colour, shape)
            for times_ns, height in zip(known_ns.tolist(), heights.tolist(), strict=True)
        ]
    if not rows:
        return
    times_ns, share, rgb, shapes = (list(column) for column in zip(*sorted(rows, key=lambda row: row[0]), strict=True))
    instants = np.array(times_ns)
    layer = np.arange(len(rows)) - np.searchsorted(instants, instants)
    spots = np.array(share)
    under = np.tril((instants[:, None] == instants) & (spots[:, None] == spots), -1).sum(axis=1)
    for k in range(layer.max() + 1):
        detections = np.flatnonzero(layer == k)
        style = rr.SeriesPoints.columns(
            colors=np.array(rgb, dtype=np.uint8)[detections],
            markers=[shapes[m] for m in detections],
            marker_sizes=MARK_SIZE * 0.6 ** under[detections],
        )
        path = ["plots", "visible_share", entity, f"mark_{k + 1}"]
        out.columns(path, instants[detections], [*rr.Scalars.columns(scalars=spots[detections]), *style])


def _sample_curve(curve: Curve, instants: Int) -> tuple[Int, Float]:
    """Those of the instants (ns) at which the curve has a value, and its newest value then."""
    row = np.searchsorted(curve.elapsed_ns, instants + SAME_INSTANT_NS, side="right") - 1
    share = np.append(curve.share, np.nan)[row]  # index −1 is the value more: none yet
    known = ~np.isnan(share)
    return instants[known], share[known]


def _has_only_ego(replay: Replay, experiment: Experiment, configuration: str) -> bool:
    units = experiment.units_of(experiment.configurations[configuration])
    carriers = [find_carrier(replay.scene, experiment.units[unit]) for unit in units]
    return bool(carriers) and all(on == replay.scene.ego_ix for on in carriers)

"""Show: one run of one log as a Rerun recording (.rrd), the truth beside every configuration, a blueprint inside.

| entity | is |
|---|---|
| `world/truth/boxes`, `measured`, `paths` | the log: its boxes, names of what is measured, paths of these and the ego |
| `world/static`, `world/units/<unit>` | the experiment's obstacles and units |
| `world/<configuration>/boxes`, `covariance` | what the receiver believes, and 2σ of where |
| `plots/visible_share/<object>/…` | how much of it is seen by the ego's units, and by the best of all |
| `plots/position_error/<object>/<configuration>` | believed to true position at the instant the list is available |
| `events/<configuration>`, `summary` | in words |

Columns are sent whole, an entity holds all its objects: hundreds of entities slow the viewer down. It shows the newest
row of an entity until the next one, so an instant at which there is nothing has an empty row of its own.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pyarrow as pa

from copem_replay.colours import TRUTH, Rgb, configuration_colours
from copem_replay.errors import OutputError
from copem_replay.experiment import Experiment
from copem_replay.replay import Replay
from copem_replay.resample import states_at
from copem_replay.tracks import CLASS_GROUPS, CLASSES, Bool, Float, Int, Scene, Tracks
from copem_replay.units import carrier, list_instants
from copem_replay.visibility import Statics

if TYPE_CHECKING:  # a second to import: only where something is written
    import rerun as rr
    import rerun.blueprint as rrb

ELAPSED, TIME = "elapsed", "time"
"""The two timelines: since the log's start, and the log's own clock."""
SHOWN_OBJECTS, SHOWN_CONFIGURATIONS = 6, 6
"""How many measured objects are plotted and configurations have a view of their own (chosen)."""
LAYOUT = 1
"""Counts up when the blueprint changes: the viewer keeps one per application id and prefers what it has."""
SMALLEST_VARIANCE_M2 = 1e-6
"""Positions known better than this have no ellipse (chosen: 2 mm would not be seen)."""
AROUND_S = 0.5
"""The first picture takes in this much before the onset and after the detection (chosen)."""

_STANDING, _EGO = 100, 200  # class ids: moving objects have the index of their class
_RESERVED = ("truth", "static", "units")
_VRU, _VEHICLE, _OTHER, _EGO_RGB = (235, 120, 140), (180, 180, 190), (150, 150, 130), (250, 250, 250)


def write_rrd(
    path: Path,
    replay: Replay,
    experiment: Experiment,
    beliefs: Mapping[str, Tracks],
    table: pd.DataFrame,
    summary: pd.DataFrame,
    run: int,
) -> None:
    """Write one run of one log. Raises OutputError.

    `beliefs`: per configuration what the receiver believes in this run, a frame per list it issued (one unit, values
    (1, P)). `table`: the rows of `detections.parquet` of this log and run. `summary`: of all logs and runs.
    """
    import rerun as rr

    shown = [replay.scene.object_number[name] for name in table["object_id"].unique()[:SHOWN_OBJECTS]]
    blueprint, layout = _blueprint(replay, table, list(beliefs), shown)
    identity = _digest(experiment.model_dump_json(), replay.scene.log, str(run))
    strict = rr.strict_mode()
    rr.set_strict_mode(True)  # else a column that does not fit is left out with a warning
    try:
        with rr.RecordingStream(f"copem_replay:{layout}", recording_id=identity, send_properties=False) as rec:
            if not rr.is_enabled(rec):
                raise OutputError(f"{path}: not written, Rerun is switched off (RERUN=off in the environment?)")
            # Not `save`: on a full disk it waits for ever, or leaves half a file and says nothing.
            memory = rec.memory_recording()
            rec.send_blueprint(blueprint, make_active=False)
            _fill(_Out(rec, replay.scene.t0_ns), replay, experiment, beliefs, table, summary, run, shown)
        _replace(path, memory.drain_as_bytes())
    finally:
        rr.set_strict_mode(strict)


def _replace(path: Path, content: bytes) -> None:
    """Write a file that is complete under its name, or not there."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.", suffix=".tmp") as folder:
            scratch = Path(folder) / path.name
            scratch.write_bytes(content)
            os.replace(scratch, path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error


@dataclass(frozen=True)
class _Out:
    """The recording as it is written."""

    rec: rr.RecordingStream
    t0_ns: int

    def static(self, path: list[Any], *what: Any) -> None:
        """What holds at all times."""
        import rerun as rr

        self.rec.log(rr.new_entity_path(path), *what, static=True)

    def columns(self, path: list[Any], elapsed_ns: Int, columns: Any) -> None:
        """A row per instant (F,)."""
        import rerun as rr

        if len(elapsed_ns):
            times = [
                rr.TimeColumn(ELAPSED, duration=elapsed_ns.astype("timedelta64[ns]")),
                rr.TimeColumn(TIME, timestamp=(self.t0_ns + elapsed_ns).astype("datetime64[ns]")),
            ]
            self.rec.send_columns(rr.new_entity_path(path), times, columns)


def _fill(
    out: _Out, replay: Replay, experiment: Experiment, beliefs: Mapping[str, Tracks], table: pd.DataFrame,
    summary: pd.DataFrame, run: int, shown: Sequence[int],
) -> None:  # fmt: skip
    import rerun as rr

    scene = replay.scene
    _properties(out, replay, experiment, list(beliefs), run)
    out.static([], rr.ViewCoordinates.RIGHT_HAND_Z_UP, _class_colours())
    _truth(out, scene, replay.truth, shown)
    _statics(out, replay.found.static)
    _units(out, replay, experiment)
    _visible_shares(out, replay, experiment, shown)
    for name, colour in configuration_colours(beliefs).items():
        part = _part(name)
        _boxes(out, ["world", part, "boxes"], scene, beliefs[name], scene.object_class.astype(np.uint16))
        solid = rr.components.FillMode.TransparentFillMajorWireframe
        style = rr.Boxes3D.from_fields(colors=[(*colour, 150)], radii=0.04, fill_mode=solid, show_labels=False)
        out.static(["world", part, "boxes"], style)
        _covariance(out, ["world", part, "covariance"], beliefs[name], colour)
        _position_errors(out, replay, experiment, name, beliefs[name], shown, colour)
        _events(out, ["events", part], name, table[table["configuration"] == name])
    what = f"Run {run} of {scene.log}, seed {experiment.seed}, visibility `{experiment.visibility}`"
    text = f"{what}. The table is over all runs and logs.\n\n{_markdown(summary)}"
    out.static(["summary"], rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))


def _properties(out: _Out, replay: Replay, experiment: Experiment, configurations: list[str], run: int) -> None:
    import rerun as rr

    out.rec.send_recording_name(f"{replay.scene.log}: run {run}")
    out.rec.send_recording_start_time_nanos(replay.scene.t0_ns)
    values = rr.AnyValues(
        log=replay.scene.log,
        run=run,
        seed=experiment.seed,
        visibility=experiment.visibility,
        configurations=configurations,
        copem_replay=version("copem-replay"),
        rerun_sdk=version("rerun-sdk"),
    )
    out.rec.send_property("replay", values)


# The world ------------------------------------------------------------------------------------------------------


def _class_colours() -> rr.AnnotationContext:
    import rerun as rr

    groups = {"vru": _VRU, "vehicles": _VEHICLE}
    colour_of = {name: colour for group, colour in reversed(groups.items()) for name in CLASS_GROUPS[group]}
    infos = [rr.AnnotationInfo(_EGO, "ego", _EGO_RGB)]
    for k, name in enumerate(CLASSES):
        colour = colour_of.get(name, _OTHER)
        infos.append(rr.AnnotationInfo(k, name, colour))
        infos.append(rr.AnnotationInfo(_STANDING + k, f"{name}, stationary", tuple(c // 2 for c in colour)))
    return rr.AnnotationContext(infos)


def _truth(out: _Out, scene: Scene, truth: Tracks, shown: Sequence[int]) -> None:
    import rerun as rr

    class_ids = scene.object_class.astype(np.uint16) + np.where(scene.moving, 0, _STANDING).astype(np.uint16)
    if scene.ego_ix >= 0:
        class_ids[scene.ego_ix] = _EGO
    _boxes(out, ["world", "truth", "boxes"], scene, truth, class_ids)
    wireframe = rr.components.FillMode.MajorWireframe
    out.static(["world", "truth", "boxes"], rr.Boxes3D.from_fields(fill_mode=wireframe, radii=0.03, show_labels=False))
    rows, counts = _by_frame(truth, np.isin(truth.row_object_ix, shown))
    above = _f32(truth.x_m[0, rows], truth.y_m[0, rows], truth.z_m[0, rows] + truth.height_m[0, rows] / 2 + 2)
    labels = _labels(scene).take(pa.array(truth.row_object_ix[rows]))
    names = rr.Points3D.columns(positions=above, labels=labels)
    out.columns(["world", "truth", "measured"], _elapsed_ns(truth), names.partition(counts))
    small = rr.Points3D.from_fields(colors=[_VRU], radii=rr.Radius.ui_points(1.5), show_labels=True)
    out.static(["world", "truth", "measured"], small)
    out.static(["world", "truth", "paths"], _paths(truth, [*shown, scene.ego_ix]))


def _paths(truth: Tracks, objects: Sequence[int]) -> rr.LineStrips3D:
    """The ways of some objects on the ground, broken where one is absent for a while."""
    import rerun as rr

    rows = np.flatnonzero(np.isin(truth.row_object_ix, objects))
    ground = _f32(truth.x_m[0, rows], truth.y_m[0, rows], truth.z_m[0, rows] - truth.height_m[0, rows] / 2)
    broken = (np.diff(truth.track_ix[rows]) != 0) | (np.diff(truth.frame_ix[rows]) != 1)
    strips = np.split(ground, np.flatnonzero(broken) + 1) if len(rows) else []
    return rr.LineStrips3D(strips, colors=[(*_OTHER, 90)], radii=0.03)


def _statics(out: _Out, static: Statics) -> None:
    """Obstacles as prisms: a wall per edge, each with its own corners so that it is shaded flat, and a lid."""
    import rerun as rr

    if not len(static.body):
        return
    sizes = np.diff(static.start)
    part, here = np.repeat(np.arange(len(sizes)), sizes), np.arange(len(static.xy_m))
    there = here + 1
    there[static.start[1:] - 1] = static.start[:-1]
    a, b = static.xy_m[here], static.xy_m[there]
    bottom, top = static.bottom_m[part], static.top_m[part]
    corners = [_f32(*a.T, bottom), _f32(*b.T, bottom), _f32(*b.T, top), _f32(*a.T, top)]
    outward = _f32((b - a)[:, 1], -(b - a)[:, 0], np.zeros(len(a)))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    up = np.tile(np.array([0, 0, 1], dtype=np.float32), (len(a), 1))
    walls = (4 * here[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    fan = (here != static.start[part]) & (there != static.start[part])
    lid = 4 * len(a) + np.stack([static.start[part], here, there], axis=-1)[fan]
    mesh = rr.Mesh3D(
        vertex_positions=np.concatenate([np.stack(corners, axis=1).reshape(-1, 3), corners[3]]),
        vertex_normals=np.concatenate([np.repeat(outward, 4, axis=0), up]),
        triangle_indices=np.concatenate([walls, lid]),
        albedo_factor=(110, 110, 110),
    )
    out.static(["world", "static"], mesh)


def _units(out: _Out, replay: Replay, experiment: Experiment) -> None:
    import rerun as rr

    for name, unit in experiment.units.items():
        at, path = replay.found.poses[name], ["world", "units", name]
        place, there = _f32(at.x_m, at.y_m, at.z_m), at.present
        if unit.at is not None:
            out.static(path, rr.Points3D.from_fields(positions=place[:1]))
        else:
            elapsed_ns = list_instants(replay.scene, replay.truth, unit) - replay.scene.t0_ns
            out.columns(path, elapsed_ns, rr.Points3D.columns(positions=place[there]).partition(there.astype(np.int64)))
        mark = rr.Radius.ui_points(4)
        out.static(path, rr.Points3D.from_fields(colors=[_EGO_RGB], radii=mark, labels=[name], show_labels=True))


def _boxes(out: _Out, path: list[str], scene: Scene, tracks: Tracks, class_ids: np.ndarray) -> None:
    """All boxes of `tracks`, list by list, from the instant each list is available. `class_ids` (N,)."""
    import rerun as rr

    rows, counts = _by_frame(tracks, tracks.valid[0])
    object_ix = tracks.row_object_ix[rows]
    columns = rr.Boxes3D.columns(
        centers=_f32(tracks.x_m[0, rows], tracks.y_m[0, rows], tracks.z_m[0, rows]),
        half_sizes=_f32(tracks.length_m[0, rows], tracks.width_m[0, rows], tracks.height_m[0, rows]) / 2,
        quaternions=_upright(tracks.yaw_rad[0, rows]),
        class_ids=class_ids[object_ix],
        labels=_labels(scene).take(pa.array(object_ix)),
    )
    out.columns(path, _elapsed_ns(tracks), columns.partition(counts))


def _covariance(out: _Out, path: list[str], tracks: Tracks, colour: Rgb) -> None:
    """2σ ellipses of the position, lying under the boxes; none where it is exact."""
    import rerun as rr

    if tracks.cov_ee_m2 is None or tracks.cov_en_m2 is None or tracks.cov_nn_m2 is None:
        return
    a, b, d = tracks.cov_ee_m2[0], tracks.cov_en_m2[0], tracks.cov_nn_m2[0]
    turn = np.hypot((a - d) / 2, b)
    high, low = (a + d) / 2 + turn, (a + d) / 2 - turn
    rows, counts = _by_frame(tracks, tracks.valid[0] & (high > SMALLEST_VARIANCE_M2))
    if not len(rows):
        return
    columns = rr.Ellipsoids3D.columns(
        centers=_f32(tracks.x_m[0, rows], tracks.y_m[0, rows], tracks.z_m[0, rows] - tracks.height_m[0, rows] / 2),
        half_sizes=_f32(
            2 * np.sqrt(high[rows]), 2 * np.sqrt(np.maximum(low[rows], SMALLEST_VARIANCE_M2)), np.full(len(rows), 0.01)
        ),
        quaternions=_upright(np.arctan2(b, (a - d) / 2)[rows] / 2),
    )
    out.columns(path, _elapsed_ns(tracks), columns.partition(counts))
    solid = rr.components.FillMode.Solid
    out.static(path, rr.Ellipsoids3D.from_fields(colors=[(*colour, 70)], fill_mode=solid))


# Plots and words ------------------------------------------------------------------------------------------------


def _visible_shares(out: _Out, replay: Replay, experiment: Experiment, shown: Sequence[int]) -> None:
    import rerun as rr

    scene, tracks = replay.scene, replay.measured.tracks
    stamps, newest = _newest_lists(tracks, experiment.max_gap_s)
    carriers = np.array([carrier(scene, unit) for unit in experiment.units.values()], dtype=np.int64)
    own = (carriers == scene.ego_ix) & (scene.ego_ix >= 0)
    styles = [("ego", own, _EGO_RGB, 3.0)] if own.any() else []
    styles += [("any unit", np.ones_like(own), TRUTH, 1.5)] if len(own) else []
    for k in shown:
        share = np.full(len(tracks.stamp_ns) + 1, np.nan)  # one more: what −1 points at
        rows = np.flatnonzero(tracks.row_object_ix == k)
        share[tracks.frame_ix[rows]] = replay.measured.look.visible_share[rows]
        for name, units, colour, width in styles:
            # A unit without a list of the object says nothing about it: the best of the others counts.
            best = np.fmax.reduce(share[newest[units]], axis=0)
            known = ~np.isnan(best)
            # An empty row breaks the line. NaN would, too, but no two recordings with NaN compare equal.
            kept = known | np.append(False, known[:-1])
            values = rr.Scalars.columns(scalars=best[known]).partition(known[kept].astype(np.int64))
            path = ["plots", "visible_share", scene.object_ids[k], name]
            out.columns(path, (stamps - scene.t0_ns)[kept], values)
            out.static(path, rr.SeriesLines(names=name, colors=colour, widths=width))


def _newest_lists(tracks: Tracks, max_gap_s: float) -> tuple[Int, Int]:
    """All capture instants (K,), and the newest list of each unit at each (U, K): −1, none for `max_gap_s`."""
    stamps = np.unique(tracks.stamp_ns)
    newest = np.full((len(tracks.units), len(stamps)), -1)
    for unit in range(len(tracks.units)):
        mine = np.flatnonzero(tracks.frame_unit_ix == unit)  # in order of capture
        at = np.searchsorted(tracks.stamp_ns[mine], stamps, side="right") - 1
        known = at >= 0
        known[known] = stamps[known] - tracks.stamp_ns[mine[at[known]]] <= max_gap_s * 1e9
        newest[unit, known] = mine[at[known]]
    return stamps, newest


def _position_errors(
    out: _Out, replay: Replay, experiment: Experiment, name: str, fused: Tracks, shown: Sequence[int], colour: Rgb
) -> None:
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
        out.columns(path, _elapsed_ns(fused)[frames[there]], rr.Scalars.columns(scalars=error))
        out.static(path, style)


_ENDINGS = {
    "object_left": "left undetected",
    "ego_left": "undetected when the ego left",
    "log_end": "undetected when the log ended",
}


def _events(out: _Out, path: list[str], name: str, part: pd.DataFrame) -> None:
    """Onset of each object, and how its look ended. `part`: the rows of one configuration."""
    import rerun as rr

    told = sorted((event for look in part.itertuples() for event in _story(look)), key=lambda event: event[0])
    text = [f"{name}: {sentence}" for _, _, sentence in told]
    columns = rr.TextLog.columns(text=text, level=[level for _, level, _ in told])
    out.columns(path, _ns([time_s for time_s, _, _ in told]), columns)


def _story(look: Any) -> list[tuple[float, str, str]]:
    """When, how serious, what: of one row of the detections."""
    who = f"{look.object_id} {look.object_class}"
    first = ", already at its first frame" if look.onset_at_start else ""
    begin = (look.onset_s, "INFO", f"onset of {who}{first}")
    if not look.detected:
        return [begin, (look.ended_s, "WARN", f"{who} {_ENDINGS[look.ended_by]}")]
    late_s, far_m = look.time_to_detection_s, look.distance_at_detection_m
    when = f"{abs(late_s):.2f} s {'before' if late_s < 0 else 'after'} the onset"
    where = "" if np.isnan(far_m) else f", at {far_m:.1f} m"
    return [begin, (look.detection_s, "INFO", f"{who} detected by {look.first_unit} {when}{where}")]


def _markdown(frame: pd.DataFrame) -> str:
    """A table with a column per row of `frame`: configurations side by side."""

    def cell(value: object) -> str:
        if value is None or value is pd.NA or (isinstance(value, float) and np.isnan(value)):
            return "–"
        text = f"{value:.4g}" if isinstance(value, float) else str(value)
        return text.replace("|", "\\|")

    lines = [[name, *(cell(value) for value in frame[name])] for name in frame.columns]
    lines.insert(1, ["---"] + ["---:"] * len(frame))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


# How it is laid out ---------------------------------------------------------------------------------------------


def _blueprint(
    replay: Replay, table: pd.DataFrame, configurations: Sequence[str], shown: Sequence[int]
) -> tuple[rrb.Blueprint, str]:
    """Views of truth and configurations over plots and words; and a digest of all that it depends on."""
    import rerun.blueprint as rrb

    scene = replay.scene
    eye, target = _eye(replay, table)
    controls = rrb.EyeControls3D(position=eye, look_target=target, eye_up=(0, 0, 1))
    views = [_view(name, controls) for name in configurations[:SHOWN_CONFIGURATIONS]]
    plots = [_plots(scene, k) for k in shown]
    below = [rrb.Tabs(*plots, name="Objects"), _words()] if plots else [_words()]
    onset_ns = int(_ns(table["onset_s"].min())) if len(table) else 0
    end_ns = max(scene.end_ns - scene.t0_ns, onset_ns)
    # No blueprint can place the time cursor, but playing begins where the selection does: at the first onset.
    panel = rrb.TimePanel(
        timeline=ELAPSED,
        play_state="paused",
        loop_mode="selection",
        state="collapsed",
        time_selection=rrb.components.AbsoluteTimeRange(onset_ns, end_ns),
    )
    blueprint = rrb.Blueprint(
        rrb.Vertical(
            rrb.Grid(*views, grid_columns=3 if len(views) in (3, 5, 6) else min(len(views), 2)),
            rrb.Horizontal(*below, column_shares=[3, 2] if plots else None),
            row_shares=[2, 1],
        ),
        panel,
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_layout=False,
        auto_views=False,
    )
    parts = (LAYOUT, configurations, [scene.object_ids[k] for k in shown], eye, target, onset_ns, end_ns)
    return blueprint, _digest(repr(parts))


def _view(configuration: str, eye: rrb.EyeControls3D) -> rrb.Spatial3DView:
    import rerun.blueprint as rrb

    own = _path("world", _part(configuration))
    return rrb.Spatial3DView(
        origin="world",
        name=configuration,
        contents=["+ world/truth/**", "+ world/static", "+ world/units/**", f"+ {own}/**"],
        eye_controls=eye,
        line_grid=rrb.LineGrid3D(spacing=5.0),
    )


def _plots(scene: Scene, k: int) -> rrb.Horizontal:
    """Of one object."""
    import rerun.blueprint as rrb

    name = scene.object_ids[k]
    shares, errors = _path("plots", "visible_share", name), _path("plots", "position_error", name)
    return rrb.Horizontal(
        rrb.TimeSeriesView(origin=shares, name="Visible share", axis_y=rrb.ScalarAxis(range=(-0.02, 1.02))),
        rrb.TimeSeriesView(origin=errors, name="Position error [m]"),
        name=f"{name} {CLASSES[scene.object_class[k]]}",
    )


def _words() -> rrb.Tabs:
    import rerun.blueprint as rrb

    # The text names the configuration: the column of entity paths would be cut off.
    columns = [rrb.encodings.TextLogColumn(kind) for kind in ("LogLevel", "Body")]
    return rrb.Tabs(
        rrb.TextLogView(origin="events", name="Events", columns=rrb.TextLogColumns(text_log_columns=columns)),
        rrb.TextDocumentView(origin="summary", name="Summary"),
    )


def _eye(replay: Replay, table: pd.DataFrame) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Where from and where to: from behind the ego and above, on it and the first object until that is detected."""
    truth, scene = replay.truth, replay.scene
    rows = np.zeros(len(truth.frame_ix), dtype=bool)
    if len(table):
        look = table[table["object_id"] == table["object_id"].iloc[int(np.argmin(table["onset_s"]))]]
        onset_s = look["onset_s"].min()
        until_s = max(onset_s, look["detection_s"].fillna(onset_s).max())
        rows = np.isin(truth.row_object_ix, [scene.object_number[look["object_id"].iloc[0]], scene.ego_ix])
        rows &= (truth.row_captured_s >= onset_s - AROUND_S) & (truth.row_captured_s <= until_s + AROUND_S)
    rows = np.flatnonzero(rows if rows.any() else np.ones(len(rows), dtype=bool))
    if not len(rows):
        return (-30.0, 0.0, 30.0), (0.0, 0.0, 0.0)
    place = np.stack([truth.x_m[0, rows], truth.y_m[0, rows], truth.z_m[0, rows]])
    low, high = place.min(axis=1), place.max(axis=1)
    away_m = np.clip(0.65 * np.hypot(*(high - low)[:2]), 15, 120)
    yaw = truth.yaw_rad[0, rows[truth.row_object_ix[rows] == scene.ego_ix]][:1].sum()  # 0, looking east, without an ego
    eye = (low + high) / 2 + away_m * np.array([-np.cos(yaw), -np.sin(yaw), 0.9])
    return tuple(np.round(eye, 1).tolist()), tuple(np.round((low + high) / 2, 1).tolist())


# Small things ---------------------------------------------------------------------------------------------------


def _part(configuration: str) -> str:
    """A configuration's part of entity paths; not one that is taken."""
    taken = configuration in _RESERVED or configuration.startswith("configuration ")
    return f"configuration {configuration}" if taken else configuration


def _path(*parts: str) -> str:
    import rerun as rr

    return rr.new_entity_path(list(parts))


def _digest(*texts: str) -> str:
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()[:16]


def _labels(scene: Scene) -> pa.Array:
    names = [f"{name} {CLASSES[k]}" for name, k in zip(scene.object_ids, scene.object_class, strict=True)]
    return pa.array(names, pa.string())


def _by_frame(tracks: Tracks, kept: Bool) -> tuple[Int, Int]:
    """The kept rows list by list, and how many each list holds (F,)."""
    order, _ = tracks.by_frame
    rows = order[kept[order]]
    return rows, np.bincount(tracks.frame_ix[rows], minlength=len(tracks.stamp_ns))


def _ns(time_s: Any) -> Any:
    return np.rint(np.asarray(time_s) * 1e9).astype(np.int64)


def _elapsed_ns(tracks: Tracks) -> Int:
    """(F,) when each list is available, since the log's start."""
    elapsed: Int = _ns(tracks.arrives_s[0])
    return elapsed


def _f32(*columns: Float) -> np.ndarray:
    """Columns (K,) side by side, as the viewer has them."""
    return np.stack(columns, axis=-1).astype(np.float32)


def _upright(yaw_rad: Float) -> np.ndarray:
    """Quaternions xyzw (K, 4) of turns about the vertical."""
    zero = np.zeros(len(yaw_rad))
    return _f32(zero, zero, np.sin(yaw_rad / 2), np.cos(yaw_rad / 2))

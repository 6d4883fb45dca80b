"""Errors and misses of a fitted unit in place: a recording for the viewer, all at once and list by list."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.colours import Rgb
from copem_replay.core.tracks import Float, Int
from copem_replay.pipeline.fit.rows import FitLists, FitRows
from copem_replay.viewer.palette import GROUND
from copem_replay.viewer.sink import ELAPSED, Out, digest, f32, ns, plain
from copem_replay.viewer.stream import file_stream

if TYPE_CHECKING:  # a second to import: only where something is written
    from rerun import blueprint as rrb

LISTED: Rgb = (86, 180, 233)
MISSED: Rgb = (255, 90, 90)
ERROR: Rgb = (230, 159, 0)
UNIT: Rgb = (255, 255, 255)


def write_fit_places(path: Path, unit: str, logs: tuple[str, ...], rows: FitRows, lists: FitLists) -> None:
    """Write where true objects are listed, with an arrow to the entry, and where they are missed, in each of the logs.

    Times are since the beginning of each log; heights are left out. Raises OutputError.
    """
    import rerun as rr

    ids = "copem_replay_fit", digest(unit, *logs, str(len(rows.log)))
    with file_stream(path, *ids) as rec:
        rec.send_blueprint(_blueprint(logs, rows))
        out = Out(rec, 0)
        for log, name in enumerate(logs):
            own, here = ["world", plain(name)], np.flatnonzero(lists.log == log)
            mine = np.flatnonzero(rows.log == log)
            mine = mine[np.argsort(rows.list[mine], kind="stable")]
            elapsed_ns = ns(lists.captured_s[here])
            east_m, north_m = rows.state_m.T
            erring = rows.listed & np.isfinite(rows.east_m)
            for what, which, colour in (("listed", rows.listed, LISTED), ("missed", ~rows.listed, MISSED)):
                some = mine[which[mine]]
                points = rr.Points3D.columns(positions=_flat(east_m[some], north_m[some]))
                out.columns([*own, what], elapsed_ns, points.partition(_count(rows.list[some], here)))
                look = rr.Points3D.from_fields(colors=[colour], radii=rr.Radius.ui_points(3 if what == "listed" else 4))
                out.static([*own, what], look)
            some = mine[erring[mine]]
            arrows = rr.Arrows3D.columns(
                origins=_flat(east_m[some], north_m[some]), vectors=_flat(rows.east_m[some], rows.north_m[some])
            )
            out.columns([*own, "error"], elapsed_ns, arrows.partition(_count(rows.list[some], here)))
            out.static([*own, "error"], rr.Arrows3D.from_fields(colors=[ERROR], radii=rr.Radius.ui_points(1)))
            places = rr.Points3D.columns(positions=_flat(lists.east_m[here], lists.north_m[here]))
            out.columns([*own, "unit"], elapsed_ns, places.partition(np.ones(len(here), dtype=np.int64)))
            mark = rr.Points3D.from_fields(colors=[UNIT], radii=rr.Radius.ui_points(7), labels=[unit], show_labels=True)
            out.static([*own, "unit"], mark)


def _flat(east_m: Float, north_m: Float) -> np.ndarray:
    return f32(east_m, north_m, np.zeros(len(east_m)))


def _count(list_ix: Int, here: Int) -> Int:
    """(lists,) how many rows each list has."""
    return np.bincount(list_ix - here[0], minlength=len(here)) if len(here) else np.zeros(0, dtype=np.int64)


def _blueprint(logs: tuple[str, ...], rows: FitRows) -> rrb.Blueprint:
    """Two views from above: all of the logs, and what is at the time."""
    import rerun.blueprint as rrb

    low, high = rows.state_m.min(axis=0), rows.state_m.max(axis=0)
    middle = np.append((low + high) / 2, 0.0)
    away_m = 1.8 * max(float((high - low).max()), 20.0)
    eye = rrb.EyeControls3D(
        position=(middle + np.array([0.0, -0.01, 1.0]) * away_m).tolist(), look_target=middle.tolist(), eye_up=(0, 1, 0)
    )
    every = rrb.VisibleTimeRange(ELAPSED, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.infinite())
    views = [
        rrb.Spatial3DView(origin="world", name=name, eye_controls=eye, time_ranges=ranges, background=GROUND)
        for name, ranges in (("All errors and misses", [every]), ("At this time", []))
    ]
    panel = rrb.TimePanel(timeline=ELAPSED, state="collapsed")
    return rrb.Blueprint(
        rrb.Horizontal(*views), panel, rrb.SelectionPanel(state="collapsed"), auto_layout=False, auto_views=False
    )

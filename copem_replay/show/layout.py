"""How it is laid out: the blueprint, and where the eye is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from copem_replay.experiment import Experiment
from copem_replay.replay import Replay
from copem_replay.show.out import ELAPSED, digest, ns, part_of, path_of
from copem_replay.tracks import CLASSES, Float, Scene
from copem_replay.units import carrier

if TYPE_CHECKING:  # a second to import: only where something is written
    import rerun.blueprint as rrb

SHOWN_CONFIGURATIONS = 6
"""How many configurations have a view of their own (chosen)."""
LAYOUT = 2
"""Counts up when the blueprint changes: the viewer keeps one per application id and prefers what it has."""
AROUND_S = 0.1
"""The first picture takes in this much before and after the instants it shows (chosen)."""
TURNED_RAD, DOWN_RAD = np.deg2rad((45.0, 38.0))
"""The eye looks this far to the right of the ego's heading, and down (chosen)."""
EYE_RAD, ASPECT, MARGIN_M = np.deg2rad(55.0), 1.7, 2.5
"""The viewer's vertical field of view; how much wider a view is than high, and room around places (chosen)."""
NEAR_FAR_M = (20.0, 150.0)
"""How far the eye is from what it looks at, at least and at most (chosen)."""


def blueprint(
    replay: Replay, experiment: Experiment, table: pd.DataFrame, configurations: Sequence[str], shown: Sequence[int],
    baseline: str | None = None,
) -> tuple[rrb.Blueprint, str]:  # fmt: skip
    """Views of truth and configurations over plots and words; and a digest of all that it depends on.

    With a `baseline` the differences of position errors to it have a plot of their own.
    """
    import rerun.blueprint as rrb

    scene = replay.scene
    follows = _followed(scene, experiment)
    eye, target = _eye(replay, table, follows)
    controls = rrb.EyeControls3D(position=eye, look_target=target, eye_up=(0, 0, 1), tracking_entity=follows)
    heard = {n: experiment.units_of(experiment.configurations[n]) for n in configurations[:SHOWN_CONFIGURATIONS]}
    views = [_view(name, units, controls) for name, units in heard.items()]
    plots = [_plots(scene, k, baseline) for k in shown]
    bound = rrb.TimeRangeBoundary.absolute
    whole = rrb.TimeAxis(view_range=rrb.TimeRange(start=bound(seconds=0.0), end=bound(seconds=scene.end_s)))
    known = rrb.TimeSeriesView(origin="plots/known", name="Known objects", axis_x=whole)
    below = [rrb.Tabs(*plots, known, name="Objects"), _words()] if plots else [_words()]
    onset_ns = int(ns(table["onset_s"].min())) if len(table) else 0
    end_ns = max(scene.end_ns - scene.t0_ns, onset_ns)
    # No blueprint can place the time cursor, but playing begins where the selection does: at the first onset.
    panel = rrb.TimePanel(
        timeline=ELAPSED,
        play_state="paused",
        loop_mode="selection",
        state="collapsed",
        time_selection=rrb.components.AbsoluteTimeRange(onset_ns, end_ns),
    )
    made = rrb.Blueprint(
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
    parts = (
        LAYOUT,
        configurations,
        heard,
        [scene.object_ids[k] for k in shown],
        eye,
        target,
        follows,
        onset_ns,
        end_ns,
        baseline,
    )
    return made, digest(repr(parts))


def _view(configuration: str, units: Sequence[str], eye: rrb.EyeControls3D) -> rrb.Spatial3DView:
    """Of one configuration, with the fields of view of its own units only."""
    import rerun.blueprint as rrb

    fields = [f"+ {path_of('world', 'fields', unit)}" for unit in units]
    always = ["+ world/truth/**", "+ world/static", "+ world/units/**", "+ world/sight/**"]
    return rrb.Spatial3DView(
        origin="world",
        name=configuration,
        contents=[*always, *fields, f"+ {path_of('world', part_of(configuration))}/**"],
        eye_controls=eye,
        line_grid=rrb.LineGrid3D(spacing=5.0),
    )


def _plots(scene: Scene, k: int, baseline: str | None) -> rrb.Horizontal:
    """Of one object."""
    import rerun.blueprint as rrb

    name = scene.object_ids[k]
    shares, errors = path_of("plots", "visible_share", name), path_of("plots", "position_error", name)
    more = path_of("plots", "error_difference", name)
    beside = [rrb.TimeSeriesView(origin=more, name=f"More error than {baseline} [m]")] if baseline is not None else []
    return rrb.Horizontal(
        rrb.TimeSeriesView(
            origin=shares,
            name="Visible share (ego white, any unit grey)",
            plot_legend=rrb.PlotLegend(visible=False),
            axis_y=rrb.ScalarAxis(range=(-0.05, 1.05)),
        ),
        rrb.TimeSeriesView(origin=errors, name="Position error [m]"),
        *beside,
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


def _followed(scene: Scene, experiment: Experiment) -> str | None:
    """The ego's first unit: what the eye keeps in its middle."""
    on_ego = (name for name, unit in experiment.units.items() if carrier(scene, unit) == scene.ego_ix >= 0)
    return next((path_of("world", "units", name) for name in on_ego), None)


def _eye(replay: Replay, table: pd.DataFrame, follows: str | None) -> tuple[list[float], list[float]]:
    """Where from and where to: on the ego, if it is followed, and the first object at its onset; else until known."""
    truth, scene = replay.truth, replay.scene
    rows = np.zeros(len(truth.frame_ix), dtype=bool)
    if len(table):
        look = table[table["object_id"] == table["object_id"].iloc[int(np.argmin(table["onset_s"]))]]
        onset_s = look["onset_s"].min()
        until_s = onset_s if follows else max(onset_s, look["detection_s"].fillna(onset_s).max())
        rows = np.isin(truth.row_object_ix, [scene.object_number[look["object_id"].iloc[0]], scene.ego_ix])
        rows &= (truth.row_captured_s >= onset_s - AROUND_S) & (truth.row_captured_s <= until_s + AROUND_S)
    rows = np.flatnonzero(rows if rows.any() else np.ones(len(rows), dtype=bool))
    if not len(rows):
        return [-30.0, 0.0, 30.0], [0.0, 0.0, 0.0]
    place = np.stack([truth.x_m[0, rows], truth.y_m[0, rows], truth.z_m[0, rows]])
    ego = np.flatnonzero(truth.row_object_ix[rows] == scene.ego_ix)
    target = place[:, ego[0]] if follows and len(ego) else (place.min(axis=1) + place.max(axis=1)) / 2
    ahead = _ahead(truth.yaw_rad[0, rows[ego]][:1].sum())  # 0, looking east, without an ego
    eye = target - _distance(place - target[:, None], ahead) * ahead
    return np.round(eye, 1).tolist(), np.round(target, 1).tolist()


def _ahead(yaw_rad: float) -> Float:
    """Where the eye looks: along the ego's way, from its left, down. Views are wide, so ways should run across."""
    turned = yaw_rad - TURNED_RAD
    ahead = np.array([np.cos(turned), np.sin(turned), -np.tan(DOWN_RAD)])
    unit: Float = ahead / np.linalg.norm(ahead)
    return unit


def _distance(place_m: Float, ahead: Float) -> float:
    """From how far the places (3, K) around the middle of the picture are all in it."""
    right = np.array([ahead[1], -ahead[0], 0]) / np.hypot(*ahead[:2])
    up = np.cross(right, ahead)
    beside = (np.abs(right @ place_m) + MARGIN_M) / (ASPECT * np.tan(EYE_RAD / 2))
    above = (np.abs(up @ place_m) + MARGIN_M) / np.tan(EYE_RAD / 2)
    return float(np.clip((np.maximum(beside, above) - ahead @ place_m).max(), *NEAR_FAR_M))

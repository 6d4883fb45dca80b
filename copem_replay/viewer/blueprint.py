"""How it is laid out: the blueprint."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import pandas as pd

from copem_replay.core.tracks import CLASSES
from copem_replay.experiment.schema import Experiment
from copem_replay.pipeline.prepare import Replay
from copem_replay.viewer.camera import FOLLOWED, Eye
from copem_replay.viewer.sink import ELAPSED, digest, ns, part_of, path_of, short_ids

if TYPE_CHECKING:  # a second to import: only where something is written
    import rerun.blueprint as rrb

LAYOUT = 3
"""Counts up when the blueprint changes: the viewer keeps one per application id and prefers what it has."""
ALL_VIEWS = 3.1
"""How much wider than high all views together are (chosen)."""


def blueprint(
    replay: Replay, experiment: Experiment, table: pd.DataFrame, configurations: Sequence[str], shown: Sequence[int],
    eye: Eye, baseline: str | None = None,
) -> tuple[rrb.Blueprint, str]:  # fmt: skip
    """Views of truth and configurations over plots and words; and a digest of all that it depends on.

    With a `baseline` the differences of position errors to it have a plot of their own.
    """
    import rerun.blueprint as rrb

    scene = replay.scene
    follows = None if eye.unit is None else path_of(*FOLLOWED)
    place, target = eye.place_m.tolist(), eye.target_m.tolist()
    controls = rrb.EyeControls3D(position=place, look_target=target, eye_up=(0, 0, 1), tracking_entity=follows)
    heard = {n: experiment.units_of(experiment.configurations[n]) for n in configurations}
    views = [_view(name, units, follows, controls) for name, units in heard.items()]
    whole = _axis(0.0, scene.end_s)
    below: list[rrb.Container] = [_words()]
    if shown:
        lanes = rrb.StateTimelineView(origin="lanes", name="What each knows, when", time_view=whole)
        below = [rrb.Vertical(lanes), rrb.Vertical(_objects(replay, shown, baseline), _lists(whole)), _words()]
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
            rrb.Grid(*views, grid_columns=_columns(len(views))),
            rrb.Horizontal(*below, column_shares=[4, 4, 3] if shown else None),
            row_shares=[3, 2],
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
        place,
        target,
        follows,
        onset_ns,
        end_ns,
        baseline,
    )
    return made, digest(repr(parts))


def _columns(views: int) -> int:
    return 3 if views in (3, 5, 6) else min(views, 2)


def aspect(views: int) -> float:
    """How much wider than high each of so many views is."""
    columns = _columns(views)
    return ALL_VIEWS * -(-views // columns) / columns


def _view(configuration: str, units: Sequence[str], follows: str | None, eye: rrb.EyeControls3D) -> rrb.Spatial3DView:
    """Of one configuration, with its own units only, and what all eyes follow."""
    import rerun.blueprint as rrb

    own = [f"+ {path_of('world', kind, unit)}" for unit in units for kind in ("units", "fields")]
    own += [f"+ {follows}"] if follows else []
    return rrb.Spatial3DView(
        origin="world",
        name=configuration,
        contents=["+ world/truth/**", "+ world/static", *own, f"+ {path_of('world', part_of(configuration))}/**"],
        eye_controls=eye,
        line_grid=rrb.LineGrid3D(spacing=5.0),
    )


def _axis(first_s: float, last_s: float) -> rrb.TimeAxis:
    """From and to, at first."""
    import rerun.blueprint as rrb

    bound = rrb.TimeRangeBoundary.absolute
    return rrb.TimeAxis(view_range=rrb.TimeRange(start=bound(seconds=first_s), end=bound(seconds=last_s)))


def _objects(replay: Replay, shown: Sequence[int], baseline: str | None) -> rrb.Tabs:
    """Curves of one object while it is in the log, the others behind it."""
    import rerun.blueprint as rrb

    scene, plots = replay.scene, []
    none = rrb.PlotLegend(visible=False)  # the lanes say which colour is whose
    for k in shown:
        there_s = replay.truth.row_captured_s[replay.truth.row_object_ix == k]
        stay = _axis(float(there_s.min()), float(there_s.max()))
        name = scene.object_ids[k]
        share = rrb.TimeSeriesView(
            origin=path_of("plots", "visible_share", name),
            name="Visible share (ego white, any unit grey)",
            plot_legend=none,
            axis_x=stay,
            axis_y=rrb.ScalarAxis(range=(-0.05, 1.05)),
        )
        error = rrb.TimeSeriesView(
            origin=path_of("plots", "position_error", name),
            name="Position error [m]",
            plot_legend=none,
            axis_x=stay,
        )
        views = [share, error]
        if baseline is not None:
            more = path_of("plots", "error_difference", name)
            views.append(
                rrb.TimeSeriesView(origin=more, name=f"More error than {baseline} [m]", axis_x=stay, plot_legend=none)
            )
        plots.append(rrb.Horizontal(*views, name=f"{short_ids(scene)[k]} {CLASSES[scene.object_class[k]]}"))
    return rrb.Tabs(*plots)


def _lists(whole: rrb.TimeAxis) -> rrb.Horizontal:
    """Curves over all measured objects."""
    import rerun.blueprint as rrb

    none = rrb.PlotLegend(visible=False)
    return rrb.Horizontal(
        rrb.TimeSeriesView(origin="plots/gospa", name="GOSPA [m]", axis_x=whole, plot_legend=none),
        rrb.TimeSeriesView(origin="plots/known", name="Measured objects known", axis_x=whole, plot_legend=none),
    )


def _words() -> rrb.Tabs:
    import rerun.blueprint as rrb

    # The text names the configuration: the column of entity paths would be cut off.
    columns = [rrb.encodings.TextLogColumn(kind) for kind in ("LogLevel", "Body")]
    return rrb.Tabs(
        rrb.TextDocumentView(origin="difference", name="What difference it made"),
        rrb.TextLogView(origin="events", name="Events", columns=rrb.TextLogColumns(text_log_columns=columns)),
        rrb.TextDocumentView(origin="summary", name="Summary of all runs"),
        rrb.TextDocumentView(origin="legend", name="Legend"),
    )

"""What is on each page of the layout: a page answers one question, all of them from the same entities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from copem_replay.core.tracks import CLASSES, TRUTH
from copem_replay.experiment.schema import Experiment
from copem_replay.pipeline.prepare import Replay
from copem_replay.viewer.camera import Eye
from copem_replay.viewer.legend import LEGEND_X, LEGEND_Y
from copem_replay.viewer.linked_lists import UnitLists, shown_under
from copem_replay.viewer.palette import GROUND
from copem_replay.viewer.sink import entity_names, lanes_of, part_of, path_of, short_ids

if TYPE_CHECKING:  # a second to import: only where something is written
    import rerun.blueprint as rrb

SMALL = 3
"""So many views beside each other at most (chosen: fewer than 400 points are too narrow)."""
NEAR_BY = 4
"""So many objects have a view that follows them: a view is some kilobytes in the file (chosen)."""
BESIDE = 4
"""Lanes of so many objects beside each other (chosen: of six configurations all are seen at 720 points)."""
BESIDE_LISTS = 2
"""And of so many where lanes of lists are under them (chosen: thirteen lanes fit into the height at 720 points)."""
MANY = 4
"""More lanes than this need half of the height (chosen)."""


@dataclass(frozen=True)
class Content:
    """What one file shows: a run, its configurations in order, and the shown objects, the most telling first.

    `episodes`: the rows of the table by object; `axes_s`: from when to when each is looked at.
    `eye` follows the ego, if there is one, `eyes` the objects; `above` looks at the units, of which `named` have names.
    `lists`: what became of those that units send by a link, by configuration, where there is one.
    """

    replay: Replay
    experiment: Experiment
    table: pd.DataFrame
    episodes: Mapping[int, pd.DataFrame]
    configurations: Sequence[str]
    objects: Sequence[int]
    axes_s: Mapping[int, tuple[float, float]]
    eye: Eye
    eyes: Sequence[Eye]
    above: Eye
    named: Sequence[str]
    lists: Mapping[str, Sequence[UnitLists]]
    baseline: str | None = None

    def id_of(self, object_ix: int) -> str:
        """As it is drawn, with its class."""
        return f"{short_ids(self.replay.scene)[object_ix]} {CLASSES[self.replay.scene.object_class[object_ix]]}"

    def axis(self, object_ix: int) -> rrb.TimeAxis:
        """From half a second before its onset to half a second after it was last detected."""
        return time_axis(*self.axes_s[object_ix])

    def under(self, object_ix: int) -> list[str]:
        """Lanes of lists that are under those of an object."""
        return [path_of(*path) for path in shown_under(self.lists, self.axes_s[object_ix])]

    def heard(self, configuration: str) -> tuple[str, ...]:
        """The units of a configuration."""
        return self.experiment.units_of(self.experiment.configurations[configuration])


def time_axis(first_s: float, last_s: float) -> rrb.TimeAxis:
    """From and to, at first."""
    import rerun.blueprint as rrb

    bound = rrb.TimeRangeBoundary.absolute
    return rrb.TimeAxis(view_range=rrb.TimeRange(start=bound(seconds=first_s), end=bound(seconds=last_s)))


def overview(of: Content) -> rrb.Container:
    """The fused tracks of each, over when it knew and what difference that made."""
    import rerun.blueprint as rrb

    views, below, shares = list[rrb.View](believes(of)), list[rrb.Container | rrb.View]([difference()]), [4.0]
    if of.objects:
        below.insert(0, rrb.Tabs(*(lanes(of, k) for k in of.objects)))
        shares.append(4.0)
    across = columns(len(views))
    if len(views) % across:
        views.append(legend())  # into the free cell
    else:
        below[-1] = rrb.Tabs(difference(), legend())
    return rrb.Vertical(
        rrb.Grid(*views, grid_columns=across),
        rrb.Horizontal(*below, column_shares=shares),
        row_shares=[3, 2] if len(of.configurations) <= MANY else [11, 10],
        name="Overview",
    )


def who_knew_when(of: Content) -> rrb.Container:
    """Lanes of every object, each from just before its onset to just after the last detection."""
    import rerun.blueprint as rrb

    beside = BESIDE_LISTS if any(of.under(k) for k in of.objects) else BESIDE
    groups = [of.objects[k : k + beside] for k in range(0, len(of.objects), beside)]
    grids = [
        rrb.Grid(
            *(lanes(of, k, of.under(k)) for k in group),
            grid_columns=min(len(group), 2),
            name=", ".join(map(of.id_of, group)),
        )
        for group in groups
    ]
    return rrb.Horizontal(
        grids[0] if len(grids) == 1 else rrb.Tabs(*grids), difference(), column_shares=[3, 2], name="Who knew when"
    )


def why_not_earlier(of: Content) -> rrb.Container:
    """An object from near by, as the configurations that knew it last and first have it; and reasons."""
    import rerun.blueprint as rrb

    pages = []
    for k, eye in zip(of.objects[:NEAR_BY], of.eyes, strict=False):
        views = [
            world_view(of, name, title, eye, units=of.heard(name), fields=True) for name, title in _last_to_first(of, k)
        ]
        origin = path_of("plots", "visible_share", entity_names(of.replay.scene)[k])
        share = _plot(origin, "Visible share (white: ego, grey: any unit)", of.axis(k), values=(-0.05, 1.05))
        below = rrb.Horizontal(lanes(of, k), share, column_shares=[3, 2])
        pages.append(rrb.Vertical(rrb.Horizontal(*views), below, row_shares=[3, 2], name=of.id_of(k)))
    return rrb.Tabs(*pages, name="Why not earlier")


def _last_to_first(of: Content, object_ix: int) -> list[tuple[str, str]]:
    """Of those that perceive: which knew an object last, or never, and first."""
    episodes = of.episodes[object_ix]
    own = [name for name in of.configurations if of.experiment.configurations[name].units != TRUTH]
    episodes = episodes[episodes["configuration"].isin(own or list(of.configurations))]
    when_s = dict(zip(episodes["configuration"], episodes["time_to_detection_s"].fillna(np.inf), strict=True))
    if not when_s:
        return []
    ranked = sorted(when_s, key=lambda name: when_s[name], reverse=True)
    between = [ranked[len(ranked) // 2]] if len(of.objects) == 1 else []
    chosen = dict.fromkeys([ranked[0], *between, ranked[-1]])
    one = of.id_of(object_ix)
    said = {
        name: f"{name}: {one} known {s:.2f} s after its onset" if np.isfinite(s) else f"{name}: {one} never known"
        for name, s in when_s.items()
    }
    return [(name, said[name]) for name in chosen]


def what_each_believes(of: Content) -> rrb.Container:
    """A view per configuration, as large as they can be."""
    import rerun.blueprint as rrb

    views: list[rrb.View] = list(believes(of, " believes"))
    across = columns(len(views))
    if len(views) % across:
        return rrb.Grid(*views, legend(), grid_columns=across, name="What each believes")
    return rrb.Grid(*views, grid_columns=across, name="What each believes")


def how_far_off(of: Content) -> rrb.Container:
    """Position errors of every shown object, and what holds for all measured ones."""
    import rerun.blueprint as rrb

    names = entity_names(of.replay.scene)
    plots = []
    for k in of.objects:
        kinds = {"position_error": f"{of.id_of(k)}: position error, m"}
        if of.baseline is not None:
            kinds = {"error_difference": f"{of.id_of(k)}: more error than {of.baseline}, m"} | kinds
        views = [_plot(path_of("plots", kind, names[k]), title, of.axis(k)) for kind, title in kinds.items()]
        plots.append(views[0] if len(views) == 1 else rrb.Tabs(*views))
    whole = time_axis(0.0, of.replay.scene.end_s)
    every = [
        _plot("plots/gospa", "GOSPA of all measured objects, m", whole, legend=True),
        _plot("plots/known", "Measured objects known (grey: there are)", whole),
    ]
    if not plots:
        return rrb.Horizontal(*every, name="How far off")
    return rrb.Horizontal(
        rrb.Grid(*plots, grid_columns=min(len(plots), 2)),
        rrb.Vertical(*every),
        column_shares=[5, 3],
        name="How far off",
    )


def where_units_are(of: Content) -> rrb.Container:
    """All units of the configuration that has most of them, from above: fields of view, and what is in its lists."""
    import rerun.blueprint as rrb

    most = max(of.configurations, key=lambda name: len(of.heard(name)))
    units = of.heard(most)
    title = f"In colour: what {most} lists. Grey: the truth. Pale ground: fields of view. Lines: listed it first"
    view = world_view(of, most, title, of.above, units=units, fields=True, named=[n for n in of.named if n in units])
    return rrb.Tabs(view, name="Units")


def in_words() -> rrb.Container:
    """Events, the table over all runs, and what all of it means."""
    import rerun.blueprint as rrb

    # The text names the configuration: the column of entity paths would be cut off.
    kinds = [rrb.encodings.TextLogColumn(kind) for kind in ("LogLevel", "Body")]
    return rrb.Horizontal(
        rrb.TextLogView(origin="events", name="Events", columns=rrb.TextLogColumns(text_log_columns=kinds)),
        rrb.Tabs(
            rrb.TextDocumentView(origin="summary", name="Summary of all runs"),
            rrb.TextDocumentView(origin="words", name="What all of it means"),
        ),
        name="In words",
    )


def believes(of: Content, said: str = "") -> list[rrb.Spatial3DView]:
    """The fused tracks of each configuration, from the ego's side."""
    alone = len(of.objects) == 1
    return [world_view(of, name, name + said, of.eye, units=of.heard(name), marks=alone) for name in of.configurations]


def columns(views: int) -> int:
    """How many of so many views are beside each other."""
    return SMALL if views in (3, 5, 6) else min(views, 2)


def world_view(
    of: Content, configuration: str, title: str, eye: Eye, *, units: Sequence[str], fields: bool = False,
    marks: bool = False, named: Sequence[str] = (),
) -> rrb.Spatial3DView:  # fmt: skip
    """The world as one configuration has it, with its own units; and what the eye follows.

    `marks`: lines to where objects were when they were first known, which stay.
    """
    import rerun as rr
    import rerun.blueprint as rrb

    kinds = ("units", "fields") if fields else ("units",)
    own = [f"+ {path_of('world', kind, unit)}" for unit in units for kind in kinds]
    part = path_of("world", part_of(configuration))
    own += [f"+ {part}/**"] if marks else [f"+ {part}/**", f"- {part}/marks/**"]
    shown = rr.Points3D.from_fields(show_labels=True)
    own += [f"- {part}/status"] if named else []  # the names are the labels there
    return rrb.Spatial3DView(
        origin=path_of(*eye.path),
        name=title,
        contents=["+ world/truth/**", "+ world/static/**", *own],
        eye_controls=rrb.EyeControls3D(
            position=eye.place_m.tolist(), look_target=eye.target_m.tolist(), eye_up=(0, 0, 1)
        ),
        overrides={path_of("world", "units", unit): shown for unit in named},
        line_grid=False,
        background=GROUND,
    )


def lanes(of: Content, object_ix: int, under: Sequence[str] = ()) -> rrb.StateTimelineView:
    """The lanes of one object, and what is under them."""
    import rerun.blueprint as rrb

    scene, onset_s = of.replay.scene, float(of.episodes[object_ix]["onset_s"].iloc[0])
    return rrb.StateTimelineView(
        origin=path_of(*lanes_of(scene, object_ix)),
        contents=["+ $origin/**", *(f"+ {path}" for path in under)] if under else "$origin/**",
        name=f"{of.id_of(object_ix)}, onset {onset_s:.1f} s",
        time_view=of.axis(object_ix),
    )


def difference() -> rrb.TextDocumentView:
    """The table of times."""
    import rerun.blueprint as rrb

    return rrb.TextDocumentView(origin="difference", name="What difference it made")


def legend() -> rrb.Spatial2DView:
    """The colours of configurations."""
    import rerun.blueprint as rrb

    bounds = rrb.VisualBounds2D(x_range=LEGEND_X, y_range=LEGEND_Y)
    return rrb.Spatial2DView(origin="legend", name="Legend", background=GROUND, visual_bounds=bounds)


def _plot(
    origin: str, title: str, axis: rrb.TimeAxis, *, legend: bool = False, values: tuple[float, float] | None = None
) -> rrb.TimeSeriesView:
    """Curves over time, on the dark ground."""
    import rerun.blueprint as rrb

    return rrb.TimeSeriesView(
        origin=origin,
        name=title,
        axis_x=axis,
        axis_y=None if values is None else rrb.ScalarAxis(range=values),
        plot_legend=rrb.PlotLegend(visible=legend),
        background=rrb.archetypes.PlotBackground(color=GROUND),
    )

"""Blueprint: the layout of a recording in the viewer, with a page per question."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from copem_replay.core.tracks import CLASSES, TRUTH
from copem_replay.experiment.schema import Experiment
from copem_replay.pipeline.false_tracks import describe_false_tracks
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.status import to_nanoseconds
from copem_replay.results.remedy import find_changed_keys, tell_what_helps
from copem_replay.results.shown_objects import SHOWN_OBJECTS, pick_evenly
from copem_replay.viewer.camera import Camera, MovingPicture, follow_episodes
from copem_replay.viewer.lanes import UnitLists, lanes_axis_s, select_list_lanes
from copem_replay.viewer.legend import legend_view
from copem_replay.viewer.map_view import asks_for_map, map_page
from copem_replay.viewer.recorded import RecordedSensors, recorded_page
from copem_replay.viewer.sink import (
    DIFFERENCE_SHORT,
    DIFFERENCE_TEXT,
    ELAPSED,
    GROUND,
    NEAR_WORDS,
    WORDS,
    configuration_part,
    digest_texts,
    entity_names,
    helps_path,
    make_entity_path,
    object_lanes_path,
    short_ids,
    show_seconds,
)

if TYPE_CHECKING:
    import rerun.blueprint as rrb


# Pages.

SMALL = 3
"""Most views beside each other: a view narrower than 400 points is too small."""
NEAR_BY = SHOWN_OBJECTS
"""Most objects with views that follow them: each of those shown."""
SHARE_TITLE = "Visible share (white: ego, grey: any, x: out of view)"
BESIDE = 4
"""Objects with lanes on one page: the lanes of seven configurations fit into a height of 720 points."""
BESIDE_LISTS = 2
"""Objects on one page if lanes of lists are under theirs: thirteen lanes fit into a height of 720 points."""
MASTS = 2
"""Most units with names in a view with words below objects."""
MANY = 4
"""More configurations than this need half of a page's height for their lanes."""
OVERVIEW, FEW = 4, 3
"""Most views of the overview, and the number from which they are in two columns: each at least 400 × 200 points."""
OVERVIEW_SHARES = (2.1, 1.0)
"""Widths of the overview's views and of what is beside them."""
LARGE_ASPECT = 1.5
"""Width by height of one view in the place of the overview's, and of one of four there, in a window of 1280 × 720."""


@dataclass(frozen=True)
class RecordingContent:
    """What one file shows: a run, its configurations in order, and the shown objects, the most telling one first.

    `episodes`: rows of the table by object; `axes_s`: first and last second of each object's axis.
    Camera `eye` follows the ego, if there is one, `large` too, in one large view, `eyes` the objects; `above` looks at
    the units, of which `named` have names. `lists`: lists that units send by a link, by configuration. `too_short`: ids
    of objects too short to judge. `opens_s`: the instant at which the recording opens. `counted`: rows of the table
    that count, of all passes; `false_tracks`, `needless`: those of these tables, None: not known. `brief`: objects that
    are known too briefly for words in a lane. `of_one`: all configurations are of one experiment. `recorded`: what
    sensors recorded, if shown.
    """

    replay: Replay
    experiment: Experiment
    table: pd.DataFrame
    episodes: Mapping[int, pd.DataFrame]
    configurations: Sequence[str]
    objects: Sequence[int]
    axes_s: Mapping[int, tuple[float, float]]
    eye: Camera
    large: Camera
    eyes: Sequence[Camera]
    above: Camera
    named: Sequence[str]
    lists: Mapping[str, Sequence[UnitLists]]
    baselines: tuple[str, ...] = ()
    too_short: Sequence[str] = ()
    opens_s: float | None = None
    counted: pd.DataFrame | None = None
    false_tracks: pd.DataFrame | None = None
    needless: pd.DataFrame | None = None
    brief: Collection[int] = ()
    of_one: bool = True
    recorded: RecordedSensors | None = None

    def id_of(self, object_ix: int) -> str:
        """Id of an object as drawn, with its class."""
        return f"{short_ids(self.replay.scene)[object_ix]} {CLASSES[self.replay.scene.object_class[object_ix]]}"

    def axis(self, object_ix: int) -> rrb.TimeAxis:
        """The time axis of an object's curves."""
        return make_time_axis(*self.axes_s[object_ix])

    def lanes_axis_s(self, object_ix: int) -> tuple[float, float]:
        """First and last second of an object's lanes."""
        onset_s = float(self.episodes[object_ix]["onset_s"].iloc[0])
        return lanes_axis_s(self.axes_s[object_ix], onset_s, self.configurations, object_ix in self.brief)

    def title(self, configuration: str, mark: str = " · ") -> str:
        """“bursty · whole run: 18 of 24 known, 3 false, brakes 1× for nothing”; `mark`: what follows the name. Counts
        objects that count, in all their passes, false tracks and needless braking, each where it is known.
        """
        counted, false, needless = (
            None if of is None else of[of["configuration"] == configuration]
            for of in (self.counted, self.false_tracks, self.needless)
        )
        counts = (
            [f"{counted['detected'].sum()} of {len(counted)} known"] if counted is not None and len(counted) else []
        )
        counts += [f"{len(false)} false"] if false is not None else []
        counts += [f"brakes {len(needless)}× for nothing"] if needless is not None and len(needless) else []
        return f"{configuration}{mark}whole run: {', '.join(counts)}" if counts else configuration

    def tell_false(self) -> str:
        """The false tracks of each configuration in Markdown, the longest first."""
        if self.false_tracks is None:
            return "False tracks are not known: `accuracy: false`, or configurations are compared."
        parts = [
            f"**{name}**: {describe_false_tracks(self.false_tracks[self.false_tracks['configuration'] == name])}"
            for name in self.configurations
        ]
        return "\n\n".join(["False tracks, about nobody, of this run, the longest first", *parts])

    def follow(self, eye: Camera) -> MovingPicture:
        """The picture of a camera that moves, with named masts: around one object, or around the ego and all."""
        stories = {k: span for k, span in self.axes_s.items() if eye.turns or k == eye.object_ix}
        masts = {k: {name for of in self.configurations for name in self.named_masts(of, [k])} for k in stories}
        return follow_episodes(self.replay, self.experiment, eye, stories, masts)

    def helps(self, object_ix: int) -> str:
        """The sentence on what would help with an object; “” where PEMs of several experiments may differ."""
        rows = self.episodes[object_ix]
        rows = rows[rows["configuration"].isin(list(self.configurations))]
        return tell_what_helps(self.experiment, rows) if self.of_one else ""

    def under(self, object_ix: int) -> list[str]:
        """The entities of list lanes that stand under an object's lanes."""
        return [make_entity_path(*path) for path in select_list_lanes(self.lists, self.axes_s[object_ix])]

    def received(self, configuration: str) -> tuple[str, ...]:
        """The units of a configuration, by name."""
        return self.experiment.units_of(self.experiment.configurations[configuration])

    def named_masts(self, configuration: str, objects: Sequence[int]) -> list[str]:
        """Named units beside the ego's: those that first listed an object in a configuration, else the nearest."""
        told = (self.episodes[k] for k in objects)
        first = [unit for rows in told for unit in rows.loc[rows["configuration"] == configuration, "first_unit"]]
        units, heard = self.experiment.units, self.received(configuration)
        known = (
            [name for name in dict.fromkeys(of) if name in heard and units[name].on != "ego"][:MASTS]
            for of in (first, self.named)
        )
        return next(filter(None, known), [])

    @property
    def with_map(self) -> bool:
        """Whether there is a page with a map of the world."""
        return self.replay.scene.frame is not None and asks_for_map(self.experiment)

    @property
    def selected_ns(self) -> tuple[int, int]:
        """The selected span of time, ns since the log's start: from the first onset to the end."""
        first_s = float(self.table["onset_s"].min()) if len(self.table) else 0.0
        first_s = first_s if self.opens_s is None or not self.baselines else self.opens_s
        scene, first_ns = self.replay.scene, int(to_nanoseconds(first_s))
        return first_ns, max(scene.end_ns - scene.t0_ns, first_ns)


def make_time_axis(first_s: float, last_s: float) -> rrb.TimeAxis:
    """A time axis that first shows these seconds."""
    import rerun.blueprint as rrb

    bound = rrb.TimeRangeBoundary.absolute
    return rrb.TimeAxis(view_range=rrb.TimeRange(start=bound(seconds=first_s), end=bound(seconds=last_s)))


def overview_page(content: RecordingContent) -> rrb.Container:
    """The fused tracks of four configurations at most; beside them lanes, and the table of times to detection."""
    import rerun.blueprint as rrb

    views = list[rrb.View](tracks_views(content, choose_overview(content)))
    columns = 1 if len(views) < FEW else 2
    words: list[rrb.View] = [difference_view(DIFFERENCE_SHORT)]
    (views if len(views) % columns else words).append(legend_view())  # into the free cell, if there is one
    return _page_with_lanes(content, rrb.Grid(*views, grid_columns=columns), words, "Overview")


def _page_with_lanes(
    content: RecordingContent, scenes: rrb.View | rrb.Container, words: Sequence[rrb.View], name: str
) -> rrb.Container:
    """Scenes, beside them the lanes of each object in tabs, and views with words below."""
    import rerun.blueprint as rrb

    lanes = [rrb.Tabs(*(lanes_view(content, k) for k in content.objects))] if content.objects else []
    beside = rrb.Vertical(*lanes, rrb.Tabs(*words))
    return rrb.Horizontal(scenes, beside, column_shares=list(OVERVIEW_SHARES), name=name)


def side_by_side_page(content: RecordingContent, early: str, late: str) -> rrb.Container:
    """Two configurations in one scene, `early` with solid boxes, `late` in outlines; beside it as in the overview."""
    units = tuple(dict.fromkeys((*content.received(early), *content.received(late))))
    scene = world_view(
        content, late, f"Solid: {early} · outlines: {late} · grey: the truth", content.large, units=units, solid=early,
        named=content.named_masts(early, content.objects) or content.named_masts(late, content.objects),
    )  # fmt: skip
    return _page_with_lanes(content, scene, [difference_view(DIFFERENCE_SHORT), legend_view()], "Side by side")


def choose_pair(content: RecordingContent) -> tuple[str, ...]:
    """Two configurations for one scene: where the recording opens, one knows an object and the other not yet. Of
    several pairs the first with fewest other keys; without a difference the first two; () for fewer.
    """
    names, opens_s = select_perceiving(content.experiment, content.configurations), content.opens_s
    for k in content.objects:
        rows = content.episodes[k]
        known = set(rows.loc[rows["detection_s"] <= opens_s, "configuration"])
        pairs = [(a, b) for a in names for b in names if a in known and b not in known]
        if pairs:
            return min(pairs, key=lambda pair: len(find_changed_keys(content.experiment, *pair)))
    return tuple(names[:2]) if len(names) > 1 else ()


def choose_overview(content: RecordingContent) -> list[str]:
    """The configurations of the overview: all with units, of more than four the baseline and those that differ most.

    The baseline is the first one with units, unless configurations are compared with another. The rest is spread evenly
    from the one that knows the shown objects first to the one that knows them last. Of several baselines the first
    stand beside what is held against them.
    """
    perceiving = select_perceiving(content.experiment, content.configurations)
    if len(perceiving) <= OVERVIEW or len(content.baselines) > 1:
        return perceiving[:OVERVIEW]
    rows = content.table[content.table["object_id"].isin([content.replay.scene.object_ids[k] for k in content.objects])]
    after_s = rows["time_to_detection_s"].fillna(rows["ended_s"] - rows["onset_s"])
    mean_s = after_s.groupby(rows["configuration"]).mean()
    baseline = next((name for name in content.baselines if name in perceiving), perceiving[0])
    ranked = sorted((name for name in perceiving if name != baseline), key=lambda name: float(mean_s.get(name, 0.0)))
    chosen = pick_evenly(ranked, OVERVIEW, [baseline])
    return [name for name in perceiving if name in chosen]


def lanes_page(content: RecordingContent) -> rrb.Container:
    """The lanes of every shown object, with those of lists, and the table of times to detection."""
    import rerun.blueprint as rrb

    beside = BESIDE_LISTS if any(content.under(k) for k in content.objects) else BESIDE
    groups = [content.objects[k : k + beside] for k in range(0, len(content.objects), beside)]
    grids = [
        rrb.Grid(
            *(lanes_view(content, k, content.under(k)) for k in group),
            grid_columns=min(len(group), 2),
            name=", ".join(map(content.id_of, group)),
        )
        for group in groups
    ]
    return rrb.Horizontal(
        grids[0] if len(grids) == 1 else rrb.Tabs(*grids),
        difference_view(DIFFERENCE_TEXT),
        column_shares=[3, 2],
        name="Who knew when",
    )


def reasons_page(content: RecordingContent) -> rrb.Container:
    """Per object close views of the configurations that knew it last and first, with its lanes and visible share."""
    import rerun.blueprint as rrb

    pages = []
    for k, eye in zip(content.objects[:NEAR_BY], content.eyes, strict=False):
        views = [
            world_view(
                content,
                name,
                title,
                eye,
                units=content.received(name),
                fields=True,
                named=content.named_masts(name, [k]),
            )
            for name, title in _last_and_first(content, k)
        ]
        origin = make_entity_path("plots", "visible_share", entity_names(content.replay.scene)[k])
        share = _curves_view(origin, SHARE_TITLE, content.axis(k), values=(-0.05, 1.05))
        right_side: rrb.View | rrb.Container = share
        if content.helps(k):
            origin = make_entity_path(*helps_path(content.replay.scene, k))
            helps = rrb.TextDocumentView(origin=origin, name="What would help")
            right_side = rrb.Vertical(share, helps, row_shares=[2, 1])
        lower_row = rrb.Horizontal(lanes_view(content, k), right_side, column_shares=[3, 2])
        first_s, last_s = content.axes_s[k]
        name = f"{short_ids(content.replay.scene)[k]} · {first_s:.1f}–{last_s:.1f} s"
        rows = [3, 2] if len(content.configurations) <= MANY else [1, 1]
        pages.append(rrb.Vertical(rrb.Horizontal(*views), lower_row, row_shares=rows, name=name))
    return rrb.Tabs(*pages, name="Why not earlier")


def _last_and_first(content: RecordingContent, object_ix: int) -> list[tuple[str, str]]:
    """Names and titles of the configurations with units that knew an object last (or never) and first; for a single
    shown object also of the middle one.
    """
    episodes = content.episodes[object_ix]
    episodes = episodes[episodes["configuration"].isin(select_perceiving(content.experiment, content.configurations))]
    when_s = dict(zip(episodes["configuration"], episodes["time_to_detection_s"].fillna(np.inf), strict=True))
    if not when_s:
        return []
    ranked = sorted(when_s, key=lambda name: when_s[name], reverse=True)
    middle_name = [ranked[len(ranked) // 2]] if len(content.objects) == 1 else []
    names = dict.fromkeys([ranked[0], *middle_name, ranked[-1]])
    titles = {
        name: f"{name}: known after {show_seconds(s)} s" if np.isfinite(s) else f"{name}: never known"
        for name, s in when_s.items()
    }
    return [(name, titles[name]) for name in names]


def tracks_page(content: RecordingContent) -> rrb.Container:
    """A view per configuration, as large as possible."""
    import rerun.blueprint as rrb

    views: list[rrb.View] = list(tracks_views(content, content.configurations, ", "))
    columns = count_columns(len(views))
    if len(views) % columns:
        return rrb.Grid(*views, legend_view(), grid_columns=columns, name="What each believes")
    return rrb.Grid(*views, grid_columns=columns, name="What each believes")


def errors_page(content: RecordingContent) -> rrb.Container:
    """Position errors of every shown object; GOSPA and number of known objects over all measured ones."""
    import rerun.blueprint as rrb

    names = entity_names(content.replay.scene)
    plots = []
    for k in content.objects:
        kinds = {"position_error": f"{content.id_of(k)}: position error, m"}
        if content.baselines:
            baseline = content.baselines[0] if len(content.baselines) == 1 else "before"
            kinds = {"error_difference": f"{content.id_of(k)}: more error than {baseline}, m"} | kinds
        views = [
            _curves_view(make_entity_path("plots", kind, names[k]), title, content.axis(k))
            for kind, title in kinds.items()
        ]
        plots.append(views[0] if len(views) == 1 else rrb.Tabs(*views))
    all_time = make_time_axis(0.0, content.replay.scene.end_s)
    overall = [
        _curves_view("plots/gospa", "GOSPA of all measured objects, m", all_time, legend=True),
        _curves_view("plots/known", "Measured objects known (grey: there are)", all_time),
    ]
    if not plots:
        return rrb.Horizontal(*overall, name="How far off")
    return rrb.Horizontal(
        rrb.Grid(*plots, grid_columns=min(len(plots), 2)),
        rrb.Vertical(*overall),
        column_shares=[5, 3],
        name="How far off",
    )


def units_page(content: RecordingContent) -> rrb.Container:
    """The configuration with most units from above: units, fields of view, fused tracks; and all recorded units."""
    import rerun.blueprint as rrb

    largest = max(content.configurations, key=lambda name: len(content.received(name)))
    units = content.received(largest)
    placed = [name for name, unit in content.experiment.units.items() if unit.pem is None]
    title = f"In colour: what {largest} lists. Grey: the truth. Pale ground: fields of view. Lines: listed it first"
    units = (*units, *(name for name in placed if name not in units))
    view = world_view(
        content, largest, title, content.above, units=units, fields=True, quiet=True,
        named=[name for name in content.named if name in units],
    )  # fmt: skip
    return rrb.Tabs(view, name="Units")


def text_page() -> rrb.Container:
    """Events, the summary of all runs, and the legend in words."""
    import rerun.blueprint as rrb

    # The text names the configuration, since the column of entity paths would be cut off.
    kinds = [rrb.encodings.TextLogColumn(kind) for kind in ("LogLevel", "Body")]
    return rrb.Horizontal(
        rrb.TextLogView(origin="events", name="Events", columns=rrb.TextLogColumns(text_log_columns=kinds)),
        rrb.Tabs(
            rrb.TextDocumentView(origin="summary", name="Summary of all runs"),
            rrb.TextDocumentView(origin="false", name="False tracks"),
            rrb.TextDocumentView(origin="words", name="What all of it means"),
        ),
        name="In words",
    )


def tracks_views(
    content: RecordingContent, configurations: Sequence[str], mark: str = " · "
) -> list[rrb.Spatial3DView]:
    """A view of the fused tracks of each of these configurations, around the ego, with arrows to objects outside it.

    `mark`: in their titles, by which views of two pages are told apart.
    """
    marks = len(content.objects) == 1
    return [
        world_view(
            content, name, content.title(name, mark), content.eye, units=content.received(name), marks=marks,
            named=content.named_masts(name, content.objects),
        )
        for name in configurations
    ]  # fmt: skip


def count_columns(views: int) -> int:
    """The number of columns of this many views on a page of their own."""
    return SMALL if views == 3 or views > 4 else min(views, 2)


def world_view(
    content: RecordingContent, configuration: str, title: str, eye: Camera, *, units: Sequence[str],
    fields: bool = False, marks: bool = False, named: Sequence[str] = (), quiet: bool = False, solid: str = "",
) -> rrb.Spatial3DView:  # fmt: skip
    """A view of truth and one configuration, with `units` as points and, with `fields`, their fields of view.

    `marks`: with the lasting lines to the places of objects at their detection. `named`: units with visible names.
    `quiet`: these are the only labels. `solid`: another configuration in the same scene, without words: its boxes are
    solid, and the others outlines.
    """
    import rerun as rr
    import rerun.blueprint as rrb

    kinds = ("units", "fields") if fields else ("units",)
    contents = [f"+ {make_entity_path('world', kind, unit)}" for unit in units for kind in kinds]
    part = make_entity_path("world", configuration_part(configuration))
    contents += [f"+ {part}/**"] if marks else [f"+ {part}/**", f"- {part}/marks/**"]
    shown = rr.Points3D.from_fields(show_labels=True)
    near = not eye.turns and eye.object_ix is not None
    # Words of the other pictures would lie over bodies.
    contents += [f"- {part}/{words}" for words in (WORDS, NEAR_WORDS) if quiet or (words == WORDS) == near]
    overrides: dict[Any, Any] = {make_entity_path("world", "units", unit): shown for unit in named}
    if solid:
        other, modes = make_entity_path("world", configuration_part(solid)), rr.components.FillMode
        contents += [f"+ {other}/**", *(f"- {other}/{kind}" for kind in ("marks/**", WORDS, NEAR_WORDS))]
        contents += [f"- {path}/covariance" for path in (part, other)]
        overrides[f"{other}/boxes"] = rr.Boxes3D.from_fields(fill_mode=modes.Solid)
        overrides[f"{part}/boxes"] = rr.Boxes3D.from_fields(fill_mode=modes.MajorWireframe)
    if eye.turns:
        on_edge = ["arrows"], ["false", configuration_part(configuration)]
        contents += [f"+ {make_entity_path(*eye.path, *entity)}" for entity in on_edge]
    return rrb.Spatial3DView(
        origin=make_entity_path(*eye.path),
        name=title,
        contents=["+ world/truth/**", "+ world/static/**", *contents],
        eye_controls=rrb.EyeControls3D(
            position=eye.place_m.tolist(), look_target=eye.target_m.tolist(), eye_up=(0, 0, 1)
        ),
        overrides=overrides,
        line_grid=False,
        background=GROUND,
    )


def lanes_view(content: RecordingContent, object_ix: int, under: Sequence[str] = ()) -> rrb.StateTimelineView:
    """The view of one object's lanes, and of the entities `under` them."""
    import rerun.blueprint as rrb

    scene, onset_s = content.replay.scene, float(content.episodes[object_ix]["onset_s"].iloc[0])
    return rrb.StateTimelineView(
        origin=make_entity_path(*object_lanes_path(scene, object_ix)),
        contents=["+ $origin/**", *(f"+ {path}" for path in under)] if under else "$origin/**",
        name=f"{content.id_of(object_ix)}, from {onset_s:.1f} s",
        time_view=make_time_axis(*content.lanes_axis_s(object_ix)),
    )


def difference_view(path: Sequence[str]) -> rrb.TextDocumentView:
    """The view of the table of times to detection at an entity."""
    import rerun.blueprint as rrb

    return rrb.TextDocumentView(origin=make_entity_path(*path), name="What difference it made")


def _curves_view(
    origin: str, title: str, axis: rrb.TimeAxis, *, legend: bool = False, values: tuple[float, float] | None = None
) -> rrb.TimeSeriesView:
    """A view of curves over time on a dark ground; `values`: range of the vertical axis, None: as the curves are."""
    import rerun.blueprint as rrb

    return rrb.TimeSeriesView(
        origin=origin,
        name=title,
        axis_x=axis,
        axis_y=None if values is None else rrb.ScalarAxis(range=values),
        plot_legend=rrb.PlotLegend(visible=legend),
        background=rrb.archetypes.PlotBackground(color=GROUND),
    )


LAYOUT = 8
"""Version of the blueprint, raised with every change: a viewer prefers the one it has kept for an application id."""


def build_blueprint(content: RecordingContent) -> rrb.Blueprint:
    """The blueprint."""
    import rerun.blueprint as rrb

    pages = [overview_page(content)]
    if content.objects:
        two = [side_by_side_page(content, *pair)] if (pair := choose_pair(content)) else []
        pages += [lanes_page(content), *two, reasons_page(content)]
    pages += [tracks_page(content), errors_page(content)]
    if any(content.received(name) for name in content.configurations):
        pages.append(units_page(content))
    pages += [map_page()] if content.with_map else []
    if content.recorded is not None and content.recorded.images + content.recorded.points:
        pages.append(recorded_page(content.recorded, content.eye, choose_overview(content)[0]))
    pages.append(text_page())
    # A blueprint cannot set the time cursor, but playing begins with the selection: at the first onset.
    panel = rrb.TimePanel(
        timeline=ELAPSED,
        play_state="playing" if content.baselines else "paused",
        loop_mode="selection",
        state="collapsed",
        time_selection=rrb.components.AbsoluteTimeRange(*content.selected_ns),
    )
    return rrb.Blueprint(
        rrb.Tabs(*pages, active_tab=0),
        panel,
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_layout=False,
        auto_views=False,
    )


def digest_layout(content: RecordingContent) -> str:
    """A digest of everything that the blueprint depends on, but for counts in its titles."""
    scene = content.replay.scene
    eyes = [
        (eye.place_m.tolist(), eye.target_m.tolist(), eye.object_ix)
        for eye in (content.eye, content.large, *content.eyes, content.above)
    ]
    parts = (
        LAYOUT,
        list(content.configurations),
        [content.received(name) for name in content.configurations],
        [scene.object_ids[k] for k in content.objects],
        eyes,
        [content.axes_s[k] for k in content.objects],
        list(content.named),
        *content.selected_ns,
        content.baselines or None,
        choose_pair(content),
        [content.title(name) for name in content.configurations],
        *([under] if any(under := [content.under(k) for k in content.objects]) else []),
        *(["map"] if content.with_map else []),
        *([content.recorded.images, content.recorded.points] if content.recorded is not None else []),
    )
    return digest_texts(repr(parts))


def view_aspect(experiment: Experiment, configurations: Sequence[str]) -> float:
    """Width by height of a view of the overview in a window of 1280 × 720: two views are one above the other."""
    return 3.0 if len(select_perceiving(experiment, configurations)) == FEW - 1 else LARGE_ASPECT


def select_perceiving(experiment: Experiment, configurations: Sequence[str]) -> list[str]:
    """The configurations that have units; all, if none does."""
    perceiving = [name for name in configurations if experiment.configurations[name].units != TRUTH]
    return perceiving or list(configurations)

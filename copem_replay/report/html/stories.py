"""Stories: what happened to single objects, the latest and those on which configurations differ most.

Each is of one object in the run of the recordings for viewers: the plan at its onset, when the first configuration
knows it and when the last does, the lanes of all, and a sentence of why. Plans need the recording.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from copem_replay.core.errors import InputError, RecordingError
from copem_replay.core.interpolation import AROUND_S, interpolate_at_instants
from copem_replay.core.tracks import CLASSES, SAME_INSTANT_S, Float, Tracks
from copem_replay.experiment.schema import Unit
from copem_replay.metrics.detections_table import first_episodes
from copem_replay.perception.sensor_poses import (
    UnitPoses,
    collect_solids,
    compute_unit_poses,
    find_carrier,
    make_observers,
    make_solid_statics,
    unit_ground,
)
from copem_replay.perception.visibility import box_corners, find_blockers
from copem_replay.report.figures.paths import Drive, find_latest_log, read_drive
from copem_replay.report.figures.selection import pick_evenly
from copem_replay.report.figures.style import shorten_names
from copem_replay.report.html.markup import Html, css_colour, make_tag, replace_greys
from copem_replay.report.html.study import NO_RECORDING, ReportData
from copem_replay.report.html.why import why_late

MOST_STORIES = 6
"""Half of them the latest objects, half those on which configurations differ most."""
JUDGED_S = 2.0
"""An episode that is shorter is too short to judge, if there are longer ones."""
_LANES = 6


def story_parts(study: ReportData) -> list[Html]:
    """Stories of up to `MOST_STORIES` objects of the drive on which objects stay unknown longest."""
    log = find_latest_log(study.results)
    run = study.results.provenance.run_shown.get(log, 0)
    rows = _rows_of_run(study, log, run)
    chosen = choose_stories(rows)
    if not chosen:
        return [make_tag("p", f"Every configuration knows every object of {log} at its onset (run {run}).")]
    try:
        drive = read_drive(study.results, log)
    except RecordingError:
        return [make_tag("p", f"No plans of {log}: {NO_RECORDING}.")]
    stories = [ObjectStory(study, drive, rows[rows["object_id"] == name]) for name in chosen]
    several = len(study.results.provenance.logs) > 1
    said = f"Run {run} of {log}, the longest unknown first, then those on which configurations differ most."
    parts = [make_tag("p", said)]
    for story, why in zip(stories, chosen.values(), strict=True):
        parts.append(_story_element(story, why, log if several else None))
    return parts


def _rows_of_run(study: ReportData, log: str, run: int) -> pd.DataFrame:
    """Rows that count of one run, without the truth, with the seconds that objects stay unknown."""
    (rows,) = study.results.each(log=log)
    rows = first_episodes(rows[(rows["run"] == run) & rows["configuration"].isin(study.contenders)])
    unknown_s = rows["time_to_detection_s"].fillna(rows["ended_s"] - rows["onset_s"]).clip(lower=0.0)
    return rows.assign(unknown_s=unknown_s)


def choose_stories(rows: pd.DataFrame) -> dict[str, str]:
    """Ids of the objects whose stories are told, with why: half by the mean time unknown, half by its spread.

    `rows`: of one run, with `unknown_s`. Objects that all know at the onset have no story; short ones if all are.
    """
    of = rows.groupby("object_id", sort=False)
    table = pd.DataFrame({"mean": of["unknown_s"].mean(), "apart": of["unknown_s"].max() - of["unknown_s"].min()})
    long = (of["ended_s"].max() - of["onset_s"].min()) >= JUDGED_S
    table = table[table["mean"] > SAME_INSTANT_S]
    table = table[long[table.index]] if long[table.index].any() else table
    latest = table.sort_values(["mean", "apart"], ascending=False, kind="stable").index
    furthest = table[table["apart"] > SAME_INSTANT_S].sort_values("apart", ascending=False, kind="stable").index
    half = MOST_STORIES // 2
    chosen = dict.fromkeys(map(str, latest[:half]), "unknown longest")
    return chosen | dict.fromkeys([str(name) for name in furthest if name not in chosen][:half], "differs most")


# Facts of a story.


@dataclass(frozen=True)
class ObjectStory:
    """One object in one run. `rows`: of its first episode, a row per configuration, with `unknown_s`."""

    study: ReportData
    drive: Drive
    rows: pd.DataFrame

    @property
    def name(self) -> str:
        """`pedestrian 61`."""
        return f"{self.rows['object_class'].iloc[0]} {self.object_id}"

    @property
    def object_id(self) -> str:
        """The id of the object."""
        return str(self.rows["object_id"].iloc[0])

    @property
    def onset_s(self) -> float:
        """The onset, in seconds since the log's start."""
        return float(self.rows["onset_s"].iloc[0])

    @property
    def short(self) -> dict[str, str]:
        """Short names of the configurations."""
        return shorten_names([str(name) for name in self.rows["configuration"]])

    @property
    def first(self) -> Any:
        """The row of the configuration that knows it first; of equal ones the first."""
        return self.rows.loc[self.rows["unknown_s"].idxmin()]

    @property
    def last(self) -> Any:
        """The row of the configuration that knows it last, or never."""
        return self.rows.loc[self.rows["unknown_s"].idxmax()]

    def known_s(self, row: Any) -> float:
        """When a configuration knows it; when its episode ends, if it never does."""
        return float(row["detection_s"] if row["detected"] else row["ended_s"])

    @property
    def blind(self) -> Any:
        """The row of the configuration whose units have it in sight last, or know it last."""
        return self.rows.loc[self.rows.apply(self.hidden_s, axis=1).iloc[::-1].idxmax()]

    def hidden_s(self, row: Any) -> float:
        """For how long after the onset a configuration has it in no list in sight, at most until one that counts."""
        seen_s = float(row["in_sight_s"])
        if not self.drive.experiment.units_of(self.drive.experiment.configurations[row["configuration"]]):
            return 0.0  # what units of a recorded output see is not known
        listed_s = float(row["captured_s"]) if row["detected"] else self.known_s(row)
        return (
            max(float(np.fmin(seen_s, listed_s)) - self.onset_s, 0.0)
            if seen_s == seen_s or not row["detected"]
            else 0.0
        )

    def blind_unit(self) -> str | None:
        """The unit from which that configuration should have seen it: a carried one, else its first one."""
        experiment = self.drive.experiment
        names = experiment.units_of(experiment.configurations[self.blind["configuration"]])
        modelled = [name for name in names if name in experiment.modelled]
        own = [name for name in modelled if find_carrier(self.drive.scene, experiment.modelled[name]) >= 0]
        return next(iter([*own, *modelled]), None)


def find_hider(story: ObjectStory) -> tuple[str, int] | None:
    """The body that hides most of the object from its blind unit at the onset: words, and its object (−1: a solid).

    None: nothing does, or it cannot be told.
    """
    unit_name = story.blind_unit()
    if unit_name is None:
        return None
    drive, unit = story.drive, story.drive.experiment.modelled[unit_name]
    world = world_at(drive, story.onset_s)
    solids = collect_solids(drive.scene, drive.truth, drive.experiment.obstacles)
    rows = np.flatnonzero(world.row_object_ix == drive.scene.object_number[story.object_id])
    poses = unit_pose(drive, unit_name, unit, world)
    if not len(rows) or not poses.present.any():
        return None
    observers = make_observers([poses], np.array([find_carrier(drive.scene, unit)]))
    try:
        [blockers] = find_blockers(world, make_solid_statics(solids), observers, drive.experiment.visibility)
    except InputError:  # a model of the user's own that cannot tell
        return None
    body = int(blockers[rows[0]])
    if body == -1:
        return None
    if body < -1:
        return solids[-2 - body].name, -1
    k = int(world.row_object_ix[body])
    return f"{CLASSES[drive.scene.object_class[k]]} {drive.scene.object_ids[k]}", k


def world_at(drive: Drive, time_s: float) -> Tracks:
    """The truth at an instant, in seconds since the log's start."""
    gap_s, t0_ns = drive.experiment.max_gap_s, drive.scene.t0_ns
    near = drive.truth.captured_between(time_s - gap_s - AROUND_S, time_s + gap_s + AROUND_S)
    return interpolate_at_instants(near, np.array([t0_ns + round(time_s * 1e9)]), t0_ns=t0_ns, max_gap_s=gap_s)


def unit_pose(drive: Drive, name: str, unit: Unit, world: Tracks) -> UnitPoses:
    """Where a unit is in a world of one instant."""
    return compute_unit_poses(drive.scene, unit, world, unit_ground(drive.truth, name, unit))


# Why, in a sentence.


def explain_story(story: ObjectStory, hider: tuple[str, int] | None) -> str:
    """What hid an object, why the last configuration knows it late, and how the first one knows it, in one sentence."""
    first, last, hidden_s = story.first, story.last, story.hidden_s(story.blind)
    parts = []
    if hidden_s > SAME_INSTANT_S:
        name = str(story.blind["configuration"])
        where = (
            f"Hidden from {story.blind_unit()} behind {hider[0]}" if hider else f"Out of sight of the units of {name}"
        )
        until = _format_time(hidden_s) if story.blind["detected"] or story.blind["in_sight_s"] > 0 else "the end"
        parts.append(f"{where} until {until}")
        if hider and story.rows["detected"].any() and name not in (first["configuration"], last["configuration"]):
            parts[0] += f", so {name} {_tell_known(story.blind)}"
    if not story.rows["detected"].any():
        return (
            "; ".join([*parts, "no configuration ever knows it" if parts else "No configuration ever knows it"]) + "."
        )
    parts.append(f"{last['configuration']} {_tell_known(last)}{_tell_captured(last, story)}")
    if last["unknown_s"] - first["unknown_s"] > SAME_INSTANT_S:
        parts.append(f"{first['configuration']} {_tell_known(first)}{_tell_captured(first, story)}")
    return "; ".join(parts) + "."


def _tell_known(row: Any) -> str:
    if not row["detected"]:
        return "never knows it"
    return (
        f"knows it after {_format_time(row['unknown_s'])}" if row["unknown_s"] > SAME_INSTANT_S else "knows it at once"
    )


def _tell_captured(row: Any, story: ObjectStory) -> str:
    """By which unit's list, what became of lists before it, and how long it took to come."""
    if not row["detected"]:
        return "" if np.isnan(row["in_sight_s"]) else f", though {_tell_sight(story, row['in_sight_s'])}"
    unit, took_s = row.get("first_unit"), row["detection_s"] - row["captured_s"]
    told = f" by {unit}" if isinstance(unit, str) and unit else ""
    listed_s, since_s = float(row.get("listed_s", np.nan)), max(float(row["in_sight_s"]), story.onset_s)
    if row["captured_s"] - listed_s > SAME_INSTANT_S and listed_s >= story.onset_s:
        told += f" (lists from {_format_time(listed_s - story.onset_s)} on were lost, late or held back)"
    elif row["captured_s"] - since_s > SAME_INSTANT_S:
        told += f" ({_tell_sight(story, since_s)}, but in no list that counts)"
    return told + (f", whose list takes {_format_time(took_s)}" if took_s > SAME_INSTANT_S and told else "")


def _tell_sight(story: ObjectStory, since_s: float) -> str:
    after_s = max(since_s - story.onset_s, 0.0)
    return f"in sight from {_format_time(after_s)} on" if after_s > SAME_INSTANT_S else "in sight from the onset on"


def _format_time(time_s: float) -> str:
    return f"{time_s:.2f} s".replace("-", "−")


# Pictures: 960 × 360, three plans above the lanes.

_WIDTH, _HEIGHT = 960, 360
_PLAN_W, _PLAN_H, _GAP, _TOP = 312, 212, 12, 18
_LANES_TOP, _LANE_LEFT = 250, 150
_OBJECT, _HIDER = "#c2410c", "#7a1fa2"
_SPAN_M, _NEAR_M = 30.0, 60.0
"""Least width of a plan, and from how far away the ego and units are in it."""
_MARGIN_M = 6.0
"""Bodies whose middle is so far outside a plan may still reach into it."""


def _story_element(story: ObjectStory, why: str, log: str | None) -> Html:
    hider = find_hider(story) if story.hidden_s(story.blind) > SAME_INSTANT_S else None
    said = explain_story(story, hider)
    title = make_tag("h3", f"{story.name}: {why}")
    shown = log is None or log in story.study.results.provenance.run_shown
    command = f"copem-replay view FOLDER --object {story.object_id}" + (f" --log {log}" if log else "")
    beside = [" ", make_tag("code", command)] if shown and story.study.results.provenance.run_shown else []
    picture = make_tag(
        "svg", *_draw_plans(story, hider), *_draw_lanes(story), class_="story", role="img", aria_label=said,
        viewBox=f"0 0 {_WIDTH} {_HEIGHT}",
    )  # fmt: skip
    figure = make_tag("div", Html(replace_greys(picture)), class_="scroll", tabindex="0", role="region", aria_label=why)
    late = why_late(story.study.why, story.drive.log, story.object_id, story.onset_s)
    named = dict.fromkeys(str(row["configuration"]) for row in (story.first, story.last))
    lines = [f"{name} {late.get(name, 'is not late')}" for name in named]
    causes = [make_tag("p", "Mean over all runs: ", "; ".join(lines), ".")] if late else []
    return make_tag("div", title, make_tag("p", said, *beside), *causes, figure)


@dataclass(frozen=True)
class _View:
    """A part of the ground in a plan: metres to pixels."""

    west_m: float
    north_m: float
    scale: float
    left: float

    def points(self, at_m: Float) -> str:
        """Pixels of places (K, 2), as SVG has them."""
        x, y = self.left + (at_m[:, 0] - self.west_m) * self.scale, _TOP + (self.north_m - at_m[:, 1]) * self.scale
        return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x.tolist(), y.tolist(), strict=True))


def _draw_plans(story: ObjectStory, hider: tuple[str, int] | None) -> Iterator[Html]:
    first, last = story.first, story.last
    short = story.short
    known = (
        f"{short[first['configuration']]} first",
        f"{short[last['configuration']]} {'last' if last['detected'] else 'never'}",
    )
    if not story.rows["detected"].any():  # halfway, and at its end
        first = first.copy()
        first["ended_s"], first["unknown_s"] = (story.onset_s + last["ended_s"]) / 2, first["unknown_s"] / 2
        known = "not known", "never known"
    told = [(row, f"{_format_time(row['unknown_s'])}: {word}") for row, word in zip((first, last), known, strict=True)]
    instants = [(story.onset_s, f"onset, {story.onset_s:.2f} s", None)]
    instants += [(story.known_s(row), title, row) for row, title in told]
    worlds = [world_at(story.drive, time_s) for time_s, _, _ in instants]
    box = _choose_box(story, worlds, hider)
    for k, ((_, title, row), world) in enumerate(zip(instants, worlds, strict=True)):
        left = k * (_PLAN_W + _GAP)
        view = _View(box[0], box[1], _PLAN_W / box[2], left)
        yield make_tag("text", title, x=f"{left}", y="12", class_="title")
        frame = {"x": f"{left}", "y": f"{_TOP}", "width": f"{_PLAN_W}", "height": f"{_PLAN_H}"}
        yield make_tag(
            "svg", *_draw_plan(story, world, view, row, hider), viewBox=f"{left} {_TOP} {_PLAN_W} {_PLAN_H}", **frame
        )
        yield make_tag("rect", **frame, fill="none", stroke="#8c8c8c")


def _choose_box(
    story: ObjectStory, worlds: Sequence[Tracks], hider: tuple[str, int] | None
) -> tuple[float, float, float]:
    """West and north end (m) and width (m) of the plans: the object, what hides it, and the ego, if it is near."""
    drive, number = story.drive, story.drive.scene.object_number[story.object_id]
    own = np.concatenate([_places(world, number) for world in worlds])
    kept = [own]
    others = [_places(world, k) for world in worlds for k in (drive.scene.ego_ix, hider[1] if hider else -1) if k >= 0]
    units = [np.array([at]) for at in drive.fixed_units().values()]
    if len(own):
        kept += [at for at in (*others, *units) if len(at) and np.hypot(*(at - own[0]).T).min() <= _NEAR_M]
    at_m = np.concatenate(kept) if len(own) else np.concatenate([*others, *units, np.zeros((1, 2))])
    low, high = at_m.min(axis=0), at_m.max(axis=0)
    width_m = max(high[0] - low[0] + 10, (high[1] - low[1] + 10) * _PLAN_W / _PLAN_H, _SPAN_M)
    west, south = (high + low) / 2 - np.array([width_m, width_m * _PLAN_H / _PLAN_W]) / 2
    return float(west), float(south + width_m * _PLAN_H / _PLAN_W), float(width_m)


def _places(world: Tracks, object_ix: int) -> Float:
    rows = np.flatnonzero((world.row_object_ix == object_ix) & world.valid[0])
    return np.stack([world.x_m[0, rows], world.y_m[0, rows]], axis=-1)


def _draw_plan(
    story: ObjectStory, world: Tracks, view: _View, row: Any, hider: tuple[str, int] | None
) -> Iterator[Html]:
    """Boxes of all bodies, obstacles, units, and the line of who lists it, at the onset of who does not see it."""
    drive, scene = story.drive, story.drive.scene
    yield make_tag("rect", x=f"{view.left}", y=f"{_TOP}", width=f"{_PLAN_W}", height=f"{_PLAN_H}", fill="#f7f7f7")
    wide_m, high_m = _PLAN_W / view.scale, _PLAN_H / view.scale
    for line in drive.lanes_within(view.west_m, view.west_m + wide_m, view.north_m - high_m, view.north_m):
        yield make_tag("polyline", points=view.points(line), fill="none", stroke="#d9d9d9")
    for outline in drive.outlines():
        yield make_tag("polygon", points=view.points(outline), fill="#b3b3b3", stroke="#8c8c8c")
    number = scene.object_number[story.object_id]
    looks = {number: (_OBJECT, _OBJECT), scene.ego_ix: ("#4d4d4d", "#262626")}
    if hider is not None and hider[1] >= 0:
        looks[hider[1]] = ("#d9d9d9", _HIDER)
    corners_m, half_m = box_corners(world), np.array([_PLAN_W, _PLAN_H]) / view.scale / 2
    middle_m = np.array([view.west_m, view.north_m]) + half_m * [1, -1]
    near = (np.abs(corners_m.mean(axis=1) - middle_m) <= half_m + _MARGIN_M).all(axis=1)
    others = corners_m[near & ~np.isin(world.row_object_ix, list(looks))]
    bodies = "".join(f"M{view.points(corners)}z" for corners in others)
    yield make_tag("path", d=bodies, fill="#d9d9d9", stroke="#8c8c8c")
    for k, (fill, stroke) in looks.items():
        for corners in corners_m[world.row_object_ix == k]:
            width = "3" if k == number else "2"
            yield make_tag("polygon", points=view.points(corners), fill=fill, stroke=stroke, stroke_width=width)
    yield from _draw_units(story, world, view, row)
    labels = {number: story.object_id, scene.ego_ix: "ego", **({hider[1]: hider[0]} if hider else {})}
    for k, label in labels.items():
        for at in _places(world, k) if k >= 0 else ():
            x, y = map(float, view.points(at[None]).split(","))
            x, y, anchor = (x, y + 20, "middle") if hider and k == hider[1] else (x + 6, y - 9, "start")
            yield make_tag("text", label, x=f"{x:.1f}", y=f"{y:.1f}", class_="label", text_anchor=anchor)


def _draw_units(story: ObjectStory, world: Tracks, view: _View, row: Any) -> Iterator[Html]:
    drive = story.drive
    for at in drive.fixed_units().values():
        x, y = map(float, view.points(np.array([at])).split(","))
        yield make_tag("path", d=f"M{x - 5:.1f},{y + 4:.1f}h10l-5,-9z", fill="#262626")
    name = story.blind_unit() if row is None else row.get("first_unit")
    target = _places(world, drive.scene.object_number[story.object_id])
    if not isinstance(name, str) or name not in drive.experiment.modelled or not len(target):
        return
    if row is None and story.hidden_s(story.blind) <= SAME_INSTANT_S:
        return
    if row is not None and not row["detected"]:
        return
    poses = unit_pose(drive, name, drive.experiment.modelled[name], world)
    if poses.present.any():
        line = view.points(np.array([[poses.x_m[0], poses.y_m[0]], target[0]]))
        colour = _HIDER if row is None else css_colour(story.study.looks[str(row["configuration"])].colour)
        dash = "5 4" if row is None else None
        yield make_tag("polyline", points=line, fill="none", stroke=colour, stroke_width="2", stroke_dasharray=dash)


# Lanes: a row per configuration, the soonest first.

_SHADES = {"hidden": "#737373", "in sight": "#bfbfbf", "on its way": "#e0e0e0"}


def _draw_lanes(story: ObjectStory) -> Iterator[Html]:
    rows = story.rows.sort_values("unknown_s", kind="stable")
    kept = pick_evenly([str(name) for name in rows["configuration"]], _LANES)
    rows = rows[rows["configuration"].isin(kept)]
    last_s = max(story.known_s(row) for _, row in rows.iterrows()) - story.onset_s
    scale = (_WIDTH - _LANE_LEFT - 60) / max(1.15 * last_s, JUDGED_S)
    each = min(18.0, 84 / len(rows))
    for k, (_, row) in enumerate(rows.iterrows()):
        yield from _draw_lane(story, row, _LANES_TOP + k * each, each - 4, scale)
    y = _LANES_TOP + len(rows) * each + 12
    x = float(_LANE_LEFT)
    for word, shade in (*_SHADES.items(), ("known (in the colour of the configuration)", None)):
        if shade:
            yield make_tag("rect", x=f"{x:.0f}", y=f"{y - 8:.0f}", width="10", height="9", fill=shade)
        yield make_tag("text", word, x=f"{x + 14:.0f}", y=f"{y:.0f}", class_="label")
        x += 24 + 7 * len(word)


def _draw_lane(story: ObjectStory, row: Any, y: float, height: float, scale: float) -> Iterator[Html]:
    """Spans of one configuration from the onset on: hidden, in sight, on its way, known; and its time."""
    known_s, name = story.known_s(row), str(row["configuration"])
    stages = (
        [row["in_sight_s"], row["captured_s"], known_s] if row["detected"] else [row["in_sight_s"], known_s, known_s]
    )
    stages[0] = story.onset_s + story.hidden_s(row)
    ends = np.fmin(np.maximum.accumulate(np.nan_to_num(np.array(stages, dtype=float), nan=story.onset_s)), known_s)
    begin_s, common = story.onset_s, {"y": f"{y:.1f}", "height": f"{height:.1f}"}
    yield make_tag(
        "text", story.short[name], x=f"{_LANE_LEFT - 6}", y=f"{y + height - 2:.1f}", class_="label", text_anchor="end"
    )
    for end_s, shade in zip(ends.tolist(), _SHADES.values(), strict=True):
        if end_s > begin_s:
            x, width = _LANE_LEFT + (begin_s - story.onset_s) * scale, (end_s - begin_s) * scale
            yield make_tag("rect", x=f"{x:.1f}", width=f"{width:.1f}", fill=shade, **common)
            begin_s = end_s
    x = _LANE_LEFT + max(known_s - story.onset_s, 0.0) * scale
    if row["detected"]:
        look = story.study.looks[name]
        width, fill = max(_WIDTH - 60 - x, 2), css_colour(look.colour)
        yield make_tag("rect", x=f"{x:.1f}", width=f"{width:.1f}", fill=fill, **common)
    flag = _format_time(row["unknown_s"]) if row["detected"] else "✕ never"
    yield make_tag("text", flag, x=f"{_WIDTH - 54}", y=f"{y + height - 2:.1f}", class_="label")

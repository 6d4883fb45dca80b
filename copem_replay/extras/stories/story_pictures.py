"""Pictures of a story: plans at the onset, when it is first known and last known, above a lane per configuration."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from copem_replay.core.tracks import SAME_INSTANT_S, Float, Tracks
from copem_replay.extras.stories.story_facts import (
    ObjectStory,
    format_seconds,
    unit_pose,
    world_at,
)
from copem_replay.perception.sight import HIDDEN, IN_SIGHT, NO_UNIT
from copem_replay.perception.visibility import box_corners
from copem_replay.pipeline.expansion import give_views
from copem_replay.pipeline.sight import StatusSpan
from copem_replay.report.html.markup import Html, css_colour, make_tag, replace_colours, replace_greys
from copem_replay.results.shown_objects import pick_evenly

JUDGED_S = 2.0
"""Least length of the lanes."""
_LANES = 6
_WIDTH, _HEIGHT = 960, 360
_PLAN_W, _PLAN_H, _GAP, _TOP = 312, 212, 12, 18
_LANES_TOP, _LANE_LEFT = 250, 150
_OBJECT, _HIDER = "var(--object)", "var(--hides)"
"""Set in `page.css`, for either theme."""
_SPAN_M, _NEAR_M = 30.0, 60.0
"""Least width of a plan, and from how far away the ego and units are in it."""
_LETTER = 6.5
"""Width of a letter of the names in plans, in pixels, rounded up."""
_MARGIN_M = 6.0
"""Bodies whose middle is so far outside a plan may still reach into it."""


def draw_story(story: ObjectStory, hider: StatusSpan | None, words: str) -> Html:
    """The picture of a story; `words`: its sentence, for screen readers."""
    picture = make_tag(
        "svg", *_draw_plans(story, hider), *_draw_lanes(story), class_="story", role="img", aria_label=words,
        viewBox=f"0 0 {_WIDTH} {_HEIGHT}",
    )  # fmt: skip
    return Html(replace_greys(replace_colours(picture, story.study.looks.values())))


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


def _draw_plans(story: ObjectStory, hider: StatusSpan | None) -> Iterator[Html]:
    """The plans side by side: at the onset, when the object is first known, and when it is last known or never."""
    first, last = story.first, story.last
    short = story.short
    plan_words = (
        f"{short[first['configuration']]} first",
        f"{short[last['configuration']]} {'last' if last['detected'] else 'never'}",
    )
    if not story.rows["detected"].any():  # halfway, and at its end
        first = first.copy()
        first["ended_s"], first["unknown_s"] = (story.onset_s + last["ended_s"]) / 2, first["unknown_s"] / 2
        plan_words = "not known", "never known"
    instants = [(story.onset_s, f"onset, {story.onset_s:.2f} s", None)]
    for row, word in zip((first, last), plan_words, strict=True):
        instants.append((story.known_s(row), f"{format_seconds(row['unknown_s'])}: {word}", row))
    worlds = [world_at(story.drive, time_s) for time_s, _, _ in instants]
    box = _choose_box(story, worlds, hider)
    for k, ((_, title, row), world) in enumerate(zip(instants, worlds, strict=True)):
        left = k * (_PLAN_W + _GAP)
        view = _View(box[0], box[1], _PLAN_W / box[2], left)
        yield make_tag("text", title, x=f"{left}", y="12", class_="title")
        frame = {"x": f"{left}", "y": f"{_TOP}", "width": f"{_PLAN_W}", "height": f"{_PLAN_H}"}
        plan, box_px = _draw_plan(story, world, view, row, hider), f"{left} {_TOP} {_PLAN_W} {_PLAN_H}"
        yield make_tag("svg", *plan, viewBox=box_px, aria_hidden="true", **frame)
        yield make_tag("rect", **frame, fill="none", stroke="#8c8c8c")


def _choose_box(story: ObjectStory, worlds: Sequence[Tracks], hider: StatusSpan | None) -> tuple[float, float, float]:
    """West and north end (m) and width (m) of the plans: the object, what hides it, and the ego, if it is near."""
    drive, number = story.drive, story.drive.scene.object_number[story.object_id]
    object_m = np.concatenate([_places(world, number) for world in worlds])
    places = [object_m]
    other_places = [
        _places(world, k) for world in worlds for k in (drive.scene.ego_ix, hider.body_ix if hider else -1) if k >= 0
    ]
    units = [np.array([at]) for at in drive.fixed_units().values()]
    if len(object_m):
        places += [at for at in (*other_places, *units) if len(at) and np.hypot(*(at - object_m[0]).T).min() <= _NEAR_M]
    at_m = np.concatenate(places) if len(object_m) else np.concatenate([*other_places, *units, np.zeros((1, 2))])
    low, high = at_m.min(axis=0), at_m.max(axis=0)
    width_m = max(high[0] - low[0] + 10, (high[1] - low[1] + 10) * _PLAN_W / _PLAN_H, _SPAN_M)
    west, south = (high + low) / 2 - np.array([width_m, width_m * _PLAN_H / _PLAN_W]) / 2
    return float(west), float(south + width_m * _PLAN_H / _PLAN_W), float(width_m)


def _places(world: Tracks, object_ix: int) -> Float:
    rows = np.flatnonzero((world.row_object_ix == object_ix) & world.valid[0])
    return np.stack([world.x_m[0, rows], world.y_m[0, rows]], axis=-1)


def _draw_plan(story: ObjectStory, world: Tracks, view: _View, row: Any, hider: StatusSpan | None) -> Iterator[Html]:
    """The SVG of one plan: bodies, obstacles, units, and a line from who lists the object (`row` None: the onset)."""
    drive, scene = story.drive, story.drive.scene
    yield make_tag("rect", x=f"{view.left}", y=f"{_TOP}", width=f"{_PLAN_W}", height=f"{_PLAN_H}", fill="#f7f7f7")
    wide_m, high_m = _PLAN_W / view.scale, _PLAN_H / view.scale
    for line in drive.lanes_within(view.west_m, view.west_m + wide_m, view.north_m - high_m, view.north_m):
        yield make_tag("polyline", points=view.points(line), fill="none", stroke="#d9d9d9")
    for outline in drive.outlines():
        yield make_tag("polygon", points=view.points(outline), fill="#b3b3b3", stroke="#8c8c8c")
    number = scene.object_number[story.object_id]
    look_by_object = {number: (_OBJECT, _OBJECT), scene.ego_ix: ("#4d4d4d", "#262626")}
    if hider is not None and hider.body_ix >= 0:
        look_by_object[hider.body_ix] = ("#d9d9d9", _HIDER)
    corners_m, half_m = box_corners(world), np.array([_PLAN_W, _PLAN_H]) / view.scale / 2
    middle_m = np.array([view.west_m, view.north_m]) + half_m * [1, -1]
    is_near = (np.abs(corners_m.mean(axis=1) - middle_m) <= half_m + _MARGIN_M).all(axis=1)
    others = corners_m[is_near & ~np.isin(world.row_object_ix, list(look_by_object))]
    bodies = "".join(f"M{view.points(corners)}z" for corners in others)
    yield make_tag("path", d=bodies, fill="#d9d9d9", stroke="#8c8c8c")
    for k, (fill, stroke) in look_by_object.items():
        for corners in corners_m[world.row_object_ix == k]:
            width = "3" if k == number else "2"
            yield make_tag("polygon", points=view.points(corners), fill=fill, stroke=stroke, stroke_width=width)
    yield from _draw_units(story, world, view, row, hider)
    labels = {number: story.object_id, scene.ego_ix: "ego", **({hider.body_ix: hider.body} if hider else {})}
    named = [
        (label, np.array([[*map(float, pair.split(","))] for pair in view.points(corners).split()]))
        for k, label in labels.items()
        for corners in corners_m[world.row_object_ix == k]
    ]
    for label, x, y in place_words(named, view.left):
        yield make_tag("text", label, x=f"{x:.1f}", y=f"{y:.1f}", class_="label", text_anchor="middle")


def place_words(bodies: Sequence[tuple[str, Float]], left: float) -> Iterator[tuple[str, float, float]]:
    """The names of bodies, given by corners (4, 2), and the middles of their base lines, all in pixels.

    Above, below, right or left of its body, a name is clear of all of them and of other names, if there is such a place
    in the plan.
    """
    covered = [(corners.min(axis=0), corners.max(axis=0)) for _, corners in bodies]
    frame = np.array([left, _TOP]), np.array([left + _PLAN_W, _TOP + _PLAN_H])
    for (name, _), ((west, north), (east, south)) in zip(bodies, list(covered), strict=True):
        half, x, y = _LETTER * len(name) / 2, (west + east) / 2, (north + south) / 2
        spots = [(x, north - 4), (x, south + 12), (east + half + 4, y + 4), (west - half - 4, y + 4)]
        areas = [(np.array([x - half, y - 10]), np.array([x + half, y + 2])) for x, y in spots]
        free = [
            k
            for k, (low, high) in enumerate(areas)
            if (low >= frame[0]).all() and (high <= frame[1]).all()
            and not any((low < other_high).all() and (high > other_low).all() for other_low, other_high in covered)
        ]  # fmt: skip
        k = free[0] if free else 0
        covered.append(areas[k])
        yield name, *spots[k]


def _draw_units(story: ObjectStory, world: Tracks, view: _View, row: Any, hider: StatusSpan | None) -> Iterator[Html]:
    """Masts, and a line from the unit that lists the object; at the onset (`row` None) from one it is hidden from."""
    drive = story.drive
    for at in drive.fixed_units().values():
        x, y = map(float, view.points(np.array([at])).split(","))
        yield make_tag("path", d=f"M{x - 5:.1f},{y + 4:.1f}h10l-5,-9z", fill="#262626")
    hidden_from = hider.unit if hider and hider.begin_s <= story.onset_s + SAME_INSTANT_S else None
    name = hidden_from if row is None else row.get("first_unit")
    target = _places(world, drive.scene.object_number[story.object_id])
    sensors = give_views(drive.experiment).modelled
    if not isinstance(name, str) or name not in sensors or not len(target):
        return
    if row is not None and not row["detected"]:
        return
    poses = unit_pose(drive, name, sensors[name], world)
    if poses.present.any():
        line = view.points(np.array([[poses.x_m[0], poses.y_m[0]], target[0]]))
        colour = _HIDER if row is None else css_colour(story.study.looks[str(row["configuration"])].colour)
        dash = "5 4" if row is None else None
        yield make_tag("polyline", points=line, fill="none", stroke=colour, stroke_width="2", stroke_dasharray=dash)


# Lanes: a row per configuration, the soonest first.

_OUT, _HIDDEN, _IN_SIGHT, _LISTED = "#4d4d4d", "#808080", "#bfbfbf", "#e0e0e0"
_UNLISTED = "#c8b48c"
"""Of recorded units without `views`: what they do not list."""
_SHADES = {"out of range or view": _OUT, "hidden": _HIDDEN, "in sight": _IN_SIGHT, "listed": _LISTED}


def _draw_lanes(story: ObjectStory) -> Iterator[Html]:
    """A lane for each configuration, the soonest first, with the key of shades below."""
    rows = story.rows.sort_values("unknown_s", kind="stable")
    lane_names = pick_evenly([str(name) for name in rows["configuration"]], _LANES)
    rows = rows[rows["configuration"].isin(lane_names)]
    last_s = max(story.known_s(row) for _, row in rows.iterrows()) - story.onset_s
    scale = (_WIDTH - _LANE_LEFT - 60) / max(1.15 * last_s, JUDGED_S)
    lane_height = min(18.0, 84 / len(rows))
    for k, (_, row) in enumerate(rows.iterrows()):
        yield from _draw_lane(story, row, _LANES_TOP + k * lane_height, lane_height - 4, scale)
    y = _LANES_TOP + len(rows) * lane_height + 12
    x = float(_LANE_LEFT)
    unlisted = any(span.status == NO_UNIT for name in lane_names for span in story.spans.get(name, ()))
    shades = _SHADES | ({"not listed": _UNLISTED} if unlisted else {})
    for word, shade in (*shades.items(), ("thick: known (in the colour of the configuration)", None)):
        if shade:
            yield make_tag("rect", x=f"{x:.0f}", y=f"{y - 8:.0f}", width="10", height="9", fill=shade)
        yield make_tag("text", word, x=f"{x + 14:.0f}", y=f"{y:.0f}", class_="label")
        x += 24 + 7 * len(word)


def _draw_lane(story: ObjectStory, row: Any, y: float, height: float, scale: float) -> Iterator[Html]:
    """Spans of one configuration from the onset on (what units have of it, on its way, known), and its time. Known is
    thicker: some configurations are as grey as what is before.
    """
    known_s, name = story.known_s(row), str(row["configuration"])
    shades = {HIDDEN: _HIDDEN, IN_SIGHT: _IN_SIGHT, NO_UNIT: _UNLISTED}
    thin, thick = ({"y": f"{y + (height - high) / 2:.1f}", "height": f"{high:.1f}"} for high in (height / 2, height))
    yield make_tag(
        "text", story.short[name], x=f"{_LANE_LEFT - 6}", y=f"{y + height - 2:.1f}", class_="label", text_anchor="end"
    )
    for span in story.spans.get(name, ()):
        x, width = _LANE_LEFT + (span.begin_s - story.onset_s) * scale, (span.end_s - span.begin_s) * scale
        shade = shades.get(span.status, _LISTED if span.status > IN_SIGHT else _OUT)
        yield make_tag("rect", x=f"{x:.1f}", width=f"{width:.1f}", fill=shade, **thin)
    x = _LANE_LEFT + max(known_s - story.onset_s, 0.0) * scale
    if row["detected"]:
        look = story.study.looks[name]
        width, fill = max(_WIDTH - 60 - x, 2), css_colour(look.colour)
        yield make_tag("rect", x=f"{x:.1f}", width=f"{width:.1f}", fill=fill, **thick)
    flag = format_seconds(row["unknown_s"]) if row["detected"] else "✕ never"
    yield make_tag("text", flag, x=f"{_WIDTH - 54}", y=f"{y + height - 2:.1f}", class_="label")

"""Player: one run on a page, two configurations side by side on canvases, with a slider, an object list and keys.

What is drawn is written into the page: places as 16-bit numbers, frame by frame, drawn by `player.js`.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from copem_replay.core.errors import CopemError
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import CLASSES, SAME_INSTANT_S, Bool, Float, Int, Scene, Tracks
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.metrics.detections_table import first_episodes
from copem_replay.pipeline.expansion import give_views
from copem_replay.report.figures.selection import Choice, Selection, choose_object_and_run, find_differing
from copem_replay.report.figures.style import sort_soonest_first
from copem_replay.report.html.markup import Html, css_colour, join_html, make_tag
from copem_replay.results.again import replay_again
from copem_replay.results.shown_objects import choose_shown_objects
from copem_replay.viewer.curves import find_false_rows

if TYPE_CHECKING:
    from copem_replay.pipeline.one_run import ReplayedRun
    from copem_replay.report.html.study import ReportData

MOST_CONFIGURATIONS = 6
"""Most configurations that a page can play: of more, those that differ, evenly from the soonest to the latest."""
MOST_BYTES = 1_400_000
"""Most of a page that places take: frames are farther apart until they fit."""
STEP_S, LONGEST_S, BEFORE_S = 0.1, 60.0, 5.0
"""Time between frames where places fit; of a longer log so much is played, from so long before the onset."""
STEP_M = 0.01
"""Unit of places, where they are within 327 m of the middle; farther apart it is larger."""
FULL_TURN = 32_768
"""Units of headings in half a turn."""


# Places, as the page holds them: 16-bit numbers. Tracks are pieces without a gap, each `object, first frame, frames`,
# then `x, y, yaw` of every frame. Entries about nobody are `frames`, then the number of each frame, then `x, y`.


@dataclass(frozen=True)
class Grid:
    """Instants (K,) of frames in seconds since the log's start, and the place and unit (m) of places."""

    instants_s: Float
    middle_m: tuple[float, float]
    unit_m: float

    def round_places(self, rows: Rows) -> Int:
        """(R, 3) places and headings as 16-bit integers."""
        heading = np.rint(rows.yaw_rad / np.pi * FULL_TURN).astype(np.int64)
        heading = (heading + FULL_TURN) % (2 * FULL_TURN) - FULL_TURN
        east, north = (
            np.clip(np.rint((at - of) / self.unit_m), -32_767, 32_767).astype(np.int64)
            for at, of in ((rows.x_m, self.middle_m[0]), (rows.y_m, self.middle_m[1]))
        )
        return np.stack([east, north, heading], axis=1)


@dataclass(frozen=True)
class Rows:
    """Objects (R,) at frames (R,) of a grid, −1: about no object, and where they are."""

    frame: Int
    object_ix: Int
    x_m: Float
    y_m: Float
    yaw_rad: Float

    def take(self, rows: Any) -> Rows:
        """The rows at these indices or in this mask."""
        return Rows(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


def find_rows(tracks: Tracks, available_s: Float, instants_s: Float, is_taken: Bool | None = None) -> Rows:
    """The newest list of `tracks`, of one run, at each instant (K,). `available_s`: when each list is there, (F,).

    `is_taken (P,)`: which rows are taken, None: all that are valid.
    """
    is_taken = tracks.valid[0] if is_taken is None else is_taken
    by_time = np.argsort(available_s, kind="stable")
    newest = np.searchsorted(available_s[by_time], instants_s + SAME_INSTANT_S, side="right") - 1
    frame = np.flatnonzero(newest >= 0)
    order, bounds = tracks.by_frame
    lists = by_time[newest[frame]]
    count = bounds[lists + 1] - bounds[lists]
    within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    rows, frame = order[np.repeat(bounds[lists], count) + within], np.repeat(frame, count)
    rows, frame = rows[is_taken[rows]], frame[is_taken[rows]]
    return Rows(frame, tracks.row_object_ix[rows], tracks.x_m[0, rows], tracks.y_m[0, rows], tracks.yaw_rad[0, rows])


def encode_tracks(rows: Rows, grid: Grid) -> bytes:
    """Rows about objects as pieces of tracks; of an object that a list has twice, the first."""
    _, kept = np.unique(np.stack([rows.object_ix, rows.frame]), axis=1, return_index=True)
    rows = rows.take(kept[rows.object_ix[kept] >= 0])
    new = (np.diff(rows.object_ix, prepend=-1) != 0) | (np.diff(rows.frame, prepend=-2) != 1)
    first = np.flatnonzero(new)
    heads = np.stack([rows.object_ix[first], rows.frame[first], np.diff(first, append=len(new))], axis=1)
    return np.insert(grid.round_places(rows), first, heads, axis=0).astype("<i2").tobytes()


def encode_false(rows: Rows, grid: Grid) -> bytes:
    """Rows about no object, by frame."""
    rows = rows.take(np.flatnonzero(rows.object_ix < 0))
    rows = rows.take(np.argsort(rows.frame, kind="stable"))
    counts = np.bincount(rows.frame, minlength=len(grid.instants_s))
    return np.concatenate([counts, grid.round_places(rows)[:, :2].ravel()]).astype("<i2").tobytes()


# What a page plays: the run of the recording for the viewer, replayed again from the log.


def write_section(study: ReportData) -> tuple[str, list[Html]] | None:
    """Title and player of one run; None where no run is shown."""
    player = player_element(study)
    return None if player is None else ("One run, side by side", [player])


def player_element(study: ReportData) -> Html | None:
    """The player of a run with its data, or words where the log cannot be replayed; None where no run is shown."""
    results, shown = study.results, study.results.provenance.run_shown
    colours = {name: look.dark for name, look in study.looks.items()}
    names = find_differing(results, study.contenders, MOST_CONFIGURATIONS, colours)
    if not shown or not names or not len(results.known):
        return None
    try:
        choice = choose_object_and_run(results, Selection(configurations=names))
        if choice.log not in shown:
            choice = choose_object_and_run(results, Selection(configurations=names, log=next(iter(shown))))
        data = collect_player_data(study, choice)
    except CopemError:  # its words name places on this machine
        return make_tag("p", "No player: the recording is not where it was, or cannot be replayed again.")
    return _write_player(data, f"Run {choice.run} of {choice.log}, as copem-replay view shows it.")


def collect_player_data(study: ReportData, choice: Choice) -> dict[str, Any]:
    """The data of one run for `player.js`. Raises CopemError where the log cannot be read or replayed again."""
    results = study.results
    experiment = resolve_for_log(results.experiment, choice.log)
    names = list(choice.configurations)
    replayed, its_rows = replay_again(results, choice.log, choice.run, names)
    (rows,) = results.each(log=choice.log, every=True)
    of_run, table = first_episodes(rows[rows["run"] == choice.run]), first_episodes(its_rows)
    scene, truth = replayed.replay.scene, replayed.replay.truth
    shown = [scene.object_ids[k] for k in choose_shown_objects(scene, truth, experiment, of_run).object_ix]
    measured = _list_measured(scene, table, shown)
    onset_s = measured[0][1]
    begin_s = 0.0 if scene.end_s <= LONGEST_S else max(0.0, onset_s - BEFORE_S)
    instants_s = np.arange(begin_s, min(scene.end_s, begin_s + LONGEST_S) + STEP_S / 2, STEP_S)
    tracks = {"": find_rows(truth, truth.captured_s, instants_s), **_find_fused(replayed, instants_s)}
    grid, tracks = _fit_frames(tracks, instants_s)
    ranked = sort_soonest_first(results, names)
    return {
        "log": choice.log,
        "run": choice.run,
        "view": study.view_command(choice.log, "OBJECT"),
        "from": float(grid.instants_s[0]),
        "step": round(float(np.diff(grid.instants_s[:2]).sum()), 3) or STEP_S,
        "frames": len(grid.instants_s),
        "unit": grid.unit_m,
        "objects": _list_objects(scene, truth),
        "ego": scene.ego_ix,
        "truth": _to_text(encode_tracks(tracks[""], grid)),
        "solids": _outline_solids(replayed, grid),
        "lanes": _list_lanes(replayed, grid),
        "units": _list_places(replayed, grid),
        "measured": measured,
        "configurations": [
            {
                "name": name,
                "colour": css_colour(study.looks[name].colour),
                "dark": css_colour(study.looks[name].dark),
                "tracks": _to_text(encode_tracks(tracks[name], grid)),
                "false": _to_text(encode_false(tracks[name], grid)),
                "known": _list_known(scene, table, name),
            }
            for name in names
        ],
        "shown": [names.index(name) for name in dict.fromkeys((ranked[-1], ranked[0]))],
    }


def _find_fused(replayed: ReplayedRun, instants_s: Float) -> dict[str, Rows]:
    """Rows by configuration; each frame has those of the last time chunk with a list by then."""
    rows_of: dict[str, Rows] = {}
    for chunk in replayed.run_tracks:
        for name, fused_tracks in chunk.items():
            rows, has_list = _find_in_chunk(replayed, fused_tracks, instants_s)
            if name in rows_of:
                before = rows_of[name].take(~has_list[rows_of[name].frame])
                pairs = ((getattr(before, column), getattr(rows, column)) for column in rows.__dataclass_fields__)
                rows = Rows(*map(np.concatenate, pairs))
            rows_of[name] = rows
        if min(of.fused.common_arrives_s.min(initial=np.inf) for of in chunk.values()) > instants_s[-1]:
            break
    return rows_of


def _find_in_chunk(replayed: ReplayedRun, fused_tracks: FusedTracks, instants_s: Float) -> tuple[Rows, Any]:
    """Rows of objects and false entries, not second entries of somebody; whether there is a list by each instant."""
    fused = fused_tracks.fused
    arrives_s = fused.common_arrives_s
    has_list = arrives_s.min(initial=np.inf) <= instants_s + SAME_INSTANT_S
    kept = fused.valid[0] & (fused.row_object_ix >= 0)
    kept |= find_false_rows(replayed.replay, replayed.experiment, fused_tracks)
    return find_rows(fused, arrives_s, instants_s, kept), has_list


def _fit_frames(tracks: dict[str, Rows], instants_s: Float) -> tuple[Grid, dict[str, Rows]]:
    """The grid of every so many frames, as many as `MOST_BYTES` allow, and the rows in them."""
    stride = 1
    while True:
        thinned = {name: rows.take(rows.frame % stride == 0) for name, rows in tracks.items()}
        if sum(len(rows.frame) for rows in thinned.values()) * 8 <= MOST_BYTES or stride >= len(instants_s):
            break
        stride += 1
    thinned = {name: Rows(rows.frame // stride, *list(vars(rows).values())[1:]) for name, rows in thinned.items()}
    x, y = (np.concatenate([getattr(rows, name) for rows in thinned.values()]) for name in ("x_m", "y_m"))
    middle_m = (float(x.min() + x.max()) / 2, float(y.min() + y.max()) / 2) if len(x) else (0.0, 0.0)
    farthest_m = max(np.ptp(x), np.ptp(y)) / 2 if len(x) else 0.0
    return Grid(instants_s[::stride], middle_m, max(STEP_M, float(np.ceil(farthest_m / 327) / 100))), thinned


def _to_text(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def _list_objects(scene: Scene, truth: Tracks) -> list[list[Any]]:
    """By object: its id, class, length and width (m)."""
    first = {int(k): row for row, k in reversed(list(enumerate(truth.row_object_ix[truth.start[:-1]])))}
    listed = []
    for k, name in enumerate(scene.object_ids):
        row = int(truth.start[first[k]]) if k in first else None
        size = [0.0, 0.0] if row is None else [round(float(of[0, row]), 2) for of in (truth.length_m, truth.width_m)]
        listed.append([name, CLASSES[int(scene.object_class[k])], *size])
    return listed


def _outline_solids(replayed: ReplayedRun, grid: Grid) -> list[list[float]]:
    """Corners of obstacles, x and y in turn, m from the middle."""
    static = replayed.replay.placed.static
    return [
        (static.xy_m[static.start[k] : static.start[k + 1]] - grid.middle_m).round(2).ravel().tolist()
        for k in range(len(static.body))
    ]


_MOST_LANE_POINTS = 20_000
"""Of borders of lanes on a page, some 200 kB; of more, those nearest to the middle."""


def _list_lanes(replayed: ReplayedRun, grid: Grid) -> list[list[float]]:
    """Borders of lanes as x and y in turn, m from the middle."""
    lines = [line[:, :2] - grid.middle_m for line in replayed.replay.lane_boundaries]
    lines.sort(key=lambda line: float(np.hypot(*line.T).min()))
    kept = np.searchsorted(np.cumsum([len(line) for line in lines]), _MOST_LANE_POINTS, side="right")
    return [line.round(1).ravel().tolist() for line in lines[:kept]]


def _list_places(replayed: ReplayedRun, grid: Grid) -> list[list[Any]]:
    """Name, x and y (m from the grid's middle) of each unit with a place of its own."""
    poses = replayed.replay.placed.poses
    fixed = (
        name
        for name, unit in give_views(replayed.experiment).modelled.items()
        if unit.at is not None and len(poses[name].x_m)
    )
    east_m, north_m = grid.middle_m
    return [
        [name, round(float(poses[name].x_m[0]) - east_m, 2), round(float(poses[name].y_m[0]) - north_m, 2)]
        for name in fixed
    ]


def _list_measured(scene: Scene, table: pd.DataFrame, shown: Sequence[str]) -> list[list[Any]]:
    """Measured objects, those that the viewer shows first, the rest by how much they tell apart: onset and end (s)."""
    time_s = table["time_to_detection_s"].fillna(table["ended_s"] - table["onset_s"])
    apart = time_s.groupby(table["object_id"], sort=False).agg(np.ptp)
    episodes = table.drop_duplicates("object_id").set_index("object_id")
    rest = [name for name in apart.index if name not in shown]
    ranked = [name for name in shown if name in apart.index] + sorted(rest, key=lambda name: -round(apart[name], 6))
    return [
        [scene.object_number[name], *episodes.loc[name, ["onset_s", "ended_s"]].astype(float).round(6).tolist()]
        for name in ranked
    ]


def _list_known(scene: Scene, table: pd.DataFrame, name: str) -> dict[str, float]:
    """When each object was known, by its number."""
    rows = table[(table["configuration"] == name) & table["detected"]]
    numbers: Iterable[int] = rows["object_id"].map(scene.object_number)
    return {str(k): round(at_s, 6) for k, at_s in zip(numbers, rows["detection_s"].tolist(), strict=True)}


_KEYS = (
    "Keys: space plays, ← and → a frame, with shift a second, Home and End, n and p the next and previous object, x "
    "exchanges A and B, + and − the width."
)
_SIGNS = (
    ("known", "filled: known"),
    ("listed", "outline: listed, not yet known, from a list captured before it counts, or not measured"),
    ("false", "dashed with ✕: about nobody"),
    ("truth", "grey: where it really is"),
    ("ego", "grey, filled: the ego"),
    ("unit", "▲ a unit at the road"),
)


def _write_player(data: dict[str, Any], says: str) -> Html:
    """The HTML elements of the player with its data, filled by its script; `says`: the sentence above."""
    names = [one["name"] for one in data["configurations"]]
    panels = [_write_panel(letter, names, k) for letter, k in zip("AB", data["shown"], strict=False)]
    last = str(data["frames"] - 1)
    slider = make_tag(
        "input", type="range", min="0", max=last, value="0", step="1", aria_label="instant", class_="moment"
    )
    head = make_tag("tr", *(make_tag("th", word, scope="col") for word in ("object", *"AB"[: len(panels)], "more")))
    table = make_tag("table", make_tag("caption", "Known after"), make_tag("thead", head), make_tag("tbody"))
    object_list = make_tag("div", table, class_="objects", tabindex="0", role="region", aria_label="Objects")
    controls = make_tag(
        "div", make_tag("button", "play", type="button", class_="play"), slider, make_tag("output", "0.0 s"),
        class_="controls screen",
    )  # fmt: skip
    json_text = json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    script = (files("copem_replay.extras.player") / "player.js").read_text(encoding="utf-8")
    return join_html(
        [
            make_tag("p", says, " ", make_tag("span", _KEYS, class_="screen")),
            make_tag(
                "div", make_tag("div", *panels, class_="panels"), controls, _write_signs(), object_list,
                make_tag("p", make_tag("code", class_="command"), class_="below"),
                id_="player", tabindex="0", role="group", aria_label="Player of a run",
            ),
            make_tag("script", Html(json_text), type="application/json", id_="played"),
            make_tag("script", Html(script)),
        ]
    )  # fmt: skip


def _write_panel(letter: str, names: Sequence[str], chosen: int) -> Html:
    options = (make_tag("option", name, value=str(k), selected=k == chosen) for k, name in enumerate(names))
    choose = make_tag("select", *options, aria_label=f"configuration {letter}")
    return make_tag(
        "div", make_tag("p", make_tag("b", letter), " ", choose, " ", make_tag("span", class_="counted")),
        make_tag("canvas", role="img", aria_label=f"configuration {letter} from above"), class_="panel",
    )  # fmt: skip


def _write_signs() -> Html:
    signs = (make_tag("span", make_tag("i", class_=f"sign {kind}"), words) for kind, words in _SIGNS)
    return make_tag("p", *signs, class_="below signs")

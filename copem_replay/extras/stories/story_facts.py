"""Facts of a story: who knows an object first and last, what hides it, what the radio lost; and a sentence of it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from copem_replay.core.errors import CopemError, count_noun
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.interpolation import interpolate_at_instants
from copem_replay.core.tracks import SAME_INSTANT_S, Tracks
from copem_replay.experiment.schema import Unit
from copem_replay.perception.sensor_poses import UnitPoses, compute_unit_poses, find_carrier, unit_ground
from copem_replay.perception.sight import HIDDEN, IN_SIGHT, NO_UNIT, OUT_OF_VIEW
from copem_replay.pipeline.one_run import replay_run
from copem_replay.pipeline.sight import SightSpan, compute_sight, list_sight_spans
from copem_replay.report.figures.paths import Drive
from copem_replay.report.figures.style import shorten_names
from copem_replay.report.html.study import ReportData
from copem_replay.results.again import replay_again

# Facts of a story.


@dataclass(frozen=True)
class ObjectStory:
    """One object in one run. `rows`: of its first episode, a row per configuration, with `unknown_s`.

    `spans`: by configuration what its units have of the object until one first lists it; none where units are recorded.
    `lost`: by configuration how many lists with the object the radio lost until it was known; None: cannot be told.
    """

    study: ReportData
    drive: Drive
    rows: pd.DataFrame
    spans: Mapping[str, list[SightSpan]]
    lost: Mapping[str, int] | None

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
    def hider(self) -> SightSpan | None:
        """The longest time in which it is hidden from those who know it last, else from those who know it first."""
        for row in (self.last, self.first):
            hidden = [span for span in self.spans.get(str(row["configuration"]), ()) if _is_told(span, HIDDEN)]
            if hidden:
                return max(hidden, key=lambda span: span.end_s - span.begin_s)
        return None


_TOLD_S = 0.1
"""Times that are no longer are left out of sentences: most units list as often."""


def _is_told(span: SightSpan, state: int) -> bool:
    return span.state == state and span.end_s - span.begin_s > _TOLD_S + SAME_INSTANT_S


def listed_until_s(row: Any) -> float:
    """Until when no list has the object, as far as it is known."""
    listed_s = float(np.fmin(row.get("listed_s", np.nan), row["captured_s"]))
    return float(row["ended_s"]) if np.isnan(listed_s) else listed_s


def find_spans(
    study: ReportData, drive: Drive, run: int, told: Mapping[str, pd.DataFrame]
) -> dict[str, dict[str, list[SightSpan]]]:
    """What the units of each configuration have of each object of `told` in a run, by object and configuration."""
    replayed = replay_run(study.results.recording(drive.log, drive.experiment), drive.experiment, run)
    replay, shown = replayed.replay, [drive.scene.object_number[name] for name in told]
    sight = compute_sight(replay, replayed.experiment, shown)
    expanded = replay.expanded
    return {
        name: {
            str(row["configuration"]): list_sight_spans(
                replay, sight, m, expanded.units_of(expanded.configurations[row["configuration"]]),
                float(row["onset_s"]), listed_until_s(row),
            )
            for _, row in rows.iterrows()
        }
        for m, (name, rows) in enumerate(told.items())
    }  # fmt: skip


def world_at(drive: Drive, time_s: float) -> Tracks:
    """The truth at an instant, in seconds since the log's start."""
    gap_s, t0_ns = drive.experiment.max_gap_s, drive.scene.t0_ns
    return interpolate_at_instants(drive.truth, np.array([t0_ns + round(time_s * 1e9)]), t0_ns=t0_ns, max_gap_s=gap_s)


def unit_pose(drive: Drive, name: str, unit: Unit, world: Tracks) -> UnitPoses:
    """Where a unit is in a world of one instant."""
    return compute_unit_poses(drive.scene, unit, world, unit_ground(drive.truth, name, unit))


def count_lost_lists(
    study: ReportData, drive: Drive, run: int, told: Mapping[str, pd.DataFrame]
) -> dict[str, dict[str, int]] | None:
    """How many lists with each object the radio lost, after its onset and before the capture that made it known.

    `told`: the rows of each object. By object and configuration, nothing where all first lists arrived; None: the run
    cannot be replayed again, or comes out otherwise.
    """
    until_s = {
        (name, str(row["configuration"])): float(row["captured_s"] if row["detected"] else row["ended_s"])
        for name, rows in told.items()
        for _, row in rows.iterrows()
    }
    waits = {
        str(row["configuration"])
        for name, rows in told.items()
        for _, row in rows.iterrows()
        if float(row.get("listed_s", np.nan)) < until_s[name, str(row["configuration"])] - SAME_INSTANT_S
    }
    if not waits:
        return {}
    lost: dict[tuple[str, str], set[tuple[int, float]]] = defaultdict(set)
    try:
        replayed, _ = replay_again(study.results, drive.log, run, waits)
        for chunk in replayed.run_tracks:  # a list near the border of two chunks is in both
            for (name, configuration), end_s in until_s.items():
                if configuration in chunk:
                    since_s = float(told[name]["onset_s"].iloc[0])
                    found = find_lost(chunk[configuration], drive.scene.object_number[name], since_s, end_s)
                    lost[name, configuration] |= found
    except CopemError:
        return None
    counts: dict[str, dict[str, int]] = defaultdict(dict)
    for (name, configuration), lists in lost.items():
        counts[name][configuration] = len(lists)
    return counts


def find_lost(fused_tracks: FusedTracks, object_ix: int, since_s: float, until_s: float) -> set[tuple[int, float]]:
    """Unit and capture of each list with an object that was sent by a link and never arrives."""
    lists, by_link = fused_tracks.received, fused_tracks.by_link
    if by_link is None:
        return set()
    frames = np.unique(lists.frame_ix[(lists.row_object_ix == object_ix) & lists.valid[0]])
    captured_s = lists.captured_s[frames]
    during = (captured_s >= since_s - SAME_INSTANT_S) & (captured_s < until_s - SAME_INSTANT_S)
    frames = frames[during & by_link[frames] & ~np.isfinite(lists.common_arrives_s[frames])]
    return set(zip(lists.frame_unit_ix[frames].tolist(), lists.captured_s[frames].round(6).tolist(), strict=True))


# Why, in a sentence.


def explain_story(story: ObjectStory) -> str:
    """What the last configuration had of an object until it knew it, and what the first one had, in one sentence."""
    first, last = story.first, story.last
    told = [last, first] if last["unknown_s"] - first["unknown_s"] > SAME_INSTANT_S else [last]
    return "; ".join(f"{row['configuration']}: {', '.join(_tell_row(story, row))}" for row in told) + "."


def _tell_row(story: ObjectStory, row: Any) -> Iterator[str]:
    """The clauses of a configuration, in the order of time; seconds are after the onset."""
    for span in story.spans.get(str(row["configuration"]), ()):
        if _is_told(span, span.state):
            to_end = span.end_s >= row["ended_s"] - SAME_INSTANT_S
            until = "to the end" if to_end else f"until {format_seconds(span.end_s - story.onset_s)}"
            words = _SPAN_WORDS[span.state].format(body=span.body, unit=span.unit)
            yield f"{words if span.state != IN_SIGHT or _knows_lists(story, row) else _NOT_COUNTED} {until}"
    yield from _tell_lists(story, row)
    after_s = float(row["unknown_s"])
    when = f"after {format_seconds(after_s)}" if after_s > SAME_INSTANT_S else "at once"
    yield f"known {when}{_tell_informing(story, row)}" if row["detected"] else "never known"


_SPAN_WORDS = {
    NO_UNIT: "no unit there", OUT_OF_VIEW: "out of range or view", HIDDEN: "behind {body} (from {unit})",
    IN_SIGHT: "in sight, not listed",
}  # fmt: skip
"""The words of lanes."""


_NOT_COUNTED = "in sight, in no list that counts"


def _knows_lists(story: ObjectStory, row: Any) -> bool:
    """Whether it is known when the object was first listed: by a column, or as the first list makes it known."""
    by_first = story.study.results.facts[str(row["configuration"])].by_truth_id
    return not np.isnan(row.get("listed_s", np.nan)) or (by_first and story.drive.experiment.measure.confirm.hits == 1)


def _tell_lists(story: ObjectStory, row: Any) -> Iterator[str]:
    """What became of lists with the object before the one that made it known."""
    lost, listed_s = None if story.lost is None else story.lost.get(str(row["configuration"]), 0), row.get("listed_s")
    if not row["detected"]:
        if lost:
            yield f"the radio lost {count_noun(lost, 'list')} with it"
    elif listed_s is not None and row["captured_s"] - listed_s > SAME_INSTANT_S and listed_s >= story.onset_s:
        fate = "the first of these lists were lost, late or held back"
        if lost is not None:
            fate = f"the radio lost {count_noun(lost, 'list')}" if lost else "these lists were late or held back"
        after_s = listed_s - story.onset_s
        since = f"{format_seconds(after_s)} on" if after_s > SAME_INSTANT_S else "the onset on"
        yield f"listed from {since} ({fate})"


def _tell_informing(story: ObjectStory, row: Any) -> str:
    """`, by the ego's own list, which arrives 0.50 s late`."""
    unit, took_s = row.get("first_unit"), row["detection_s"] - row["captured_s"]
    if not isinstance(unit, str) or not unit:
        return ""
    modelled, scene = story.drive.experiment.modelled, story.drive.scene
    aboard = unit in modelled and find_carrier(scene, modelled[unit]) == scene.ego_ix >= 0
    whose = "the ego's own list" if aboard else f"the list of {unit}"
    return f", by {whose}" + (f", which arrives {format_seconds(took_s)} late" if took_s > SAME_INSTANT_S else "")


def format_seconds(time_s: float) -> str:
    """`2.30 s`, never `−0.00 s`."""
    return f"{round(time_s, 2) + 0.0:.2f} s".replace("-", "−")

"""Facts of a story: who knows an object first and last, and what becomes of it until then; and a sentence of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from copem_replay.core.errors import CopemError
from copem_replay.core.interpolation import interpolate_at_instants
from copem_replay.core.tracks import SAME_INSTANT_S, Tracks
from copem_replay.experiment.schema import Unit
from copem_replay.metrics.detections_table import first_episodes
from copem_replay.perception.sensor_poses import UnitPoses, compute_unit_poses, find_carrier, unit_ground
from copem_replay.perception.sight import HIDDEN
from copem_replay.pipeline.sight import StatusSpan, compute_sight
from copem_replay.pipeline.status import compute_status, list_status_spans, read_episode_clocks
from copem_replay.report.figures.paths import Drive
from copem_replay.report.figures.style import shorten_names
from copem_replay.report.html.study import ReportData
from copem_replay.results.again import replay_again
from copem_replay.viewer.rrd import TrackCollector
from copem_replay.viewer.status import lane_text

# Facts of a story.


@dataclass(frozen=True)
class ObjectStory:
    """One object in one run. `rows`: of its first episode, a row per configuration, with `unknown_s`.

    `spans`: by configuration its status until it is known, as lanes have it; none: the run cannot be replayed again.
    """

    study: ReportData
    drive: Drive
    rows: pd.DataFrame
    spans: Mapping[str, list[StatusSpan]]

    @property
    def name(self) -> str:
        """The class and id of the object: `pedestrian 61`."""
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
        """The row of the configuration that knows it first; of equals the first one."""
        return self.rows.loc[self.rows["unknown_s"].idxmin()]

    @property
    def last(self) -> Any:
        """The row of the configuration that knows it last, or never."""
        return self.rows.loc[self.rows["unknown_s"].idxmax()]

    def known_s(self, row: Any) -> float:
        """The time from which a configuration knows it; the end of its episode, if it never does."""
        return float(row["detection_s"] if row["detected"] else row["ended_s"])

    @property
    def hider(self) -> StatusSpan | None:
        """The longest time in which it is hidden from those who know it last, else from those who know it first."""
        for row in (self.last, self.first):
            spans = self.spans.get(str(row["configuration"]), ())
            hidden = [span for span in spans if span.status == HIDDEN and _is_told(span)]
            if hidden:
                return max(hidden, key=lambda span: span.end_s - span.begin_s)
        return None


_TOLD_S = 0.1
"""Times that are no longer are left out of sentences: most units list as often."""


def _is_told(span: StatusSpan) -> bool:
    return span.end_s - span.begin_s > _TOLD_S + SAME_INSTANT_S


def find_spans(
    study: ReportData, drive: Drive, run: int, episodes_of: Mapping[str, pd.DataFrame]
) -> dict[str, dict[str, list[StatusSpan]]]:
    """The status of each object of `episodes_of` in a run until it is known, by object and configuration.

    None where the run cannot be replayed again, or comes out otherwise.
    """
    names = list(dict.fromkeys(name for rows in episodes_of.values() for name in rows["configuration"]))
    try:
        replayed, table = replay_again(study.results, drive.log, run, names)
        collector = TrackCollector([drive.scene.object_number[name] for name in episodes_of])
        for chunk in replayed.run_tracks:
            collector.add(chunk)
    except CopemError:
        return {name: {} for name in episodes_of}
    replay, experiment, shown = replayed.replay, replayed.experiment, collector.object_ix.tolist()
    sight, spans = compute_sight(replay, experiment, shown), dict[str, dict[str, list[StatusSpan]]]()
    for configuration, tracks in collector.whole().items():
        clock = read_episode_clocks(drive.scene, first_episodes(table), configuration)
        statuses = compute_status(replay, experiment, configuration, tracks, sight, clock)
        for m, (name, rows) in enumerate(episodes_of.items()):
            of = spans.setdefault(name, {})
            for _, row in rows[rows["configuration"] == configuration].iterrows():
                until_s = row["detection_s"] if row["detected"] else row["ended_s"]
                of[configuration] = list_status_spans(replay, sight, statuses, m, row["onset_s"], until_s)
    return spans


def world_at(drive: Drive, time_s: float) -> Tracks:
    """The truth at an instant, in seconds since the log's start."""
    gap_s, t0_ns = drive.experiment.max_gap_s, drive.scene.t0_ns
    return interpolate_at_instants(drive.truth, np.array([t0_ns + round(time_s * 1e9)]), t0_ns=t0_ns, max_gap_s=gap_s)


def unit_pose(drive: Drive, name: str, unit: Unit, world: Tracks) -> UnitPoses:
    """Where a unit is in a world of one instant."""
    return compute_unit_poses(drive.scene, unit, world, unit_ground(drive.truth, name, unit))


# Why, in a sentence.


def explain_story(story: ObjectStory) -> str:
    """One sentence on how the last configuration came to know an object, and how the first one did."""
    first, last = story.first, story.last
    told = [last, first] if last["unknown_s"] - first["unknown_s"] > SAME_INSTANT_S else [last]
    return "; ".join(f"{row['configuration']}: {', '.join(_tell_row(story, row))}" for row in told) + "."


def _tell_row(story: ObjectStory, row: Any) -> Iterator[str]:
    """The clauses of a configuration, in the order of time; seconds are after the onset."""
    for span in story.spans.get(str(row["configuration"]), ()):
        if _is_told(span):
            to_end = span.end_s >= row["ended_s"] - SAME_INSTANT_S
            until = "to the end" if to_end else f"until {format_seconds(span.end_s - story.onset_s)}"
            yield f"{lane_text(span)} {until}"
    after_s = float(row["unknown_s"])
    when = f"after {format_seconds(after_s)}" if after_s > SAME_INSTANT_S else "at once"
    yield f"known {when}{_tell_informing(story, row)}" if row["detected"] else "never known"


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

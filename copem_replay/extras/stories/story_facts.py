"""Facts of a story: who knows an object first and last, what hides it, what the radio lost; and a sentence of it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from copem_replay.core.errors import CopemError, InputError, count_noun
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.interpolation import interpolate_at_instants
from copem_replay.core.tracks import CLASSES, SAME_INSTANT_S, Tracks
from copem_replay.experiment.schema import Unit
from copem_replay.perception.sensor_poses import (
    UnitPoses,
    collect_solids,
    compute_unit_poses,
    find_carrier,
    make_observers,
    make_solid_statics,
    unit_ground,
)
from copem_replay.perception.visibility import find_blockers
from copem_replay.report.figures.paths import Drive
from copem_replay.report.figures.style import shorten_names
from copem_replay.report.html.study import ReportData
from copem_replay.results.again import replay_again

# Facts of a story.


@dataclass(frozen=True)
class ObjectStory:
    """One object in one run. `rows`: of its first episode, a row per configuration, with `unknown_s`.

    `lost`: by configuration how many lists with the object the radio lost until it was known; None: cannot be told.
    """

    study: ReportData
    drive: Drive
    rows: pd.DataFrame
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


def explain_story(story: ObjectStory, hider: tuple[str, int] | None) -> str:
    """What hid an object, why the last configuration knows it late, and how the first one knows it, in one sentence."""
    first, last, hidden_s = story.first, story.last, story.hidden_s(story.blind)
    parts = []
    if hidden_s > SAME_INSTANT_S:
        name = str(story.blind["configuration"])
        where = (
            f"Hidden from {story.blind_unit()} behind {hider[0]}" if hider else f"Out of sight of the units of {name}"
        )
        until = format_seconds(hidden_s) if story.blind["detected"] or story.blind["in_sight_s"] > 0 else "the end"
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
    after_s = float(row["unknown_s"])
    return f"knows it after {format_seconds(after_s)}" if after_s > SAME_INSTANT_S else "knows it at once"


def _tell_captured(row: Any, story: ObjectStory) -> str:
    """By which unit's list, what became of lists before it, and how long it took to come."""
    lost = None if story.lost is None else story.lost.get(str(row["configuration"]), 0)
    if not row["detected"]:
        seen = "" if np.isnan(row["in_sight_s"]) else f", though {_tell_sight(story, row['in_sight_s'])}"
        return f"{seen}; the radio lost {count_noun(lost, 'list')} with it" if lost else seen
    unit, took_s = row.get("first_unit"), row["detection_s"] - row["captured_s"]
    told = f" by {unit}" if isinstance(unit, str) and unit else ""
    listed_s, since_s = float(row.get("listed_s", np.nan)), max(float(row["in_sight_s"]), story.onset_s)
    if row["captured_s"] - listed_s > SAME_INSTANT_S and listed_s >= story.onset_s:
        fate = "the first of these lists were lost, late or held back"
        if lost is not None:
            fate = f"the radio lost {count_noun(lost, 'list')}" if lost else "these lists were late or held back"
        after_s = listed_s - story.onset_s
        since = f"{format_seconds(after_s)} on" if after_s > SAME_INSTANT_S else "the onset on"
        told += f" (listed from {since}; {fate})"
    elif row["captured_s"] - since_s > SAME_INSTANT_S:
        told += f" ({_tell_sight(story, since_s)}, but in no list that counts)"
    return told + (f", whose list takes {format_seconds(took_s)}" if took_s > SAME_INSTANT_S and told else "")


def _tell_sight(story: ObjectStory, since_s: float) -> str:
    after_s = max(since_s - story.onset_s, 0.0)
    return f"in sight from {format_seconds(after_s)} on" if after_s > SAME_INSTANT_S else "in sight from the onset on"


def format_seconds(time_s: float) -> str:
    """`2.30 s`, never `−0.00 s`."""
    return f"{round(time_s, 2) + 0.0:.2f} s".replace("-", "−")

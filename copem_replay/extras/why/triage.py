"""Triage: late episodes of a configuration in groups that have one story, ranked by the seconds that they cost.

An episode is late where its object is unknown for more than a second. Its cause is the one that adds most in the chain
(`causes.py`); a group is a drive and a cause, whatever hides its objects, or on whichever side of the ego they are.
An episode is late by structure where it stays late although nothing in sight is missed, else by chance. Definitions:
docs/guide/why.md.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from copem_replay.core.errors import name_first
from copem_replay.core.tracks import SAME_INSTANT_S, Float, Int
from copem_replay.extras.why.causes import CAUSES, LEFT, CauseShares, Counterfactuals, name_cause
from copem_replay.perception.sight import HIDDEN
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.sight import compute_sight, list_sight_spans
from copem_replay.results.shown_objects import is_observed

LATE_S = 1.0
"""An episode that is unknown for longer is late: on fourteen recorded drives, four fifths of all seconds."""
TOO_SHORT = "all too short to judge"
"""Of a group without an object that viewers show."""
_MOST_LATE = 0.05
"""Episodes that are late in a larger share of the runs are in the groups."""
_HELPED = ("hidden", "rate", "outages", "range", "missed", "memory", "fusion", "pose", "ghosts")
"""Causes of sensors and of the fusion: what stays unknown without these nobody can know in time."""
EPISODE = ["log", "object_id", "episode"]
_NAMED = 3


def tabulate_episodes(replays: Counterfactuals, shares: Sequence[CauseShares], late_s: float = LATE_S) -> pd.DataFrame:
    """A row for each episode of a log: the means over runs of its seconds, in all and by cause, and what became of it.

    `late_share`, `never_share`: of the runs; `structural_share`: late although nothing is missed; `hopeless_share`: not
    known in time even if every list of every unit held it. `cause`: the one that adds most. What recorded units missed
    is not known: structural is NaN, and nothing is hopeless.
    """
    rows, gone = replays.rows, [share.cause for share in shares if share.gained_s is not None]
    unknown_s, length_s = rows["unknown_s"].to_numpy(), (rows["ended_s"] - rows["onset_s"]).to_numpy(dtype=float)
    unmissed_s = replays.unknown_s([cause for cause in gone if cause.name in ("missed", "memory")])
    at_best_s = replays.unknown_s([cause for cause in gone if cause.name in _HELPED])
    structural, hopeless = (unmissed_s > late_s).astype(float), at_best_s >= length_s - SAME_INSTANT_S
    if replays.only.recorded:
        structural, hopeless = np.full(len(rows), np.nan), np.zeros(len(rows), dtype=bool)
    names = [name_cause(share) for share in shares]
    values = pd.DataFrame({
        "unknown_s": unknown_s, "late_share": unknown_s > late_s, "structural_share": structural,
        "never_share": rows["detection_s"].isna().to_numpy(), "hopeless_share": hopeless,
        **{f"added {name}": share.added_s for name, share in zip(names, shares, strict=True)},
    }).astype(float)  # fmt: skip
    keys = [*EPISODE, "object_class", "onset_s", "ended_s"]
    values[keys] = rows[keys].reset_index(drop=True)
    table = values.groupby(keys, sort=False).mean().reset_index()
    added = table[[f"added {name}" for name in names]].to_numpy()
    table["cause"] = np.array(names, dtype=object)[added.argmax(axis=1)]
    return table


def group_late_episodes(
    replays: Counterfactuals, shares: Sequence[CauseShares], late_s: float = LATE_S
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The rows of `triage.csv` of a log, and its episodes with the group of each that is late."""
    episodes = tabulate_episodes(replays, shares, late_s)
    is_late = (episodes["late_share"] > _MOST_LATE) & (episodes["hopeless_share"] < 1)
    episodes[["where", "hidden_by"]] = ""
    if is_late.any():
        episodes.loc[is_late, ["where", "hidden_by"]] = find_places(replays.replay, episodes[is_late])
    grouped, none_is = [], not is_observed(episodes).any()  # then some are shown all the same
    for (log, cause), rows in episodes[is_late].groupby(["log", "cause"], sort=False):
        judged = rows[is_observed(rows) | none_is]
        worst = rows.loc[(judged if len(judged) else rows)["unknown_s"].idxmax()]
        grouped.append({
            "log": log, "cause": cause, "where": name_places(rows), "episodes": len(rows),
            "objects": rows["object_id"].nunique(), "lost_s": rows["unknown_s"].sum(),
            "never_share": rows["never_share"].mean(), "structural_share": _share_structural(rows["structural_share"]),
            "example": worst["object_id"] if len(judged) else "",
            "example_class": worst["object_class"], "example_onset_s": worst["onset_s"],
        })  # fmt: skip
    return rank_groups(pd.DataFrame(grouped, columns=COLUMNS)), episodes


def name_places(late: pd.DataFrame) -> str:
    """`bus 12 for 3.1 s, car 5 for 1.2 s`: where a group loses its seconds, the most first; one place alone."""
    lost_s = late[late["where"] != ""].groupby("where")["unknown_s"].sum().sort_values(ascending=False, kind="stable")
    told = {str(where): f"{where} for {seconds:.1f} s" for where, seconds in lost_s.items()}
    return name_first([*(told.values() if len(told) > 1 else told)], _NAMED)


def _share_structural(of_episodes: pd.Series) -> float:
    known = of_episodes.dropna()
    return float((known > 1 - _MOST_LATE).mean()) if len(known) else float("nan")


def list_late_episodes(episodes: pd.DataFrame, late_s: float = LATE_S) -> pd.DataFrame:
    """The rows of `late_episodes.csv`: episodes unknown for longer than `late_s` in the mean, with the words."""
    late = episodes[episodes["unknown_s"] > late_s]
    words = [describe_episode(episode) for _, episode in late.iterrows()]
    return late.drop(columns="structural_share").assign(words=words).reset_index(drop=True)


COLUMNS = [
    "log", "cause", "where", "episodes", "objects", "lost_s", "never_share", "structural_share", "example",
    "example_class", "example_onset_s",
]  # fmt: skip


def rank_groups(groups: pd.DataFrame) -> pd.DataFrame:
    """The groups, those that cost most first."""
    return groups.sort_values("lost_s", ascending=False, kind="stable", ignore_index=True)


# What hides an object, or where it is.


def find_places(replay: Replay, episodes: pd.DataFrame) -> list[tuple[str, str]]:
    """By row the place, and the body that hides the object most often while it is unknown; empty: none does.

    The place is this body if being hidden is the cause, else the side of the ego.
    """
    ids = {name: number for number, name in enumerate(replay.scene.object_ids)}
    objects: Int = np.array([ids[name] for name in episodes["object_id"]], dtype=np.int64)
    begin_s = episodes["onset_s"].to_numpy(dtype=float)
    until_s = begin_s + episodes["unknown_s"].to_numpy(dtype=float)
    is_hidden = (episodes["cause"] == "hidden").tolist()
    bodies, sides = _find_bodies(replay, objects, begin_s, until_s), _find_sides(replay, objects, begin_s)
    places = zip(bodies, sides, is_hidden, strict=True)
    return [(body if hidden and body else side, body) for body, side, hidden in places]


def _find_bodies(replay: Replay, objects: Int, begin_s: Float, until_s: Float) -> list[str]:
    """By object the words for who hides it longest from the units that have it in view; “”: nobody."""
    (one,) = replay.expanded.configurations.values()
    names, shown = replay.expanded.units_of(one), list(dict.fromkeys(objects.tolist()))
    sight, words = compute_sight(replay, replay.expanded, shown), []
    for k, *between_s in zip(objects.tolist(), begin_s.tolist(), until_s.tolist(), strict=True):
        lasts_s: dict[str, float] = {}
        for span in list_sight_spans(replay, sight, shown.index(k), names, *between_s):
            if span.status == HIDDEN:
                lasts_s[span.body] = lasts_s.get(span.body, 0.0) + span.end_s - span.begin_s
        words.append(max(lasts_s, key=lambda body: lasts_s[body], default=""))
    return words


def _find_sides(replay: Replay, objects: Int, at_s: Float) -> list[str]:
    """By object `ahead`, `left`, `behind` or `right` of the ego at its instant (s); “”: the ego is not there."""
    truth, ego = replay.truth, replay.scene.ego_ix
    if ego < 0:
        return [""] * len(objects)
    sides = []
    for number, begin_s in zip(objects.tolist(), at_s.tolist(), strict=True):
        frame = int(np.searchsorted(truth.captured_s, begin_s - SAME_INSTANT_S))
        rows = np.flatnonzero(truth.frame_ix == frame)
        object_rows, of_ego = rows[truth.row_object_ix[rows] == number], rows[truth.row_object_ix[rows] == ego]
        if not len(object_rows) or not len(of_ego):
            sides.append("")
            continue
        dx, dy = (float(column[0, object_rows[0]] - column[0, of_ego[0]]) for column in (truth.x_m, truth.y_m))
        turn = np.arctan2(dy, dx) - truth.yaw_rad[0, of_ego[0]]
        sides.append(("ahead", "left", "behind", "right")[int(np.round(turn / (np.pi / 2))) % 4])
    return sides


# In words.


def describe_structure(structural_share: float) -> str:
    """`, by structure`: late although nothing in sight is missed; `, by chance`; or the share; empty where unknown."""
    if np.isnan(structural_share):
        return ""
    sure = {1.0: "by structure", 0.0: "by chance"}
    return f", {sure.get(structural_share, f'{structural_share:.0%} of it by structure')}"


def describe_episode(episode: pd.Series) -> str:
    """Why an object is late: `1.9 s late: 1.2 hidden by bus 12, 0.5 latency`; parts below .05 s are left out."""
    parts = []
    for cause in (*LEFT.values(), *CAUSES):
        added_s = float(episode.get(f"added {cause.name}", 0.0))
        if added_s >= 0.05:
            by = f"hidden by {episode['hidden_by']}" if cause.name == "hidden" and episode["hidden_by"] else cause.words
            parts.append(f"{added_s:.1f} {by}")
    return f"{episode['unknown_s']:.1f} s late" + (f": {', '.join(parts)}" if parts else "")

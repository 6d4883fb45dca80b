"""What is held at frames of the truth, frame by frame and object by object in plain Python."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from copem_replay.core.object_list import ObjectLists
from copem_replay.metrics.accuracy.statistics import AccuracySettings
from copem_replay.metrics.episodes import Episodes, Reference
from copem_replay.metrics.matching import GHOST, MATCH, Matches
from tests.oracles.accuracy import SAME_S, Array, Places, best_pairs, is_annotated, likely, nearest_of

Key = tuple[int, int, int]
"""Run, episode and frame."""


def list_at(issue_s: Sequence[float], time_s: float, max_age_s: float) -> int | None:
    """The newest list that is available then, none where it has been for too long."""
    there = [k for k, since_s in enumerate(issue_s) if since_s <= time_s + SAME_S]
    return there[-1] if there and time_s - issue_s[there[-1]] <= max_age_s + SAME_S else None


def held_plainly(
    lists: ObjectLists, about: Matches, issue_s: Array, frame_s: Array, places: Places, episodes: Episodes,
    reference: Reference, measured: Array, settings: AccuracySettings, max_age_s: float,
) -> tuple[dict[Key, float], dict[Key, float], dict[Key, float], list[int]]:  # fmt: skip
    """Errors, ages and parts of GOSPA, and by run how many held entries have no true object. `places`: at frames."""
    error_m: dict[Key, float] = {}
    age_s: dict[Key, float] = {}
    gospa: dict[Key, float] = {}
    gone = [0] * len(lists.start)
    unit = settings.cutoff_m**settings.power
    episode_of = {int(o): m for m, o in enumerate(episodes.object_ix)}
    for s in range(len(lists.start)):
        for g, time_s in enumerate(frame_s):
            if not reference.present[g]:
                continue
            here = [
                (m, np.array(place))
                for o, m in episode_of.items()
                if (place := places[o][g]) is not None
                and episodes.onset_s[m] - SAME_S <= time_s <= episodes.ended_s[m] + SAME_S
            ]
            k = list_at(issue_s.tolist(), float(time_s), max_age_s)
            those = range(0) if k is None else range(lists.start[s, k], lists.start[s, k + 1])
            estimates: list[Any] = []
            for i in those:
                entry, role = lists.entries[i], about.role[i]
                place = np.array([entry["x_m"], entry["y_m"]])
                away_m = float(np.hypot(place[0] - reference.x_m[g], place[1] - reference.y_m[g]))
                false = role == GHOST and bool(measured[likely(entry)])
                if role != GHOST and int(about.object_ix[i]) in episode_of:
                    m = episode_of[int(about.object_ix[i])]
                    if places[int(about.object_ix[i])][g] is None and time_s >= episodes.onset_s[m] - SAME_S:
                        gone[s] += 1
                        false = True
                    for target, true_place in here:
                        if target != m:
                            continue
                        estimates.append(place)
                        if role == MATCH:
                            error_m[s, m, g] = float(np.hypot(*(place - true_place)))
                            age_s[s, m, g] = float(time_s - entry["captured_s"])
                if false and is_annotated(settings, place, away_m):
                    estimates.append(place)
            pairs = best_pairs(
                np.array([place for _, place in here]), np.array(estimates), settings.cutoff_m, settings.power
            )
            for h, (m, _) in enumerate(here):
                gospa[s, m, g] = pairs[h][1] ** settings.power if h in pairs else unit / 2
            for b in set(range(len(estimates))) - {b for b, _ in pairs.values()}:
                h = nearest_of(here, estimates[b])
                if h is not None:
                    gospa[s, here[h][0], g] += unit / 2
    return error_m, age_s, gospa, gone

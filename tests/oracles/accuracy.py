"""What the sums of accuracy mean, list by list and object by object in plain Python; and truths built by hand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely
from scipy.optimize import linear_sum_assignment
from scipy.special import gammainc

from copem_replay.core.object_list import ObjectLists
from copem_replay.core.tracks import CLASSES, TRUTH, VALUES, Scene, Tracks
from copem_replay.metrics.accuracy.statistics import BAND, EXISTENCE, OBJECT, RUN, Accuracy, AccuracySettings
from copem_replay.metrics.episodes import Episodes, Reference
from copem_replay.metrics.matching import DUPLICATE, GHOST, MATCH, Matches

Array = npt.NDArray[Any]
SAME_S = 1e-6
Places = Mapping[int, Sequence[tuple[float, float] | None]]
"""Where each object is at each instant; None: not in the truth."""


def truth_of(
    places: Places, times_s: Sequence[float], velocity: Mapping[int, tuple[float, float]] | None = None
) -> Tracks:
    """The truth at instants, its tracks in the order given; `velocity` by object, else all stand."""
    there = {o: [k for k, place in enumerate(row) if place is not None] for o, row in places.items()}
    objects = [o for o in places if there[o]]
    rows = [(o, k) for o in objects for k in there[o]]
    values = {name: np.zeros((1, len(rows))) for name in VALUES}
    for p, (o, k) in enumerate(rows):
        place = places[o][k]
        assert place is not None
        values["x_m"][0, p], values["y_m"][0, p] = place
        values["vx_mps"][0, p], values["vy_mps"][0, p] = (velocity or {}).get(o, (0.0, 0.0))
    times = np.array(times_s, dtype=float)
    return Tracks(
        units=(TRUTH,),
        start=np.cumsum([0, *(len(there[o]) for o in objects)]),
        unit_ix=np.zeros(len(objects), dtype=int),
        object_ix=np.array(objects, dtype=int),
        frame_ix=np.array([k for _, k in rows], dtype=int),
        stamp_ns=np.rint(times * 1e9).astype(np.int64),
        captured_s=times,
        frame_unit_ix=np.zeros(len(times), dtype=int),
        arrives_s=times[None],
        valid=np.ones((1, len(rows)), dtype=bool),
        **values,
    )


def scene_of(*classes: str) -> Scene:
    """Objects of these classes; the first is the ego."""
    return Scene(
        log="log",
        t0_ns=0,
        end_ns=10**12,
        object_ids=tuple(map(str, range(len(classes)))),
        object_class=np.array([CLASSES.index(name) for name in classes], dtype=np.int8),
        moving=np.ones(len(classes), dtype=bool),
        ego_ix=0,
    )


def episodes_of(episodes: Mapping[int, tuple[float, float]]) -> Episodes:
    """Onset and end by object."""
    onset, end = (np.array([episode[q] for episode in episodes.values()], dtype=float) for q in (0, 1))
    nothing = np.zeros(len(onset), dtype=int)
    before_s = np.full(len(onset), -np.inf)
    return Episodes(np.array(list(episodes), dtype=int), nothing, onset, nothing, end, nothing, before_s, nothing)


def reference_of(places: Sequence[tuple[float, float] | None]) -> Reference:
    """A point to measure from, at each list; None: absent."""
    x, y = (np.array([np.nan if place is None else place[q] for place in places], dtype=float) for q in (0, 1))
    return Reference(x, y, *(np.zeros(len(places)) for _ in range(3)), np.array([p is not None for p in places], bool))


def likely(entry: Any) -> int:
    """Its most probable class."""
    return list(entry["class_probability"]).index(max(entry["class_probability"]))


def band_of(edges: Sequence[float], value: float) -> int | None:
    for d in range(len(edges) - 1):
        if edges[d] <= value < edges[d + 1]:
            return d
    return None


def is_annotated(settings: AccuracySettings, place: Array, away_m: float) -> bool:
    """Whether the truth is annotated at a place that is so far from the reference."""
    corners = settings.annotated_m
    inside = not corners or shapely.Polygon(corners).buffer(1e-6).covers(shapely.Point(place))
    return inside and away_m <= settings.annotated_range_m + 1e-6


def best_pairs(truth: Array, estimates: Array, cutoff_m: float, power: float) -> dict[int, tuple[int, float]]:
    """Of each truth that has one the partner and the distance."""
    away = np.array([[np.hypot(*(t - b)) for b in estimates] for t in truth]).reshape(len(truth), len(estimates))
    cost = np.minimum(away, cutoff_m) ** power
    return {
        int(i): (int(j), float(away[i, j]))
        for i, j in zip(*linear_sum_assignment(cost), strict=True)
        if away[i, j] < cutoff_m
    }


def nearest_of(here: list[tuple[int, Array]], place: Array) -> int | None:
    return min(range(len(here)), key=lambda h: np.hypot(*(here[h][1] - place)), default=None)


def nees_of(entry: Any, error: Array) -> float:
    covariance = np.array([[entry["cov_ee_m2"], entry["cov_en_m2"]], [entry["cov_en_m2"], entry["cov_nn_m2"]]])
    size, direction = np.linalg.eigh(covariance)
    return float(sum((error @ direction[:, q]) ** 2 / max(size[q], 1e-9) for q in (0, 1)))


def expected_of(entry: Any, gate_m: float) -> tuple[float, float, float]:
    """Share beyond the gate, mean and mean square of NEES of what is within, by integrals over 64 directions."""
    covariance = np.array([[entry["cov_ee_m2"], entry["cov_en_m2"]], [entry["cov_en_m2"], entry["cov_nn_m2"]]])
    small, large = np.maximum(np.linalg.eigvalsh(covariance), 1e-9)
    angle = (np.arange(64) + 0.5) * 2 * np.pi / 64
    limit = gate_m**2 / (large * np.cos(angle) ** 2 + small * np.sin(angle) ** 2)
    # χ² of two degrees of freedom is the gamma distribution of shape 1 and scale 2.
    below, first, second = (np.mean(gammainc(k, limit / 2)) for k in (1, 2, 3))
    return 1 - below, 2 * first / below, 8 * second / below


def plainly(
    lists: ObjectLists, about: Matches, now: Matches, issue_s: Array, places: Places,
    velocity: Mapping[int, tuple[float, float]], captures_s: Sequence[float] | None, places_captured: Places,
    episodes: Episodes, stay_from_s: Array, reference: Reference, measured: Array, settings: AccuracySettings,
) -> Accuracy:  # fmt: skip
    """The same as `assess`, by the sentences of its module. `captures_s`: None, entries tell of now."""
    S, K, M = len(lists.start), len(issue_s), len(episodes.object_ix)
    edges = {"by_distance": settings.distance_edges_m, "by_time": settings.time_edges_s}
    window = [
        [k for k in range(K) if stay_from_s[m] - SAME_S <= issue_s[k] <= episodes.ended_s[m] + SAME_S] for m in range(M)
    ]
    column = {(m, k): c for c, (m, k) in enumerate((m, k) for m in range(M) for k in window[m])}
    by_object, by_run = np.zeros((S, M), OBJECT), np.zeros(S, RUN)
    banded = {name: np.zeros((S, max(len(given) - 1, 0)), BAND) for name, given in edges.items()}
    by_existence = np.zeros((S, 10), EXISTENCE)
    ghosts_at = np.zeros((S, len(settings.existence_thresholds)), dtype=int)
    error_m, gospa = (np.full((S, len(column)), np.nan, dtype=np.float32) for _ in range(2))

    present = [k for k in range(K) if reference.present[k]]
    by_run["lists"] = len(present)
    by_run["time_s"] = sum(issue_s[k + 1] - issue_s[k] for k in present if k + 1 in present)

    def at(o: int, k: int) -> Array | None:
        place = places[o][k] if o in places else None
        return None if place is None else np.array(place)

    def away(k: int, place: Array) -> float:
        return float(np.hypot(place[0] - reference.x_m[k], place[1] - reference.y_m[k]))

    def bands(s: int, k: int, place: Array) -> list[Any]:
        found = {
            "by_distance": band_of(edges["by_distance"], away(k, place)),
            "by_time": band_of(edges["by_time"], float(issue_s[k])),
        }
        return [banded[name][s, d : d + 1] for name, d in found.items() if d is not None]

    for s in range(S):
        for m, o in enumerate(episodes.object_ix):
            stay = [k for k in window[m] if k in present and at(o, k) is not None]
            known: list[tuple[float, bool]] = []
            tracks: list[int] = []
            for k in stay:
                place = at(o, k)
                assert place is not None
                mine: list[Any] = []
                for i in range(lists.start[s, k], lists.start[s, k + 1]):
                    if now.object_ix[i] == o and now.role[i] == MATCH:
                        mine.append(lists.entries[i])
                    if now.object_ix[i] == o and now.role[i] == DUPLICATE:
                        by_object[s, m]["duplicates"] += issue_s[k] >= episodes.onset_s[m] - SAME_S
                assert len(mine) <= 1
                known.append((float(issue_s[k]), bool(mine)))
                if issue_s[k] >= episodes.onset_s[m] - SAME_S:
                    for one in [by_object[s, m : m + 1], *bands(s, k, place)]:
                        one["looked"] += 1
                        one["missed"] += not mine
            for k in [k for k in window[m] if k in present]:  # gaps of the truth are no matter here
                those = range(lists.start[s, k], lists.start[s, k + 1])
                paired = [lists.entries[i] for i in those if about.object_ix[i] == o and about.role[i] == MATCH]
                assert len(paired) <= 1
                if not paired:
                    continue
                (entry,) = paired
                if captures_s is None:
                    then = places[o][k]
                else:
                    f = min(range(len(captures_s)), key=lambda f: abs(captures_s[f] - entry["captured_s"]))
                    assert abs(captures_s[f] - entry["captured_s"]) <= SAME_S
                    then = places_captured[o][f]
                assert then is not None, "nobody is there in a gap of the truth"
                off = np.array([entry["x_m"], entry["y_m"]]) - then
                assert np.hypot(*off) <= settings.gate_m + 1e-6
                by_object[s, m]["square_then_m2"] += off @ off
                by_object[s, m]["age_of_information_s"] += issue_s[k] - entry["captured_s"]
                beyond, mean, square = expected_of(entry, settings.gate_m)
                by_object[s, m]["beyond_gate"] += beyond
                by_object[s, m]["nees_square_expected"] += square
                place = at(o, k)
                sums = [by_object[s, m : m + 1]]
                if place is not None:
                    sums += bands(s, k, place)
                elif (d := band_of(edges["by_time"], float(issue_s[k]))) is not None:
                    sums.append(banded["by_time"][s, d : d + 1])
                for one in sums:
                    one["pairs"] += 1
                    one["nees"] += nees_of(entry, off)
                    one["nees_expected"] += mean
                if entry["track_id"] >= 0:
                    tracks.append(int(entry["track_id"]))
                if place is None:
                    continue
                error = np.array([entry["x_m"], entry["y_m"]]) - place
                error_m[s, column[m, k]] = np.hypot(*error)
                for one in sums:
                    one["placed"] += 1
                    one["square_m2"] += error @ error
                    one["east_m"] += error[0]
                    one["north_m"] += error[1]
                speed = np.array([entry["vx_mps"], entry["vy_mps"]]) - np.array(velocity.get(o, (0.0, 0.0)))
                by_object[s, m]["velocity_square_m2ps2"] += speed @ speed
            by_object[s, m]["tracked"] = len(tracks)
            by_object[s, m]["switches"] = sum(a != b for a, b in pairwise(tracks))
            by_object[s, m]["longest_gap_s"] = longest_unknown(known, episodes.onset_s[m], episodes.ended_s[m])
        for k in present:
            here = [
                (m, place)
                for m, o in enumerate(episodes.object_ix)
                if (place := at(o, k)) is not None
                and k in window[m]
                and episodes.onset_s[m] - SAME_S <= issue_s[k] <= episodes.ended_s[m] + SAME_S
            ]
            estimates = []
            for i in range(lists.start[s, k], lists.start[s, k + 1]):
                entry, role, o = lists.entries[i], now.role[i], now.object_ix[i]
                place = np.array([entry["x_m"], entry["y_m"]])
                by_run[s]["duplicates"] += role == DUPLICATE and o in episodes.object_ix
                is_measured = bool(measured[likely(entry)])
                unknown = not is_annotated(settings, place, away(k, place))
                by_run[s]["unannotated"] += is_measured and unknown and role == GHOST
                if is_measured and not (unknown and about.role[i] == GHOST):
                    claim = by_existence[s, min(int(entry["existence"] * 10), 9)]
                    claim["entries"] += 1
                    claim["existence"] += entry["existence"]
                    claim["with_object"] += about.role[i] != GHOST
                if about.role[i] == role == GHOST and is_measured and not unknown:
                    by_run[s]["ghosts"] += 1
                    ghosts_at[s] += entry["existence"] >= np.array(settings.existence_thresholds)
                    for one in bands(s, k, place):
                        one["ghosts"] += 1
                    h = nearest_of(here, place)
                    if h is not None:
                        by_object[s, here[h][0]]["ghosts"] += 1
                if role == GHOST and is_measured and not unknown:
                    by_run[s]["stale_ghosts"] += about.role[i] != GHOST
                    estimates.append(place)
                elif role != GHOST and o in [episodes.object_ix[m] for m, _ in here]:
                    estimates.append(place)
            if not here:
                continue
            by_run[s]["lists_looked"] += 1
            unit = settings.cutoff_m**settings.power
            pairs = best_pairs(
                np.array([place for _, place in here]), np.array(estimates), settings.cutoff_m, settings.power
            )
            parts = {h: [0.0, 0.0, 0.0] for h in range(len(here))}
            for h in parts:
                if h in pairs:
                    parts[h][0] = pairs[h][1] ** settings.power
                else:
                    parts[h][1] = unit / 2
            for b in set(range(len(estimates))) - {b for b, _ in pairs.values()}:
                h = nearest_of(here, estimates[b])
                assert h is not None
                parts[h][2] += unit / 2
            for h, (m, _) in enumerate(here):
                for q, name in enumerate(("localisation", "missed", "false")):
                    by_object[s, m][f"gospa_{name}"] += parts[h][q]
                gospa[s, column[m, k]] = sum(parts[h])
            most = max(len(here), len(estimates))
            total = sum(d**settings.power for _, d in pairs.values()) + unit * (most - len(pairs))
            by_run[s]["ospa_m"] += (total / most) ** (1 / settings.power)
    return Accuracy(
        settings=settings,
        first_list=np.array([int((issue_s < stay_from_s[m] - SAME_S).sum()) for m in range(M)], dtype=int),
        count=np.array([len(w) for w in window], dtype=int),
        error_m=error_m,
        gospa=gospa,
        by_object=by_object,
        by_run=by_run,
        ghosts_at=ghosts_at,
        by_existence=by_existence,
        **banded,
    )


def longest_unknown(known: list[tuple[float, bool]], onset_s: float, ended_s: float) -> float:
    """The longest stretch of [onset, end] in which the last list said so far held no match."""
    changes = sorted({onset_s, ended_s, *(min(max(t, onset_s), ended_s) for t, _ in known)})
    longest = chunk = 0.0
    for begin, end in pairwise(changes):
        said = [is_known for t, is_known in known if t <= begin + SAME_S]
        chunk = 0.0 if said and said[-1] else chunk + end - begin
        longest = max(longest, chunk)
    return longest


def permuted(
    lists: ObjectLists, matches: Matches | None, rng: np.random.Generator
) -> tuple[ObjectLists, Matches | None, Array]:
    """The same lists, each in another order, and where each entry came from."""
    to = np.arange(len(lists.entries))
    for start in lists.start:
        for a, b in pairwise(start):
            to[a:b] = a + rng.permutation(b - a)
    moved = None if matches is None else taken(matches, to)
    return ObjectLists(lists.start, lists.entries[to]), moved, to


def matches_of(object_ix: Sequence[int], role: Sequence[int]) -> Matches:
    """Objects and roles as given, places that mean nothing."""
    nowhere, nothing = np.full(len(role), np.nan), np.zeros(len(role), dtype=np.int8)
    return Matches(np.array(object_ix, dtype=int), np.array(role, dtype=np.int8), nowhere, nowhere, nothing)


def taken(matches: Matches, rows: Any) -> Matches:
    """Those of some entries."""
    return Matches(*(column[rows] for column in vars(matches).values()))


def one_run(lists: ObjectLists, run: int) -> tuple[ObjectLists, slice]:
    """The lists of one run by itself, and which entries they are."""
    first, last = int(lists.start[run, 0]), int(lists.start[run, -1])
    return ObjectLists(lists.start[run : run + 1] - first, lists.entries[first:last]), slice(first, last)

"""Needless braking: what false alarms cost the driver of a recorded drive.

The driver *brakes* at a list when he must (`metrics/braking/demand.py`) for any entry of it, of whatever class,
measured or not, in `hits` of the last `of` lists (`measure.confirm`). Braking is *needed* where the truth gives a
reason at any tenth of a second of the log that is within `around_s` of the list: he must brake for a true object,
standing ones too, with the margin `wider_m` and the share `needed_at`. Braking that is not needed is *needless*, as
long as he drives, from its list to the next, for `max_age_s` at most. An event is a stretch of it, with pauses of
`merge_s` or less.

The speed that an event loses is that of the driver's deceleration over its needless time, at most the speed at its
begin. *Driving* is the time between frames of the ego in which it is in the log and not slower than `slower_mps`: the
same in all configurations. Entries about the ego itself, and those outside `measure.annotated`, are not asked.

An event is by the surest entry that begins it: a `ghost` at no object, a `duplicate` of another entry, or an entry
about a true object: `late` where the truth of its capture, at the list's instant, demands braking too, else
`misplaced`.

Letters of the shapes: S runs, K lists, T thresholds of existence, G tenths of a second, E events.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from copem_replay.core.interpolation import interpolate_states
from copem_replay.core.object_list import Entries, ObjectLists, TellsOf, join_entries, take_entries, view_as_numbers
from copem_replay.core.tracks import SAME_INSTANT_S, VALUES, Bool, Float, Int, Scene, Tracks
from copem_replay.metrics.accuracy.aggregator import are_annotated
from copem_replay.metrics.accuracy.statistics import AccuracySettings
from copem_replay.metrics.braking.demand import BrakingEgo
from copem_replay.metrics.braking.driver import driver_deceleration
from copem_replay.metrics.config import DUPLICATE_ENTRY, GHOST_ENTRY, LATE, MISPLACED, Confirm, Needless
from copem_replay.metrics.episodes import Reference
from copem_replay.metrics.matching import DUPLICATE, GHOST, Matches

_GRID_S = 0.1
"""Seconds between instants at which the truth is asked."""
_ROWS = 500_000
"""States of the truth that are asked at a time: the size of blocks, which changes no result."""


@dataclass(frozen=True)
class TruthDemand:
    """When the truth gives a reason to brake: at instants `time_s (G,)` whether the driver must, and whether he must
    with tolerance (`needed`); `driven_s (F,)`: seconds of driving before each of the ego's frames.
    """

    braking: BrakingEgo
    asked: Needless
    scene: Scene
    truth: Tracks
    max_gap_s: float
    time_s: Float
    must: Bool
    needed: Bool
    driven_s: Float

    @property
    def driving_s(self) -> float:
        """Seconds of driving in the log."""
        return float(self.driven_s[-1])

    def drive_between(self, begins_s: Float, ends_s: Float) -> Float:
        """(K,) seconds of driving between instants (K,)."""
        before, after = (np.interp(time_s, self.braking.path.frame_s, self.driven_s) for time_s in (begins_s, ends_s))
        return np.asarray(after - before)

    def is_needed(self, time_s: Float) -> Bool:
        """(K,) whether braking is needed within `around_s` of instants (K,), half a tenth more for their distance."""
        reach_s = self.asked.around_s + _GRID_S / 2 + SAME_INSTANT_S
        count = np.concatenate([[0], np.cumsum(self.needed)])
        first, after = (np.searchsorted(self.time_s, time_s + side * reach_s, side="right") for side in (-1, 1))
        needed: Bool = count[after] > count[first]
        return needed


def find_truth_demand(
    braking: BrakingEgo, settings: Needless, scene: Scene, truth: Tracks, max_gap_s: float
) -> TruthDemand:
    """When the truth of a log gives a reason to brake. Raises InputError where a driver of the user's own fails."""
    time_s = np.arange(0.0, scene.end_s + SAME_INSTANT_S, _GRID_S)
    must, needed = np.zeros(len(time_s), dtype=bool), np.zeros(len(time_s), dtype=bool)
    first, last = (
        truth.captured_s[truth.frame_ix[truth.start[:-1] if k == 0 else truth.start[1:] - 1]] for k in (0, 1)
    )
    begin, end = np.searchsorted(time_s, first - SAME_INSTANT_S), np.searchsorted(time_s, last + SAME_INSTANT_S)
    count = np.where(truth.object_ix == scene.ego_ix, 0, np.maximum(end - begin, 0))
    cuts = np.flatnonzero(np.diff(np.cumsum(count) // _ROWS)) + 1
    for tracks in np.split(np.arange(len(count)), cuts):
        steps = np.concatenate([np.arange(begin[k], begin[k] + count[k]) for k in tracks.tolist()] or [np.arange(0)])
        objects = np.repeat(truth.object_ix[tracks], count[tracks])
        states, present = interpolate_states(truth, objects, time_s[steps], t0_ns=scene.t0_ns, max_gap_s=max_gap_s)
        rows, steps = _stack_states(states)[present], steps[present]
        soft = braking.must_brake(time_s, steps, rows, margin_m=settings.wider_m, share=settings.needed_at)
        needed[steps[soft]] = True
        hard = braking.must_brake(time_s, steps, rows, margin_m=settings.margin_m, share=settings.brakes_at)
        must[steps[hard]] = True
    driven_s = _add_up_driving(braking, max_gap_s)
    return TruthDemand(braking, settings, scene, truth, max_gap_s, time_s, must, needed, driven_s)


def _stack_states(states: dict[str, Float]) -> Float:
    """(N, 8) states as the first numbers of entries."""
    return np.ascontiguousarray(np.stack([states[name] for name in VALUES[:8]], axis=1))


def _add_up_driving(braking: BrakingEgo, max_gap_s: float) -> Float:
    after_s, driving = np.diff(braking.path.frame_s), braking.path.frame_mps[:-1] >= braking.slower_mps
    return np.append(0.0, np.cumsum(np.where(driving & (after_s <= max_gap_s + SAME_INSTANT_S), after_s, 0.0)))


@dataclass(frozen=True)
class NeedlessBraking:
    """Needless braking of a configuration in S runs, in seconds and m/s.

    Per run (S,): `brakes`, the number of events; `needless_s`; `speed_lost_mps`, the most; `missed_s`: the truth
    demands braking and the driver does not. `needless_s_at (S, T)`: `needless_s` of only the entries of at least each
    existence. Per event (E,), by run and begin: `entries` that cause it, `class_ix`: their most probable classes,
    `object_id`: the true objects that they match, None: none.
    """

    driving_s: float
    must_brake_s: float
    brakes: Int
    needless_s: Float
    speed_lost_mps: Float
    missed_s: Float
    needless_s_at: Float
    run_ix: Int
    begins_s: Float
    lasts_s: Float
    lost_mps: Float
    cause: np.ndarray  # of CAUSES
    entries: Entries
    class_ix: Int
    object_id: np.ndarray

    def repeated(self, runs: int) -> NeedlessBraking:
        """The braking of `runs` equal runs, from that of one run; itself where it has `runs` already."""
        if len(self.brakes) == runs:
            return self
        per_run = {
            name: np.repeat(getattr(self, name), runs, axis=0)
            for name in ("brakes", "needless_s", "speed_lost_mps", "missed_s", "needless_s_at")
        }
        times = np.tile(np.arange(len(self.run_ix)), runs)
        events = {name: getattr(self, name)[times] for name in _EVENTS if name != "run_ix"}
        run_ix = np.repeat(np.arange(runs), len(self.run_ix))
        return NeedlessBraking(self.driving_s, self.must_brake_s, **per_run, run_ix=run_ix, **events)


_EVENTS = ("run_ix", "begins_s", "lasts_s", "lost_mps", "cause", "entries", "class_ix", "object_id")


class NeedlessDetector:
    """Finds needless braking in the lists of a configuration, time chunk after time chunk.

    `issue_s (K,)`: when its lists of the whole log are available. `reference`: where distances are measured from then.
    """

    def __init__(
        self, truth: TruthDemand, issue_s: Float, reference: Reference, settings: AccuracySettings,
        *, confirm: Confirm, max_age_s: float, runs: int,
    ) -> None:  # fmt: skip
        self._truth, self._issue_s, self._reference, self._settings = truth, issue_s, reference, settings
        self._confirm, self._max_age_s = confirm, max_age_s
        self._added = 0
        self._tells_of: TellsOf = "now"
        ego = truth.braking.path
        self._ego_x_m, self._ego_y_m = ego.locate(ego.course(issue_s).bound_m)
        self._existence = np.full((runs, len(issue_s)), -1.0, dtype=np.float32)
        """Of the surest entry of each list that demands braking; −1: none does."""
        self._parts: list[tuple[Int, Int, Entries, Int, Int, Int]] = []

    def add(self, lists: ObjectLists, matches: Matches, tells_of: TellsOf) -> None:
        """Add the lists of a time chunk, with the matches of their entries when they tell of (`tells_of`)."""
        self._tells_of = tells_of
        braking, settings = self._truth.braking, self._truth.asked
        count = lists.start.shape[1] - 1
        list_ix = np.full(len(lists.entries), -1)
        for start in lists.start:
            list_ix[start[0] : start[-1]] = np.repeat(np.arange(count), np.diff(start))
        issue_s = self._issue_s[self._added : self._added + count]
        demands = braking.must_brake(
            issue_s, list_ix, view_as_numbers(lists.entries), margin_m=settings.margin_m, share=settings.brakes_at
        )
        list_ix += self._added
        rows = np.flatnonzero(demands & (matches.object_ix != self._truth.scene.ego_ix))
        x_m, y_m = (lists.entries[name][rows] for name in ("x_m", "y_m"))
        rows = rows[are_annotated(x_m, y_m, list_ix[rows], self._reference, self._settings)]
        run_ix = np.searchsorted(lists.start[:, 0], rows, side="right") - 1
        rows, run_ix = self._choose_surest(lists.entries, rows, run_ix, list_ix)
        entries, k = take_entries(lists.entries, rows), list_ix[rows]
        self._existence[run_ix, k] = entries["existence"]
        self._parts.append(
            (run_ix, k, entries, matches.object_ix[rows], matches.role[rows].astype(np.int64),
             matches.class_ix[rows].astype(np.int64))
        )  # fmt: skip
        self._added += count

    def _choose_surest(self, entries: Entries, rows: Int, run_ix: Int, which: Int) -> tuple[Int, Int]:
        """Of each run and list one row: of the highest existence the nearest to the ego."""
        k = which[rows]
        away_m = np.hypot(entries["x_m"][rows] - self._ego_x_m[k], entries["y_m"][rows] - self._ego_y_m[k])
        order = np.lexsort((away_m, -entries["existence"][rows], k, run_ix))
        first = np.ones(len(order), dtype=bool)
        first[1:] = (np.diff(run_ix[order]) != 0) | (np.diff(k[order]) != 0)
        return rows[order[first]], run_ix[order[first]]

    def result(self) -> NeedlessBraking:
        """The needless braking over all added lists: totals by run, and one element for each event."""
        truth, runs = self._truth, len(self._existence)
        brakes, held_s = self._confirmed(self._existence >= 0.0), self._list_lasts_s()
        lasts_s = truth.drive_between(self._issue_s, self._issue_s + held_s)
        driving = truth.braking.is_driving(self._issue_s) & ~truth.is_needed(self._issue_s) & (lasts_s > 0.0)
        needless = brakes & driving
        run_ix, k = np.nonzero(needless)
        first, after = _join_events(run_ix, self._issue_s[k], lasts_s[k], truth.asked.merge_s)
        needless_s = np.add.reduceat(lasts_s[k], first) if len(first) else np.zeros(0)
        begin_run, begin_k = run_ix[first], k[first]
        event_lost_mps = self._lose_speed(self._issue_s[begin_k], needless_s)
        entries, object_ix, role, class_ix = self._find_entries(begin_run, begin_k)
        speed_lost = np.zeros(runs)
        np.maximum.at(speed_lost, begin_run, event_lost_mps)
        return NeedlessBraking(
            driving_s=truth.driving_s,
            must_brake_s=float(truth.must.sum() * _GRID_S),
            brakes=np.bincount(begin_run, minlength=runs),
            needless_s=_add_up(needless, lasts_s),
            speed_lost_mps=speed_lost,
            missed_s=self._miss(brakes, held_s),
            needless_s_at=self._find_by_existence(driving, lasts_s),
            run_ix=begin_run,
            begins_s=self._issue_s[begin_k],
            lasts_s=self._issue_s[k[after - 1]] + lasts_s[k[after - 1]] - self._issue_s[begin_k],
            lost_mps=event_lost_mps,
            cause=self._find_causes(entries, object_ix, role, self._issue_s[begin_k]),
            entries=entries,
            class_ix=class_ix,
            object_id=np.array([*truth.scene.object_ids, None], dtype=object)[object_ix],
        )

    def _confirmed(self, demands: Bool) -> Bool:
        """(S, K) whether at least `hits` of the last `window` lists, this one included, demand braking."""
        hits, window = self._confirm.hits, self._confirm.of
        if window == 1:
            return demands
        count = np.cumsum(demands, axis=1)
        before = np.zeros_like(count)
        before[:, window:] = count[:, :-window]
        return np.asarray(count - before >= hits)

    def _list_lasts_s(self) -> Float:
        """(K,) for how long each list is the newest, `max_age_s` and to the ego's last frame at most."""
        last_s = float(self._truth.braking.path.frame_s[-1])
        next_s = np.append(self._issue_s[1:], np.inf)
        lasts: Float = np.maximum(np.minimum(np.minimum(next_s, last_s) - self._issue_s, self._max_age_s), 0.0)
        return lasts

    def _lose_speed(self, begins_s: Float, needless_s: Float) -> Float:
        """(E,) m/s that the driver's deceleration takes in the needless time of events."""
        braking = self._truth.braking
        speed = braking.path.course(begins_s).speed_mps
        middles_s = needless_s[:, None] * (np.arange(20) + 0.5) / 20
        lost_mps: Float = driver_deceleration(braking.driver, middles_s, speed[:, None]).mean(axis=1) * needless_s
        return np.minimum(lost_mps, speed)

    def _find_by_existence(self, driving: Bool, lasts_s: Float) -> Float:
        """(S, T) needless seconds with entries of at least each existence."""
        thresholds = np.array(self._settings.existence_thresholds, dtype=np.float32)
        levels = np.unique(self._existence[self._existence >= 0.0])
        level_ix = np.searchsorted(levels, thresholds, side="left")
        needless_s = np.zeros((len(self._existence), len(thresholds)))
        for place in np.unique(level_ix[level_ix < len(levels)]).tolist():
            needless = self._confirmed(self._existence >= levels[place]) & driving
            needless_s[:, level_ix == place] = _add_up(needless, lasts_s)[:, None]
        return needless_s

    def _miss(self, brakes: Bool, lasts_s: Float) -> Float:
        """(S,) seconds in which the driver must brake by the truth, and does not."""
        truth = self._truth
        at_s = truth.time_s[truth.must]
        list_ix = np.searchsorted(self._issue_s, at_s + SAME_INSTANT_S, side="right") - 1
        valid = list_ix >= 0
        valid[valid] = at_s[valid] - self._issue_s[list_ix[valid]] <= lasts_s[list_ix[valid]] + SAME_INSTANT_S
        missed = np.full(len(brakes), float((~valid).sum()))
        missed += (~brakes[:, list_ix[valid]]).sum(axis=1)
        return missed * _GRID_S

    def _find_entries(self, run_ix: Int, k: Int) -> tuple[Entries, Int, Int, Int]:
        """The surest entry of each run and list (E,) that demands braking, or that did in the lists that confirm it."""
        empty = np.empty(0, dtype=np.int64)
        runs, lists, _, objects, roles, classes = zip(*self._parts, strict=True) if self._parts else ([empty],) * 6
        key = np.concatenate([empty, *runs]) * len(self._issue_s) + np.concatenate([empty, *lists])
        order = np.argsort(key, kind="stable")
        place = order[np.searchsorted(key[order], run_ix * len(self._issue_s) + k, side="right") - 1]
        entries = join_entries([part[2] for part in self._parts])
        columns = (np.concatenate([empty, *column])[place] for column in (objects, roles, classes))
        object_ix, role, class_ix = columns
        return take_entries(entries, place), object_ix, role, class_ix

    def _find_causes(self, entries: Entries, object_ix: Int, role: Int, time_s: Float) -> np.ndarray:
        """(E,) why each event's entry makes the driver brake: ghost, duplicate, late or misplaced (`CAUSES`)."""
        truth, settings = self._truth, self._truth.asked
        states, present = interpolate_states(
            truth.truth, object_ix, np.ascontiguousarray(entries["captured_s"]), t0_ns=truth.scene.t0_ns,
            max_gap_s=truth.max_gap_s,
        )  # fmt: skip
        needed_when_captured = truth.braking.must_brake(
            time_s, np.arange(len(time_s)), _stack_states(states), margin_m=settings.wider_m, share=settings.needed_at
        )
        is_late = needed_when_captured & present & (self._tells_of == "capture")
        return np.select(
            [(role == GHOST) | (object_ix < 0), role == DUPLICATE, is_late],
            [GHOST_ENTRY, DUPLICATE_ENTRY, LATE],
            MISPLACED,
        ).astype(object)


def _add_up(held: Bool, lasts_s: Float) -> Float:
    """(S,) seconds of the lists (S, K) that are held: row by row, so that no sum depends on other runs."""
    seconds: Float = np.where(held, lasts_s, 0.0).sum(axis=1)
    return seconds


def _join_events(run_ix: Int, begins_s: Float, lasts_s: Float, merge_s: float) -> tuple[Int, Int]:
    """First and behind the last (E,) of the needless lists of each event, which are by run and instant."""
    if not len(run_ix):
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    pause_s = begins_s[1:] - (begins_s + lasts_s)[:-1]
    new = np.concatenate([[True], (np.diff(run_ix) != 0) | (pause_s > merge_s + SAME_INSTANT_S)])
    first = np.flatnonzero(new)
    return first, np.append(first[1:], len(run_ix))

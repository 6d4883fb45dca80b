"""Sight: what units have of an object, in one meaning of *in sight* for tables, viewers, stories and causes.

Spans are of episodes, from the onset on, from list to list; of several units the best counts. What a list tells holds
until the unit's next one; what the first after the onset tells holds from the onset on, unless it is in sight, which
begins with that list.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.perception.config import PerceptionSetup
from copem_replay.perception.observation import Observations, assess_view, rows_by_unit

NO_UNIT, OUT_OF_VIEW, HIDDEN, IN_SIGHT = range(1, 5)
"""The better the higher: of several units the best counts. No unit: it is not there, or the object carries it.

`pipeline/status.py` goes on from here; 0 is an object that is not in the log."""


def judge_sight(pem: str, experiment: PerceptionSetup, view: ViewGeometry, tags: Mapping[str, str]) -> Int:
    """(P,) the state of each object of a view for a unit with this PEM: out of range or view, hidden, or in sight.

    In sight: some of it shows, and its couple lists it with any probability. Hidden: it would, were nothing between.
    A visible share of NaN, where no couple can apply at any share, is out of view.
    """
    state = np.full(len(view.range_m), OUT_OF_VIEW)
    with np.errstate(invalid="ignore"):
        shows = view.visible_share > 0
    rows = np.flatnonzero(shows)
    state[rows[assess_view(pem, experiment, view.take(rows), tags)[1] > 0]] = IN_SIGHT
    rows = np.flatnonzero((state != IN_SIGHT) & ~np.isnan(view.visible_share))
    clear = replace(view.take(rows), visible_share=np.ones(len(rows)))
    state[rows[assess_view(pem, experiment, clear, tags)[1] > 0]] = HIDDEN
    return state


@dataclass(frozen=True)
class SightSpans:
    """Spans (K,) of one state, by episode and begin: of single units, `unit_ix` of those that look, or of several.

    `end_s` is inf where nothing follows.
    """

    unit_ix: Int
    episode_ix: Int
    begin_s: Float
    end_s: Float
    state: Int

    def of_units(self, units: Collection[int]) -> SightSpans:
        """The spans of these units combined (`unit_ix` −1): at each instant the best of their states."""
        rows = np.flatnonzero(np.isin(self.unit_ix, list(units)))
        steps = np.zeros((len(rows), IN_SIGHT + 1), dtype=np.int64)
        steps[np.arange(len(rows)), self.state[rows]] = 1
        episode_ix, at_s = np.tile(self.episode_ix[rows], 2), np.concatenate([self.begin_s[rows], self.end_s[rows]])
        order = np.lexsort((at_s, episode_ix))
        episode_ix, at_s = episode_ix[order], at_s[order]
        is_held = np.cumsum(np.concatenate([steps, -steps])[order], axis=0) > 0
        state = IN_SIGHT - is_held[:, ::-1].argmax(axis=1)
        end_s = np.append(at_s[1:], np.inf)
        kept = is_held.any(axis=1) & (end_s > at_s)  # where none holds, an episode ends
        return SightSpans(np.full(kept.sum(), -1), episode_ix[kept], at_s[kept], end_s[kept], state[kept])

    def first_s(self, state: int, episodes: int) -> Float:
        """(M,) the first time of each episode in a state; NaN: never."""
        rows, first_s = self.state == state, np.full(episodes, np.inf)
        np.minimum.at(first_s, self.episode_ix[rows], self.begin_s[rows])
        return np.where(np.isfinite(first_s), first_s, np.nan)

    def seconds(self, state: int, episode_ix: Int, until_s: Float) -> Float:
        """(n,) seconds that episodes (n,) are in a state until an instant each."""
        spans = self.episode_ix[rows := np.flatnonzero(self.state == state)]
        first, after = (np.searchsorted(spans, episode_ix, side=side) for side in ("left", "right"))
        count = after - first
        which = np.repeat(np.arange(len(episode_ix)), count)
        span = rows[np.arange(len(which)) - np.repeat(np.cumsum(count) - count - first, count)]
        lasts_s = np.clip(np.minimum(until_s[which], self.end_s[span]) - self.begin_s[span], 0.0, None)
        return np.bincount(which, lasts_s, len(episode_ix)).astype(float)


class SightChanges(NamedTuple):
    """The lists (K,) of units in which the state of an episode differs from that in the unit's list before."""

    unit_ix: Int
    episode_ix: Int
    captured_s: Float
    state: Int

    def take(self, rows: Int) -> SightChanges:
        """The changes at these rows."""
        return SightChanges(self.unit_ix[rows], self.episode_ix[rows], self.captured_s[rows], self.state[rows])


def find_sight_changes(
    observations: Observations, experiment: PerceptionSetup, tags: Mapping[str, str], episode_ix: Int
) -> SightChanges:
    """The changes in the lists of a time chunk. `tags`: those of the log; `episode_ix (P,)`: of each row, −1: none."""
    tracks = observations.tracks
    state = np.full(len(episode_ix), NO_UNIT)
    for unit, rows in zip(experiment.modelled.values(), rows_by_unit(tracks), strict=True):
        rows = rows[episode_ix[rows] >= 0]
        state[rows] = judge_sight(str(unit.pem), experiment, observations.view.take(rows), tags)
    rows = np.flatnonzero(episode_ix >= 0)
    return _keep_changes(
        SightChanges(tracks.row_unit_ix[rows], episode_ix[rows], tracks.row_captured_s[rows], state[rows])
    )


def _keep_changes(lists: SightChanges) -> SightChanges:
    order = np.lexsort((lists.captured_s, lists.episode_ix, lists.unit_ix))
    lists = lists.take(order)
    same = [column[1:] == column[:-1] for column in (lists.unit_ix, lists.episode_ix, lists.state)]
    kept = np.flatnonzero(np.append(True, ~np.all(same, axis=0))[: len(order)])
    return lists.take(kept)


def join_sight_changes(chunks: Sequence[SightChanges], onset_s: Float) -> SightSpans:
    """The spans of single units over the whole log. `onset_s (M,)`: of the episodes."""
    unit_ix, episode_ix, begin_s, state = _keep_changes(SightChanges(*map(np.concatenate, zip(*chunks, strict=True))))
    begins = np.append(True, (np.diff(unit_ix) != 0) | (np.diff(episode_ix) != 0))[: len(unit_ix)]
    end_s = np.where(
        np.append(begins[1:], True)[: len(unit_ix)], np.inf, np.append(begin_s[1:], np.inf)[: len(unit_ix)]
    )
    begin_s = np.where(begins & (state != IN_SIGHT), onset_s[episode_ix], begin_s)
    return SightSpans(unit_ix, episode_ix, begin_s, end_s, state)


class SightTimes(NamedTuple):
    """Of one configuration, all (S | 1, M): when it first has each object in sight, and seconds before it is listed.

    NaN: never, or not known: the truth needs no sight, and recorded units without `views` do not tell.
    """

    in_sight_s: Float
    out_of_view_s: Float
    hidden_s: Float


def measure_sight(
    spans: SightSpans, experiment: PerceptionSetup, names: Sequence[str] | None, equipped: Bool, until_s: Float
) -> SightTimes:
    """The times of the units `names`, None of the truth.

    `equipped (S | 1, U)`: which of the experiment's units each run has.
    `until_s (S | 1, M)`: when each object is first listed, or its episode ends.
    """
    episodes = until_s.shape[1]
    if names is None or any(name not in experiment.modelled for name in names):
        return SightTimes(*np.full((3, 1, episodes), np.nan))
    modelled, every = list(experiment.modelled), list(experiment.units)
    patterns, pattern_ix = np.unique(equipped[:, [every.index(name) for name in names]], axis=0, return_inverse=True)
    runs = max(len(until_s), len(pattern_ix))
    until_s, pattern_ix = np.broadcast_to(until_s, (runs, episodes)), np.broadcast_to(pattern_ix.ravel(), runs)
    times = np.empty((3, runs, episodes))
    for k, there in enumerate(patterns):
        group = spans.of_units({modelled.index(name) for name, present in zip(names, there, strict=True) if present})
        run_ix = np.flatnonzero(pattern_ix == k)
        episode, then_s = np.tile(np.arange(episodes), len(run_ix)), until_s[run_ix].ravel()
        times[0, run_ix] = group.first_s(IN_SIGHT, episodes)
        for row, state in enumerate((OUT_OF_VIEW, HIDDEN), start=1):
            times[row, run_ix] = group.seconds(state, episode, then_s).reshape(len(run_ix), episodes)
    return SightTimes(*times)

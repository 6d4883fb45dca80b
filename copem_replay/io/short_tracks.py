"""Short tracks: entries of object lists followed from list to list and smoothed, with position and velocity at any
instant.

Ids are used where all entries have one; else an entry continues the track whose predicted position it is nearest to.
States are those of a parabola through the entries near in time, so that errors of single entries average out.
`tools/check_time_offsets.py` measures the clock offsets that are estimated with these constants.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from copem_replay.core.tracks import Float, Int, Tracks

WINDOW_S = 0.75
"""Half width of smoothing: errors of half a metre leave a velocity good to 0.3 m/s."""
SLOWEST_HZ = 0.5
"""Lists that come less often are not followed: in 2 s between them a car moves farther than cars are apart."""
GAP_LISTS, WINDOW_LISTS = 4.5, 4.0
"""Periods of slow lists that are a gap, and the half width of smoothing in periods: some lists miss an object."""
_EACH_SIDE = 2  # entries before and after an instant, at least: at the end of a track a velocity is a guess
_FASTEST_MPS = 60.0  # a faster jump, beyond 3 m, is another object under the same id
_SETTLED_S = 0.2  # time constant with which entries move a track; larger: smoother, but late in turns
_APART_M = 1e5  # distance of lists in the tree along its third axis, so that no entry is near one of another list


@dataclass(frozen=True)
class ListPoints:
    """Entries of object lists, (P,) each, in order of time. `list_ix` ascends; `track` is −1 without ids."""

    time_s: Float
    list_ix: Int
    x_m: Float
    y_m: Float
    track: Int

    def thinned(self, most: int) -> ListPoints:
        """About `most` entries: every n-th list, whole."""
        every = -(-len(self.time_s) // most)
        return self.take(np.flatnonzero(self.list_ix % every == 0)) if every > 1 else self

    def take(self, rows: Int) -> ListPoints:
        """The entries of `rows`."""
        return ListPoints(self.time_s[rows], self.list_ix[rows], self.x_m[rows], self.y_m[rows], self.track[rows])


def make_list_points(tracks: Tracks, t0_ns: int, track: Int | None = None) -> ListPoints:
    """The entries of `tracks`, one run, in seconds since `t0_ns`; `track`: ids of the rows, None: `track_ix`."""
    ids = tracks.track_ix if track is None else track
    stamps, list_ix = np.unique(tracks.stamp_ns, return_inverse=True)
    of_row = list_ix[tracks.frame_ix]
    order = np.argsort(of_row, kind="stable")
    time_s = (stamps - t0_ns) * np.float64(1e-9)
    of_row = of_row[order]
    return ListPoints(time_s[of_row], of_row, tracks.x_m[0, order], tracks.y_m[0, order], ids[order])


@dataclass(frozen=True)
class PointStates:
    """States of tracks, (K,) each; `velocity (2, K)`."""

    x_m: Float
    y_m: Float
    velocity: Float
    track: Int


@dataclass(frozen=True)
class ShortTracks:
    """Smoothed states in order of tracks and time, (Q,) each; between states further apart than `gap_s` is no state."""

    time_s: Float
    track: Int
    x_m: Float
    y_m: Float
    velocity: Float  # (2, Q)
    gap_s: float
    entries: ListPoints  # the entries that were smoothed, in order of tracks and time; `track` numbers the tracks

    def at(self, times_s: Float) -> tuple[PointStates, Int]:
        """(K,) states of all tracks that have one at ascending instants (F,) in s, and (K,) index of the instant."""
        span = float(max(self.time_s.max(), times_s.max()) - min(self.time_s.min(), times_s.min())) + 10
        begin = np.flatnonzero(np.diff(self.track, prepend=-1))
        first, last = self.time_s[begin], self.time_s[np.append(begin[1:], len(self.track)) - 1]
        first_instant, after_instant = np.searchsorted(times_s, first), np.searchsorted(times_s, last, side="right")
        count = np.maximum(after_instant - first_instant, 0)
        track = np.repeat(np.arange(len(begin)), count)
        instant = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first_instant, count)
        axis = self.time_s + np.repeat(np.arange(len(begin)), np.diff(np.append(begin, len(self.track)))) * span
        before = np.searchsorted(axis, times_s[instant] + track * span, side="right") - 1
        before = np.clip(before, begin[track], len(axis) - 1)
        after = np.minimum(before + 1, np.append(begin[1:], len(axis))[track] - 1)
        long_s = self.time_s[after] - self.time_s[before]
        is_close = long_s <= self.gap_s
        weight = (times_s[instant] - self.time_s[before]) / np.maximum(long_s, 1e-9)
        before, after, weight = before[is_close], after[is_close], np.clip(weight[is_close], 0.0, 1.0)

        def between(values: Float) -> Float:
            mixed: Float = values[..., before] * (1 - weight) + values[..., after] * weight
            return mixed

        states = PointStates(between(self.x_m), between(self.y_m), between(self.velocity), self.track[before])
        return states, instant[is_close]

    def nearest(
        self, other: ListPoints, offset_s: float, *, gate_m: float, faster_mps: float, mutual: bool = False
    ) -> tuple[Int, PointStates, Float]:
        """Entries nearest to a moving track once shifted back by `offset_s`: rows, states, distances in m, (K,) each.
        Only tracks faster than `faster_mps` count. `mutual`: the entry is also nearest to that state.
        """
        stamps_s, instant_ix = np.unique(other.time_s, return_inverse=True)
        states, instant = self.at(stamps_s - offset_s)
        moving = np.flatnonzero(np.hypot(*states.velocity) > faster_mps)
        # Entries are matched with standing tracks, too, so that these are not taken for one that passes by.
        entries = np.stack([other.x_m, other.y_m, instant_ix * _APART_M], axis=1)
        points = np.stack([states.x_m, states.y_m, instant * _APART_M], axis=1)
        if not len(moving):
            empty = np.empty(0, dtype=np.int64)
            return empty, _take_states(states, empty), np.empty(0)
        from scipy.spatial import cKDTree  # it takes long to import

        distance_m, point = cKDTree(points).query(entries, distance_upper_bound=gate_m)
        rows = np.flatnonzero(np.isfinite(distance_m))
        if mutual and len(rows):
            _, nearest_row = cKDTree(entries).query(points[point[rows]], distance_upper_bound=gate_m)
            rows = rows[nearest_row == rows]
        rows = rows[np.isin(point[rows], moving)]
        return rows, _take_states(states, point[rows]), distance_m[rows]


def _take_states(states: PointStates, rows: Int) -> PointStates:
    return PointStates(states.x_m[rows], states.y_m[rows], states.velocity[:, rows], states.track[rows])


def short_tracks(entries: ListPoints) -> ShortTracks:
    """The smoothed tracks of object lists."""
    step_s = _step_s(entries)
    return _smooth_points(chain_points(entries), max(WINDOW_S, WINDOW_LISTS * step_s), max(0.5, GAP_LISTS * step_s))


def chain_points(entries: ListPoints) -> ListPoints:
    """Entries in order of tracks and time, `track` counting unbroken tracks; none where lists come too seldom."""
    step_s = _step_s(entries)
    gap_s = max(0.5, GAP_LISTS * step_s)
    if step_s > 1 / SLOWEST_HZ:
        entries = entries.take(np.empty(0, dtype=np.int64))
    elif len(entries.track) and entries.track.min() < 0:
        entries = replace(entries, track=follow_points(entries, gap_s))
    entries = entries.take(np.lexsort((entries.time_s, entries.track)))
    new = (np.diff(entries.track, prepend=-1) != 0) | (np.diff(entries.time_s, prepend=-np.inf) > gap_s)
    # A jump is another object under the same id.
    jump_m = np.hypot(np.diff(entries.x_m, prepend=np.nan), np.diff(entries.y_m, prepend=np.nan))
    new |= jump_m > _FASTEST_MPS * np.diff(entries.time_s, prepend=-np.inf) + 3.0
    return replace(entries, track=np.cumsum(new) - 1)


def _step_s(entries: ListPoints) -> float:
    """The median period of lists in s; inf with fewer than two."""
    times_s = np.unique(entries.time_s)
    return float(np.median(np.diff(times_s))) if len(times_s) > 1 else np.inf


def _smooth_points(entries: ListPoints, window_s: float, gap_s: float) -> ShortTracks:
    """States from parabolas through the entries within `window_s`, where both sides have enough of them."""
    time_s, track = entries.time_s, entries.track
    if not len(time_s):
        return ShortTracks(time_s, track, entries.x_m, entries.y_m, np.empty((2, 0)), gap_s, entries)
    axis = time_s + track * (float(np.ptp(time_s)) + 10 * window_s)
    low, high = np.searchsorted(axis, axis - window_s), np.searchsorted(axis, axis + window_s, side="right")
    row_ix = np.arange(len(axis))
    centres = np.flatnonzero((row_ix - low >= _EACH_SIDE) & (high - row_ix > _EACH_SIDE))
    sums = [np.zeros(len(centres)) for _ in range(5)]
    right_sides = np.zeros((2, 3, len(centres)))
    widest = int((high - low)[centres].max()) if len(centres) else 0
    for n in range(widest):
        row = low[centres] + n
        in_window = row < high[centres]
        row = np.minimum(row, len(axis) - 1)
        t = np.where(in_window, axis[row] - axis[centres], 0.0)
        for power in range(5):
            sums[power] += np.where(in_window, t**power, 0.0)
        for axis_ix, values in enumerate((entries.x_m, entries.y_m)):
            offset_m = np.where(in_window, values[row] - values[centres], 0.0)  # small numbers keep their digits
            for power in range(3):
                right_sides[axis_ix, power] += offset_m * t**power
    normal = np.array([[sums[i + j] for j in range(3)] for i in range(3)]).transpose(2, 0, 1)
    is_solvable = np.linalg.det(normal) != 0  # no parabola goes through entries of one time alone
    centres, normal, right_sides = centres[is_solvable], normal[is_solvable], right_sides[:, :, is_solvable]
    solved = np.linalg.solve(normal, right_sides.transpose(2, 1, 0)) if len(centres) else np.empty((0, 3, 2))
    x_m, y_m = entries.x_m[centres] + solved[:, 0, 0], entries.y_m[centres] + solved[:, 0, 1]
    return ShortTracks(time_s[centres], track[centres], x_m, y_m, solved[:, 1].T, gap_s, entries)


def follow_points(entries: ListPoints, gap_s: float) -> Int:
    """(P,) tracks of entries without ids: an entry continues the track whose predicted position it is nearest to."""
    track = np.full(len(entries.time_s), -1)
    bounds = np.flatnonzero(np.diff(entries.list_ix, prepend=-1, append=-1))
    place, velocity, seen_s, names = np.empty((0, 2)), np.empty((0, 2)), np.empty(0), np.empty(0, dtype=np.int64)
    number, n_seen = 0, np.empty(0, dtype=np.int64)
    for begin, end in pairwise(bounds.tolist()):
        now_s, entry_m = entries.time_s[begin], np.stack([entries.x_m[begin:end], entries.y_m[begin:end]], axis=1)
        alive = now_s - seen_s <= gap_s
        place, velocity, seen_s, names, n_seen = (a[alive] for a in (place, velocity, seen_s, names, n_seen))
        since_s = now_s - seen_s
        follows = np.full(end - begin, -1)
        if len(names):
            away_m = np.hypot(*(entry_m[:, None] - (place + velocity * since_s[:, None])[None]).transpose(2, 0, 1))
            nearest_track, nearest_entry = away_m.argmin(axis=1), away_m.argmin(axis=0)
            rows = np.arange(end - begin)
            mutual = (nearest_entry[nearest_track] == rows) & (
                away_m[rows, nearest_track]
                <= 2.5 + np.where(n_seen[nearest_track] > 1, 5.0, 35.0) * since_s[nearest_track]
            )
            follows[mutual] = nearest_track[mutual]
        old, new = np.flatnonzero(follows >= 0), np.flatnonzero(follows < 0)
        if len(old):
            k = follows[old]
            residual, second = entry_m[old] - (place[k] + velocity[k] * since_s[k, None]), (n_seen[k] == 1)[:, None]
            gain = np.clip(1 - np.exp(-since_s[k, None] / _SETTLED_S), 0.3, 0.7)
            velocity[k] += np.where(second, 1.0, gain**2 / (2 - gain)) * residual / np.maximum(since_s[k, None], 1e-3)
            place[k] = np.where(second, entry_m[old], entry_m[old] - (1 - gain) * residual)
            seen_s[k] = now_s
            n_seen[k] += 1
            track[begin + old] = names[k]
        track[begin + new] = number + np.arange(len(new))
        place, velocity = np.concatenate([place, entry_m[new]]), np.concatenate([velocity, np.zeros((len(new), 2))])
        seen_s, names = np.append(seen_s, np.full(len(new), now_s)), np.append(names, track[begin + new])
        number, n_seen = number + len(new), np.append(n_seen, np.ones(len(new), dtype=np.int64))
    return track

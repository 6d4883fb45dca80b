"""Needless braking, computed the plain way: box by box, instant by instant, event by event, with Shapely.

From the words of docs/guide/metrics.md and of the docstrings alone. The ego follows the line through its recorded
places, straight on beyond the last. Its speed while braking is stepped down by milliseconds, and boxes are
compared every twentieth of a second and when it stands. Where a box a little larger or smaller, or nearer or farther,
or an ego that is watched for one step longer, would change the answer, the oracle gives none.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
import shapely

Array = npt.NDArray[np.float64]
Deceleration = Callable[[Array, float], Array]
"""m/s² so many seconds (K,) after braking began at such a speed."""

COMPARED_S = 0.05
FINE_S = 1e-3
SHARES = 12
DOUBT_M = 0.02
EDGE_S = 1e-6
EDGE_M = 1e-9


@dataclass(frozen=True)
class Box:
    """An entry of a list, or the true state of an object."""

    x_m: float
    y_m: float
    yaw_rad: float = 0.0
    vx_mps: float = 0.0
    vy_mps: float = 0.0
    length_m: float = 0.6
    width_m: float = 0.6

    def after(self, time_s: Array) -> npt.NDArray[np.object_]:
        return boxes(
            self.x_m + self.vx_mps * time_s, self.y_m + self.vy_mps * time_s, np.full(len(time_s), self.yaw_rad),
            self.length_m, self.width_m,
        )  # fmt: skip


def boxes(x: Array, y: Array, yaw: Array, length_m: float, width_m: float) -> npt.NDArray[np.object_]:
    ahead = np.stack([np.cos(yaw), np.sin(yaw)], axis=1) * length_m / 2
    aside = np.stack([-np.sin(yaw), np.cos(yaw)], axis=1) * width_m / 2
    centre = np.stack([x, y], axis=1)
    corners = [centre + ahead + aside, centre - ahead + aside, centre - ahead - aside, centre + ahead - aside]
    made: npt.NDArray[np.object_] = shapely.polygons(np.stack(corners, axis=1))
    return made


@dataclass(frozen=True)
class Ego:
    """The recorded frames of the ego (F,) and its driver: `reaction_s`, the median of it; `slower_mps`: no driving."""

    time_s: Array
    x_m: Array
    y_m: Array
    yaw_rad: Array
    speed_mps: Array
    length_m: float
    width_m: float
    deceleration: Deceleration
    reaction_s: float
    slower_mps: float = 1.0
    max_gap_s: float = 0.5

    def is_there(self, now_s: float) -> bool:
        if np.abs(self.time_s - now_s).min() <= EDGE_S:
            return True
        before, after = self.time_s[self.time_s < now_s], self.time_s[self.time_s > now_s]
        return bool(len(before) and len(after) and after[0] - before[-1] <= self.max_gap_s + EDGE_S)

    def speed(self, now_s: float) -> float:
        return float(np.interp(now_s, self.time_s, self.speed_mps))

    def is_driving(self, now_s: float) -> bool:
        return self.is_there(now_s) and self.speed(now_s) >= self.slower_mps

    def driving_s(self, from_s: float = 0.0, until_s: float = math.inf) -> float:
        """Seconds of driving between instants: frame to frame, by the speed of the frame before."""
        total_s = 0.0
        for k in range(len(self.time_s) - 1):
            begins_s, ends_s = float(self.time_s[k]), float(self.time_s[k + 1])
            if self.speed_mps[k] >= self.slower_mps and ends_s - begins_s <= self.max_gap_s + EDGE_S:
                total_s += max(min(ends_s, until_s) - max(begins_s, from_s), 0.0)
        return total_s

    def _ways(self) -> Array:
        return np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(self.x_m), np.diff(self.y_m)))])

    def poses(self, now_s: float, driven_m: Array) -> tuple[Array, Array, Array]:
        """Where it is when it has driven so far since an instant: x, y, yaw."""
        ways = self._ways()
        places = np.interp(now_s, self.time_s, ways) + driven_m
        known, first = np.unique(ways, return_index=True)
        yaw = np.unwrap(self.yaw_rad)
        x, y, heading = (np.interp(places, known, of[first]) for of in (self.x_m, self.y_m, yaw))
        beyond = np.maximum(places - ways[-1], 0.0)
        return x + beyond * math.cos(yaw[-1]), y + beyond * math.sin(yaw[-1]), heading

    def brake(self, speed_mps: float, share: float, until_s: float = 30.0) -> tuple[Array, Array, float]:
        """Instants up to `until_s`, way by then, and when it stands (inf: later), of the ego that reacts and brakes
        with a share of what it can.
        """
        steps = math.ceil(max(until_s - self.reaction_s, 0.0) / FINE_S) + 1
        middle_s = (np.arange(steps) + 0.5) * FINE_S
        slower = share * self.deceleration(middle_s, speed_mps) * FINE_S
        speeds = speed_mps - np.concatenate([[0.0], np.cumsum(slower)])
        moving = int((speeds > 0).sum())
        stands_s = math.inf
        if moving <= steps:
            stands_s = self.reaction_s + (moving - 1 + speeds[moving - 1] / slower[moving - 1]) * FINE_S
        speeds = np.maximum(speeds, 0.0)
        way_m = np.concatenate([[0.0], np.cumsum((speeds[1:] + speeds[:-1]) / 2) * FINE_S])
        way_m += speed_mps * self.reaction_s
        time_s = self.reaction_s + np.arange(steps + 1) * FINE_S
        return np.concatenate([[0.0], time_s]), np.concatenate([[0.0], way_m]), stands_s


def must_brake(ego: Ego, now_s: float, entry: Box, *, margin_m: float, share: float) -> bool | None:
    """Whether the driver must brake for an entry at an instant; None: by a hair."""
    if not ego.is_driving(now_s):
        return False
    answers = {
        _must_brake(ego, now_s, _grown(entry, by_m), margin_m, share, longer_s)
        for by_m in (-DOUBT_M, 0.0, DOUBT_M)
        for longer_s in (0.0, COMPARED_S)
    }
    return answers.pop() if len(answers) == 1 else None


def _grown(entry: Box, by_m: float) -> Box:
    return replace(entry, length_m=entry.length_m + 2 * by_m, width_m=entry.width_m + 2 * by_m)


def _must_brake(ego: Ego, now_s: float, entry: Box, margin_m: float, share: float, longer_s: float) -> bool | None:
    speed = ego.speed(now_s)
    _, _, stands_s = ego.brake(speed, share)
    until_s = min(stands_s + longer_s, 30.0)
    instants = np.arange(0.0, until_s + 1e-9, COMPARED_S)

    def distances(time_s: Array, driven_m: Array) -> Array:
        around = boxes(*ego.poses(now_s, driven_m), ego.length_m, ego.width_m)
        return np.asarray(shapely.distance(around, entry.after(time_s)), dtype=float)

    now_m = float(distances(np.zeros(1), np.zeros(1))[0])
    if now_m <= EDGE_M:
        return False
    margin_m = 0.0 if now_m <= margin_m else margin_m

    met = np.flatnonzero(distances(instants, speed * instants) <= margin_m + EDGE_M)
    if not len(met):
        return False
    at_s = instants[met[0]]
    x, y, yaw = (float(of[0]) for of in ego.poses(now_s, np.array([speed * at_s])))
    to_x, to_y = entry.x_m + entry.vx_mps * at_s - x, entry.y_m + entry.vy_mps * at_s - y
    ahead_m = math.cos(yaw) * to_x + math.sin(yaw) * to_y
    if abs(ahead_m) < DOUBT_M:
        return None
    if ahead_m < 0:
        return False

    for k in range(1, SHARES + 1):
        time_s, way_m, stops_s = ego.brake(speed, share * k / SHARES, until_s)
        moving = instants[instants < stops_s]
        if stops_s <= until_s:
            moving = np.append(moving, stops_s)
        if not (distances(moving, np.interp(moving, time_s, way_m)) <= margin_m + EDGE_M).any():
            return False
    return True


# Lists, and what becomes of them.


@dataclass(frozen=True)
class Listed:
    """An entry for which the driver must brake."""

    existence: float
    away_m: float
    cause: str = ""


@dataclass
class Event:
    """Needless braking: `needless` (from, seconds) of its lists."""

    needless: list[tuple[float, float]]
    lost_mps: float = 0.0
    cause: str = ""

    @property
    def begins_s(self) -> float:
        return self.needless[0][0]

    @property
    def lasts_s(self) -> float:
        return self.needless[-1][0] + self.needless[-1][1] - self.begins_s


@dataclass
class Outcome:
    """Of one run."""

    events: list[Event] = field(default_factory=list)
    needless_s: float = 0.0
    speed_lost_mps: float = 0.0
    missed_s: float = 0.0


@dataclass(frozen=True)
class Rules:
    """What the experiment says: of `braking.needless`, `measure.confirm` and the configuration."""

    around_s: float = 0.5
    merge_s: float = 1.0
    hits: int = 1
    of: int = 1
    max_age_s: float = 0.5


def is_needed(now_s: float, reasons_s: Sequence[float], around_s: float) -> bool:
    """Whether the truth gives a reason at a tenth of a second (`reasons_s`) around an instant."""
    return any(abs(reason_s - now_s) <= around_s + 0.05 + EDGE_S for reason_s in reasons_s)


def find_needless(
    ego: Ego, issue_s: Array, demands: Sequence[Sequence[Listed]], must_s: Sequence[float],
    reasons_s: Sequence[float], rules: Rules, existence: float = 0.0,
) -> Outcome:  # fmt: skip
    """What becomes of the lists of one run. `demands`: by list the entries that the driver must brake for, of which
    those of at least `existence` count; `must_s`, `reasons_s`: tenths of a second at which the truth demands braking,
    and with tolerance.
    """
    demands = [[entry for entry in entries if entry.existence >= existence] for entries in demands]
    ends_s = float(ego.time_s[-1])
    out, brakes, lasts_s = Outcome(), [], []
    for k, now_s in enumerate(issue_s):
        window = demands[max(k - rules.of + 1, 0) : k + 1]
        brakes.append(sum(bool(entries) for entries in window) >= rules.hits)
        until_s = min(float(issue_s[k + 1]) if k + 1 < len(issue_s) else math.inf, now_s + rules.max_age_s, ends_s)
        lasts_s.append(max(until_s - now_s, 0.0))
    for k, now_s in enumerate(issue_s):
        if not brakes[k] or not ego.is_driving(now_s) or is_needed(now_s, reasons_s, rules.around_s):
            continue
        part = (float(now_s), ego.driving_s(now_s, now_s + lasts_s[k]))
        if part[1] <= 0.0:
            continue
        before = out.events[-1].needless[-1] if out.events else None
        if before is not None and now_s - sum(before) <= rules.merge_s + EDGE_S:
            out.events[-1].needless.append(part)
        else:
            newest = next(entries for entries in reversed(demands[: k + 1]) if entries)
            surest = min(newest, key=lambda entry: (-entry.existence, entry.away_m))
            out.events.append(Event([part], cause=surest.cause))
    for event in out.events:
        needless_s, speed = sum(of_s for _, of_s in event.needless), ego.speed(event.begins_s)
        steps = np.arange(0.0, needless_s, FINE_S)
        widths = np.minimum(FINE_S, needless_s - steps)
        slowed = float((ego.deceleration(steps + widths / 2, speed) * widths).sum())
        event.lost_mps = min(slowed, speed)
        out.needless_s += needless_s
        out.speed_lost_mps = max(out.speed_lost_mps, event.lost_mps)
    for at_s in must_s:
        held = [k for k in range(len(issue_s)) if issue_s[k] <= at_s + EDGE_S]
        in_use = bool(held) and at_s - issue_s[held[-1]] <= lasts_s[held[-1]] + EDGE_S
        out.missed_s += 0.0 if in_use and brakes[held[-1]] else 0.1
    return out

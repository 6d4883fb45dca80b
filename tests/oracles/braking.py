"""Braking, computed the plain way: what the fast code of the package is held against.

Two boxes move between recorded frames in straight lines. From one instant on the ego brakes: its speed is stepped down
millisecond by millisecond, and it is put on its recorded path that far along, never farther than it was recorded.
Shapely says how near the boxes are, at every millisecond and, wherever they could be nearer in between, twenty times as
often. Nothing is shared with the package but the rules of the contract about who is in the log when.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import shapely

Array = npt.NDArray[np.float64]

STEP_S = 1e-3
FINER = 20
TOUCH_M = 1e-9
EDGE_S = 1e-6  # within a microsecond of a frame is at that frame


@dataclass(frozen=True)
class Motion:
    """The recorded frames of one box, (K,) each; `yaw_rad` may jump by full turns."""

    time_s: Array
    x_m: Array
    y_m: Array
    yaw_rad: Array
    speed_mps: Array
    length_m: float
    width_m: float

    def there(self, time_s: Array, max_gap_s: float) -> npt.NDArray[np.bool_]:
        """Whether it is in the log: at its frames, and between two that are near enough in time."""
        after = np.minimum(np.searchsorted(self.time_s, time_s), len(self.time_s) - 1)
        left, right = self.time_s[np.maximum(after - 1, 0)], self.time_s[after]
        at_a_frame = (np.abs(time_s - left) <= EDGE_S) | (np.abs(time_s - right) <= EDGE_S)
        inside = (self.time_s[0] <= time_s) & (time_s <= self.time_s[-1])
        return at_a_frame | (inside & (right - left <= max_gap_s + EDGE_S))

    def places(self, time_s: Array) -> tuple[Array, Array, Array]:
        """x, y and yaw at instants (K,)."""
        yaw = np.interp(time_s, self.time_s, np.unwrap(self.yaw_rad))
        return np.interp(time_s, self.time_s, self.x_m), np.interp(time_s, self.time_s, self.y_m), yaw


@dataclass(frozen=True)
class Outcome:
    """What becomes of it; `touch_s` and `touch_mps` (the ego's speed then) are None where the boxes never touch."""

    min_distance_m: float
    touch_s: float | None
    touch_mps: float | None
    distance: Callable[[Array], Array]


class Ego:
    """The ego that drives as recorded, or with constant speed from an instant on, until it brakes."""

    def __init__(self, motion: Motion, constant_from_s: float | None = None) -> None:
        self.motion = motion
        steps = np.hypot(np.diff(motion.x_m), np.diff(motion.y_m))
        self.frame_m = np.concatenate([[0.0], np.cumsum(steps)])
        self.constant_from_s = constant_from_s
        self.brake_s = math.inf

    def free(self, time_s: Array) -> tuple[Array, Array]:
        """Way and speed, had it not braked; past its last frame it would have gone on as fast as there."""
        m = self.motion
        if self.constant_from_s is None:
            beyond = np.maximum(time_s - m.time_s[-1], 0.0) * m.speed_mps[-1]
            return np.interp(time_s, m.time_s, self.frame_m) + beyond, np.interp(time_s, m.time_s, m.speed_mps)
        start = np.interp(self.constant_from_s, m.time_s, self.frame_m)
        speed = np.interp(self.constant_from_s, m.time_s, m.speed_mps)
        return start + speed * (time_s - self.constant_from_s), np.full(len(time_s), speed)

    def brakes(self, brake_s: float, a_max_mps2: float, build_up_s: float, until_s: float) -> None:
        """From `brake_s` on, never faster than recorded and never faster again; not when it is gone from the log."""
        if math.isinf(brake_s) or (self.constant_from_s is None and brake_s > self.motion.time_s[-1] + EDGE_S):
            return
        self.brake_s = brake_s
        elapsed = np.arange(0.0, max(until_s - brake_s, 0.0) + 2 * STEP_S, STEP_S)
        free_m, free_mps = self.free(brake_s + elapsed)
        way, speed = [float(free_m[0])], [float(free_mps[0])]
        for k in range(1, len(elapsed)):
            middle = elapsed[k] - STEP_S / 2
            deceleration = a_max_mps2 * min(middle / build_up_s, 1.0) if build_up_s > 0 else a_max_mps2
            slower = min(max(speed[-1] - deceleration * STEP_S, 0.0), float(free_mps[k]))
            way.append(way[-1] + (speed[-1] + slower) / 2 * STEP_S)
            speed.append(slower)
        self.table = elapsed, np.array(way), np.array(speed)

    def way(self, time_s: Array) -> Array:
        """Metres along the path at instants (K,), never farther than without braking."""
        free, _ = self.free(time_s)
        if math.isinf(self.brake_s):
            return free
        braked = np.interp(time_s - self.brake_s, self.table[0], self.table[1])
        return np.where(time_s > self.brake_s, np.minimum(braked, free), free)

    def speed(self, time_s: float) -> float:
        """Speed at an instant."""
        if time_s > self.brake_s:
            return float(np.interp(time_s - self.brake_s, self.table[0], self.table[2]))
        return float(self.free(np.array([time_s]))[1][0])

    def there(self, time_s: Array, max_gap_s: float) -> npt.NDArray[np.bool_]:
        """An ego that was made to brake or to keep its speed is there whether recorded or not."""
        if self.constant_from_s is not None:
            return np.ones(len(time_s), dtype=bool)
        return self.motion.there(time_s, max_gap_s) | (time_s > self.brake_s)

    def places(self, time_s: Array) -> tuple[Array, Array, Array]:
        """x, y and yaw at instants (K,): on the recorded path, straight on ahead beyond its end."""
        m, way = self.motion, self.way(time_s)
        x, y = np.interp(way, self.frame_m, m.x_m), np.interp(way, self.frame_m, m.y_m)
        yaw = np.interp(way, self.frame_m, np.unwrap(m.yaw_rad))
        beyond = np.maximum(way - self.frame_m[-1], 0.0)
        return x + beyond * np.cos(m.yaw_rad[-1]), y + beyond * np.sin(m.yaw_rad[-1]), yaw


def corners(x: Array, y: Array, yaw: Array, length_m: float, width_m: float) -> Array:
    """(K, 4, 2) corners of boxes."""
    ahead = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)[:, None] * length_m / 2
    aside = np.stack([-np.sin(yaw), np.cos(yaw)], axis=1)[:, None] * width_m / 2
    signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    return np.stack([x, y], axis=1)[:, None] + signs[:, :1] * ahead + signs[:, 1:] * aside


def outcome(
    ego: Motion,
    other: Motion,
    *,
    onset_s: float,
    brake_s: float = math.inf,
    a_max_mps2: float = 8.0,
    build_up_s: float = 0.0,
    constant_speed: bool = False,
    max_gap_s: float = 0.5,
) -> Outcome:
    """From the onset until the other's last frame."""
    last_s = max(float(other.time_s[-1]), onset_s)
    driven = Ego(ego, onset_s if constant_speed else None)
    driven.brakes(brake_s, a_max_mps2, build_up_s, last_s)

    def boxes(time_s: Array) -> tuple[Array, Array]:
        return (
            corners(*driven.places(time_s), ego.length_m, ego.width_m),
            corners(*other.places(time_s), other.length_m, other.width_m),
        )

    def distance(time_s: Array) -> Array:
        a, b = boxes(time_s)
        both = driven.there(time_s, max_gap_s) & other.there(time_s, max_gap_s)
        return np.where(both, shapely.distance(shapely.polygons(a), shapely.polygons(b)), np.inf)

    time_s = np.arange(onset_s, last_s, STEP_S)
    frames = other.time_s[(other.time_s >= onset_s) & (other.time_s <= last_s)]
    time_s = np.unique(np.concatenate([time_s, frames, [onset_s, last_s]]))
    found = distance(time_s)
    # Between two instants no corner comes nearer than by how far both boxes move meanwhile.
    a, b = boxes(time_s)
    moved = sum(np.hypot(*np.moveaxis(np.diff(c, axis=0), -1, 0)).max(axis=1, initial=0.0) for c in (a, b))
    nearest = np.minimum(found[1:], found[:-1]) - moved
    touching = np.flatnonzero(found <= TOUCH_M)
    still_apart = np.arange(len(nearest)) < (touching[0] if len(touching) else len(nearest))
    closer = np.flatnonzero(still_apart & (nearest < max(found.min() - 1e-5, TOUCH_M)))
    if np.isfinite(found.min()) and len(closer):
        share = np.arange(1, FINER) / FINER
        finer = (time_s[closer, None] + share * (time_s[closer + 1] - time_s[closer])[:, None]).ravel()
        time_s, found = np.concatenate([time_s, finer]), np.concatenate([found, distance(finer)])
    order = np.argsort(time_s)
    time_s, found = time_s[order], found[order]
    touching = np.flatnonzero(found <= TOUCH_M)
    if not len(touching):
        return Outcome(float(found.min()), None, None, distance)
    touch_s = float(time_s[touching[0]])
    return Outcome(0.0, touch_s, driven.speed(touch_s), distance)

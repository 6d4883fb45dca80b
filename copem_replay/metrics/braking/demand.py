"""Demand: whether the ego has to brake for an entry of a list, or for a true object.

At a list's instant the ego drives along its recorded path with its recorded speed v. The driver (`braking.driver`)
reacts after ρ, the median of its reaction, and then brakes with a share f of its deceleration until it stands. The
entry goes straight on with its listed velocity and does not turn. The driver *must brake* for it, with a margin m and a
share β, when all of this holds:

1. v is at least `slower_mps`, and the entry does not overlap the ego: it is the ego itself, or too late.
2. If the ego does not brake, the two come within m of each other before a braking ego (f = β) would stand; and the
   entry's centre is then ahead of the ego's. Who runs into its back is no reason to brake.
3. They meet for every f of β/12, 2β/12, …, β, too. A contact while the ego stands does not count.

So a share below β of the driver's braking does not keep it clear. An entry nearer than m already is judged by touching.
Places are compared every `STEP_S`, and at the instant the ego stands.

Asked is the effort, as in the brake threat number: required by available deceleration (J. Jansson, "Collision avoidance
theory with application to automotive collision mitigation", Linköping 2005). Time to collision and the corridor of
`measure.conflict` call ordinary traffic a reason to brake: docs/guide/metrics.md.

Letters of the shapes: K instants, J steps, N entries, V vertices of the path.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from copem_replay.core.compiled import borrowing, borrowing_kernel
from copem_replay.core.geometry import box_distance, pose_on_path
from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.metrics.braking.driver import Driver, driver_deceleration, reaction_delays
from copem_replay.metrics.braking.encounter import Course, EgoPath

STEP_S = 0.05
"""Seconds between places that are compared: two vehicles that cross at 30 m/s come 1.5 m nearer."""
_LONGEST_S = 30.0
"""Later contacts give no reason to brake."""
_SHARES = 12
_LISTS = 2000
"""Lists whose braking is worked out at a time: the size of blocks, which changes no result."""
X, Y, YAW, VX, VY, LENGTH, WIDTH = 0, 1, 3, 4, 5, 6, 7
"""Columns of states (N, …), as in `core/object_list.py`."""


@dataclass(frozen=True)
class BrakingEgo:
    """The ego of a log with its driver. `slower_mps`: a slower ego does not drive."""

    path: EgoPath
    driver: Driver
    slower_mps: float

    @cached_property
    def _reaction_s(self) -> float:
        return float(reaction_delays(self.driver.reaction, np.array([0.5]))[0])

    def is_driving(self, time_s: Float) -> Bool:
        """(K,) whether the ego is in the log, and not too slow."""
        return self._is_driving(self.path.course(time_s))

    def _is_driving(self, course: Course) -> Bool:
        driving: Bool = ~np.isnan(course.along_m) & (course.speed_mps >= self.slower_mps)
        return driving

    def must_brake(self, time_s: Float, instant_ix: Int, states: Float, *, margin_m: float, share: float) -> Bool:
        """(N,) whether the driver must brake for states (N, ≥ 8), each listed at instant `instant_ix (N,)` of `time_s
        (K,)`; −1: at none, False. `share`: of the driver's deceleration. Raises InputError where a user's driver fails.
        """
        out = np.zeros(len(instant_ix), dtype=np.bool_)
        course = self.path.course(time_s)
        driving = np.flatnonzero(self._is_driving(course))
        row_of = np.full(len(time_s), -1)
        for begin in range(0, len(driving), _LISTS):
            block = driving[begin : begin + _LISTS]
            deceleration, instants = self._brake(course.speed_mps[block], share)
            row_of[:] = -1
            row_of[block] = np.arange(len(block))
            _mark_demands(
                self.path.path, self.path.size_m, course.along_m[block], course.speed_mps[block], deceleration,
                instants, self._reaction_s, row_of, instant_ix, states, margin_m, share,
                np.empty((len(block), instants.max(), 3)), out,
            )  # fmt: skip
        return out

    def _brake(self, speed_mps: Float, share: float) -> tuple[Float, Int]:
        """(K, J) deceleration (m/s²) by step, and (K,) the number of steps, and one, until an ego of `speed_mps (K,)`
        stands that brakes with a `share` of it.
        """
        most_steps = round(_LONGEST_S / STEP_S)
        steps = 64
        while True:
            steps = min(steps, most_steps)
            end_s = STEP_S * np.arange(1, steps + 1)
            begin_s = np.maximum(end_s - STEP_S, self._reaction_s)
            taken_s = np.maximum(end_s - begin_s, 0.0)
            elapsed_s = np.where(taken_s > 0, (begin_s + end_s) / 2 - self._reaction_s, 0.0)
            grid = np.broadcast_to(elapsed_s, (len(speed_mps), steps))
            deceleration = driver_deceleration(self.driver, grid, speed_mps[:, None])
            has_stopped = np.cumsum(share * deceleration * taken_s, axis=1) >= speed_mps[:, None] - 1e-12
            if has_stopped.any(axis=1).all() or steps == most_steps:
                break
            steps *= 2
        instants = np.where(has_stopped.any(axis=1), np.argmax(has_stopped, axis=1) + 2, steps + 1)
        return np.ascontiguousarray(deceleration), instants


@borrowing_kernel
def _mark_demands(
    path: Float, size: Float, along: Float, speed: Float, deceleration: Float, instants: Int, reaction_s: float,
    row_of: Int, instant_ix: Int, states: Float, margin_m: float, share: float, poses: Float, out: Bool,
) -> None:  # fmt: skip
    """Fills `out (N,)`: must brake. `row_of (K,)`: row of `along`, …, −1: none. `poses (K, J + 1, 3)`: scratch."""
    for k in range(len(along)):
        for j in range(instants[k]):
            poses[k, j, 0], poses[k, j, 1], poses[k, j, 2] = pose_on_path(path, along[k] + speed[k] * j * STEP_S)
    for n in range(len(instant_ix)):
        k = row_of[instant_ix[n]] if instant_ix[n] >= 0 else -1
        if k >= 0:
            out[n] = _must_brake(
                path, size, along[k], speed[k], deceleration[k], reaction_s, states[n], margin_m, share, poses[k],
                instants[k],
            )  # fmt: skip


@borrowing
def _must_brake(
    path: Float, size: Float, along: float, speed: float, deceleration: Float, reaction_s: float, state: Float,
    margin_m: float, share: float, poses: Float, steps: int,
) -> bool:  # fmt: skip
    """Whether the ego hits the state's box, both if it does not brake and with each part of the braking `share`."""
    dx, dy = state[X] - poses[0, 0], state[Y] - poses[0, 1]
    radii = (np.hypot(size[0], size[1]) + np.hypot(state[LENGTH], state[WIDTH])) / 2 + margin_m
    reach = (speed + np.hypot(state[VX], state[VY])) * (steps - 1) * STEP_S + radii
    if not dx * dx + dy * dy <= reach * reach:  # a place that is not known is nowhere
        return False
    distance_m = _distance(poses[0, 0], poses[0, 1], poses[0, 2], size, state, 0.0, radii)
    if distance_m <= 0.0:
        return False
    margin_m = 0.0 if distance_m <= margin_m else margin_m
    if not _meets_ahead(poses, steps, size, state, margin_m, radii):
        return False
    for k in range(_SHARES, 0, -1):
        part = deceleration[: steps - 1], share * k / _SHARES
        if not _is_hit(path, size, along, speed, part, reaction_s, state, margin_m, radii):
            return False
    return True


@borrowing
def _meets_ahead(poses: Float, steps: int, size: Float, state: Float, margin_m: float, radii: float) -> bool:
    """Whether the ego that does not brake meets the entry, which is then ahead of its centre."""
    for j in range(steps):
        x, y, yaw = poses[j, 0], poses[j, 1], poses[j, 2]
        if _distance(x, y, yaw, size, state, j * STEP_S, radii) <= margin_m:
            dx, dy = state[X] + state[VX] * j * STEP_S - x, state[Y] + state[VY] * j * STEP_S - y
            return bool(np.cos(yaw) * dx + np.sin(yaw) * dy >= 0.0)
    return False


@borrowing
def _is_hit(
    path: Float, size: Float, along: float, speed: float, braking: tuple[Float, float], reaction_s: float,
    state: Float, margin_m: float, radii: float,
) -> bool:  # fmt: skip
    """Whether the ego, `braking` with (deceleration by step, share), meets the state's box before it stands."""
    s, v = along, speed
    for j in range(len(braking[0])):
        end_s = (j + 1) * STEP_S
        dt = min(STEP_S, max(end_s - reaction_s, 0.0))
        s += v * (STEP_S - dt)
        a = braking[1] * braking[0][j]
        stands = a * dt >= v
        if stands:
            s += v * v / (2 * a)
            end_s += v / a - dt
        else:
            s += v * dt - a * dt * dt / 2
            v -= a * dt
        x, y, yaw = pose_on_path(path, s)
        if _distance(x, y, yaw, size, state, end_s, radii) <= margin_m:
            return True
        if stands:
            return False
    return False


@borrowing
def _distance(x: float, y: float, yaw: float, size: Float, state: Float, after_s: float, radii: float) -> float:
    """Distance of the ego's box from the entry's after some time; inf where centres are `radii` apart or more."""
    ex, ey = state[X] + state[VX] * after_s, state[Y] + state[VY] * after_s
    if (ex - x) ** 2 + (ey - y) ** 2 > radii * radii:
        return np.inf
    return float(box_distance(x, y, yaw, size[0], size[1], ex, ey, state[YAW], state[LENGTH], state[WIDTH]))

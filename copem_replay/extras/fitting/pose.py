"""The error of a unit's own pose, by what the errors of different objects in one list have in common; and its delay.

A pose off by a shift δ and a turn θ moves each entry by δ + θ·J d, where d leads from the unit to the object. Own
errors of objects do not correlate between objects: products over pairs give the variances of δ and θ without them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from scipy.stats import chi2, t

from copem_replay.core.tracks import CLASSES, Float, Int
from copem_replay.extras.fitting.error_memory import LastingPart
from copem_replay.extras.fitting.estimate import Estimate, LogPool, pool_logs
from copem_replay.extras.fitting.rows import FitLists, FitRows
from copem_replay.io.clock_offset import TimeOffset
from copem_replay.io.recorded_lists import RecordedLists
from copem_replay.io.recorded_units import delay_words, estimate_delay
from copem_replay.io.recording import Recording
from copem_replay.metrics.limits import FEWEST_LOGS

FEWEST_LISTS = 50
"""Lists with two listed objects or more below which no pose is fitted."""
FEWEST_BLOCKS = 4
"""Blocks of time below which no pose is fitted: each is left out in turn for the standard error."""
_BLOCK_S = 10.0
"""Length of a block: long beside most correlation times, short beside a log."""
_SURE = 0.99
"""Confidence from which on there is a pose error at all."""
_LAGS = (1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144, 233)
"""Lags of products in lists: Fibonacci numbers, about evenly spaced in their logarithm."""


@dataclass(frozen=True)
class PoseFit:
    """Standard deviations of the pose and the part of it that lasts; or why none are fitted."""

    position_sigma_m: Estimate | None = None
    yaw_sigma_deg: Estimate | None = None
    memory: LastingPart | None = None
    untold: str | None = None

    def keys(self) -> dict[str, Any]:
        """A unit's `placed`; empty where no pose is fitted."""
        sigmas = {"position_sigma_m": self.position_sigma_m, "yaw_sigma_deg": self.yaw_sigma_deg}
        out: dict[str, Any] = {name: one.written() for name, one in sigmas.items() if one is not None and one.value > 0}
        return out | ({} if self.memory is None else {"memory": [self.memory.keys()]})


def fit_pose(rows: FitRows, lists: FitLists) -> PoseFit:
    """Fit the pose error of a unit to listed rows. The mean of all rows is a bias of entries, not of the pose."""
    count = np.bincount(rows.list, minlength=len(lists.log))
    usable = int((count >= 2).sum())
    if usable < FEWEST_LISTS:
        return PoseFit(untold=f"{usable} lists have two objects or more; a pose needs {FEWEST_LISTS}")
    shared = rows.take(count[rows.list] >= 2)
    if (three := int((count >= 3).sum())) < FEWEST_LISTS:
        return PoseFit(untold=f"{three} lists have three objects: what two of them share need not be the unit's")
    b = shared.view.bearing_rad
    cos, sin, range_m = np.cos(b), np.sin(b), shared.view.range_m
    along, across = (one - one.mean() for one in (shared.along_m, shared.across_m))
    L = len(lists.log)
    block = (lists.captured_s / _BLOCK_S).astype(np.int64) + 1_000_000 * lists.log
    _, block = np.unique(block, return_inverse=True)

    def pairs(column: Float) -> Float:
        """(L,) Σ over pairs of different objects in a list."""
        pair_sum: Float = (np.bincount(shared.list, column, L) ** 2 - np.bincount(shared.list, column**2, L)) / 2
        return pair_sum

    # Products along have l·l' of the shift, those across l·l' of the shift and r r' of the turn; l: lines of sight.
    a11 = 2 * (pairs(cos * cos) + 2 * pairs(cos * sin) + pairs(sin * sin))
    a12, a22 = pairs(cos * range_m) + pairs(sin * range_m), pairs(range_m * range_m)
    b1 = sum(pairs(one * way) for one in (along, across) for way in (cos, sin))
    b2 = pairs(across * range_m)
    sums = np.array([np.bincount(block, one) for one in (a11, a12, a22, b1, b2)])
    lags = _sum_lagged_products(shared, lists, block, cos * along - sin * across, sin * along + cos * across)
    B = sums.shape[1]
    if B < FEWEST_BLOCKS:
        return PoseFit(untold=f"{usable} lists in {B} × {_BLOCK_S:g} s; a pose needs {FEWEST_BLOCKS} such times")
    left_out = [sums.sum(axis=1) - sums[:, k] for k in range(B)]
    free, error = _solve_variances(sums.sum(axis=1)), _jackknife(np.array([_solve_variances(one) for one in left_out]))
    if not (free > t.ppf(_SURE, B - 1) * error).any():
        variances = np.maximum(free, 0)
        most = np.sqrt(np.maximum(variances + 1.96 * error, 0))
        why = f"errors of different objects hang together no more than by chance (pose: < {most[0]:.2g} m, "
        return PoseFit(untold=f"{why}< {np.rad2deg(most[1]):.2g}°, {usable} lists)")
    variances, error = (
        _solve_nonnegative(sums.sum(axis=1)),
        _jackknife(np.array([_solve_nonnegative(one) for one in left_out])),
    )
    shift, turn = (_estimate_sigma(value, off, usable, B) for value, off in zip(variances, error, strict=True))
    value, low, high = np.rad2deg([turn.value, turn.low, turn.high]).tolist()
    memory = _fit_pose_memory(lags, float(np.median(np.diff(lists.captured_s)[np.diff(lists.log) == 0])), usable)
    return PoseFit(shift, Estimate(value, low, high, turn.n, turn.n_effective), memory)


def _jackknife(each: Float) -> Float:
    """(2,) the standard error of a value, from the values without each block (B, 2)."""
    error: Float = np.sqrt((len(each) - 1) * each.var(axis=0))
    return error


def _solve_variances(sums: Float) -> Float:
    """(2,) variances of shift (m²) and turn (rad²) from the normal equations; may be below 0."""
    a11, a12, a22, b1, b2 = sums
    both: Float = np.linalg.lstsq(np.array([[a11, a12], [a12, a22]]), np.array([b1, b2]), rcond=None)[0]
    return both  # least norm: objects in one direction and at one range do not tell shift and turn apart


def _solve_nonnegative(sums: Float) -> Float:
    """(2,) variances of shift (m²) and turn (rad²), 0 or more: where one would be below 0, the other alone."""
    both, (a11, _, a22, b1, b2) = _solve_variances(sums), sums
    if both[1] < 0:
        return np.array([max(b1 / a11, 0.0), 0.0])
    return both if both[0] >= 0 else np.array([0.0, max(b2 / a22, 0.0)])


def _estimate_sigma(variance: float, error: float, n: int, blocks: int) -> Estimate:
    """σ of a variance with its standard error, as of a sample with the degrees of freedom that give this error."""
    if variance <= error:
        return Estimate(float(np.sqrt(variance)), 0.0, float(np.sqrt(variance + 1.96 * error)), n, blocks)
    freedom = 2 * (variance / error) ** 2 * (blocks - 1) / (blocks + 1)
    low, high = np.sqrt(freedom * variance / chi2.ppf([0.975, 0.025], freedom))
    return Estimate(float(np.sqrt(variance)), float(low), float(high), n, blocks)


def _sum_lagged_products(rows: FitRows, lists: FitLists, block: Int, east_m: Float, north_m: Float) -> Float:
    """(1 + lags, 2, blocks) Σ eᵢ(t)·eⱼ(t + lag) over different objects i, j, and the number of pairs; lag 0 first."""
    L, B = len(lists.log), int(block.max()) + 1
    key = rows.object * L + rows.list + rows.log * L * (int(rows.object.max()) + 1)
    order = np.argsort(key)
    total = [np.bincount(rows.list, one, L) for one in (east_m, north_m, np.ones(len(east_m)))]
    out = np.zeros((1 + len(_LAGS), 2, B))
    for k, lag in enumerate((0, *_LAGS)):
        if lag >= L:
            break
        same_log = lists.log[: L - lag] == lists.log[lag:]
        product, pair_count = (
            np.where(same_log, sum(one[: L - lag] * one[lag:] for one in ones), 0.0) for ones in (total[:2], total[2:])
        )
        position = np.clip(np.searchsorted(key[order], key + lag), 0, len(key) - 1)
        later_row = order[position]
        own_pair = (key[later_row] == key + lag) & (rows.list + lag < L)
        own_product = east_m * east_m[later_row] + north_m * north_m[later_row]
        product -= np.bincount(rows.list[own_pair], own_product[own_pair], L)[: L - lag]
        pair_count -= np.bincount(rows.list[own_pair], minlength=L)[: L - lag]
        out[k] = [np.bincount(block[: L - lag], one, B) for one in (product, pair_count)]
    return out


def _fit_pose_memory(lags: Float, period_s: float, n: int) -> LastingPart | None:
    """The lasting part of the pose error: a drift, or a constant if that is too slow to tell; None: none is sure."""
    from scipy.optimize import least_squares

    B = lags.shape[2]
    delta_s = period_s * np.array(_LAGS)

    def fit_decay(sums: Float) -> Float:  # by lag the sum and number of products; (2,) share that lasts, ln of seconds
        mean = sums[:, 0] / np.maximum(sums[:, 1], 1)
        weight = np.sqrt(sums[1:, 1] / max(sums[0, 1], 1))

        def residuals_at(x: Float) -> Float:
            residual: Float = weight * (mean[1:] / mean[0] - np.clip(x[0], 0, 1) * np.exp(-delta_s / np.exp(x[1])))
            return residual

        solution: Float = least_squares(residuals_at, [0.7, np.log(10 * period_s)], bounds=([0, -5], [1, 9])).x
        return solution

    best = fit_decay(lags.sum(axis=2))
    left_out = np.array([fit_decay(lags.sum(axis=2) - lags[:, :, k]) for k in range(B)])
    error = 1.96 * _jackknife(left_out)
    if best[0] - error[0] <= 0:
        return None
    share = Estimate(float(best[0]), float(best[0] - error[0]), float(min(best[0] + error[0], 1.0)), n, B)
    low, middle, high = np.exp([best[1] - error[1], best[1], best[1] + error[1]])
    if middle > 3 * delta_s[-1]:
        return LastingPart(share, "always")
    return LastingPart(share, Estimate(float(middle), float(low), float(high), n, B))


# The delay of a unit's lists, over all logs: by its entries against the truth, or as declared.

_Z = 1.96
"""Standard deviations from the mean to the limits of a 95 % interval."""


@dataclass(frozen=True)
class DelayFit:
    """The delay from capture to stamp of every list that does not state its capture (s). `notes`: a line per log.

    `of_log`: by log what is used in place of that of all (`--delay-by`); `of_class`: by class of object the delay of
    entries about such objects, where it was asked for.
    """

    estimate: Estimate
    notes: tuple[str, ...] = ()
    of_log: Mapping[str, float] = field(default_factory=dict)
    of_class: Mapping[str, Estimate] = field(default_factory=dict)

    @property
    def seconds(self) -> float:
        """The delay in use."""
        return self.estimate.value

    def seconds_of(self, log: str) -> float:
        """The delay in use for a log."""
        return self.of_log.get(log, self.estimate.value)


def unit_delay(
    logs: Sequence[tuple[Recording, RecordedLists]], declared_s: float | None, *,
    by: Literal["log", "class"] | None = None, held_out: Sequence[Recording] = (),
) -> DelayFit:  # fmt: skip
    """The delay of the lists of all logs, or `declared_s` where they do not tell it; None: none is declared.

    A delay that could also be a shift along the way is used only where none is declared. `by` log: each log has its
    own, where it tells one; class: each log whose objects are of one class, `held_out` ones too, has that of the class.
    """
    if all(lists.capture_said.all() for _, lists in logs):
        late_s = np.concatenate([lists.tracks.arrives_s[0] - lists.tracks.captured_s for _, lists in logs])
        low, middle, high = np.quantile(late_s, [0.025, 0.5, 0.975])
        note = "every list says when it was captured; the interval holds 95 % of the lists"
        return DelayFit(Estimate(float(middle), float(low), float(high), len(late_s), float(len(late_s))), (note,))
    delays = {recording.scene.log: estimate_delay(lists, recording.scene, recording.truth) for recording, lists in logs}
    pooled = pool_delays(delays, declared_s)
    if by == "log":
        return replace(pooled, of_log={log: one.offset_s for log, one in delays.items() if one.untold is None})
    of_class = _estimate_by_class(logs) if by == "class" else {}
    kinds = {one.scene.log: _list_classes(one) for one in (*(one for one, _ in logs), *held_out)}
    known = {(kind,): one.value for kind, one in of_class.items() if np.isfinite(one.low)}
    return replace(pooled, of_log={log: known[one] for log, one in kinds.items() if one in known}, of_class=of_class)


def _list_classes(recording: Recording) -> tuple[str, ...]:
    """The classes of a log's true objects."""
    return tuple(CLASSES[k] for k in np.unique(recording.scene.object_class[recording.truth.object_ix]))


def _estimate_by_class(logs: Sequence[tuple[Recording, RecordedLists]]) -> dict[str, Estimate]:
    """By class the delay (s) of entries about its objects, estimated against the truth of this class alone."""
    out = {}
    for kind in sorted({kind for recording, _ in logs for kind in _list_classes(recording)}):
        delays = {}
        for recording, recorded in logs:
            truth, scene = recording.truth, recording.scene
            of_kind = truth.take_tracks(scene.object_class[truth.object_ix] == CLASSES.index(kind))
            if len(of_kind.object_ix):
                delays[scene.log] = estimate_delay(recorded, scene, of_kind)
        out[kind] = pool_delays(delays, None).estimate
    return out


def pool_delays(delays: Mapping[str, TimeOffset], declared_s: float | None) -> DelayFit:
    """The delay of several logs: their mean, with what they scatter by from three logs on (`pool_logs`)."""
    notes = tuple(f"delay in {log}: {delay_words(one)}" for log, one in delays.items()) + _note_contradiction(delays)
    unambiguous = [one for one in delays.values() if one.untold is None and not one.unbiased]
    if unambiguous:
        return DelayFit(_weigh_delays(unambiguous), notes)
    usable = [one for one in delays.values() if one.untold is None]
    why = "no log tells it from a shift along the way" if usable else "no log tells it"
    if declared_s is not None or not usable:
        return DelayFit(Estimate(declared_s or 0.0, why=f"{why}; kept as declared"), notes)
    mean = _weigh_delays(usable)
    why_used = f"{why}; if there is none, {mean.words()}"
    return DelayFit(Estimate(mean.value, mean.low, mean.high, mean.n, mean.n_effective, why=why_used), notes)


def _pool_offsets(offsets: Sequence[TimeOffset]) -> LogPool:
    sigma_s = np.array([(one.high_s - one.low_s) / (2 * _Z) for one in offsets])
    return pool_logs(np.array([one.offset_s for one in offsets]), sigma_s**2, sum(one.entries for one in offsets))


def _note_contradiction(delays: Mapping[str, TimeOffset]) -> tuple[str, ...]:
    """A line with the delays of all logs where chance does not make them differ so."""
    usable = {log: one for log, one in delays.items() if one.untold is None}
    if len(usable) < FEWEST_LOGS or not _pool_offsets(list(usable.values())).contradict:
        return ()
    each = ", ".join(f"{one.offset_s:.3f} s in {log}" for log, one in usable.items())
    return (f"delays contradict each other beyond chance: {each}; --delay-by log or class takes each its own",)


def _weigh_delays(offsets: Sequence[TimeOffset]) -> Estimate:
    """The mean delay (s) of some logs: with enough logs by random effects, else weighted, widened by Birge's ratio."""
    if len(offsets) >= FEWEST_LOGS:
        return _pool_offsets(offsets).mean
    offset_s = np.array([one.offset_s for one in offsets])
    sigma_s = np.array([(one.high_s - one.low_s) / (2 * _Z) for one in offsets])
    weight = 1 / sigma_s**2
    mean_s = float((weight * offset_s).sum() / weight.sum())
    birge_ratio = 1.0  # Birge's ratio
    if len(offsets) > 1:
        birge_ratio = max(1.0, float(np.sqrt((weight * (offset_s - mean_s) ** 2).sum() / (len(offsets) - 1))))
    half_s = float(_Z * birge_ratio / np.sqrt(weight.sum()))
    n = sum(one.entries for one in offsets)
    return Estimate(mean_s, mean_s - half_s, mean_s + half_s, n, float("nan"))

"""The Ideal Fusion Model (Piazzoni et al. 2022): matching by truth id, Σ = (Σₙ Σₙ⁻¹)⁻¹, μ = Σ · Σₙ Σₙ⁻¹ μₙ.

It combines the lists of the units, stale or not: nothing is predicted. Of each unit and object it takes the newest
entry among those of the unit's newest list and of all lists that the receiver takes in at the instant: each is
information, and no other fusion of these lists may know an object sooner. Assumes Gaussian errors, independent across
units. Two ways with one law: the units' sampled errors are weighed (Σₙ Σ Σₙ⁻¹ εₙ), or ε ~ N(μ, Σ) is drawn once. What
the paper leaves open is combined by inverse variance as well: yaw on the circle, size, speed; height above ground by
mean.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from copem_replay.communication.arrivals import FusionSchedule, KeptEntries, SentEntries, fusion_schedule, keep_entries
from copem_replay.core.compiled import borrowing_kernel
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.random import CounterRng, RandomKey, object_words
from copem_replay.core.tracks import NO_CAPTURE_NS, Bool, Float, Int, Scene, Tracks
from copem_replay.fusion.covariance import FLATTEST

SMALLEST_VARIANCE = 1e-9
"""A smaller variance counts as this in weights (m², rad², m²/s²): states without error have weights, too."""


def fuse_ideal(
    received: Tracks,
    *,
    max_age_s: float,
    without_object_ix: int = -1,
    instants: FusionSchedule | None = None,
    cached: KeptEntries | None = None,
) -> FusedTracks:
    """One fused list per instant of the receiver, as tracks of the one unit `fused`. `instants`: some of the instants.

    `cached`: the entries that `keep_by_object` keeps of units with partial messages; None: there are none.

    `received`: lists with truth ids; arrival times common to all runs. `without_object_ix`: the receiver's own body,
    which it does not list. Frames are the receiver's instants: `arrives_s` is when the list is available,
    `captured_s` the newest capture among the lists that it uses. NaN where an object is in none of them.
    """
    instants = instants or fusion_schedule(received, max_age_s=max_age_s)
    beside = find_lists_beside_newest(received, instants, cached)
    rows, start, object_ix, instant = _find_contributions(received, instants, beside, without_object_ix, cached)
    counts, rows, start = (
        _select_newest_entries(received, rows, start) if len(beside.frame) else (received.valid, rows, start)
    )
    valid = _any_valid(counts, rows, start)
    out = {name: np.full(valid.shape, np.nan) for name in ("x_m", "y_m", "cov_ee_m2", "cov_en_m2", "cov_nn_m2")}
    weighed = WeightedRows.of(received)
    x_m, y_m = map(np.ascontiguousarray, (received.x_m, received.y_m))  # of one layout, compiled once
    positions = Positions(x_m, y_m, *weighed.covariances)
    _combine_position(counts, positions, weighed.information, rows, start, Positions(*out.values()))
    spread = _combine_scalars(received, counts, weighed, rows, start, out)
    captured = np.where(instants.newest >= 0, received.captured_s[instants.newest], -np.inf).max(
        axis=1, initial=-np.inf
    )
    stamps = np.where(instants.newest >= 0, received.stamp_ns[instants.newest], NO_CAPTURE_NS).max(axis=1)
    np.maximum.at(captured, beside.instant, received.captured_s[beside.frame])
    np.maximum.at(stamps, beside.instant, received.stamp_ns[beside.frame])
    first = np.flatnonzero(np.diff(object_ix, prepend=-1) != 0)
    fused = Tracks(
        units=("fused",),
        start=np.append(first, len(object_ix)),
        unit_ix=np.zeros(len(first), dtype=np.int64),
        object_ix=object_ix[first],
        frame_ix=instant,
        stamp_ns=stamps,
        captured_s=captured,
        frame_unit_ix=np.zeros(len(instants.issue_s), dtype=np.int64),
        arrives_s=instants.issue_s[None],
        valid=valid,
        **spread,
        **out,
    )
    return FusedTracks(fused, received, rows, start)


def draw_posterior(fused_tracks: FusedTracks, scene: Scene, seed: int, runs: Int) -> FusedTracks:
    """One draw of ε ~ N(μ, Σ) per object and list, around the fused expected states (S, P)."""
    expected = fused_tracks.fused
    words = object_words(scene.object_ids)[expected.row_object_ix]
    zero = np.zeros(len(words), dtype=np.int64)
    random_key = RandomKey(("",), zero, words, expected.stamp_ns[expected.frame_ix])
    rng = CounterRng(seed, scene.log)
    z1 = rng.normal("ideal fusion 1", random_key, runs, expected.valid)
    z2 = rng.normal("ideal fusion 2", random_key, runs, expected.valid)
    assert expected.cov_ee_m2 is not None
    assert expected.cov_en_m2 is not None
    assert expected.cov_nn_m2 is not None
    l11 = np.sqrt(expected.cov_ee_m2)
    l21 = expected.cov_en_m2 / l11
    l22 = np.sqrt(np.maximum(expected.cov_nn_m2 - l21**2, 0.0))
    drawn = replace(expected, x_m=expected.x_m + l11 * z1, y_m=expected.y_m + l21 * z1 + l22 * z2)
    return replace(fused_tracks, fused=drawn)


def keep_by_object(
    received: Tracks, partial: Bool, schedule: FusionSchedule, instants: FusionSchedule, *, max_age_s: float
) -> KeptEntries:
    """The newest row of each object of the units whose messages are `partial (U,)`, in one run, at `instants`.

    Entries are counted list by list, as in `Tracks.by_frame`.
    """
    order, bounds = received.by_frame
    is_listed = received.valid[0] & (received.row_object_ix >= 0)
    object_of = np.unique(np.stack([received.row_unit_ix, received.row_object_ix]), axis=1, return_inverse=True)[
        1
    ].ravel()
    return keep_entries(
        received,
        SentEntries(bounds, np.where(is_listed, object_of, -1)[order]),
        partial,
        schedule,
        instants,
        max_age_s=max_age_s,
    )


class BesideNewest(NamedTuple):
    """Lists (B,) that ideal fusion uses beside the newest ones: the instant and the list, each list once."""

    instant: Int
    frame: Int


def find_lists_beside_newest(received: Tracks, instants: FusionSchedule, cached: KeptEntries | None) -> BesideNewest:
    """The lists beside the newest ones at `instants`, without partial messages: `cached` holds those."""
    instant, frame = instants.beside_newest()
    if cached is not None:
        complete = ~cached.partial[received.frame_unit_ix[frame]]
        instant, frame = instant[complete], frame[complete]
    return BesideNewest(instant, frame)


def _select_lists(
    received: Tracks, instants: FusionSchedule, beside: BesideNewest, cached: KeptEntries | None
) -> tuple[Int, Int]:
    """Instants, ascending, and the lists that are used at each: unit by unit, the newest first."""
    newest = instants.newest if cached is None else cached.newest
    instant, unit = np.nonzero(newest >= 0)
    frame = newest[newest >= 0]
    if not len(beside.frame):
        return instant, frame
    age = np.append(np.full(len(frame), np.iinfo(np.int64).min), -received.stamp_ns[beside.frame])
    instant, frame = np.append(instant, beside.instant), np.append(frame, beside.frame)
    order = np.lexsort((age, np.append(unit, received.frame_unit_ix[beside.frame]), instant))
    return instant[order], frame[order]


def _find_contributions(
    received: Tracks, instants: FusionSchedule, beside: BesideNewest, without_object_ix: int, cached: KeptEntries | None
) -> tuple[Int, Int, Int, Int]:
    """Contributions: the rows (C,) of `received` that make up each fused row, start (P + 1,), object and instant (P,).
    Entries without truth id (of recorded units) and those of `without_object_ix` contribute to none.
    """
    order, bounds = received.by_frame
    begin, count = bounds[:-1], np.diff(bounds)
    if cached is not None:
        begin, count = np.append(begin, cached.start[:-1] + len(order)), np.append(count, np.diff(cached.start))
        order = np.append(order, order[cached.entry])
    instant, frame = _select_lists(received, instants, beside, cached)
    begin, count = begin[frame], count[frame]
    offset = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    rows = order[np.repeat(begin, count) + offset]
    instant = np.repeat(instant, count)
    object_ix = received.row_object_ix[rows]
    is_kept = (object_ix != without_object_ix) & (object_ix >= 0)
    rows, instant, object_ix = rows[is_kept], instant[is_kept], object_ix[is_kept]
    # Rows of an object are in order of instants and units already; the sort of small integers is fast.
    order_by_object = np.argsort(object_ix.astype(np.min_scalar_type(object_ix.max(initial=0))), kind="stable")
    rows, instant, object_ix = rows[order_by_object], instant[order_by_object], object_ix[order_by_object]
    first_rows = np.flatnonzero((np.diff(object_ix, prepend=-1) != 0) | (np.diff(instant, prepend=-1) != 0))
    return rows, np.append(first_rows, len(rows)), object_ix[first_rows], instant[first_rows]


def _select_newest_entries(received: Tracks, rows: Int, start: Int) -> tuple[Bool, Int, Int]:
    """(S, P) the rows that count: of a unit's entries about one object at an instant only the newest that was detected.

    Also the contributions, as in `_find_contributions`, without those that were detected and count in no run. A list
    beside a newest one is at one instant only, so its rows count there or nowhere.
    """
    counts, unit_ix = received.valid.copy(), received.row_unit_ix
    _drop_older_entries(received.valid, rows, start, unit_ix, counts)
    stay = counts[:, rows].any(axis=0) | ~received.valid[:, rows].any(axis=0)
    return counts, rows[stay], np.append(0, np.cumsum(stay))[start]


@borrowing_kernel
def _drop_older_entries(valid: Bool, rows: Int, start: Int, unit_ix: Int, counts: Bool) -> None:
    """Sets `counts` False at detected rows behind a newer detected one of their unit and object. Contributions are in
    the order of units, and of each unit the newest is the first.
    """
    for s in range(valid.shape[0]):
        for p in range(len(start) - 1):
            unit, newer = -1, False
            for c in range(start[p], start[p + 1]):
                r = rows[c]
                if unit_ix[r] != unit:
                    unit, newer = unit_ix[r], False
                if valid[s, r] and newer:
                    counts[s, r] = False
                newer = newer or valid[s, r]


def _inverse_covariances(received: Tracks) -> tuple[Float, Float, Float]:
    """Inverse position covariances ee, en, nn (1 | S, P), with the eigenvalues of `floor_covariances` inverted."""
    high, low, c2, s2 = _covariance_axes(*_stated_covariances(received))
    mean, difference = (1 / high + 1 / low) / 2, (1 / high - 1 / low) / 2
    return mean + difference * c2, difference * s2, mean - difference * c2


def floor_covariances(received: Tracks) -> tuple[Float, Float, Float]:
    """Stated position covariances ee, en, nn (1 | S, P) with small eigenvalues raised: see `floor_eigenvalues`."""
    cov = _stated_covariances(received)
    high, low, c2, s2 = _covariance_axes(*cov)
    mean, difference = (high + low) / 2, (high - low) / 2
    wide = low <= (cov[0] + cov[2]) / 2 - np.hypot((cov[0] - cov[2]) / 2, cov[1])
    ee, en, nn = mean + difference * c2, difference * s2, mean - difference * c2
    return np.where(wide, cov[0], ee), np.where(wide, cov[1], en), np.where(wide, cov[2], nn)


def _stated_covariances(received: Tracks) -> tuple[Float, Float, Float]:
    """Position covariances ee, en, nn (1 | S, P) as stated, 0 where they are not."""
    none = np.zeros((1, len(received.frame_ix)))
    ee, en, nn = (none if c is None else c for c in (received.cov_ee_m2, received.cov_en_m2, received.cov_nn_m2))
    return ee, en, nn


def _covariance_axes(a: Float, b: Float, d: Float) -> tuple[Float, Float, Float, Float]:
    """Eigenvalues of position covariances, floored, larger first; cos 2φ and sin 2φ of the larger one's direction φ."""
    half, turn = (a + d) / 2, np.hypot((a - d) / 2, b)
    high = np.maximum(half + turn, SMALLEST_VARIANCE)
    low = np.maximum(half - turn, np.maximum(SMALLEST_VARIANCE, FLATTEST * high))
    c2 = np.where(turn > 0, (a - d) / 2 / np.where(turn > 0, turn, 1), 1.0)
    s2 = np.where(turn > 0, b / np.where(turn > 0, turn, 1), 0.0)
    return high, low, c2, s2


_VARIANCES = ("yaw_var_rad2", "size_var_m2", "speed_var_m2ps2")
_ALIKE = len(_VARIANCES)
_WEIGHED_BY = {
    "sin": 0, "cos": 0, "length_m": 1, "width_m": 1, "height_m": 1, "vx_mps": 2, "vy_mps": 2, "z_m": _ALIKE,
}  # fmt: skip
"""The scalars that are combined, and the variance in `_VARIANCES` that weighs each (`_ALIKE`: all count 1)."""


class WeightedRows(NamedTuple):
    """Values and weights of rows (P,), listed or not."""

    covariances: tuple[Float, Float, Float]
    information: PositionInformation
    scalars: Float  # (S | 1, P, V)
    weights: Float

    @classmethod
    def of(cls, received: Tracks) -> WeightedRows:
        """Values of the rows of `received`, and the weights (inverse variances) that they have when combined."""
        zeros = np.zeros((1, len(received.frame_ix)))
        information = [
            1 / np.maximum(zeros if variance is None else variance, SMALLEST_VARIANCE)
            for variance in _stated_variances(received)
        ]
        yaw = {"sin": np.sin(received.yaw_rad), "cos": np.cos(received.yaw_rad)}
        values = [yaw[name] if name in yaw else getattr(received, name) for name in _WEIGHED_BY]
        scalars, weights = _stack_columns(values), _stack_columns([*information, zeros + 1])
        return cls(floor_covariances(received), PositionInformation(*_inverse_covariances(received)), scalars, weights)


def _stated_variances(received: Tracks) -> list[Float | None]:
    return [getattr(received, name) for name in _VARIANCES]


def _combine_scalars(
    received: Tracks, counts: Bool, weighed: WeightedRows, rows: Int, start: Int, out: dict[str, Float]
) -> dict[str, Float]:
    """Fills `out` with inverse-variance means (S, P) of scalars; returns their variances, NaN: none contributes.
    `counts`: which rows contribute.
    """
    shape = len(counts), len(start) - 1
    means, spreads = np.full((len(_WEIGHED_BY), *shape), np.nan), np.full((_ALIKE + 1, *shape), np.nan)
    scratch = np.empty(len(rows), np.int64), np.empty((shape[1], len(_WEIGHED_BY)), np.bool_)
    weighed_by = np.array([*_WEIGHED_BY.values()])
    _sum_scalars(counts, weighed.scalars, weighed.weights, weighed_by, rows, start, means, spreads, scratch)
    mean_of = dict(zip(_WEIGHED_BY, means, strict=True))
    out["yaw_rad"] = np.arctan2(mean_of.pop("sin"), mean_of.pop("cos"))
    out.update(mean_of)
    return {
        name: np.where(np.isnan(spread), np.nan, 0.0) if variance is None else spread
        for name, variance, spread in zip(_VARIANCES, _stated_variances(received), spreads, strict=False)
    }


def _stack_columns(columns: list[Float]) -> Float:
    """(S | 1, P, V) from V columns (S | 1, P)."""
    return np.stack(np.broadcast_arrays(*columns), axis=-1)


def _any_valid(valid: Bool, rows: Int, start: Int) -> Bool:
    """(S, P) whether any row that contributes is valid."""
    out = np.zeros((len(valid), len(start) - 1), dtype=np.bool_)
    _fill_any_valid(valid, rows, start, out)
    return out


@borrowing_kernel
def _fill_any_valid(valid: Bool, rows: Int, start: Int, out: Bool) -> None:
    for s in range(out.shape[0]):
        for p in range(out.shape[1]):
            for c in range(start[p], start[p + 1]):
                if valid[s, rows[c]]:
                    out[s, p] = True
                    break


class Positions(NamedTuple):
    """Positions and their covariances, one row for all runs where these agree: (S | 1, P) each."""

    x_m: Float
    y_m: Float
    ee_m2: Float
    en_m2: Float
    nn_m2: Float


class PositionInformation(NamedTuple):
    """Inverse covariances of positions, one row for all runs where these agree: (S | 1, P) each."""

    ee: Float
    en: Float
    nn: Float


@borrowing_kernel
def _combine_position(
    valid: Bool, given: Positions, information: PositionInformation, rows: Int, start: Int, out: Positions
) -> None:
    """Fills `out` with combined positions and covariances (S, P); rows without contribution stay as they are."""
    x, y, cov_ee, cov_en, cov_nn = given
    ee, en, nn = information
    out_x, out_y, out_ee, out_en, out_nn = out
    for s in range(out_x.shape[0]):
        i = s if ee.shape[0] > 1 else 0  # one row where all runs agree
        j = s if x.shape[0] > 1 else 0
        for p in range(out_x.shape[1]):
            a = b = d = u = v = x0 = y0 = 0.0
            n, last_row = 0, -1
            for c in range(start[p], start[p + 1]):
                r = rows[c]
                if not valid[s, r]:
                    continue
                if n == 0:  # relative to the first: weights of exact states are large
                    x0, y0 = x[j, r], y[j, r]
                n, last_row = n + 1, r
                dx, dy = x[j, r] - x0, y[j, r] - y0
                a, b, d = a + ee[i, r], b + en[i, r], d + nn[i, r]
                u, v = u + ee[i, r] * dx + en[i, r] * dy, v + en[i, r] * dx + nn[i, r] * dy
            if n == 1:  # as it is, to the last bit
                out_ee[s, p], out_en[s, p], out_nn[s, p] = cov_ee[i, last_row], cov_en[i, last_row], cov_nn[i, last_row]
                out_x[s, p], out_y[s, p] = x0, y0
            elif n:
                det = a * d - b * b
                out_ee[s, p], out_en[s, p], out_nn[s, p] = d / det, -b / det, a / det
                out_x[s, p], out_y[s, p] = x0 + (d * u - b * v) / det, y0 + (a * v - b * u) / det


@borrowing_kernel
def _sum_scalars(
    valid: Bool, values: Float, weights: Float, weighed_by: Int, rows: Int, start: Int, means: Float, spreads: Float,
    scratch: tuple[Int, Bool],
) -> None:  # fmt: skip
    """Fills `means (V, S, fused rows)` and `spreads (W, S, fused rows)`, variances, where anything contributes. `values
    (S | 1, P, V)` and `weights (S | 1, P, W)` have one row where all runs agree.
    """
    contributing, is_equal = scratch
    for p in range(len(start) - 1):  # whether all that may contribute agree, in any run
        for v in range(values.shape[2]):
            is_equal[p, v] = values.shape[0] == 1
            for c in range(start[p] + 1, start[p + 1]):
                is_equal[p, v] &= values[0, rows[c], v] == values[0, rows[start[p]], v]
    for s in range(valid.shape[0]):
        value = values[s if values.shape[0] > 1 else 0]
        weight = weights[s if weights.shape[0] > 1 else 0]
        for p in range(len(start) - 1):
            n = 0
            for c in range(start[p], start[p + 1]):
                if valid[s, rows[c]]:
                    contributing[n] = rows[c]
                    n += 1
            if n == 0:
                continue
            for w in range(spreads.shape[0]):
                total = 0.0
                for c in range(n):
                    total += weight[contributing[c], w]
                spreads[w, s, p] = 1 / total
            for v in range(means.shape[0]):
                w, first = weighed_by[v], value[contributing[0], v]
                moment = 0.0
                for c in range(1, 1 if is_equal[p, v] else n):
                    moment += weight[contributing[c], w] * (value[contributing[c], v] - first)
                if moment != 0.0:
                    total = 0.0
                    for c in range(n):
                        total += weight[contributing[c], w]
                    moment /= total
                means[v, s, p] = first + moment

"""Rows to fit a perception error model to, drawn from the model itself, plainly."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.extras.fitting.rows import FitLists, FitRows

PERIOD_S = 0.1


def held_uniforms(rng: np.random.Generator, n: int, share: float, tau_s: float) -> np.ndarray:
    """(n,) uniforms 0.1 s apart: with probability `share` the held one, renewed with 1 − e^(−Δ/τ), else a new one."""
    renewed = rng.random(n) > np.exp(-PERIOD_S / tau_s)
    renewed[0] = True
    held = rng.random(n)[np.maximum.accumulate(np.where(renewed, np.arange(n), 0))]
    return np.where(rng.random(n) < share, held, rng.random(n))


def view_of(range_m: np.ndarray, visible_share: np.ndarray, class_ix: np.ndarray | int = 0) -> ViewGeometry:
    one = np.ones(len(range_m))
    kind = np.broadcast_to(np.asarray(class_ix, dtype=np.int8), len(range_m)).copy()
    return ViewGeometry(range_m, 0 * one, 0 * one, visible_share, kind, one, one, one, 0 * one, 5 * one)


def rows_of(pass_ix: np.ndarray, listed: np.ndarray, view: ViewGeometry, folds: int = 5) -> FitRows:
    """Rows of passes that follow each other, lists 0.1 s apart, without errors."""
    n = len(pass_ix)
    first = np.r_[0, np.flatnonzero(np.diff(pass_ix)) + 1]
    number = np.arange(n) - np.repeat(first, np.diff(np.r_[first, n]))
    nothing, none = np.full(n, np.nan), np.full(n, -1)
    return FitRows(
        list=number, log=0 * pass_ix, object=pass_ix, pass_ix=pass_ix, captured_s=number * PERIOD_S, view=view,
        state_m=np.zeros((n, 2)), listed=listed, along_m=nothing, across_m=nothing, east_m=nothing, north_m=nothing,
        yaw_rad=nothing, speed_mps=nothing, size_m=np.full((3, n), np.nan), class_ix=none, existence=nothing,
        track_id=none, fold=pass_ix % folds,
    )  # fmt: skip


def lists_of(rows: FitRows) -> FitLists:
    count = int(rows.list.max()) + 1
    zero = np.zeros(count)
    entries = np.bincount(rows.list[rows.listed], minlength=count)
    return FitLists(np.zeros(count, dtype=int), np.arange(count) * PERIOD_S, zero, zero, zero, entries)


def passes(
    seed: int, count: int, length: int, probability: Callable[[ViewGeometry], np.ndarray],
    memory: tuple[float, float] = (0.0, 1.0), far_m: float = 60.0,
) -> FitRows:  # fmt: skip
    """`count` straight drives past the unit, each of `length` lists, at a visible share that wanders from 0 to 1.

    `memory`: share and correlation time of detection.
    """
    rng = np.random.default_rng(seed)
    x = np.linspace(-1, 1, length) * rng.uniform(0.5, 1, (count, 1)) * far_m
    range_m = np.hypot(x, rng.uniform(2, far_m / 3, (count, 1))).ravel()
    phase, speed = rng.uniform(0, 2 * np.pi, (2, count, 1))
    share = np.clip(0.6 + 0.6 * np.sin(phase + speed * np.arange(length) / length), 0, 1).ravel()
    view = view_of(range_m, share)
    u = np.concatenate([held_uniforms(rng, length, *memory) for _ in range(count)])
    return rows_of(np.repeat(np.arange(count), length), u < probability(view), view)

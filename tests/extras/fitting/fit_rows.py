"""Rows of a fit, made by hand: what was drawn is known."""

from collections.abc import Callable

import numpy as np

from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.extras.fitting.rows import FitLists, FitRows, OtherEntries


def lasting_normals(
    rng: np.random.Generator, captured_s: np.ndarray, drift: float, tau_s: float, constant: float, columns: int
) -> np.ndarray:
    """(n, C) standard normals of one series: a recursion over its lists, written plainly."""
    wander = rng.normal(size=columns)
    bias = rng.normal(size=columns)
    out = np.empty((len(captured_s), columns))
    for k in range(len(captured_s)):
        if k:
            f = np.exp(-(captured_s[k] - captured_s[k - 1]) / tau_s)
            wander = f * wander + np.sqrt(1 - f * f) * rng.normal(size=columns)
        white = rng.normal(size=columns)
        out[k] = np.sqrt(drift) * wander + np.sqrt(constant) * bias + np.sqrt(max(1 - drift - constant, 0)) * white
    return out


def rows_of(
    seed: int = 0,
    *,
    passes: int = 20,
    lists_each: int = 80,
    memory: tuple[float, float, float] = (0.6, 1.0, 0.0),
    spread: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]] = lambda range_m: (
        0.4 + 0 * range_m,
        0.2 + 0 * range_m,
    ),
    mean_m: tuple[float, float] = (0.2, -0.1),
    listed: float = 0.8,
    folds: int = 5,
    period_s: float = 0.1,
) -> tuple[FitRows, FitLists]:
    """Objects that drive past a unit at (0, 0) one after the other, 40 m to 5 m and out to 40 m again.

    `spread`: standard deviations along and across by range. `memory`: drift, its τ and the constant share.
    """
    rng = np.random.default_rng(seed)
    P, m = passes, lists_each
    n = P * m
    pass_ix = np.repeat(np.arange(P), m)
    captured_s = period_s * (np.arange(n) + 20 * pass_ix) + rng.uniform(0, 0.01, n)
    east = np.tile(np.linspace(-40, 40, m), P)
    state = np.column_stack([east, np.full(n, 5.0) + 0 * east])
    range_m, bearing = np.hypot(*state.T), np.arctan2(state[:, 1], state[:, 0])
    z = np.concatenate([lasting_normals(rng, captured_s[pass_ix == p], *memory, 6) for p in range(P)])
    sigma = spread(range_m)
    there = rng.uniform(size=n) < listed
    gone = np.where(there, 0.0, np.nan)
    along, across = mean_m[0] + sigma[0] * z[:, 0] + gone, mean_m[1] + sigma[1] * z[:, 1] + gone
    cos, sin = np.cos(bearing), np.sin(bearing)
    half = np.full(n, 0.5)
    view = ViewGeometry(range_m, bearing, bearing, np.tile(np.where(np.arange(m) % 7 == 0, 0.5, 1.0), P),
                        np.full(n, 3, dtype=np.int8), 9 * half, 4 * half, 3 * half, 0 * half, 20 * half)  # fmt: skip
    rows = FitRows(
        np.arange(n), np.zeros(n, dtype=np.int64), pass_ix, pass_ix, captured_s, view, state, there,
        along, across, cos * along - sin * across, sin * along + cos * across,
        0.05 * z[:, 2] + gone, np.full(n, np.nan), 0.3 * z[:, 3:6].T + gone,
        np.where(there, 3, -1), np.where(there, 0.9, np.nan), np.where(there, pass_ix, -1), pass_ix % folds,
    )  # fmt: skip
    none = np.zeros(n)
    return rows, FitLists(np.zeros(n, dtype=np.int64), captured_s, none, none, none, there.astype(np.int64))


def nothing_else() -> OtherEntries:
    """No other entries."""
    none, whole = np.empty(0), np.empty(0, dtype=np.int64)
    return OtherEntries(whole, whole, none, none, none, none, none, none, whole, whole, none, whole)

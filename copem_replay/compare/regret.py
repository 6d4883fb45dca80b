"""What one configuration loses or gains against another, metric by metric, over the rows and lists that both have.

Rows are paired by log, object and run, lists by instant; differences are first − second. Definitions are those of
`summary.csv`, but for what pairs allow:

*ttd_rmst_s*: the mean of min(T, horizon). Never detected counts as the horizon; who was still there when we stopped
looking as the time looked, at most the horizon, in both alike.
*dad_median_m*: the median of the differences, not the difference of the medians. Never detected is below every
distance, so it differs infinitely from a distance, and not at all from never.
*gospa_m*: a list counts where an object is measured in it, on or after its onset.
*ttd_rmst_s_equal_ghosts*: ttd_rmst_s, with entries below a threshold of existence left out: of each side the lowest
with at most so many ghosts per minute, over all logs and runs. Resamples keep the threshold.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from copem_replay.compare.figures import Figure, OfMedians, OfSums
from copem_replay.compare.grid import Grid
from copem_replay.compare.intervals import Whose
from copem_replay.compare.lists import together
from copem_replay.compare.sides import Ghosts, Side
from copem_replay.tracks import Bool, Float, Int

METRICS = {
    "detected_share": 1,
    "ttd_rmst_s": -1,
    "ttd_rmst_s_equal_ghosts": -1,
    "dad_median_m": 1,
    "position_rmse_m": -1,
    "gospa_m": -1,
    "ghosts_per_min": -1,
    "pass_share": 1,
}
"""All metrics, and whether more (1) or less (−1) is better."""


@dataclass(frozen=True)
class Setting:
    """How all pairs are measured: the horizon, GOSPA's power, and at how many ghosts per minute times are compared."""

    horizon_s: float
    power: float
    ghosts_per_min: float | None


@dataclass(frozen=True)
class Regret:
    """A metric of a pair; `existence`: the thresholds of the first and of the second, where there are such."""

    metric: str
    figure: Figure
    existence: tuple[float, float] | None = None


def regrets(first: Side, second: Side, grid: Grid, setting: Setting) -> Iterator[Regret]:
    """Every metric that both sides have what it takes for."""
    cells = np.flatnonzero(first.there & second.there)
    yield Regret("detected_share", _shares(grid, cells, first.detected[cells], second.detected[cells]))
    times = [_times_s(side, side.detection_s, cells, setting.horizon_s) for side in (first, second)]
    yield Regret("ttd_rmst_s", _means(grid, cells, times[0], times[1]))
    yield from _at_equal_ghosts(first, second, grid, cells, setting)
    yield Regret("dad_median_m", _distances(first, second, grid, cells))
    yield from _of_lists(first, second, grid, cells, setting.power)
    if first.ghosts is not None and second.ghosts is not None:
        yield Regret("ghosts_per_min", _ghosts(first, second, first.ghosts, second.ghosts, grid, cells))
    if first.conflict is not None and second.conflict is not None:
        assert first.passes is not None
        assert second.passes is not None
        judged = cells[first.conflict[cells] & second.conflict[cells]]
        yield Regret("pass_share", _shares(grid, judged, first.passes[judged], second.passes[judged]))


def _whose(grid: Grid, cells: Int) -> Whose:
    return Whose(grid.log_of[cells], grid.object_of[cells], grid.run_of[cells])


def _mean(sums: Float) -> tuple[Float, Float]:
    return sums[..., 0] / sums[..., 2], sums[..., 1] / sums[..., 2]


def _root(power: float) -> Callable[[Float], tuple[Float, Float]]:
    def of(sums: Float) -> tuple[Float, Float]:
        first, second = _mean(sums)
        return first ** (1 / power), second ** (1 / power)

    return of


def _means(grid: Grid, cells: Int, first: Float, second: Float, only: Int | None = None) -> OfSums:
    ones = np.ones(len(cells))
    return OfSums(
        whose=_whose(grid, cells),
        n=ones.astype(np.int64),
        only=only,
        sums=np.stack([first, second, ones], axis=1),
        of=_mean,
    )


def _shares(grid: Grid, cells: Int, first: Bool, second: Bool) -> OfSums:
    only = np.stack([first & ~second, second & ~first], axis=1).astype(np.int64)
    return _means(grid, cells, first.astype(float), second.astype(float), only)


def _times_s(side: Side, detection_s: Float, cells: Int, horizon_s: float) -> Float:
    """(C,) min(T, horizon) of cells, detected at `detection_s (N·S,)` or, NaN, not. To a nanosecond, as in summary."""
    onset_s = side.onset_s[cells]
    looked_s = np.where(side.left[cells], np.inf, side.ended_s[cells] - onset_s)
    time_s = np.where(np.isnan(detection_s[cells]), looked_s, detection_s[cells] - onset_s)
    return np.minimum(np.round(time_s, 9), horizon_s)


def threshold(ghosts: Ghosts, per_min: float) -> float | None:
    """The lowest existence with at most so many ghosts per minute; None: even the highest has more."""
    minutes, counts = ghosts.minutes[ghosts.there].sum(), ghosts.at[ghosts.there].sum(axis=0)
    enough = counts <= per_min * minutes * (1 + 1e-9)
    return float(ghosts.existence[np.argmax(enough)]) if enough.any() and minutes > 0 else None


def own_rate(ghosts: Ghosts) -> float | None:
    """Ghosts per minute at the lowest existence there is."""
    minutes = float(ghosts.minutes[ghosts.there].sum())
    return float(ghosts.at[ghosts.there, 0].sum()) / minutes if len(ghosts.existence) and minutes > 0 else None


def _at_equal_ghosts(first: Side, second: Side, grid: Grid, cells: Int, setting: Setting) -> Iterator[Regret]:
    limits, times = [], []
    for side in (first, second):
        if side.ghosts is None or side.steps is None or setting.ghosts_per_min is None:
            return
        limit = threshold(side.ghosts, setting.ghosts_per_min)
        detection_s = np.full(len(grid.object_of), np.inf)
        if limit is not None:
            kept = side.steps.existence >= limit
            np.minimum.at(detection_s, side.steps.cell[kept], side.steps.detection_s[kept])
        limits.append(np.nan if limit is None else limit)
        detection_s[np.isinf(detection_s)] = np.nan
        times.append(_times_s(side, detection_s, cells, setting.horizon_s))
    times = [np.where(np.isnan(limit), np.nan, time_s) for limit, time_s in zip(limits, times, strict=True)]
    yield Regret("ttd_rmst_s_equal_ghosts", _means(grid, cells, times[0], times[1]), (limits[0], limits[1]))


def _distances(first: Side, second: Side, grid: Grid, cells: Int) -> OfMedians:
    known = [np.where(side.detected[cells], side.distance_m[cells], -np.inf) for side in (first, second)]
    placed = ~np.isnan(known[0] + known[1])  # NaN: detected during a gap of the truth, no distance to rank
    return OfMedians(
        whose=_whose(grid, cells[placed]),
        n=np.ones(int(placed.sum()), dtype=np.int64),
        first=known[0][placed],
        second=known[1][placed],
    )


def _of_lists(first: Side, second: Side, grid: Grid, cells: Int, power: float) -> Iterator[Regret]:
    """Errors and GOSPA; lists are of no object in particular, so that their number stays when objects are resampled."""
    if first.accuracy is None or second.accuracy is None:
        return
    both = together(first.accuracy, second.accuracy, grid, cells)
    squares = np.concatenate([both.squared_m2, both.matched[:, None]], axis=1)
    of_errors = OfSums(whose=_whose(grid, cells), n=both.matched, sums=squares, of=_root(2.0))
    yield Regret("position_rmse_m", of_errors.take(both.matched > 0))
    there = both.measured > 0
    parts = np.concatenate([both.gospa, np.zeros((len(cells), 1))], axis=1)[there]
    whose, sums, n = _with_places(grid, cells[there], parts, np.outer(both.lists, [0.0, 0.0, 1.0]), both.lists)
    yield Regret("gospa_m", OfSums(whose=whose, n=n, sums=sums, of=_root(power)))


def _ghosts(first: Side, second: Side, ghosts: Ghosts, others: Ghosts, grid: Grid, cells: Int) -> OfSums:
    """Ghosts over minutes; those that are nearest to no measured object are of their list only."""
    there = ghosts.there & others.there
    cells = cells[there[_places(grid, cells)]]
    nearest = np.zeros((len(cells), 4))
    by_object = first.accuracy is not None and second.accuracy is not None
    rest = np.stack([ghosts.count, others.count, ghosts.minutes, others.minutes], axis=1).astype(float)
    rest[~there] = 0.0
    for k, side in enumerate((first, second)):
        if by_object and side.accuracy is not None:
            nearest[:, k] = side.accuracy.ghosts[cells]
            rest[:, k] -= np.bincount(_places(grid, cells), nearest[:, k], minlength=len(rest))
    whose, sums, n = _with_places(grid, cells, nearest, rest, there.astype(np.int64))
    return OfSums(whose=whose, n=n, sums=sums, by_object=by_object, of=_rates)


def _rates(sums: Float) -> tuple[Float, Float]:
    return sums[..., 0] / sums[..., 2], sums[..., 1] / sums[..., 3]


def _places(grid: Grid, cells: Int) -> Int:
    places: Int = grid.log_of[cells] * grid.runs + grid.run_of[cells]
    return places


def _with_places(grid: Grid, cells: Int, of_cells: Float, of_places: Float, n: Int) -> tuple[Whose, Float, Int]:
    """Items of cells, then of all places that count for something (`n (L·S,)`): of a log and a run, of no object."""
    at = np.flatnonzero(n)
    whose = Whose(
        np.concatenate([grid.log_of[cells], at // grid.runs]),
        np.concatenate([grid.object_of[cells], np.full(len(at), -1)]),
        np.concatenate([grid.run_of[cells], at % grid.runs]),
    )
    counts = np.concatenate([np.zeros(len(cells), dtype=np.int64), n[at]])
    return whose, np.concatenate([of_cells, of_places[at]]), counts

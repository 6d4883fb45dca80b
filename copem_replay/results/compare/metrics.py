"""What one configuration loses or gains against another, metric by metric, over the rows and lists that both have.

Rows are paired by log, object and run, lists by instant; differences are first − second. Definitions are those of
`summary.csv`, but for what pairs allow:

*ttd_rmst_s*: the difference of the two restricted means over the rows that both have; never detected counts as the
horizon, who was still there when we stopped looking is censored.
*dad_median_m*: the median of the differences, not the difference of the medians. Never detected is below every
distance, so it differs infinitely from a distance, and not at all from never.
*gospa_m*: a list counts where an object is measured in it, on or after its onset.
*ttd_rmst_s_equal_ghosts*: ttd_rmst_s, with entries below a threshold of existence left out, so that each side has as
many ghosts per minute over all logs and runs as is asked for, stale ones not counted; where that says something
(`results/compare/equal_ghosts.py`). Between two thresholds (the second may leave nothing)
it is their mixture that has exactly as many: a share of the drives goes by the one, the rest by the other, as between
two points of a ROC curve. Resamples keep the thresholds and the share.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.metrics.summary_metrics import METRIC
from copem_replay.metrics.survival import CENSORED, DETECTED, LEFT
from copem_replay.results.compare.bootstrap import Whose
from copem_replay.results.compare.configuration_data import ConfigurationData, Ghosts, StepData
from copem_replay.results.compare.differences import Figure, OfMedians, OfSums, OfTimes, Times
from copem_replay.results.compare.pairing import Grid
from copem_replay.results.compare.per_list import together

METRICS = {name: METRIC[name.removesuffix("_equal_ghosts")].better for name in (
    "detected_share", "ttd_rmst_s", "ttd_rmst_s_equal_ghosts", "dad_median_m", "position_rmse_m", "gospa_m",
    "false_positives_per_min", "pass_share",
)}  # fmt: skip
"""All metrics, and whether more (1) or less (−1) is better."""


@dataclass(frozen=True)
class Setting:
    """How all pairs are measured: the horizon, GOSPA's power, and at how many ghosts per minute times are compared."""

    horizon_s: float
    power: float
    false_positives_per_min: float | None


@dataclass(frozen=True)
class Kept:
    """Entries of at least `existence` are listed in a share of the drives, in the rest those of at least `above`."""

    existence: float
    above: float  # inf: nothing
    share: float
    false_positives_per_min: float


@dataclass(frozen=True)
class Regret:
    """A metric of a pair; `kept`: at which ghosts the first and the second are, where that is chosen."""

    metric: str
    figure: Figure
    kept: tuple[Kept, Kept] | None = None


def regrets(
    first: ConfigurationData, second: ConfigurationData, grid: Grid, setting: Setting, only: Sequence[str] | None = None
) -> Iterator[Regret]:
    """Every metric, or only some, that both sides have what it takes for."""
    cells = np.flatnonzero(first.there & second.there)
    for names, made in _METRICS.items():
        if only is None or not set(names).isdisjoint(only):
            yield from (one for one in made(first, second, grid, cells, setting) if only is None or one.metric in only)


def _of_detections(
    first: ConfigurationData, second: ConfigurationData, grid: Grid, cells: Int, setting: Setting
) -> Iterator[Regret]:
    yield Regret("detected_share", _shares(grid, cells, first.detected[cells], second.detected[cells]))
    times = [(_times(side, side.detection_s, cells),) for side in (first, second)]
    yield Regret("ttd_rmst_s", _restricted_means(grid, cells, times[0], times[1], setting))


def _of_distances(
    first: ConfigurationData, second: ConfigurationData, grid: Grid, cells: Int, setting: Setting
) -> Iterator[Regret]:
    yield Regret("dad_median_m", _distances(first, second, grid, cells))


def _of_ghosts(
    first: ConfigurationData, second: ConfigurationData, grid: Grid, cells: Int, setting: Setting
) -> Iterator[Regret]:
    if first.ghosts is not None and second.ghosts is not None:
        yield Regret("false_positives_per_min", _ghosts(first, second, first.ghosts, second.ghosts, grid, cells))


def _of_braking(
    first: ConfigurationData, second: ConfigurationData, grid: Grid, cells: Int, setting: Setting
) -> Iterator[Regret]:
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


def _times(side: ConfigurationData, detection_s: Float, cells: Int, share: float = 1.0) -> Times:
    """Times of cells (C,), detected at `detection_s (N·S,)` or, NaN, not. To a nanosecond, as in summary."""
    onset_s, detected = side.onset_s[cells], ~np.isnan(detection_s[cells])
    time_s = np.where(detected, detection_s[cells], side.ended_s[cells]) - onset_s
    ending = np.where(detected, DETECTED, np.where(side.left[cells], LEFT, CENSORED))
    return Times(share, np.round(time_s, 9), ending)


def _restricted_means(
    grid: Grid, cells: Int, first: tuple[Times, ...], second: tuple[Times, ...], setting: Setting
) -> OfTimes:
    return OfTimes(
        whose=_whose(grid, cells),
        n=np.ones(len(cells), dtype=np.int64),
        first=first,
        second=second,
        horizon_s=setting.horizon_s,
    )


def kept_at(ghosts: Ghosts, per_min: float) -> Kept | None:
    """What is listed with so many ghosts per minute, or with fewer where all have fewer; None: there is no minute."""
    minutes = float(ghosts.minutes[ghosts.there].sum())
    if minutes <= 0 or not len(ghosts.existence):
        return None
    rates = np.append(ghosts.at[ghosts.there].sum(axis=0) / minutes, 0.0)
    limits = np.append(ghosts.existence, np.inf)
    k = int(np.argmax(rates <= per_min * (1 + 1e-9)))
    if k == 0 or rates[k] >= per_min * (1 - 1e-9):
        return Kept(float(limits[k]), float(limits[k]), 1.0, float(rates[k]))
    share = float((per_min - rates[k]) / (rates[k - 1] - rates[k]))
    return Kept(float(limits[k - 1]), float(limits[k]), share, per_min)


def own_rate(ghosts: Ghosts) -> float | None:
    """Ghosts per minute at the lowest existence there is, without stale ones."""
    minutes = float(ghosts.minutes[ghosts.there].sum())
    return float(ghosts.at[ghosts.there, 0].sum()) / minutes if len(ghosts.existence) and minutes > 0 else None


def _at_equal_ghosts(
    first: ConfigurationData, second: ConfigurationData, grid: Grid, cells: Int, setting: Setting
) -> Iterator[Regret]:
    kept, times = [], []
    for side in (first, second):
        if side.ghosts is None or side.steps is None or setting.false_positives_per_min is None:
            return
        found = kept_at(side.ghosts, setting.false_positives_per_min)
        if found is None:
            return
        kept.append(found)
        parts = ((found.share, found.existence), (1.0 - found.share, found.above))
        size = len(grid.object_of)
        times.append(
            tuple(
                _times(side, _detected_s(side.steps, limit, size), cells, share) for share, limit in parts if share > 0
            )
        )
    figure = _restricted_means(grid, cells, times[0], times[1], setting)
    yield Regret("ttd_rmst_s_equal_ghosts", figure, (kept[0], kept[1]))


def _detected_s(steps: StepData, existence: float, cells: int) -> Float:
    """(C,) when each cell is detected by entries of at least some existence; NaN: never."""
    detection_s = np.full(cells, np.inf)
    enough = steps.existence >= existence
    np.minimum.at(detection_s, steps.cell[enough], steps.detection_s[enough])
    return np.where(np.isinf(detection_s), np.nan, detection_s)


def _distances(first: ConfigurationData, second: ConfigurationData, grid: Grid, cells: Int) -> OfMedians:
    known = [np.where(side.detected[cells], side.distance_m[cells], -np.inf) for side in (first, second)]
    placed = ~np.isnan(known[0] + known[1])  # NaN: detected during a gap of the truth, no distance to rank
    return OfMedians(
        whose=_whose(grid, cells[placed]),
        n=np.ones(int(placed.sum()), dtype=np.int64),
        first=known[0][placed],
        second=known[1][placed],
    )


def _of_lists(
    first: ConfigurationData, second: ConfigurationData, grid: Grid, cells: Int, setting: Setting
) -> Iterator[Regret]:
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
    yield Regret("gospa_m", OfSums(whose=whose, n=n, sums=sums, of=_root(setting.power)))


def _ghosts(
    first: ConfigurationData, second: ConfigurationData, ghosts: Ghosts, others: Ghosts, grid: Grid, cells: Int
) -> OfSums:
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


_METRICS = {
    ("detected_share", "ttd_rmst_s"): _of_detections,
    ("ttd_rmst_s_equal_ghosts",): _at_equal_ghosts,
    ("dad_median_m",): _of_distances,
    ("position_rmse_m", "gospa_m"): _of_lists,
    ("false_positives_per_min",): _of_ghosts,
    ("pass_share",): _of_braking,
}
"""What makes which metrics, in the order of a comparison."""

"""Differences of two configurations, metric by metric, over the rows and lists that both have.

Rows are paired by log, object and run, lists by instant; differences are first − second. Definitions are those of
`summary.csv`, but for what pairs allow:

*ttd_rmst_s*: the difference of the two restricted means over the rows that both have; never detected counts as the
horizon, an object still there when observation ends is censored.
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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.metrics.summary_metrics import METRIC
from copem_replay.metrics.survival import CENSORED, DETECTED, LEFT
from copem_replay.results.compare.bootstrap import Items
from copem_replay.results.compare.configuration_data import ConfigurationData, StepData
from copem_replay.results.compare.differences import Figure, OfMedians, OfSums, OfTimes
from copem_replay.results.compare.equal_ghosts import Kept
from copem_replay.results.compare.pairing import Grid
from copem_replay.results.compare.per_list import together

METRICS = {name: METRIC[name.removesuffix("_equal_ghosts")].better for name in (
    "detected_share", "ttd_rmst_s", "ttd_rmst_s_equal_ghosts", "dad_median_m", "position_rmse_m", "gospa_m",
    "false_positives_per_min", "pass_share",
)}  # fmt: skip
"""All metrics, and whether more (1) or less (−1) is better."""


@dataclass(frozen=True)
class Setting:
    """How a pair is measured: the horizon, GOSPA's power, and what is kept of each side's entries for equal ghosts."""

    horizon_s: float
    power: float
    kept: tuple[Kept, Kept] | None = None


@dataclass(frozen=True)
class Regret:
    """A metric of a pair; `kept`: at which ghosts the first and the second are, where that is chosen."""

    metric: str
    figure: Figure
    kept: tuple[Kept, Kept] | None = None


@dataclass(frozen=True)
class _Pair:
    """Two sides in a log, and the cells (C,) that both have."""

    first: ConfigurationData
    second: ConfigurationData
    grid: Grid
    cells: Int
    setting: Setting

    @property
    def sides(self) -> tuple[ConfigurationData, ConfigurationData]:
        return self.first, self.second

    @property
    def runs(self) -> Int:
        """(C,) the run of each cell."""
        found: Int = self.cells % self.grid.runs
        return found

    def items(self, cells: Int, **columns: NDArray[Any]) -> Items:
        """An item for each of some cells, −1 − r: of run r and no object."""
        objects = np.where(cells < 0, -1, cells // self.grid.runs + self.grid.before)
        runs = np.where(cells < 0, -1 - cells, cells % self.grid.runs)
        numbers = {"logs": np.full(len(cells), self.grid.log_ix), "objects": objects, "runs": runs}
        n = {"n": np.ones(len(cells), dtype=np.int64)}
        return Items({name: of.astype(np.int32) for name, of in numbers.items()} | n | columns)


def regrets(
    first: ConfigurationData, second: ConfigurationData, grid: Grid, setting: Setting, only: Sequence[str] | None = None
) -> Iterator[Regret]:
    """Every metric of a log, or only some, that both sides have what it takes for."""
    pair = _Pair(first, second, grid, np.flatnonzero(first.there & second.there), setting)
    for names, made in _METRICS.items():
        if only is None or not set(names).isdisjoint(only):
            yield from (one for one in made(pair) if only is None or one.metric in only)


def _of_detections(pair: _Pair) -> Iterator[Regret]:
    yield Regret("detected_share", _shares(pair, pair.cells, *(side.detected[pair.cells] for side in pair.sides)))
    times = [((1.0, side.detection_s),) for side in pair.sides]
    yield Regret("ttd_rmst_s", _restricted_means(pair, times))


def _at_equal_ghosts(pair: _Pair) -> Iterator[Regret]:
    if pair.setting.kept is None:
        return
    times = []
    for side, kept in zip(pair.sides, pair.setting.kept, strict=True):
        parts = ((kept.share, kept.existence), (1.0 - kept.share, kept.above))
        assert side.steps is not None
        times.append([(share, _detected_s(side.steps, limit, len(side.there))) for share, limit in parts if share > 0])
    yield Regret("ttd_rmst_s_equal_ghosts", _restricted_means(pair, times), pair.setting.kept)


def _detected_s(steps: StepData, existence: float, cells: int) -> Float:
    """(C,) when each cell is detected by entries of at least some existence; NaN: never."""
    detection_s = np.full(cells, np.inf)
    enough = steps.existence >= existence
    np.minimum.at(detection_s, steps.cell[enough], steps.detection_s[enough])
    return np.where(np.isinf(detection_s), np.nan, detection_s)


def _restricted_means(pair: _Pair, times: Sequence[Sequence[tuple[float, Float]]]) -> OfTimes:
    """Of times of detection (N·S,), NaN: not, with their shares of the drives, of both sides."""
    shares, parts = [], []
    for side, sign, of_side in zip(pair.sides, (1.0, -1.0), times, strict=True):
        for share, detection_s in of_side:
            shares.append(sign * share)
            parts.append(_times(pair, side, detection_s[pair.cells]))
    return OfTimes(parts=tuple(parts), shares=tuple(shares), horizon_s=pair.setting.horizon_s)


def _times(pair: _Pair, side: ConfigurationData, detection_s: Float) -> Items:
    """To a nanosecond, as in summary."""
    cells, detected = pair.cells, ~np.isnan(detection_s)
    time_s = np.where(detected, detection_s, side.ended_s[cells]) - side.onset_s[cells]
    ending = np.where(detected, DETECTED, np.where(side.left[cells], LEFT, CENSORED)).astype(np.int8)
    return pair.items(cells, time_s=np.round(time_s, 9), ending=ending)


def _of_distances(pair: _Pair) -> Iterator[Regret]:
    first, second = (np.where(side.detected, side.distance_m, -np.inf)[pair.cells] for side in pair.sides)
    placed = ~np.isnan(first + second)  # NaN: detected during a gap of the truth, no distance to rank
    items = pair.items(pair.cells[placed], first=first[placed], second=second[placed])
    yield Regret("dad_median_m", OfMedians(parts=(items,)))


def _of_lists(pair: _Pair) -> Iterator[Regret]:
    """Errors and GOSPA; lists are of no object in particular, so that their number stays when objects are resampled."""
    if pair.first.accuracy is None or pair.second.accuracy is None:
        return
    both = together(pair.first.accuracy, pair.second.accuracy, pair.grid, pair.cells)
    k = both.matched > 0
    squares = np.concatenate([both.squared_m2, both.matched[:, None]], axis=1)[k]
    errors = pair.items(pair.cells[k], n=both.matched[k], sums=squares)
    yield Regret("position_rmse_m", OfSums(parts=(errors,), of=_root(2.0)))
    there = both.measured > 0
    parts = np.concatenate([both.gospa, np.zeros((len(pair.cells), 1))], axis=1)[there]
    items = _with_runs(pair, pair.cells[there], parts, np.outer(both.lists, [0.0, 0.0, 1.0]), both.lists)
    yield Regret("gospa_m", OfSums(parts=(items,), of=_root(pair.setting.power)))


def _of_ghosts(pair: _Pair) -> Iterator[Regret]:
    """Ghosts over minutes; those that are nearest to no measured object are of their list only."""
    ghosts, others = pair.first.ghosts, pair.second.ghosts
    if ghosts is None or others is None:
        return
    there = ghosts.there & others.there
    cells, runs = pair.cells[there[pair.runs]], pair.runs[there[pair.runs]]
    nearest = np.zeros((len(cells), 4))
    rest = np.stack([ghosts.count, others.count, ghosts.minutes, others.minutes], axis=1).astype(float)
    rest[~there] = 0.0
    accuracy = [side.accuracy for side in pair.sides if side.accuracy is not None]
    for k, of in enumerate(accuracy if len(accuracy) == 2 else ()):
        nearest[:, k] = of.ghosts[cells]
        rest[:, k] -= np.bincount(runs, nearest[:, k], minlength=len(rest))
    items = _with_runs(pair, cells, nearest, rest, there.astype(np.int64))
    yield Regret("false_positives_per_min", OfSums(parts=(items,), by_object=len(accuracy) == 2, of=_rates))


def _of_braking(pair: _Pair) -> Iterator[Regret]:
    first, second, cells = pair.first, pair.second, pair.cells
    if first.conflict is not None and second.conflict is not None:
        assert first.passes is not None
        assert second.passes is not None
        judged = cells[first.conflict[cells] & second.conflict[cells]]
        yield Regret("pass_share", _shares(pair, judged, first.passes[judged], second.passes[judged]))


def _shares(pair: _Pair, cells: Int, first: Bool, second: Bool) -> OfSums:
    only = np.stack([first & ~second, second & ~first], axis=1).astype(np.int64)
    sums = np.stack([first, second, np.ones(len(cells))], axis=1)
    return OfSums(parts=(pair.items(cells, only=only, sums=sums),), of=_mean)


def _with_runs(pair: _Pair, cells: Int, of_cells: Float, of_runs: Float, n: Int) -> Items:
    """Items of cells, then of all runs that count for something (`n (S,)`)."""
    at = np.flatnonzero(n)
    counts = np.concatenate([np.zeros(len(cells), dtype=np.int64), n[at]])
    return pair.items(np.concatenate([cells, -1 - at]), n=counts, sums=np.concatenate([of_cells, of_runs[at]]))


def _mean(sums: Float) -> tuple[Float, Float]:
    return sums[..., 0] / sums[..., 2], sums[..., 1] / sums[..., 2]


def _root(power: float) -> Callable[[Float], tuple[Float, Float]]:
    def of(sums: Float) -> tuple[Float, Float]:
        first, second = _mean(sums)
        return first ** (1 / power), second ** (1 / power)

    return of


def _rates(sums: Float) -> tuple[Float, Float]:
    return sums[..., 0] / sums[..., 2], sums[..., 1] / sums[..., 3]


_METRICS = {
    ("detected_share", "ttd_rmst_s"): _of_detections,
    ("ttd_rmst_s_equal_ghosts",): _at_equal_ghosts,
    ("dad_median_m",): _of_distances,
    ("position_rmse_m", "gospa_m"): _of_lists,
    ("false_positives_per_min",): _of_ghosts,
    ("pass_share",): _of_braking,
}
"""What makes which metrics, in the order of a comparison."""

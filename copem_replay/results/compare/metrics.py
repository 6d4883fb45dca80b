"""Metrics of a comparison: differences of two configurations, over the rows that both have and what both hold.

Rows are paired by log, object and run, what is held by frame; differences are first − second. Shares, times and
distances are of the rows that count (`measure.began`), accuracy and ghosts of all. Definitions are those of
`summary.csv`, except:

*ttd_rmst_s*: the difference of the two restricted means over the rows that both have; never detected counts as the
horizon, an object still there when observation ends is censored.
*ttd_both_s*: the difference of the mean times to detection over the rows that both detect. It says nothing of the rows
that one alone detects; their numbers stand beside it.
*dad_median_m*: the median of the differences, not the difference of the medians. Never detected is below every
distance, so it differs infinitely from a distance, and not at all from never.
*position_rmse_held_m*: over the frames of the truth at which both hold an entry about the object, from the first frame
at which both have issued a list (`metrics/accuracy/held.py`). *gospa_held_m*: over all these frames at which an object
is measured, on or after its onset, also where one side holds no list.
*ttd_rmst_s_equal_ghosts*: ttd_rmst_s, with entries below a threshold of existence left out, so that each side has as
many ghosts per minute over all logs and runs as is asked for (`explain_incomparable`: where that means nothing). Stale
ghosts are not counted: a late list that was right at its capture is not cleaner without them. Between two thresholds
(the second may leave nothing) their mixture has exactly as many: a share of the drives uses the one, the rest the
other, as between two points of a ROC curve. Intervals keep the thresholds and the share.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, reduce
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.errors import InputError
from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.metrics.limits import choose_over
from copem_replay.metrics.summary_metrics import COMPARED, OF_LISTS
from copem_replay.metrics.survival import CENSORED, DETECTED, LEFT, compute_unknown_s
from copem_replay.results.compare.labels import LabelledConfiguration
from copem_replay.results.compare.limits import (
    MedianStatistic,
    PairStatistic,
    StatisticItems,
    SumStatistic,
    TimeStatistic,
)
from copem_replay.results.compare.pairing import (
    Columns,
    PairedHeldSums,
    PairingGrid,
    PairSide,
    configuration_rows,
    float_column,
    integer_column,
    list_column,
    pair_held_lists,
)
from copem_replay.results.table_files import AGAIN

if TYPE_CHECKING:
    import pyarrow as pa


# Operating points: the ghosts per minute at which times are compared.

FEWEST_GHOSTS = 10
"""Fewer ghosts than this decide nothing: of ten the Poisson error is already a third."""
TRUTH = "the baseline is the truth, which has no ghosts"
ONE_VALUE = "all entries claim the same existence, so that none is left out before the others"
FEW = f"fewer than {FEWEST_GHOSTS} ghosts would decide"
_FILES = ("lists.parquet", "thresholds.parquet")


@dataclass(frozen=True)
class GhostTotals:
    """Ghosts of a configuration in all logs and runs; the existence at which it detects."""

    minutes: float
    existence: Float  # (T,) ascending
    at: Int  # (T,) ghosts of at least each existence
    least: float  # lowest existence of a detection; inf: none
    most: float  # highest; −inf: none

    @property
    def per_min(self) -> float | None:
        """Ghosts per minute at the lowest existence; None: unknown."""
        return float(self.at[0]) / self.minutes if len(self.existence) and self.minutes > 0 else None

    @property
    def tells_apart(self) -> bool:
        """Whether any threshold of existence removes some entries, but not all."""
        all_left = (self.at == self.at[:1]) & (self.least >= self.existence)
        none_left = (self.at == 0) & (self.most < self.existence)
        return not (all_left | none_left).all()


@dataclass(frozen=True)
class OperatingPoint:
    """Thresholds of existence: `existence` in a share of the drives, `above` in the rest."""

    existence: float
    above: float  # inf: nothing
    share: float
    false_positives_per_min: float


def ghost_totals(
    sides: Sequence[LabelledConfiguration], logs: Sequence[str], runs: int
) -> dict[LabelledConfiguration, GhostTotals]:
    """Totals of the sides whose folders have the tables for it. Raises InputError where these are damaged."""
    totals: dict[LabelledConfiguration, GhostTotals] = {}
    for log in logs:
        for results in dict.fromkeys(
            labelled.results for labelled in sides if {*_FILES} <= set(labelled.results.by_log)
        ):
            tables = results.rows_of(log, _FILES)
            for labelled in (labelled for labelled in sides if labelled.results is results):
                rows, steps = configuration_rows(labelled, tables).values()
                totals[labelled] = _add_log(labelled, totals.get(labelled), rows, steps, runs)
    return totals


def _add_log(
    labelled: LabelledConfiguration, before: GhostTotals | None, rows: pa.Table, steps: pa.Table, runs: int
) -> GhostTotals:
    """Ghost totals of `before` (None: the first log) and of one log's first `runs` runs, by existence threshold."""
    lengths, existence = list_column(rows["existence"])
    counts, ghosts_at = list_column(rows["ghosts_at"])
    thresholds = existence[: lengths[0]] if len(lengths) else existence
    if before is not None and len(before.existence):
        thresholds = before.existence if len(lengths) else thresholds
    consistent = (lengths == len(thresholds)).all() and (counts == len(thresholds)).all()
    size = len(lengths), len(thresholds)
    if not consistent or (existence.reshape(size) != thresholds).any() or (np.diff(thresholds) <= 0).any():
        raise InputError(
            f"{labelled.results.place / _FILES[0]}: expected the same ascending existence and as many ghosts_at in "
            f"all rows, found others; {AGAIN}"
        )
    compared = integer_column(rows["run"], missing=runs) < runs
    minutes = float(float_column(rows["minutes"])[compared].sum())
    ghosts = ghosts_at.reshape(size)[compared].sum(axis=0).astype(np.int64)
    steps_at = float_column(steps["existence"])[integer_column(steps["run"], missing=runs) < runs]
    lowest_step, highest_step = float(steps_at.min(initial=np.inf)), float(steps_at.max(initial=-np.inf))
    if before is None or not len(before.existence):
        return GhostTotals(minutes, thresholds, ghosts, lowest_step, highest_step)
    ghosts = ghosts if len(lengths) else np.zeros_like(before.at)
    extremes = min(before.least, lowest_step), max(before.most, highest_step)
    return GhostTotals(before.minutes + minutes, before.existence, before.at + ghosts, *extremes)


def find_operating_point(ghosts: GhostTotals, per_min: float) -> OperatingPoint | None:
    """The operating point with `per_min` ghosts, fewer where all entries make fewer; None: unknown."""
    if ghosts.per_min is None:
        return None
    rates = np.append(ghosts.at / ghosts.minutes, 0.0)
    limits = np.append(ghosts.existence, np.inf)
    k = int(np.argmax(rates <= per_min * (1 + 1e-9)))
    if k == 0 or rates[k] >= per_min * (1 - 1e-9):
        return OperatingPoint(float(limits[k]), float(limits[k]), 1.0, float(rates[k]))
    share = float((per_min - rates[k]) / (rates[k - 1] - rates[k]))
    return OperatingPoint(float(limits[k - 1]), float(limits[k]), share, per_min)


def find_operating_points(
    first: GhostTotals | None, second: GhostTotals | None, per_min: float | None
) -> tuple[OperatingPoint, OperatingPoint] | None:
    """The operating points of both sides; None: one is unknown."""
    if first is None or second is None or per_min is None:
        return None
    kept = find_operating_point(first, per_min), find_operating_point(second, per_min)
    return None if kept[0] is None or kept[1] is None else (kept[0], kept[1])


def explain_incomparable(
    first: GhostTotals | None, second: GhostTotals | None, per_min: float | None, *, by_user: bool, truth: bool
) -> str | None:
    """Why the times of two sides at `per_min` ghosts cannot be compared; None: they can, or there are none.

    `by_user`: the user asked for the rate; else it is the second side's own. `truth`: the second side is the truth.
    """
    if per_min is None or first is None or second is None:
        return None
    if truth:
        return TRUTH
    if not by_user and second.at[:1].sum() < FEWEST_GHOSTS:
        return FEW
    for side in (first, second):
        point = find_operating_point(side, per_min)
        if side.per_min is None or point is None or side.per_min <= per_min * (1 + 1e-9):
            continue
        if not side.tells_apart:
            return ONE_VALUE if side is first else f"of the baseline, {ONE_VALUE}"
        if point.false_positives_per_min * side.minutes < FEWEST_GHOSTS * (1 - 1e-9):
            return FEW
    return None


def notes_on_equal_ghosts(reasons: Mapping[str, str | None]) -> Iterator[str]:
    """Notes on pairs without times at equal ghosts. `reasons`: by label."""
    for reason in dict.fromkeys(reason for reason in reasons.values() if reason is not None):
        labels = ", ".join(label for label, why in reasons.items() if why == reason)
        yield f"{labels}: no ttd_rmst_s_equal_ghosts: {reason}"


@dataclass(frozen=True)
class PairSettings:
    """Parameters of a pair: the horizon, the power of GOSPA, and the operating points of both sides."""

    horizon_s: float
    power: float
    kept: tuple[OperatingPoint, OperatingPoint] | None = None


@dataclass(frozen=True)
class HeldCounts:
    """Counts beside figures of held lists; those of several logs add up. (2,): of the first, of the second.

    `frames`: object frames are not counted twice: a frame of a run counts once. `without_truth` is over all frames.
    """

    frames: int
    pairs: int
    only: Int  # (2,) pairs of object and frame that only this side lists
    age_s: Float  # (2,) Σ of the ages of the pairs
    without_list: Int  # (2,) frames at which this side holds no list
    without_truth: Int  # (2,) held entries whose object has no truth at the frame

    def __add__(self, other: HeldCounts) -> HeldCounts:
        return HeldCounts(*(getattr(self, of.name) + getattr(other, of.name) for of in fields(HeldCounts)))

    def columns(self) -> dict[str, object]:
        """The counts as columns of a comparison."""
        columns: dict[str, object] = {"frames": self.frames}
        for k, (name, only) in enumerate((("", "only_configuration"), ("baseline_", "only_baseline"))):
            columns[only] = int(self.only[k])
            columns[f"{name}age_s"] = float(self.age_s[k] / self.pairs) if self.pairs else None
            columns[f"{name}no_list_share"] = float(self.without_list[k] / self.frames) if self.frames else None
            columns[f"{name}without_truth"] = int(self.without_truth[k])
        return columns


@dataclass(frozen=True)
class Regret:
    """A metric of a pair; `counts`: by log the number of objects and of passes with rows on both sides.

    `kept`: operating points of the first and the second, for times at equal ghosts. `held`: counts of held lists.
    """

    metric: str
    figure: PairStatistic
    counts: tuple[tuple[int, int], ...]
    kept: tuple[OperatingPoint, OperatingPoint] | None = None
    held: HeldCounts | None = None

    @property
    def over(self) -> str | None:
        """The unit of its interval; None: there are too few."""
        return choose_over(*total_counts(self.counts))

    @staticmethod
    def joined(of_logs: Sequence[Regret]) -> Regret:
        """The same metric over several logs."""
        figures, held = [regret.figure for regret in of_logs], [r.held for r in of_logs if r.held is not None]
        counts = tuple(counts for regret in of_logs for counts in regret.counts)
        all_held = reduce(HeldCounts.__add__, held) if held else None
        return Regret(of_logs[0].metric, type(figures[0]).joined(figures), counts, of_logs[0].kept, all_held)


def total_counts(counts: Iterable[tuple[int, int]]) -> tuple[int, int, int]:
    """The number of logs with objects, of objects and of passes, over all logs."""
    some = [of_log for of_log in counts if of_log[0]]
    return len(some), sum(objects for objects, _ in some), sum(passes for _, passes in some)


@dataclass(frozen=True)
class _Pair:
    """Two sides in a log, and the cells (C,) that both have: all, or those that count."""

    first: PairSide
    second: PairSide
    grid: PairingGrid
    cells: Int
    setting: PairSettings

    @property
    def sides(self) -> tuple[PairSide, PairSide]:
        return self.first, self.second

    @cached_property
    def held(self) -> PairedHeldSums | None:
        """What both hold; None: a side has no accuracy."""
        if self.first.accuracy is None or self.second.accuracy is None:
            return None
        return pair_held_lists(self.first.accuracy, self.second.accuracy, self.grid, self.cells)

    @cached_property
    def held_counts(self) -> HeldCounts | None:
        """What is said beside figures of what both hold."""
        if self.held is None:
            return None
        without_truth = [0 if side.lists is None else int(side.lists["without_truth"].sum()) for side in self.sides]
        both, pairs = self.held, int(self.held.pairs.sum())
        frames, without = int(both.frames.sum()), np.array(without_truth)
        return HeldCounts(frames, pairs, both.only, both.age_s, both.without_list, without)

    def items(self, cells: Int, **columns: NDArray[Any]) -> StatisticItems:
        """An item for each of `cells`; −1 − r stands for run r and no object."""
        objects = np.where(cells < 0, -1, self.grid.object_of(cells) + self.grid.before)
        runs = np.where(cells < 0, -1 - cells, cells % self.grid.runs)
        passes = np.where(cells < 0, -1, cells // self.grid.runs)
        numbers = {"logs": np.full(len(cells), self.grid.log_ix), "objects": objects, "passes": passes, "runs": runs}
        n = {"n": np.ones(len(cells), dtype=np.int64)}
        return StatisticItems({name: of.astype(np.int32) for name, of in numbers.items()} | n | columns)


def compute_regrets(
    first: PairSide, second: PairSide, grid: PairingGrid, setting: PairSettings, metrics: Sequence[str] | None = None
) -> Iterator[Regret]:
    """The metrics of a log, all or `metrics` some, for which both sides have the data.

    Those of lists are over all rows that both sides have, the others over those that count.
    """
    pairs = []
    for there in (first.there & second.there, first.counted & second.counted):
        pair = _Pair(first, second, grid, np.flatnonzero(there), setting)
        counts = len(np.unique(grid.object_of(pair.cells))), len(np.unique(pair.cells // grid.runs))
        pairs.append((pair, counts))
    for metric in COMPARED.values():
        compared = metric.compared
        if compared is None or (metrics is not None and metric.name not in metrics):
            continue
        pair, counts = pairs[0 if metric.part in OF_LISTS else 1]
        figure = FIGURES[compared.figure](pair) if isinstance(compared.figure, str) else _means(pair, compared.figure)
        if figure is not None:
            held = pair.held_counts if FIGURES.get(compared.figure) in (_held_errors, _held_gospa) else None
            points = pair.setting.kept if FIGURES.get(compared.figure) is _means_at_equal_ghosts else None
            counts = (1, 1) if metric.part == "needless" else counts  # a drive is one, whatever objects it has
            yield Regret(metric.name, figure, (counts,), points, held)


def _means(pair: _Pair, values: Callable[[Columns], NDArray[Any]]) -> SumStatistic:
    """Means of a value of rows; of true and false, shares."""
    first, second = (values(side.rows)[pair.cells] for side in pair.sides)
    if first.dtype == bool:
        return _shares(pair, pair.cells, first, second)
    sums = np.stack([first, second, np.ones(len(pair.cells))], axis=1)
    return SumStatistic(parts=(pair.items(pair.cells, sums=sums),), of=_divide_mean)


def _shares(pair: _Pair, cells: Int, first: Bool, second: Bool) -> SumStatistic:
    only = np.stack([first & ~second, second & ~first], axis=1).astype(np.int64)
    sums = np.stack([first, second, np.ones(len(cells))], axis=1)
    return SumStatistic(parts=(pair.items(cells, only=only, sums=sums),), of=_divide_mean, share=True, most=1.0)


def _passes(pair: _Pair) -> SumStatistic | None:
    """Shares of the rows in conflict that pass."""
    first, second, cells = pair.first.rows, pair.second.rows, pair.cells
    if "conflict" not in first or "conflict" not in second:
        return None
    judged = cells[first["conflict"][cells] & second["conflict"][cells]]
    return _shares(pair, judged, first["braking_pass"][judged], second["braking_pass"][judged])


def _means_where_both_detect(pair: _Pair) -> SumStatistic:
    """Mean times to detection of the cells that both sides detect; `only`: the cells that one side alone does."""
    first, second = (side.rows["detected"][pair.cells] for side in pair.sides)
    both_detect = first & second
    times_s = ((side.rows["detection_s"] - side.rows["onset_s"])[pair.cells] for side in pair.sides)
    sums = np.stack([*(np.where(both_detect, time_s, 0.0) for time_s in times_s), both_detect.astype(float)], axis=1)
    only = np.stack([first & ~second, second & ~first], axis=1).astype(np.int64)
    items = pair.items(pair.cells, n=both_detect.astype(np.int64), only=only, sums=sums)
    return SumStatistic(parts=(items,), of=_divide_mean)


def _means_unknown(pair: _Pair) -> SumStatistic:
    """Means of min(seconds unknown, horizon)."""

    def unknown_s(rows: Columns) -> Float:
        found = compute_unknown_s(rows["detection_s"] - rows["onset_s"], rows["ended_s"] - rows["onset_s"])
        return np.minimum(found, pair.setting.horizon_s)

    return replace(_means(pair, unknown_s), most=pair.setting.horizon_s)


def _means_at_equal_ghosts(pair: _Pair) -> TimeStatistic | None:
    if pair.setting.kept is None:
        return None
    times = []
    for side, kept in zip(pair.sides, pair.setting.kept, strict=True):
        parts = ((kept.share, kept.existence), (1.0 - kept.share, kept.above))
        assert side.steps is not None
        times.append(
            [(share, _detection_times_s(side.steps, limit, len(side.there))) for share, limit in parts if share > 0]
        )
    return _restricted_means(pair, times)


def _detection_times_s(steps: Columns, existence: float, cells: int) -> Float:
    """(C,) seconds at which each cell is detected by entries of at least `existence`; NaN: never."""
    detection_s = np.full(cells, np.inf)
    enough = steps["existence"] >= existence
    np.minimum.at(detection_s, steps["cell"][enough], steps["detection_s"][enough])
    return np.where(np.isinf(detection_s), np.nan, detection_s)


def _restricted_means(pair: _Pair, times: Sequence[Sequence[tuple[float, Float]]]) -> TimeStatistic:
    """The restricted means of both sides, from (share of the drives, instants of detection (N·S,), NaN: never)."""
    shares, parts = [], []
    for side, sign, of_side in zip(pair.sides, (1.0, -1.0), times, strict=True):
        for share, detection_s in of_side:
            shares.append(sign * share)
            parts.append(_time_items(pair, side, detection_s[pair.cells]))
    return TimeStatistic(parts=tuple(parts), shares=tuple(shares), horizon_s=pair.setting.horizon_s)


def _time_items(pair: _Pair, side: PairSide, detection_s: Float) -> StatisticItems:
    """Items of times to detection, rounded to a nanosecond as in the summary."""
    cells, detected = pair.cells, ~np.isnan(detection_s)
    time_s = np.where(detected, detection_s, side.rows["ended_s"][cells]) - side.rows["onset_s"][cells]
    ending = np.where(detected, DETECTED, np.where(side.rows["left"][cells], LEFT, CENSORED)).astype(np.int8)
    return pair.items(cells, time_s=np.round(time_s, 9), ending=ending)


def _distances(pair: _Pair) -> MedianStatistic:
    first, second = (
        np.where(side.rows["detected"], side.rows["distance_at_detection_m"], -np.inf)[pair.cells]
        for side in pair.sides
    )
    placed = ~np.isnan(first + second)  # NaN: detected during a gap of the truth, no distance to rank
    return MedianStatistic(parts=(pair.items(pair.cells[placed], first=first[placed], second=second[placed]),))


HELD_METRICS = ("position_rmse_held_m", "gospa_held_m")
"""The metrics of what both sides hold."""


def _held_errors(pair: _Pair) -> SumStatistic | None:
    if (held := pair.held) is None:
        return None
    paired = held.pairs > 0
    squares = np.concatenate([held.squared_m2, held.pairs[:, None]], axis=1)[paired]
    items = pair.items(pair.cells[paired], n=held.pairs[paired], sums=squares)
    return SumStatistic(parts=(items,), of=_make_power_mean(2.0))


def _held_gospa(pair: _Pair) -> SumStatistic | None:
    """GOSPA of frames, which belong to no object, so that their number stays where objects are clusters."""
    if (held := pair.held) is None:
        return None
    measured = held.measured > 0
    parts = np.concatenate([held.gospa, np.zeros((len(pair.cells), 1))], axis=1)[measured]
    items = _append_run_items(pair, pair.cells[measured], parts, np.outer(held.frames, [0.0, 0.0, 1.0]), held.frames)
    return SumStatistic(parts=(items,), of=_make_power_mean(pair.setting.power))


def _ghost_rates(pair: _Pair) -> SumStatistic | None:
    """Sums for ghosts per minute of both sides: of each cell its object's, of each run all others; None: no lists."""
    first, second = pair.first.lists, pair.second.lists
    if first is None or second is None:
        return None
    present, runs = first["there"] & second["there"], pair.cells % pair.grid.runs
    cells, runs = pair.cells[present[runs]], runs[present[runs]]
    cell_ghosts = np.zeros((len(cells), 4))
    run_sums = np.stack([of[name] for name in ("ghosts", "minutes") for of in (first, second)], axis=1).astype(float)
    run_sums[~present] = 0.0
    accuracy = [side.accuracy for side in pair.sides if side.accuracy is not None]
    for k, accuracy_of_side in enumerate(accuracy if len(accuracy) == 2 else ()):
        cell_ghosts[:, k] = accuracy_of_side.ghosts[cells]
        run_sums[:, k] -= np.bincount(runs, cell_ghosts[:, k], minlength=len(run_sums))
    items = _append_run_items(pair, cells, cell_ghosts, run_sums, present.astype(np.int64))
    return SumStatistic(parts=(items,), by_object=len(accuracy) == 2, of=_divide_rates)


def _needless_time(pair: _Pair) -> SumStatistic | None:
    """Shares of the driving time with needless braking, which belongs to runs only."""
    first, second = pair.first.lists, pair.second.lists
    if first is None or second is None or "needless_s" not in first or "needless_s" not in second:
        return None
    runs = np.flatnonzero(first["there"] & second["there"] & (first["driving_s"] > 0))
    if not len(runs):
        return None  # who stands does not drive
    sums = np.stack([first["needless_s"], second["needless_s"], first["driving_s"]], axis=1)[runs]
    items = pair.items(-1 - runs, sums=sums)
    return SumStatistic(parts=(items,), by_object=False, of=_divide_mean, most=1.0)


def _append_run_items(pair: _Pair, cells: Int, of_cells: Float, of_runs: Float, n: Int) -> StatisticItems:
    """Items of cells, then of the runs with `n (S,)` above 0."""
    runs = np.flatnonzero(n)
    counts = np.concatenate([np.zeros(len(cells), dtype=np.int64), n[runs]])
    return pair.items(np.concatenate([cells, -1 - runs]), n=counts, sums=np.concatenate([of_cells, of_runs[runs]]))


def _divide_mean(sums: Float) -> tuple[Float, Float]:
    return sums[..., 0] / sums[..., 2], sums[..., 1] / sums[..., 2]


def _make_power_mean(power: float) -> Callable[[Float], tuple[Float, Float]]:
    def of(sums: Float) -> tuple[Float, Float]:
        first, second = _divide_mean(sums)
        return first ** (1 / power), second ** (1 / power)

    return of


def _divide_rates(sums: Float) -> tuple[Float, Float]:
    return sums[..., 0] / sums[..., 2], sums[..., 1] / sums[..., 3]


FIGURES: Mapping[Any, Callable[[_Pair], PairStatistic | None]] = {
    "restricted means": lambda pair: _restricted_means(
        pair, [((1.0, side.rows["detection_s"]),) for side in pair.sides]
    ),
    "means where both detect": _means_where_both_detect,
    "times unknown": _means_unknown,
    "restricted means at equal ghosts": _means_at_equal_ghosts,
    "distances": _distances,
    "held errors": _held_errors,
    "held GOSPA": _held_gospa,
    "ghosts": _ghost_rates,
    "passes": _passes,
    "needless time": _needless_time,
}
"""Figures of pairs by the names that metrics compared by them give; None: a side has no data."""


def list_tables(metrics: Sequence[str] | None) -> set[str]:
    """Names of the tables that metrics (None: all) are of; most others are larger."""
    asked = [of.compared for name, of in COMPARED.items() if of.compared and (metrics is None or name in metrics)]
    return {"detections.parquet", *(name for of in asked for name in of.files)}

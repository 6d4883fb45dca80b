"""Pairing of results, log by log: a grid with a cell for every measured object and run, common to all sides.

Rows of two configurations about the same object in the same run are in the same cell. Lists are paired instant by
instant; only instants that both have count (within 1 µs is one), and for other latencies or rates there may be none.

Letters of the shapes: N measured objects of the log, S runs; N·S cells, object by object.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.errors import InputError
from copem_replay.core.tracks import SAME_INSTANT_S, Bool, Float, Int
from copem_replay.metrics.survival import COMPETES
from copem_replay.results.compare.labels import LabelledConfiguration
from copem_replay.results.schema import AGAIN

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True)
class PairingGrid:
    """The objects measured in a log, and the runs that all folders have.

    `log_ix`: number of the log; `before`: number of objects in the logs before it.
    """

    log_ix: int
    objects: tuple[str, ...]  # N
    runs: int  # S
    before: int = 0

    def cells(self, table: pa.Table) -> Int:
        """(n,) the cell of each row of a table, −1: a run that is not compared, or an object that is not measured."""
        import pyarrow as pa
        import pyarrow.compute as pc

        object_ix = integer_column(
            pc.index_in(table["object_id"], value_set=pa.array(self.objects, pa.string())), missing=-1
        )
        run = self.runs_of(table)
        return np.where((object_ix >= 0) & (run >= 0), object_ix * self.runs + run, -1)

    def runs_of(self, table: pa.Table) -> Int:
        """(n,) the run of each row, −1: one that is not compared."""
        run = integer_column(table["run"], missing=-1)
        return np.where((run >= 0) & (run < self.runs), run, -1)


def build_grid(log_ix: int, tables: Iterable[pa.Table], runs: int, before: int) -> PairingGrid:
    """The grid of a log, from its rows of `detections.parquet` in several folders."""
    objects: dict[str, None] = {}
    for table in tables:
        objects |= dict.fromkeys(table["object_id"].unique().to_pylist())
    return PairingGrid(log_ix, tuple(objects), runs, before)


def integer_column(column: pa.ChunkedArray, *, missing: int = 0) -> Int:
    """(n,) whole numbers, `missing` where null."""
    import pyarrow as pa

    values: Int = column.cast(pa.int64()).fill_null(missing).to_numpy()
    return values


def float_column(column: pa.ChunkedArray) -> Float:
    """(n,) numbers, NaN where null."""
    import pyarrow as pa

    values: Float = column.cast(pa.float64()).to_numpy()
    return values


def flag_column(column: pa.ChunkedArray) -> Bool:
    """(n,) true or false, null is false."""
    import pyarrow as pa

    values: Bool = column.cast(pa.bool_()).fill_null(False).to_numpy().astype(np.bool_)
    return values


def list_column(column: pa.ChunkedArray) -> tuple[Int, Float]:
    """(n,) lengths of lists, 0 where null, and what is in them one after the other, NaN where null."""
    import pyarrow as pa
    import pyarrow.compute as pc

    length = integer_column(pc.list_value_length(column))
    inner: Float = pc.list_flatten(column).cast(pa.float64()).to_numpy()
    return length, inner


# One side of a pair: the rows of a configuration in a log, laid out on the grid.

T = TypeVar("T", bound=np.generic)


@dataclass(frozen=True)
class AccuracyData:
    """Accuracy of a configuration: each cell has `length` lists from the instant `first` on, at `start` in values.

    `first` counts in the instants of the cell's run, `available_s[of_run[run]]`, which are equal in all runs unless
    `by_run`, where runs differ in their units.
    """

    start: Int  # (N·S,)
    length: Int  # (N·S,)
    first: Int  # (N·S,)
    ghosts: Int  # (N·S,) false entries nearest to this object
    error_m: Float  # (V,) NaN: not matched
    gospa: Float  # (V,) this object's part of GOSPA to its power; NaN: before the onset
    available_s: tuple[Float, ...]  # (K,) each
    of_run: Int  # (S,)
    by_run: bool


@dataclass(frozen=True)
class FalsePositiveData:
    """Ghosts of a configuration, by run."""

    there: Bool  # (S,)
    minutes: Float  # (S,)
    count: Int  # (S,)


@dataclass(frozen=True)
class StepData:
    """Steps (C,): a cell is detected at `detection_s` without entries below any threshold up to `existence`."""

    cell: Int
    existence: Float
    detection_s: Float


@dataclass(frozen=True)
class ConfigurationData:
    """A configuration on the grid: columns by cell, without meaning where it is not `there`. None: not written."""

    label: str
    path: Path
    there: Bool
    detected: Bool
    left: Bool  # never detected, if it was not
    onset_s: Float
    ended_s: Float
    detection_s: Float
    distance_m: Float
    conflict: Bool | None
    passes: Bool | None
    accuracy: AccuracyData | None
    ghosts: FalsePositiveData | None
    steps: StepData | None


def configuration_rows(one: LabelledConfiguration, tables: dict[str, pa.Table]) -> dict[str, pa.Table]:
    """The rows of a configuration, by table."""
    import pyarrow.compute as pc

    return {name: table.filter(pc.equal(table["configuration"], one.configuration)) for name, table in tables.items()}


def lay_out_configuration(
    one: LabelledConfiguration, tables: dict[str, pa.Table], grid: PairingGrid
) -> ConfigurationData:
    """A configuration's rows of a log on the grid. Raises InputError where tables are damaged or contradictory."""
    results, rows_of = one.results, configuration_rows(one, tables)
    rows = rows_of["detections.parquet"]
    cell = grid.cells(rows)
    place = results.folder / "detections.parquet"
    _check_once(place, cell, one.configuration)
    detected = flag_column(rows["detected"])
    for name, needed in (("onset_s", True), ("ended_s", True), ("detection_s", detected)):
        if (np.isnan(float_column(rows[name])) & needed).any():
            raise InputError(f"{place}: column {name}: expected a number in every row, found none in some; {AGAIN}")
    braking = results.provenance.braking is not None
    size = len(grid.objects) * grid.runs
    return ConfigurationData(
        label=one.label,
        path=results.folder,
        there=_lay_out(np.ones(len(cell), dtype=bool), cell, size),
        detected=_lay_out(detected, cell, size),
        left=_lay_out(_is_left(rows), cell, size),
        onset_s=_lay_out(float_column(rows["onset_s"]), cell, size),
        ended_s=_lay_out(float_column(rows["ended_s"]), cell, size),
        detection_s=_lay_out(float_column(rows["detection_s"]), cell, size),
        distance_m=_lay_out(float_column(rows["distance_at_detection_m"]), cell, size),
        conflict=_lay_out(flag_column(rows["conflict"]), cell, size) if braking else None,
        passes=_lay_out(flag_column(rows["braking_pass"]), cell, size) if braking else None,
        accuracy=_accuracy_data(results.folder, rows_of, cell, grid),
        ghosts=_false_positive_data(results.folder / "lists.parquet", rows_of, grid, one.configuration),
        steps=_step_data(rows_of, grid),
    )


def _lay_out(values: NDArray[T], cell: Int, size: int) -> NDArray[T]:
    """(size,) values by cell; NaN, 0 or False where there are none."""
    out = np.full(size, np.nan if values.dtype.kind == "f" else 0, dtype=values.dtype)
    out[cell[cell >= 0]] = values[cell >= 0]
    return out


def _is_left(rows: pa.Table) -> Bool:
    import pyarrow as pa
    import pyarrow.compute as pc

    return flag_column(pc.is_in(rows["ended_by"], pa.array(COMPETES)))


def _check_once(place: Path, cell: Int, configuration: str) -> None:
    present = cell[cell >= 0]
    if len(np.unique(present)) != len(present):
        raise InputError(f"{place}: {configuration}: expected each log, run and object once, found some twice; {AGAIN}")


def _accuracy_data(folder: Path, tables: dict[str, pa.Table], cell: Int, grid: PairingGrid) -> AccuracyData | None:
    if not {"accuracy.parquet", "instants.parquet"} <= set(tables):
        return None
    rows, place = tables["accuracy.parquet"], folder / "accuracy.parquet"
    if not np.array_equal(grid.cells(rows), cell):
        raise InputError(f"{place}: expected the rows of detections.parquet, found others; {AGAIN}")
    length, error_m = list_column(rows["error_m"])
    parts, gospa = list_column(rows["gospa_m2"])
    if not np.array_equal(length, parts):
        raise InputError(f"{place}: expected error_m and gospa_m2 of equal length, found others; {AGAIN}")
    instants = tables["instants.parquet"]
    counts, flat_s = list_column(instants["available_s"])
    by_run, until = "run" in instants.column_names, np.cumsum(counts)
    times_s = [flat_s[until[k] - counts[k] : until[k]] for k in range(len(counts))]
    available_s = (*times_s, np.empty(0))  # the last: none
    of_run = np.full(grid.runs, -1 if by_run else len(counts) - 1)  # −1: the last, none
    if by_run:
        run = grid.runs_of(instants)
        of_run[run[run >= 0]] = np.flatnonzero(run >= 0)
    first, size = integer_column(rows["first_list"]), len(grid.objects) * grid.runs
    kept = cell >= 0
    last = np.array([len(times) for times in available_s], dtype=np.int64)[of_run[cell[kept] % grid.runs]]
    if (first[kept] < 0).any() or ((first + length)[kept] > last)[length[kept] > 0].any():
        raise InputError(f"{place}: expected lists of instants.parquet, found more; {AGAIN}")
    start = np.cumsum(length) - length
    return AccuracyData(
        start=_lay_out(start, cell, size),
        length=_lay_out(length, cell, size),
        first=_lay_out(first, cell, size),
        ghosts=_lay_out(integer_column(rows["ghosts"]), cell, size),
        error_m=error_m,
        gospa=gospa,
        available_s=available_s,
        of_run=of_run,
        by_run=by_run,
    )


def _false_positive_data(
    place: Path, tables: dict[str, pa.Table], grid: PairingGrid, configuration: str
) -> FalsePositiveData | None:
    if "lists.parquet" not in tables:
        return None
    rows = tables["lists.parquet"]
    run = grid.runs_of(rows)
    _check_once(place, run, configuration)
    return FalsePositiveData(
        there=_lay_out(np.ones(len(run), dtype=bool), run, grid.runs),
        minutes=_lay_out(float_column(rows["minutes"]), run, grid.runs),
        count=_lay_out(integer_column(rows["ghosts"]), run, grid.runs),
    )


def _step_data(tables: dict[str, pa.Table], grid: PairingGrid) -> StepData | None:
    if "thresholds.parquet" not in tables:
        return None
    rows = tables["thresholds.parquet"]
    cell = grid.cells(rows)
    kept = cell >= 0
    return StepData(cell[kept], float_column(rows["existence"])[kept], float_column(rows["detection_s"])[kept])


# Fused lists of two configurations, paired instant by instant.

_VALUES = 4_000_000
"""Values paired at a time, a few hundred MB: the size of blocks, which changes no result."""


@dataclass(frozen=True)
class PairedListSums:
    """Sums over the lists that two configurations share. (…, 2): of the first and of the second."""

    matched: Int  # (C,) lists in which both match the object of the cell
    squared_m2: Float  # (C, 2) Σ e² over them
    measured: Int  # (C,) lists in which the object of the cell is measured
    gospa: Float  # (C, 2) Σ of its parts of GOSPA over them
    lists: Int  # (S,) shared lists in which an object of the cells is measured


def pair_lists(first: AccuracyData, second: AccuracyData, grid: PairingGrid, cells: Int) -> PairedListSums:
    """Pair the lists of cells (C,)."""
    run_of = cells % grid.runs
    other, offset = _match_instants(first, second, np.arange(grid.runs))
    most = max((len(times) for times in first.available_s), default=0)
    matched, measured = np.zeros((2, len(cells)), dtype=np.int64)
    squared, gospa = np.zeros((2, len(cells), 2))
    counted = np.zeros(grid.runs * most, dtype=bool)
    until = np.cumsum(first.length[cells])
    bounds = np.searchsorted(until, np.arange(_VALUES, int(until[-1]) if len(until) else 0, _VALUES))
    for part in np.split(np.arange(len(cells)), bounds):
        row, place, number, partner = _align_values(first, second, other, offset[run_of], cells, part)
        errors_m = [side.error_m[k].astype(float) for side, k in ((first, place), (second, partner))]
        k = ~np.isnan(errors_m[0] + errors_m[1])
        matched += np.bincount(row[k], minlength=len(cells))
        parts = [side.gospa[k] for side, k in ((first, place), (second, partner))]
        g = ~np.isnan(parts[0] + parts[1])
        measured += np.bincount(row[g], minlength=len(cells))
        for side in (0, 1):
            squared[:, side] += np.bincount(row[k], errors_m[side][k] ** 2, minlength=len(cells))
            gospa[:, side] += np.bincount(row[g], parts[side][g], minlength=len(cells))
        counted[run_of[row[g]] * most + number[g]] = True
    return PairedListSums(matched, squared, measured, gospa, counted.reshape(grid.runs, most).sum(axis=1))


def count_shared_instants(first: AccuracyData, second: AccuracyData) -> Int:
    """(3,) number of instants that both have, and that each has; over all runs where those of a side differ."""
    sides = (first, second)
    runs = np.arange(len(first.of_run) if first.by_run or second.by_run else 1)
    other, offset = _match_instants(first, second, runs)
    counts = [np.array([len(times) for times in side.available_s])[side.of_run[runs]] for side in sides]
    has = np.append(0, np.cumsum(other >= 0))
    return np.array([(has[offset + counts[0]] - has[offset]).sum(), *(count.sum() for count in counts)])


def _match_instants(first: AccuracyData, second: AccuracyData, runs: Int) -> tuple[Int, Int]:
    """For instants of the first their numbers in the second, −1: none; and the place where those of each run begin,
    (R,).
    """
    pairs, which = np.unique(np.stack([first.of_run[runs], second.of_run[runs]]), axis=1, return_inverse=True)
    numbers = []
    for mine, others in pairs.T.tolist():
        mine_s, other_s = first.available_s[mine], second.available_s[others]
        # The nearest of the other's, to the left or to the right.
        right = np.searchsorted(other_s, mine_s)
        near = np.full(len(mine_s), -1, dtype=np.int64)
        for k in (right - 1, right):
            close = (k >= 0) & (k < len(other_s))
            close[close] = np.abs(other_s[k[close]] - mine_s[close]) <= SAME_INSTANT_S * (1 + 1e-6)
            near[close] = k[close]
        numbers.append(near)
    counts = np.array([len(near) for near in numbers], dtype=np.int64)
    begins = (np.cumsum(counts) - counts)[which.ravel()]
    return np.concatenate([np.empty(0, dtype=np.int64), *numbers]), begins


def _align_values(
    first: AccuracyData, second: AccuracyData, other: Int, offset: Int, cells: Int, part: Int
) -> tuple[Int, Int, Int, Int]:
    """(V,) rows of `cells`, places in the first's values, numbers of its instants, places in the second's values.

    Of the rows `part` of `cells (C,)`, whose instants begin at `offset (C,)` in `other`.
    """
    length = first.length[cells[part]]
    row = np.repeat(part, length)
    within = np.arange(len(row)) - np.repeat(np.cumsum(length) - length, length)
    cell = cells[row]
    number = first.first[cell] + within
    same = other[offset[row] + number] - second.first[cell]
    shared = (other[offset[row] + number] >= 0) & (same >= 0) & (same < second.length[cell])
    if not shared.all():
        row, within, cell, number, same = (values[shared] for values in (row, within, cell, number, same))
    return row, first.start[cell] + within, number, second.start[cell] + same

"""Pairing of results, log by log: a grid with a cell for every episode and run, common to all sides.

Rows of two configurations about the same episode of an object in the same run are in the same cell. What both hold is
paired frame by frame of the truth (`metrics/accuracy/held.py`), from the first frame at which both have issued a list.

Letters of the shapes: N episodes of the log, S runs, G frames; N·S cells, episode by episode.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from copem_replay.core.errors import InputError
from copem_replay.core.tracks import SAME_INSTANT_S, Bool, Float, Int
from copem_replay.metrics.columns import TABLES
from copem_replay.metrics.onset import COUNTS_BY, is_counted
from copem_replay.metrics.survival import COMPETES
from copem_replay.results.compare.labels import LabelledConfiguration
from copem_replay.results.table_files import AGAIN


@dataclass(frozen=True)
class PairingGrid:
    """The episodes of a log, and the runs that all folders have.

    `log_ix`: number of the log; `before`: number of objects in the logs before it.
    """

    log_ix: int
    episodes: tuple[tuple[str, int], ...]  # N: object, and number of the episode
    runs: int  # S
    before: int = 0

    @cached_property
    def objects(self) -> tuple[str, ...]:
        """The measured objects, each once."""
        return tuple(dict.fromkeys(name for name, _ in self.episodes))

    def object_of(self, cells: Int) -> Int:
        """(C,) the object of each cell, as a position in `objects`; −1 of a negative one."""
        number = {name: k for k, name in enumerate(self.objects)}
        object_ix = np.array([*(number[name] for name, _ in self.episodes), -1], dtype=np.int64)
        return object_ix[np.where(cells < 0, -1, cells // self.runs)]

    def cells(self, table: pa.Table) -> Int:
        """(n,) the grid cell of each row of a table; −1: its run is not compared, or its episode is not in the grid."""
        object_ix = integer_column(
            pc.index_in(table["object_id"], value_set=pa.array(self.objects, pa.string())), missing=-1
        )
        number, run = integer_column(table["episode"], missing=-1), self.runs_of(table)
        episode_limit = max((n for _, n in self.episodes), default=0) + 1
        row_of_episode = np.full((len(self.objects) + 1, episode_limit + 1), -1)
        for k, (name, n) in enumerate(self.episodes):
            row_of_episode[self.objects.index(name), n] = k
        place = row_of_episode[object_ix, np.where((number >= 0) & (number < episode_limit), number, episode_limit)]
        return np.where((place >= 0) & (run >= 0), place * self.runs + run, -1)

    def runs_of(self, table: pa.Table) -> Int:
        """(n,) the run of each row, −1: one that is not compared."""
        run = integer_column(table["run"], missing=-1)
        return np.where((run >= 0) & (run < self.runs), run, -1)


def build_grid(log_ix: int, tables: Iterable[pa.Table], runs: int, before: int) -> PairingGrid:
    """The grid of a log's episodes; `tables`: its `detections.parquet` by folder, `before`: objects of earlier logs."""
    episodes: dict[tuple[str, int], None] = {}
    for table in tables:
        pairs = (
            table.select(["object_id", "episode"]).group_by(["object_id", "episode"], use_threads=False).aggregate([])
        )
        episodes |= dict.fromkeys(zip(pairs["object_id"].to_pylist(), pairs["episode"].to_pylist(), strict=True))
    return PairingGrid(log_ix, tuple(episodes), runs, before)


def integer_column(column: pa.ChunkedArray, *, missing: int = 0) -> Int:
    """(n,) whole numbers, `missing` where null."""
    values: Int = column.cast(pa.int64()).fill_null(missing).to_numpy()
    return values


def float_column(column: pa.ChunkedArray) -> Float:
    """(n,) numbers, NaN where null."""
    values: Float = column.cast(pa.float64()).to_numpy()
    return values


def flag_column(column: pa.ChunkedArray) -> Bool:
    """(n,) true or false, null is false."""
    values: Bool = column.cast(pa.bool_()).fill_null(False).to_numpy().astype(np.bool_)
    return values


def list_column(column: pa.ChunkedArray) -> tuple[Int, Float]:
    """(n,) lengths of lists, 0 where null, and what is in them one after the other, NaN where null."""
    length = integer_column(pc.list_value_length(column))
    inner: Float = pc.list_flatten(column).cast(pa.float64()).to_numpy()
    return length, inner


_READ = {"true or false": flag_column, "numbers": float_column, "whole numbers": integer_column}
"""Columns by their kind."""

# One side of a pair: the rows of a configuration in a log, laid out on the grid.

T = TypeVar("T", bound=np.generic)


@dataclass(frozen=True)
class AccuracyData:
    """Accuracy of a configuration: each cell has `length` frames from frame `first` on, at `start` in the values.

    What is held at frames is equal in all runs unless runs differ in their units: run s has row `of_run[s]`.
    """

    start: Int  # (N·S,)
    length: Int  # (N·S,)
    first: Int  # (N·S,)
    ghosts: Int  # (N·S,) false entries nearest to this object
    error_m: Float  # (V,) NaN: not listed
    age_s: Float  # (V,) NaN: not listed
    gospa: Float  # (V,) this object's part of GOSPA to its power; NaN: it does not count at the frame
    frame_s: Float  # (G,)
    begins: Int  # (R,) the first frame at which a list has been issued, G: there is none
    holds: Bool  # (R, G) whether a list is held
    of_run: Int  # (S,)


Columns = dict[str, NDArray[Any]]
"""Columns that comparisons read, by their names in a file of results."""


@dataclass(frozen=True)
class PairSide:
    """One side of a pair in a log: what comparisons read of a configuration, laid out on the grid. None: not written.

    `rows`: columns of `detections.parquet` by cell, and `left`: never detected, if it was not. They have no meaning
    where a cell is not `there`. `counted`: there, and counts for times, shares and distances at detection. `lists`:
    columns of `lists.parquet` by run, and `there`. `steps`: columns (C,) of `thresholds.parquet`, and `cell`: it is
    detected at `detection_s` without entries below any threshold up to `existence`.
    """

    there: Bool
    counted: Bool
    rows: Columns
    accuracy: AccuracyData | None
    lists: Columns | None
    steps: Columns | None

    @property
    def counted_however_begun(self) -> Bool:
        """The mask of rows that would count whatever `measure.began` says."""
        return self.there & (self.rows["ended_s"] - self.rows["onset_s"] > SAME_INSTANT_S)

    def has_rows_of(self, other: PairSide) -> bool:
        """Whether the other side has equal rows, and equal counts of lists, as far as both are written."""
        if not np.array_equal(self.there, other.there):
            return False
        pairs = [(of[self.there], other.rows[name][self.there]) for name, of in self.rows.items() if name in other.rows]
        if self.lists is not None and other.lists is not None:
            pairs += [(of, other.lists[name]) for name, of in self.lists.items() if name in other.lists]
        return all(np.array_equal(one, of, equal_nan=True) for one, of in pairs)


def configuration_rows(labelled: LabelledConfiguration, tables: dict[str, pa.Table]) -> dict[str, pa.Table]:
    """The rows of a configuration, by table."""
    return {
        name: table.filter(pc.equal(table["configuration"], labelled.configuration)) for name, table in tables.items()
    }


def lay_out_configuration(labelled: LabelledConfiguration, tables: dict[str, pa.Table], grid: PairingGrid) -> PairSide:
    """A configuration's rows of a log on the grid. Raises InputError where tables are damaged or contradictory."""
    results, rows_of = labelled.results, configuration_rows(labelled, tables)
    rows, place = rows_of["detections.parquet"], results.place / "detections.parquet"
    cell, size = grid.cells(rows), len(grid.episodes) * grid.runs
    _check_once(place, cell, labelled.configuration)
    columns = _read_columns(place, rows)
    if (np.isnan(columns["detection_s"]) & columns["detected"]).any():
        raise InputError(f"{place}: column detection_s: expected a number where detected, found none in some; {AGAIN}")
    columns["left"] = flag_column(pc.is_in(rows["ended_by"], pa.array(COMPETES)))
    began = rows.select([*COUNTS_BY]).to_pandas()
    return PairSide(
        there=_lay_out(np.ones(len(cell), dtype=bool), cell, size),
        counted=_lay_out(is_counted(began, results.provenance.measure["began"]), cell, size),
        rows={name: _lay_out(values, cell, size) for name, values in columns.items()},
        accuracy=_accuracy_data(results.place, rows_of, cell, grid),
        lists=_list_columns(results.place / "lists.parquet", rows_of, grid, labelled.configuration),
        steps=_step_columns(results.place / "thresholds.parquet", rows_of, grid),
    )


def _read_columns(place: Path, rows: pa.Table) -> Columns:
    """(n,) the columns that comparisons read and that are no keys of rows, nor text or lists."""
    kinds = TABLES[place.name].kinds("braking", "needless", compared=True)
    return {
        name: _READ[kind](rows[name])
        for name, kind in kinds.items()
        if kind in _READ and name not in ("run", "episode") and name in rows.column_names
    }


def _lay_out(values: NDArray[T], cell: Int, size: int) -> NDArray[T]:
    """(size,) values by cell; NaN, 0 or False where there are none."""
    out = np.full(size, np.nan if values.dtype.kind == "f" else 0, dtype=values.dtype)
    out[cell[cell >= 0]] = values[cell >= 0]
    return out


def _check_once(place: Path, cell: Int, configuration: str) -> None:
    present = cell[cell >= 0]
    if len(np.unique(present)) != len(present):
        raise InputError(f"{place}: {configuration}: expected each log, run and object once, found some twice; {AGAIN}")


def _accuracy_data(folder: Path, tables: dict[str, pa.Table], cell: Int, grid: PairingGrid) -> AccuracyData | None:
    """What a configuration holds frame by frame, laid out by cell; None: its accuracy is not measured."""
    if not {"accuracy.parquet", "instants.parquet"} <= set(tables):
        return None
    rows, place = tables["accuracy.parquet"], folder / "accuracy.parquet"
    if not np.array_equal(grid.cells(rows), cell):
        raise InputError(f"{place}: expected the rows of detections.parquet, found others; {AGAIN}")
    kinds = TABLES["accuracy.parquet"].kinds(compared=True)
    columns = {name: list_column(rows[name]) for name, kind in kinds.items() if kind == "lists of numbers"}
    length = columns["error_held_m"][0]
    if any(not np.array_equal(length, of) for of, _ in columns.values()):
        raise InputError(f"{place}: expected {', '.join(columns)} of equal length, found others; {AGAIN}")
    frame_s, begins, holds, of_run = _read_frames(folder / "instants.parquet", tables["instants.parquet"], grid)
    first, size = integer_column(rows["first_frame"]), len(grid.episodes) * grid.runs
    kept = cell >= 0
    if (first[kept] < 0).any() or ((first + length)[kept] > len(frame_s))[length[kept] > 0].any():
        raise InputError(f"{place}: expected frames of instants.parquet, found more; {AGAIN}")
    return AccuracyData(
        start=_lay_out(np.cumsum(length) - length, cell, size), length=_lay_out(length, cell, size),
        first=_lay_out(first, cell, size), ghosts=_lay_out(integer_column(rows["ghosts"]), cell, size),
        error_m=columns["error_held_m"][1], age_s=columns["age_held_s"][1], gospa=columns["gospa_held_m2"][1],
        frame_s=frame_s, begins=begins, holds=holds, of_run=of_run,
    )  # fmt: skip


def _read_frames(place: Path, rows: pa.Table, grid: PairingGrid) -> tuple[Float, Int, Bool, Int]:
    """`frame_s`, `begins`, `holds`, `of_run` of `AccuracyData`; the last row of `holds`, all False: no lists."""
    counts, all_frames_s = list_column(rows["frame_s"])
    numbers, held_list = list_column(rows["held_list"])
    issued, available_s = list_column(rows["available_s"])
    frames = int(counts[0]) if len(counts) else 0
    consistent = (counts == frames).all() and (numbers == frames).all()
    if not consistent or (all_frames_s.reshape(len(counts), frames) != all_frames_s[:frames]).any():
        raise InputError(f"{place}: expected the same frame_s in all rows of a log, and as many held_list; {AGAIN}")
    frame_s = all_frames_s[:frames]
    first_s = np.append(available_s, np.inf)[np.where(issued > 0, np.cumsum(issued) - issued, len(available_s))]
    begins = np.searchsorted(frame_s, first_s - SAME_INSTANT_S, side="left")
    holds = np.concatenate([~np.isnan(held_list).reshape(len(counts), frames), np.zeros((1, frames), dtype=bool)])
    by_run = "run" in rows.column_names
    of_run = np.full(grid.runs, -1 if by_run else len(counts) - 1)
    if by_run:
        run = grid.runs_of(rows)
        of_run[run[run >= 0]] = np.flatnonzero(run >= 0)
    return frame_s, np.append(begins, frames), holds, of_run


def _list_columns(place: Path, tables: dict[str, pa.Table], grid: PairingGrid, configuration: str) -> Columns | None:
    if place.name not in tables:
        return None
    rows = tables[place.name]
    run = grid.runs_of(rows)
    _check_once(place, run, configuration)
    columns = _read_columns(place, rows) | {"there": np.ones(len(run), dtype=bool)}
    return {name: _lay_out(values, run, grid.runs) for name, values in columns.items()}


def _step_columns(place: Path, tables: dict[str, pa.Table], grid: PairingGrid) -> Columns | None:
    if place.name not in tables:
        return None
    cell = grid.cells(tables[place.name])
    columns = _read_columns(place, tables[place.name]) | {"cell": cell}
    return {name: values[cell >= 0] for name, values in columns.items()}


# What two configurations hold, paired frame by frame.

_VALUES = 4_000_000
"""Values paired at a time, a few hundred MB: the size of blocks, which changes no result."""


@dataclass(frozen=True)
class PairedHeldSums:
    """Sums over the frames from which on both sides have issued a list. (…, 2): of the first and of the second."""

    pairs: Int  # (C,) frames at which both list the object of the cell
    squared_m2: Float  # (C, 2) Σ e² over them
    age_s: Float  # (2,) Σ of ages over them, in all cells
    only: Int  # (2,) frames at which one lists the object of a cell and the other does not
    measured: Int  # (C,) frames at which the object of the cell counts
    gospa: Float  # (C, 2) Σ of its parts of GOSPA over them
    frames: Int  # (S,) frames at which the object of any of the cells counts
    without_list: Int  # (2,) of these, in all runs, frames without a list


def pair_held_lists(first: AccuracyData, second: AccuracyData, grid: PairingGrid, cells: Int) -> PairedHeldSums:
    """Pair what both sides hold of cells (C,)."""
    sides, frames = (first, second), len(first.frame_s)
    begins = np.maximum(*(side.begins[side.of_run] for side in sides))
    pairs, measured = np.zeros((2, len(cells)), dtype=np.int64)
    squared_m2, gospa = np.zeros((2, len(cells), 2))
    age_s, one_sided = np.zeros(2), np.zeros(2, dtype=np.int64)
    counted = np.zeros((grid.runs, frames), dtype=bool)
    until = np.cumsum(first.length[cells])
    bounds = np.searchsorted(until, np.arange(_VALUES, int(until[-1]) if len(until) else 0, _VALUES))
    for part in np.split(np.arange(len(cells)), bounds):
        row, frame, places = _align_frames(first, second, begins[cells % grid.runs], cells, part)
        errors_m = [side.error_m[k] for side, k in zip(sides, places, strict=True)]
        parts = [side.gospa[k] for side, k in zip(sides, places, strict=True)]
        listed = [~np.isnan(of) for of in errors_m]
        both_list, counts = listed[0] & listed[1], ~np.isnan(parts[0] + parts[1])
        pairs += np.bincount(row[both_list], minlength=len(cells))
        measured += np.bincount(row[counts], minlength=len(cells))
        for side in (0, 1):
            squared_m2[:, side] += np.bincount(row[both_list], errors_m[side][both_list] ** 2, minlength=len(cells))
            gospa[:, side] += np.bincount(row[counts], parts[side][counts], minlength=len(cells))
            age_s[side] += sides[side].age_s[places[side][both_list]].sum()
            one_sided[side] += (listed[side] & ~both_list).sum()
        counted[cells[row[counts]] % grid.runs, frame[counts]] = True
    missing = np.zeros(2, dtype=np.int64)
    if counted.any():  # a side that is not in the log has no frames
        missing[:] = [(counted & ~side.holds[side.of_run]).sum() for side in sides]
    return PairedHeldSums(pairs, squared_m2, age_s, one_sided, measured, gospa, counted.sum(axis=1), missing)


def _align_frames(
    first: AccuracyData, second: AccuracyData, begins: Int, cells: Int, part: Int
) -> tuple[Int, Int, tuple[Int, Int]]:
    """Frame by frame of rows `cells[part]`: (V,) row, (V,) frame, and (V,) place of its value on each side. `begins
    (C,)`: frames before these are left out.
    """
    length = first.length[cells[part]]
    row = np.repeat(part, length)
    offset = np.arange(len(row)) - np.repeat(np.cumsum(length) - length, length)
    cell = cells[row]
    frame = first.first[cell] + offset
    counts = frame >= begins[row]
    row, offset, cell, frame = (values[counts] for values in (row, offset, cell, frame))
    return row, frame, (first.start[cell] + offset, second.start[cell] + offset)

"""One side of a pair: what a configuration gave in a log, laid out on the grid."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.errors import InputError
from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.metrics.end_reason import COMPETES
from copem_replay.results.compare.labels import Named
from copem_replay.results.compare.pairing import Grid, flag, lists, number, whole

if TYPE_CHECKING:
    import pyarrow as pa

T = TypeVar("T", bound=np.generic)
_AGAIN = "run the experiment again with --overwrite"


@dataclass(frozen=True)
class AccuracyData:
    """Lists of a configuration against the truth: of each cell `length` of them from `first` on, at `start` in values.

    `first` counts in the instants of the cell's run, `available_s[of_run[run]]`; they are the same in all runs unless
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
class Ghosts:
    """Entries of a configuration at no object, by run."""

    there: Bool  # (S,)
    minutes: Float  # (S,)
    count: Int  # (S,)


@dataclass(frozen=True)
class StepData:
    """When each cell is detected (C,) if entries below any threshold up to `existence (C,)` are left out."""

    cell: Int
    existence: Float
    detection_s: Float


@dataclass(frozen=True)
class ConfigurationData:
    """A configuration on the grid: columns by cell, that mean nothing where it is not `there`. None: not written."""

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
    ghosts: Ghosts | None
    steps: StepData | None


def rows_of(one: Named, tables: dict[str, pa.Table]) -> dict[str, pa.Table]:
    """What tables of a log say of a configuration."""
    import pyarrow.compute as pc

    return {name: table.filter(pc.equal(table["configuration"], one.configuration)) for name, table in tables.items()}


def side_of(one: Named, tables: dict[str, pa.Table], grid: Grid) -> ConfigurationData:
    """Lay out what a log's tables say of a configuration. Raises InputError: they are damaged or don't go together."""
    results, mine = one.results, rows_of(one, tables)
    rows = mine["detections.parquet"]
    cell = grid.cells(rows)
    place = results.folder / "detections.parquet"
    _check_once(place, cell, one.configuration)
    detected = flag(rows["detected"])
    for name, wanted in (("onset_s", True), ("ended_s", True), ("detection_s", detected)):
        if (np.isnan(number(rows[name])) & wanted).any():
            raise InputError(f"{place}: column {name}: expected a number in every row, found none in some; {_AGAIN}")
    braking = results.provenance.braking is not None
    size = len(grid.objects) * grid.runs
    return ConfigurationData(
        label=one.label,
        path=results.folder,
        there=_laid(np.ones(len(cell), dtype=bool), cell, size),
        detected=_laid(detected, cell, size),
        left=_laid(_is_left(rows), cell, size),
        onset_s=_laid(number(rows["onset_s"]), cell, size),
        ended_s=_laid(number(rows["ended_s"]), cell, size),
        detection_s=_laid(number(rows["detection_s"]), cell, size),
        distance_m=_laid(number(rows["distance_at_detection_m"]), cell, size),
        conflict=_laid(flag(rows["conflict"]), cell, size) if braking else None,
        passes=_laid(flag(rows["braking_pass"]), cell, size) if braking else None,
        accuracy=_accuracy(results.folder, mine, cell, grid),
        ghosts=_ghosts(results.folder / "lists.parquet", mine, grid, one.configuration),
        steps=_steps(mine, grid),
    )


def _laid(values: NDArray[T], cell: Int, size: int) -> NDArray[T]:
    """(size,) values by cell; where there are none NaN, 0 or False."""
    out = np.full(size, np.nan if values.dtype.kind == "f" else 0, dtype=values.dtype)
    out[cell[cell >= 0]] = values[cell >= 0]
    return out


def _is_left(rows: pa.Table) -> Bool:
    import pyarrow as pa
    import pyarrow.compute as pc

    return flag(pc.is_in(rows["ended_by"], pa.array(COMPETES)))


def _check_once(place: Path, cell: Int, configuration: str) -> None:
    there = cell[cell >= 0]
    if len(np.unique(there)) != len(there):
        raise InputError(
            f"{place}: {configuration}: expected each log, run and object once, found some twice; {_AGAIN}"
        )


def _accuracy(folder: Path, tables: dict[str, pa.Table], cell: Int, grid: Grid) -> AccuracyData | None:
    if not {"accuracy.parquet", "instants.parquet"} <= set(tables):
        return None
    rows, place = tables["accuracy.parquet"], folder / "accuracy.parquet"
    if not np.array_equal(grid.cells(rows), cell):
        raise InputError(f"{place}: expected the rows of detections.parquet, found others; {_AGAIN}")
    length, error_m = lists(rows["error_m"])
    parts, gospa = lists(rows["gospa_m2"])
    if not np.array_equal(length, parts):
        raise InputError(f"{place}: expected error_m and gospa_m2 of equal length, found others; {_AGAIN}")
    instants = tables["instants.parquet"]
    counts, flat_s = lists(instants["available_s"])
    by_run, until = "run" in instants.column_names, np.cumsum(counts)
    times_s = [flat_s[until[k] - counts[k] : until[k]] for k in range(len(counts))]
    available_s = (*times_s, np.empty(0))  # the last: none
    of_run = np.full(grid.runs, -1 if by_run else len(counts) - 1)  # −1: the last, none
    if by_run:
        run = grid.runs_of(instants)
        of_run[run[run >= 0]] = np.flatnonzero(run >= 0)
    first, size = whole(rows["first_list"]), len(grid.objects) * grid.runs
    kept = cell >= 0
    last = np.array([len(times) for times in available_s], dtype=np.int64)[of_run[cell[kept] % grid.runs]]
    if (first[kept] < 0).any() or ((first + length)[kept] > last)[length[kept] > 0].any():
        raise InputError(f"{place}: expected lists of instants.parquet, found more; {_AGAIN}")
    start = np.cumsum(length) - length
    return AccuracyData(
        start=_laid(start, cell, size),
        length=_laid(length, cell, size),
        first=_laid(first, cell, size),
        ghosts=_laid(whole(rows["ghosts"]), cell, size),
        error_m=error_m,
        gospa=gospa,
        available_s=available_s,
        of_run=of_run,
        by_run=by_run,
    )


def _ghosts(place: Path, tables: dict[str, pa.Table], grid: Grid, configuration: str) -> Ghosts | None:
    if "lists.parquet" not in tables:
        return None
    rows = tables["lists.parquet"]
    run = grid.runs_of(rows)
    _check_once(place, run, configuration)
    return Ghosts(
        there=_laid(np.ones(len(run), dtype=bool), run, grid.runs),
        minutes=_laid(number(rows["minutes"]), run, grid.runs),
        count=_laid(whole(rows["ghosts"]), run, grid.runs),
    )


def _steps(tables: dict[str, pa.Table], grid: Grid) -> StepData | None:
    if "thresholds.parquet" not in tables:
        return None
    rows = tables["thresholds.parquet"]
    cell = grid.cells(rows)
    kept = cell >= 0
    return StepData(cell[kept], number(rows["existence"])[kept], number(rows["detection_s"])[kept])

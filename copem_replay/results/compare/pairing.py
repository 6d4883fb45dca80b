"""The grid on which results are paired, log by log: a cell for every measured object and run, the same for all sides.

Letters of the shapes: N measured objects of the log, S runs; N·S cells, object by object. So what two configurations
say of the same object in the same run stands in the same cell of both.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.tracks import Bool, Float, Int

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True)
class Grid:
    """The objects measured in a log, and the runs that all folders have.

    `log_ix`: which log it is; `before`: how many objects the logs before it have.
    """

    log_ix: int
    objects: tuple[str, ...]  # N
    runs: int  # S
    before: int = 0

    def cells(self, table: pa.Table) -> Int:
        """(n,) the cell of each row of a table, −1: a run that is not compared, or an object that is not measured."""
        import pyarrow as pa
        import pyarrow.compute as pc

        at = whole(pc.index_in(table["object_id"], value_set=pa.array(self.objects, pa.string())), missing=-1)
        run = self.runs_of(table)
        return np.where((at >= 0) & (run >= 0), at * self.runs + run, -1)

    def runs_of(self, table: pa.Table) -> Int:
        """(n,) the run of each row, −1: one that is not compared."""
        run = whole(table["run"], missing=-1)
        return np.where((run >= 0) & (run < self.runs), run, -1)


def grid_of(log_ix: int, tables: Iterable[pa.Table], runs: int, before: int) -> Grid:
    """The grid of a log, of its rows of `detections.parquet` in several folders."""
    objects: dict[str, None] = {}
    for table in tables:
        objects |= dict.fromkeys(table["object_id"].unique().to_pylist())
    return Grid(log_ix, tuple(objects), runs, before)


def whole(column: pa.ChunkedArray, *, missing: int = 0) -> Int:
    """(n,) whole numbers, `missing` where null."""
    import pyarrow as pa

    values: Int = column.cast(pa.int64()).fill_null(missing).to_numpy()
    return values


def number(column: pa.ChunkedArray) -> Float:
    """(n,) numbers, NaN where null."""
    import pyarrow as pa

    values: Float = column.cast(pa.float64()).to_numpy()
    return values


def flag(column: pa.ChunkedArray) -> Bool:
    """(n,) true or false, null is false."""
    import pyarrow as pa

    values: Bool = column.cast(pa.bool_()).fill_null(False).to_numpy().astype(np.bool_)
    return values


def lists(column: pa.ChunkedArray) -> tuple[Int, Float]:
    """(n,) lengths of lists, 0 where null, and what is in them one after the other, NaN where null."""
    import pyarrow as pa
    import pyarrow.compute as pc

    length = whole(pc.list_value_length(column))
    inner: Float = pc.list_flatten(column).cast(pa.float64()).to_numpy()
    return length, inner

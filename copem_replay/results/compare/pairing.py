"""The grid on which results are paired: a cell for every measured object and run, the same for all configurations.

Letters of the shapes: L logs, N measured objects of all logs, S runs; N·S cells, object by object; L·S places, log by
log. So what two configurations say of the same object in the same run stands in the same cell of both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.errors import InputError
from copem_replay.core.tracks import Bool, Float, Int

if TYPE_CHECKING:
    import pyarrow as pa

    from copem_replay.results.read import Results


@dataclass(frozen=True)
class Grid:
    """Logs, the objects measured in them, and the runs that all folders have."""

    logs: tuple[str, ...]  # L
    objects: tuple[str, ...]  # (N,) log and id, `log\nid`
    log_ix: Int  # (N,) which log each object is of
    runs: int  # S

    def cells(self, table: pa.Table) -> Int:
        """(n,) the cell of each row of a table, −1: a run that is not compared, or an object nobody measured."""
        import pyarrow as pa
        import pyarrow.compute as pc

        at = _numbered(pc.index_in(_object_keys(table), value_set=pa.array(self.objects, pa.string())))
        return self._of_runs(at, table)

    def places(self, table: pa.Table) -> Int:
        """(n,) the place of each row's log and run, −1: a run that is not compared."""
        return self._of_runs(self.log_numbers(table), table)

    def log_numbers(self, table: pa.Table) -> Int:
        """(n,) which log each row of a table is of, −1: none of these."""
        import pyarrow as pa
        import pyarrow.compute as pc

        return _numbered(pc.index_in(table["log"], value_set=pa.array(self.logs, pa.string())))

    def _of_runs(self, at: Int, table: pa.Table) -> Int:
        run = whole(table["run"], missing=-1)
        return np.where((at >= 0) & (run >= 0) & (run < self.runs), at * self.runs + run, -1)

    @cached_property
    def object_of(self) -> Int:
        """(N·S,) the object of each cell."""
        return np.repeat(np.arange(len(self.objects)), self.runs)

    @cached_property
    def log_of(self) -> Int:
        """(N·S,) the log of each cell."""
        of: Int = self.log_ix[self.object_of]
        return of

    @cached_property
    def place_of(self) -> Int:
        """(N·S,) the place of each cell: its log and run."""
        of: Int = self.log_of * self.runs + self.run_of
        return of

    @cached_property
    def run_of(self) -> Int:
        """(N·S,) the run of each cell."""
        return np.tile(np.arange(self.runs), len(self.objects))


def grid_of(folders: Sequence[Results]) -> Grid:
    """The grid of several folders. Raises InputError where there is no row at all."""
    import pyarrow.compute as pc

    logs = tuple(log.name for log in folders[0].provenance.logs)
    objects: dict[str, None] = {}
    for folder in folders:
        objects |= dict.fromkeys(pc.unique(_object_keys(folder.arrow["detections.parquet"])).to_pylist())
        if unknown := set(folder.arrow["detections.parquet"]["log"].unique().to_pylist()) - set(logs):
            raise InputError(
                f"{folder.folder}/detections.parquet: expected the logs of provenance.json, found {min(unknown)!r}"
            )
    if not objects:
        raise InputError(f"{folders[0].folder}: expected rows to compare, found none: no measured object has an onset")
    number = {name: k for k, name in enumerate(logs)}
    log_ix = np.array([number[key.partition("\n")[0]] for key in objects], dtype=np.int64)
    return Grid(logs, tuple(objects), log_ix, min(folder.provenance.runs for folder in folders))


def _object_keys(table: pa.Table) -> pa.ChunkedArray:
    import pyarrow.compute as pc

    return pc.binary_join_element_wise(table["log"], table["object_id"], "\n")


def _numbered(found: pa.ChunkedArray) -> Int:
    return whole(found, missing=-1)


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

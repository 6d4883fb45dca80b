"""A results folder, read back: one reader for figures, reports, recordings and comparisons."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from copem_replay.core.errors import ExperimentError, InputError
from copem_replay.core.remote import Remote, is_url
from copem_replay.core.tracks import TRUTH
from copem_replay.experiment.file import Source, load, parse, places_of
from copem_replay.experiment.schema import Experiment
from copem_replay.io.together import File, Place, first_of
from copem_replay.metrics.fixed import Fixed, fixed_in
from copem_replay.metrics.intervals import clusters
from copem_replay.metrics.tally import DETECTED
from copem_replay.results.belongings import MARK, check_still
from copem_replay.results.by_log import LogRows, log_rows
from copem_replay.results.provenance import Provenance, read_provenance
from copem_replay.results.tables import (
    AGAIN,
    BRAKING,
    CONFLICT,
    DETECTIONS,
    EXACT,
    OPTIONAL,
    ROWS,
    TALLY,
    VERDICTS,
    file_of,
    read_csv,
    read_frame,
)

if TYPE_CHECKING:
    import pyarrow as pa

_MAY_BE_FOLDERS = ("detections.parquet", "tally.parquet")


@dataclass(frozen=True, eq=False)
class Results:
    """A results folder. Its files are read when they are first asked for, which raises InputError where one is damaged
    or is by now that of other results.

    >>> results = cr.load_results("out/tc016d")
    >>> results.name, results.experiment.runs, results.sweep is None
    ('tc016d', 500, True)
    """

    folder: Path
    seen: os.stat_result  # the folder when it was opened
    provenance: Provenance

    @property
    def name(self) -> str:
        """The name of the folder, also where it is given as `.`."""
        return self.folder.resolve().name

    @cached_property
    def source(self) -> Source:
        """`experiment.yaml` as plain data."""
        try:
            source = load(self.folder / "experiment.yaml")
        except ExperimentError as error:
            why = error.problems[0].removeprefix(f"{self.folder / 'experiment.yaml'}:").strip()
            raise InputError(
                f"{self.folder / 'experiment.yaml'}: expected the experiment of the results, found damage: {why}; "
                f"{AGAIN}"
            ) from None
        check_still(self.folder, self.seen)
        return source

    @cached_property
    def experiment(self) -> Experiment:
        """The experiment, with components of the user's own."""
        experiment, problems = parse(self.source)
        if experiment is None or problems:
            raise InputError(problems)
        return experiment

    @cached_property
    def table(self) -> pd.DataFrame:
        """`detections.parquet` as a whole, for users: figures take `known` or `each`, whatever its size."""
        return self._frame("detections.parquet", _columns(self.experiment))

    @cached_property
    def rows(self) -> LogRows:
        """Where the rows of each log are in `detections.parquet`."""
        place = self.folder / "detections.parquet"
        found = log_rows(place, self._compared, self._files(place))
        check_still(self.folder, self.seen)
        return found

    def each(self, *columns: str, log: str | None = None) -> Iterator[pd.DataFrame]:
        """Rows log by log, or of one log, with these of the columns; none named: all but the log's name."""
        rows = self.rows.only(columns or [name for name in self.rows.without_rows.column_names if name != "log"])
        for one in self.rows.where if log is None else [log]:
            found = rows.of(one)
            check_still(self.folder, self.seen)
            yield found.to_pandas()

    @cached_property
    def tally(self) -> pd.DataFrame:
        """`tally.parquet`."""
        return self._frame("tally.parquet", (*TALLY, *(("in_conflict", "passed") if self.experiment.braking else ())))

    @cached_property
    def known(self) -> pd.DataFrame:
        """In how many `runs` each object is detected when; of one object alone run by run, for these are resampled."""
        tally = self.tally[self.tally["event"] == DETECTED]
        if not len(tally) or clusters(tally)[0] != "runs":
            return tally
        columns = [name for name in TALLY if name not in ("log", "event", "runs")]
        (rows,) = self.each(*columns, "run", log=str(tally["log"].iloc[0]))
        return rows.assign(log=tally["log"].iloc[0], runs=1)

    @cached_property
    def summary(self) -> pd.DataFrame:
        """`summary.csv`."""
        return self._frame("summary.csv", ("configuration", "n", "list_rate_hz"))

    @cached_property
    def exact(self) -> pd.DataFrame | None:
        """`exact.parquet`; None: there is no such file."""
        return self._frame("exact.parquet", EXACT) if (self.folder / "exact.parquet").is_file() else None

    @cached_property
    def sweep(self) -> pd.DataFrame | None:
        """`sweep.csv`; None: there is no such file."""
        columns = ("sweep", "value", "configuration", "list_rate_hz")
        return self._frame("sweep.csv", columns) if (self.folder / "sweep.csv").is_file() else None

    @property
    def detections(self) -> pd.DataFrame:
        """A row per log, configuration, run and measured object."""
        return self.table

    @cached_property
    def accuracy(self) -> pd.DataFrame | None:
        """Position errors and parts of GOSPA, list by list, in the order of `detections`; None: not measured."""
        return self._frame("accuracy.parquet", ()) if (self.folder / "accuracy.parquet").is_file() else None

    @cached_property
    def bands(self) -> pd.DataFrame | None:
        """Accuracy by configuration and by distance, time or existence; None: not measured."""
        columns = ("configuration", "by", "from", "to")
        return self._frame("bands.csv", columns) if (self.folder / "bands.csv").is_file() else None

    @property
    def notes(self) -> tuple[str, ...]:
        """What had to be said of the recordings and of the runs: one line each."""
        notes = self.provenance.data.get("notes", [])
        return tuple(map(str, notes)) if isinstance(notes, list) else ()

    @cached_property
    def by_log(self) -> dict[str, LogRows]:
        """The tables that comparisons read, by file name, those that are there."""
        rows = self.rows.only(self._compared)
        if not rows.where:
            raise InputError(f"{self.folder}: nothing can be compared: no measured object has an onset")
        if unknown := set(rows.where) - {log.name for log in self.provenance.logs}:
            raise InputError(f"{rows.place}: expected the logs of provenance.json, found {min(unknown)!r}")
        tables = {rows.place.name: rows}
        there = {name: kinds for name, kinds in OPTIONAL.items() if (self.folder / name).is_file()}
        tables |= {name: log_rows(self.folder / name, kinds) for name, kinds in there.items()}
        check_still(self.folder, self.seen)
        return tables

    def rows_of(self, log: str, *names: str) -> dict[str, pa.Table]:
        """A log's rows of some of these tables, by default of all."""
        tables = {name: rows.of(log) for name, rows in self.by_log.items() if not names or name in names}
        check_still(self.folder, self.seen)
        return tables

    @cached_property
    def fixed(self) -> Fixed:
        """What is the same in every run."""
        return fixed_in(self.source.data)

    @cached_property
    def by_truth_id(self) -> frozenset[str]:
        """Configurations that detect by truth id: the truth, and ideal fusion."""
        if self.provenance.measure["match"].get("always"):
            return frozenset()
        return frozenset(name for name, said in self._configurations if _knows_ids(said))

    @cached_property
    def truth(self) -> frozenset[str]:
        """Configurations that are the truth."""
        return frozenset(name for name, said in self._configurations if said.get("units") == TRUTH)

    @property
    def _configurations(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """What `experiment.yaml` says of each configuration, as plain data."""
        said = self.source.data.get("configurations")
        for name, one in said.items() if isinstance(said, dict) else ():
            if isinstance(one, dict):
                yield str(name), one

    def log_place(self, log: str) -> Place:
        """Where the recording of a log, or the several that it is made of, are expected."""
        entry = self.experiment.logs[[file.name for file in self.provenance.logs].index(log)]
        if isinstance(entry, str):
            return Remote(entry) if is_url(entry) else self.folder / entry
        return places_of(entry, self.folder)[0]

    def log_path(self, log: str) -> File:
        """Where the recording of a log is expected."""
        return first_of(self.log_place(log))

    def chosen(self, configurations: Sequence[str] | None) -> tuple[str, ...]:
        """The configurations to draw, each once; None: all. Raises InputError for a name that is not there."""
        known = tuple(self.experiment.configurations)
        for name in configurations or ():
            if name not in known:
                raise InputError(f"{self.folder}: configurations: expected some of {', '.join(known)}, found {name!r}")
        return tuple(dict.fromkeys(configurations)) if configurations else known

    @property
    def _compared(self) -> dict[str, str]:
        """Columns of `detections.parquet` that comparisons read, and their kinds."""
        return DETECTIONS | (VERDICTS if self.provenance.braking is not None else {})

    def _files(self, place: Path) -> list[Path]:
        """Of a table that is a folder, in the order of the logs; none: it is a file."""
        if not place.is_dir():
            return []
        return [path for log in self.provenance.logs if (path := file_of(place, log.name)).is_file()]

    def _frame(self, name: str, columns: Sequence[str]) -> pd.DataFrame:
        def as_frame(place: Path) -> pd.DataFrame:
            from pyarrow import parquet

            table = parquet.read_table(self._files(place) or place)
            return table.to_pandas(split_blocks=True, self_destruct=True)  # column by column, none of them twice

        table = read_frame(self.folder / name, read_csv if name.endswith(".csv") else as_frame, columns)
        check_still(self.folder, self.seen)
        return table


def open_results(folder: Path | str, *more: str) -> Results:
    """A results folder of which nothing but the provenance is read yet.

    `more`: files that have to be there besides what every comparison needs. Raises InputError, one line: no such
    folder, no results, or a damaged provenance.
    """
    folder = Path(folder)
    if not folder.is_dir():
        found = "a file" if folder.exists() else "no such folder"
        raise InputError(f"{folder}: expected a results folder, found {found}; `copem-replay run` writes one")
    _check_there(folder, MARK, "experiment.yaml", "detections.parquet", *more)
    seen = os.stat(folder)
    return Results(folder, seen, read_provenance(folder / MARK))


def _check_there(folder: Path, *names: str) -> None:
    for name in names:
        if not (folder / name).is_file() and not (name in _MAY_BE_FOLDERS and (folder / name).is_dir()):
            raise InputError(
                f"{folder}: expected a results folder, found no {name} in it; `copem-replay run` writes one"
            )


def load_results(folder: Path | str, *, rowless: bool = False) -> Results:
    """Read a results folder, without rows only if `rowless`.

    Raises InputError, one line: no such folder, no results, or damaged ones.
    """
    return complete(open_results(folder, "summary.csv"), rowless=rowless)


def complete(results: Results, *, rowless: bool = False) -> Results:
    """The same, with rows held against the experiment, and every other table read. Raises InputError."""
    _check_there(results.folder, "summary.csv", "tally.parquet")
    experiment, rows = results.experiment, results.rows
    if missing := [name for name in _columns(experiment) if name not in rows.kinds]:
        raise InputError(f"{rows.place}: expected the column {missing[0]}, found none; {AGAIN}")
    if rows.where or not rowless:
        _check(rows, experiment)
    counts = results.known.groupby(["log", "configuration"])["runs"].sum()
    if counts.to_dict() != rows.counts:
        expected, found = sum(rows.counts.values()), int(counts.sum())
        raise InputError(
            f"{results.folder}/tally.parquet: expected the {expected} rows of detections.parquet counted, found "
            f"{found}; {AGAIN}"
        )
    expected, found = len(results.experiment.logs), len(results.provenance.logs)
    if expected != found:
        raise InputError(
            f"{results.folder}/{MARK}: expected {expected} logs as in experiment.yaml, found {found}; {AGAIN}"
        )
    for name in ("summary", "exact", "sweep"):
        getattr(results, name)
    return results


def _columns(experiment: Experiment) -> tuple[str, ...]:
    """Columns that `detections.parquet` has to have."""
    conflict = experiment.measure.conflict
    return tuple(ROWS | (BRAKING if experiment.braking else {}) | (CONFLICT if conflict else {}))


def _check(rows: LogRows, experiment: Experiment) -> None:
    """Raise InputError where the rows are of another experiment, are not all there, or there are none."""
    unknown = [name for name in rows.configurations if name not in experiment.configurations]
    if unknown:
        raise InputError(f"{rows.place}: expected the configurations of experiment.yaml, found {unknown[0]!r}; {AGAIN}")
    if not rows.where:
        raise InputError(f"{rows.place}: expected rows to draw, found none: no measured object has an onset")
    # A configuration that has none of its units in a log is left out of that log.
    counts = [*rows.counts.values(), *[0] * (set(experiment.configurations) != set(rows.configurations))]
    of_log: dict[str, set[int]] = {}
    for (log, _), count in rows.counts.items():
        of_log.setdefault(log, set()).add(count)
    if 0 in counts or any(len(of) > 1 for of in of_log.values()):
        raise InputError(
            f"{rows.place}: expected as many rows of each configuration, found {min(counts)} to {max(counts)}; {AGAIN}"
        )


def _knows_ids(configuration: dict[str, Any]) -> bool:
    """Whether a configuration needs no match with the truth to know an object."""
    fusion = configuration.get("fusion")
    if configuration.get("recorded"):
        return False
    return fusion is None or bool(fusion.get("kind", "ideal") == "ideal")

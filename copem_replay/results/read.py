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
    VERDICTS,
    file_of,
    read_csv,
    read_frame,
)

if TYPE_CHECKING:
    import pyarrow as pa


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
        """`detections.parquet`."""
        experiment = self.experiment
        columns = ROWS + (BRAKING if experiment.braking else ()) + (CONFLICT if experiment.measure.conflict else ())
        return self._frame("detections.parquet", columns)

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
        place = self.folder / "detections.parquet"
        columns = DETECTIONS | (VERDICTS if self.provenance.braking is not None else {})
        tables = {place.name: log_rows(place, columns, self._files(place))}
        found = tables[place.name].where
        if not found:
            raise InputError(f"{self.folder}: nothing can be compared: no measured object has an onset")
        if unknown := set(found) - {log.name for log in self.provenance.logs}:
            raise InputError(f"{place}: expected the logs of provenance.json, found {min(unknown)!r}")
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
        if not (folder / name).is_file() and not (name == "detections.parquet" and (folder / name).is_dir()):
            raise InputError(
                f"{folder}: expected a results folder, found no {name} in it; `copem-replay run` writes one"
            )


def load_results(folder: Path | str, *, rowless: bool = False) -> Results:
    """Read a results folder whole, without rows only if `rowless`.

    Raises InputError, one line: no such folder, no results, or damaged ones.
    """
    return complete(open_results(folder, "summary.csv"), rowless=rowless)


def complete(results: Results, *, rowless: bool = False) -> Results:
    """The same, with every table read and held against the experiment. Raises InputError."""
    _check_there(results.folder, "summary.csv")
    if len(results.table) or not rowless:
        _check(results.folder, results.table, results.experiment)
    expected, found = len(results.experiment.logs), len(results.provenance.logs)
    if expected != found:
        raise InputError(
            f"{results.folder}/{MARK}: expected {expected} logs as in experiment.yaml, found {found}; {AGAIN}"
        )
    for name in ("summary", "exact", "sweep"):
        getattr(results, name)
    return results


def _check(folder: Path, table: pd.DataFrame, experiment: Experiment) -> None:
    """Raise InputError where the rows are of another experiment, are not all there, or there are none."""
    place = folder / "detections.parquet"
    unknown = [name for name in table["configuration"].unique() if name not in experiment.configurations]
    if unknown:
        raise InputError(f"{place}: expected the configurations of experiment.yaml, found {unknown[0]!r}; {AGAIN}")
    if not len(table):
        raise InputError(f"{place}: expected rows to draw, found none: no measured object has an onset")
    # A configuration that has none of its units in a log is left out of that log.
    counts = [int(n) for n in table.groupby(["log", "configuration"], sort=False).size()]
    counts += [0] * (set(experiment.configurations) != set(table["configuration"]))
    of_log = table.groupby(["log", "configuration"], sort=False).size().groupby("log").agg(["min", "max"])
    if 0 in counts or (of_log["min"] != of_log["max"]).any():
        raise InputError(
            f"{place}: expected as many rows of each configuration, found {min(counts)} to {max(counts)}; {AGAIN}"
        )


def _knows_ids(configuration: dict[str, Any]) -> bool:
    """Whether a configuration needs no match with the truth to know an object."""
    fusion = configuration.get("fusion")
    if configuration.get("recorded"):
        return False
    return fusion is None or bool(fusion.get("kind", "ideal") == "ideal")

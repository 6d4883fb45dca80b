"""Results: what a run gave, read from its folder, for figures, reports, recordings and comparisons.

What `cr.run` gives is in a scratch folder until it is saved, and read from there: there is one way to results.

Comparisons read log by log (`results/table_files.py`): of a table of any size only the rows of one log are in memory.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd

from copem_replay.core.errors import (
    ExperimentError,
    InputError,
    OutputError,
    RemoteFile,
    count_noun,
    is_url,
)
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.experiment.file import (
    ExperimentSource,
    parse_experiment,
    read_experiment_file,
    settings_places,
)
from copem_replay.experiment.schema import Experiment
from copem_replay.io.open import Place
from copem_replay.io.recording import Recording
from copem_replay.metrics.columns import COMPARED_FILES, TABLES
from copem_replay.metrics.limits import find_clusters
from copem_replay.metrics.onset import COUNTS_BY, select_counted
from copem_replay.metrics.summary import DETECTED
from copem_replay.results.folder import EXPERIMENT, MARK, check_inputs, check_unchanged, read_made, take_place
from copem_replay.results.provenance import (
    Provenance,
    read_provenance,
    reread_recording,
)
from copem_replay.results.seals import check_sealed
from copem_replay.results.table_files import (
    AGAIN,
    LogRows,
    check_columns,
    check_configurations,
    read_csv,
    read_frame,
    read_log_rows,
    read_parquet,
    table_file,
)

if TYPE_CHECKING:
    import pyarrow as pa

    from copem_replay.pipeline.expansion import ConfigurationFacts
    from copem_replay.pipeline.run import StudyTables
    from copem_replay.results.write import Exporter


_MAY_BE_FOLDERS = ("detections.parquet", "tally.parquet")
_NUMBERS = itertools.count(1)


@dataclass(eq=False, repr=False)
class Results:
    """What an experiment gave, read from a folder, which `run` makes too: pandas tables, as a results folder has them.

    `detections`: a row per log, configuration, run and measured object; of many rows `each` gives those of a log at a
    time. `summary`: a row per configuration. `summary_by`, `exact`, `sweep`, `accuracy`, `bands`: None where the
    experiment does not ask for them. Times are in seconds (`_s`), distances in metres (`_m`); missing values are null.
    What columns mean: docs/reference/columns.md. A file of a folder is read when it is first used, which raises
    InputError where it is damaged, or where other results have taken the place of the folder.

    >>> result = cr.run({"version": 1, "configurations": {"GT": {"units": "truth"}}}, "logs/tc016d.mcap")
    >>> result.detections.shape[0], result.exact is None
    (7, True)
    >>> results = cr.load_results("out/tc016d")
    >>> results.name, results.experiment.runs, results.sweep is None
    ('tc016d', 500, True)
    """

    folder: Path | None = None
    """The results folder; None: they are not saved."""
    study: StudyTables | None = None
    """What was run, to be saved; None: they were read."""
    exporters: Callable[[str | None], Sequence[Exporter]] = lambda _: ()
    """How single runs are written, by the address of a Rerun viewer that also gets them."""

    def __post_init__(self) -> None:
        self._called = self.folder or Path(f"run {next(_NUMBERS)}")
        self._read_last: tuple[tuple[str, Experiment], Recording] | None = None
        if self.study is not None:
            self.__dict__["experiment"] = self.study.experiment  # with components of classes that no name leads to
        else:
            self._read_from(self._called)
            self.__dict__["provenance"] = read_provenance(self._called / MARK)

    def _read_from(self, folder: Path) -> None:
        self.__dict__["_files_at"], self._seen = folder, os.stat(folder)

    def __repr__(self) -> str:
        logs, runs = count_noun(len(self.provenance.logs), "log"), count_noun(self.provenance.runs, "run")
        of = count_noun(len(self.facts), "configuration")
        return f"Results({of}, {runs}, {logs}, {self.folder or 'not saved'})"

    @property
    def place(self) -> Path:
        """The folder, or the name for unsaved results in messages."""
        return self.folder or self._called

    @property
    def name(self) -> str:
        """The name of the folder, also where it is given as `.`."""
        return self.place.resolve().name

    @cached_property
    def _files_at(self) -> Path:
        """The folder that files are read from; of a run that is not saved one that goes with it, made when needed."""
        from copem_replay.results.write import make_scratch_results

        assert self.study is not None
        self._read_from(folder := make_scratch_results(self.study))
        return folder

    @cached_property
    def provenance(self) -> Provenance:
        """Versions, logs, seed, metric parameters."""
        return read_provenance(self._files_at / MARK)

    @cached_property
    def source(self) -> ExperimentSource:
        """The experiment of the results as plain data, checked against damage (InputError)."""
        self._check_sealed(EXPERIMENT)
        file = self._files_at / EXPERIMENT
        try:
            source = read_experiment_file(file)
        except ExperimentError as error:
            why = error.problems[0].removeprefix(f"{file}:").strip()
            raise InputError(f"{file}: expected the experiment of the results, found damage: {why}; {AGAIN}") from None
        self.check_unchanged()
        return source

    @cached_property
    def experiment(self) -> Experiment:
        """The experiment, with components of the user's own."""
        experiment, problems = parse_experiment(self.source)
        if experiment is None or problems:
            raise InputError(problems)
        return experiment

    def check_unchanged(self) -> None:
        """Raise InputError where other results have taken the place of the folder."""
        check_unchanged(self._files_at, self._seen)

    # Tables, by the names of their files.

    def has(self, name: str) -> bool:
        """Whether there is a table, by the name of its file."""
        return _exists(self._files_at, name)

    def frame(self, name: str) -> pd.DataFrame:
        """A whole table, by the name of its file. Raises InputError where it is damaged."""
        self._check_sealed(name)
        reader = read_csv if name.endswith(".csv") else partial(read_parquet, files=self._files(name))
        table = read_frame(self._files_at / name, reader, self.provenance.kinds(name))
        self.check_unchanged()
        return table

    def log_rows(self, name: str) -> LogRows:
        """A table log by log, which has at least the columns that comparisons read. Raises InputError."""
        self._check_sealed(name)
        rows = read_log_rows(self._files_at / name, self.provenance.kinds(name, compared=True), self._files(name))
        self.check_unchanged()
        return rows

    def check_made(self, name: str, again: str) -> None:
        """Raise InputError where what a command made of the results is not what it wrote. `again`: how to make it."""
        check_sealed(self._files_at, name, read_made(self._files_at), again)

    def _check_sealed(self, name: str) -> None:
        """Raise InputError where a file is not what was written, or other results have taken its place."""
        try:
            check_sealed(self._files_at, name, self.provenance.seals)
        except InputError:
            self.check_unchanged()
            raise

    def _files(self, name: str) -> list[Path]:
        """The files of a table that is a folder, in the order of the logs; empty: the table is a file."""
        if not (self._files_at / name).is_dir():
            return []
        files = (table_file(self._files_at / name, log.name) for log in self.provenance.logs)
        return [file for file in files if file.is_file()]

    def require_folder(self) -> Path:
        """The results folder. Raises InputError for results that are not saved."""
        if self.folder is None:
            raise InputError("expected results in a folder, found some that are not saved; result.save(folder) does")
        return self.folder

    def save(self, folder: str | PathLike[str], overwrite: bool = False) -> Path:
        """Write the results folder, complete or not at all. Returns its path.

        Raises OutputError: the folder holds something already (`overwrite` replaces results), or is not writable; also
        where a replay could not be written, and all other results are there. InputError: they were read from a folder.

        >>> result.save("out/example", overwrite=True).name
        'example'
        """
        from copem_replay.results.write import check_own_files, fill_place

        if (study := self.study) is None:
            raise InputError(
                f"{self.place}: expected results of a run to save, found some that were read from a folder"
            )
        exporters = self.exporters(None)
        with take_place(Path(folder), overwrite=overwrite) as place:
            check_inputs(place, [path for recording in study.recordings for path in recording.paths])
            check_own_files(place, study.experiment, study.recordings, exporters)
            fill_place(place, study, exporters=exporters)
            self.folder = place.shown
            self._read_from(place.folder)
            vars(self).pop("provenance", None)
        if place.failed:
            raise OutputError(place.failed)
        return place.shown

    @cached_property
    def rows(self) -> LogRows:
        """`detections.parquet`, log by log."""
        return self.log_rows("detections.parquet")

    def each(self, *columns: str, log: str | None = None, every: bool = False) -> Iterator[pd.DataFrame]:
        """Rows that count, or `every` row, log by log or of one log; with `columns`, none named: all but `log`."""
        columns = columns or tuple(name for name in self.rows.without_rows.column_names if name != "log")
        rows = self.rows.only(dict.fromkeys((*columns, *COUNTS_BY)))
        for name_of_log in self.rows.logs if log is None else [log]:
            table = rows.of(name_of_log)
            self.check_unchanged()
            frame = table.to_pandas()
            counted = frame if every else self.counted(frame)
            yield counted[[name for name in columns if name in counted]]

    def counted(self, rows: pd.DataFrame) -> pd.DataFrame:
        """The rows that count for times, shares and distances at detection (`measure.began`)."""
        return select_counted(rows, self.provenance.measure["began"])

    @cached_property
    def tally(self) -> pd.DataFrame:
        """`tally.parquet`, which counts the rows of `detections.parquet`. Raises InputError where it counts others."""
        tally = self.frame("tally.parquet")
        of = tally[tally["event"] == DETECTED]
        if (counts := of.groupby(["log", "configuration"])["runs"].sum()).to_dict() != self.rows.counts:
            raise InputError(
                f"{self.place}/tally.parquet: expected the {sum(self.rows.counts.values())} rows of "
                f"detections.parquet counted, found {int(counts.sum())}; {AGAIN}"
            )
        return tally

    @cached_property
    def known(self) -> pd.DataFrame:
        """The tally of detections that count; for a single object a row per run, as runs are then the clusters."""
        tally = self.counted(self.tally[self.tally["event"] == DETECTED])
        clusters = find_clusters(tally)
        if clusters is None or not clusters.by_run:
            return tally
        columns = [name for name in TABLES["tally.parquet"].kinds() if name not in ("log", "event", "runs")]
        (rows,) = self.each(*columns, "run", log=str(tally["log"].iloc[0]))
        return rows.assign(log=tally["log"].iloc[0], runs=1)

    @cached_property
    def summary(self) -> pd.DataFrame:
        """`summary.csv`."""
        return self.frame("summary.csv")

    @cached_property
    def summary_by(self) -> pd.DataFrame | None:
        """`summary_by.csv`; None: there is no such file."""
        return self._optional("summary_by.csv")

    @cached_property
    def exact(self) -> pd.DataFrame | None:
        """`exact.parquet`; None: there is no such file."""
        return self._optional("exact.parquet")

    @cached_property
    def sweep(self) -> pd.DataFrame | None:
        """`sweep.csv`; None: there is no such file."""
        return self._optional("sweep.csv")

    @cached_property
    def detections(self) -> pd.DataFrame:
        """A row per log, configuration, run and measured object; figures take `known` or `each`, which hold less."""
        return self.frame("detections.parquet")

    @cached_property
    def accuracy(self) -> pd.DataFrame | None:
        """Position errors and parts of GOSPA, list by list, in the order of `detections`; None: not measured."""
        return self._optional("accuracy.parquet")

    @cached_property
    def bands(self) -> pd.DataFrame | None:
        """Accuracy by configuration and by distance, time or existence; None: not measured."""
        return self._optional("bands.csv")

    @property
    def facts(self) -> dict[str, ConfigurationFacts]:
        """What each configuration is."""
        return self.provenance.facts

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on the recordings and the runs, a line each."""
        notes = self.provenance.data.get("notes", [])
        return tuple(map(str, notes)) if isinstance(notes, list) else ()

    @cached_property
    def by_log(self) -> Mapping[str, LogRows]:
        """By file name, the folder's tables that comparisons read. Raises InputError: no rows, or unknown names."""
        rows = self.rows
        if not rows.counts:
            raise InputError(f"{self.place}: nothing can be compared: no measured object has an onset")
        logs = {log.name for log in self.provenance.logs}
        for noun, unknown in (
            ("logs", set(rows.logs) - logs),
            ("configurations", set(rows.configurations) - self.facts.keys()),
        ):
            if unknown:
                raise InputError(f"{rows.place}: expected the {noun} of provenance.json, found {min(unknown)!r}")
        names = [rows.place.name, *filter(self.has, COMPARED_FILES)]
        kinds = {name: TABLES[name].kinds("braking", "fleet", "needless", compared=True) for name in names}
        return {name: (rows if name == rows.place.name else self.log_rows(name)).only(kinds[name]) for name in names}

    def rows_of(self, log: str, names: Collection[str] | None = None) -> dict[str, pa.Table]:
        """A log's rows of the named tables (None: all) of those that comparisons read."""
        tables = {name: self.by_log[name].of(log) for name in self.by_log if names is None or name in names}
        self.check_unchanged()
        return tables

    def log_place(self, log: str) -> Place:
        """The place where the recording of a log, or the several that it is made of, are expected."""
        base = self.place if self.study is None else Path()
        number = [file.name for file in self.provenance.logs].index(log)
        entry = self.experiment.logs[number]
        if isinstance(entry, str):
            return RemoteFile(entry) if is_url(entry) else base / entry
        return settings_places(self.experiment.logs, number, base)[0]

    def recording(self, log: str, experiment: Experiment) -> Recording:
        """The recording of a log, read again for `experiment` (this one, or one made of it); the last one is cached.

        Raises RecordingError where it is missing or not the replayed one, InputError where rows name unknown objects.
        """
        if self.study is not None:
            return self.study.find_log(log).whole()
        key = (log, resolve_for_log(experiment, log))
        if self._read_last is None or self._read_last[0] != key:
            (recorded,) = (one for one in self.provenance.logs if one.name == log)
            recording = reread_recording(recorded, self.log_place(log), key[1])
            self._check_objects(log, recording)
            self._read_last = key, recording
        return self._read_last[1]

    def _check_objects(self, log: str, recording: Recording) -> None:
        """Raise InputError where rows of a log name objects that its recording does not have."""
        (rows,) = self.each("object_id", log=log, every=True)
        named = {"detections.parquet": rows["object_id"]}
        if self.has("tally.parquet"):
            named["tally.parquet"] = self.tally.loc[self.tally["log"] == log, "object_id"]
        for name, objects in named.items():
            if unknown := set(objects.unique()) - recording.scene.object_number.keys():
                raise InputError(
                    f"{self.place}/{name}: expected objects of the recording {log}, found {min(unknown)!r}; {AGAIN}"
                )

    def chosen(self, configurations: Sequence[str] | None) -> tuple[str, ...]:
        """The configurations to draw, each once; None: all. Raises InputError for a name that is not there."""
        known = tuple(self.experiment.configurations)
        for name in configurations or ():
            if name not in known:
                raise InputError(f"{self.place}: configurations: expected some of {', '.join(known)}, found {name!r}")
        return tuple(dict.fromkeys(configurations)) if configurations else known

    def _optional(self, name: str) -> pd.DataFrame | None:
        return self.frame(name) if self.has(name) else None


def open_results(folder: Path | str, *more: str) -> Results:
    """A results folder of which only the provenance is read yet.

    `more`: files that have to exist besides those that every comparison needs. Raises InputError, one line: no such
    folder, no results, or a damaged provenance.
    """
    folder = Path(folder)
    if not folder.is_dir():
        found = "a file" if folder.exists() else "no such folder"
        raise InputError(f"{folder}: expected a results folder, found {found}; `copem-replay run` writes one")
    _check_exists(folder, MARK, "experiment.yaml", "detections.parquet", *more)
    return Results(folder)


def _exists(folder: Path, name: str) -> bool:
    return (folder / name).is_file() or (name in _MAY_BE_FOLDERS and (folder / name).is_dir())


def _check_exists(folder: Path, *names: str) -> None:
    for name in (name for name in names if not _exists(folder, name)):
        raise InputError(f"{folder}: expected a results folder, found no {name} in it; `copem-replay run` writes one")


def read_results(folder: Path | str, *, rowless: bool = False) -> Results:
    """A results folder, checked; one without rows only if `rowless`.

    Raises InputError, one line: no such folder, no results, or damaged ones.
    """
    return check_complete(open_results(folder, "summary.csv"), rowless=rowless)


def check_complete(results: Results, *, rowless: bool = False) -> Results:
    """The results, with rows checked against the experiment and every other table read. Raises InputError."""
    _check_exists(results.place, "summary.csv", "tally.parquet")
    experiment, rows = results.experiment, results.rows
    check_columns(rows.place, results.provenance.kinds(rows.place.name), rows.kinds)
    if rows.counts or not rowless:
        check_configurations(rows, experiment.configurations)
    for noun, expected, actual in (
        ("logs", len(experiment.logs), len(results.provenance.logs)),
        ("configurations", len(experiment.configurations), len(experiment.configurations.keys() & results.facts)),
    ):
        if expected != actual:
            raise InputError(
                f"{results.place}/{MARK}: expected {expected} {noun} as in experiment.yaml, found {actual}; {AGAIN}"
            )
    for name in ("tally", "summary", "summary_by", "exact", "sweep"):
        getattr(results, name)
    return results

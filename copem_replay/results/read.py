"""Results: what a run gave, in memory or read back from its folder, for figures, reports, recordings and comparisons.

Comparisons read log by log (`results/log_rows.py`): of a table of any size only the rows of one log are in memory.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from copem_replay.core.errors import (
    ExperimentError,
    InputError,
    OutputError,
    RecordingError,
    RemoteFile,
    count_noun,
    is_url,
)
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.experiment.file import (
    ExperimentSource,
    make_plain_source,
    parse_experiment,
    read_experiment_file,
    settings_places,
)
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import read_logs
from copem_replay.io.open import File, Place, fetch_place, first_recording, read_file_stamps, sha256_of
from copem_replay.io.recording import Recording
from copem_replay.metrics.config import Objects
from copem_replay.metrics.intervals import choose_clusters
from copem_replay.metrics.onset import COUNTS_BY, select_counted
from copem_replay.metrics.summary import DETECTED
from copem_replay.pipeline.prepare import Replay, prepare_log
from copem_replay.pipeline.study_log import read_content_digest
from copem_replay.pipeline.sweep import resolve_sweep
from copem_replay.results.folder import EXPERIMENT, MARK, check_inputs, check_unchanged, take_place
from copem_replay.results.log_rows import LogRows, count_rows, find_stretches, log_rows
from copem_replay.results.schema import (
    AGAIN,
    COMPARED_FILES,
    TABLES,
    Provenance,
    check_columns,
    parse_provenance,
    read_csv,
    read_frame,
    read_provenance,
    table_file,
)

if TYPE_CHECKING:
    import pyarrow as pa

    from copem_replay.pipeline.expansion import ConfigurationFacts
    from copem_replay.pipeline.run import ExperimentResult
    from copem_replay.results.folder import ResultsPlace
    from copem_replay.results.schema import RecordedLog
    from copem_replay.results.write import Exporter


# Where tables come from: a folder, or a run that is in memory.

_MAY_BE_FOLDERS = ("detections.parquet", "tally.parquet")


class FolderTables:
    """The tables of a results folder, by the names of their files; paths in its experiment are relative to `base`.

    A table is read when it is asked for. Raises InputError where it is damaged, or where other results have taken the
    place of the folder.
    """

    def __init__(self, place: Path) -> None:
        self.place, self.base, self._seen = place, place, os.stat(place)
        self.provenance = read_provenance(place / MARK)

    @cached_property
    def source(self) -> ExperimentSource:
        """`experiment.yaml` as plain data."""
        file = self.place / EXPERIMENT
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
        check_unchanged(self.place, self._seen)

    def has(self, name: str) -> bool:
        """Whether there is such a table."""
        return (self.place / name).is_file() or (name in _MAY_BE_FOLDERS and (self.place / name).is_dir())

    def kinds(self, name: str, *, compared: bool = False) -> dict[str, str]:
        """Kinds of the columns that a table has to have, all or only those that comparisons read."""
        asked = {"braking": self.provenance.braking, "conflict": self.provenance.measure["conflict"]}
        return TABLES[name].kinds(*(key for key, of in asked.items() if of is not None), compared=compared)

    def frame(self, name: str) -> pd.DataFrame:
        """A whole table."""

        def as_frame(place: Path) -> pd.DataFrame:
            from pyarrow import parquet

            table = parquet.read_table(self._files(place) or place).replace_schema_metadata(None)
            # Column by column, so that no column is in memory twice.
            return table.to_pandas(split_blocks=True, self_destruct=True)

        table = read_frame(self.place / name, read_csv if name.endswith(".csv") else as_frame, self.kinds(name))
        self.check_unchanged()
        return table

    def rows(self, name: str) -> LogRows:
        """A table log by log, which has at least the columns that comparisons read."""
        rows = log_rows(self.place / name, self.kinds(name, compared=True), self._files(self.place / name))
        self.check_unchanged()
        return rows

    def _files(self, place: Path) -> list[Path]:
        """The files of a table that is a folder, in the order of the logs; empty: the table is a file."""
        if not place.is_dir():
            return []
        return [path for log in self.provenance.logs if (path := table_file(place, log.name)).is_file()]


_NUMBERS = itertools.count(1)


class RunTables:
    """The tables of a run that is in memory, by the names that their files have. `place`: what it is called."""

    def __init__(self, experiment: Experiment, recordings: tuple[Recording, ...], replayed: ExperimentResult) -> None:
        self.experiment, self.recordings, self.replayed = experiment, recordings, replayed
        self.place, self.base = Path(f"run {next(_NUMBERS)}"), Path()

    @cached_property
    def provenance(self) -> Provenance:
        """What `provenance.json` says once it is written."""
        from copem_replay.results.write import build_provenance

        data = build_provenance(self.experiment, self.recordings, self.replayed, (), self.replayed.notes)
        return parse_provenance(data, self.place)

    @cached_property
    def source(self) -> ExperimentSource:
        """The experiment as plain data."""
        return make_plain_source(resolve_sweep(self.experiment).as_written())

    def check_unchanged(self) -> None:
        """Nothing can take its place."""

    def has(self, name: str) -> bool:
        """Whether there is such a table."""
        return self._table(name) is not None

    def frame(self, name: str) -> pd.DataFrame:
        """A whole table."""
        table = self._table(name)
        return table if isinstance(table, pd.DataFrame) else table.to_pandas()

    def rows(self, name: str) -> LogRows:
        """A table log by log."""
        import pyarrow as pa

        table = self._table(name)
        if isinstance(table, pd.DataFrame):
            table = pa.Table.from_pandas(table, preserve_index=False)
        table = table.replace_schema_metadata(None)
        kinds = {column.name: column.kind for column in TABLES[name].columns if column.name in table.column_names}

        where: dict[str, list[pa.Table]] = {}
        for log, begin, end in find_stretches(table["log"].combine_chunks()) if len(table) else ():
            where.setdefault(log, []).append(table.slice(begin, end - begin))

        def read(log: str, columns: Sequence[str]) -> list[pa.Table]:
            return [rows.select(columns) for rows in where.get(log, ())]

        return LogRows(self.place / name, kinds, count_rows(table), table.schema.empty_table(), read)

    def _table(self, name: str) -> Any:
        """A table of pandas or Arrow; None: there is none."""
        stem = name.partition(".")[0]
        if name in COMPARED_FILES:
            return getattr(self.replayed.accuracy, stem, None)
        return self.replayed.table if stem == "detections" else getattr(self.replayed, stem)

    def recording(self, log: str) -> Recording:
        """The recording of a log."""
        return next(of_log for of_log in self.replayed.logs if of_log.name == log).whole()


@dataclass(eq=False, repr=False)
class Results:
    """What an experiment gave, just computed or read from a folder: pandas tables, as a results folder has them.

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

    tables: FolderTables | RunTables
    folder: Path | None = None
    """The results folder; None: they are not saved."""
    exporters: Callable[[str | None], Sequence[Exporter]] | None = None
    """How single runs are written, by the address of a Rerun viewer that also gets them; None: they are written."""

    def __repr__(self) -> str:
        logs, runs = count_noun(len(self.provenance.logs), "log"), count_noun(self.provenance.runs, "run")
        of = count_noun(len(self.facts), "configuration")
        return f"Results({of}, {runs}, {logs}, {self.folder or 'not saved'})"

    @property
    def place(self) -> Path:
        """The folder, or what results that are not saved are called in messages."""
        return self.folder or self.tables.place

    @property
    def name(self) -> str:
        """The name of the folder, also where it is given as `.`."""
        return self.place.resolve().name

    @property
    def provenance(self) -> Provenance:
        """Versions, logs, seed, metric parameters."""
        return self.tables.provenance

    @property
    def source(self) -> ExperimentSource:
        """The experiment as plain data."""
        return self.tables.source

    @property
    def experiment(self) -> Experiment:
        """The experiment, with components of the user's own."""
        return self.tables.experiment

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """The recordings that were replayed; none of results that were read."""
        return self.tables.recordings if isinstance(self.tables, RunTables) else ()

    @property
    def replayed(self) -> ExperimentResult | None:
        """What the pipeline gave; None of results that were read."""
        return self.tables.replayed if isinstance(self.tables, RunTables) else None

    def check_unchanged(self) -> None:
        """Raise InputError where other results have taken the place of the folder."""
        self.tables.check_unchanged()

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
        from copem_replay.results.write import check_own_files

        exporters = self._list_exporters()
        with take_place(Path(folder), overwrite=overwrite) as place:
            check_inputs(place, [path for recording in self.recordings for path in recording.paths])
            check_own_files(place, self.experiment, self.recordings, exporters)
            self.fill(place)
        if place.failed:
            raise OutputError(place.failed)
        return place.shown

    def fill(
        self,
        place: ResultsPlace,
        *,
        skipped: Sequence[tuple[File, str]] = (),
        viewer: str | None = None,
        label: str | None = None,
    ) -> list[str]:
        """Write the results into a place that is locked. Returns notes, one line each.

        `skipped`: logs that were left out, with reasons. `viewer`: address of a Rerun viewer that also gets the
        recordings. `label`: what the results are called in a history. Raises InputError where the results were read
        from a folder.
        """
        from copem_replay.results.write import fill_place

        exporters = self._list_exporters(viewer)
        assert self.replayed is not None
        notes = fill_place(
            place,
            self.experiment,
            self.recordings,
            self.replayed,
            exporters=exporters,
            skipped=skipped,
            label=label,
        )
        self.folder = place.shown
        return notes

    def _list_exporters(self, viewer: str | None = None) -> Sequence[Exporter]:
        if self.replayed is None or self.exporters is None:
            raise InputError(
                f"{self.place}: expected results of a run to save, found some that were read from a folder"
            )
        return self.exporters(viewer)

    @cached_property
    def table(self) -> pd.DataFrame:
        """`detections.parquet` as a whole, for users; figures take `known` or `each`, which hold less in memory."""
        return self._frame("detections.parquet")

    @cached_property
    def rows(self) -> LogRows:
        """`detections.parquet`, log by log."""
        return self.tables.rows("detections.parquet")

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
        """`tally.parquet`."""
        return self._frame("tally.parquet")

    @cached_property
    def known(self) -> pd.DataFrame:
        """The tally of detections that count; for a single object a row per run, as runs are then the clusters."""
        tally = self.counted(self.tally[self.tally["event"] == DETECTED])
        if not len(tally) or choose_clusters(tally)[0] != "runs":
            return tally
        columns = [name for name in TABLES["tally.parquet"].kinds() if name not in ("log", "event", "runs")]
        (rows,) = self.each(*columns, "run", log=str(tally["log"].iloc[0]))
        return rows.assign(log=tally["log"].iloc[0], runs=1)

    @cached_property
    def summary(self) -> pd.DataFrame:
        """`summary.csv`."""
        return self._frame("summary.csv")

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

    @property
    def detections(self) -> pd.DataFrame:
        """A row per log, configuration, run and measured object."""
        return self.table

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
    def by_log(self) -> dict[str, LogRows]:
        """By file name the tables that comparisons read, those that exist."""
        rows = self.rows
        if not rows.counts:
            raise InputError(f"{self.place}: nothing can be compared: no measured object has an onset")
        logs = {log.name for log in self.provenance.logs}
        for what, unknown in (
            ("logs", set(rows.logs) - logs),
            ("configurations", set(rows.configurations) - self.facts.keys()),
        ):
            if unknown:
                raise InputError(f"{rows.place}: expected the {what} of provenance.json, found {min(unknown)!r}")
        tables = {rows.place.name: rows} | {n: self.tables.rows(n) for n in COMPARED_FILES if self.tables.has(n)}
        return {name: of.only(TABLES[name].kinds("braking", "fleet", compared=True)) for name, of in tables.items()}

    def rows_of(self, log: str, *names: str) -> dict[str, pa.Table]:
        """A log's rows of the named tables, by default of all that comparisons read."""
        tables = {name: rows.of(log) for name, rows in self.by_log.items() if not names or name in names}
        self.check_unchanged()
        return tables

    def log_place(self, log: str) -> Place:
        """The place where the recording of a log, or the several that it is made of, are expected."""
        entry = self.experiment.logs[[file.name for file in self.provenance.logs].index(log)]
        if isinstance(entry, str):
            return RemoteFile(entry) if is_url(entry) else self.tables.base / entry
        return settings_places(entry, self.tables.base)[0]

    def log_path(self, log: str) -> File:
        """The file where the recording of a log, or the first of several, is expected."""
        return first_recording(self.log_place(log))

    def chosen(self, configurations: Sequence[str] | None) -> tuple[str, ...]:
        """The configurations to draw, each once; None: all. Raises InputError for a name that is not there."""
        known = tuple(self.experiment.configurations)
        for name in configurations or ():
            if name not in known:
                raise InputError(f"{self.place}: configurations: expected some of {', '.join(known)}, found {name!r}")
        return tuple(dict.fromkeys(configurations)) if configurations else known

    def _optional(self, name: str) -> pd.DataFrame | None:
        return self._frame(name) if self.tables.has(name) else None

    def _frame(self, name: str) -> pd.DataFrame:
        return self.tables.frame(name)


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
    return Results(FolderTables(folder), folder)


def _check_exists(folder: Path, *names: str) -> None:
    for name in names:
        if not (folder / name).is_file() and not (name in _MAY_BE_FOLDERS and (folder / name).is_dir()):
            raise InputError(
                f"{folder}: expected a results folder, found no {name} in it; `copem-replay run` writes one"
            )


def read_results(folder: Path | str, *, rowless: bool = False) -> Results:
    """A results folder, checked; one without rows only if `rowless`.

    Raises InputError, one line: no such folder, no results, or damaged ones.
    """
    return check_complete(open_results(folder, "summary.csv"), rowless=rowless)


def check_complete(results: Results, *, rowless: bool = False) -> Results:
    """The results, with rows checked against the experiment and every other table read. Raises InputError."""
    if isinstance(results.tables, RunTables):
        return results
    _check_exists(results.place, "summary.csv", "tally.parquet")
    experiment, rows = results.experiment, results.rows
    check_columns(rows.place, results.tables.kinds(rows.place.name), rows.kinds)
    if rows.counts or not rowless:
        _check_rows(rows, experiment)
    tally = results.tally[results.tally["event"] == DETECTED]
    counts = tally.groupby(["log", "configuration"])["runs"].sum()
    if counts.to_dict() != rows.counts:
        expected, found = sum(rows.counts.values()), int(counts.sum())
        raise InputError(
            f"{results.place}/tally.parquet: expected the {expected} rows of detections.parquet counted, found "
            f"{found}; {AGAIN}"
        )
    for what, expected, found in (
        ("logs", len(experiment.logs), len(results.provenance.logs)),
        ("configurations", len(experiment.configurations), len(experiment.configurations.keys() & results.facts)),
    ):
        if expected != found:
            raise InputError(
                f"{results.place}/{MARK}: expected {expected} {what} as in experiment.yaml, found {found}; {AGAIN}"
            )
    for name in ("summary", "summary_by", "exact", "sweep"):
        getattr(results, name)
    return results


def _check_rows(rows: LogRows, experiment: Experiment) -> None:
    """Raise InputError where rows are of another experiment or missing, or where there are none."""
    unknown = [name for name in rows.configurations if name not in experiment.configurations]
    if unknown:
        raise InputError(f"{rows.place}: expected the configurations of experiment.yaml, found {unknown[0]!r}; {AGAIN}")
    if not rows.counts:
        raise InputError(f"{rows.place}: expected rows to draw, found none: no measured object has an onset")
    # A configuration that has none of its units in a log is left out of that log.
    counts = [*rows.counts.values(), *[0] * (set(experiment.configurations) != set(rows.configurations))]
    counts_of: dict[str, set[int]] = {}
    for (log, _), count in rows.counts.items():
        counts_of.setdefault(log, set()).add(count)
    if 0 in counts or any(len(sizes) > 1 for sizes in counts_of.values()):
        raise InputError(
            f"{rows.place}: expected as many rows of each configuration, found {min(counts)} to {max(counts)}; {AGAIN}"
        )


# Logs, read again: figures of single runs need the recording, which a results folder names but does not hold.


def reread_log(results: Results, log: str, object_id: str) -> Replay:
    """One log, prepared again for replay with one measured object only.

    Raises RecordingError, one line, where the recording is missing or not the one that was replayed, or has no ego.
    """
    of_log = resolve_for_log(results.experiment, log)
    measure = of_log.measure.model_copy(update={"objects": Objects(ids=(object_id,))})
    experiment = of_log.model_copy(update={"measure": measure})
    recording = reread_recording(results, log, experiment)
    if recording.scene.ego_ix < 0:
        raise RecordingError("no ego in this study, whose runs could be drawn", path=recording.path)
    return prepare_log(recording, experiment)


def reread_recording(results: Results, log: str, experiment: Experiment) -> Recording:
    """The recording of a log of the results, read again as an experiment, theirs or one made of it, has it.

    Raises RecordingError, one line, where the recording is missing or not the one that was replayed.
    """
    if isinstance(results.tables, RunTables):
        return results.tables.recording(log)
    file = next(file for file in results.provenance.logs if file.name == log)
    path, place = results.log_path(log), results.log_place(log)
    try:
        with fetch_place(place) as here:
            stamps, digest = read_file_stamps(here), sha256_of(here)
    except InputError as error:
        raise RecordingError(f"{error}; put the log back to draw its runs") from None
    _check_same_content(digest, file, path)
    recordings, refused = read_logs(resolve_for_log(experiment, log), [place], None)
    if refused:
        raise RecordingError([f"{refusal.path}: {refusal.reason}" for refusal in refused])
    if recordings[0].stamps != stamps:  # a copy of its own, or it has changed since
        _check_same_content(read_content_digest(recordings[0]), file, path)
    # Draws are addressed by the log's name, which depends on what else was replayed.
    return replace(recordings[0], scene=replace(recordings[0].scene, log=log))


def _check_same_content(digest: str, file: RecordedLog, path: File) -> None:
    """Raise RecordingError where a recording is another than the one that was replayed."""
    if digest != file.sha256:
        raise RecordingError(
            f"expected the log that was replayed, SHA-256 {file.sha256[:12]}…, found {digest[:12]}…; "
            "put that log back, or run the experiment again",
            path=path,
        )

"""A results folder, read back: one reader for figures, reports, recordings and comparisons.

Comparisons read log by log: of a table of any size only the rows of one log are in memory. The place of each log's rows
is known from a pass over the names alone; they may be in one file or in one for each log, in any order.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from copem_replay.core.errors import ExperimentError, InputError, RecordingError, RemoteFile, is_url
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.experiment.file import ExperimentSource, parse_experiment, read_experiment_file, settings_places
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
from copem_replay.results.folder import MARK, check_unchanged
from copem_replay.results.schema import (
    AGAIN,
    COMPARED_FILES,
    TABLES,
    Provenance,
    check_columns,
    check_kind,
    check_text,
    read_csv,
    read_frame,
    read_provenance,
    table_file,
)

if TYPE_CHECKING:
    import pyarrow as pa

    from copem_replay.pipeline.expansion import ConfigurationFacts
    from copem_replay.results.schema import RecordedLog


@dataclass(frozen=True, eq=False)
class LogRows:
    """One table: the kinds of its columns, and the place of each log's rows: file, row group, from, to."""

    place: Path
    kinds: Mapping[str, str]
    where: Mapping[str, Sequence[tuple[Path, int, int, int]]]
    counts: Mapping[tuple[str, str], int]  # rows by log and configuration, in the order of both
    without_rows: pa.Table
    _last: dict[tuple[Path, int], pa.Table] = field(default_factory=dict)

    def of(self, log: str) -> pa.Table:
        """A log's rows without the column `log`, text as `string`. Raises InputError where they are damaged."""
        import pyarrow as pa
        from pyarrow import parquet

        names, parts = [name for name in self.kinds if name != "log"], []
        for file, k, begin, end in self.where.get(log, ()):
            if (file, k) not in self._last:
                self._last.clear()
                with _report_damage(self.place):
                    group = parquet.ParquetFile(file).read_row_group(k, names)
                    self._last[file, k] = group.replace_schema_metadata(None)  # pandas would parse any text in it
            parts.append(self._last[file, k].slice(begin, end - begin))
        table = pa.concat_tables(parts) if parts else self.without_rows.select(names)
        for k, name in enumerate(names):
            if self.kinds[name] == "text":
                check_text(self.place, name, table[name])
                table = table.set_column(k, name, table[name].cast(pa.string()))
        return table

    @property
    def configurations(self) -> tuple[str, ...]:
        """The configurations that have rows, in their order."""
        return tuple(dict.fromkeys(configuration for _, configuration in self.counts))

    def only(self, names: Iterable[str]) -> LogRows:
        """The table with those of the named columns that it has."""
        columns = self.without_rows.column_names
        return replace(self, kinds={name: self.kinds.get(name, "") for name in names if name in columns}, _last={})

    def renamed(self, to: Mapping[str, str]) -> LogRows:
        """The table with its logs renamed, `to` by the old names."""
        where = {to.get(log, log): places for log, places in self.where.items()}
        counts = {(to.get(log, log), configuration): n for (log, configuration), n in self.counts.items()}
        return replace(self, where=where, counts=counts, _last={})


def log_rows(place: Path, kinds: Mapping[str, str], files: Sequence[Path] = ()) -> LogRows:
    """A table, which has at least columns of these kinds, with the place of each log's rows.

    `files`: those of a table that is a folder. Raises InputError where the table cannot be read, lacks a column, or has
    one of another kind.
    """
    import pyarrow as pa
    from pyarrow import parquet

    names, schema = ["log", "configuration"], pa.schema([])
    where: dict[str, list[tuple[Path, int, int, int]]] = {}
    counts: Counter[tuple[str, str]] = Counter()
    for path in files or [place]:
        with _report_damage(place):
            file = parquet.ParquetFile(path, read_dictionary=names)
            schema = file.schema_arrow.remove_metadata()
        check_columns(place, kinds, schema.names)
        kinds = {c.name: c.kind for c in TABLES[place.name].columns if c.name in schema.names}
        for name, kind in kinds.items():
            column_type = schema.field(name).type
            if file.metadata.num_rows or not pa.types.is_null(column_type):  # without rows columns may have no types
                check_kind(place, name, kind, column_type)
        for k in range(file.num_row_groups if file.metadata.num_rows else 0):
            with _report_damage(place):
                group = file.read_row_group(k, names).unify_dictionaries()
            for name in names:
                check_text(place, name, group[name])
            sizes = group.group_by(names, use_threads=False).aggregate([([], "count_all")]).to_pydict()
            counts.update(
                dict(zip(zip(sizes["log"], sizes["configuration"], strict=True), sizes["count_all"], strict=True))
            )
            for log, begin, end in _find_stretches(group["log"].combine_chunks()):
                where.setdefault(log, []).append((path, k, begin, end))
    return LogRows(place, kinds, where, counts, schema.empty_table())


@contextmanager
def _report_damage(place: Path) -> Iterator[None]:
    """Raise InputError where Arrow cannot read a table."""
    try:
        yield
    except KeyError as error:  # of a column that is asked for by its name
        name = error.args[0].decode() if isinstance(error.args[0], bytes) else error.args[0]
        raise InputError(f"{place}: expected the column {name}, found none; {AGAIN}") from None
    except (OSError, ValueError) as error:  # what Arrow raises derives from these
        why = " ".join(str(error).split())
        raise InputError(f"{place}: expected a table that can be read, found damage: {why}; {AGAIN}") from None


def _find_stretches(names: pa.Array) -> Iterator[tuple[str, int, int]]:
    """Stretches of equal names: name, first row, row after the last."""
    import pyarrow as pa

    column = names if pa.types.is_dictionary(names.type) else names.dictionary_encode()
    name_ix, distinct = column.indices.to_numpy(), column.dictionary.to_pylist()
    ends = np.append(np.flatnonzero(np.diff(name_ix)) + 1, len(name_ix)).tolist()
    for begin, end in zip([0, *ends], ends, strict=False):
        yield distinct[name_ix[begin]], begin, end


_MAY_BE_FOLDERS = ("detections.parquet", "tally.parquet")


@dataclass(frozen=True, eq=False)
class Results:
    """A results folder. A file is read when it is first used, which raises InputError where it is damaged, or where
    other results have taken the place of the folder.

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
    def source(self) -> ExperimentSource:
        """`experiment.yaml` as plain data."""
        try:
            source = read_experiment_file(self.folder / "experiment.yaml")
        except ExperimentError as error:
            why = error.problems[0].removeprefix(f"{self.folder / 'experiment.yaml'}:").strip()
            raise InputError(
                f"{self.folder / 'experiment.yaml'}: expected the experiment of the results, found damage: {why}; "
                f"{AGAIN}"
            ) from None
        check_unchanged(self.folder, self.seen)
        return source

    @cached_property
    def experiment(self) -> Experiment:
        """The experiment, with components of the user's own."""
        experiment, problems = parse_experiment(self.source)
        if experiment is None or problems:
            raise InputError(problems)
        return experiment

    @cached_property
    def table(self) -> pd.DataFrame:
        """`detections.parquet` as a whole, for users; figures take `known` or `each`, which hold less in memory."""
        return self._frame("detections.parquet")

    @cached_property
    def rows(self) -> LogRows:
        """`detections.parquet` with the place of each log's rows."""
        place = self.folder / "detections.parquet"
        rows = log_rows(place, self._kinds(place.name, compared=True), self._files(place))
        check_unchanged(self.folder, self.seen)
        return rows

    def each(self, *columns: str, log: str | None = None, every: bool = False) -> Iterator[pd.DataFrame]:
        """Rows that count, or `every` row, log by log or of one log; with `columns`, none named: all but `log`."""
        columns = columns or tuple(name for name in self.rows.without_rows.column_names if name != "log")
        rows = self.rows.only(dict.fromkeys((*columns, *COUNTS_BY)))
        for name_of_log in self.rows.where if log is None else [log]:
            table = rows.of(name_of_log)
            check_unchanged(self.folder, self.seen)
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
        rows = self.rows.only(self._kinds(self.rows.place.name, compared=True))
        if not rows.where:
            raise InputError(f"{self.folder}: nothing can be compared: no measured object has an onset")
        logs = {log.name for log in self.provenance.logs}
        for what, unknown in (
            ("logs", set(rows.where) - logs),
            ("configurations", set(rows.configurations) - self.facts.keys()),
        ):
            if unknown:
                raise InputError(f"{rows.place}: expected the {what} of provenance.json, found {min(unknown)!r}")
        tables = {rows.place.name: rows}
        for name in (name for name in COMPARED_FILES if (self.folder / name).is_file()):
            table = log_rows(self.folder / name, self._kinds(name, compared=True))
            tables[name] = table.only(TABLES[name].kinds("fleet", compared=True))
        check_unchanged(self.folder, self.seen)
        return tables

    def rows_of(self, log: str, *names: str) -> dict[str, pa.Table]:
        """A log's rows of the named tables, by default of all that comparisons read."""
        tables = {name: rows.of(log) for name, rows in self.by_log.items() if not names or name in names}
        check_unchanged(self.folder, self.seen)
        return tables

    def log_place(self, log: str) -> Place:
        """The place where the recording of a log, or the several that it is made of, are expected."""
        entry = self.experiment.logs[[file.name for file in self.provenance.logs].index(log)]
        if isinstance(entry, str):
            return RemoteFile(entry) if is_url(entry) else self.folder / entry
        return settings_places(entry, self.folder)[0]

    def log_path(self, log: str) -> File:
        """The file where the recording of a log, or the first of several, is expected."""
        return first_recording(self.log_place(log))

    def chosen(self, configurations: Sequence[str] | None) -> tuple[str, ...]:
        """The configurations to draw, each once; None: all. Raises InputError for a name that is not there."""
        known = tuple(self.experiment.configurations)
        for name in configurations or ():
            if name not in known:
                raise InputError(f"{self.folder}: configurations: expected some of {', '.join(known)}, found {name!r}")
        return tuple(dict.fromkeys(configurations)) if configurations else known

    def _kinds(self, name: str, *, compared: bool = False) -> dict[str, str]:
        """Kinds of the columns that a file has to have, all or only those that comparisons read."""
        asked = {"braking": self.provenance.braking, "conflict": self.provenance.measure["conflict"]}
        return TABLES[name].kinds(*(key for key, of in asked.items() if of is not None), compared=compared)

    def _files(self, place: Path) -> list[Path]:
        """The files of a table that is a folder, in the order of the logs; empty: the table is a file."""
        if not place.is_dir():
            return []
        return [path for log in self.provenance.logs if (path := table_file(place, log.name)).is_file()]

    def _optional(self, name: str) -> pd.DataFrame | None:
        return self._frame(name) if (self.folder / name).is_file() else None

    def _frame(self, name: str) -> pd.DataFrame:
        def as_frame(place: Path) -> pd.DataFrame:
            from pyarrow import parquet

            table = parquet.read_table(self._files(place) or place).replace_schema_metadata(None)
            return table.to_pandas(
                split_blocks=True, self_destruct=True
            )  # column by column, so that no column is in memory twice

        table = read_frame(self.folder / name, read_csv if name.endswith(".csv") else as_frame, self._kinds(name))
        check_unchanged(self.folder, self.seen)
        return table


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
    seen = os.stat(folder)
    return Results(folder, seen, read_provenance(folder / MARK))


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
    _check_exists(results.folder, "summary.csv", "tally.parquet")
    experiment, rows = results.experiment, results.rows
    check_columns(rows.place, results._kinds(rows.place.name), rows.kinds)
    if rows.where or not rowless:
        _check_rows(rows, experiment)
    tally = results.tally[results.tally["event"] == DETECTED]
    counts = tally.groupby(["log", "configuration"])["runs"].sum()
    if counts.to_dict() != rows.counts:
        expected, found = sum(rows.counts.values()), int(counts.sum())
        raise InputError(
            f"{results.folder}/tally.parquet: expected the {expected} rows of detections.parquet counted, found "
            f"{found}; {AGAIN}"
        )
    for what, expected, found in (
        ("logs", len(experiment.logs), len(results.provenance.logs)),
        ("configurations", len(experiment.configurations), len(experiment.configurations.keys() & results.facts)),
    ):
        if expected != found:
            raise InputError(
                f"{results.folder}/{MARK}: expected {expected} {what} as in experiment.yaml, found {found}; {AGAIN}"
            )
    for name in ("summary", "exact", "sweep"):
        getattr(results, name)
    return results


def _check_rows(rows: LogRows, experiment: Experiment) -> None:
    """Raise InputError where rows are of another experiment or missing, or where there are none."""
    unknown = [name for name in rows.configurations if name not in experiment.configurations]
    if unknown:
        raise InputError(f"{rows.place}: expected the configurations of experiment.yaml, found {unknown[0]!r}; {AGAIN}")
    if not rows.where:
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

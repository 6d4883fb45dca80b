"""A results folder, read back: what the figures are made of."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd

from copem_replay.core.csv_names import as_named
from copem_replay.core.errors import InputError
from copem_replay.experiment.file import Source, load, parse
from copem_replay.experiment.schema import Experiment
from copem_replay.results.belongings import check_still

_NUMBERS = ("run", "onset_s", "captured_s", "detection_s", "time_to_detection_s", "distance_at_detection_m", "ended_s")
_TABLE = ("log", "configuration", "object_id", "object_class", "detected", "ended_by", *_NUMBERS)
_BRAKING = ("conflict", "braking_pass", "brake_s", "min_distance_m", "impact_s", "impact_speed_mps")
_CONFLICT = ("conflict_detected", "conflict_detection_s", "distance_at_conflict_detection_m")
_EXACT = ("log", "configuration", "object_id", "time_to_detection_s", "probability")
_AGAIN = "run the experiment again with --overwrite"


@dataclass(frozen=True)
class LogFile:
    """A recording the results were made of."""

    name: str
    path: Path
    sha256: str


@dataclass(frozen=True)
class Results:
    """A results folder. `exact`, `sweep`: None where it has no such file.

    >>> results = cr.load_results("out/tc016d")
    >>> results.name, results.experiment.runs, results.sweep is None
    ('tc016d', 500, True)
    """

    folder: Path
    source: Source  # experiment.yaml as plain data
    experiment: Experiment
    table: pd.DataFrame  # detections.parquet
    summary: pd.DataFrame  # summary.csv
    logs: tuple[LogFile, ...]
    run_shown: dict[str, int]  # by log
    exact: pd.DataFrame | None
    sweep: pd.DataFrame | None
    seen: os.stat_result  # the folder it was read from

    @property
    def name(self) -> str:
        """What the study is called: as its folder."""
        return self.folder.resolve().name

    @property
    def detections(self) -> pd.DataFrame:
        """A row per log, configuration, run and measured object."""
        return self.table

    @cached_property
    def accuracy(self) -> pd.DataFrame | None:
        """Position errors and parts of GOSPA, list by list, in the order of `detections`; None: not measured."""
        file = self.folder / "accuracy.parquet"
        return _read(file, pd.read_parquet, ()) if file.is_file() else None

    @cached_property
    def bands(self) -> pd.DataFrame | None:
        """Accuracy by configuration and by distance, time or existence; None: not measured."""
        file = self.folder / "bands.csv"
        return _read(file, _csv, ("configuration", "by", "from", "to")) if file.is_file() else None

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """What had to be said of the recordings and of the runs: one line each."""
        file = self.folder / "provenance.json"
        try:
            return tuple(map(str, json.loads(file.read_text(encoding="utf-8"))["notes"]))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"{file}: expected the notes of the results, found damage: {error}; {_AGAIN}") from None

    def chosen(self, configurations: Sequence[str] | None) -> tuple[str, ...]:
        """The configurations to draw, each once; None: all. Raises InputError for a name that is not there."""
        known = tuple(self.experiment.configurations)
        for name in configurations or ():
            if name not in known:
                raise InputError(f"{self.folder}: configurations: expected some of {', '.join(known)}, found {name!r}")
        return tuple(dict.fromkeys(configurations)) if configurations else known


def load_results(folder: Path | str, *, rowless: bool = False) -> Results:
    """Read a results folder, without rows only if `rowless`.

    Raises InputError, one line: no such folder, no results, or damaged ones.
    """
    folder = Path(folder)
    if not folder.is_dir():
        found = "a file" if folder.exists() else "no such folder"
        raise InputError(f"{folder}: expected a results folder, found {found}; `copem-replay run` writes one")
    for name in ("provenance.json", "experiment.yaml", "detections.parquet", "summary.csv"):
        if not (folder / name).is_file():
            raise InputError(
                f"{folder}: expected a results folder, found no {name} in it; `copem-replay run` writes one"
            )
    seen = os.stat(folder)
    source = load(folder / "experiment.yaml")
    experiment, problems = parse(source)
    if experiment is None or problems:
        raise InputError(problems)
    columns = _TABLE + (_BRAKING if experiment.braking else ()) + (_CONFLICT if experiment.measure.conflict else ())
    table = _read(folder / "detections.parquet", pd.read_parquet, columns)
    if len(table) or not rowless:
        _check(folder, table, experiment)
    exact, sweep = folder / "exact.parquet", folder / "sweep.csv"
    names, hashes, run_shown = _provenance(folder / "provenance.json")
    places = [folder / log for log in experiment.logs]
    if len(places) != len(names):
        raise InputError(
            f"{folder}/provenance.json: expected {len(places)} logs as in experiment.yaml, found {len(names)}; {_AGAIN}"
        )
    results = Results(
        folder,
        source,
        experiment,
        table,
        _read(folder / "summary.csv", _csv, ("configuration", "n", "list_rate_hz")),
        tuple(LogFile(*log) for log in zip(names, places, hashes, strict=True)),
        run_shown,
        _read(exact, pd.read_parquet, _EXACT) if exact.is_file() else None,
        _read(sweep, _csv, ("sweep", "value", "configuration", "list_rate_hz")) if sweep.is_file() else None,
        seen,
    )
    check_still(folder, seen)
    return results


def _csv(path: Path) -> pd.DataFrame:
    """A table of which names stay text and what is empty is missing, whatever else a name looks like."""
    text = {"configuration": str, "sweep": str}
    table = pd.read_csv(path, dtype=text, na_values=[""], keep_default_na=False)
    return as_named(table.fillna({name: "" for name in text if name in table}), [n for n in text if n in table])


def _read(path: Path, reader: Callable[[Path], pd.DataFrame], columns: Sequence[str]) -> pd.DataFrame:
    """A table with at least these columns. Raises InputError."""
    try:
        table = reader(path)
    except (OSError, ValueError) as error:  # what Arrow and pandas raise derives from these
        why = " ".join(str(error).split())
        raise InputError(f"{path}: expected a table that can be read, found damage: {why}; {_AGAIN}") from None
    if missing := [name for name in columns if name not in table.columns]:
        raise InputError(f"{path}: expected the column {missing[0]}, found none; {_AGAIN}")
    for name in set(columns) & {*_NUMBERS, "value", "list_rate_hz", "probability", "n"}:
        if table[name].dtype.kind not in "iuf" and table[name].notna().any():
            raise InputError(f"{path}: column {name}: expected numbers, found {table[name].dtype}; {_AGAIN}")
    return table


def _check(folder: Path, table: pd.DataFrame, experiment: Experiment) -> None:
    """Raise InputError where the rows are of another experiment, are not all there, or there are none."""
    place = folder / "detections.parquet"
    unknown = [name for name in table["configuration"].unique() if name not in experiment.configurations]
    if unknown:
        raise InputError(f"{place}: expected the configurations of experiment.yaml, found {unknown[0]!r}; {_AGAIN}")
    if not len(table):
        raise InputError(f"{place}: expected rows to draw, found none: no measured object has an onset")
    counts = [int((table["configuration"] == name).sum()) for name in experiment.configurations]
    if min(counts) != max(counts):
        raise InputError(
            f"{place}: expected as many rows of each configuration, found {min(counts)} to {max(counts)}; {_AGAIN}"
        )


def _provenance(path: Path) -> tuple[list[str], list[str], dict[str, int]]:
    """Names and SHA-256 of the logs, and the run that was shown of each. Raises InputError."""
    try:
        data: Any = json.loads(path.read_text(encoding="utf-8"))
        names, hashes = ([str(log[key]) for log in data["logs"]] for key in ("log", "sha256"))
        return names, hashes, {str(log): int(run) for log, run in data["run_shown"].items() if run is not None}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        why = f"no {error}" if isinstance(error, KeyError) else " ".join(str(error).split())
        raise InputError(f"{path}: expected the provenance of results, found damage: {why}; {_AGAIN}") from None

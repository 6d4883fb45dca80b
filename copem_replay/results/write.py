"""The results folder: complete under its name, or not there at all.

Everything is written into a folder beside it first, which then takes its name (`results/place.py`). Same input, same
seed: the same bytes in all but the .rrd.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pandas as pd

from copem_replay.core.csv_names import for_spreadsheets
from copem_replay.core.errors import OutputError
from copem_replay.core.yaml import dump
from copem_replay.experiment.drive import of_log
from copem_replay.experiment.schema import Experiment
from copem_replay.io.recording import Recording
from copem_replay.io.together import File, paths_of
from copem_replay.pipeline.run import Result, log_path_of
from copem_replay.pipeline.selected_runs import ShownRun, one_run, shown_logs, shown_runs
from copem_replay.pipeline.sweep import resolved
from copem_replay.results import tables
from copem_replay.results.belongings import MARK
from copem_replay.results.contents import TableFile, log_entries, versions, write_parquet, written_name
from copem_replay.results.export import Exporter, RunToExport
from copem_replay.results.place import EXPERIMENT, Place, check_inputs, taken

_ACCURACY = ("accuracy", "instants", "lists", "thresholds")


def write_results(
    folder: Path,
    experiment: Experiment,
    recordings: Sequence[Recording],
    result: Result,
    *,
    exporters: Sequence[Exporter],
    skipped: Sequence[tuple[File, str]] = (),
    overwrite: bool = False,
) -> list[str]:
    """Write the results folder. Returns notes for the user. Raises OutputError, also where only exporters failed.

    `exporters`: each writes every shown run (`show` in the experiment) as a file, `MCAP` and `RRD` for instance.
    `skipped`: recordings that are left out, and why.
    """
    with taken(folder, overwrite=overwrite) as place:
        check_inputs(place, [path for recording in recordings for path in recording.paths])
        notes = fill_place(place, experiment, recordings, result, exporters=exporters, skipped=skipped)
    if place.failed:
        raise OutputError(place.failed)
    return place.notes + notes


def fill_place(
    place: Place,
    experiment: Experiment,
    recordings: Sequence[Recording],
    result: Result,
    *,
    exporters: Sequence[Exporter],
    skipped: Sequence[tuple[File, str]] = (),
) -> list[str]:
    """Write results into a place that is taken. Returns notes for the user. Raises OutputError.

    The place's `folder` and `notes` may change; `failed`: exporters' files that could not be written.
    """
    files = _files(experiment, recordings, result, exporters)
    try:
        place.will_hold(files)
        _fill(place, experiment, recordings, result)
        notes = [*result.notes, *_export(place, experiment, recordings, result, exporters)]
        files = [name for name in files if name not in place.left_out]
        write_csv(_logs(place.folder, result, skipped), place.new / "logs.csv")
        provenance = provenance_of(experiment, recordings, result, skipped, notes) | {"files": files}
        (place.new / MARK).write_text(json.dumps(provenance, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        place.finish(files)
    except OSError as error:
        raise OutputError(f"{place.folder}: cannot be written: {error.strerror or error}") from error
    return notes


def _files(
    experiment: Experiment, recordings: Sequence[Recording], result: Result, exporters: Sequence[Exporter]
) -> list[str]:
    """What is going to be in the folder, by names relative to it."""
    files = [EXPERIMENT, MARK, "summary.csv", "logs.csv"]
    files += _named("detections.parquet", result.tables.counts)
    files += _named("tally.parquet", dict(result.tally["log"].value_counts(sort=False)))
    files += ["exact.parquet"] * (result.exact is not None) + ["sweep.csv"] * (result.sweep is not None)
    if result.bands is not None:
        files += [f"{name}.parquet" for name in _ACCURACY] + ["bands.csv"]
    for log in shown_logs(experiment, result):
        for shown in shown_runs(experiment, result, log):
            stem, shown_count = _target(shown, log, recordings), len(experiment.shown())
            files += [name for exporter in exporters for name in exporter.files(stem, shown_count)]
    return sorted(files)


def _named(name: str, counts: Mapping[str, int]) -> list[str]:
    """The file of a table of which each log has so many rows, or those of its logs where it has many."""
    if sum(counts.values()) <= tables.MANY_ROWS:
        return [name]
    return [str(tables.file_of(Path(name), log)) for log, count in counts.items() if count]


def _target(shown: ShownRun, log: str, recordings: Sequence[Recording]) -> str:
    """What the files of a run that is shown are called, relative to the folder, without their suffix."""
    return shown.stem if len(recordings) == 1 else f"{shown.stem}/{log}"


def _fill(place: Place, experiment: Experiment, recordings: Sequence[Recording], result: Result) -> None:
    """Write the experiment and all tables but that of the logs."""
    data, scratch = resolved(experiment).as_written(), place.new
    data["logs"] = log_entries(experiment.logs, recordings, place.folder)
    for of in _recorded_latencies(data):
        of["file"] = os.path.relpath(of["file"], place.folder)
    (scratch / EXPERIMENT).write_text(dump(data), encoding="utf-8")
    _write_rows(result, scratch)
    write_csv(result.summary, scratch / "summary.csv")
    if result.exact is not None:
        write_parquet(result.exact, scratch / "exact.parquet")
    if result.bands is not None:
        write_csv(result.bands, scratch / "bands.csv")
    if result.sweep is not None:
        write_csv(result.sweep, scratch / "sweep.csv")


def _export(
    place: Place, experiment: Experiment, recordings: Sequence[Recording], result: Result, exporters: Sequence[Exporter]
) -> list[str]:
    """Write the runs that are shown. Returns notes for the user; what cannot be written is among those that failed."""
    notes: list[str] = []
    for log in shown_logs(experiment, result) if exporters else ():
        for shown in shown_runs(experiment, result, log):
            stem, shown_count = _target(shown, log, recordings), len(experiment.shown())
            files = [exporter.files(stem, shown_count) for exporter in exporters]
            with place.may_fail([name for names in files for name in names]):
                run = _run_to_export(log, shown, experiment, recordings, result)
                (place.new / stem).parent.mkdir(parents=True, exist_ok=True)
                for exporter, names in zip(exporters, files, strict=True):
                    with place.may_fail(names):
                        said = exporter.write(place.new / f"{stem}{exporter.suffix}", run)
                        notes += [f"{log}: {line}" for line in said if f"{log}: {line}" not in notes]
        next(one for one in result.logs if one.name == log).drop()
    return notes


def _recorded_latencies(data: dict[str, Any]) -> list[dict[str, Any]]:
    """The latencies of an experiment, as plain data, that are read off files."""
    configurations = [c.get("link") for c in data["configurations"].values()]
    links = [link for link in (*data.get("links", {}).values(), *configurations) if isinstance(link, dict)]
    found = [*(link.get("latency") for link in links), *(unit.get("ready") for unit in data["units"].values())]
    return [one for one in found if isinstance(one, dict) and one.get("kind") == "recorded"]


def _logs(folder: Path, result: Result, skipped: Sequence[tuple[File, str]]) -> pd.DataFrame:
    """The rows of `logs.csv`: what became of each log."""
    rows = [
        {
            "log": log.name,
            "path": _utf8(" + ".join(written_name(one, folder) for one in paths_of(log.recording.place))),
            "sha256": log.digests["sha256"],
            "episodes": facts.episodes,
            "rows": result.tables.counts[log.name],
            "state": "done",
        }
        for log, facts in zip(result.logs, result.facts, strict=True)
    ]
    rows += [
        {"log": None, "path": _utf8(written_name(path, folder)), "state": "skipped", "reason": _utf8(why)}
        for path, why in skipped
    ]
    columns = {"log": "object", "path": "object", "sha256": "object", "episodes": "Int64", "rows": "Int64",
               "state": "object", "reason": "object"}  # fmt: skip
    return pd.DataFrame(rows, columns=list(columns)).astype(columns)


def _run_to_export(
    log: str, shown: ShownRun, experiment: Experiment, recordings: Sequence[Recording], result: Result
) -> RunToExport:
    """One run of one log, in the configurations that the experiment shows."""
    of_study = next(one for one in result.logs if one.name == log)
    replay, recording = of_study.replay(), of_study.whole()
    experiment = of_log(experiment, log)
    chosen = experiment.model_copy(update={"configurations": experiment.shown()})
    names = list(chosen.configurations)
    rows = result.tables.rows(log)
    manifest = {
        "copem_replay": version("copem-replay"),
        "experiment": dump(resolved(experiment).as_written() | {"logs": [log_path_of(recordings, log).name]}),
        "log": log,
        "run": str(shown.run),
        "run_is": shown.why,
    }
    return RunToExport(
        recording,
        shown,
        one_run(recording, chosen, shown.run, replay),
        experiment.configurations,
        rows[(rows["run"] == shown.run) & rows["configuration"].isin(names)],
        result.summary[result.summary["configuration"].isin(names)],
        manifest,
    )


def provenance_of(
    experiment: Experiment,
    recordings: Sequence[Recording],
    result: Result,
    skipped: Sequence[tuple[File, str]],
    notes: Sequence[str],
) -> dict[str, object]:
    """What made these results: versions, logs, seed, metric parameters; no clock, no host."""
    shown = {log: shown_runs(experiment, result, log) for log in shown_logs(experiment, result)}
    return {
        "format": tables.FORMAT,
        **versions(),
        "seed": experiment.seed,
        "runs": experiment.runs,
        "logs": [
            {"log": log.name, "topic": log.recording.topic, **{n: log.digests[n] for n in ("sha256", "truth")}}
            for log in result.logs
        ],
        "logs_skipped": [{"log": _utf8(path.name), "reason": reason} for path, reason in skipped],
        "visibility": experiment.visibility.label,
        "max_gap_s": experiment.max_gap_s,
        "window_s": experiment.window_s,
        "measure": experiment.measure.model_dump(mode="json", by_alias=True) | {"horizon_used_s": result.horizon_s},
        "braking": experiment.braking and experiment.braking.model_dump(mode="json", by_alias=True),
        "run_shown": {log: runs[0].run for log, runs in shown.items()},
        "runs_shown": {
            log: [{"file": each.stem, "run": each.run, "run_is": each.why or None} for each in runs]
            for log, runs in shown.items()
        },
        "notes": list(notes),
    }  # fmt: skip


def _utf8(name: str) -> str:
    """A file's name as text that can be written: bytes that are not UTF-8 escaped."""
    return name.encode(errors="backslashreplace").decode()


def _write_rows(result: Result, scratch: Path) -> None:
    """The tables of logs, of which all or those of one are in memory, and the tally."""
    with ExitStack() as open_files:
        files: dict[str, TableFile] = {}

        def add(name: str, table: Any) -> None:
            if name not in files:
                files[name] = open_files.enter_context(TableFile(scratch / name))
            files[name].add(table)

        for rows, of_logs in result.tables.parts():
            if sum(result.tables.counts.values()) <= tables.MANY_ROWS:
                add("detections.parquet", rows)
            else:
                _write_by_log(rows, scratch / "detections.parquet")
            if result.bands is not None:
                accuracy = result.accuracy_of(of_logs, rows)
                for name in _ACCURACY:
                    add(f"{name}.parquet", getattr(accuracy, name))
    if len(result.tally) <= tables.MANY_ROWS:
        write_parquet(result.tally, scratch / "tally.parquet")
    else:
        _write_by_log(result.tally, scratch / "tally.parquet")


def _write_by_log(rows: pd.DataFrame, folder: Path) -> None:
    """A file for each log."""
    folder.mkdir(exist_ok=True)
    for log, part in rows.groupby("log", sort=False):
        write_parquet(part, tables.file_of(folder, str(log)))


def write_csv(table: pd.DataFrame, path: Path) -> None:
    """A table as CSV: nulls empty, numbers with nine significant digits, names quoted for spreadsheets."""
    for_spreadsheets(table).to_csv(path, index=False, float_format="%.9g", lineterminator="\n")

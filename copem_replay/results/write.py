"""The results folder: complete under its name, or not there at all.

Everything is written into a folder beside it first, which then takes its name (`results/place.py`). Same input, same seed: the
same bytes in all but the .rrd.
"""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pandas as pd

from copem_replay.core.csv_names import for_spreadsheets
from copem_replay.core.errors import OutputError
from copem_replay.core.yaml import dump
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import place_of
from copem_replay.io.checksum import sha256_of
from copem_replay.io.recording import Recording
from copem_replay.pipeline.accuracy_tables import AccuracyTables
from copem_replay.pipeline.run import Result, log_path_of
from copem_replay.pipeline.selected_runs import ShownRun, one_run, shown_logs, shown_runs
from copem_replay.pipeline.sweep import resolved
from copem_replay.results.belongings import MARK
from copem_replay.results.place import EXPERIMENT, Place, check_inputs, taken

_LIBRARIES = (
    "foxglove-schemas-protobuf", "mcap", "numba", "numpy", "osi-python", "pandas", "protobuf", "pyarrow", "rerun-sdk",
    "scipy", "shapely",
)  # fmt: skip
_ACCURACY = ("accuracy", "instants", "lists", "thresholds")


def write_results(
    folder: Path,
    experiment: Experiment,
    recordings: Sequence[Recording],
    result: Result,
    *,
    skipped: Sequence[tuple[Path, str]] = (),
    overwrite: bool = False,
    viewer: str | None = None,
) -> list[str]:
    """Write the folder of the contract. Returns what has to be said of it. Raises OutputError.

    `viewer`: where a Rerun viewer listens that shall get what is written to .rrd, too.
    """
    with taken(folder, overwrite=overwrite) as place:
        check_inputs(place, [recording.path for recording in recordings])
        notes = fill_place(place, experiment, recordings, result, skipped=skipped, viewer=viewer)
        return place.notes + notes


def fill_place(
    place: Place,
    experiment: Experiment,
    recordings: Sequence[Recording],
    result: Result,
    *,
    skipped: Sequence[tuple[Path, str]] = (),
    viewer: str | None = None,
) -> list[str]:
    """The same into a place that is taken, whose `folder` and `notes` may change. Raises OutputError."""
    files = _files(experiment, recordings, result)
    try:
        place.will_hold(files)
        notes = _fill(place.new, place.folder, experiment, recordings, result, skipped, viewer)
        place.finish(files)
    except OSError as error:
        raise OutputError(f"{place.folder}: cannot be written: {error.strerror or error}") from error
    return notes


def _files(experiment: Experiment, recordings: Sequence[Recording], result: Result) -> list[str]:
    """What is going to be in the folder, by names relative to it."""
    files = [EXPERIMENT, MARK, "detections.parquet", "summary.csv"]
    files += ["exact.parquet"] * (result.exact is not None) + ["sweep.csv"] * (result.sweep is not None)
    if result.accuracy is not None:
        files += [f"{name}.parquet" for name in _ACCURACY if getattr(result.accuracy, name) is not None] + ["bands.csv"]
    for log in shown_logs(experiment, result):
        for shown in shown_runs(experiment, result, log):
            files += [f"{_target(shown, log, recordings)}.{kind}" for kind in ("mcap", "rrd")]
    return sorted(files)


def _target(shown: ShownRun, log: str, recordings: Sequence[Recording]) -> str:
    """What the files of a run that is shown are called, relative to the folder, without their suffix."""
    return shown.stem if len(recordings) == 1 else f"{shown.stem}/{log}"


def _fill(
    scratch: Path, folder: Path, experiment: Experiment, recordings: Sequence[Recording], result: Result,
    skipped: Sequence[tuple[Path, str]], viewer: str | None,
) -> list[str]:  # fmt: skip
    data = resolved(experiment).as_written()
    data["logs"] = [os.path.relpath(place_of(recording.path), folder) for recording in recordings]
    (scratch / EXPERIMENT).write_text(dump(data), encoding="utf-8")
    write_parquet(result.table, scratch / "detections.parquet")
    write_csv(result.summary, scratch / "summary.csv")
    if result.exact is not None:
        write_parquet(result.exact, scratch / "exact.parquet")
    if result.accuracy is not None:
        _write_accuracy(result.accuracy, scratch)
    if result.sweep is not None:
        write_csv(result.sweep, scratch / "sweep.csv")
    notes = list(result.notes)
    for log in shown_logs(experiment, result):
        for shown in shown_runs(experiment, result, log):
            target = scratch / _target(shown, log, recordings)
            said = _show(target, log, shown, experiment, recordings, result, viewer)
            notes += [f"{log}: {line}" for line in said if f"{log}: {line}" not in notes]
    provenance = provenance_of(experiment, recordings, result, skipped, notes)
    (scratch / MARK).write_text(json.dumps(provenance, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return notes


def _show(
    target: Path,
    log: str,
    shown: ShownRun,
    experiment: Experiment,
    recordings: Sequence[Recording],
    result: Result,
    viewer: str | None,
) -> list[str]:
    from copem_replay.io.write.mcap import write_mcap
    from copem_replay.io.write.message_family import family_of
    from copem_replay.viewer import write_rrd

    recording = next(r for r in recordings if r.scene.log == log)
    chosen = experiment.model_copy(update={"configurations": experiment.shown()})
    one = one_run(recording, chosen, shown.run, next(r for r in result.replays if r.scene.log == log))
    of_run_shown = (result.table["log"] == log) & (result.table["run"] == shown.run)
    rows = result.table[of_run_shown & result.table["configuration"].isin(list(chosen.configurations))]
    summary = result.summary[result.summary["configuration"].isin(list(chosen.configurations))]
    manifest = {
        "copem_replay": version("copem-replay"),
        "experiment": dump(resolved(experiment).as_written() | {"logs": [log_path_of(recordings, log).name]}),
        "log": log,
        "run": str(shown.run),
        "run_is": shown.why,
    }
    said = write_mcap(
        Path(f"{target}.mcap"),
        recording.path,
        one.replay.scene,
        one.beliefs,
        rows,
        manifest,
        family_of(recording),
        recording.window,
    )
    return said + write_rrd(
        Path(f"{target}.rrd"),
        one.replay,
        one.experiment,
        one.beliefs,
        rows,
        summary,
        shown.run,
        run_is=shown.why,
        viewer=viewer,
    )


def provenance_of(
    experiment: Experiment,
    recordings: Sequence[Recording],
    result: Result,
    skipped: Sequence[tuple[Path, str]],
    notes: Sequence[str],
) -> dict[str, object]:
    """What made these results: versions, logs, seed, metric parameters; no clock, no host."""
    shown = {log: shown_runs(experiment, result, log) for log in shown_logs(experiment, result)}
    return {
        "copem_replay": version("copem-replay"),
        "python": platform.python_version(),
        "libraries": {name: version(name) for name in _LIBRARIES},
        "seed": experiment.seed,
        "runs": experiment.runs,
        "logs": [
            {"log": r.scene.log, "topic": r.topic, "sha256": sha256_of(r.path)} for r in recordings
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
        "files": _files(experiment, recordings, result),
    }  # fmt: skip


def _utf8(name: str) -> str:
    """A file's name as text that can be written: bytes that are not UTF-8 escaped."""
    return name.encode(errors="backslashreplace").decode()


def write_parquet(table: Any, path: Path) -> None:
    """A table, of pandas or of Arrow, as Parquet: NaN as null, text as `string` whatever pandas keeps it in."""
    import pyarrow as pa
    from pyarrow import parquet

    arrow = pa.Table.from_pandas(table, preserve_index=False) if isinstance(table, pd.DataFrame) else table
    fields = [pa.field(f.name, pa.string()) if pa.types.is_large_string(f.type) else f for f in arrow.schema]
    parquet.write_table(arrow.cast(pa.schema(fields, arrow.schema.metadata)), path, compression="zstd")


def _write_accuracy(tables: AccuracyTables, scratch: Path) -> None:
    for name in _ACCURACY:
        if (table := getattr(tables, name)) is not None:
            write_parquet(table, scratch / f"{name}.parquet")
    write_csv(tables.bands, scratch / "bands.csv")


def write_csv(table: pd.DataFrame, path: Path) -> None:
    """A table as CSV: nulls empty, numbers with nine significant digits, names quoted for spreadsheets."""
    for_spreadsheets(table).to_csv(path, index=False, float_format="%.9g", lineterminator="\n")

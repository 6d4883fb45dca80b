"""The results folder is written: complete under its name, or not at all.

Everything is written into a folder beside it first, which then takes its name (`results/folder.py`). Equal input and
seed give equal bytes in all files but the .rrd.
"""

from __future__ import annotations

import json
import shutil
import weakref
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from tempfile import gettempdir, mkdtemp
from typing import TYPE_CHECKING, Any

import pandas as pd

from copem_replay.core.colours import configuration_colours
from copem_replay.core.errors import OutputError, RecordingError
from copem_replay.core.files import portable_name
from copem_replay.core.tracks import TRUTH
from copem_replay.core.yaml import dump_yaml
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.experiment.schema import Experiment
from copem_replay.io.open import (
    File,
    check_files_unchanged,
    fetch_place,
    first_recording,
    list_recordings,
    read_file_stamps,
    sha256_of,
)
from copem_replay.io.recording import KnownLog, Recording
from copem_replay.metrics.columns import COMPARED_FILES, FALSE_TRACKS, NEEDLESS, TABLES
from copem_replay.metrics.detections_table import first_episodes
from copem_replay.pipeline.cost import return_memory
from copem_replay.pipeline.one_run import (
    ReplayedRun,
    ShownRun,
    choose_logs,
    list_stems,
    replay_run,
    select_shown_runs,
)
from copem_replay.pipeline.run import StudyTables
from copem_replay.pipeline.study_log import is_made
from copem_replay.pipeline.sweep import list_points, resolve_sweep
from copem_replay.results.folder import EXPERIMENT, MADE, MARK, ResultsPlace, check_names
from copem_replay.results.provenance import (
    build_provenance,
    escape_name,
    list_read,
    log_entries,
    recording_name,
    relative_path,
)
from copem_replay.results.seals import seal_recordings, seal_results
from copem_replay.results.table_files import MANY_ROWS, TableFile, table_file, write_csv, write_parquet
from copem_replay.results.truth_scene import draw_truth

if TYPE_CHECKING:
    from copem_replay.experiment.schema import Configuration


# Exporters: each writes one shown run of one log as a file of its own kind.


@dataclass(frozen=True)
class RunToExport:
    """One run of one log, in the configurations that are shown.

    `one`: the replayed run. `every`: all configurations of the experiment, whose order determines colours. `table`,
    `needless`, `false_tracks`: the rows of these files of this log and run, None: not asked for. `summary`: over all
    logs and runs. `manifest`: the provenance that the file states.
    """

    recording: Recording
    shown: ShownRun
    replayed: ReplayedRun
    every: Mapping[str, Configuration]
    table: pd.DataFrame
    summary: pd.DataFrame
    manifest: dict[str, str]
    needless: pd.DataFrame | None = None
    false_tracks: pd.DataFrame | None = None


@dataclass(frozen=True)
class Exporter:
    """A kind of file. `suffix`: with the dot. `write`: writes the file and returns notes for the user.

    `names`: gives the files for a stem and a number of configurations besides the truth, where there may be several.

    `write` raises OutputError where the file cannot be written, and RecordingError where the recording cannot be read:
    the results are then without it, and say so.
    """

    suffix: str
    write: Callable[[Path, RunToExport], list[str]]
    names: Callable[[str, int], list[str]] | None = None

    def files(self, stem: str, configurations: int) -> list[str]:
        """Names of the files, relative to the folder that the stem is relative to."""
        return [stem + self.suffix] if self.names is None else self.names(stem, configurations)


def _write_mcap(path: Path, run: RunToExport) -> list[str]:
    """Write the replay of one run as MCAP, with the recording's own messages. Returns notes for the user."""
    from copem_replay.io.write.mcap import write_mcap
    from copem_replay.io.write.message_family import find_family

    recording, show, table = run.recording, run.replayed.experiment.show, first_episodes(run.table)
    with fetch_place(recording.place) as local_path:
        stamps = read_file_stamps(local_path)
        has_digest = recording.sha256 is not None or recording.stamps is not None
        if has_digest and stamps != recording.stamps and sha256_of(local_path) != recording.sha256:
            raise RecordingError("it is no longer what was replayed", path=first_recording(recording.place))
        truth = draw_truth(run.replayed, table) if show is None or show.truth else None
        units = show is None or show.units
        chunks = ((of.fused, of.unit_lists() if units else ()) for of in run.replayed.run_tracks.chunks())
        truths = {name for name, of in run.every.items() if of.units == TRUTH}
        notes = write_mcap(
            path, local_path, run.replayed.replay.scene, chunks, table, run.manifest,
            find_family(recording), recording.window, truth,
            colours=configuration_colours(run.every, truths, shown=run.replayed.experiment.configurations),
        )  # fmt: skip
        check_files_unchanged(stamps)
    return notes


MCAP = Exporter(".mcap", _write_mcap)
"""The recording with the fused lists added, as MCAP."""


def fill_place(
    place: ResultsPlace, study: StudyTables, *, exporters: Sequence[Exporter],
    skipped: Sequence[tuple[File, str]] = (), label: str | None = None,
) -> list[str]:  # fmt: skip
    """Write results into a place that is locked. Returns notes for the user. Raises OutputError.

    `exporters`: each writes every shown run (`show` in the experiment) as a file. `skipped`: recordings that are left
    out, and why. The place's `folder` and `notes` may change; `failed` has the exporters' files that could not be
    written.
    """
    for recording in study.recordings:
        if is_made(recording):
            raise RecordingError("cannot be opened: No such file or directory", path=first_recording(recording.place))
    files = list_results(study.experiment, study.recordings, exporters, _list_row_files(study))
    try:
        place.scratch.may_remove([*files, MADE])
        _write_files(place.new, place.folder, study, skipped)
        notes = [*study.notes, *_export(place, study, exporters)]
        files = [name for name in files if name not in place.left_out]
        more = {"files": files} | ({"label": label} if label is not None else {})
        _write_provenance(place.new, build_provenance(study, skipped, notes) | more, files)
        place.finish([*files, *seal_recordings(place.new, files)])
    except OSError as error:
        raise place.cannot_be_written(error) from error
    return notes


def make_scratch_results(study: StudyTables) -> Path:
    """The results of a study, without replays, in a scratch folder that goes with the study.

    Raises OutputError: no room on the disk.
    """
    files = list_results(study.experiment, study.recordings, (), _list_row_files(study))
    try:
        folder = Path(mkdtemp(prefix="copem-replay-"))
        weakref.finalize(study, shutil.rmtree, folder, ignore_errors=True)
        _write_files(folder, folder, study)
        _write_provenance(folder, build_provenance(study, (), study.notes) | {"files": files}, files)
    except OSError as error:
        why = f"{error.strerror or error}; set TMPDIR to a folder with room"
        raise OutputError(f"{gettempdir()}: cannot be written: {why}") from None
    return folder


def check_own_files(
    place: ResultsPlace, experiment: Experiment, recordings: Sequence[KnownLog], exporters: Sequence[Exporter]
) -> None:
    """Raise OutputError where a file of the user's own has a name that the results will have."""
    if place.before is not None:
        check_names(place, list_results(experiment, recordings, exporters))


def list_results(
    experiment: Experiment, recordings: Sequence[KnownLog], exporters: Sequence[Exporter],
    tables: Iterable[str] = ("detections.parquet", "tally.parquet"),
) -> list[str]:  # fmt: skip
    """The files that the results of an experiment have, by names relative to the folder.

    `tables`: the files of those tables that are a folder where they have many rows.
    """
    files = [EXPERIMENT, MARK, "summary.csv", "logs.csv", "read.csv", *tables]
    files += ["exact.parquet"] * experiment.measure.exact + ["sweep.csv"] * any(True for _ in list_points(experiment))
    files += ["summary_by.csv"] * bool(experiment.measure.by)
    files += [name for name in (*COMPARED_FILES, FALSE_TRACKS, "bands.csv") if experiment.measure.accuracy]
    files += [NEEDLESS] * (experiment.needless is not None)
    for log in choose_logs(experiment, [recording.scene.log for recording in recordings]):
        for stem in list_stems(experiment):
            place, shown_count = _place_stem(stem, log, recordings), _count_with_views(experiment, log)
            files += [name for exporter in exporters for name in exporter.files(place, shown_count)]
    return sorted(files)


def _count_with_views(experiment: Experiment, log: str) -> int:
    """How many of the shown configurations have views of their own in a log: all but the truth, unless it is alone."""
    shown = resolve_for_log(experiment, log).shown()
    return sum(configuration.units != TRUTH for configuration in shown.values()) or len(shown)


def _table_files(name: str, counts: Mapping[str, int]) -> list[str]:
    """The file of a table, or one per log where it has many rows. `counts`: rows by log."""
    if sum(counts.values()) <= MANY_ROWS:
        return [name]
    return [table_file(Path(name), log).as_posix() for log, count in counts.items() if count]


def _place_stem(stem: str, log: str, logs: Sequence[object]) -> str:
    """The name of a shown run's files, relative to the folder, without suffix."""
    return stem if len(logs) == 1 else f"{stem}/{portable_name(log)}"


def _list_row_files(study: StudyTables) -> list[str]:
    """The files of the tables of rows and of the tally."""
    tally = dict(study.tally["log"].value_counts(sort=False))
    return _table_files("detections.parquet", study.counts) + _table_files("tally.parquet", tally)


def _write_files(scratch: Path, folder: Path, study: StudyTables, skipped: Sequence[tuple[File, str]] = ()) -> None:
    """Write the experiment and all tables to `scratch`; paths in them are relative to `folder`, where they will be."""
    data = relocate_experiment(resolve_sweep(study.experiment), study.recordings, folder)
    (scratch / EXPERIMENT).write_text(dump_yaml(data), encoding="utf-8")
    _write_rows(study, scratch)
    write_csv(study.summary, scratch / "summary.csv")
    write_csv(_read_table(study), scratch / "read.csv")
    write_csv(_logs_table(folder, study, skipped), scratch / "logs.csv")
    if study.exact is not None:
        write_parquet(study.exact, scratch / "exact.parquet")
    for name, table in (("summary_by.csv", study.summary_by), ("bands.csv", study.bands), ("sweep.csv", study.sweep)):
        if table is not None:
            write_csv(table, scratch / name)


def relocate_experiment(experiment: Experiment, logs: Sequence[KnownLog], folder: Path) -> dict[str, Any]:
    """An experiment of these logs as plain data, with paths as they are from a folder."""
    data = experiment.as_written()
    data["logs"] = log_entries(experiment.logs, logs, folder)
    for latency in _find_recorded_latencies(data):
        latency["file"] = relative_path(latency["file"], folder)
    for site in (one for entry in (data, *data["logs"]) if isinstance(entry, dict) for one in entry.get("maps") or ()):
        site["file"] = relative_path(site["file"], folder)
    return data


def _write_provenance(folder: Path, content: Mapping[str, object], files: Iterable[str]) -> None:
    """Write `provenance.json` of a folder that is complete but for it, with the seals of its files."""
    text = json.dumps(seal_results(folder, files, content), indent=1, ensure_ascii=False)
    (folder / MARK).write_text(f"{text}\n", encoding="utf-8")


def _export(place: ResultsPlace, study: StudyTables, exporters: Sequence[Exporter]) -> list[str]:
    """Write the files of the shown runs. Returns notes for the user; of a failed file a line is in `place.failed`."""
    notes: list[str] = []
    for log in choose_logs(study.experiment, [one.name for one in study.logs]) if exporters else ():
        for shown in select_shown_runs(study, log):
            stem, shown_count = _place_stem(shown.stem, log, study.logs), _count_with_views(study.experiment, log)
            files = [exporter.files(stem, shown_count) for exporter in exporters]
            with place.may_fail([name for names in files for name in names]):
                run = _make_run_to_export(log, shown, study)
                (place.new / stem).parent.mkdir(parents=True, exist_ok=True)
                for exporter, names in zip(exporters, files, strict=True):
                    with place.may_fail(names):
                        lines = exporter.write(place.new / f"{stem}{exporter.suffix}", run)
                        notes += [f"{log}: {line}" for line in lines if f"{log}: {line}" not in notes]
                    return_memory()
        study.find_log(log).drop()
    return notes


def _find_recorded_latencies(data: dict[str, Any]) -> list[dict[str, Any]]:
    """The recorded latencies of an experiment given as plain data."""
    configurations = [c.get("link") for c in data["configurations"].values()]
    links = [link for link in (*data.get("links", {}).values(), *configurations) if isinstance(link, dict)]
    latencies = [*(link.get("latency") for link in links), *(unit.get("ready") for unit in data["units"].values())]
    return [replayed for replayed in latencies if isinstance(replayed, dict) and replayed.get("kind") == "recorded"]


def _logs_table(folder: Path, study: StudyTables, skipped: Sequence[tuple[File, str]]) -> pd.DataFrame:
    """The table `logs.csv`: a row by replayed log (`done`) and by skipped recording, with the reason."""
    rows: list[dict[str, Any]] = []
    for log, facts in zip(study.logs, study.facts, strict=True):
        path = " + ".join(recording_name(replayed, folder) for replayed in list_recordings(log.recording.place))
        counts = {"episodes": facts.episodes, "rows": study.counts[log.name]}
        log_row = {"log": log.name, "path": escape_name(path), "sha256": log.digests["sha256"], "state": "done"}
        rows.append(log_row | counts)
    for place, why in skipped:
        left_out = {"path": escape_name(recording_name(place, folder)), "reason": escape_name(why)}
        rows.append({"log": None, "state": "skipped"} | left_out)
    return TABLES["logs.csv"].frame(rows)


def _read_table(study: StudyTables) -> pd.DataFrame:
    """The rows of `read.csv`: what was left out or mended of each log, what changes figures first."""
    empty_row: dict[str, object] = {"number": 0, "what": "nothing was left out or mended", "changes": False}
    rows = [
        {"log": log.name, "topic": log.recording.topic, "frames": log.frames, "entries": log.object_states, **finding}
        | {"changes": "yes" if finding["changes"] else "no"}
        for log in study.logs
        for finding in sorted(list_read(log.recording) or [empty_row], key=lambda one: not one["changes"])
    ]
    return TABLES["read.csv"].frame(rows)


def _make_run_to_export(log: str, shown: ShownRun, study: StudyTables) -> RunToExport:
    """What exporters need of one run of a log: recording, replayed run, rows, summary and manifest, shown ones only."""
    study_log = study.find_log(log)
    replay, recording = study_log.replay(), study_log.whole()
    experiment = resolve_for_log(study.experiment, log)
    shown_experiment = experiment.model_copy(update={"configurations": experiment.shown()})
    names = list(shown_experiment.configurations)
    rows = study.rows(log, shown.run)
    manifest = {
        "copem_replay": version("copem-replay"),
        "experiment": dump_yaml(resolve_sweep(experiment).as_written() | {"logs": [recording.path.name]}),
        "log": log,
        "run": str(shown.run),
        "run_is": shown.why,
    }
    return RunToExport(
        recording,
        shown,
        replay_run(recording, shown_experiment, shown.run, replay),
        experiment.configurations,
        rows[rows["configuration"].isin(names)],
        study.summary[study.summary["configuration"].isin(names)],
        manifest,
        *study.events_of(log, shown.run),
    )


def _write_rows(study: StudyTables, scratch: Path) -> None:
    """Write detections, accuracy and tally in batches; a file by log if there are more than `MANY_ROWS` rows."""
    with ExitStack() as open_files:
        files: dict[str | Path, TableFile] = {}

        def add(name: str | Path, table: Any) -> None:
            if name not in files:
                (scratch / name).parent.mkdir(exist_ok=True)
                files[name] = open_files.enter_context(TableFile(scratch / name))
            files[name].add(table)

        many = sum(study.counts.values()) > MANY_ROWS
        for rows, parts in study.batches():
            for log, log_rows in rows.groupby("log", sort=False) if many else [("", rows)]:
                add("detections.parquet" if not many else table_file(Path("detections.parquet"), str(log)), log_rows)
            if study.bands is not None:
                for name, table in study.accuracy_of(parts, rows).items():
                    add(name, table)
    return_memory()
    if len(study.tally) <= MANY_ROWS:
        write_parquet(study.tally, scratch / "tally.parquet")
    else:
        (scratch / "tally.parquet").mkdir()
        for log, rows in study.tally.groupby("log", sort=False):
            write_parquet(rows, table_file(scratch / "tally.parquet", str(log)))

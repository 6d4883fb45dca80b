"""Beside each other: one run in the configurations that are compared, of one or several folders, in one recording.

A results folder holds no lists, but what made them: experiment, logs, seed. So the run is computed once more, and held
against the table of the folder.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from copem_replay.core.errors import InputError, OutputError
from copem_replay.core.tracks import SAME_INSTANT_NS
from copem_replay.experiment.drive import of_log
from copem_replay.experiment.schema import Configuration, Experiment
from copem_replay.pipeline.blocks import replay_block
from copem_replay.pipeline.prepare import prepare
from copem_replay.pipeline.selected_runs import STEM, OneRun, one_run
from copem_replay.results.belongings import list_made
from copem_replay.results.compare.comparable import check_comparable
from copem_replay.results.compare.inputs import read_folders
from copem_replay.results.compare.labels import Named, chosen, named
from copem_replay.results.read import Results, complete
from copem_replay.results.reread import read_again
from copem_replay.viewer.merge_experiments import Part, merged
from copem_replay.viewer.selection import in_parts


@dataclass(frozen=True)
class _Side:
    """What a folder has of the run. `labels`: by configuration of the folder, what it is called here."""

    results: Results
    labels: Mapping[str, str]
    one: OneRun
    rows: pd.DataFrame


def check_beside(path: Path) -> None:
    """Raise OutputError where a recording cannot be written under this name."""
    if path.suffix.lower() != ".rrd":
        raise OutputError(f"{path}: expected a name that ends with .rrd, found {path.name}")
    of_results = path.name == f"{STEM}.rrd" or path.name.startswith(f"{STEM}_")
    if of_results and (path.parent / "provenance.json").exists():
        raise OutputError(f"{path}: expected another name, found that of a recording of the results in that folder")


def write_beside(
    path: Path,
    folders: Sequence[Path],
    *,
    configurations: Sequence[str] | None = None,
    baseline: str | None = None,
    log: str | None = None,
    run: int | None = None,
) -> list[str]:
    """Write one run (None: the one that the baseline's folder shows) as a recording, differences marked.

    Configurations and baseline as in `compare`. Returns notes. Raises InputError, RecordingError where a
    log is not the one that was replayed, OutputError.
    """
    from copem_replay.viewer import write_rrd

    check_beside(path)
    read = read_folders(folders)
    check_comparable(read)
    wanted = chosen(named(read), configurations, baseline)
    _check_one_recording(list(dict.fromkeys(one.results for one in wanted)))
    used = [complete(results) for results in dict.fromkeys(one.results for one in wanted)]
    log, number = _which(used[0], used, log, run)
    for one in wanted:
        if one.configuration not in of_log(one.results.experiment, log).configurations:
            raise InputError(
                f"configuration {one.label}: log {log} has none of its units; choose another log with --log"
            )
    sides = [_side(results, [one for one in wanted if one.results is results], log, number) for results in used]
    parts = [Part(side.results.name, side.one.experiment, side.labels) for side in sides]
    experiment = merged(parts)
    experiment = experiment.model_copy(
        update={"configurations": {one.label: experiment.configurations[one.label] for one in wanted}}
    )
    recording = read_again(sides[0].results, log, experiment)
    for side in sides:
        if side.one.replay.scene.object_ids != recording.scene.object_ids:
            where = sides[0].results.folder
            raise InputError(f"{side.results.folder}: log {log}: expected the objects of {where}: `read` differs")
    run_tracks = {
        side.labels[name]: fused_tracks for side in sides for name, fused_tracks in side.one.run_tracks.whole().items()
    }
    table = pd.concat([side.rows.assign(configuration=side.rows["configuration"].map(side.labels)) for side in sides])
    for folder in folders:
        list_made(folder, [part.path(path) for part in in_parts([one.label for one in wanted], wanted[0].label)])
    write_rrd(
        path,
        prepare(recording, experiment, onsets_of=of_log(sides[0].results.experiment, log)),
        experiment.model_copy(update={"configurations": _every(read, experiment)}),
        [{one.label: run_tracks[one.label] for one in wanted}],
        table.reset_index(drop=True),
        _summary(sides, wanted),
        number,
        run_is=f"differences to {wanted[0].label}",
        baseline=wanted[0].label,
    )
    return [f"{path}: {line}" for line in _one_world(sides)]


def _every(read: Sequence[Results], experiment: Experiment) -> dict[str, Configuration]:
    """All configurations of all folders, in their order, those that are shown as in `experiment`.

    Colours go by their places: those of a folder's own files, as far as it is the first.
    """
    label_of = {(one.results, one.configuration): one.label for one in named(read)}
    found: dict[str, Configuration] = {}
    for results in read:
        for name, asked in results.experiment.configurations.items():
            label = label_of.get((results, name), f"{results.name}:{name}")
            found[label] = experiment.configurations.get(label, asked)
    return found


def _check_one_recording(used: Sequence[Results]) -> None:
    """Raise InputError where folders are of several recordings of a drive: one picture has what one of them holds."""
    expected = {(log.name, log.sha256) for log in used[0].provenance.logs}
    for other in used[1:]:
        for log in other.provenance.logs:
            if (log.name, log.sha256) not in expected:
                where = used[0].folder
                raise InputError(
                    f"{other.folder}: log {log.name}: expected the recording of {where}, found another of the same "
                    "drive: they cannot be shown together; compare them without --rrd"
                )


def _which(first: Results, every: Sequence[Results], log: str | None, run: int | None) -> tuple[str, int]:
    """The log and the run, as asked for or as the first folder shows them. Raises InputError."""
    names = [file.name for file in first.provenance.logs]
    if log is not None and log not in names:
        raise InputError(f"--log: expected one of {', '.join(names)}, found {log!r}")
    log = log if log is not None else next((name for name in names if name in first.provenance.run_shown), names[0])
    number = run if run is not None else first.provenance.run_shown.get(log, 0)
    runs = min(results.experiment.runs for results in every)
    if not 0 <= number < runs:
        raise InputError(f"--run: expected 0 to {runs - 1}, the runs that all folders have, found {number}")
    return log, number


def _side(results: Results, wanted: Sequence[Named], log: str, run: int) -> _Side:
    """One folder's part of the run, computed once more. Raises InputError where its table says otherwise."""
    labels = {one.configuration: one.label for one in wanted}
    alone = of_log(results.experiment, log)
    kept = {name: configuration for name, configuration in alone.configurations.items() if name in labels}
    experiment = alone.model_copy(update={"configurations": kept, "sweep": None})
    one = one_run(read_again(results, log, experiment), experiment, run)
    (every,) = results.each(log=log)
    rows = every[(every["run"] == run) & every["configuration"].isin(list(kept))].assign(log=log)
    again = replay_block(one.replay, one.experiment, np.array([run]))
    keys = ["configuration", "object_id"]
    times = [table.set_index(keys)["detection_s"].sort_index() for table in (rows, again)]
    same = times[0].index.equals(times[1].index) and np.allclose(
        times[0], times[1], rtol=0, atol=SAME_INSTANT_NS / 1e9, equal_nan=True
    )
    if not same:
        raise InputError(
            f"{results.folder}: log {log}: run {run} comes out otherwise than in detections.parquet: another version "
            "made it; run the experiment again with --overwrite"
        )
    return _Side(results, labels, one, rows)


def _summary(sides: Sequence[_Side], wanted: Sequence[Named]) -> pd.DataFrame:
    """The summaries, one under the other, in the order of the configurations."""
    tables = []
    for side in sides:
        mine = side.results.summary
        mine = mine[mine["configuration"].isin(list(side.labels))]
        tables.append(mine.assign(configuration=mine["configuration"].map(side.labels)))
    return pd.concat(tables).set_index("configuration").loc[[one.label for one in wanted]].reset_index()


def _one_world(sides: Sequence[_Side]) -> list[str]:
    """What of the world the folders do not share: it can be shown only once."""
    first = sides[0].results
    return [
        f"{key} differ; those of {first.folder} are shown"
        for key in ("obstacles", "visibility")
        if any(getattr(side.results.experiment, key) != getattr(first.experiment, key) for side in sides)
    ]

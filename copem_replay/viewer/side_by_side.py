"""Side by side: one run in compared configurations, of one or several results folders, as one Rerun recording.

A results folder holds no lists, but experiment, logs and seed, which determine them. So the run is computed again and
checked against the table of its folder. The experiments of the folders are joined into one; nothing is drawn with it,
since random keys hold names of units, and different units of one name get other names in it.

Configurations are held against one of them, or each against itself in an older folder, where it is paler.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from copem_replay.communication.link import LinkModel
from copem_replay.core.colours import TRUTH, Rgb, configuration_colours
from copem_replay.core.errors import InputError, OutputError
from copem_replay.core.files import remove_leftovers
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.experiment.schema import Configuration, Experiment, Unit
from copem_replay.io.recording import Recording
from copem_replay.metrics.columns import FALSE_TRACKS
from copem_replay.perception.pem.model import Pem
from copem_replay.pipeline.one_run import ReplayedRun
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.results.again import replay_again
from copem_replay.results.compare.compare import read_folders
from copem_replay.results.compare.labels import (
    LabelledConfiguration,
    check_comparable,
    label_configurations,
    name_folders,
    pair_configurations,
)
from copem_replay.results.folder import add_to_made_list
from copem_replay.results.outputs import check_output
from copem_replay.results.read import Results, check_complete
from copem_replay.viewer.sink import split_into_files


@dataclass(frozen=True)
class ComparedExperiment:
    """An experiment, the name of its folder, and the labels of its configurations in the joined experiment."""

    name: str
    experiment: Experiment
    labels: Mapping[str, str]


def join_experiments(parts: Sequence[ComparedExperiment]) -> Experiment:
    """The first experiment with units, PEMs, links and configurations of all."""
    units: dict[str, Unit] = {}
    pems: dict[str, Pem] = {}
    configurations: dict[str, Configuration] = {}
    links: dict[str, LinkModel] = {}
    for part in parts:
        unit_names: dict[str, str] = {}
        for name, unit in part.experiment.units.items():
            pem = None if unit.pem is None else part.experiment.pems[unit.pem]
            unit_names[name] = _choose_unit_name(name, part.name, unit, pem, units, pems)
            units[unit_names[name]] = unit if pem is None else unit.model_copy(update={"pem": unit_names[name]})
            if pem is not None:
                pems[unit_names[name]] = pem
        part_links = part.experiment.links
        link_names = {
            name: name if links.get(name, link) == link else f"{part.name}:{name}" for name, link in part_links.items()
        }
        links |= {link_names[name]: link for name, link in part_links.items()}
        for name, label in part.labels.items():
            configurations[label] = _rename_members(
                part.experiment, part.experiment.configurations[name], unit_names, link_names
            )
    changed = {"units": units, "pems": pems, "links": links, "configurations": configurations, "sweep": None}
    return parts[0].experiment.model_copy(update=changed)


def _choose_unit_name(
    name: str, folder: str, unit: Unit, pem: Pem | None, units: Mapping[str, Unit], pems: Mapping[str, Pem]
) -> str:
    """The unit's own name if it is free or belongs to an equal unit; else with the folder's name before it."""
    choice = name
    while choice in units:
        same = units[choice].model_copy(update={"pem": None}) == unit.model_copy(update={"pem": None})
        if same and pems.get(choice) == pem:
            break
        choice = f"{folder}:{choice}"
    return choice


def _rename_members(
    experiment: Experiment, configuration: Configuration, unit_names: Mapping[str, str], link_names: Mapping[str, str]
) -> Configuration:
    """The configuration with its units and links called as in the joined experiment; both: new name by old one."""
    changed: dict[str, object] = {}
    if configuration.units != "truth":
        changed["units"] = tuple(unit_names[name] for name in experiment.units_of(configuration))
    if configuration.inputs is not None:
        changed["inputs"] = tuple(unit_names[name] for name in configuration.inputs)
    if isinstance(configuration.latency_s, dict):
        changed["latency_s"] = {unit_names.get(unit, unit): late for unit, late in configuration.latency_s.items()}
    if isinstance(configuration.link, str):
        changed["link"] = link_names.get(configuration.link, configuration.link)
    if isinstance(configuration.link, dict):
        changed["link"] = {
            unit_names.get(unit, unit): link_names.get(link, link) for unit, link in configuration.link.items()
        }
    return configuration.model_copy(update=changed)


@dataclass(frozen=True)
class _Side:
    """One folder's part of the run: replayed tracks and rows of its table. `labels`: by name of its configurations."""

    results: Results
    labels: Mapping[str, str]
    one: ReplayedRun
    rows: pd.DataFrame


def check_side_by_side(path: Path) -> None:
    """Raise OutputError for a path that is no .rrd, or may not be written."""
    if path.suffix.lower() != ".rrd":
        raise OutputError(f"{path}: expected a name that ends with .rrd, found {path.name}")
    check_output(path)


def write_side_by_side(
    path: Path,
    folders: Sequence[Path],
    *,
    configurations: Sequence[str] | None = None,
    baseline: str | None = None,
    log: str | None = None,
    run: int | None = None,
) -> list[str]:
    """Write one run (None: the one shown in the baseline's folder) as a recording with marked differences.

    Configurations and baselines as in `compare`. Returns notes. Raises InputError; RecordingError if a log is not the
    one that was replayed; OutputError.
    """
    from copem_replay.viewer import write_rrd

    check_side_by_side(path)
    all_results = read_folders(folders)
    check_comparable(all_results)
    pairs = pair_configurations(all_results, configurations, baseline)
    if configurations is None:  # the truth is in every view: beside others it is left out
        pairs = {one: other for one, other in pairs.items() if not one.facts.truth} or pairs
    named = list(dict.fromkeys(choice for pair in pairs.items() for choice in reversed(pair)))  # baselines first
    labels = [choice.label for choice in named]
    baselines = {one.label: other.label for one, other in pairs.items()}
    versions = baseline is None and len(all_results) == 2
    _check_one_recording(list(dict.fromkeys(choice.results for choice in named)))
    opened = [check_complete(results) for results in dict.fromkeys(choice.results for choice in named)]
    log, shown_run = _choose_run(opened[0], opened, log, run)
    sides = _replay_sides(opened, named, log, shown_run)
    experiment = _join_sides(sides, labels)
    recording = _reread_truth(sides, log, experiment)
    run_tracks = {side.labels[name]: fused for side in sides for name, fused in side.one.run_tracks.whole().items()}
    table = pd.concat([side.rows.assign(configuration=side.rows["configuration"].map(side.labels)) for side in sides])
    files = [part.path(path) for part in split_into_files(labels, baselines)]
    for file in files:
        check_output(file)
        remove_leftovers(file)
    for folder in folders:
        add_to_made_list(folder, files)
    write_rrd(
        path,
        prepare_log(recording, experiment, onsets_of=resolve_for_log(sides[0].results.experiment, log)),
        experiment.model_copy(update={"configurations": _list_configurations(all_results, experiment)}),
        [{label: run_tracks[label] for label in labels}],
        table.reset_index(drop=True),
        _join_summaries(sides, labels),
        shown_run,
        run_is=f"differences to {name_folders(all_results)[0] if versions else labels[0]}",
        baselines=baselines,
        of_one=len(opened) == 1,
        false_tracks=_join_false_tracks(sides, log, shown_run),
        colours=_colour_versions(named, list(pairs.values())) if versions else None,
    )
    return [f"{path}: {line}" for line in _note_other_worlds(sides)]


def _colour_versions(chosen: Sequence[LabelledConfiguration], older: Sequence[LabelledConfiguration]) -> dict[str, Rgb]:
    """Colours by label: those that configurations have in all files of their experiment; of the older ones paler."""
    colours: dict[str, Rgb] = {}
    for labelled in chosen:
        truths = [name for name, facts in labelled.results.facts.items() if facts.truth]
        colours_of = configuration_colours(labelled.results.experiment.configurations, truths)
        red, green, blue = ((a + b) // 2 for a, b in zip(colours_of[labelled.configuration], TRUTH, strict=True))
        colours[labelled.label] = (red, green, blue) if labelled in older else colours_of[labelled.configuration]
    return colours


def _replay_sides(opened: Sequence[Results], named: Sequence[LabelledConfiguration], log: str, run: int) -> list[_Side]:
    """The run of every folder. Raises InputError for a configuration without units in the log."""
    for choice in named:
        if choice.configuration not in resolve_for_log(choice.results.experiment, log).configurations:
            raise InputError(
                f"configuration {choice.label}: log {log} has none of its units; choose another log with --log"
            )
    return [
        _replay_side(results, [choice for choice in named if choice.results is results], log, run) for results in opened
    ]


def _join_sides(sides: Sequence[_Side], labels: Sequence[str]) -> Experiment:
    """The experiments of all folders as one, with the labelled configurations in their order."""
    parts = [ComparedExperiment(side.results.name, side.one.experiment, side.labels) for side in sides]
    experiment = join_experiments(parts)
    configurations = {label: experiment.configurations[label] for label in labels}
    return experiment.model_copy(update={"configurations": configurations})


def _reread_truth(sides: Sequence[_Side], log: str, experiment: Experiment) -> Recording:
    """The first folder's recording. Raises InputError if another folder read other objects from it."""
    recording = sides[0].results.recording(log, experiment)
    for side in sides:
        if side.one.replay.scene.object_ids != recording.scene.object_ids:
            first_folder = sides[0].results.place
            raise InputError(f"{side.results.place}: log {log}: expected the objects of {first_folder}: `read` differs")
    return recording


def _list_configurations(all_results: Sequence[Results], experiment: Experiment) -> dict[str, Configuration]:
    """By label all configurations of all folders in their order, shown ones as in `experiment`. Colours depend on this
    order: configurations of the first folder have the colours of its own files.
    """
    labelled = label_configurations(all_results)
    label_of = {(choice.results, choice.configuration): choice.label for choice in labelled}
    configurations: dict[str, Configuration] = {}
    for results in all_results:
        for name, configuration in results.experiment.configurations.items():
            label = label_of.get((results, name), f"{results.name}:{name}")
            configurations[label] = experiment.configurations.get(label, configuration)
    return configurations


def _check_one_recording(opened: Sequence[Results]) -> None:
    """Raise InputError if folders are of different recordings of a drive: a picture holds the truth of one."""
    expected = {(log.name, log.sha256) for log in opened[0].provenance.logs}
    for results in opened[1:]:
        for log in results.provenance.logs:
            if (log.name, log.sha256) not in expected:
                first_folder = opened[0].place
                raise InputError(
                    f"{results.place}: log {log.name}: expected the recording of {first_folder}, found another "
                    "of the same drive: they cannot be shown together; compare them without --rrd"
                )


def _choose_run(first: Results, all_results: Sequence[Results], log: str | None, run: int | None) -> tuple[str, int]:
    """Log and run: the given ones, else those that the first folder shows. Raises InputError for others than it has."""
    names = [file.name for file in first.provenance.logs]
    if log is not None and log not in names:
        raise InputError(f"--log: expected one of {', '.join(names)}, found {log!r}")
    log = log if log is not None else next((name for name in names if name in first.provenance.run_shown), names[0])
    number = run if run is not None else first.provenance.run_shown.get(log, 0)
    runs = min(results.experiment.runs for results in all_results)
    if not 0 <= number < runs:
        raise InputError(f"--run: expected 0 to {runs - 1}, the runs that all folders have, found {number}")
    return log, number


def _replay_side(results: Results, chosen: Sequence[LabelledConfiguration], log: str, run: int) -> _Side:
    """One folder's part of the run, computed again. Raises InputError if its table differs."""
    labels = {replayed.configuration: replayed.label for replayed in chosen}
    replayed, rows = replay_again(results, log, run, labels)
    return _Side(results, labels, replayed, rows)


def _join_false_tracks(sides: Sequence[_Side], log: str, run: int) -> pd.DataFrame | None:
    """The folders' rows of `false_tracks.parquet` of the run; None: one has none."""
    if not all(side.results.has(FALSE_TRACKS) for side in sides):
        return None
    tables = [(side, side.results.frame(FALSE_TRACKS)) for side in sides]
    labelled = [rows.assign(configuration=rows["configuration"].map(side.labels)) for side, rows in tables]
    rows = pd.concat(labelled).dropna(subset="configuration")
    return rows[(rows["log"] == log) & (rows["run"] == run)]


def _join_summaries(sides: Sequence[_Side], labels: Sequence[str]) -> pd.DataFrame:
    """The rows of the folders' summaries, in the order of the configurations."""
    tables = []
    for side in sides:
        summary = side.results.summary
        summary = summary[summary["configuration"].isin(list(side.labels))]
        tables.append(summary.assign(configuration=summary["configuration"].map(side.labels)))
    return pd.concat(tables).set_index("configuration").loc[list(labels)].reset_index()


def _note_other_worlds(sides: Sequence[_Side]) -> list[str]:
    """Notes on settings of the world that differ between folders: only the first folder's are shown."""
    first = sides[0].results
    return [
        f"{key} differ; those of {first.place} are shown"
        for key in ("obstacles", "visibility")
        if any(getattr(side.results.experiment, key) != getattr(first.experiment, key) for side in sides)
    ]

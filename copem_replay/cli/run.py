"""`copem-replay run`: replay an experiment into a results folder."""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from copem_replay.cli.inspect import override_source
from copem_replay.cli.terminal import (
    By,
    Ego,
    FromS,
    Logs,
    ToS,
    print_answer,
    print_first_notes,
    print_line,
    print_notes,
    print_problems,
    print_rows,
    print_table,
    print_verdicts,
    show_progress,
    split_entries,
    width_of,
)
from copem_replay.core.errors import InputError, is_url
from copem_replay.core.extras import load_extra

if TYPE_CHECKING:
    import pandas as pd

    from copem_replay.api.study import LoadedStudy
    from copem_replay.experiment.file import ExperimentSource
    from copem_replay.experiment.schema import Experiment
    from copem_replay.pipeline.expansion import ConfigurationFacts
    from copem_replay.pipeline.parts import PartCache
    from copem_replay.pipeline.run import StudyTables
    from copem_replay.results.decision import Decision
    from copem_replay.results.folder import ResultsPlace
    from copem_replay.results.read import Results
    from copem_replay.results.verdicts import Judgement

Pieces: TypeAlias = Annotated[
    str | None, typer.Option(metavar="FOLDER", help="Keep finished parts here, and reuse them: a folder or a URL.")
]
Cluster: TypeAlias = Annotated[
    str | None,
    typer.Option(
        metavar="WHERE",
        help="Use Dask processes instead of threads: local, local:N, tcp://HOST:PORT, tls://… or scheduler.json.",
    ),
]

ADVICE_AFTER_S, ADVICE_CORES = 60.0, 4
"""Processes are advised for replays that take longer, on more cores: a study of seconds takes longer with them."""


def run(
    experiment: Annotated[
        list[Path],
        typer.Argument(
            metavar="EXPERIMENT", help="Experiment file (YAML); or recordings, which `init` drafts one for."
        ),
    ],
    log: Logs = None,
    ego: Ego = None,
    from_s: FromS = None,
    to_s: ToS = None,
    out: Annotated[Path | None, typer.Option(metavar="FOLDER", help="Results folder [out/<experiment>].")] = None,
    runs: Annotated[int | None, typer.Option(metavar="N", min=1, help="Number of runs.")] = None,
    by: By = None,
    seed: Annotated[int | None, typer.Option(metavar="N", help="Seed of all random numbers.")] = None,
    jobs: Annotated[
        int | None, typer.Option(metavar="N", min=1, max=1024, help="Number of workers [one per core].")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the results in the folder.")] = False,
    skip_unreadable: Annotated[
        bool, typer.Option("--skip-unreadable", help="Leave out recordings that cannot be replayed.")
    ] = False,
    pieces: Pieces = None,
    cluster: Cluster = None,
    report: Annotated[bool, typer.Option("--report", help="Also write report.html.")] = False,
    label: Annotated[str | None, typer.Option(metavar="TEXT", help="Name of these results in a history.")] = None,
    explain: Annotated[bool, typer.Option("--explain", help="Print every figure, and what it means.")] = False,
    live: Annotated[bool, typer.Option("--live", help="Also show the replay in a running Rerun viewer.")] = False,
    viewer: Annotated[str | None, typer.Option(metavar="URL", help="Address of that viewer [on this machine].")] = None,
) -> int:
    """Replay an experiment, write its results, print the summary.

    For recordings the draft that `init` would print is replayed; it is experiment.yaml in the results folder.
    """
    from copem_replay.pipeline.parts import PartCache
    from copem_replay.results.decision import decide, describe_verdicts
    from copem_replay.results.folder import EXPERIMENT, take_place
    from copem_replay.results.outputs import check_outputs

    source = _read_source(experiment)
    source = override_source(
        source, {"ego": ego, "runs": runs, "seed": seed}, log or (), (from_s, to_s), split_entries(by)
    )
    out = out or Path("out") / (experiment[0].stem if len(experiment) == 1 else "drives")
    if cluster is not None:
        load_extra("workers", "address")(cluster)
        pieces = pieces or f"{out}.pieces"
    check_outputs({"--out": out, "--pieces": None if pieces is None or is_url(pieces) else Path(pieces)})
    with take_place(out, overwrite=overwrite) as place:
        print_notes(place.notes)
        place.notes.clear()
        cache = None if pieces is None else PartCache(pieces)
        study = _read_study(place, experiment, source, skip_unreadable, cache, cluster)
        url = _check_viewer(study.experiment, viewer) if live or viewer is not None else None
        tables, advice = _replay_study(study, jobs, cache, threads=cluster is None)
        results = _write_results(place, study, tables, advice, cache, url, label, explain=explain)
        decision = decide(results)
        _print_results(tables, results, decision, explain=explain)
        if by is not None and tables.summary_by is not None:
            _print_groups(tables.summary_by, split_entries(by) or ())
        verdicts = _judge_results(results)
        if report:
            from copem_replay.api.results import write_report

            print_line(f"report in {write_report(place.shown)}")
    drafted = "" if source.path in experiment else f", drafted as by init ({EXPERIMENT})"
    print_line(f"results in {place.shown}{drafted}{'' if explain else '; every figure: --explain'}")
    _print_next(place.shown)
    print_answer(decision.sentences if verdicts is None else [describe_verdicts(verdicts)])
    return 1 if study.skipped or place.failed or not (verdicts is None or verdicts.passes) else 0


def _read_source(paths: Sequence[Path]) -> ExperimentSource:
    """The experiment of a file, or the draft for recordings. Raises InputError, RecordingError."""
    from copem_replay.experiment.file import is_recording, read_experiment_file, read_experiment_text

    if not all(map(is_recording, paths)):
        if len(paths) > 1:
            raise InputError(f"expected one experiment, or recordings, found {', '.join(map(str, paths))}")
        return read_experiment_file(paths[0])
    from copem_replay.api.recordings import draft_drives, explain_undrafted

    text, surveys = draft_drives(paths)
    if text is None:
        raise InputError(explain_undrafted(surveys))
    named = ", ".join(path.name for path in paths)  # without a folder: the draft names recordings from the working one
    return read_experiment_text(Path(f"draft of {named}"), text)


def _judge_results(results: Results) -> Judgement | None:
    """Judge the criteria of an experiment, write and print the verdicts; None: there are none. Those that are against
    results of before are left to `verdict`.
    """
    if not results.experiment.criteria:
        return None
    from copem_replay.results.judge import judge_own_criteria, list_later
    from copem_replay.results.verdicts import FILE, write_verdicts

    if later := list_later(results):
        command = f"copem-replay verdict {results.place} --before FOLDER"
        print_notes([f"criteria {', '.join(later)}: `{command}` judges them"])
    if (verdicts := judge_own_criteria(results)) is None:
        return None
    write_verdicts(verdicts, results.place / FILE)
    print_notes(verdicts.notes)
    print_line("")
    print_verdicts(verdicts)
    return verdicts


def _read_study(
    place: ResultsPlace, files: Sequence[Path], source: ExperimentSource, skip_unreadable: bool,
    cache: PartCache | None, cluster: str | None,
) -> LoadedStudy:  # fmt: skip
    """The experiment and its recordings; with `cluster` every part is computed when this returns."""
    from copem_replay.api.run import list_exporters
    from copem_replay.api.study import read_study
    from copem_replay.pipeline.study_log import LogSurvey
    from copem_replay.results.folder import check_inputs
    from copem_replay.results.write import check_own_files

    with nullcontext() if cluster is None else load_extra("workers", "cluster")(cluster, cache) as crew:

        def read() -> LoadedStudy:
            study = read_study(source, skip_unreadable=skip_unreadable, survey=LogSurvey(cache), crew=crew)
            check_inputs(place, [*files, *(path for log in study.logs for path in log.paths)])
            check_own_files(place, study.experiment, study.logs, list_exporters())
            return study

        return read() if crew is None else crew.read_study(read)


def _replay_study(
    study: LoadedStudy, jobs: int | None, cache: PartCache | None, *, threads: bool
) -> tuple[StudyTables, list[str]]:
    """Replay with progress on stderr. Returns what it gives and, where `threads` do it, the advice on `--cluster`."""
    from copem_replay.api.run import count_workers, replay_study
    from copem_replay.api.study import prepare_study

    replays, warnings = prepare_study(study)
    print_notes(warnings)
    began_s = time.perf_counter()
    tables = show_progress("replaying", lambda progress: replay_study(study, replays, jobs, progress, cache))
    return tables, advise_cluster(time.perf_counter() - began_s, count_workers(jobs)) if threads else []


def _write_results(
    place: ResultsPlace, study: LoadedStudy, tables: StudyTables, advice: list[str], cache: PartCache | None,
    viewer: str | None, label: str | None, *, explain: bool,
) -> Results:  # fmt: skip
    """Fill the results folder, then print notes and problems. Returns the results."""
    from copem_replay.api.run import list_exporters
    from copem_replay.results.read import Results
    from copem_replay.results.write import fill_place

    notes = fill_place(place, tables, exporters=list_exporters(viewer), skipped=study.skipped, label=label)
    if cache is not None:
        print_notes(sorted(cache.damaged))
        print_problems([f"pieces: {cache.computed} computed, {cache.found} found in {cache.store.where}"])
    skipped = [f"{path}: skipped: {reason}" for path, reason in study.skipped]
    print_notes([*place.notes, *skipped])
    print_first_notes(notes, explain=explain)
    print_notes([*tables.costs, *advice])
    print_problems(place.failed)
    return Results(place.shown)


def _print_results(tables: StudyTables, results: Results, decision: Decision, *, explain: bool) -> None:
    """Print the summary: what fits a screen, or every figure and what it means."""
    from copem_replay.results.screen import format_screen

    summary = tables.summary  # as it was computed: nine digits are on the edge of a rounding where it is not
    if explain:
        _print_summary(results, summary, decision)
    else:
        lines, marked = format_screen(results, summary, decision.best)
        print_rows(lines, marked)
    if tables.sweep is not None:
        print_line(f"sweep of {', '.join(dict.fromkeys(tables.sweep['sweep']))} in {results.place / 'sweep.csv'}")


def _print_summary(results: Results, summary: pd.DataFrame, decision: Decision) -> None:
    """Print every figure of the summary, what it means, and what later commands hold the others against."""
    from copem_replay.core.tracks import TRUTH
    from copem_replay.metrics.summary import describe_began, format_summary

    print_table(format_summary(summary, width_of(sys.stdout)), decision.best)
    configurations = results.experiment.configurations
    if len(results.tally):
        modelled = (name for name, one in configurations.items() if one.units != TRUTH)
        reference, words = next(modelled, next(iter(configurations))), results.experiment.measure.began
        print_line(describe_began(results.tally, reference, results.provenance.horizon_used_s, words))
    _print_baseline(results.facts)


def _print_groups(table: pd.DataFrame, entries: Sequence[str]) -> None:
    """Print the slices that the command line asks for."""
    from copem_replay.metrics.config import parse_slice
    from copem_replay.results.slices import groups_text

    asked = table["by"].isin([parse_slice(entry).label for entry in entries])
    print(f"\n{groups_text(table[asked], width_of(sys.stdout))}\n")


def _print_baseline(facts: dict[str, ConfigurationFacts]) -> None:
    """Print which configuration `compare` and `report` hold the others against."""
    from copem_replay.results.compare.labels import find_baseline

    if len(facts) > 1:
        baseline = find_baseline(facts, list(facts))
        print_line(f"baseline of compare and report: {baseline.name}, {baseline.why}")


def _print_next(folder: Path) -> None:
    """Print the command to go on with: `view` if the folder has a recording for the viewer, else `report`."""
    from copem_replay.viewer.open import list_rrd_files

    print_line(f"next: copem-replay {'view' if list_rrd_files(folder) else 'report'} {shlex.quote(str(folder))}")


def _check_viewer(experiment: Experiment, url: str | None) -> str:
    """The address of the viewer for `--live`. Raises InputError before the replay: no viewer there, nothing to show."""
    from copem_replay.viewer import VIEWER, check_viewer

    if experiment.show is None or experiment.show.run is None:
        raise InputError("--live: nothing to show: the experiment has `show: null` or `show: {run: null}`")
    check_viewer(url or VIEWER)
    return url or VIEWER


def advise_cluster(took_s: float, cores: int) -> list[str]:
    """A line that recommends `--cluster` after a long replay in threads on many cores; else no line."""
    if took_s <= ADVICE_AFTER_S or cores <= ADVICE_CORES:
        return []
    return [f"replaying took {took_s:.0f} s; `--cluster local` makes more of {cores} cores: its workers are processes"]

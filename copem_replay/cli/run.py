"""The command that replays: run."""

from __future__ import annotations

import shlex
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from copem_replay.cli.cluster import crew_at, hint
from copem_replay.cli.inspect import source_with
from copem_replay.cli.options import Ego, ExperimentFile, FromS, Logs, ToS
from copem_replay.cli.progress import with_progress
from copem_replay.cli.terminal import complain, note, say, width_of
from copem_replay.core.errors import InputError

if TYPE_CHECKING:
    from copem_replay.experiment.schema import Experiment


def run(
    experiment: ExperimentFile,
    log: Logs = None,
    ego: Ego = None,
    from_s: FromS = None,
    to_s: ToS = None,
    out: Annotated[Path | None, typer.Option(metavar="FOLDER", help="Results folder [out/<experiment>].")] = None,
    runs: Annotated[int | None, typer.Option(metavar="N", min=1, help="Number of runs.")] = None,
    seed: Annotated[int | None, typer.Option(metavar="N", help="Seed of all random numbers.")] = None,
    jobs: Annotated[
        int | None, typer.Option(metavar="N", min=1, max=1024, help="Number of workers [one per core].")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the results in the folder.")] = False,
    skip_unreadable: Annotated[
        bool, typer.Option("--skip-unreadable", help="Leave out recordings that cannot be replayed.")
    ] = False,
    pieces: Annotated[
        str | None,
        typer.Option(metavar="FOLDER", help="Keep finished pieces here, and reuse them: a folder or a URL."),
    ] = None,
    cluster: Annotated[
        str | None,
        typer.Option(
            metavar="WHERE",
            help="Use Dask processes instead of threads: local, local:N, tcp://HOST:PORT, tls://… or scheduler.json.",
        ),
    ] = None,
    report: Annotated[bool, typer.Option("--report", help="Also write report.html.")] = False,
    live: Annotated[bool, typer.Option("--live", help="Also show the replay in a running Rerun viewer.")] = False,
    viewer: Annotated[str | None, typer.Option(metavar="URL", help="Address of that viewer [on this machine].")] = None,
) -> int:
    """Replay an experiment, write its results, print the summary."""
    from copem_replay.cli.api.run import pieces_in, with_crew, workers
    from copem_replay.cli.api.study import Study, prepared, read_study
    from copem_replay.pipeline.log_survey import LogSurvey
    from copem_replay.results.place import check_inputs, taken

    source = source_with(experiment, {"ego": ego, "runs": runs, "seed": seed}, log or (), (from_s, to_s))
    out = out or Path("out") / experiment.stem
    if cluster is not None:
        from copem_replay.pipeline.crew.dask_workers import check_address

        check_address(cluster)
        pieces = pieces or f"{out}.pieces"
    with taken(out, overwrite=overwrite) as place:
        note(place.notes)
        place.notes.clear()
        kept = None if pieces is None else pieces_in(pieces)
        with crew_at(cluster, kept) as crew:

            def read() -> Study:
                study = read_study(source, skip_unreadable=skip_unreadable, survey=LogSurvey(kept), crew=crew)
                check_inputs(place, [experiment, *(path for recording in study.recordings for path in recording.paths)])
                return study

            study = read() if crew is None else with_crew(read, crew)
        url = _viewer(study.experiment, viewer) if live or viewer is not None else None
        from copem_replay.cli.api.run import fill, replayed
        from copem_replay.metrics.summary_text import summary_text
        from copem_replay.viewer.opening import recordings_of

        ready, warnings = prepared(study)
        note(warnings)
        began_s = time.perf_counter()
        result = with_progress("replaying", lambda progress: replayed(study, ready, jobs, progress, kept))
        costs = list(result.replayed.costs)
        if cluster is None:
            costs += hint(time.perf_counter() - began_s, workers(jobs))
        notes = fill(place, result, skipped=study.skipped, viewer=url)
        if kept is not None:
            note(sorted(kept.damaged))
            complain([f"pieces: {kept.computed} computed, {kept.found} found in {kept.store.where}"])
        skipped = [f"{path}: skipped: {reason}" for path, reason in study.skipped]
        note([*place.notes, *skipped, *notes, *costs])
        complain(place.failed)
        print(summary_text(result.summary, width_of(sys.stdout)))
        if result.sweep is not None:
            say(f"sweep of {', '.join(dict.fromkeys(result.sweep['sweep']))} in {place.shown / 'sweep.csv'}")
        say(f"results in {place.shown}")
        if report:
            from copem_replay.cli.api.results import write_report

            say(f"report in {write_report(place.shown)}")
    say(f"next: copem-replay {'view' if recordings_of(place.shown) else 'report'} {shlex.quote(str(place.shown))}")
    return 1 if study.skipped or place.failed else 0


def _viewer(experiment: Experiment, url: str | None) -> str:
    """Where a viewer listens; refused before the replay where there is none, or nothing to show in it."""
    from copem_replay.viewer import VIEWER, check_viewer

    if experiment.show is None or experiment.show.run is None:
        raise InputError("--live: nothing to show, the experiment says so (`show: null`, or its `run`)")
    check_viewer(url or VIEWER)
    return url or VIEWER

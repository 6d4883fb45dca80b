"""The command line: each command a few lines around a library call, and one place where errors become exit codes.

0 done · 1 done, but a log was skipped · 2 the input was wrong: plain lines on stderr · 70 a defect of ours: traceback ·
130 interrupted.
"""

from __future__ import annotations

import sys

try:  # before `main` is there to catch it
    import gc
    import io
    import os
    import signal
    import traceback
    import unicodedata
    from collections.abc import Callable, Iterable, Sequence
    from contextlib import suppress
    from pathlib import Path
    from typing import Annotated, Any

    import typer

    import copem_replay
    from copem_replay.cli import convert
    from copem_replay.core.errors import CopemError, InputError, OutputError
except KeyboardInterrupt:
    print("interrupted", file=sys.stderr)
    sys.exit(130)

app = typer.Typer(
    help="Replay recorded traffic through perception error models of one or many cooperating units.",
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

app.add_typer(convert.app, name="convert")

ExperimentFile = Annotated[Path, typer.Argument(metavar="EXPERIMENT", help="Experiment file (YAML).")]


@app.callback(invoke_without_command=True)
def version(
    context: typer.Context,
    show: Annotated[bool, typer.Option("--version", help="Print the version.", is_eager=True)] = False,
) -> None:
    """Print the version."""
    if show:
        from importlib.metadata import version as installed

        print(f"copem-replay {installed('copem-replay')}")
        raise typer.Exit(0)
    if context.invoked_subcommand is None:
        commands = ", ".join(typer.main.get_group(app).commands)
        raise InputError(f"copem-replay: expected a command, one of {commands}; --help tells more")


@app.command()
def info(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="Recordings: MCAP, rosbag2 folder, .osi.")],
    as_json: Annotated[bool, typer.Option("--json", help="As JSON, one array.")] = False,
) -> int:
    """What is in a recording: topics, object lists, objects, span, rate, ego vehicle, what is missing.

    Ends 0 when at least one object list could be read, else 2.
    """
    import json

    from copem_replay.experiment.draft.findings import as_json as plain
    from copem_replay.experiment.draft.survey import survey
    from copem_replay.experiment.draft.survey_text import describe

    surveys = [survey(log) for log in logs]
    if as_json:
        print(json.dumps([plain(s) for s in surveys], indent=1, ensure_ascii=False))
    else:
        _print_blocks(describe(s) for s in surveys if s.topics)
    _complain(s.reason for s in surveys if s.reason is not None)
    return 0 if any(s.readable for s in surveys) else 2


@app.command()
def init(log: Annotated[Path, typer.Argument(metavar="LOG", help="Recording: MCAP, rosbag2 folder, .osi.")]) -> int:
    """Print an experiment that replays a recording, with comments: copem-replay init LOG > experiment.yaml.

    Its paths are relative to where you are. Where no list is known by name, `read:` is proposed from the names of
    fields. Ends 2 when no list of true objects could be read.
    """
    from copem_replay.experiment.draft.survey import survey
    from copem_replay.experiment.draft.template import commented, proposed, unfinished

    found = survey(log)
    text = commented(found) if found.readable else proposed(found)
    if text is None:
        print(unfinished(found), end="")
        raise InputError(found.reason or f"{log}: no list of true objects")
    try:
        str(log).encode()
    except UnicodeEncodeError:
        raise InputError(f"{log}: its path is not UTF-8: no experiment could name it") from None
    print(text, end="")
    return 0


@app.command()
def check(
    experiment: ExperimentFile,
    log: Annotated[list[Path] | None, typer.Option(help="Check against this recording instead of those named.")] = None,
    ego: Annotated[str | None, typer.Option(metavar="ID", help="Object that is the ego vehicle.")] = None,
    from_s: Annotated[
        float | None, typer.Option("--from", metavar="S", help="Read what was logged from this instant on [the first].")
    ] = None,
    to_s: Annotated[
        float | None, typer.Option("--to", metavar="S", help="Read what was logged up to this instant [the last].")
    ] = None,
) -> int:
    """Every problem of an experiment file at once, with file and line, against its logs too."""
    source = _source(experiment, {"ego": ego}, log or [], (from_s, to_s))
    wanted, recordings, _skipped = _ready(source, skip_unreadable=False)
    from copem_replay.pipeline.run import notes_of

    prepared, warnings = _prepared(source, wanted, recordings)
    notes = notes_of(recordings, prepared, wanted, replayed=False) + warnings
    _complain(f"note: {note}" for note in notes)
    print(_printable(f"{experiment}: no problem found; logs: {', '.join(r.scene.log for r in recordings)}"))
    return 0


@app.command()
def run(
    experiment: ExperimentFile,
    log: Annotated[list[Path] | None, typer.Option(help="Replay this recording instead of those named.")] = None,
    ego: Annotated[str | None, typer.Option(metavar="ID", help="Object that is the ego vehicle.")] = None,
    from_s: Annotated[
        float | None, typer.Option("--from", metavar="S", help="Read what was logged from this instant on [the first].")
    ] = None,
    to_s: Annotated[
        float | None, typer.Option("--to", metavar="S", help="Read what was logged up to this instant [the last].")
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Results folder [out/<experiment>].")] = None,
    runs: Annotated[int | None, typer.Option(min=1, help="Number of runs.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of all random numbers.")] = None,
    jobs: Annotated[int | None, typer.Option(min=1, max=1024, help="Workers [one per core].")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the results that are there.")] = False,
    skip_unreadable: Annotated[
        bool, typer.Option("--skip-unreadable", help="Leave out logs that cannot be replayed.")
    ] = False,
    report: Annotated[bool, typer.Option("--report", help="Write report.html, too.")] = False,
    live: Annotated[bool, typer.Option("--live", help="Show the replay in a Rerun viewer that runs, too.")] = False,
    viewer: Annotated[
        str | None, typer.Option(metavar="URL", help="Where that viewer listens [on this machine].")
    ] = None,
) -> int:
    """Replay, measure, write the results folder, print the summary."""
    from copem_replay.results.place import check_inputs, taken

    source = _source(experiment, {"ego": ego, "runs": runs, "seed": seed}, log or [], (from_s, to_s))
    with taken(out or Path("out") / experiment.stem, overwrite=overwrite) as place:
        _complain(f"note: {note}" for note in place.notes)
        place.notes.clear()
        ready, recordings, skipped = _ready(source, skip_unreadable=skip_unreadable)
        check_inputs(place, [experiment, *(recording.path for recording in recordings)])
        url = _viewer(ready, viewer) if live or viewer is not None else None
        from copem_replay.metrics.summary_text import summary_text
        from copem_replay.pipeline.run import run as run_experiment
        from copem_replay.results.write import fill_place

        prepared, warnings = _prepared(source, ready, recordings)
        _complain(f"note: {warning}" for warning in warnings)
        result = _with_progress(
            lambda progress: run_experiment(ready, recordings, jobs=_workers(jobs), progress=progress, ready=prepared)
        )
        notes = fill_place(place, ready, recordings, result, skipped=skipped, viewer=url)
        notes = place.notes + [f"{path}: skipped: {reason}" for path, reason in skipped] + notes + list(result.costs)
        _complain(f"note: {note}" for note in notes)
        print(summary_text(result.summary))
        if result.sweep is not None:
            where = place.shown / "sweep.csv"
            print(_printable(f"sweep of {', '.join(dict.fromkeys(result.sweep['sweep']))} in {where}"))
        print(_printable(f"results in {place.shown}"))
        if report:
            from copem_replay.report import write_report

            print(_printable(f"report in {write_report(place.shown)}"))
    return 1 if skipped else 0


@app.command()
def compare(
    folders: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Results folders.")],
    configurations: Annotated[
        str | None, typer.Option(metavar="A,B,…", help="Only these, and the baseline [all].")
    ] = None,
    baseline: Annotated[
        str | None, typer.Option(metavar="C", help="What they are compared with [the one named ideal].")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write all of it as .csv, or the table as .md.")
    ] = None,
    ghosts_per_min: Annotated[
        float | None, typer.Option(metavar="X", min=0, help="Ghosts at which times are compared [the baseline's].")
    ] = None,
    rrd: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write one run in all of them as a Rerun recording (.rrd).")
    ] = None,
    run: Annotated[
        int | None, typer.Option(metavar="N", help="Run in that recording [as in the baseline's replay.rrd].")
    ] = None,
    log: Annotated[str | None, typer.Option(metavar="NAME", help="Log in that recording [likewise].")] = None,
) -> int:
    """Configurations with a baseline, paired on log, object and run, within or across results folders."""
    from copem_replay.results.compare import check_out, comparison_text, write_comparison
    from copem_replay.results.compare import compare as compared

    if out is not None:
        check_out(out)
    if rrd is not None:
        from copem_replay.viewer.side_by_side import check_beside, write_beside

        check_beside(rrd)
    elif run is not None or log is not None:
        raise InputError(f"--{'log' if run is None else 'run'}: expected --rrd FILE with it, found none")
    names = None if configurations is None else [name.strip() for name in configurations.split(",")]
    comparison = compared(folders, configurations=names, baseline=baseline, ghosts_per_min=ghosts_per_min)
    notes = list(comparison.notes)
    if rrd is not None:
        notes += write_beside(rrd, folders, configurations=names, baseline=baseline, log=log, run=run)
    _complain(f"note: {note}" for note in notes)
    _print_blocks([comparison_text(comparison).splitlines()])
    if out is not None:
        write_comparison(comparison, out)
    for file in (out, rrd):
        if file is not None:
            _tidied(file)
            print(_printable(f"written to {file}"))
    return 0


@app.command()
def plot(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Results folder.")],
    out: Annotated[Path | None, typer.Option(metavar="FOLDER", help="Where the figures go [DIR/figures].")] = None,
    configurations: Annotated[
        str | None, typer.Option(metavar="A,B,…", help="Only these; in the figure of runs four of them by default.")
    ] = None,
    run: Annotated[int | None, typer.Option(metavar="N", help="Run that is shown [as in replay.rrd].")] = None,
    object: Annotated[
        str | None, typer.Option(metavar="ID", help="Object whose runs are shown [the first in conflict].")
    ] = None,
    log: Annotated[str | None, typer.Option(metavar="NAME", help="Log of the runs shown [the first].")] = None,
) -> int:
    """Figures from a results folder, as PNG and SVG: single runs, distances, curves, and sweeps if there are some."""
    from copem_replay.report.figures import load_results, write_figures

    names = None if configurations is None else [name.strip() for name in configurations.split(",")]
    files, notes = write_figures(load_results(folder), out, configurations=names, log=log, object_id=object, run=run)
    _complain(f"note: {note}" for note in notes)
    figures = out or folder / "figures"
    _tidied(figures, figures)
    _tidied(figures)
    _print_blocks([[str(file) for file in files]])
    return 0


@app.command()
def report(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Results folder.")],
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Where it goes [DIR/report.html].")] = None,
    baseline: Annotated[
        str | None, typer.Option(metavar="C", help="What configurations are compared with [the one named ideal].")
    ] = None,
) -> int:
    """What a results folder says, as one HTML file that opens offline: words, tables, figures, provenance."""
    from copem_replay.report import write_report

    path = write_report(folder, out, baseline=baseline)
    _tidied(path)
    print(_printable(f"report in {path}"))
    return 0


@app.command()
def view(folder: Annotated[Path, typer.Argument(metavar="DIR", help="Results folder.")]) -> int:
    """Open the recordings of a results folder in the Rerun viewer."""
    import subprocess

    place = folder.absolute()  # no name that looks like an option
    found = (
        sorted(place.glob(pattern))
        for pattern in ("replay.rrd", "replay/**/*.rrd", "replay_*.rrd", "replay_*/**/*.rrd")
    )
    files = [path for paths in found for path in paths if path.is_file()]
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    if not files:
        raise InputError(f"{folder}: no replay.rrd in this folder; `show: {{run: 0}}` in an experiment writes one")
    # The module, not the script: it is there in every environment that has rerun-sdk, whatever the PATH.
    code = subprocess.call([sys.executable, "-m", "rerun", *map(str, files)])
    if code:
        raise OutputError(
            f"{folder}: the Rerun viewer could not be opened (it ended with {code}); without a display, copy "
            f"{files[0].name} to a desktop and open it there: rerun {files[0].name}"
        )
    return 0


@app.command()
def schema() -> int:
    """JSON Schema of the experiment file, with the components installed."""
    import json

    from copem_replay.experiment.schema import Experiment

    described = Experiment.model_json_schema(by_alias=True) | {
        "$schema": "https://json-schema.org/draft/2020-12/schema"
    }
    print(json.dumps(described, indent=1))
    return 0


def _source(
    path: Path, changes: dict[str, Any], logs: Sequence[Path], window_s: tuple[float | None, float | None]
) -> Any:
    """The experiment file, with what the options say instead where they are given."""
    from dataclasses import replace

    from copem_replay.experiment.file import load

    source = load(path)
    changes = {name: value for name, value in changes.items() if value is not None}
    source.data.update(changes)
    options: dict[Any, str] = {(name,): f"--{name}" for name in changes}
    ends = {k: option for k, option in enumerate(("--from", "--to")) if window_s[k] is not None}
    if ends:
        said = source.data.get("window_s")
        window = said if isinstance(said, list) and len(said) == len(window_s) else [None, None]
        source.data["window_s"] = [window_s[k] if k in ends else window[k] for k in range(len(window_s))]
        options |= {("window_s",): ", ".join(ends.values())} | {("window_s", k): o for k, o in ends.items()}
    source = replace(source, options=options)
    if not logs:
        return source
    source.data["logs"] = [str(log) for log in logs]
    return replace(source, logs=tuple(map(str, logs)))


def _ready(source: Any, *, skip_unreadable: bool) -> tuple[Any, Any, list[tuple[Path, str]]]:
    """Experiment and recordings, and what was skipped; raises with every problem there is."""
    from copem_replay.experiment.file import log_paths
    from copem_replay.experiment.validate import across_logs, problems, read_logs

    experiment, found = problems(source)
    if experiment is None:
        raise InputError(found)
    recordings, refused = read_logs(experiment, log_paths(source)[0], source)
    if not skip_unreadable or not recordings:
        found += [log.said(source) for log in refused]
    found += across_logs(experiment, recordings, source)
    if found:
        raise InputError(found)
    return experiment, recordings, [(log.path, log.reason) for log in refused]


def _tidied(path: Path, place: Path | None = None) -> None:
    """Remove what killed commands left of a file or folder beside it, or in `place`, and say so."""
    from copem_replay.core.scratch import remove_leftovers

    _complain(f"note: {note}" for note in remove_leftovers(path, place))


def _prepared(source: Any, experiment: Any, recordings: Any) -> tuple[Any, list[str]]:
    """The logs made ready, and what is to be said before any run; raises with what cannot be done with them."""
    from copem_replay.core.errors import ExperimentError
    from copem_replay.pipeline.log_replay import prepare
    from copem_replay.pipeline.memory import memory_notes
    from copem_replay.pipeline.run import check_closed_form

    prepared = [prepare(recording, experiment) for recording in recordings]
    key: tuple[str, ...] = ("measure", "exact")
    try:
        check_closed_form(prepared, experiment)
        key = ("runs",)
        return prepared, memory_notes(prepared, experiment)
    except ExperimentError as error:
        raise InputError([source.at(key, problem) for problem in error.problems]) from None


def _viewer(experiment: Any, url: str | None) -> str:
    """Where a viewer listens; refused before the replay where there is none, or nothing to show in it."""
    from copem_replay.viewer import VIEWER, check_viewer

    if experiment.show is None or experiment.show.run is None:
        raise InputError("--live: nothing to show, the experiment says so (`show: null`, or its `run`)")
    check_viewer(url or VIEWER)
    return url or VIEWER


def _workers(jobs: int | None) -> int:
    if jobs is not None:
        return jobs
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _with_progress(work: Callable[[Callable[[int, int], None] | None], Any]) -> Any:
    """Show a bar on a terminal, nothing otherwise."""
    if sys.stderr is None or not sys.stderr.isatty():
        return work(None)
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("replaying", total=None)
        return work(lambda done, total: bar.update(task, completed=done, total=total))


def _printable(text: str) -> str:
    """One line that no file name or key can break, colour or stop."""
    harmful = {c for c in text if unicodedata.category(c)[0] == "C" or c in "\u2028\u2029"}
    return "".join(c.encode("unicode_escape").decode() if c in harmful else c for c in text)


def _print_blocks(blocks: Iterable[Sequence[str]]) -> None:
    print("\n\n".join("\n".join(map(_printable, block)) for block in blocks))


def _complain(lines: Iterable[str]) -> None:
    for line in lines:
        print(_printable(line), file=sys.stderr)


def main() -> None:
    """Entry point: runs a command and ends with its exit code."""
    gc.set_threshold(100_000, 50, 100)  # a tenth of what imports take is looking for garbage that they do not make
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a terminal that has no “×” gets `\\xd7`
    for number in (signal.SIGTERM, signal.SIGHUP):  # by way of what has to be tidied up
        if number == signal.SIGTERM or signal.getsignal(number) != signal.SIG_IGN:  # nohup has it ignored
            signal.signal(number, lambda number, frame: sys.exit(128 + number))
    code = _ended()
    if copem_replay.CACHE_NOTE is not None and "numba" in sys.modules:  # something may have been compiled
        _complain([f"note: {copem_replay.CACHE_NOTE}"])
    sys.exit(code)


def _ended() -> int:
    try:
        code = _called(sys.argv[1:])
        if sys.stdout is not None:
            sys.stdout.flush()
        return code
    except CopemError as error:
        _complain(error.problems)
        return 2
    except (KeyboardInterrupt, typer.Abort):
        _complain(["interrupted"])
        return 130
    except BrokenPipeError:  # the reader of our output has gone: `copem-replay info … | head`
        _discard_output()
        return 0
    except MemoryError:
        _complain(["copem-replay: not enough memory; take fewer runs, units or objects at a time"])
        return 2
    except Exception as error:
        if hasattr(error, "format_message"):  # typer's words on options and arguments
            _complain([f"copem-replay: {' '.join(error.format_message().split())}"])
            return 2
        if isinstance(error, OSError) and not isinstance(error, FileNotFoundError | FileExistsError):
            _discard_output()  # a full disk, a device that fails, no permission: none of our doing
            _complain([f"copem-replay: {f'{error.filename}: ' if error.filename else ''}{error.strerror or error}"])
            return 2
        if isinstance(error, RuntimeError) and str(error).startswith("cannot cache function"):  # Numba's words
            _complain(
                ["copem-replay: no folder to cache compiled code in; set NUMBA_CACHE_DIR to one that can be written"]
            )
            return 2
        traceback.print_exc()
        print("copem-replay: this is a defect of copem_replay; please report it with the lines above", file=sys.stderr)
        return 70


def _called(arguments: list[str]) -> int:
    """Run a command. Not by typer's own `main`, which has other ideas of what errors and interrupts look like."""
    command = typer.main.get_command(app)
    try:
        with command.make_context("copem-replay", arguments) as context:
            code = command.invoke(context)
    except typer.Exit as ended:
        return ended.exit_code
    return code if isinstance(code, int) else 0


def _discard_output() -> None:
    """What is still to be printed goes nowhere: nobody reads it, or it cannot be written."""
    with suppress(OSError, ValueError, AttributeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    main()

"""The command line: each command a few lines around a library call, and one place where errors become exit codes.

0 done · 1 done, but a log was skipped · 2 the input was wrong: plain lines on stderr · 70 a defect of ours: traceback.
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from copem_replay.errors import CopemError, InputError, OutputError

app = typer.Typer(
    help="Replay recorded traffic through perception error models of one or many cooperating units.",
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

ExperimentFile = Annotated[Path, typer.Argument(metavar="EXPERIMENT", help="Experiment file (YAML).")]


@app.callback(invoke_without_command=True)
def version(
    show: Annotated[bool, typer.Option("--version", help="Print the version.", is_eager=True)] = False,
) -> None:
    """Print the version."""
    if show:
        from importlib.metadata import version as installed

        print(f"copem-replay {installed('copem-replay')}")
        raise typer.Exit(0)


@app.command()
def info(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="Recordings (MCAP).")],
    as_json: Annotated[bool, typer.Option("--json", help="As JSON, one array.")] = False,
) -> int:
    """What is in a recording: topics, object lists, objects, span, rate, ego vehicle, what is missing."""
    import json

    from copem_replay.info import describe, survey

    surveys = [_or_problem(survey, log) for log in logs]
    good = [s for s in surveys if isinstance(s, dict)]
    if as_json:
        print(json.dumps(good, indent=1, ensure_ascii=False))
    else:
        print("\n\n".join("\n".join(describe(s)) for s in good))
    problems = [line for s in surveys if not isinstance(s, dict) for line in s]
    problems += [str(s["reason"]) for s in good if not s["readable"]]
    if problems:
        raise InputError(problems)
    return 0


@app.command()
def check(experiment: ExperimentFile) -> int:
    """Every problem of an experiment file at once, with file and line, against its logs too."""
    _experiment, recordings, _skipped = _load(experiment, {}, [], skip_unreadable=False)
    names = ", ".join(r.scene.log for r in recordings)
    print(f"{experiment}: no problem found; logs: {names}")
    return 0


@app.command()
def run(
    experiment: ExperimentFile,
    log: Annotated[list[Path] | None, typer.Option(help="Replay this recording instead of those named.")] = None,
    ego: Annotated[str | None, typer.Option(metavar="ID", help="Object that is the ego vehicle.")] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Results folder [out/<experiment>].")] = None,
    runs: Annotated[int | None, typer.Option(min=1, help="Number of runs.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of all random numbers.")] = None,
    jobs: Annotated[int | None, typer.Option(min=1, help="Workers [one per core].")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the results that are there.")] = False,
    skip_unreadable: Annotated[
        bool, typer.Option("--skip-unreadable", help="Leave out logs that cannot be replayed.")
    ] = False,
) -> int:
    """Replay, measure, write the results folder, print the summary."""
    from copem_replay.results import check_target, write_results
    from copem_replay.table import summary_text

    folder = out or Path("out") / experiment.stem
    check_target(folder, overwrite=overwrite)
    changes = {"ego": ego, "runs": runs, "seed": seed}
    ready, recordings, skipped = _load(
        experiment, {k: v for k, v in changes.items() if v is not None}, log or [], skip_unreadable=skip_unreadable
    )
    from copem_replay.run import run as run_experiment

    result = _with_progress(lambda progress: run_experiment(ready, recordings, jobs=_workers(jobs), progress=progress))
    notes = write_results(folder, ready, recordings, result, skipped=skipped, overwrite=overwrite)
    _say([f"{path}: skipped: {reason}" for path, reason in skipped] + notes)
    print(summary_text(result.summary))
    print(f"results in {folder}")
    return 1 if skipped else 0


@app.command()
def view(folder: Annotated[Path, typer.Argument(metavar="DIR", help="Results folder.")]) -> int:
    """Open the recordings of a results folder in the Rerun viewer."""
    import subprocess

    files = [p for p in [folder / "replay.rrd", *sorted(folder.glob("replay/**/*.rrd"))] if p.is_file()]
    if not files:
        raise InputError(f"{folder}: no replay.rrd in this folder; `show: {{run: 0}}` in an experiment writes one")
    # The module, not the script: it is there in every environment that has rerun-sdk, whatever the PATH.
    code = subprocess.call([sys.executable, "-m", "rerun", *map(str, files)])
    if code:
        raise OutputError(f"{folder}: the Rerun viewer could not be opened (it ended with {code})")
    return 0


@app.command()
def schema() -> int:
    """JSON Schema of the experiment file, with the components installed."""
    import json

    from copem_replay.experiment import Experiment

    described = Experiment.model_json_schema(by_alias=True) | {
        "$schema": "https://json-schema.org/draft/2020-12/schema"
    }
    print(json.dumps(described, indent=1))
    return 0


def _load(
    path: Path, changes: dict[str, Any], logs: Sequence[Path], *, skip_unreadable: bool
) -> tuple[Any, Any, list[tuple[Path, str]]]:
    """Experiment and recordings; raises with every problem there is."""
    from copem_replay.check import across_logs, problems, read_logs
    from copem_replay.experiment_file import load, log_paths

    source = load(path)
    source.data.update(changes)
    if logs:
        source.data["logs"] = [str(log.absolute()) for log in logs]
    experiment, found = problems(source)
    paths, _ = log_paths(source)
    if skip_unreadable:
        found = [line for line in found if not line.endswith(": no such file")]
    if experiment is None or found:
        raise InputError(found)
    recordings, refused = read_logs(experiment, paths, source)
    wrong = list(across_logs(experiment, recordings, source))
    if wrong or (refused and not skip_unreadable) or not recordings:
        raise InputError([*(reason for _, reason in refused), *wrong])
    return experiment, recordings, refused


def _workers(jobs: int | None) -> int:
    import os

    return jobs or len(os.sched_getaffinity(0))


def _with_progress(work: Callable[[Callable[[int, int], None] | None], Any]) -> Any:
    """Show a bar on a terminal, nothing otherwise."""
    if not sys.stderr.isatty():
        return work(None)
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("replaying", total=None)
        return work(lambda done, total: bar.update(task, completed=done, total=total))


def _or_problem(work: Callable[[Path], Any], path: Path) -> Any:
    try:
        return work(path)
    except CopemError as error:
        return error.problems


def _say(lines: Sequence[str]) -> None:
    for line in lines:
        print(f"note: {line}", file=sys.stderr)


def main() -> None:
    """Entry point: runs a command and ends with its exit code."""
    sys.exit(_ended())


def _ended() -> int:
    try:
        code = app(standalone_mode=False)
    except CopemError as error:
        for line in error.problems:
            print(line, file=sys.stderr)
        return 2
    except (KeyboardInterrupt, typer.Abort):
        print("interrupted: nothing was written", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of our output has gone: `copem-replay info … | head`
        sys.stdout = None
        return 0
    except Exception as error:
        if hasattr(error, "format_message"):  # typer's words on options and arguments
            print(f"copem-replay: {' '.join(error.format_message().split())}", file=sys.stderr)
            return 2
        traceback.print_exc()
        print("copem-replay: this is a defect of copem_replay; please report it with the lines above", file=sys.stderr)
        return 70
    return code if isinstance(code, int) else 0


if __name__ == "__main__":
    main()

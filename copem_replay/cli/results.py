"""Commands on results folders: `compare`, `plot`, `film`, `report`, `view`, `layout`, `export`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from copem_replay.cli.terminal import (
    Baseline,
    By,
    ResultsFolder,
    print_answer,
    print_blocks,
    print_first_notes,
    print_line,
    print_notes,
    print_rows,
    print_table,
    print_verdicts,
    split_entries,
    split_names,
    width_of,
)
from copem_replay.core.errors import InputError

if TYPE_CHECKING:
    from copem_replay.results.compare import Comparison


def compare(
    folders: Annotated[
        list[Path], typer.Argument(metavar="FOLDER", help="Results folder; or the older one, then newer ones.")
    ],
    configurations: Annotated[
        str | None, typer.Option(metavar="A,B,…", help="Only these, and the baseline [all].")
    ] = None,
    baseline: Baseline = None,
    by: By = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write everything as .csv, or the table as .md.")
    ] = None,
    false_positives_per_min: Annotated[
        float | None,
        typer.Option(metavar="N", min=0, help="Ghosts per minute at which times are compared [the baseline's]."),
    ] = None,
    explain: Annotated[bool, typer.Option("--explain", help="Print every figure, and what it means.")] = False,
    rrd: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write one run of all configurations as a Rerun recording (.rrd)."),
    ] = None,
    run: Annotated[
        int | None, typer.Option(metavar="N", help="Run in that recording [as in the baseline's replay.rrd].")
    ] = None,
    log: Annotated[
        str | None, typer.Option(metavar="NAME", help="Log in that recording [as in that replay.rrd].")
    ] = None,
    decide: Annotated[
        str | None, typer.Option(metavar="METRIC", help="The one metric that decides: no other has a star [all].")
    ] = None,
    matters: Annotated[
        list[str] | None,
        typer.Option(metavar="METRIC=N", help="Least difference that matters: better, worse, alike or open."),
    ] = None,
    fail_on: Annotated[
        list[str] | None,
        typer.Option(metavar="'METRIC > N'", help="Exit with 1 if the newer folder is shown to be worse by so much."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON: the answer, notes and every row.")] = False,
) -> int:
    """Compare configurations with a baseline, or new results with old.

    They are paired by log, object and run. OLD NEW: each configuration of the newer results folder minus itself in the
    older one, and in one line whether it is better or worse.
    """
    from copem_replay.api.results import compare as compare_results
    from copem_replay.results.compare import check_out, comparison_text, write_comparison
    from copem_replay.results.decision import decide as decide_on
    from copem_replay.results.decision import decide_compared
    from copem_replay.results.read import open_results
    from copem_replay.results.screen import choose_notes, format_comparison
    from copem_replay.results.versions import tell_change

    if out is not None:
        check_out(out)
    _check_rrd_options(rrd, run, log)
    names = split_names(configurations)
    _check_fail_on(fail_on, folders, names, baseline)
    comparison = compare_results(
        folders,
        configurations=names,
        baseline=baseline,
        false_positives_per_min=false_positives_per_min,
        by=split_entries(by),
        decide=decide,
        matters=dict(map(_parse_matters, matters or ())),
    )
    in_full = bool(explain or by is not None or matters or decide)
    notes = list(comparison.notes) if in_full else choose_notes(comparison.notes)
    if rrd is not None:
        from copem_replay.viewer.side_by_side import write_side_by_side

        drawn = names if names or not comparison.newer else [*comparison.changed.configurations] or None
        notes += write_side_by_side(rrd, folders, configurations=drawn, baseline=baseline, log=log, run=run)
    if not as_json:
        print_first_notes(notes, explain=in_full)
    if comparison.newer:
        head, sentence, marked = tell_change(comparison)
        answer: tuple[str, ...] = (sentence,)
    else:
        opened = open_results(folders[0]) if len(folders) == 1 else None
        decision = decide_compared(comparison) if opened is None else decide_on(opened, comparison)
        head, answer, marked = "", decision.sentences, decision.best
    if as_json:
        print(_format_json(comparison, " ".join(answer)))
    else:
        print_rows([head] if head else [])
        if in_full:
            print_table(comparison_text(comparison, width_of(sys.stdout)), marked)
        else:
            print_rows(*format_comparison(comparison, marked))
            print_rows([] if comparison.newer else ["every figure: --explain"])
    if by is not None and len(folders) == 1 and not as_json:
        from copem_replay.results.slices import groups_text, summarise_slices

        table = summarise_slices(open_results(folders[0]), split_entries(by))
        assert table is not None
        shown = [comparison.baseline, *comparison.configurations]
        print(f"\n{groups_text(table[table['configuration'].isin(shown)], width_of(sys.stdout))}")
    if out is not None:
        write_comparison(comparison, out, folders)
    if not as_json:
        _print_written(out, rrd)
    if comparison.newer:  # what both have
        names = [name for name in comparison.configurations if name not in comparison.truths]
    code = _judge_differences(_check_fail_on(fail_on, folders, names, baseline), folders, quiet=as_json)
    if not as_json:
        print_answer(answer)
    return code


def _format_json(comparison: Comparison, answer: str) -> str:
    """A comparison as JSON: the answer, what it is against, notes, and the rows of `--out x.csv`, null where empty."""
    tables = [comparison.table, *([] if comparison.groups is None else [comparison.groups])]
    rows = [row for table in tables for row in json.loads(table.to_json(orient="records", double_precision=15))]
    said = {"answer": answer, "baseline": comparison.baseline, "newer": comparison.newer}
    said |= {"unchanged": comparison.unchanged, "notes": comparison.notes, "rows": rows}
    return json.dumps(said, ensure_ascii=False, indent=1)


def _parse_matters(text: str) -> tuple[str, float]:
    name, _, number = text.partition("=")
    try:
        return name.strip(), float(number)
    except ValueError:
        raise InputError(f"--matters: expected METRIC=N, such as ttd_rmst_s=0.25, found {text!r}") from None


def _check_fail_on(
    conditions: list[str] | None, folders: list[Path], names: list[str] | None, baseline: str | None
) -> dict[str, dict[str, Any]]:
    """Criteria of the conditions of `--fail-on`: differences to the first of two folders, or to the baseline."""
    if not conditions:
        return {}
    from copem_replay.experiment.criteria import BEFORE, parse_fail_on

    if len(folders) != 2 and baseline is None:
        raise InputError(f"--fail-on: expected two folders, OLD NEW, or --baseline NAME, found {len(folders)}")
    against = BEFORE if len(folders) == 2 and baseline is None else str(baseline)
    return parse_fail_on(conditions, against, names)


def _judge_differences(criteria: dict[str, dict[str, Any]], folders: list[Path], *, quiet: bool) -> int:
    if not criteria:
        return 0
    from copem_replay.api.results import judge
    from copem_replay.results.judge import find_population
    from copem_replay.results.read import open_results

    population = find_population(open_results(folders[-1], "tally.parquet"))
    criteria = {name: criterion | {"population": population} for name, criterion in criteria.items()}
    verdicts = judge(folders[-1], criteria, before=folders[0] if len(folders) > 1 else None)
    if not quiet:
        print_line("")
        print_verdicts(verdicts)
    return 0 if verdicts.passes else 1


def _check_rrd_options(rrd: Path | None, run: int | None, log: str | None) -> None:
    if rrd is not None:
        from copem_replay.viewer.side_by_side import check_side_by_side

        check_side_by_side(rrd)
    elif run is not None or log is not None:
        raise InputError(f"--{'log' if run is None else 'run'}: expected --rrd FILE with it, found none")


def _print_written(*files: Path | None) -> None:
    for file in files:
        if file is not None:
            opens = f"; next: copem-replay view {file}" if file.suffix == ".rrd" else ""
            print_line(f"written to {file}{opens}")


def verdict(
    folder: ResultsFolder,
    criteria: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Criteria, a file with this key [those of the experiment].")
    ] = None,
    before: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Earlier results, for criteria that compare with them.")
    ] = None,
    junit: Annotated[Path | None, typer.Option(metavar="FILE", help="Also write JUnit XML.")] = None,
    markdown: Annotated[Path | None, typer.Option(metavar="FILE", help="Also write Markdown; - prints it.")] = None,
    jsonl: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Name of the JSON lines [FOLDER/verdicts.jsonl].")
    ] = None,
) -> int:
    """Judge results by criteria; exit code 1 if one does not pass.

    Nothing is replayed. Ends with 1 where a criterion does not pass, after all files are written.
    """
    from copem_replay.api.results import judge
    from copem_replay.results.verdicts import FILE, check_verdict_files, verdicts_markdown, write_verdicts

    printed = markdown == Path("-")
    files = {"jsonl": jsonl or folder / FILE, "junit": junit, "markdown": None if printed else markdown}
    check_verdict_files(files)
    verdicts = judge(folder, criteria, before=before)
    print_notes(verdicts.notes)
    if printed:
        print(verdicts_markdown(verdicts), end="")
    else:
        print_verdicts(verdicts)
    for form, path in files.items():
        if path is not None:
            write_verdicts(verdicts, path, form)
            if not printed:
                print_line(f"{'verdicts' if form == 'jsonl' else form} in {path}")
    return 0 if verdicts.passes else 1


def plot(
    folder: ResultsFolder,
    out: Annotated[Path | None, typer.Option(metavar="FOLDER", help="Folder of the figures [FOLDER/figures].")] = None,
    configurations: Annotated[
        str | None, typer.Option(metavar="A,B,…", help="Only these [all; four of them for single runs].")
    ] = None,
    run: Annotated[
        int | None, typer.Option(metavar="N", help="Run in the figure of single runs [as in replay.rrd].")
    ] = None,
    object: Annotated[
        str | None, typer.Option(metavar="ID", help="Object in the figure of single runs [the first in conflict].")
    ] = None,
    log: Annotated[
        str | None, typer.Option(metavar="NAME", help="Log in the figure of single runs [the first].")
    ] = None,
    by: By = None,
) -> int:
    """Draw the figures of a results folder, as PNG and SVG.

    Single runs, distances at detection, detection curves, where the time goes, sweeps.
    """
    from copem_replay.api.plot import write_figures

    names = split_names(configurations)
    files, notes = write_figures(
        folder, out, configurations=names, log=log, object_id=object, run=run, by=split_entries(by)
    )
    print_notes(notes)
    print_blocks([[str(file) for file in files]])
    return 0


def report(
    folder: ResultsFolder,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Name of the file [FOLDER/report.html].")] = None,
    baseline: Baseline = None,
    by: By = None,
) -> int:
    """Write the report of a results folder, as one HTML file.

    It has text, tables, figures and provenance, and opens offline.
    """
    from copem_replay.api.results import write_report

    path = write_report(folder, out, baseline=baseline, by=split_entries(by))
    print_line(f"report in {path}")
    return 0


def view(
    folder: ResultsFolder,
    web: Annotated[
        bool, typer.Option("--web", help="Serve viewer and recordings on 127.0.0.1, for a browser, until interrupted.")
    ] = False,
    object: Annotated[
        str | None, typer.Option(metavar="ID", help="Open at the onset of this object [at the first onset].")
    ] = None,
    log: Annotated[str | None, typer.Option(metavar="NAME", help="Log of that object [any].")] = None,
    with_recording: Annotated[
        Path | None, typer.Option("--with", metavar="FILE", help="Add the images and points of this recording.")
    ] = None,
) -> int:
    """Open the recordings of a results folder in the viewer.

    A .rrd file opens, too, and of a recording one run of the draft. Each opens half a second before the first onset of
    the objects that tell most, or that of an object.
    """
    from copem_replay.api.results import view as view_results

    view_results(folder, web=web, object_id=object, log=log, with_recording=with_recording)
    return 0

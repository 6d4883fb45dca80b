"""Results folders in Python: read, compared, reported, and opened in the viewer."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, TypeAlias

from copem_replay.core.errors import InputError, OutputError
from copem_replay.results.compare import Comparison
from copem_replay.results.read import Results, open_results

if TYPE_CHECKING:
    from copem_replay.results.verdicts import Judgement
    from copem_replay.viewer.open import Sought

AnyResults: TypeAlias = Results | str | PathLike[str]
"""Results, of `run` or read from a folder, or the path of a results folder."""


def load_results(folder: str | PathLike[str]) -> Results:
    """Read a results folder: its experiment and its tables, under the names that `run` gives them.

    `detections`, `tally`, `summary`, and where it has them `exact`, `sweep`, `accuracy`, `bands` (else None): pandas,
    times in seconds (`_s`), distances in metres (`_m`). Of many rows `each` gives those of a log at a time.

    Raises InputError: no such folder, no results in it, or damaged ones.

    >>> results = cr.load_results("out/tc016d")
    >>> results.detections["configuration"].nunique(), len(results.summary)
    (6, 6)
    """
    from copem_replay.results.read import read_results

    return read_results(Path(folder))


def compare(
    results: AnyResults | Sequence[AnyResults],
    *,
    configurations: Sequence[str] | None = None,
    baseline: str | None = None,
    false_positives_per_min: float | None = None,
    by: Sequence[str] | None = None,
    decide: str | None = None,
    matters: Mapping[str, float] | None = None,
) -> Comparison:
    """Compare configurations with a baseline, paired by log, object and run, within or across results folders.

    `configurations`: only these; None: all. `baseline`: None: of several folders each configuration is held against
    itself in the first one, `cr.compare([old, new])`; of one it is the one named `ideal`, else the ideal fusion of the
    same inputs, else the first that is not the truth. `false_positives_per_min`: false positives per minute at which
    times to detection are compared once more; None: those of the baseline. `by`: entries by which rows are grouped,
    each group compared for itself, in `groups` of the result: `["class", "log*class"]`. Its `table` has a row per log,
    configuration and metric: `difference` with the limits `low` and `high` of its 95 % interval. `decide`: the one
    metric that was named to decide, of which alone there are stars; None: all, held together. `matters`: by metric the
    least difference that matters, by which each is better, worse, alike or open.

    Raises InputError with every reason why the results are unreadable or not comparable.

    >>> comparison = cr.compare("out/tc016d", baseline="PEM")
    >>> table = comparison.overall.set_index(["metric", "configuration"])
    >>> table.loc[("ttd_rmst_s", "coPEM:0.5s"), "baseline_value"].round(1)
    np.float64(0.8)
    """
    from copem_replay.results.compare import compare_folders

    all_results = list(results) if isinstance(results, Sequence) and not isinstance(results, str) else [results]
    return compare_folders(
        [_results_or_path(folder) for folder in all_results],
        configurations=configurations,
        baseline=baseline,
        false_positives_per_min=false_positives_per_min,
        by=by,
        decide=decide,
        matters=matters,
    )


def judge(
    results: AnyResults,
    criteria: Mapping[str, Any] | str | PathLike[str] | None = None,
    *,
    before: AnyResults | None = None,
) -> Judgement:
    """Hold criteria against results: met, not met, undecided or not measured, by the intervals of `summary.csv`.

    `criteria`: by name, each with its keys, or the path of a file with the key `criteria`; None: those of the
    experiment. `before`: results that criteria are `against`.

    Raises InputError: no criteria, names that do not exist, results that are unreadable or not comparable.

    >>> verdicts = cr.judge("out/tc016d", {"known": {"metric": "detected_share", "at_least": 0.9,
    ...                                              "population": "these_logs", "configurations": ["coPEM:0s"]}})
    >>> verdicts.passes, verdicts.all[0].verdict
    (True, 'met')
    """
    from copem_replay.experiment.cross_references import read_criteria
    from copem_replay.results.judge import judge_results

    judged, other = (
        given if isinstance(given, Results | None) else open_results(Path(given), "summary.csv", "tally.parquet")
        for given in (results, before)
    )
    assert judged is not None
    if criteria is None:
        chosen = judged.experiment.criteria
    else:
        chosen = read_criteria(criteria if isinstance(criteria, Mapping) else Path(criteria), judged.source.data)
    if not chosen:
        raise InputError(f"{judged.place}: expected criteria in its experiment, found none; --criteria FILE gives some")
    return judge_results(judged, chosen, other)


def write_report(
    results: AnyResults,
    file: str | PathLike[str] | None = None,
    *,
    baseline: str | None = None,
    by: Sequence[str] | None = None,
) -> Path:
    """Write the report of a results folder as one HTML file that opens offline. Returns its path.

    `file`: None: `report.html` in the folder. `baseline`: None: as in `compare`. `by`: what its tables of groups are
    by, `["log", "class"]`; None: by what the experiment says (`measure.by`).

    Raises InputError where the results are unreadable, OutputError where the file is not writable.

    >>> cr.write_report("out/tc016d", "report.html").name
    'report.html'
    """
    from copem_replay.report import write_html_report

    path = None if file is None else Path(file)
    return write_html_report(_results_or_path(results), path, baseline=baseline, by=by)


def view(
    results: AnyResults,
    *,
    web: bool = False,
    object_id: str | None = None,
    log: str | None = None,
    with_recording: str | PathLike[str] | None = None,
) -> None:
    """Open the recordings of a results folder, or one `.rrd` file, in the Rerun viewer, and wait until it ends.

    Each opens just before the first onset. Of a recording one run of its draft (`draft_experiment`) is opened, which is
    kept for as long as the viewer is open.

    `object_id`: only recordings with this measured object, just before its onset; `log`: only those of this log.

    `with_recording`: a recording of these results; the run that is shown of it is written anew, for as long as the
    viewer is open, with images and points of the recording itself behind the boxes.

    `web`: serve viewer and recordings on a free port of 127.0.0.1 instead, print the address, and go on until
    interrupted (Ctrl-C).

    Raises InputError: no such folder, no `replay.rrd` in it, one that is damaged or of other results, or none of it
    with the object; OutputError where the viewer does not open.

    >>> cr.view("out/nowhere")
    Traceback (most recent call last):
    copem_replay.core.errors.InputError: out/nowhere: no such folder
    """
    from copem_replay.experiment.file import is_recording
    from copem_replay.results.provenance import check_format
    from copem_replay.viewer import write_with_recording
    from copem_replay.viewer.open import Sought, list_rrd_files

    folder = results.require_folder() if isinstance(results, Results) else Path(results)
    if log is not None and object_id is None:
        raise InputError("--log: expected --object ID with it, found none")
    sought = None if object_id is None else Sought(object_id, log)
    if folder.is_file() and folder.suffix == ".rrd" and sought is None and with_recording is None:
        return _open_sought(folder.parent, folder.parent, [folder.absolute()], sought, web=web)
    if is_recording(folder) and with_recording is None:
        return _view_draft(folder, web=web, object_id=object_id, log=log)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    check_format(folder)
    if with_recording is not None:
        with TemporaryDirectory(prefix="copem-replay-") as scratch:
            file, notes = write_with_recording(Path(scratch), open_results(folder), Path(with_recording))
            sys.stderr.writelines(f"note: {line}\n" for line in notes)
            return _open_sought(folder, Path(scratch), [file], sought, web=web)
    if not (files := list_rrd_files(folder)):
        raise InputError(f"{folder}: no replay.rrd in this folder; `show: {{run: 0}}` in an experiment writes one")
    return _open_sought(folder, folder, files, sought, web=web)


def _view_draft(path: Path, *, web: bool, object_id: str | None, log: str | None) -> None:
    """Open one run of the draft of a recording."""
    from copem_replay.api.recordings import draft_experiment
    from copem_replay.api.run import run
    from copem_replay.core.yaml import parse_yaml

    draft, _, _ = parse_yaml(draft_experiment(path))
    with TemporaryDirectory(prefix="copem-replay-") as scratch:
        run(draft | {"runs": 1}).save(Path(scratch) / "view")
        print(f"note: {path}: one run of the draft of `init`; `copem-replay run {path}` keeps results", file=sys.stderr)
        view(Path(scratch) / "view", web=web, object_id=object_id, log=log)


def _open_sought(folder: Path, place: Path, files: Sequence[Path], sought: Sought | None, *, web: bool) -> None:
    """Open recordings of results, which lie at a place, here or in a browser: those of the object sought.

    Raises OutputError where the viewer does not open.
    """
    from copem_replay.results.seals import check_recordings
    from copem_replay.viewer.open import open_viewer, opening_s

    instants_s = opening_s(place, files, sought, folder)
    if sought is not None and not (files := [file for file in files if file in instants_s]):
        where = "" if sought.log is None else f" of log {sought.log}"
        raise InputError(f"{folder}: no recording{where} has the measured object {sought.object_id!r}")
    check_recordings([place / file.relative_to(place.absolute()) for file in files])
    if web:
        _serve_recordings(place, files, instants_s)
    elif code := open_viewer(files, instants_s):
        raise OutputError(
            f"{folder}: the Rerun viewer could not be opened (it ended with {code}); without a display, "
            f"copem-replay view {folder} --web serves it for a browser"
        )


def _serve_recordings(folder: Path, files: Sequence[Path], instants_s: Mapping[Path, float]) -> None:
    """Serve recordings for a browser until interrupted."""
    from copem_replay.viewer.open import serve_recordings

    try:
        with serve_recordings(folder, files, instants_s) as server:
            print(f"viewer at {server.url} (Ctrl-C ends it)", flush=True)
            server.serve_forever()
    except KeyboardInterrupt:  # the intended end
        return


def take_results(results: AnyResults) -> Results:
    """Results as they are, or those of a folder."""
    return results if isinstance(results, Results) else load_results(results)


def _results_or_path(results: AnyResults) -> Results | Path:
    return results if isinstance(results, Results) else Path(results)

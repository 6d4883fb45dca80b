"""Figures of results, as matplotlib Figures: `cr.plot.detection_curves(results)`; all that `copem-replay plot` writes.
`cr.write_figures` makes the files.
"""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from copem_replay.api.results import AnyResults, take_results
from copem_replay.core.errors import InputError
from copem_replay.core.extras import load_extra

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from copem_replay.results.compare import Comparison


__all__ = [
    "answer",
    "detection_curves",
    "differences",
    "distances",
    "false_positives",
    "late_paths",
    "latency_breakdown",
    "single_runs",
    "slices",
    "sweeps",
    "trade_off",
]


def answer(results: AnyResults, *, configurations: Sequence[str] | None = None) -> Figure:
    """Mean time to detection and share that passes, a dot with its interval per configuration, the soonest first.

    Raises InputError for a configuration that is not among the results.

    >>> len(cr.plot.answer("out/tc016d").axes)
    2
    """
    return _draw("answer", results, configurations)


def differences(
    results: AnyResults, *, configurations: Sequence[str] | None = None, comparison: Comparison | None = None
) -> Figure:
    """Each configuration minus the baseline, a dot with its interval, and the line of 0.

    `comparison`: of `cr.compare`; None: with its default baseline.

    Raises InputError for a configuration that is not among the results, and where there is nothing to compare.

    >>> against = cr.compare("out/tc016d", baseline="coPEM:0s")
    >>> len(cr.plot.differences("out/tc016d", comparison=against).axes) > 0
    True
    """
    return _draw("differences", results, configurations, differences=comparison)


def detection_curves(results: AnyResults, *, configurations: Sequence[str] | None = None) -> Figure:
    """Share of objects detected over the seconds since the onset, with 95 % bands: a curve per configuration.

    Raises InputError for a configuration that is not among the results.

    >>> len(cr.plot.detection_curves("out/tc016d").axes) > 0
    True
    """
    from copem_replay.report.figures.detection_curves import curves_figure

    return curves_figure(take_results(results), configurations=configurations)


def distances(results: AnyResults, *, configurations: Sequence[str] | None = None) -> Figure:
    """Distance at detection in metres, of every run and object: a strip per configuration.

    Raises InputError for a configuration that is not among the results.

    >>> len(cr.plot.distances("out/tc016d", configurations=["PEM"]).axes) > 0
    True
    """
    from copem_replay.report.figures.distances import distances_figure

    return distances_figure(take_results(results), configurations=configurations)


def late_paths(results: AnyResults, *, configurations: Sequence[str] | None = None, log: str | None = None) -> Figure:
    """The path of every measured object, coloured by the seconds for which it is unknown: a panel per configuration.

    `log`: None: the one in which objects are known latest.

    Raises InputError for what is not among the results, RecordingError where the recording is gone or has changed.

    >>> len(cr.plot.late_paths("out/tc016d", configurations=["PEM", "coPEM:1s"]).axes) > 0
    True
    """
    return _draw("late_paths", results, configurations, log=log)


def latency_breakdown(results: AnyResults, *, configurations: Sequence[str] | None = None) -> Figure:
    """Mean seconds of the stages from the onset to the detection: a bar per configuration.

    Raises InputError for a configuration that is not among the results, and where nothing was detected.

    >>> len(cr.plot.latency_breakdown("out/tc016d").axes)
    1
    """
    return _draw("latency_breakdown", results, configurations)


def single_runs(
    results: AnyResults,
    *,
    configurations: Sequence[str] | None = None,
    log: str | None = None,
    object_id: str | None = None,
    run: int | None = None,
) -> Figure:
    """One run in up to four configurations: speed [m/s], distance [m], visible share and events over the seconds.

    `log`, `object_id`, `run`: None: the first log, its first object in conflict, the run in `replay.rrd`.

    Raises InputError for what is not among the results, RecordingError where the recording is gone or has changed.

    >>> len(cr.plot.single_runs("out/tc016d", run=0).axes) > 0
    True
    """
    from copem_replay.report.figures.selection import Selection
    from copem_replay.report.figures.single_runs import runs_figure

    return runs_figure(take_results(results), Selection(configurations, log, object_id, run))


def slices(
    results: AnyResults, *, configurations: Sequence[str] | None = None, by: Sequence[str] | None = None
) -> Figure:
    """Mean time to detection by group: a row per group and a column per configuration, darker is later.

    `by`: what rows are grouped by, `["log", "class"]`; None: by what the experiment says (`measure.by`).

    Raises InputError for what is not among the results, and where nothing is grouped.

    >>> len(cr.plot.slices("out/tc016d", by=["class"]).axes) > 0
    True
    """
    from copem_replay.results.slices import summarise_slices

    read = take_results(results)
    return _draw("slices", read, configurations, sliced=summarise_slices(read, by))


def sweeps(results: AnyResults, *, configurations: Sequence[str] | None = None) -> Figure:
    """Shares and times over the values of each sweep. Raises InputError where the results have no sweep.

    >>> cr.plot.sweeps("out/tc016d")
    Traceback (most recent call last):
    copem_replay.core.errors.InputError: out/tc016d: expected sweep.csv in it, found none; ...
    """
    from copem_replay.report.figures.sweeps import sweeps_figure

    return sweeps_figure(take_results(results), configurations=configurations)


def false_positives(results: AnyResults, *, configurations: Sequence[str] | None = None) -> Figure:
    """False positives per minute over the position error (RMSE) in metres: a mark per configuration.

    Raises InputError for a configuration that is not among the results, and where fewer than two have both figures.

    >>> cr.plot.false_positives("out/tc016d")
    Traceback (most recent call last):
    copem_replay.core.errors.InputError: out/tc016d: no figure of false_positives: ...
    """
    return _draw("false_positives", results, configurations)


def trade_off(results: AnyResults, *, configurations: Sequence[str] | None = None) -> Figure:
    """Seconds sooner than the car alone against the share of the driving time with needless braking: a mark per
    configuration, a line where entries of more existence alone would be listed.

    Raises InputError for a configuration that is not among the results, and where fewer than two have both figures.

    >>> len(cr.plot.trade_off("out/tc016d").axes)
    1
    """
    return _draw("trade_off", results, configurations)


_LACKING = {
    "trade_off": "nobody brakes for nothing, or no driver is asked",
    "false_positives": "fewer than two configurations have both false positives and position errors",
    "late_paths": "of the truth alone nothing is late",
}
"""Why a figure cannot be drawn, where `plot` leaves it out without a word."""


def _draw(name: str, results: AnyResults, configurations: Sequence[str] | None, **options: Any) -> Figure:
    """A figure of the registry. Raises InputError where the results have none."""
    from copem_replay.report.figures.registry import FIGURES
    from copem_replay.report.figures.selection import Selection

    read, selection = take_results(results), Selection(configurations, **options)
    read.chosen(configurations)
    missing = FIGURES[name].missing(read, selection)
    if missing is not None and (reason := missing or _LACKING.get(name)):
        raise InputError(f"{read.place}: no figure of {name}: {reason}")
    return FIGURES[name].draw(read, selection)  # which itself says what else is missing


def write_figures(
    results: AnyResults,
    folder: str | PathLike[str] | None = None,
    *,
    configurations: Sequence[str] | None = None,
    log: str | None = None,
    object_id: str | None = None,
    run: int | None = None,
    by: Sequence[str] | None = None,
) -> tuple[list[Path], list[str]]:
    """Write all figures as PNG and SVG. Returns the files, and notes: one line per figure that is left out.

    `folder`: None: `figures` in the results folder. `log`, `object_id`, `run` as in `single_runs`. `by`: what the
    figure of slices groups rows by, `["log", "class"]`; None: by what the experiment says (`measure.by`).

    Raises InputError for what is not among the results, OutputError where a file is not writable.

    >>> files, notes = cr.write_figures("out/tc016d", "figures", configurations=["GT", "PEM"])
    >>> sorted({file.stem for file in files})
    ['answer', 'curves', 'differences', 'distances', 'late_paths', 'latency_breakdown', 'runs']
    """
    from copem_replay.report.figures.registry import write_figure_files
    from copem_replay.report.figures.selection import Selection
    from copem_replay.results.slices import summarise_slices

    read = take_results(results)
    selection = Selection(configurations, log, object_id, run, sliced=summarise_slices(read, by))
    return write_figure_files(read, None if folder is None else Path(folder), selection)


if not TYPE_CHECKING:  # with it type checkers would accept every name

    def __getattr__(name: str) -> object:
        if name == "write_film":  # its name of before; now `cr.write_film`, of an extra
            return load_extra("name of the API", name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__]

"""Figures of results, as matplotlib Figures: `cr.plot.detection_curves(results)`. `write_figures` makes the files,
`write_film` a film.
"""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from copem_replay.api.results import AnyResults, take_results

if TYPE_CHECKING:
    from matplotlib.figure import Figure


__all__ = ["detection_curves", "distances", "single_runs", "sweeps", "write_figures", "write_film"]


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


def sweeps(results: AnyResults, *, configurations: Sequence[str] | None = None) -> Figure:
    """Shares and times over the values of each sweep. Raises InputError where the results have no sweep.

    >>> cr.plot.sweeps("out/tc016d")
    Traceback (most recent call last):
    copem_replay.core.errors.InputError: out/tc016d: expected sweep.csv in it, found none; ...
    """
    from copem_replay.report.figures.sweeps import sweeps_figure

    return sweeps_figure(take_results(results), configurations=configurations)


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

    >>> files, notes = cr.plot.write_figures("out/tc016d", "figures", configurations=["GT", "PEM"])
    >>> sorted({file.stem for file in files})
    ['answer', 'curves', 'differences', 'distances', 'late_paths', 'latency_breakdown', 'runs']
    """
    from copem_replay.report.figures.registry import write_figure_files
    from copem_replay.report.figures.selection import Selection
    from copem_replay.results.slices import summarise_slices

    read = take_results(results)
    selection = Selection(configurations, log, object_id, run, sliced=summarise_slices(read, by))
    return write_figure_files(read, None if folder is None else Path(folder), selection)


def write_film(
    results: AnyResults,
    file: str | PathLike[str] | None = None,
    *,
    configurations: Sequence[str] | None = None,
    log: str | None = None,
    object_id: str | None = None,
    run: int | None = None,
) -> Path:
    """Write ten seconds of one object in one run as a GIF, and return its path.

    A plan for each of up to six configurations shows what it believes, and says whether the object is known, or why
    not. `file`: None: `film.gif` in the results folder. `configurations`: None: four, from worst to best. `log`,
    `object_id`, `run` as in `single_runs`. The recording is replayed again.

    Raises InputError for what is not among the results and for more configurations, RecordingError where the recording
    is gone or has changed, OutputError where the file is not writable.

    >>> cr.plot.write_film("out/tc016d", "film.gif", configurations=["PEM", "coPEM:0s"]).name
    'film.gif'
    """
    from copem_replay.core.colours import configuration_colours
    from copem_replay.experiment.drive import resolve_for_log
    from copem_replay.metrics.detections_table import first_episodes
    from copem_replay.pipeline.one_run import replay_run
    from copem_replay.report.figures.selection import Selection, choose_object_and_run
    from copem_replay.viewer.film import check_film, draw_film

    read = take_results(results)
    path = read.require_folder() / "film.gif" if file is None else Path(file)
    check_film(path, configurations)
    choice = choose_object_and_run(read, Selection(configurations, log, object_id, run))
    (rows,) = read.each(log=choice.log, every=True)
    table = first_episodes(rows[rows["run"] == choice.run])
    recording = read.recording(choice.log, read.experiment)
    replayed = replay_run(recording, resolve_for_log(read.experiment, choice.log), choice.run)
    read.check_unchanged()
    every = configuration_colours(read.experiment.configurations)
    colours = {name: every[name] for name in choice.configurations}
    return draw_film(path, replayed, table, choice.object_id, colours, read.place)


def __dir__() -> list[str]:
    return [*__all__]

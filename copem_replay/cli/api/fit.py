"""A perception error model from recordings: fitted, looked at in Python, or saved as a folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from copem_replay.cli.api.study import AnyExperiment, AnyPath, Study, read_study, source_of
from copem_replay.core.errors import ExperimentError, InputError, OutputError
from copem_replay.core.text import counted
from copem_replay.experiment.file import Source
from copem_replay.experiment.schema import Experiment
from copem_replay.io.recording import Recording

if TYPE_CHECKING:
    from copem_replay.pipeline.fit.estimate import Estimate
    from copem_replay.pipeline.fit.fit import Fit
    from copem_replay.results.place import Place

_STATED = [[1.0, 0.0], [0.0, 1.0]]
"""What lists are read with that state no covariance; no estimate depends on it."""


@dataclass(repr=False)
class FittedPem:
    """A fitted perception error model, and all that it is from.

    `found`: the parts of the fit. `estimates`: every number by its name, each with `value`, `low`, `high`, `n`,
    `n_effective`, or `why` it cannot be told.

    >>> unit = {"on": "ego", "height_m": 1.8, "recorded": {"topic": "copem/PEM/objects"}}
    >>> plan = {"version": 1, "units": {"ego": unit}, "configurations": {"recorded": {"units": ["ego"]}}}
    >>> fitted = cr.fit(plan | {"logs": ["out/tc016d/replay.mcap"]}, "ego")
    >>> variance_m2 = fitted.estimates["errors.bins.0.covariance_m2.0"]
    >>> variance_m2.low < 1.0 < variance_m2.high
    True
    """

    experiment: Experiment
    recordings: tuple[Recording, ...]
    found: Fit
    folder: Path | None = None
    """The folder, once it is saved."""

    def __repr__(self) -> str:
        found = self.found
        matched = counted(found.gathered.matched, "entry", "entries")
        return f"FittedPem({found.unit}, {counted(len(found.logs), 'log')}, {matched})"

    @property
    def estimates(self) -> dict[str, Estimate]:
        """Every number by its name."""
        from copem_replay.results.fit_files import all_estimates

        return dict(all_estimates(self.found))

    @property
    def yaml(self) -> str:
        """The model as keys of an experiment: `pems` and `units`, behind every number how well it is known."""
        from copem_replay.results.fit_files import pem_text

        return pem_text(self.found, self.experiment)

    @property
    def notes(self) -> tuple[str, ...]:
        """What has to be said of matches, truth and choice: one line each."""
        return self.found.said

    def save(self, folder: AnyPath, overwrite: bool = False) -> Path:
        """Write the folder of the fit, complete or not at all. Returns its path.

        Raises OutputError: the folder holds something already (`overwrite` replaces a fit), or is not writable; also
        where a page could not be written, and the rest of the fit is there.
        """
        from copem_replay.results.place import check_inputs, taken

        with taken(Path(folder), overwrite=overwrite) as place:
            check_inputs(place, [path for recording in self.recordings for path in recording.paths])
            fill(place, self)
            self.folder = place.shown
        if place.failed:
            raise OutputError(place.failed)
        return place.shown


def fill(place: Place, fitted: FittedPem) -> None:
    """Write a fit into a place that is taken."""
    from copem_replay.results.fit_files import fill_fit

    pages = {"fit.html": _write_page, "places.rrd": _write_places}
    fill_fit(place, fitted.found, fitted.experiment, fitted.recordings, pages)


def _write_page(path: Path, found: Fit) -> None:
    from copem_replay.report.fit.page import fit_page
    from copem_replay.report.fit.study import FitStudy
    from copem_replay.results.fit_files import all_estimates

    gathered, parts, checks = found.gathered, found.parts, found.checks
    study = FitStudy(
        found.unit, found.logs, gathered.rows, gathered.lists, parts.detection, parts.errors, parts.rest,
        found.delay.seconds, dict(all_estimates(found)),
        {one.statistic: one.pit for one in (checks.fitted if checks else ())},
        {one.statistic: one.pit for one in (checks.memoryless if checks else ())},
        {one.statistic: one.verdict for one in (checks.fitted if checks else ())},
        found.said,
    )  # fmt: skip
    path.write_text(fit_page(study), encoding="utf-8")


def _write_places(path: Path, found: Fit) -> None:
    from copem_replay.viewer.fit_places import write_fit_places

    write_fit_places(path, found.unit, found.logs, found.gathered.rows, found.gathered.lists)


def fit(
    experiment: AnyExperiment,
    unit: str,
    *,
    hold_out: Sequence[str] = (),
    folds: int | None = None,
    truth: str | None = None,
    by: Sequence[str] = ("range", "visible_share"),
    monotone: bool = True,
    simplest: bool = False,
) -> FittedPem:
    """Fit a perception error model to the lists of a recorded unit and the truth beside them.

    `unit`: one whose lists are `recorded`, with its place (`at` or `on`). `hold_out`: names of logs that are left for
    the check. `folds`: parts of the cross-validation that chooses between models. `truth`: `partial`, if entries may be
    about objects that the truth lacks, or `complete`; None: partial where a list has more of them than true objects are
    within reach. `by`: what detection depends on. `monotone`: farther and more hidden is never better. `simplest`: the
    first rung of every ladder.

    Raises InputError: no such unit or log, no place, nothing of it near a true object.

    >>> cr.fit("logs/tc016d.yaml", "rspu01")
    Traceback (most recent call last):
    copem_replay.core.errors.InputError: unit rspu01: expected a unit whose lists are recorded (none), ...
    """
    return fitted(
        study_to_fit(source_of(experiment)[0], unit), unit, how_of(hold_out, folds, truth, by, monotone, simplest)
    )


def how_of(
    hold_out: Sequence[str], folds: int | None, truth: str | None, by: Sequence[str], monotone: bool, simplest: bool
) -> Any:
    """How to fit, checked. Raises InputError."""
    from copem_replay.pipeline.fit.fit import How

    if hold_out and folds is not None:
        raise InputError("--folds: expected either folds or logs to hold out, found both")
    if folds is not None and folds < 2:
        raise InputError(f"--folds: expected at least 2, found {folds}")
    if truth not in (None, "partial", "complete"):
        raise InputError(f"--truth: expected partial or complete, found {truth}")
    for name in by:
        if name not in ("range", "visible_share", "azimuth", "class"):
            raise InputError(f"--by: expected some of range, visible_share, azimuth, class; found {name!r}")
    return How(tuple(hold_out), folds, truth, tuple(by), monotone, simplest)  # type: ignore[arg-type]


def study_to_fit(source: Source, unit: str) -> Study:
    """An experiment and its recordings, whose recorded unit need not state what is going to be estimated."""
    return read_study(replace(source, data=_with_covariance(source.data, unit)))


def fitted(study: Study, unit: str, how: Any) -> FittedPem:
    """The fit of a study."""
    from copem_replay.pipeline.fit.check import checked
    from copem_replay.pipeline.fit.fit import fit as fit_unit

    if not study.recordings:
        raise ExperimentError(study.source.at(("logs",), "expected at least one recording, found none"))
    from copem_replay.pipeline.study_log import content_of

    # Taken now, while the files are what was read.
    known = tuple(replace(recording, sha256=content_of(recording)) for recording in study.recordings)
    study = replace(study, recordings=known)
    found = checked(fit_unit(study.experiment, study.recordings, unit, how))
    return FittedPem(study.experiment, study.recordings, found)


def _with_covariance(data: dict[str, Any], unit: str) -> dict[str, Any]:
    """The data of an experiment whose recorded unit says some covariance, in all its logs."""

    def stated(units: Any) -> Any:
        mine = units.get(unit) if isinstance(units, dict) else None
        recorded = mine.get("recorded") if isinstance(mine, dict) else None
        if not isinstance(mine, dict) or not isinstance(recorded, dict):
            return units
        return units | {unit: mine | {"recorded": {"covariance_m2": _STATED} | recorded}}

    def entry(one: Any) -> Any:
        return one | {"units": stated(one["units"])} if isinstance(one, dict) and "units" in one else one

    logs = data.get("logs")
    changed = {"units": stated(data.get("units"))} if "units" in data else {}
    return data | changed | ({"logs": [entry(one) for one in logs]} if isinstance(logs, list) else {})

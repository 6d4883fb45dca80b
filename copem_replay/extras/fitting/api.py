"""`cr.fit`: a perception error model from the recorded lists of a unit, in Python or saved as a folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from copem_replay.api.study import AnyExperiment, AnyPath, LoadedStudy, load_source, read_study
from copem_replay.core.errors import ExperimentError, InputError, OutputError, count_noun
from copem_replay.experiment.file import ExperimentSource
from copem_replay.experiment.schema import Experiment
from copem_replay.io.recording import Recording

if TYPE_CHECKING:
    from copem_replay.extras.fitting.estimate import Estimate
    from copem_replay.extras.fitting.fit import Fit


_ANY_COVARIANCE_M2 = [[1.0, 0.0], [0.0, 1.0]]
"""Covariance (m²) of lists that state none, so that they can be read; no estimate depends on it."""


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
        matched = count_noun(found.gathered.matched, "entry", "entries")
        return f"FittedPem({found.unit}, {count_noun(len(found.logs), 'log')}, {matched})"

    @property
    def estimates(self) -> dict[str, Estimate]:
        """Every number by its name."""
        from copem_replay.extras.fitting.page import list_estimates

        return dict(list_estimates(self.found))

    @property
    def yaml(self) -> str:
        """The model as keys of an experiment: `pems` and `units`, behind every number how well it is known."""
        from copem_replay.extras.fitting.page import pem_text

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
        from copem_replay.extras.fitting.page import fill_fit
        from copem_replay.results.folder import check_inputs, take_place

        with take_place(Path(folder), overwrite=overwrite) as place:
            check_inputs(place, [path for recording in self.recordings for path in recording.paths])
            fill_fit(place, self.found, self.experiment, self.recordings)
            self.folder = place.shown
        if place.failed:
            raise OutputError(place.failed)
        return place.shown


def fit(
    experiment: AnyExperiment,
    unit: str,
    *,
    hold_out: Sequence[str] = (),
    folds: int | None = None,
    truth: str | None = None,
    by: Sequence[str] | None = None,
    monotone: bool = True,
    simplest: bool = False,
    delay_by: str | None = None,
) -> FittedPem:
    """Fit a perception error model to the lists of a recorded unit and the truth beside them.

    `unit`: one whose lists are `recorded`, with its place (`at` or `on`). `hold_out`: names of logs that are left for
    the check. `folds`: parts of the cross-validation that chooses between models. `truth`: `partial`, if entries may be
    about objects that the truth lacks, or `complete`; None: partial where a list has more of them than true objects are
    within reach. `by`: what detection may depend on, of `range`, `visible_share`, `class`, `azimuth`; None: all.
    `monotone`: farther and more hidden is never better. `simplest`: the first rung of every ladder. `delay_by`: `log`,
    each log has a delay of its own; `class`, each log whose objects are of one class has that of the class.

    Raises InputError: no such unit or log, no place, nothing of it near a true object.

    >>> cr.fit("logs/tc016d.yaml", "rspu01")
    Traceback (most recent call last):
    copem_replay.core.errors.InputError: unit rspu01: expected a unit whose lists are recorded (none), ...
    """
    return fit_study(
        read_study_to_fit(load_source(experiment)[0], unit),
        unit,
        check_fit_options(hold_out, folds, truth, by, monotone, simplest, delay_by),
    )


def check_fit_options(
    hold_out: Sequence[str],
    folds: int | None,
    truth: str | None,
    by: Sequence[str] | None,
    monotone: bool,
    simplest: bool,
    delay_by: str | None = None,
) -> Any:
    """FitOptions of these values. Raises InputError for a value that is not allowed."""
    from copem_replay.extras.fitting.detection import BY
    from copem_replay.extras.fitting.fit import FitOptions

    if hold_out and folds is not None:
        raise InputError("--folds: expected either folds or logs to hold out, found both")
    if folds is not None and folds < 2:
        raise InputError(f"--folds: expected at least 2, found {folds}")
    if truth not in (None, "partial", "complete"):
        raise InputError(f"--truth: expected partial or complete, found {truth}")
    by = BY if by is None else tuple(by)
    if unknown := [name for name in by if name not in BY]:
        raise InputError(f"--by: expected some of {', '.join(BY)}; found {unknown[0]!r}")
    if delay_by not in (None, "log", "class"):
        raise InputError(f"--delay-by: expected log or class, found {delay_by}")
    kind: Any = truth
    late_by: Any = delay_by
    return FitOptions(tuple(hold_out), folds, kind, by, monotone, simplest, delay_by=late_by)


def read_study_to_fit(source: ExperimentSource, unit: str) -> LoadedStudy:
    """An experiment and its recordings; the lists of `unit` need no stated covariance, for the fit estimates it. Raises
    InputError: the experiment has no such unit.
    """
    units = source.data.get("units")
    if isinstance(units, dict) and unit not in units:
        recorded = [name for name, keys in units.items() if isinstance(keys, dict) and "recorded" in keys]
        names = ", ".join(recorded) or "none"
        raise InputError(f"unit {unit}: expected a unit whose lists are recorded ({names}), found no such unit")
    return read_study(replace(source, data=_add_covariance(source.data, unit)))


def fit_study(study: LoadedStudy, unit: str, options: Any) -> FittedPem:
    """Fit a unit of a study, with its replay check. Raises ExperimentError without a recording, InputError as `fit`."""
    from copem_replay.extras.fitting.fit import add_replay_check, fit_unit
    from copem_replay.extras.fitting.needless_check import check_needless

    if not study.recordings:
        raise ExperimentError(study.source.at(("logs",), "expected at least one recording, found none"))
    from copem_replay.pipeline.study_log import read_content_digest

    # Digests are taken now, while the files are still what was read.
    recordings = tuple(replace(recording, sha256=read_content_digest(recording)) for recording in study.recordings)
    fit_of_unit = add_replay_check(fit_unit(study.experiment, recordings, unit, options))
    needless = check_needless(fit_of_unit, study.experiment, recordings)
    fit_of_unit = replace(fit_of_unit, needless="" if needless is None else needless.line())
    return FittedPem(study.experiment, recordings, fit_of_unit)


def _add_covariance(data: dict[str, Any], unit: str) -> dict[str, Any]:
    """The experiment's data with a covariance of the recorded unit, in `units` and each log, where none is stated."""

    def with_covariance(units: Any) -> Any:
        keys = units.get(unit) if isinstance(units, dict) else None
        recorded = keys.get("recorded") if isinstance(keys, dict) else None
        if not isinstance(keys, dict) or not isinstance(recorded, dict):
            return units
        return units | {unit: keys | {"recorded": {"covariance_m2": _ANY_COVARIANCE_M2} | recorded}}

    def convert_units(keys: Any) -> Any:
        return keys | {"units": with_covariance(keys["units"])} if isinstance(keys, dict) and "units" in keys else keys

    logs = data.get("logs")
    converted: dict[str, Any] = convert_units(data)
    return converted | ({"logs": [convert_units(entry) for entry in logs]} if isinstance(logs, list) else {})

"""Criteria: what has to hold of results so that they are good enough, each a metric, a bound, and of what it is asked.

A criterion is judged by the interval of its metric (`results/judge.py`). Its keys stand in an experiment, or in a file
of their own with the one key `criteria`, so that the limits of a team lie beside its code. Names are checked before any
run: one that does not exist would be a limit that nothing ever breaks.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, ValidationError, field_validator, model_validator

from copem_replay.core.components import Frozen, Id, Number
from copem_replay.core.errors import ExperimentError, InputError, near_name_hint, unknown_name_message
from copem_replay.core.tracks import CLASS_GROUPS, TRUTH
from copem_replay.metrics.config import parse_slices
from copem_replay.metrics.figure_limits import JUDGED, PER_MINUTE, SUMMED
from copem_replay.metrics.intervals import CONFIDENCE
from copem_replay.metrics.summary_metrics import COMPARED, METRICS_OF
from copem_replay.perception.pem.condition import ClassNames

if TYPE_CHECKING:
    from copem_replay.core.yaml import Key
    from copem_replay.experiment.file import ExperimentSource

BEFORE = "before"
"""What a criterion is against: the same configuration in the folder of `--before`; `NAME@before`: that one there."""


class ObjectsOf(Frozen):
    """Which of the measured objects a criterion is about: those of some classes, or some by their ids."""

    classes: ClassNames | None = None
    ids: Annotated[tuple[Id, ...], Field(min_length=1)] | None = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        if (self.classes is None) == (self.ids is None):
            raise ValueError("expected one of `classes: [vru]` and `ids: [7, 12]`")
        return self

    def expanded(self) -> frozenset[str] | None:
        """The classes, those of groups among them; None: objects are named by their ids."""
        if self.classes is None:
            return None
        return frozenset(member for name in self.classes for member in CLASS_GROUPS.get(name, (name,)))


def _check_is_name(value: str) -> str:
    if not value.strip() or not value.isprintable():
        raise ValueError(f"expected a printable name, found {value!r}")
    return value


CriterionName = Annotated[Id, AfterValidator(_check_is_name)]
Entry = Annotated[str, Field(min_length=1)]


class Criterion(Frozen):
    """A bound that a metric has to keep, `at_most` or `at_least`.

    `configurations`: None: all but the truth. `objects`, `logs` (with wildcards), `by` (a value for each dimension of a
    slice): of what; `each`: of every group of a slice, each by itself. `against`: the metric is the difference to this
    configuration, pair by pair: of the same results, or `NAME@before` of those given by `--before`, where `before`
    alone is the same name. `population`: whether it is asked of all such traffic, or of the runs of these logs.
    `passes_when`: it is `shown` (by default of a bound), or `not_refuted` (by default of a difference). `if_absent`:
    what becomes of it where nothing is measured.
    """

    metric: Annotated[str, Field(min_length=1)]
    at_most: Number | None = None
    at_least: Number | None = None
    configurations: Annotated[tuple[Id, ...], Field(min_length=1)] | None = None
    objects: ObjectsOf | None = None
    logs: Annotated[tuple[Entry, ...], Field(min_length=1)] | None = None
    by: Annotated[dict[str, Id], Field(min_length=1)] | None = None
    each: Entry | Annotated[tuple[Entry, ...], Field(min_length=1)] | None = None
    against: Id | None = None
    population: Literal["such_traffic", "these_logs"] = "such_traffic"
    confidence: Annotated[float, Field(strict=True, ge=0.5, le=0.9999)] = CONFIDENCE
    passes_when: Literal["shown", "not_refuted"] | None = None
    if_absent: Literal["fail", "pass"] = "fail"

    @field_validator("each")
    @classmethod
    def _sliced(cls, each: Any) -> Any:
        if each is not None:
            parse_slices([each])
        return each

    @field_validator("by")
    @classmethod
    def _of_slices(cls, by: dict[str, str] | None) -> dict[str, str] | None:
        if by is not None:
            parse_slices([list(by)])
        return by

    @model_validator(mode="after")
    def _one_bound(self) -> Self:
        if (self.at_most is None) == (self.at_least is None):
            found = "none" if self.at_most is None else "both"
            raise ValueError(f"expected one of `at_most` and `at_least`, found {found}")
        if self.by is not None and self.each is not None:
            raise ValueError("expected either `by`, one group, or `each`, every group; found both")
        return self

    @property
    def bound(self) -> float:
        """The bound."""
        return float(self.at_most if self.at_most is not None else self.at_least or 0.0)

    @property
    def direction(self) -> Literal["at_most", "at_least"]:
        """On which side of the bound the metric has to be."""
        return "at_most" if self.at_most is not None else "at_least"

    @property
    def passes_unless_refuted(self) -> bool:
        """Whether it passes where it is undecided."""
        return self.passes_when == "not_refuted" or (self.passes_when is None and self.against is not None)

    @property
    def of_runs(self) -> bool:
        """Whether it is asked of the runs of these logs."""
        return self.population == "these_logs"

    def find_against(self, configuration: str, known: Sequence[str]) -> tuple[str, bool]:
        """The other side of a difference, and whether it is of the results of before."""
        other = self.against or ""
        if other in known:
            return other, False
        if other == BEFORE:
            return configuration, True
        name, at, where = other.rpartition("@")
        return (name, True) if at and where == BEFORE else (other, False)


class CriteriaFile(Frozen):
    """A file with criteria alone."""

    criteria: Annotated[dict[CriterionName, Criterion], Field(min_length=1)]


def read_criteria(given: Path | Mapping[str, Any], study: Mapping[str, Any]) -> dict[str, Criterion]:
    """Criteria by name, from a file with the one key `criteria` or as plain data, checked against an experiment's data.

    Raises ExperimentError with all problems, a line each, with file, line and key.
    """
    from copem_replay.experiment.file import describe_by_key, make_plain_source, read_experiment_file

    source = make_plain_source({"criteria": given}) if isinstance(given, Mapping) else read_experiment_file(given)
    problems = [*source.problems, *check_criteria(source, study)]
    try:
        criteria = CriteriaFile.model_validate(source.data).criteria
    except ValidationError as error:
        shape = describe_by_key(CriteriaFile, error, source.data)
        raise ExperimentError([*problems, *(source.at(key, message) for key, message in shape)]) from None
    if problems:
        raise ExperimentError(problems)
    return dict(criteria)


_FAIL_ON = re.compile(r"\s*(\w+)\s*([<>])=?\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*")


def parse_fail_on(conditions: Sequence[str], against: str, names: Sequence[str] | None) -> dict[str, dict[str, Any]]:
    """Criteria of which these conditions, `ttd_rmst_s > 0.05`, are the refutation: differences to `against`.

    `names`: of the configurations. Raises InputError for a condition of another form.
    """
    criteria: dict[str, dict[str, Any]] = {}
    for condition in conditions:
        if (found := _FAIL_ON.fullmatch(condition)) is None:
            example = "such as 'ttd_rmst_s > 0.05'"
            raise InputError(f"--fail-on: expected a metric and a bound, {example}, found {condition!r}")
        metric, sign, bound = found.groups()
        criterion: dict[str, Any] = {"metric": metric, "against": against}
        criterion["at_most" if sign == ">" else "at_least"] = float(bound)
        criteria[condition.strip()] = criterion | ({} if names is None else {"configurations": list(names)})
    return criteria


# Names that criteria use.

_ASKED: dict[str, tuple[Callable[[Mapping[str, Any]], bool], str]] = {
    "braking": (lambda data: data.get("braking") is not None, "`braking: {driver: …}`"),
    "conflict": (lambda data: _measure_of(data).get("conflict") is not None, "`measure: {conflict: {}}`"),
    "accuracy": (lambda data: _measure_of(data).get("accuracy", True) is not False, "`measure: {accuracy: true}`"),
    "exact": (lambda data: _measure_of(data).get("exact") is True, "`measure: {exact: true}`"),
}
"""What an experiment has to ask for so that there is a metric: whether it does, and the key that would."""


def _measure_of(data: Mapping[str, Any]) -> Mapping[str, Any]:
    measure = data.get("measure")
    return measure if isinstance(measure, Mapping) else {}


def _own_names(study: Mapping[str, Any]) -> list[str]:
    own = _measure_of(study).get("metrics")
    return [str(one.get("name")) for one in own if isinstance(one, dict)] if isinstance(own, list | tuple) else []


def check_criteria(source: ExperimentSource, study: Mapping[str, Any]) -> Iterator[str]:
    """A line for every metric and configuration that criteria name and the experiment `study`, plain data, has not."""
    criteria = source.data.get("criteria")
    configurations = study.get("configurations")
    known = [str(name) for name in configurations] if isinstance(configurations, Mapping) else []
    for name, criterion in criteria.items() if isinstance(criteria, Mapping) else ():
        if not isinstance(criterion, Mapping):
            continue
        key: Key = ("criteria", name)
        metric, against = criterion.get("metric"), criterion.get("against")
        if isinstance(metric, str) and (problem := _find_metric_problem(metric, against is not None, study)):
            yield source.at((*key, "metric"), problem)
        named = criterion.get("configurations")
        for k, one in enumerate(named if isinstance(named, list | tuple) else ()):
            if isinstance(one, str | int) and str(one) not in known:
                yield source.at((*key, "configurations", k), _unknown_configuration(one, known))
        if isinstance(against, str | int) and str(against) not in known:
            other, _, where = str(against).rpartition("@")
            if where != BEFORE or (other and "@" not in str(against)):
                hint = f"; of the results given by --before: {against}@{BEFORE}, or {BEFORE} for the same name"
                yield source.at((*key, "against"), _unknown_configuration(against, known) + hint)


def _unknown_configuration(name: object, known: Sequence[str]) -> str:
    return f"expected names of configurations, found {name}: {unknown_name_message('configuration', name, known)}"


def _find_metric_problem(metric: str, paired: bool, study: Mapping[str, Any]) -> str | None:
    """Why a metric cannot be held against a bound; None: it can. `paired`: it is a difference."""
    own, of = _own_names(study), {name.name: what for what, names in METRICS_OF.items() for name in names}
    if metric not in of and metric not in own and metric not in COMPARED:
        hint = near_name_hint(metric, [*of, *own, *COMPARED]) or "; `copem-replay schema` lists them"
        return f"expected a column of summary.csv, found {metric}{hint}"
    if paired and metric not in COMPARED:
        listed = ", ".join(COMPARED)
        return f"expected a metric that `compare` pairs, as there is `against`, found {metric}; there are {listed}"
    judged = (*JUDGED, *SUMMED, *PER_MINUTE, *own)
    if not paired and metric not in judged:
        if metric in COMPARED:
            return f"{metric} is a difference of two configurations; say `against: <configuration>`"
        return f"expected a metric that has an interval over logs or runs, found {metric}{_judged_instead(metric)}"
    needs = [of.get(metric, "")] + ["braking"] * (metric in JUDGED and "braking" in JUDGED[metric].rows)
    if metric in COMPARED and COMPARED[metric].compared and (COMPARED[metric].compared or (0, 0, ()))[2]:
        needs.append("accuracy")
    for what in needs:
        if what in _ASKED and not _ASKED[what][0](study):
            return f"expected a metric that the experiment measures, found {metric}; {_ASKED[what][1]} would"
    return None


def _judged_instead(metric: str) -> str:
    if f"{metric.removesuffix('_m')}_held_m" in COMPARED:
        return f"; with `against`, {metric.removesuffix('_m')}_held_m has one"
    return f"; there are {', '.join(name for name in (*JUDGED, *SUMMED, *PER_MINUTE) if not name.endswith('_exact'))}"


def choose_judged(criterion: Criterion, configurations: Mapping[str, Any]) -> list[str]:
    """The configurations that a criterion is about, of all `configurations` by name."""
    if criterion.configurations is not None:
        return list(dict.fromkeys(criterion.configurations))
    judged = [name for name, one in configurations.items() if one.units != TRUTH]
    if criterion.against is not None and not criterion.find_against("", list(configurations))[1]:
        judged = [name for name in judged if name != criterion.against]
    return judged

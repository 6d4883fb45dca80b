"""Criteria: what has to hold of results so that they are good enough, each a metric, a bound, and of what it is asked.

A criterion is judged by the interval of its metric (`results/judge.py`). Its keys stand in an experiment, or in a file
of their own with the one key `criteria`, so that the limits of a team lie beside its code. Names are checked before any
run: one that does not exist would be a limit that nothing ever breaks.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, field_validator, model_validator

from copem_replay.core.components import Frozen, Id, Number
from copem_replay.core.errors import InputError
from copem_replay.core.tracks import CLASS_GROUPS, TRUTH
from copem_replay.metrics.config import Measure, Weigh, parse_slices
from copem_replay.metrics.limits import CONFIDENCE, DRIVES, TRAFFIC, choose_over, explain_no_clusters
from copem_replay.metrics.needed import Known, count_at_best, find_enough_horizon
from copem_replay.perception.pem.condition import ClassNames

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
        """The classes, with groups expanded; None: objects are named by their ids."""
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
    what becomes of it where nothing is measured. `weigh`: what counts alike in the metric, every object or every drive;
    None: as `measure.weigh`.
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
    weigh: Weigh | None = Field(default=None, exclude_if=lambda weigh: weigh is None)

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
        """The configuration that the difference is to, and whether it is in earlier results."""
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


_FAIL_ON = re.compile(r"\s*(\w+)\s*([<>])=?\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*")


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


def note_undecidable(criteria: Mapping[str, Criterion], counted: Sequence[int], measure: Measure) -> Iterator[str]:
    """Notes on criteria that no number of runs can decide, or that so few cannot meet.

    `counted`: by log how many episodes count.
    """
    names = [name for name, one in criteria.items() if not one.of_runs]
    logs = sum(number > 0 for number in counted)
    over = choose_over(logs, sum(counted), 1)
    if over in TRAFFIC:
        for name in names:
            once = over == "logs" and (criteria[name].weigh or measure.weigh) == DRIVES
            clusters = logs if over == "logs" else sum(counted)
            known = Known(over, clusters, clusters if once else sum(counted))
            if (line := _note_too_few(name, criteria[name], known, measure.horizon_s)) is not None:
                yield line
    elif names:
        yield (
            f"criteria {', '.join(names)}: such traffic is not measured by {explain_no_clusters(logs, sum(counted))}, "
            "whatever the runs; `population: these_logs` asks about these recordings"
        )


def _note_too_few(name: str, criterion: Criterion, known: Known, horizon_s: float) -> str | None:
    """A note on a criterion that so few clusters cannot show to be met, however good the figure; None: they can."""
    if criterion.against is not None:
        return None
    metric, bound = criterion.metric, criterion.bound
    needed = count_at_best(metric, criterion.direction, bound, horizon_s, known, criterion.confidence)
    if needed is None:
        return None
    asked = f"{metric} ≤ {bound:g}" if criterion.direction == "at_most" else f"{metric} ≥ {bound:g}"
    line = f"criteria {name}: {known.clusters} {known.over} cannot show {asked}, however good; at least {needed} can"
    shorter_s = find_enough_horizon(metric, bound, known, criterion.confidence)
    return line if shorter_s is None else f"{line}, or a horizon_s of {shorter_s:.2g}"


def choose_judged(criterion: Criterion, configurations: Mapping[str, Any]) -> list[str]:
    """The configurations that a criterion judges, out of `configurations`, all by name."""
    if criterion.configurations is not None:
        return list(dict.fromkeys(criterion.configurations))
    judged = [name for name, one in configurations.items() if one.units != TRUTH]
    if criterion.against is not None and not criterion.find_against("", list(configurations))[1]:
        judged = [name for name in judged if name != criterion.against]
    return judged

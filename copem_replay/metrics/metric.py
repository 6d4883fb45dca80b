"""A metric: one column of `summary.csv` with its statistics, its value and its words in one place.

Statistics are sums over runs, objects, lists and logs (for quantiles: tables of times); the value is computed from them
last. An own metric derives from `RowMetric`; the experiment names it in `measure: {metrics: [{kind: …}]}`. The metrics
of lists on links (`LINK`) and of recorded outputs (`OUTPUT`) stand here beside their sums; the others are in
`metrics/summary_metrics.py` and `metrics/accuracy/metrics.py`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from operator import attrgetter
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import Field

from copem_replay.communication.arrivals import find_out_of_sequence, find_overtaken_lists
from copem_replay.core.components import Component, GivenError, ask_component
from copem_replay.core.tracks import Float, Tracks
from copem_replay.metrics.limits import OBJECTS

if TYPE_CHECKING:
    import pandas as pd

    from copem_replay.metrics.accuracy.statistics import AccuracyTotal


Value = float | int | str | None
OwnSums = dict[str, float]
"""Sums of an own metric over rows and logs, by their names; empty without rows."""


@dataclass(frozen=True)
class MetricInputs:
    """What the statistics of one configuration are computed from, over all logs, runs and measured objects.

    `rows`: its rows of `tally.parquet` for detections, log by log; `conflicts`: those for implied collisions, None
    where the experiment does not ask for them. `facts`: what it is (`ConfigurationFacts`), of which `fixed`,
    `fixed_verdicts`, `truth` and `least_s` are read; None: nothing is known. `accuracy`, `exact`: None where the
    experiment does not ask for it. `output`: times of a recorded output, `link`: of the lists on links; None: the
    configuration has none. `driving`: rows of `lists.parquet`, or of `sum_lists`; None: without accuracy. `own`: sums
    of own metrics, by name. `weigh`: what weighs alike, objects or drives.
    """

    rows: pd.DataFrame
    list_rate_hz: float | None
    horizon_s: float | None
    facts: Any = None
    accuracy: AccuracyTotal | None = None
    exact: pd.DataFrame | None = None  # its rows of exact.parquet
    output: OutputTimes | None = None
    conflicts: pd.DataFrame | None = None
    link: LinkTimes | None = None
    own: Mapping[str, OwnSums] = field(default_factory=dict)
    weigh: str = OBJECTS
    driving: pd.DataFrame | None = None


class Compared(NamedTuple):
    """What the difference to a baseline is: in words, and the figure of the pairs that it is taken of.

    `figure`: values (C,) made of columns of the rows that both have (`results/compare/pairing.py`), whose means are
    compared, or shares where they are true or false; or a name in `FIGURES` of `results/compare/metrics.py`. `files`:
    that it is made of, beside `detections.parquet`.
    """

    words: str
    figure: Callable[[Any], Any] | str
    files: tuple[str, ...] = ()


@dataclass(frozen=True)
class Metric:
    """One column of `summary.csv`, one metric of `compare`, or both.

    `statistics`: gives the sums; None: the experiment does not ask for this metric, which then has no column. Metrics
    with equal statistics share the function, which is called once. `value`: computes the value from the sums; None: no
    sample. `better`: 1 more, −1 less, 0 neither. `part`: the table that shows the metric on the terminal and in the
    report; empty: none. `header`: of its column in the report, with the unit; empty: made of the name. `compared`:
    None: it is not compared. `kind`, `among`: as of a column of results.
    """

    name: str
    statistics: Callable[[MetricInputs], Any]
    value: Callable[[Any], Value]
    better: Literal[-1, 0, 1]
    help: str = ""
    part: str = ""
    header: str = ""
    compared: Compared | None = None
    kind: str = "numbers"
    among: tuple[str, ...] = ()


def compared_metric(name: str, better: Literal[-1, 1], part: str, header: str, compared: Compared) -> Metric:
    """A metric of pairs, which `compare` alone has."""
    return Metric(name, lambda _: None, lambda _: None, better, "", part, header, compared)


def evaluate_metrics(metrics: Sequence[Metric], inputs: MetricInputs) -> dict[str, Value]:
    """The columns of one configuration, by name; None: no sample."""
    sums: dict[Hashable, Any] = {}
    row: dict[str, Value] = {}
    for metric in metrics:
        if metric.statistics not in sums:
            sums[metric.statistics] = metric.statistics(inputs)
        if sums[metric.statistics] is not None:
            row[metric.name] = metric.value(sums[metric.statistics])
    return row | (_pin_limits(metrics, row) if getattr(inputs.facts, "truth", False) else {})


def _pin_limits(metrics: Sequence[Metric], row: Mapping[str, Value]) -> dict[str, Value]:
    """The limits of the truth's figures that are the best there can be: so by definition, but for `braking` in time."""
    best = {of.name: float(of.better > 0) for of in metrics if of.better and of.part != "braking"}
    pinned = (name for name in best if row.get(f"{name}_low") is not None and row[name] == best[name])
    return {f"{name}_{end}": best[name] for name in pinned for end in ("low", "high")}


def divide_or_none(total: float, number: float) -> float | None:
    """The quotient, a mean or a share; None where the divisor is 0."""
    return float(total) / float(number) if number > 0 else None


OWN = "own"
"""The `part` of own metrics."""


class RowMetric(Component, ABC):
    """Base of own metrics: sums over rows of `detections.parquet`, and a value made of the sums.

    `name`: the column; units belong in it. `help`: its meaning in one clause, for the report. `better` as in `Metric`.

    >>> class Late(cr.RowMetric):
    ...     def statistics(self, rows):
    ...         return {"late": (rows["time_to_detection_s"] > 0.5).to_numpy(), "rows": np.ones(len(rows))}
    ...
    ...     def value(self, sums):
    ...         return sums["late"] / sums["rows"]
    """

    help: ClassVar[str] = ""
    better: ClassVar[Literal[-1, 0, 1]] = 0

    name: Annotated[str, Field(strict=True, pattern=r"^[a-z][a-z0-9_]*$", max_length=60)]

    @abstractmethod
    def statistics(self, rows: pd.DataFrame) -> Mapping[str, Float]:
        """Named statistics (n,) of the n rows of one configuration in one log, in the order of run and object.

        Columns: docs/guide/metrics.md. Each statistic is then summed over rows and logs.
        """

    @abstractmethod
    def value(self, sums: Mapping[str, float]) -> float | None:
        """The value of the sums; None or NaN: no sample. Without rows it is not called."""


def own_metrics(components: Sequence[RowMetric]) -> tuple[Metric, ...]:
    """The columns of own metrics."""
    return tuple(_own_metric_column(k, component) for k, component in enumerate(components))


def _own_metric_column(k: int, metric: RowMetric) -> Metric:
    def value(sums: OwnSums) -> float | None:
        number = ask_component(metric, _own_metric_key(k), lambda: _check_number(metric.value(sums))) if sums else None
        return None if number is None or np.isnan(number) else number

    return Metric(metric.name, lambda given: given.own.get(metric.name, {}), value, metric.better, metric.help, OWN)


def _own_metric_key(k: int) -> str:
    return f"measure.metrics[{k}]"


def _check_number(value: Any) -> float | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise GivenError("value", f"expected a number or None, found {type(value).__name__}")
    return float(value)


def own_sums(components: Sequence[RowMetric], rows: pd.DataFrame) -> dict[str, OwnSums]:
    """Sums of own metrics, by name, over the rows of `detections.parquet` of one configuration in one log."""
    return {
        metric: {name: float(values.sum()) for name, values in of_metric.items()}
        for metric, of_metric in own_statistics(components, rows).items()
    }


def own_statistics(components: Sequence[RowMetric], rows: pd.DataFrame) -> dict[str, dict[str, Float]]:
    """The statistics (n,) of own metrics, by name, of the n rows of one configuration in one log; empty without rows.

    Raises InputError where an own metric fails.
    """
    if not len(rows):
        return {}
    rows = rows.reset_index(drop=True)
    return {
        own.name: ask_component(own, _own_metric_key(k), partial(_check_statistics, own, rows))
        for k, own in enumerate(components)
    }


def _check_statistics(metric: RowMetric, rows: pd.DataFrame) -> dict[str, Float]:
    columns: dict[str, Float] = {}
    for name, values in metric.statistics(rows).items():
        columns[name] = np.asarray(values, dtype=float)
        if (shape := columns[name].shape) != (len(rows),):
            raise GivenError("statistics", f"{name}: expected shape ({len(rows)},), found {shape}")
    return columns


# Lists on links, for configurations that name one.


@dataclass(frozen=True)
class LinkTimes:
    """Sums over the lists that units send: how many, lost, and overtaken by a newer one of their unit.

    `from_s`, `to_s (N,)`: the age of the newest list of a unit at its arrival, and when a newer one replaced it.
    """

    sent: int
    lost: int
    overtaken: int
    from_s: Float
    to_s: Float

    def __add__(self, other: LinkTimes) -> LinkTimes:
        return LinkTimes(
            self.sent + other.sent, self.lost + other.lost, self.overtaken + other.overtaken,
            np.concatenate([self.from_s, other.from_s]), np.concatenate([self.to_s, other.to_s]),
        )  # fmt: skip

    def age_s(self, q: float) -> float | None:
        """The q-quantile over time of the age of the newest list, of all units and runs; None: no list arrived."""
        ages = np.concatenate([self.from_s, self.to_s])
        order = np.argsort(ages, kind="stable")
        step = np.concatenate([np.ones(len(self.from_s)), -np.ones(len(self.to_s))])[order]
        passed = np.concatenate([[0.0], np.cumsum(np.cumsum(step)[:-1] * np.diff(ages[order]))]) if len(ages) else ages
        return float(np.interp(q * passed[-1], passed, ages[order])) if len(ages) and passed[-1] > 0 else None


def link_times(listed: Tracks, arriving: Tracks, received: Tracks, units: Collection[str], end_s: float) -> LinkTimes:
    """Sums over the lists that `units` send in one run, up to the end of the log, `end_s`.

    `listed`: the lists as they are sent; `arriving`: as they arrive, which decides whether they are overtaken;
    `received`: as the receiver takes them in.
    """
    arrives_s, late = received.common_arrives_s, find_out_of_sequence(received)
    sent = np.isfinite(listed.common_arrives_s)
    sent &= np.array([name in units for name in received.units], dtype=bool)[received.frame_unit_ix]
    arrived = sent & np.isfinite(arrives_s)
    ages: list[tuple[Float, Float]] = []
    for unit in np.unique(received.frame_unit_ix[sent]):
        frames = np.flatnonzero((received.frame_unit_ix == unit) & ~late & (arrives_s <= end_s))
        frames = frames[np.argsort(arrives_s[frames], kind="stable")]
        until_s = np.append(arrives_s[frames][1:], end_s)
        ages.append((arrives_s[frames] - received.captured_s[frames], until_s - received.captured_s[frames]))
    from_s, to_s = (np.concatenate([np.empty(0), *(part[k] for part in ages)]) for k in (0, 1))
    return LinkTimes(
        int(sent.sum()),
        int((sent & ~arrived).sum()),
        int((arrived & find_overtaken_lists(arriving)).sum()),
        from_s,
        to_s,
    )


_row = partial(Metric, statistics=attrgetter("link"), better=-1, part="link")
LINK = (
    _row("lost_share", value=lambda of: divide_or_none(of.lost, of.sent),
         help="share of the lists sent by a link that it loses"),
    _row("age_of_information_p50_s", value=lambda of: of.age_s(0.5),
         help="age since capture of a unit's newest list that arrived by a link: at most this for 50 % of the time"),
    _row("age_of_information_p95_s", value=lambda of: of.age_s(0.95), help="the same for 95 % of the time"),
    _row("overtaken_share", value=lambda of: divide_or_none(of.overtaken, of.sent - of.lost),
         help="share of the arriving lists that come after a newer one of their unit; ideal fusion and trackers still "
              "use them, and all fusions do where messages are partial"),
)  # fmt: skip
"""Columns of `summary.csv` where a configuration has a link."""


# Ages of a stack's recorded output, for configurations that are `recorded`.


@dataclass(frozen=True)
class OutputTimes:
    """Sums (s) over the lists of a stack that become available while a log lasts, and over how many lists each is.

    `latency_s`: available − stamp of the state, where the messages say both; `delay_s`: that stamp − instant of the
    state, from `delay_s` of the experiment; `input_age_s`: available − newest capture among the inputs that had
    arrived.
    """

    latency_s: float = 0.0
    with_latency: int = 0
    delay_s: float = 0.0
    with_delay: int = 0
    input_age_s: float = 0.0
    with_input: int = 0

    def __add__(self, other: OutputTimes) -> OutputTimes:
        return OutputTimes(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(OutputTimes)))


_OF_OUTPUT = attrgetter("output")

OUTPUT = (
    Metric("output_latency_s", _OF_OUTPUT, lambda of: divide_or_none(of.latency_s, of.with_latency), -1,
           "a stack's lists: available − the stamp of the state, mean; a dash: not in the messages", "output"),
    Metric("output_delay_s", _OF_OUTPUT, lambda of: divide_or_none(of.delay_s, of.with_delay), -1,
           "a stack's lists: that stamp − the instant of the state, by `delay_s` of the experiment", "output"),
    Metric("input_age_s", _OF_OUTPUT, lambda of: divide_or_none(of.input_age_s, of.with_input), -1,
           "available − the newest capture of an input that had arrived: its age, not a latency", "output"),
)  # fmt: skip
"""Columns of `summary.csv` where a configuration is recorded."""

"""A metric: one column of `summary.csv`, with all that is said of it in one place.

Its statistics are sums over runs, objects, lists and logs (quantiles: tables of times), and its value is made of them
last. An own metric derives from `RowMetric`; the experiment names it in `measure: {metrics: [{kind: …}]}`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from copem_replay.core.components import Component, GivenError, asked
from copem_replay.core.tracks import Float

if TYPE_CHECKING:
    import pandas as pd

    from copem_replay.metrics.accuracy.statistics import Total
    from copem_replay.metrics.link_times import LinkTimes
    from copem_replay.metrics.output_times import OutputTimes

Value = float | int | str | None
OwnSums = dict[str, float]
"""Sums of an own metric over rows and logs, by their names; empty without rows."""


@dataclass(frozen=True)
class Given:
    """What the statistics of one configuration are made from, over all logs, runs and measured objects.

    `rows`: its rows of `tally.parquet` of being detected, log by log; `conflicts`: of a collision being implied, None
    where that is not asked for. `lists_fixed`, `reaction_fixed`: known alike, braking alike in every run. `accuracy`,
    `exact`: None where the experiment asks for neither. `output`: of a stack's recorded output. `link`: of the lists
    that come by one. `own`: sums of own metrics, by name.
    """

    rows: pd.DataFrame
    list_rate_hz: float | None
    seed: int
    horizon_s: float | None
    lists_fixed: bool = False
    reaction_fixed: bool = False
    accuracy: Total | None = None
    exact: pd.DataFrame | None = None  # its rows of exact.parquet
    output: OutputTimes | None = None
    conflicts: pd.DataFrame | None = None
    link: LinkTimes | None = None
    own: Mapping[str, OwnSums] = field(default_factory=dict)


@dataclass(frozen=True)
class Metric:
    """One column of `summary.csv`.

    `statistics`: sums; None: the experiment does not ask for this metric, which then has no column. Metrics that share
    them share the function, which is called once. `value`: made of the sums; None: there is nothing to make it of.
    `better`: 1 more, −1 less, 0 neither. `part`: the table that shows it on the terminal and in the report; empty:
    none. `compared`: what its difference to a baseline is; empty: it is not compared.
    """

    name: str
    statistics: Callable[[Given], Any]
    value: Callable[[Any], Value]
    better: Literal[-1, 0, 1]
    help: str
    part: str = ""
    compared: str = ""


def values(metrics: Iterable[Metric], given: Given) -> dict[str, Value]:
    """The columns of one configuration."""
    made: dict[Hashable, Any] = {}
    row: dict[str, Value] = {}
    for metric in metrics:
        if metric.statistics not in made:
            made[metric.statistics] = metric.statistics(given)
        if made[metric.statistics] is not None:
            row[metric.name] = metric.value(made[metric.statistics])
    return row


OWN = "own"
"""The part of metrics that an experiment names."""


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
        """The value made of the sums; None or NaN: there is nothing to make it of. Without rows it is not asked."""


def own_metrics(components: Sequence[RowMetric]) -> tuple[Metric, ...]:
    """The columns of own metrics."""
    return tuple(_column(k, component) for k, component in enumerate(components))


def _column(k: int, own: RowMetric) -> Metric:
    def value(sums: OwnSums) -> float | None:
        found = asked(own, _where(k), lambda: _number(own.value(sums))) if sums else None
        return None if found is None or np.isnan(found) else found

    return Metric(own.name, lambda given: given.own.get(own.name, {}), value, own.better, own.help, OWN)


def _where(k: int) -> str:
    return f"measure.metrics[{k}]"


def _number(value: Any) -> float | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise GivenError("value", f"expected a number or None, found {type(value).__name__}")
    return float(value)


def own_sums(components: Sequence[RowMetric], rows: pd.DataFrame) -> dict[str, OwnSums]:
    """By the names of own metrics their sums over rows of `detections.parquet`, of one configuration in one log."""
    if not len(rows):
        return {}
    rows = rows.reset_index(drop=True)
    return {own.name: asked(own, _where(k), partial(_sums, own, rows)) for k, own in enumerate(components)}


def _sums(own: RowMetric, rows: pd.DataFrame) -> OwnSums:
    sums: OwnSums = {}
    for name, of_rows in own.statistics(rows).items():
        column = np.asarray(of_rows, dtype=float)
        if column.shape != (len(rows),):
            raise GivenError("statistics", f"{name}: expected shape ({len(rows)},), found {column.shape}")
        sums[name] = float(column.sum())
    return sums

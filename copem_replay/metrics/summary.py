"""Summary: one row per configuration, over all logs, runs and measured objects.

Its columns are metrics: metrics/summary_metrics.py, and the own ones of the experiment.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from copem_replay.metrics.accuracy.metrics import beyond_gate_share
from copem_replay.metrics.accuracy.statistics import Total
from copem_replay.metrics.fixed import Fixed
from copem_replay.metrics.intervals import FEWEST_CLUSTERS, clusters
from copem_replay.metrics.link_times import LinkTimes
from copem_replay.metrics.metric import Given, OwnSums, RowMetric, own_metrics, own_sums, values
from copem_replay.metrics.output_times import OutputTimes
from copem_replay.metrics.summary_metrics import METRICS
from copem_replay.metrics.tally import CONFLICT, DETECTED, tally

MUCH_BEYOND = 0.01
"""From this share of errors beyond the gate on it is said (chosen)."""


def horizon_s(table: pd.DataFrame, given_s: float | None) -> float | None:
    """The horizon of restricted means: as given, or the longest episode at any measured object."""
    if given_s is not None:
        return given_s
    return float((table["ended_s"] - table["onset_s"]).max()) if len(table) else None


Sums = Mapping[str, Mapping[str, OwnSums]]
"""Of own metrics, by configuration and name."""


def summary(
    rows: pd.DataFrame, configurations: Sequence[str], list_rate_hz: Mapping[str, float | None], **given: Any
) -> tuple[pd.DataFrame, list[str]]:
    """The rows of `summary.csv` of rows of `detections.parquet`, otherwise as `summary_of`."""
    own, asked = own_sums_of(rows, given.get("own", ())), "conflict_detected" in rows
    return summary_of(tally(rows), configurations, list_rate_hz, sums=own, conflicts_asked=asked, **given)


def own_sums_of(rows: pd.DataFrame, own: Sequence[RowMetric]) -> dict[str, dict[str, OwnSums]]:
    """Of rows of `detections.parquet`, log by log."""
    sums: dict[str, dict[str, OwnSums]] = {}
    for (_, name), part in rows.groupby(["log", "configuration"], sort=False) if own else ():
        sums = added(sums, {str(name): own_sums(own, part)})
    return sums


def added(sums: Sums, more: Sums) -> dict[str, dict[str, OwnSums]]:
    """Sums of own metrics over some logs, and those of one more."""
    result = {configuration: dict(of) for configuration, of in sums.items()}
    for configuration, of in more.items():
        mine = result.setdefault(configuration, {})
        for metric, one in of.items():
            before = mine.get(metric, {})
            mine[metric] = before | {name: before.get(name, 0.0) + value for name, value in one.items()}
    return result


def summary_of(
    tallied: pd.DataFrame,
    configurations: Sequence[str],
    list_rate_hz: Mapping[str, float | None],
    *,
    seed: int,
    horizon_s: float | None,
    exact: pd.DataFrame | None = None,
    accuracy: Mapping[str, Total] | None = None,
    fixed: Fixed | None = None,
    own: Sequence[RowMetric] = (),
    sums: Sums | None = None,
    outputs: Mapping[str, OutputTimes] | None = None,
    conflicts_asked: bool = False,
    links: Mapping[str, LinkTimes] | None = None,
) -> tuple[pd.DataFrame, list[str]]:
    """The rows of `summary.csv`, and what has to be said about them, of the rows of `tally.parquet`.

    `exact`: the rows of `exact.parquet`. `accuracy`: by configuration the sums its figures are made of.
    `fixed`: what is the same in every run; None: nothing. `own`: the experiment's own metrics, whose columns come last,
    and `sums`, what they are made of. `outputs`: how old the recorded outputs are, by configuration; `links`: what
    becomes of lists, of those with a link. `conflicts_asked`: whether it is measured when lists imply a collision.
    """
    notes: list[str] = []
    fixed = fixed or Fixed()
    known, implied = (tallied[tallied["event"] == event] for event in (DETECTED, CONFLICT))
    judged = known[known["in_conflict"]] if "in_conflict" in known else known.iloc[:0]
    for what, rows_of, those in (("detected", known, "measured objects"), ("pass", judged, "objects in conflict")):
        if len(rows_of) and clusters(rows_of)[0] is None:
            notes.append(
                f"no interval of the {what} share: fewer than {FEWEST_CLUSTERS} logs and fewer than {FEWEST_CLUSTERS} "
                f"{those}, and more runs say nothing about other traffic"
            )
    parts, conflicts = _by_configuration(known), _by_configuration(implied)
    exactly = _by_configuration(exact) if exact is not None else {}
    notes += _beyond_the_gate(accuracy or {})
    notes += _not_annotated(accuracy or {})
    columns = (*METRICS, *own_metrics(own))
    rows = []
    for name in configurations:
        given = Given(
            parts.get(name, known.iloc[:0]),
            list_rate_hz[name],
            seed,
            horizon_s,
            lists_fixed=fixed.known(name),
            reaction_fixed=fixed.passes(name),
            accuracy=accuracy[name] if accuracy else None,
            exact=exactly.get(name, exact.iloc[:0]) if exact is not None else None,
            output=(outputs or {}).get(name),
            conflicts=conflicts.get(name, implied.iloc[:0]) if conflicts_asked else None,
            own=(sums or {}).get(name, {}),
            link=(links or {}).get(name),
        )
        rows.append({"configuration": name, **values(columns, given)})
    return pd.DataFrame(rows), notes


def _beyond_the_gate(accuracy: Mapping[str, Total]) -> list[str]:
    """Which configurations claim covariances so large that the gate cuts off some errors."""
    shares = {name: beyond_gate_share(of) or 0.0 for name, of in accuracy.items()}
    cut = {name: share for name, share in shares.items() if share >= MUCH_BEYOND}
    if not cut:
        return []
    gate_m = accuracy[next(iter(cut))].settings.gate_m
    said = ", ".join(f"{name} {100 * share:.2g} %" for name, share in cut.items())
    return [
        f"position errors expected beyond the gate of {gate_m:g} m, by the claimed covariances: {said}; RMSE and NEES "
        "are without them, so true covariances have a NEES of nees_expected, not 2 (a larger `measure: {match: "
        "{gate_m: …}}` keeps them)"
    ]


def _not_annotated(accuracy: Mapping[str, Total]) -> list[str]:
    """How many entries are no ghosts because the truth is not annotated there."""
    counts = {name: int(of.runs["unannotated"]) for name, of in accuracy.items()}
    if not any(counts.values()):
        return []
    said = ", ".join(f"{name} {count}" for name, count in counts.items())
    return [f"entries at no object where the truth is not annotated, no ghosts, in all lists of all runs: {said}"]


def _by_configuration(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    return {str(name): part for name, part in table.groupby("configuration", sort=False)}

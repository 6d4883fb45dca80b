"""Accuracy in the results folder: columns of rows, figures of configurations, and tables.

| table | rows |
|---|---|
| `accuracy` | as `detections`: by list of the object's stay its position error, and its part of GOSPAᵖ; its ghosts |
| `instants` | log × configuration, and run where runs differ in them: when each fused list was available |
| `lists` | log × configuration × run: lists, ghosts, stale ones, and how many of the others from which existence on |
| `thresholds` | log × configuration × run × object × step: when it is detected if more existence is asked for |
| `bands` | configuration × distance, time (by log) or existence: from, to, and the figures in between |
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from copem_replay.core.tracks import Float
from copem_replay.metrics.accuracy.statistics import Accuracy, Total, joined
from copem_replay.metrics.columns import beneath

if TYPE_CHECKING:
    from copem_replay.pipeline.blocks import Outcome
    from copem_replay.pipeline.log_tables import LogTables
    from copem_replay.pipeline.scoring import Scores


def with_accuracy(*outcomes: Outcome) -> dict[str, Any]:
    """The columns of `detections` with the figures of each row, block after block."""
    parts = [_row_columns(one) for outcome in outcomes for _, _, one in accuracies(outcome)]
    columns = beneath([outcome.columns for outcome in outcomes])
    return columns | (beneath(parts) if parts else {})


def _row_columns(accuracy: Accuracy) -> dict[str, Any]:
    """(S · M,) each."""
    sums = accuracy.by_object.ravel()

    def mean(name: str, of: str = "pairs") -> Float:
        return np.where(sums[of] > 0, sums[name] / np.maximum(sums[of], 1), np.nan)

    return {
        "matched_lists": sums["pairs"],
        "unplaced_lists": sums["pairs"] - sums["placed"],
        "position_rmse_m": np.sqrt(mean("square_m2", "placed")),
        "position_rmse_captured_m": np.sqrt(mean("square_then_m2")),
        "bias_east_m": mean("east_m", "placed"),
        "bias_north_m": mean("north_m", "placed"),
        "velocity_rmse_mps": np.sqrt(mean("velocity_square_m2ps2", "placed")),
        "nees": mean("nees"),
        "age_of_information_s": mean("age_of_information_s"),
        "identity_switches": np.where(sums["tracked"] > 0, sums["switches"], np.nan),
        "duplicates": sums["duplicates"],
        "longest_gap_s": sums["longest_gap_s"],
    }


def accuracies(outcome: Outcome) -> Iterable[tuple[str, Scores, Accuracy]]:
    """Of each configuration whose accuracy is measured."""
    for name, scores in outcome.all_scores.items():
        if scores.accuracy is not None:
            yield name, scores, scores.accuracy


def by_log(logs: Iterable[LogTables]) -> dict[tuple[str, str], Total]:
    """Sums over the runs of each log and configuration."""
    return {(log.log, name): joined(nodes) for log in logs for name, nodes in log.totals.items()}


def totals(of_logs: Mapping[tuple[str, str], Total]) -> dict[str, Total]:
    """By configuration the sums over all runs and logs; nothing where there is no accuracy."""
    result: dict[str, Total] = {}
    for (_, name), one in of_logs.items():
        # Of time there are bands in each log, which do not add up over several.
        one = replace(one, settings=replace(one.settings, time_edges_s=()), by_time=one.by_time[:0])
        result[name] = result[name] + one if name in result else one
    return result


@dataclass(frozen=True)
class AccuracyTables:
    """The tables, in the order of `detections`. `instants` has a row per run where runs differ in them."""

    accuracy: pa.Table
    instants: pa.Table
    lists: pa.Table
    thresholds: pa.Table


def accuracy_tables(logs: Sequence[LogTables], rows: pd.DataFrame, *, same_instants: bool) -> AccuracyTables:
    """All tables of several logs; `rows`: those of `detections`."""
    keys = pa.Table.from_pandas(rows[["log", "configuration", "run", "object_id"]], preserve_index=False)
    beside = pa.concat_tables([log.beside for log in logs if log.beside is not None])
    runs = pa.concat_tables([log.runs for log in logs if log.runs is not None])
    per_list = keys
    for name in ("first_list", "error_m", "gospa_m2", "ghosts"):
        per_list = per_list.append_column(name, beside[name])
    lengths = pc.list_value_length(beside["existence"]).to_numpy()
    thresholds = keys.take(pa.array(np.repeat(np.arange(len(lengths)), lengths)))
    thresholds = thresholds.append_column("existence", pc.list_flatten(beside["existence"]))
    thresholds = thresholds.append_column("detection_s", pc.list_flatten(beside["steps_s"]))
    lists = runs.drop_columns("available_s")
    return AccuracyTables(per_list, _instants(runs, same_instants), lists, thresholds)


def _instants(runs: pa.Table, same: bool) -> pa.Table:
    """Of each configuration, and of each run where runs have units or outages, and so instants, of their own."""
    columns = runs.select(["log", "configuration", "run", "available_s"])
    if same:
        return columns.filter(pc.equal(columns["run"], 0)).drop_columns("run")
    said = np.flatnonzero(columns["available_s"].is_valid())
    rows = said[np.searchsorted(said, np.arange(len(columns)), side="right") - 1]  # as in the row before
    return columns.set_column(3, "available_s", columns["available_s"].take(pa.array(rows)))


def bands(of_logs: Mapping[tuple[str, str], Total]) -> pd.DataFrame:
    """How good the lists were by distance, over time and by existence."""
    rows: list[dict[str, Any]] = []
    for name, of in totals(of_logs).items():
        rows += _band_rows(name, "distance_m", of.settings.distance_edges_m, of.by_distance, None)
        edges = np.linspace(0.0, 1.0, len(of.by_existence) + 1)
        for k, sums in enumerate(of.by_existence):
            if sums["entries"]:
                rows.append(
                    {
                        "log": "all", "configuration": name, "by": "existence", "from": edges[k], "to": edges[k + 1],
                        "entries": int(sums["entries"]), "existence": sums["existence"] / sums["entries"],
                        "with_object_share": sums["with_object"] / sums["entries"],
                    }
                )  # fmt: skip
    for (log, name), of in of_logs.items():
        rows += _band_rows(name, "time_s", of.settings.time_edges_s, of.by_time, log)
    columns = ["log", "configuration", "by", "from", "to", "looked", "missed_share", "ghosts", "pairs",
               "position_rmse_m", "bias_east_m", "bias_north_m", "nees", "nees_expected", "entries", "existence",
               "with_object_share"]  # fmt: skip
    return pd.DataFrame(rows, columns=columns)


def _band_rows(name: str, by: str, edges: Sequence[float], sums: Any, log: str | None) -> list[dict[str, Any]]:
    rows = []
    for k, one in enumerate(sums):
        if not (one["looked"] or one["pairs"] or one["ghosts"]):
            continue
        pairs = int(one["pairs"])
        row = {
            "log": log or "all", "configuration": name, "by": by, "from": edges[k], "to": edges[k + 1],
            "looked": int(one["looked"]), "ghosts": int(one["ghosts"]), "pairs": pairs,
            "missed_share": one["missed"] / one["looked"] if one["looked"] else np.nan,
        }  # fmt: skip
        if placed := int(one["placed"]):
            row["position_rmse_m"] = np.sqrt(one["square_m2"] / placed)
            row |= {"bias_east_m": one["east_m"] / placed, "bias_north_m": one["north_m"] / placed}
        if pairs:
            row |= {"nees": one["nees"] / pairs, "nees_expected": one["nees_expected"] / pairs}
        rows.append(row)
    return rows

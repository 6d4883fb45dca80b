"""What the results folder says of how good the lists were: columns of rows, figures of configurations, and tables.

| table | rows |
|---|---|
| `accuracy` | as `detections`: by list of the object's stay its position error, and its part of GOSPAᵖ; its ghosts |
| `instants` | log × configuration, and run where runs differ in them: when each fused list was available |
| `lists` | log × configuration × run: lists, ghosts, stale ones, and how many of the others from which existence on |
| `thresholds` | log × configuration × run × object × step: when it is detected if more existence is asked for |
| `bands` | configuration × distance, time (by log) or existence: from, to, and the figures in between |
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from copem_replay.core.tracks import Float, Int
from copem_replay.metrics.accuracy.statistics import Accuracy, Total, total
from copem_replay.pipeline.blocks import Outcome
from copem_replay.pipeline.scoring import Scores


def with_accuracy(outcome: Outcome) -> pd.DataFrame:
    """The rows of `detections` with the figures of each."""
    parts = [_row_columns(one) for _, _, one in _accuracies(outcome)]
    if not parts:
        return outcome.table
    more = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return outcome.table.assign(**more)


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


def totals(outcomes: Iterable[Outcome]) -> dict[str, Total]:
    """By configuration the sums over all runs and logs; nothing where there is no accuracy."""
    result: dict[str, Total] = {}
    for (_, name), one in _by_log(outcomes).items():
        # Of time there are bands in each log, which do not add up over several.
        one = replace(one, settings=replace(one.settings, time_edges_s=()), by_time=one.by_time[:0])
        result[name] = result[name] + one if name in result else one
    return result


def _by_log(outcomes: Iterable[Outcome]) -> dict[tuple[str, str], Total]:
    """Sums over the runs of each log and configuration; how runs were cut into blocks makes no difference."""
    parts: dict[tuple[str, str], list[tuple[int, Accuracy]]] = {}
    for outcome in outcomes:
        for name, _, one in _accuracies(outcome):
            mine = parts.setdefault((outcome.log, name), [])
            mine += (
                [(int(run), one.of_run(s)) for s, run in enumerate(outcome.runs)]
                if _scattered(outcome)
                else [(int(outcome.runs[0]), one)]
            )
    return {key: total([one for _, one in sorted(mine, key=lambda part: part[0])]) for key, mine in parts.items()}


def _scattered(outcome: Outcome) -> bool:
    """Whether other outcomes have runs between these: where runs differ in their units."""
    return bool((np.diff(outcome.runs) != 1).any())


@dataclass(frozen=True)
class AccuracyTables:
    """The tables, in the order of `detections`. `instants` has a row per run where runs differ in them."""

    accuracy: pa.Table
    instants: pa.Table
    lists: pa.Table
    thresholds: pa.Table
    bands: pd.DataFrame


def accuracy_tables(outcomes: Sequence[Outcome], order: Int, *, same_instants: bool) -> AccuracyTables:
    """All tables of runs of several logs, `order (n,)` being that of the rows of all outcomes in `detections`."""
    per_list = _per_list(outcomes).take(pa.array(order))
    instants = _instants(outcomes) if same_instants else _instants_by_run(outcomes)
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    return AccuracyTables(per_list, instants, _lists(outcomes), _thresholds(outcomes, place), bands(outcomes))


def _accuracies(outcome: Outcome) -> Iterable[tuple[str, Scores, Accuracy]]:
    for name, scores in outcome.all_scores.items():
        if scores.accuracy is not None:
            yield name, scores, scores.accuracy


def _per_list(outcomes: Sequence[Outcome]) -> pa.Table:
    first: list[Int] = []
    lengths: list[Int] = [np.zeros(1, dtype=np.int64)]
    error: list[Any] = []
    gospa: list[Any] = []
    ghosts: list[Int] = []
    for outcome in outcomes:
        runs = len(outcome.runs)
        for _, _, one in _accuracies(outcome):
            first.append(np.tile(one.first_list, runs))
            lengths.append(np.tile(one.count, runs))
            error.append(one.error_m.ravel())
            gospa.append(one.gospa.ravel())
            ghosts.append(one.by_object["ghosts"].ravel())
    offsets = pa.array(np.cumsum(np.concatenate(lengths)), pa.int64())

    def nested(parts: list[Any]) -> pa.Array:
        # To about a millimetre: what is finer is noise, and takes twice the space.
        values = np.round(np.concatenate([np.empty(0, dtype=np.float32), *parts]) * np.float32(1024)) / np.float32(1024)
        return pa.LargeListArray.from_arrays(offsets, pa.array(values, mask=np.isnan(values)))

    rows = pd.concat([outcome.table[["log", "configuration", "run", "object_id"]] for outcome in outcomes])
    keys = pa.Table.from_pandas(rows, preserve_index=False)
    none = np.empty(0, dtype=np.int64)
    return (
        keys.append_column("first_list", pa.array(np.concatenate([none, *first])))
        .append_column("error_m", nested(error))
        .append_column("gospa_m2", nested(gospa))
        .append_column("ghosts", pa.array(np.concatenate([none, *ghosts])))
    )


def _instants(outcomes: Sequence[Outcome]) -> pa.Table:
    rows: dict[tuple[str, str], Float] = {}
    for outcome in outcomes:
        for name, scores, _ in _accuracies(outcome):
            rows.setdefault((outcome.log, name), scores.issue_s)
    return pa.table(
        {
            "log": pa.array([log for log, _ in rows], pa.string()),
            "configuration": pa.array([name for _, name in rows], pa.string()),
            "available_s": pa.array([list(times) for times in rows.values()], pa.list_(pa.float64())),
        }
    )


def _instants_by_run(outcomes: Sequence[Outcome]) -> pa.Table:
    """The same with a row for every run, which has its own units or outages, and so its own instants."""
    rows = [
        (outcome.log, name, run, scores.issue_s)
        for outcome in outcomes
        for name, scores, _ in _accuracies(outcome)
        for run in outcome.runs.tolist()
    ]
    places = {key: k for k, key in enumerate(dict.fromkeys(row[:2] for row in rows))}
    rows.sort(key=lambda row: (places[row[:2]], row[2]))
    return pa.table(
        {
            "log": pa.array([row[0] for row in rows], pa.string()),
            "configuration": pa.array([row[1] for row in rows], pa.string()),
            "run": pa.array([row[2] for row in rows], pa.int64()),
            "available_s": pa.array([row[3] for row in rows], pa.list_(pa.float64())),
        }
    )


def _lists(outcomes: Sequence[Outcome]) -> pa.Table:
    rows: list[dict[str, Any]] = []
    for outcome in outcomes:
        for name, _, one in _accuracies(outcome):
            for s, run in enumerate(outcome.runs.tolist()):
                sums = one.by_run[s]
                rows.append(
                    {
                        "log": outcome.log,
                        "configuration": name,
                        "run": run,
                        "lists": int(sums["lists"]),
                        "minutes": float(sums["time_s"]) / 60,
                        "ghosts": int(sums["ghosts"]),
                        "stale_ghosts": int(sums["stale_ghosts"]),
                        "duplicates": int(sums["duplicates"]),
                        "existence": list(one.settings.existence_thresholds),
                        "ghosts_at": one.ghosts_at[s].tolist(),
                    }
                )
    places = {key: k for k, key in enumerate(dict.fromkeys((row["log"], row["configuration"]) for row in rows))}
    rows.sort(key=lambda row: (places[row["log"], row["configuration"]], row["run"]))
    schema = pa.schema(
        [
            ("log", pa.string()), ("configuration", pa.string()), ("run", pa.int64()), ("lists", pa.int64()),
            ("minutes", pa.float64()), ("ghosts", pa.int64()), ("stale_ghosts", pa.int64()), ("duplicates", pa.int64()),
            ("existence", pa.list_(pa.float64())), ("ghosts_at", pa.list_(pa.int64())),
        ]
    )  # fmt: skip
    return pa.Table.from_pylist(rows, schema)


def _thresholds(outcomes: Sequence[Outcome], place: Int) -> pa.Table:
    """Steps of all rows, in the order of `detections`."""
    row: list[Int] = [np.empty(0, dtype=np.int64)]
    existence: list[Float] = [np.empty(0)]
    detection_s: list[Float] = [np.empty(0)]
    before = 0
    for outcome in outcomes:
        runs = len(outcome.runs)
        for name, scores in outcome.all_scores.items():
            steps, episodes = scores.steps, scores.detections.detection_s.shape[1]
            times = 1 if scores.detections.detection_s.shape[0] == runs else runs
            for copy in range(times):  # one run stands for all
                row.append(before + (steps.run_ix + copy) * episodes + steps.episode_ix)
                existence.append(steps.existence)
                detection_s.append(steps.detection_s)
            before += runs * episodes
            assert (outcome.table["configuration"] == name).sum() == runs * episodes
    rows = place[np.concatenate(row)]
    order = np.argsort(rows, kind="stable")
    keys = pd.concat([outcome.table[["log", "configuration", "run", "object_id"]] for outcome in outcomes])
    back = np.empty(len(place), dtype=np.int64)
    back[place] = np.arange(len(place))
    table = pa.Table.from_pandas(keys, preserve_index=False).take(pa.array(back[rows[order]]))
    table = table.append_column("existence", pa.array(np.concatenate(existence)[order]))
    return table.append_column("detection_s", pa.array(np.concatenate(detection_s)[order]))


def bands(outcomes: Sequence[Outcome]) -> pd.DataFrame:
    """How good the lists were by distance, over time and by existence."""
    rows: list[dict[str, Any]] = []
    for name, of in totals(outcomes).items():
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
    for (log, name), of in _by_log(outcomes).items():
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

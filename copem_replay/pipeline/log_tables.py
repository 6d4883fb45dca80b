"""What one log gives in some runs and configurations: tables in the order of configuration, run and object.

`beside` has the rows of `rows`: `first_list`, `error_m`, `gospa_m2` and `ghosts` of `accuracy.parquet`, and of
`thresholds.parquet` the steps of a row, `existence` and `steps_s`. `runs` has a row per configuration and run: the
columns of `lists.parquet`, and `available_s` of `instants.parquet`, null: as in the row before.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pyarrow as pa

from copem_replay.core.tracks import Float, Int
from copem_replay.metrics.accuracy.statistics import Accuracy, Total, total
from copem_replay.metrics.columns import frame
from copem_replay.metrics.way import WAY
from copem_replay.pipeline.accuracy_tables import accuracies, with_accuracy

if TYPE_CHECKING:
    from copem_replay.pipeline.blocks import Outcome
    from copem_replay.pipeline.scoring import Scores

RUNS = pa.schema(
    [
        ("log", pa.string()), ("configuration", pa.string()), ("run", pa.int64()), ("lists", pa.int64()),
        ("minutes", pa.float64()), ("ghosts", pa.int64()), ("stale_ghosts", pa.int64()), ("duplicates", pa.int64()),
        ("existence", pa.list_(pa.float64())), ("ghosts_at", pa.list_(pa.int64())),
        ("available_s", pa.list_(pa.float64())),
    ]
)  # fmt: skip

BESIDE = pa.schema(
    [
        ("first_list", pa.int64()), ("error_m", pa.large_list(pa.float32())), ("gospa_m2", pa.large_list(pa.float32())),
        ("ghosts", pa.int64()), ("existence", pa.large_list(pa.float64())), ("steps_s", pa.large_list(pa.float64())),
    ]
)  # fmt: skip


@dataclass(frozen=True)
class LogTables:
    """The tables of one log; those of accuracy are None where it is not asked for.

    `totals`: by configuration sums of accuracy over so many neighbouring runs.
    """

    log: str
    rows: pd.DataFrame | pa.Table
    beside: pa.Table | None = None
    runs: pa.Table | None = None
    totals: dict[str, list[tuple[int, Total]]] = field(default_factory=dict)

    def of(self, configuration: str, *, way: bool) -> LogTables:
        """Those of one configuration. `way`: whether it has the columns `WAY`, whatever others have."""
        assert isinstance(self.rows, pd.DataFrame)
        mine = (self.rows["configuration"] == configuration).to_numpy()
        begin, count = int(mine.argmax()) if len(mine) else 0, int(mine.sum())
        rows, beside, runs = self.rows.iloc[begin : begin + count], self.beside, self.runs
        return LogTables(
            self.log,
            rows if way else rows.drop(columns=list(WAY), errors="ignore"),
            None if beside is None else beside.slice(begin, count),
            None if runs is None else runs.filter(np.array(runs["configuration"].to_pylist()) == configuration),
            {name: nodes for name, nodes in self.totals.items() if name == configuration},
        )


def log_tables(log: str, outcomes: Sequence[Outcome], names: Sequence[str], *, accuracy: bool) -> LogTables:
    """The tables of blocks of runs of one log, which may be scattered over them, in configurations of these `names`."""
    columns = with_accuracy(*outcomes)
    counts = [len(one.columns["run"]) // max(len(names), 1) for one in outcomes]  # of each configuration
    number = np.concatenate([np.repeat(np.arange(len(names)), count) for count in counts])
    order = np.lexsort((columns["run"], number))
    totals = {}
    for name in names:
        if mine := list(_runs_of(outcomes, name)):
            mine.sort(key=lambda part: part[0])
            totals[name] = [(sum(len(one.by_run) for _, one in mine), total([one for _, one in mine]))]
    ordered = frame({name: values[order] for name, values in columns.items()})
    if not accuracy or not names:
        return LogTables(log, ordered, totals=totals)
    return LogTables(log, ordered, _beside(outcomes).take(pa.array(order)), _runs(outcomes, names), totals)


def joined(log: str, parts: Sequence[LogTables]) -> LogTables:
    """The tables of several configurations and ranges of runs of one log, which are in their order."""
    totals: dict[str, list[tuple[int, Total]]] = {}
    for part in parts:
        for name, nodes in part.totals.items():
            totals.setdefault(name, []).extend(nodes)
    rows = pa.concat_tables([part.rows for part in parts], promote_options="permissive")
    beside, runs = ([t for part in parts if (t := getattr(part, name)) is not None] for name in ("beside", "runs"))
    return LogTables(
        log, rows, pa.concat_tables(beside) if beside else None, pa.concat_tables(runs) if runs else None, totals
    )


def _runs_of(outcomes: Iterable[Outcome], name: str) -> Iterator[tuple[int, Accuracy]]:
    """Statistics of one configuration by their first run; run by run where other outcomes have runs between these."""
    for outcome in outcomes:
        scores = outcome.all_scores.get(name)
        if scores is None or scores.accuracy is None:
            continue
        if (np.diff(outcome.runs) == 1).all():
            yield int(outcome.runs[0]), scores.accuracy
        else:
            yield from ((int(run), scores.accuracy.of_run(s)) for s, run in enumerate(outcome.runs))


def _beside(outcomes: Sequence[Outcome]) -> pa.Table:
    """In the order of the outcomes' rows."""
    first: list[Int] = []
    lengths: list[Int] = [np.zeros(1, dtype=np.int64)]
    values: dict[str, list[Any]] = {name: [] for name in ("error_m", "gospa_m2", "existence", "steps_s")}
    steps: list[Int] = [np.zeros(1, dtype=np.int64)]
    ghosts: list[Int] = []
    for outcome in outcomes:
        runs = len(outcome.runs)
        for _, scores, one in accuracies(outcome):
            first.append(np.tile(one.first_list, runs))
            lengths.append(np.tile(one.count, runs))
            values["error_m"].append(one.error_m.ravel())
            values["gospa_m2"].append(one.gospa.ravel())
            ghosts.append(one.by_object["ghosts"].ravel())
            count, existence, steps_s = _steps(scores, runs)
            steps.append(count)
            values["existence"].append(existence)
            values["steps_s"].append(steps_s)
    none = np.empty(0, dtype=np.int64)

    def nested(counts: list[Int], name: str, kind: type) -> pa.Array:
        flat = np.concatenate([np.empty(0, dtype=kind), *values[name]])
        if kind is np.float32:  # to about a millimetre: what is finer is noise, and takes twice the space
            flat = np.round(flat * np.float32(1024)) / np.float32(1024)
        offsets = pa.array(np.cumsum(np.concatenate(counts)), pa.int64())
        return pa.LargeListArray.from_arrays(offsets, pa.array(flat, mask=np.isnan(flat)))

    return pa.table(
        {
            "first_list": pa.array(np.concatenate([none, *first])),
            "error_m": nested(lengths, "error_m", np.float32),
            "gospa_m2": nested(lengths, "gospa_m2", np.float32),
            "ghosts": pa.array(np.concatenate([none, *ghosts])),
            "existence": nested(steps, "existence", np.float64),
            "steps_s": nested(steps, "steps_s", np.float64),
        }
    )


def _steps(scores: Scores, runs: int) -> tuple[Int, Float, Float]:
    """How many steps each row has, and their existences and times; one run may stand for all."""
    steps, shape = scores.steps, scores.detections.detection_s.shape
    row = steps.run_ix * shape[1] + steps.episode_ix
    order = np.argsort(row, kind="stable")
    count, times = np.bincount(row, minlength=shape[0] * shape[1]), 1 if shape[0] == runs else runs
    return np.tile(count, times), np.tile(steps.existence[order], times), np.tile(steps.detection_s[order], times)


def _runs(outcomes: Sequence[Outcome], names: Sequence[str]) -> pa.Table:
    rows: list[dict[str, Any]] = []
    for outcome in outcomes:
        for name, scores, one in accuracies(outcome):
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
                        "available_s": scores.issue_s,
                    }
                )
    place = {name: k for k, name in enumerate(names)}
    rows.sort(key=lambda row: (place[row["configuration"]], row["run"]))
    before: dict[str, Any] = {}
    for row in rows:  # those of the run before are written once
        same = before.get(row["configuration"])
        before[row["configuration"]] = row["available_s"]
        if same is not None and (same is row["available_s"] or np.array_equal(same, row["available_s"])):
            row["available_s"] = None
    return pa.Table.from_pylist(rows, RUNS)

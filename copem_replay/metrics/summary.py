"""The summary: one row per configuration, over all logs, runs and measured objects; its tally, and its plain text.

Its columns are metrics: metrics/summary_metrics.py, and the own ones of the experiment. They are computed from the
tally, which counts in how many runs each object is detected at each instant, or never: whole numbers, so that counts of
any runs in any order add up to the same. `compare` reads the tally too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from copem_replay.core.errors import count_noun, wrap_line
from copem_replay.core.tracks import SAME_INSTANT_S, Int
from copem_replay.metrics.accuracy.metrics import beyond_gate_share
from copem_replay.metrics.accuracy.statistics import AccuracyTotal
from copem_replay.metrics.braking.driving import RATE, SHARE
from copem_replay.metrics.limits import (
    DRIVES,
    NOT_ENOUGH,
    NOTHING_DRAWN,
    OBJECTS,
    choose_over,
    count_clusters,
    describe_absent,
    describe_clusters,
    explain_no_clusters,
    format_limit,
    format_limits,
    interval_words,
    limit_rate,
)
from copem_replay.metrics.metric import (
    LinkTimes,
    MetricInputs,
    OutputTimes,
    OwnSums,
    RowMetric,
    evaluate_metrics,
    own_metrics,
    own_sums,
)
from copem_replay.metrics.onset import BEGAN, has_frame_after
from copem_replay.metrics.summary_metrics import METRIC, METRICS, summarise_detections

DETECTED = "detected"
"""The event of the first list that confirms the object."""
CONFLICT = "conflict"
"""The event of the first list that implies a collision."""

_EVENT_COLUMNS = {
    DETECTED: {
        "detection_s": "detection_s",
        "time_to_detection_s": "time_to_detection_s",
        "distance_at_detection_m": "distance_at_detection_m",
        "gap_at_detection_m": "gap_at_detection_m",
    },
    CONFLICT: {
        "detection_s": "conflict_detection_s",
        "time_to_detection_s": "time_to_conflict_detection_s",
        "distance_at_detection_m": "distance_at_conflict_detection_m",
    },
}
"""By event the columns of the tally, and their names in `detections.parquet`; null in the row for never."""
_OBJECT_COLUMNS = (
    "object_id", "object_class", "episode", "onset_s", "distance_at_onset_m", "began", "area", "ended_s",
    "ended_by",
)  # fmt: skip


EPISODE = ("log", "object_id", "episode")
"""Columns that name an episode."""


def tally_rows(rows: pd.DataFrame) -> pd.DataFrame:
    """The tally of rows of `detections.parquet`, in their order of logs, configurations and objects.

    Rows of one object that is detected at one instant differ in nothing but the run: one of them stands for `runs`.
    """
    parts = [_tally_event(rows, event) for event in _EVENT_COLUMNS if event == DETECTED or "conflict_detected" in rows]
    tallied = pd.concat(parts, ignore_index=True)
    order = np.lexsort([pd.factorize(tallied[name])[0] for name in ("configuration", "log")])  # stable: events stay
    return tallied.iloc[order].reset_index(drop=True)


def list_runs(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows of `detections.parquet` with the columns of the tally, each for its own `run`, event after event."""
    parts = []
    for event, of_event in _EVENT_COLUMNS.items():
        if event != DETECTED and "conflict_detected" not in rows:
            continue
        columns = {name: rows[source] for name, source in of_event.items() if source in rows}
        kept = {name: rows[name] for name in ("log", "configuration", "run", *_OBJECT_COLUMNS) if name in rows}
        parts.append(pd.DataFrame(kept | columns).assign(event=event, runs=1))
        if "conflict" in rows:
            passed = rows["braking_pass"].fillna(False).astype(int)
            parts[-1] = parts[-1].assign(in_conflict=rows["conflict"].astype(bool), passed=passed)
    return pd.concat(parts, ignore_index=True)


def _tally_event(rows: pd.DataFrame, event: str) -> pd.DataFrame:
    """The tally of `event`: rows (n,) of episodes with equal times counted as one, with the number of `runs`."""
    columns = {name: source for name, source in _EVENT_COLUMNS[event].items() if source in rows}
    time_s = rows[columns["time_to_detection_s"]].to_numpy(dtype=float)
    has_event = rows["detected" if event == DETECTED else "conflict_detected"].to_numpy(dtype=bool)
    time_s = np.where(has_event, time_s + 0.0, np.inf)  # −0 is 0, and never comes last
    episode = np.zeros(len(rows), dtype=np.int64)
    for name in ("configuration", *EPISODE):
        episode = _number_pairs(episode, rows[name])[0]
    group, number, instant_s = _number_pairs(episode, time_s)
    first_of = np.empty(len(number), dtype=np.int64)
    first_of[group[::-1]] = np.arange(len(rows))[::-1]
    order = np.lexsort((instant_s, number))
    first_of, runs = first_of[order], np.bincount(group, minlength=len(order))[order]
    tallied = {
        **{name: rows[name].take(first_of).to_numpy() for name in ("log", "configuration")},
        "event": np.full(len(order), event, dtype=object),
        **{name: rows[name].take(first_of).to_numpy() for name in _OBJECT_COLUMNS if name in rows},
        **{name: rows[source].take(first_of).to_numpy() for name, source in columns.items()},
        "runs": runs,
    }
    if "conflict" in rows:
        passes = rows["braking_pass"].fillna(False).to_numpy(dtype=bool)
        tallied["in_conflict"] = rows["conflict"].to_numpy(dtype=bool)[first_of]
        tallied["passed"] = np.bincount(group, passes, minlength=len(order)).astype(np.int64)[order]
    return pd.DataFrame(tallied)


def _number_pairs(number: Int, values: Any) -> tuple[Int, Int, Any]:
    """The number of each row's pair of number and value (n,), as pairs appear, and the pairs' numbers and values.

    By hash, which does not sort.
    """
    value_ix, distinct = pd.factorize(values)
    pair, pairs = pd.factorize(number * max(len(distinct), 1) + value_ix)
    return pair, pairs // max(len(distinct), 1), distinct[pairs % max(len(distinct), 1)]


MUCH_BEYOND = 0.01
"""From this share of errors beyond the gate on there is a note: the NEES of a true, round covariance is then 1.91, not
2.
"""


FEWEST_FOLLOWED = 5
"""As many episodes last at least as long as the horizon; of more than fifty a tenth, of fewer than five half."""


def settle_horizon(counted: pd.DataFrame, asked_s: float) -> tuple[float, list[str]]:
    """The horizon of restricted means in seconds, and a note where it is shorter than `asked_s`.

    `counted`: rows that count, of all logs. It is the longest that enough episodes last, `asked_s` at most: a mean up
    to where hardly anybody is followed would hang on a few long episodes.
    """
    number, needed, followed, shorter_s = _count_followed(counted, asked_s)
    if followed >= needed:
        return asked_s, []
    words, shorter = _format_followed(number, followed, asked_s), format_cell(shorter_s)
    return shorter_s, [f"horizon_s: {words}; so times count up to {shorter} s, which {needed} of them last"]


def describe_followed(counted: pd.DataFrame, horizon_s: float) -> str | None:
    """One line where too few counted episodes last as long as the horizon; None: enough for a restricted mean."""
    number, needed, followed, _ = _count_followed(counted, horizon_s)
    return None if followed >= needed else _format_followed(number, followed, horizon_s)


def _format_followed(number: int, followed: int, asked_s: float) -> str:
    share = 100 * followed / number
    return f"{followed} of {count_noun(number, 'episode')} that count ({share:.3g} %) last {format_cell(asked_s)} s"


def _count_followed(counted: pd.DataFrame, asked_s: float) -> tuple[int, int, int, float]:
    """How many episodes count, are needed for a restricted mean, last `asked_s`; how long enough of them last."""
    episodes = counted.drop_duplicates([*EPISODE])
    length_s = np.sort(np.round((episodes["ended_s"] - episodes["onset_s"]).to_numpy(dtype=float), 9))[::-1]
    number = len(length_s)
    needed = -(-number // 2) if number < FEWEST_FOLLOWED else max(FEWEST_FOLLOWED, -(-number // 10))
    followed = int((length_s >= asked_s - SAME_INSTANT_S).sum())
    return number, needed, followed, float(length_s[needed - 1]) if number else 0.0


Sums = Mapping[str, Mapping[str, OwnSums]]
"""Sums of own metrics, by configuration and by name."""


def summarise_rows(
    rows: pd.DataFrame, configurations: Sequence[str], list_rate_hz: Mapping[str, float | None], **extra: Any
) -> tuple[pd.DataFrame, list[str]]:
    """The rows of `summary.csv`, and notes, from rows of `detections.parquet`. `extra`: as for `summarise_tally`."""
    sums, implied = own_sums_by_log(rows, extra.get("own", ())), "conflict_detected" in rows
    return summarise_tally(tally_rows(rows), configurations, list_rate_hz, sums=sums, conflicts_asked=implied, **extra)


def own_sums_by_log(rows: pd.DataFrame, metrics: Sequence[RowMetric]) -> dict[str, dict[str, OwnSums]]:
    """Sums of own metrics by configuration and name, over rows of `detections.parquet`, added log by log."""
    sums: dict[str, dict[str, OwnSums]] = {}
    for (_, name), part in rows.groupby(["log", "configuration"], sort=False) if metrics else ():
        sums = add_own_sums(sums, {str(name): own_sums(metrics, part)})
    return sums


def add_own_sums(sums: Sums, more: Sums) -> dict[str, dict[str, OwnSums]]:
    """Sums of own metrics, by configuration and name, of `sums` and `more` together."""
    result = {configuration: dict(metrics) for configuration, metrics in sums.items()}
    for configuration, metrics in more.items():
        totals = result.setdefault(configuration, {})
        for metric, added in metrics.items():
            before = totals.get(metric, {})
            totals[metric] = before | {name: before.get(name, 0.0) + value for name, value in added.items()}
    return result


_EACH_DRIVE_ONCE = (
    "weigh: drives: in shares, times and distances of detections each drive counts once, however many objects it has; "
    "accuracy and rates are over pairs, lists and minutes"
)


def summarise_tally(
    tallied: pd.DataFrame,
    configurations: Sequence[str],
    list_rate_hz: Mapping[str, float | None],
    *,
    horizon_s: float | None,
    exact: pd.DataFrame | None = None,
    accuracy: Mapping[str, AccuracyTotal] | None = None,
    facts: Mapping[str, Any] | None = None,
    own: Sequence[RowMetric] = (),
    sums: Sums | None = None,
    outputs: Mapping[str, OutputTimes] | None = None,
    conflicts_asked: bool = False,
    links: Mapping[str, LinkTimes] | None = None,
    weigh: str = OBJECTS,
    driving: pd.DataFrame | None = None,
) -> tuple[pd.DataFrame, list[str]]:
    """The rows of `summary.csv`, and notes about them, from the rows of `tally.parquet`.

    `exact`: the rows of `exact.parquet`. `accuracy`: its sums, by configuration. `facts`: what configurations are
    (`find_facts`); None: nothing is known. `own`: the experiment's own metrics, whose columns come last; `sums`: their
    sums. `outputs`: ages of recorded outputs, by configuration;
    `links`: sums over lists on links, by configuration. `conflicts_asked`: whether the experiment measures when lists
    imply a collision. `weigh`: as `measure.weigh`. `driving`: columns of `lists.parquet` about needless braking.
    """
    detections, implying = (tallied[tallied["event"] == event] for event in (DETECTED, CONFLICT))
    detections_of, conflicts_of = _split_by_configuration(detections), _split_by_configuration(implying)
    exact_of = _split_by_configuration(exact) if exact is not None else {}
    notes = [_EACH_DRIVE_ONCE] * (weigh == DRIVES and detections["log"].nunique() > 1)
    notes += [*_note_no_interval(detections), *_note_beyond_gate(accuracy or {}), *_note_unannotated(accuracy or {})]
    columns, driving_of = (*METRICS, *own_metrics(own)), {} if driving is None else _split_by_configuration(driving)
    rows = []
    for name in configurations:
        inputs = MetricInputs(
            detections_of.get(name, detections.iloc[:0]),
            list_rate_hz[name],
            horizon_s,
            facts=(facts or {}).get(name),
            accuracy=accuracy[name] if accuracy else None,
            exact=exact_of.get(name, exact.iloc[:0]) if exact is not None else None,
            output=(outputs or {}).get(name),
            conflicts=conflicts_of.get(name, implying.iloc[:0]) if conflicts_asked else None,
            own=(sums or {}).get(name, {}),
            link=(links or {}).get(name),
            weigh=weigh,
            driving=driving_of.get(name),
        )
        rows.append({"configuration": name, **evaluate_metrics(columns, inputs)})
    return pd.DataFrame(rows), notes


def describe_began(tallied: pd.DataFrame, configuration: str, horizon_s: float | None, words: Sequence[str]) -> str:
    """One line: how many episodes began in each way, and the mean time of each group in one configuration.

    `tallied`: the whole tally. `words`: `measure.began`, those that count.
    """
    rows = tallied[(tallied["event"] == DETECTED) & (tallied["configuration"] == configuration)]
    groups, followed = [], has_frame_after(rows)
    for word in reversed(BEGAN):
        part = rows[(rows["began"] == word) & followed]
        mean_s = summarise_detections(MetricInputs(part, None, horizon_s)).mean_s()
        number = part.groupby([*EPISODE]).ngroups
        groups.append(f"{number} {word}" + ("" if mean_s is None else f" {format_cell(mean_s)} s"))
    line = f"objects by how they began, and their ttd_rmst_s in {configuration}: {', '.join(groups)}"
    line += f"; counted: {', '.join(words)}"
    if short := rows[~followed].groupby([*EPISODE]).ngroups:
        line += f"; left out, with no frame after the onset: {short}"
    if (rows["began"] == "appeared").any():
        line += "; on annotated drives `appeared` may be where annotation began"
    return line


def _note_no_interval(detections: pd.DataFrame) -> list[str]:
    """Which shares have no interval, from the rows of the tally for detections."""
    conflicts = detections[detections["in_conflict"]] if "in_conflict" in detections else detections.iloc[:0]
    notes = []
    for share, rows in (("detected", detections), ("pass", conflicts)):
        if (counts := count_clusters(rows))[0] and choose_over(*counts) is None:
            notes.append(f"no interval of the {share} share: {explain_no_clusters(*counts)}; {NOT_ENOUGH}")
    return notes


def _note_beyond_gate(accuracy: Mapping[str, AccuracyTotal]) -> list[str]:
    """A note on configurations whose covariances are so large that the gate cuts errors off; empty: there are none."""
    shares = {name: beyond_gate_share(of) or 0.0 for name, of in accuracy.items()}
    cut_shares = {name: share for name, share in shares.items() if share >= MUCH_BEYOND}
    if not cut_shares:
        return []
    gate_m = accuracy[next(iter(cut_shares))].settings.gate_m
    words = ", ".join(f"{name} {100 * share:.2g} %" for name, share in cut_shares.items())
    return [
        f"position errors expected beyond the gate of {gate_m:g} m, by the claimed covariances: {words}; RMSE and NEES "
        "are without them, so true covariances have a NEES of nees_expected, not 2 (a larger `measure: {match: "
        "{gate_m: …}}` keeps them)"
    ]


def _note_unannotated(accuracy: Mapping[str, AccuracyTotal]) -> list[str]:
    """How many entries are no ghosts because the truth is not annotated there."""
    counts = {name: int(of.runs["unannotated"]) for name, of in accuracy.items()}
    if not any(counts.values()):
        return []
    words = ", ".join(f"{name} {count}" for name, count in counts.items())
    return [f"entries at no object where the truth is not annotated, no ghosts, in all lists of all runs: {words}"]


def _split_by_configuration(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    return {str(name): part for name, part in table.groupby("configuration", sort=False)}


# Tables as plain text, nothing cut off: whole in a pipe, in blocks that fit the width of a terminal.

_GAP = "  "
SETUP = ("n", "list_rate_hz", "n_conflict", "driving_h", "must_brake_s")
"""Columns of the set-up, not of results: written once, below the table, where all configurations are alike."""


def describe_mean(horizon_s: float, *, censored: bool) -> str:
    """The words for a restricted mean. `censored`: whether rows are still undetected when the ego or the log ends."""
    up_to = f"{format_cell(horizon_s)} s"
    words = f"mean of min(time until known, {up_to}), never known counting as {up_to}"
    if not censored:
        return words
    return f"{words}; an object still unknown when the log or the ego ends counts as those that are followed longer"


def has_undetected(summary: pd.DataFrame) -> bool:
    """Whether any row of any configuration was never detected."""
    return bool((summary[["left_undetected_share", "open_share"]] > 0).any(axis=None))


def format_summary(summary: pd.DataFrame, width: int | None = None) -> str:
    """The summary for a terminal: detections, then conflicts, braking, recorded outputs and own metrics.

    `width`: of the terminal, in characters; None: lines of any length.
    """
    lines = _part_lines(summary, "summary", width, "detected_share")
    lines += describe_intervals(summary, "interval")
    horizon = summary["ttd_rmst_horizon_s"].dropna()
    if len(horizon):
        lines.append(
            f"ttd_rmst_s: {describe_mean(float(horizon.iloc[0]), censored=bool((summary['open_share'] > 0).any()))}"
        )
    if has_undetected(summary):
        lines += ["", *_part_lines(summary, "undetected", width)]
        lines.append(
            "left_undetected_share: the object left; open_share: still undetected when the log or the ego ended"
        )
    if "conflict_detected_share" in summary:
        lines += ["", *_part_lines(summary, "conflict", width)]
        lines.append("conflict_*: the same for the first list that implies a collision")
    if "pass_share" in summary and summary["n_conflict"].any():
        lines += ["", *_part_lines(summary, "braking", width, "pass_share")]
        lines += describe_intervals(summary, "pass_interval")
        lines.append("pass_share: share of conflicts that the configured driver avoids when braking after detection")
    if SHARE in summary:
        none = describe_no_needless(summary)
        lines += ["", *(_needless_lines(summary, width) if none is None else [none])]
    if "output_latency_s" in summary:
        lines += ["", *_part_lines(summary[summary["output_delay_s"].notna()], "output", width)]
        lines.append("output_latency_s: available − the stamp of the state; output_delay_s: that stamp − the state")
    own = [name for name in summary if name not in ("configuration", *METRIC)]
    if own:
        lines += ["", format_table(summary[["configuration", *own]], width)]
    return "\n".join(part for line in lines for part in (wrap_line(line, width) if "\n" not in line else [line]))


def describe_no_needless(summary: pd.DataFrame) -> str | None:
    """The upper limit of needless braking where nobody does it, or that it is unknown; None: somebody does."""
    driving_h = float(summary["driving_h"].max())
    if not driving_h > 0:
        return "braking for nothing: not known, for the ego does not drive"
    if summary[RATE].any():
        return None
    below = limit_rate(np.zeros(1), np.full(1, driving_h))[1]
    return (
        f"braking for nothing: none in {3600 * driving_h:.3g} s of driving, which only rules out more than "
        f"{format_limit(below)} an hour"
    )


def _needless_lines(summary: pd.DataFrame, width: int | None) -> list[str]:
    """The table of braking for nothing, and what it means."""
    lines = _part_lines(summary, "needless", width, RATE)
    over = summary["needless_interval_over"].dropna().unique()
    lines += [f"95 %: Poisson limits over {describe_clusters(str(one), driving=True)}" for one in over]
    return [*lines, "needless_*: the driver would have to brake for an entry of a list, and the truth gives no reason"]


def _part_lines(summary: pd.DataFrame, part: str, width: int | None, share: str = "") -> list[str]:
    """The columns of a part, the limits of its share beside it; below them the set-up that all have alike."""
    names = ["configuration", *(metric.name for metric in METRICS if metric.part == part and metric.name in summary)]
    shared = {name: format_cell(summary[name].iloc[0]) for name in names if name in SETUP and _is_alike(summary[name])}
    names = [name for name in names if name not in shared]
    if share:
        summary = summary.assign(**{"95 %": _interval_lines(summary, share)})
        names.insert(names.index(share) + 1, "95 %")
    below = [f"all configurations: {', '.join(f'{name} {value}' for name, value in shared.items())}"] if shared else []
    return [format_table(summary[names], width), *below]


def _is_alike(column: pd.Series) -> bool:
    return len(column) > 1 and len({format_cell(value) for value in column}) == 1


def _interval_lines(summary: pd.DataFrame, share: str) -> list[str]:
    limits = zip(summary[f"{share}_low"], summary[f"{share}_high"], strict=True)
    return [format_limits(low, high) if pd.notna(low) else "–" for low, high in limits]


def describe_intervals(summary: pd.DataFrame, name: str) -> list[str]:
    """Lines on the limits: their kind (column `name`), what they are over, what they miss; on rows without limits."""
    columns = [name, f"{name}_over", f"{name}_clusters"]
    limited = summary.reindex(columns=columns).dropna(subset=columns[1]).drop_duplicates()
    kinds = [
        interval_words(kind, over, None if pd.isna(number) else int(number))
        for kind, over, number in limited.itertuples(index=False)
    ]
    lines = [f"95 %: {'; '.join(kinds)}"] if kinds else []
    logs = limited.loc[limited[columns[1]] == "logs", columns[2]].dropna()
    lines += [f"whatever the interval, {describe_absent(int(logs.min()))}"] if len(logs) else []
    undrawn = summary.loc[summary[name] == NOTHING_DRAWN, "configuration"]
    if len(undrawn):
        lines.append(f"no 95 % of {', '.join(undrawn)}: nothing drawn, every run is the same")
    return lines


def format_table(table: pd.DataFrame, width: int | None = None) -> str:
    """A table with aligned columns; numbers to four significant digits, nulls as a dash.

    Where it is wider than `width`, it comes in blocks: each has the first column, and as many others as fit.
    """
    cells = [[format_cell(value) for value in row] for row in table.itertuples(index=False)]
    columns: list[tuple[str, ...]] = list(zip(list(map(str, table.columns)), *cells, strict=True))
    first, *others = (
        _align_column(column, to_left=k == 0 or not pd.api.types.is_numeric_dtype(table[table.columns[k]]))
        for k, column in enumerate(columns)
    )
    if not others:
        return "\n".join(first)
    return "\n\n".join("\n".join(_block_lines(first, block, width)) for block in _split_columns(first, others, width))


def _align_column(column: Sequence[str], *, to_left: bool) -> list[str]:
    widest = max(map(len, column))
    return [text.ljust(widest) if to_left else text.rjust(widest) for text in column]


def _split_columns(first: Sequence[str], others: Sequence[list[str]], width: int | None) -> list[list[list[str]]]:
    """The other columns in groups that fit beside the first one within `width` (None: any); none is empty."""
    blocks: list[list[list[str]]] = []
    width_used = 0
    for column in others:
        size = len(_GAP) + len(column[0])
        if not blocks or (width is not None and width_used + size > width and blocks[-1]):
            blocks.append([])
            width_used = len(first[0])
        blocks[-1].append(column)
        width_used += size
    return blocks


def _block_lines(first: Sequence[str], others: Sequence[list[str]], width: int | None) -> list[str]:
    """The lines of a block; where even one column is too wide, the values below the names of their rows."""
    rows = [_GAP.join(row).rstrip() for row in zip(first, *others, strict=True)]
    if width is None or max(map(len, rows)) <= width:
        return rows
    return [line for row in zip(first, *others, strict=True) for line in (row[0].rstrip(), *_indent_values(row[1:]))]


def _indent_values(values: Sequence[str]) -> list[str]:
    return [f"  {value.strip()}" for value in values if value.strip()]


def format_cell(value: object) -> str:
    """A number to four significant digits, a null as a dash, anything else as it is."""
    if value is None or value is pd.NA or value != value:
        return "–"
    if not isinstance(value, float):
        return str(value)
    return "0" if abs(value) < 1e-12 else f"{value:.4g}"

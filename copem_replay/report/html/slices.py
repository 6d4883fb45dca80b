"""Tables of slices: the figures of each group, and of each drive its objects, the latest first."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from copem_replay.metrics.limits import count_clusters
from copem_replay.metrics.slices import describe_chance
from copem_replay.report.figures.slices import MOST_GROUPS
from copem_replay.report.figures.style import format_per_cent, format_two_decimals
from copem_replay.report.html.markup import (
    Html,
    allow_breaks,
    fold_parts,
    join_html,
    line_swatch,
    make_list,
    make_table,
    make_tag,
)
from copem_replay.report.html.tables import column_header, format_value, full_number, interval_markup
from copem_replay.results.screen import describe_counted
from copem_replay.results.slices import SHOWN, describe_groups

if TYPE_CHECKING:
    from copem_replay.report.html.study import ReportData


_OPEN = 24
"""Most rows of a table that is not folded."""


def group_tables(study: ReportData) -> Html:
    """A table for each entry, and the objects of each drive where groups are drives."""
    sliced = study.sliced
    assert sliced is not None
    parts: list[Html] = []
    for by, rows in sliced.groupby("by", sort=False):
        table = _group_table(study, str(by), rows)
        parts.append(table if len(rows) <= _OPEN else fold_parts(f"By {by}: {len(rows)} rows", table))
        lines = [*describe_chance(rows), *describe_groups(rows)]
        parts.append(fold_parts("What intervals are over, and where there are none", make_list(lines)))
        if by == "log":
            parts += [make_tag("h3", "Objects of each drive"), *_drives(study)]
    return join_html(parts)


def _group_table(study: ReportData, by: str, rows: pd.DataFrame) -> Html:
    names = [name for name in SHOWN if name in rows and rows[name].notna().any()]
    lines = []
    for row in rows.to_dict("records"):
        name = str(row["configuration"])
        cell = make_tag("span", line_swatch(study.looks[name]), make_tag("span", allow_breaks(name)), class_="named")
        cells = [make_tag("td", cell, class_="text"), make_tag("td", str(row["objects"]))]
        cells += [_figure_cell(row, name) for name in names]
        lines.append(make_tag("tr", make_tag("th", allow_breaks(str(row["group"])), scope="row"), *cells))
    head = [by, "configuration", "objects", *map(column_header, names)]
    return make_table(head, lines, caption=f"By {by}")


def _figure_cell(row: dict[str, Any], name: str) -> Html:
    value = float("nan") if pd.isna(row[name]) else float(row[name])
    low, high = (row.get(f"{name}_{end}") for end in ("low", "high"))
    parts = [Html(format_value(name, value))]
    if pd.notna(low) and pd.notna(high):
        parts.append(interval_markup(*(100.0 * limit for limit in (low or 0.0, high or 0.0))))
    if name == "detected_share" and row["apart"] is not None and row["apart"] == True:  # noqa: E712
        parts.append(Html(" *"))
    return make_tag("td", *parts, data_column=name, data_value=full_number(row[name]))


# The objects of each drive.


def _drives(study: ReportData) -> Iterator[Html]:
    """A table per drive, in their order: its objects that count, those that are known the latest first."""
    known, names = study.results.known, study.names
    logs = [log.name for log in study.results.provenance.logs]
    for k, log in enumerate(logs[:MOST_GROUPS]):
        rows = known[known["log"] == log]
        table = _object_table(rows, list(names)) if len(rows) else make_tag("p", "No object counts.")
        number = describe_counted(*count_clusters(rows)[1:])
        yield make_tag("details", make_tag("summary", f"{log}: {number}"), table, id_=f"slices-drive-{k}")
    if len(logs) > MOST_GROUPS:
        yield make_tag("p", f"{len(logs) - MOST_GROUPS} further drives are left out.", class_="below")


def _object_table(rows: pd.DataFrame, names: list[str]) -> Html:
    """A row per object: its class, its range at the onset, and by configuration when it is known, in which share."""
    runs = rows["runs"].to_numpy(dtype=float)
    time_s = rows["time_to_detection_s"].to_numpy(dtype=float)
    known = ~np.isnan(time_s)
    sums = pd.DataFrame({"runs": runs, "known": runs * known, "time_s": np.where(known, runs * time_s, 0.0)})
    of_episode = [rows[name].to_numpy() for name in ("object_id", "episode", "configuration")]
    sums = sums.groupby(of_episode, sort=False).sum()
    share = sums["known"] / sums["runs"]
    mean_s = sums["time_s"] / sums["known"].where(sums["known"] > 0)
    latest = pd.DataFrame({"share": share, "mean_s": mean_s}).groupby(level=[0, 1], sort=False).mean()
    order = latest.sort_values(["share", "mean_s"], ascending=[True, False], kind="stable").index
    known_by_row = {key: (float(share[key]), float(mean_s[key])) for key in share.index}
    episodes = rows.drop_duplicates(["object_id", "episode"]).set_index(["object_id", "episode"])
    lines = []
    for key in order:
        episode = episodes.loc[key]
        head = make_tag("th", f"{key[0]}{f' ({key[1] + 1})' if key[1] else ''}", scope="row")
        cells = [make_tag("td", str(episode["object_class"]), class_="text")]
        cells += [
            make_tag("td", format_two_decimals(float(episode[name]))) for name in ("onset_s", "distance_at_onset_m")
        ]
        cells += [make_tag("td", _when_known(known_by_row.get((*key, name)))) for name in names]
        lines.append(make_tag("tr", head, *cells))
    return make_table(["object", "class", "counts from, s", "range then, m", *names], lines)


def _when_known(known: tuple[float, float] | None) -> str:
    """`0.4 s`; where it is not known in every run, `0.4 s in 75 %`. `known`: share of the runs, and mean seconds."""
    if known is None:
        return "–"
    share, mean_s = known
    if not share:
        return "never"
    return f"{format_two_decimals(mean_s)} s" + ("" if share == 1 else f" in {format_per_cent(share)} %")

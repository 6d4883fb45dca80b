"""Why objects are late: the tables that `copem-replay why FOLDER` leaves in results, and a sentence per object."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Final

import pandas as pd

from copem_replay.core.errors import count_noun
from copem_replay.extras.why.causes import CAUSES, describe_cause
from copem_replay.extras.why.sensitivity import compare_orders, describe_orders, tabulate_variations
from copem_replay.extras.why.triage import TOO_SHORT, describe_structure
from copem_replay.report.figures.style import format_per_cent, format_two_decimals
from copem_replay.report.html.markup import (
    Html,
    allow_breaks,
    fold_parts,
    link_story,
    make_list,
    make_table,
    make_tag,
)

if TYPE_CHECKING:
    from copem_replay.report.html.study import ReportData
    from copem_replay.results.read import Results

FOLDER: Final = "why"
"""Of a results folder, with the tables of `copem-replay why`."""
_FILES: Final = ("why.csv", "units.csv", "triage.csv", "late_episodes.csv", "sensitivity.csv")
_AGAIN: Final = "run `copem-replay why` on the folder again"
_MOST_GROUPS: Final = 10


def read_why(results: Results) -> dict[str, pd.DataFrame]:
    """The tables by the names of their files; none without a folder. Raises InputError where one is damaged."""
    tables = {}
    for name in _FILES:
        if results.folder is None or not (path := results.folder / FOLDER / name).is_file():
            continue
        results.check_made(f"{FOLDER}/{name}", _AGAIN)
        table = pd.read_csv(path, dtype={"object_id": str, "example": str, "log": str}, keep_default_na=False)
        numbers = [column for column in table if column.endswith(("_s", "_share"))]
        tables[name] = table.assign(**{column: pd.to_numeric(table[column]) for column in numbers})
    return tables


def write_section(study: ReportData) -> tuple[str, list[Html]] | None:
    """Title and tables of what `copem-replay why` left in the folder; None: nothing."""
    tables = read_why(study.results)
    return ("Why it is late", [*why_parts(tables)]) if tables else None


def why_parts(tables: Mapping[str, pd.DataFrame]) -> Iterator[Html]:
    """Seconds by cause, what units spare, and groups of late episodes, configuration by configuration."""
    if "why.csv" in tables:
        yield make_tag(
            "p",
            "Seconds that objects are unknown, in the mean, by cause. Causes are put back one by one in the order in "
            "which they act, so that what they add sums to the whole, to the end of each episode; the mean time at "
            "the top counts up to a limit.",
        )
        yield _cause_table(tables["why.csv"], "added_s", "Seconds that each cause adds")
        gained = _cause_table(tables["why.csv"], "gained_s", "Seconds gained if only this cause were gone: no sum")
        yield fold_parts("What would be gained if only one were gone", gained)
    if "units.csv" in tables:
        yield make_tag("h3", "What each unit spares")
        yield from _by_configuration(tables["units.csv"], _unit_table)
    if "triage.csv" in tables:
        yield make_tag("h3", "Late objects with one story")
        if not len(tables["triage.csv"]):
            yield make_tag("p", "No object is unknown for more than 1 s in one run of twenty or more.")
        yield from _by_configuration(tables["triage.csv"], _group_list)
    if "sensitivity.csv" in tables:
        yield make_tag("h3", "How much hangs on the perception error models")
        varied = tables["sensitivity.csv"]
        yield _variation_table(tabulate_variations(varied))
        yield make_list(describe_orders(varied, compare_orders(varied)))


def _by_configuration(table: pd.DataFrame, write: Callable[[str, pd.DataFrame], Html]) -> Iterator[Html]:
    """The part of each configuration; from the third on they are folded."""
    for k, (name, of) in enumerate(table.groupby("configuration", sort=False)):
        part = write(str(name), of)
        yield part if k < 2 else fold_parts(str(name), part)


def _cause_table(causes: pd.DataFrame, value: str, caption: str) -> Html:
    """A table of `value` (s): rows are causes, columns configurations; of `added_s` with their sum."""
    names = list(dict.fromkeys(causes["configuration"]))
    order = sorted(dict.fromkeys(causes["cause"]), key=_place_of_cause)
    seconds = causes.set_index(["configuration", "cause"])[value].astype(float).to_dict()
    rows = []
    for cause in order:
        cells = [make_tag("td", _two_decimals(seconds.get((name, cause), math.nan))) for name in names]
        rows.append(make_tag("tr", make_tag("th", describe_cause(str(cause)), scope="row"), *cells))
    if value == "added_s":
        sums = causes.groupby("configuration")[value].sum()
        cells = [make_tag("td", _two_decimals(float(sums[name]))) for name in names]
        rows.append(make_tag("tr", make_tag("th", "all", scope="row"), *cells))
    return make_table(["cause", *names], rows, caption=caption)


def _place_of_cause(name: str) -> int:
    return next((k for k, cause in enumerate(CAUSES) if cause.name == name), -1)


def _two_decimals(seconds: float) -> str:
    return "" if math.isnan(seconds) else format_two_decimals(seconds)


def _unit_table(name: str, units: pd.DataFrame) -> Html:
    rows = []
    for row in units.to_dict("records"):
        cells = [make_tag("td", format_two_decimals(float(row[key]))) for key in ("share_s", "alone_s", "left_out_s")]
        rows.append(make_tag("tr", make_tag("th", allow_breaks(str(row["unit"])), scope="row"), *cells))
    return make_table(["unit", "its share (Shapley), s", "alone, s", "if left out, s"], rows, caption=name)


def _variation_table(means: pd.DataFrame) -> Html:
    rows = []
    for row in means.itertuples(index=False):
        name, *seconds = row
        cells = [make_tag("td", format_two_decimals(float(value))) for value in seconds]
        rows.append(make_tag("tr", make_tag("th", allow_breaks(str(name)), scope="row"), *cells))
    return make_table(list(map(str, means.columns)), rows, caption="Seconds that objects are unknown, in the mean")


def _group_list(name: str, groups: pd.DataFrame) -> Html:
    """A list of the groups of late episodes of one configuration that cost most, with links to stories."""
    lost_s = float(groups["lost_s"].sum())
    lines = []
    for row in groups.head(_MOST_GROUPS).to_dict("records"):
        where = f" ({row['where']})" if row["where"] else ""
        objects, share = count_noun(int(row["objects"]), "object"), format_per_cent(float(row["lost_s"]) / lost_s)
        words = (
            f"{row['log']}: {objects}, {float(row['lost_s']):.1f} s ({share} %), {describe_cause(str(row['cause']))}"
        )
        words += where + describe_structure(float(row["structural_share"]))
        story = link_story(str(row["log"]), str(row["example"]), f"{row['example_class']} {row['example']}")
        view = make_tag("code", f"copem-replay view FOLDER --object {row['example']} --log {row['log']}")
        such = ["such as ", story, " ", view] if row["example"] else [TOO_SHORT]
        lines.append(make_tag("span", f"{words}; ", *such))
    rest = len(groups) - _MOST_GROUPS
    more = [f"and {count_noun(rest, 'group')} more in {FOLDER}/triage.csv"] if rest > 0 else []
    head = make_tag("p", f"{name}: late for more than 1 s, {lost_s:.1f} s in all")
    return make_tag("div", head, make_list([*lines, *more]))


def why_late(tables: Mapping[str, pd.DataFrame], log: str, object_id: str, onset_s: float) -> dict[str, str]:
    """By configuration why an object is late, in words, the mean over runs; empty where it is not."""
    if "late_episodes.csv" not in tables:
        return {}
    rows = tables["late_episodes.csv"]
    rows = rows[(rows["log"] == log) & (rows["object_id"] == object_id) & ((rows["onset_s"] - onset_s).abs() < 1e-6)]
    return {str(row["configuration"]): str(row["words"]) for row in rows.to_dict("records")}

"""Which objects were never detected, by name; and how probable that is, where it is known without a draw."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import pandas as pd

from copem_replay.core.text import counted
from copem_replay.metrics.end_reason import EndReason
from copem_replay.metrics.summary_text import cell
from copem_replay.report.html.markup import Html, joined, listed, table, tag

if TYPE_CHECKING:
    from copem_replay.report.html.study import Study

_OPEN = 40
"""Rows up to which the table is shown at once (chosen)."""


def never_detected(study: Study) -> Html:
    """A row for each object and each set of configurations that missed it in as many runs, the most missed first."""
    known = study.results.known
    missed = misses(known)
    if not len(missed):
        return tag("p", "None: every measured object was detected in every run, by every configuration.")
    rows = [_row(study, found, list(names)) for found, names in _together(missed, study.names)]
    things = missed.groupby(["log", "object_id"]).ngroups
    every = known.groupby(["log", "object_id"]).ngroups
    said = (
        f"{counted(things, 'object')} of the {every} measured, missed in some run by some configuration; the most "
        "missed first. A row names all configurations that miss the object in as many runs."
    )
    head = ["log", "object", "class", "never in", "by", "looked at for (s)", "until"]
    whole = table(head, rows, caption="Objects never detected", id_="never")
    if len(rows) > _OPEN:
        whole = tag("details", tag("summary", f"All {len(rows)} rows"), whole)
    return joined([tag("p", said), whole])


def without_a_draw(study: Study) -> Html:
    """How probably an object is never detected, what that hangs on, and how probably the ego fails; a line each."""
    rows = study.results.summary
    if "miss_log10" not in rows:
        return Html()
    above = "What the PEM implies if its lists err independently of each other, which small numbers hang on most."
    lines = listed(_exactly(row) for row in rows.to_dict("records"))
    return joined([tag("h3", "Without a draw"), tag("p", above), lines])


def _exactly(row: dict[str, Any]) -> Html:
    missed, half, fails = (
        float(row.get(name, math.nan)) for name in ("miss_log10", "miss_log10_half_odds", "fail_share_exact")
    )
    said: list[str] = [tag("b", str(row["configuration"])), ": "]
    if math.isnan(missed):
        said.append("the detection of every measured object is certain")
    elif missed == 0:
        said.append("no list ever holds a measured object")
    else:
        said += [
            "a measured object is never detected with probability ", powers(missed),
            "; were the odds of every detection half of what the PEM says, that would be ", powers(half),
        ]  # fmt: skip
    if not math.isnan(fails):
        said += [". The ego fails with probability ", powers(math.log10(fails)) if fails > 0 else "0"]
    return joined([*said, "."])


def powers(log10: float) -> Html:
    """`0.0123`, `4.2·10⁻²²`: a number by its decadic logarithm, however small or large."""
    if -3 <= log10 < 4:
        return Html(cell(math.pow(10, log10)))
    mantissa, _, exponent = f"{math.pow(10, log10 - math.floor(log10)):.1e}".partition("e")
    power = tag("sup", f"{math.floor(log10) + int(exponent)}".replace("-", "−"))
    return joined(["10" if mantissa == "1.0" else f"{mantissa}·10", power])


def misses(known: pd.DataFrame) -> pd.DataFrame:
    """By log, object and configuration in how many runs it was never detected (`missed`), of how many (`runs`)."""
    keys = ["log", "object_id", "configuration"]
    missed = known["runs"].where(known["time_to_detection_s"].isna(), 0)
    grouped = known.assign(missed=missed).groupby(keys, sort=False)
    found = grouped.agg(
        missed=("missed", "sum"),
        runs=("runs", "sum"),
        object_class=("object_class", "first"),
        onset_s=("onset_s", "first"),
        ended_s=("ended_s", "first"),
        ended_by=("ended_by", "first"),
    ).reset_index()
    return found[found["missed"] > 0]


def _together(missed: pd.DataFrame, order: Sequence[str]) -> list[tuple[pd.Series, tuple[str, ...]]]:
    by_key: dict[tuple[str, str, int, int], tuple[pd.Series, list[str]]] = {}
    for _, found in missed.iterrows():
        key = (str(found["log"]), str(found["object_id"]), int(found["missed"]), int(found["runs"]))
        by_key.setdefault(key, (found, []))[1].append(str(found["configuration"]))
    ranked = sorted(by_key, key=lambda key: (-key[2] / key[3], -len(by_key[key][1]), key))
    return [(by_key[key][0], tuple(name for name in order if name in by_key[key][1])) for key in ranked]


def _row(study: Study, found: pd.Series, names: list[str]) -> Html:
    every = len(names) == len(study.names) > 1
    by = f"all {len(names)} configurations" if every else ", ".join(names)
    return tag(
        "tr",
        tag("th", str(found["log"]), scope="row"),
        tag("td", str(found["object_id"]), class_="text"),
        tag("td", str(found["object_class"]), class_="text"),
        tag("td", f"{counted(int(found['runs']), 'run') if found['missed'] == found['runs'] else found['missed']}"
            + (" (all)" if found["missed"] == found["runs"] else f" of {counted(int(found['runs']), 'run')}"),
            data_value=str(found["missed"])),
        tag("td", by, class_="text long"),
        tag("td", cell(float(found["ended_s"] - found["onset_s"]))),
        tag("td", EndReason(found["ended_by"]).past, class_="text"),
    )  # fmt: skip

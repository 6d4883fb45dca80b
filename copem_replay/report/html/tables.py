"""Tables: summary, differences, missed objects and stages of the latency, with the meaning of their columns.

Cells have two decimals, shares three significant digits; `data-value` holds the number of `summary.csv`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import pandas as pd

from copem_replay.core.errors import count_noun
from copem_replay.metrics.braking.driving import JUDGED_DRIVING
from copem_replay.metrics.limits import NOT_ENOUGH
from copem_replay.metrics.metric import own_metrics
from copem_replay.metrics.summary import SETUP, describe_intervals, format_cell, has_undetected
from copem_replay.metrics.summary_metrics import COMPARED, METRIC, METRICS, PARTS
from copem_replay.metrics.survival import EndReason
from copem_replay.report.figures.latency_breakdown import STAGES, count_detected, mean_stages_by_configuration
from copem_replay.report.figures.style import (
    format_aligned_per_cent,
    format_signed_decimals,
    format_three_digits,
    format_two_decimals,
    write_limits,
)
from copem_replay.report.html.markup import (
    Html,
    allow_breaks,
    fold_parts,
    join_html,
    line_swatch,
    link_player,
    link_story,
    make_list,
    make_table,
    make_tag,
)
from copem_replay.results.compare.limits import ALONE, STAR
from copem_replay.results.compare.tables import comparison_lines, explain_no_interval, held_cells, use_headers
from copem_replay.results.verdicts import MET, NOT_MEASURED, NOT_MET, UNDECIDED, Judgement, Verdict

if TYPE_CHECKING:
    from copem_replay.report.html.study import ReportData
    from copem_replay.results.compare import Comparison


# Headers of columns and formats of their values: two decimals, counts whole, shares in per cent.

_HEADERS = {name: metric.header for name, metric in (METRIC | COMPARED).items() if metric.header}
_UNITS = {
    "_per_min": " per minute", "_share": ", %", "_mps2": ", m/s²", "_mps": ", m/s", "_deg": ", °", "_hz": ", Hz",
    "_m": ", m", "_s": ", s",
}  # fmt: skip
"""Units by ends of names, for columns without a header of their own."""
FIRST = ("ttd_rmst_s", "ttd_median_s", "ttd_p95_s", "detected_share")
"""First columns of a table, which a narrow screen shows without scrolling."""


def column_header(name: str) -> str:
    """The header of a column with its unit: `known after (mean), s`."""
    if name in _HEADERS:
        return _HEADERS[name]
    for end, unit in _UNITS.items():
        if name.endswith(end) and len(name) > len(end):
            return name.removesuffix(end).replace("_", " ") + unit
    return name.replace("_", " ")


def strip_unit(name: str) -> str:
    """The header of a column without its unit, for sentences."""
    return column_header(name).partition(", ")[0]


def is_share(name: str) -> bool:
    """Whether a column is shown in per cent."""
    return column_header(name).endswith(", %")


def sort_columns(names: Sequence[str]) -> list[str]:
    """Columns in the order in which they are shown: those in `FIRST`, then the others."""
    return sorted(names, key=lambda name: FIRST.index(name) if name in FIRST else len(FIRST))


def format_value(name: str, value: float) -> str:
    """A value of a column; NaN as a dash."""
    if value != value:
        return "–"
    if name in _COUNTS:
        return f"{value:.0f}"
    if is_share(name):
        return format_aligned_per_cent(value)
    return format_two_decimals(value)


def difference_column_header(name: str) -> str:
    """The header of a column of differences, in percentage points for shares."""
    return column_header(name).removesuffix(", %") + ", percentage points" if is_share(name) else column_header(name)


def format_signed_difference(name: str, value: float) -> str:
    """A difference with its sign."""
    return format_signed_decimals(value * (100 if is_share(name) else 1))


_INTERVALS = {"detected_share": "interval", "pass_share": "pass_interval"}
"""Columns with limits, and the columns that name their kind of interval."""
_COUNTS = {"n": ("row", "rows"), "n_conflict": ("row in conflict", "rows in conflict")}


def summary_tables(study: ReportData) -> Html:
    """`summary.csv` as several tables, each of which fits on a page."""
    rows = study.results.summary
    parts = []
    metrics = (*METRICS, *own_metrics(study.results.experiment.measure.metrics))
    for part in PARTS:
        if part == "undetected" and not has_undetected(rows):
            continue
        columns_of = {m.name: m.help for m in metrics if m.part == part and m.name in rows}
        present = {name: says for name, says in columns_of.items() if rows[name].notna().any()}
        once = [name for name in present if name in SETUP and rows[name].nunique(dropna=False) == 1]
        columns = {name: present[name] for name in sort_columns(list(present)) if name not in once}
        shown = part != "braking" or "pass_share" in columns
        if columns and shown:
            below = [*_common_values(rows, once), *_interval_sentences(study, columns)]
            parts += [_summary_table(study, part, columns), *(make_tag("p", line, class_="below") for line in below)]
            parts.append(fold_parts("What the columns mean", _column_meanings(columns.items())))
    return join_html(parts)


def _common_values(rows: pd.DataFrame, names: Sequence[str]) -> list[str]:
    """A sentence of columns with one value: `500 rows, 10 fused lists per second for each configuration.`"""
    values = [
        count_noun(int(rows[name].iloc[0]), noun, many) for name, (noun, many) in _COUNTS.items() if name in names
    ]
    values += [
        f"{format_three_digits(float(rows[name].iloc[0]))} {column_header(name)}"
        for name in names
        if name not in _COUNTS
    ]
    return [f"{', '.join(values)} for each configuration."] if values else []


def _summary_table(study: ReportData, part: str, columns: dict[str, str]) -> Html:
    rows = []
    for _, row in study.results.summary.set_index("configuration", drop=False).loc[list(study.ranked)].iterrows():
        cells = [_summary_cell(row.to_dict(), name) for name in columns]
        rows.append(
            make_tag("tr", row_head(study, str(row["configuration"])), *cells, data_row=str(row["configuration"]))
        )
    return make_table(["configuration", *map(column_header, columns)], rows, caption=PARTS[part], id_=part)


def row_head(study: ReportData, name: str) -> Html:
    """The head of a configuration's row."""
    return make_tag(
        "th",
        make_tag("span", line_swatch(study.looks[name]), make_tag("span", allow_breaks(name)), class_="named"),
        scope="row",
    )


def _summary_cell(row: dict[str, Any], name: str) -> Html:
    """The cell of one metric of a configuration, with its limits, and the full number as data."""
    value = float("nan") if pd.isna(row[name]) else float(row[name])
    parts = [Html(format_value(name, value))]
    with_limits, scale = name in (*_INTERVALS, *JUDGED_DRIVING), 100 if is_share(name) else 1
    low, high = (row.get(f"{name}_{end}") if with_limits else None for end in ("low", "high"))
    if low is not None and high is not None and pd.notna(low) and pd.notna(high):
        parts.append(interval_markup(scale * float(low), scale * float(high)))
    return make_tag(
        "td",
        *parts,
        data_column=name,
        data_value=full_number(row[name]),
        data_low=full_number(low),
        data_high=full_number(high),
    )


def interval_markup(low: float, high: float) -> Html:
    """Limits of an interval, which may wrap below their value."""
    return join_html([" ", make_tag("span", write_limits(low, high), class_="interval")])


def full_number(value: Any) -> str | None:
    """A number with the digits of `summary.csv`; None for a missing one."""
    return f"{value:.9g}" if value is not None and pd.notna(value) else None


def _interval_sentences(study: ReportData, columns: Iterable[str]) -> list[str]:
    """Sentences below a table: what the intervals of its columns are over, and up to when means are."""
    rows = study.results.summary
    sentences = []
    for column in (name for name in columns if name in _INTERVALS):
        lines = describe_intervals(rows, _INTERVALS[column])
        none = [f"no interval: too few logs, or objects of one log; {NOT_ENOUGH}"]
        words = [line.replace("95 %: ", "95 % ").replace("no 95 % of", "no 95 % interval of") for line in lines or none]
        sentences += [_make_sentence(f"{strip_unit(column)}: {line}") for line in words]
    horizon = rows["ttd_rmst_horizon_s"].dropna() if "ttd_rmst_s" in columns else pd.Series(dtype=float)
    if len(horizon):
        up_to = f"{format_three_digits(float(horizon.iloc[0]))} s"
        sentences.append(f"Means are of min(time, {up_to}); an object that is never detected counts as {up_to}.")
    return sentences


def _column_meanings(columns: Iterable[tuple[str, str]], names: Any = column_header) -> Html:
    terms = [
        part
        for name, says in columns
        for part in (make_tag("dt", names(name)), make_tag("dd", says, " ", make_tag("code", name)))
    ]
    return make_tag("dl", *terms)


def regret_table(study: ReportData) -> Html:
    """Each configuration minus the baseline, as in `copem-replay compare`; or why there are no differences."""
    regret = study.regret
    if regret is None:
        reason = "no object is measured" if not len(study.results.known) else "there is one configuration only"
        return make_tag("p", f"No differences: {reason}.")
    rows = {(row.configuration, row.metric): row for row in regret.overall.itertuples(index=False)}
    compared = [name for name in study.ranked if name in regret.configurations]
    metrics = sort_columns([m for m in COMPARED if any(_is_compared(rows.get((name, m))) for name in compared)])
    words = [(m, f"{of.words}; {'more' if COMPARED[m].better > 0 else 'less'} is better") for m in metrics
             if (of := COMPARED[m].compared)]  # fmt: skip
    tables = []
    for id_, suffix, columns in (
        ("regret", "", [m for m in metrics if COMPARED[m].part != "lists"]),
        ("regret-lists", ", of the lists", [m for m in metrics if COMPARED[m].part == "lists"]),
    ):
        lines = [
            make_tag(
                "tr", row_head(study, name), *(_difference_cell(rows.get((name, m)), m) for m in columns), data_row=name
            )
            for name in compared
        ]
        head = ["configuration", *map(difference_column_header, columns)]
        tables += (
            [make_table(head, lines, caption=f"Differences to {regret.baseline}{suffix}", id_=id_)] if columns else []
        )
    return join_html(
        [
            *tables,
            make_tag(
                "p",
                f"Bold, {STAR}: the interval excludes 0, these tables together at 95 %; {ALONE}: "
                "its own interval alone excludes 0.",
                class_="below",
            ),
            _held_table(study, regret),
            fold_parts(
                "What the columns mean, and how they are made",
                _column_meanings(words, difference_column_header),
                make_list(map(_make_sentence, comparison_lines(regret))),
            ),
        ]
    )


def _is_compared(row: Any) -> bool:
    """Whether there is a difference: a column without any is left out."""
    return row is not None and bool(pd.notna(row.difference))


def _held_table(study: ReportData, regret: Comparison) -> Html:
    """What the differences of what is held are over: a row per configuration; nothing where they are not compared."""
    cells = held_cells(regret)
    lines = [
        make_tag("tr", row_head(study, name), *(make_tag("td", cell) for cell in rest), data_row=name)
        for name, *rest in cells.itertuples(index=False)
    ]
    caption = f"The newest list at the frames of the truth: of the configuration / of {regret.baseline}"
    return make_table(list(cells.columns), lines, caption=caption, id_="regret-held") if lines else Html()


def baseline_words(study: ReportData) -> Html:
    """Words on which configuration is the baseline, and why."""
    if study.regret is None:
        return Html()
    why = study.regret.baseline_why
    words = "chosen with --baseline" if why is None else f"{why}; --baseline of copem-replay report chooses another"
    return make_tag("p", "Each configuration minus ", make_tag("b", study.regret.baseline), f": {words}.")


def _difference_cell(row: Any, metric: str) -> Html:
    """The cell of one difference with its limits and star; “–” without a value."""
    if row is None or pd.isna(row.difference):
        return make_tag("td", "–", data_column=metric)
    limits = row.low, row.high
    shown: list[str] = [format_signed_difference(metric, row.difference)]
    if row.star == STAR:
        shown = [make_tag("b", *shown)]
    shown += [] if pd.isna(row.star) else [f" {row.star}"]
    if pd.notna(row.interval_over):
        times = 100.0 if is_share(metric) else 1.0
        shown.append(interval_markup(*(math.nan if pd.isna(limit) else times * float(limit) for limit in limits)))
    shown += [f" ({why})" for why in explain_no_interval(row)]
    low, high = map(full_number, limits)
    return make_tag(
        "td", *shown, data_column=metric, data_value=full_number(row.difference), data_low=low, data_high=high
    )


def _make_sentence(line: str) -> str:
    """A line on a table, with headers of columns in place of their names."""
    line = use_headers(line)
    return f"{line[:1].upper()}{line[1:]}."


# Objects that were never detected, and the exact probability of that, where it is known.

_OPEN = 40
"""Most rows of an unfolded table: about a screen."""


def never_detected(study: ReportData) -> Html:
    """A table with a row per object and set of configurations that miss it in equally many runs, most missed first."""
    rows_of_tally = study.results.known
    missed = count_misses(rows_of_tally)
    if not len(missed):
        return make_tag("p", "None: every measured object was detected in every run, by every configuration.")
    rows = [_missed_row(study, found, list(names)) for found, names in _group_misses(missed, study.names)]
    things = missed.groupby(["log", "object_id"]).ngroups
    measured = rows_of_tally.groupby(["log", "object_id"]).ngroups
    text = (
        f"{count_noun(things, 'object')} of the {measured} measured, missed in some run by some configuration; the "
        "most missed first. A row names all configurations that miss the object in as many runs."
    )
    head = ["log", "object", "class", "never in", "by", "looked at for (s)", "until", "look at it"]
    table = make_table(head, rows, caption="Objects never detected", id_="never")
    if len(rows) > _OPEN:
        table = make_tag("details", make_tag("summary", f"All {len(rows)} rows"), table)
    return join_html([make_tag("p", text), table])


def exact_misses(study: ReportData) -> Html:
    """Exact probabilities that an object is never detected and that the ego fails, a line per configuration."""
    rows = study.results.summary
    if "miss_log10" not in rows:
        return Html()
    above = "What the PEM implies if its lists err independently of each other, which small numbers hang on most."
    lines = make_list(_exact_sentence(row) for row in rows.to_dict("records"))
    return join_html([make_tag("h3", "Without a draw"), make_tag("p", above), lines])


def _exact_sentence(row: dict[str, Any]) -> Html:
    """A sentence on how probably a configuration never detects an object, and how probably the ego fails."""
    missed, half, fails = (
        float(row.get(name, math.nan)) for name in ("miss_log10", "miss_log10_half_odds", "fail_share_exact")
    )
    sentence: list[str] = [make_tag("b", str(row["configuration"])), ": "]
    if math.isnan(missed):
        sentence.append("the detection of every measured object is certain")
    elif missed == 0:
        sentence.append("no list ever holds a measured object")
    else:
        sentence += [
            "a measured object is never detected with probability ", format_power(missed),
            "; were the odds of every detection half of what the PEM says, that would be ", format_power(half),
        ]  # fmt: skip
    if not math.isnan(fails):
        sentence += [". The ego fails with probability ", format_power(math.log10(fails)) if fails > 0 else "0"]
    return join_html([*sentence, "."])


def format_power(log10: float) -> Html:
    """A number of any size from its decadic logarithm: `0.0123`, `4.2·10⁻²²`."""
    if -3 <= log10 < 4:
        return Html(format_cell(math.pow(10, log10)))
    mantissa, _, exponent = f"{math.pow(10, log10 - math.floor(log10)):.1e}".partition("e")
    power = make_tag("sup", f"{math.floor(log10) + int(exponent)}".replace("-", "−"))
    return join_html(["10" if mantissa == "1.0" else f"{mantissa}·10", power])


def count_misses(known: pd.DataFrame) -> pd.DataFrame:
    """Rows by log, episode and configuration with `missed` > 0: runs without detection, of `runs`."""
    keys = ["log", "object_id", "episode", "configuration"]
    missed = known["runs"].where(known["time_to_detection_s"].isna(), 0)
    grouped = known.assign(missed=missed).groupby(keys, sort=False)
    counts = grouped.agg(
        missed=("missed", "sum"),
        runs=("runs", "sum"),
        object_class=("object_class", "first"),
        onset_s=("onset_s", "first"),
        ended_s=("ended_s", "first"),
        ended_by=("ended_by", "first"),
    ).reset_index()
    return counts[counts["missed"] > 0]


def _group_misses(missed: pd.DataFrame, order: Sequence[str]) -> list[tuple[pd.Series, tuple[str, ...]]]:
    by_key: dict[tuple[str, str, int, int, int], tuple[pd.Series, list[str]]] = {}
    for _, row in missed.iterrows():
        key = (str(row["log"]), str(row["object_id"]), int(row["episode"]), int(row["missed"]), int(row["runs"]))
        by_key.setdefault(key, (row, []))[1].append(str(row["configuration"]))
    ranked = sorted(by_key, key=lambda key: (-key[3] / key[4], -len(by_key[key][1]), key))
    return [(by_key[key][0], tuple(name for name in order if name in by_key[key][1])) for key in ranked]


def _missed_row(study: ReportData, row: pd.Series, names: list[str]) -> Html:
    """The row of an object that the configurations `names` miss: in how many runs, and links to it."""
    by_all = len(names) == len(study.names) > 1
    configurations = f"all {len(names)} configurations" if by_all else ", ".join(names)
    suffix = f", episode {row['episode']}" if row["episode"] else ""
    log, object_id = str(row["log"]), str(row["object_id"])
    links, command = [link_story(log, object_id), link_player(log, object_id)], study.view_command(log, object_id)
    return make_tag(
        "tr",
        make_tag("th", str(row["log"]), scope="row"),
        make_tag("td", f"{object_id}{suffix}", class_="text"),
        make_tag("td", str(row["object_class"]), class_="text"),
        make_tag("td", f"{count_noun(int(row['runs']), 'run') if row['missed'] == row['runs'] else row['missed']}"
            + (" (all)" if row["missed"] == row["runs"] else f" of {count_noun(int(row['runs']), 'run')}"),
            data_value=str(row["missed"])),
        make_tag("td", configurations, class_="text long"),
        make_tag("td", format_cell(float(row["ended_s"] - row["onset_s"]))),
        make_tag("td", EndReason(row["ended_by"]).past, class_="text"),
        make_tag("td", join_html([*links, make_tag("code", command)] if command else links, " "), class_="text long"),
    )  # fmt: skip


# Stages of the latency (`report/figures/latency_breakdown.py`).


def stage_table(study: ReportData) -> Html:
    """Means of the stages and their meaning, below their figure."""
    means = mean_stages_by_configuration(study.results, study.names)
    stages = [stage for stage in STAGES if any(stage in means_of_name for means_of_name in means.values())]
    detected = count_detected(study.results)
    note = (
        "Means over the rows in which the object is detected; how many these are, where not all, is beside the bar. "
        "Rows without detection have no stages, so bars of configurations that miss many objects are over other rows, "
        "and their sum is not the mean time after which it is known."
    )
    terms = [part for stage in stages for part in (make_tag("dt", stage), make_tag("dd", STAGES[stage]))]
    below = fold_parts("What the stages are", make_tag("dl", *terms))
    return join_html([make_tag("p", note), _stages_table(study, means, stages, detected), below])


def _stages_table(
    study: ReportData, means: dict[str, dict[str, float]], stages: list[str], detected: dict[str, tuple[int, int]]
) -> Html:
    """The table of the stages' mean durations (s) by configuration, with their sum."""
    rows = []
    for name in study.ranked:
        figures = [*(means[name].get(stage) for stage in stages), sum(means[name].values()) if means[name] else None]
        cells = [
            make_tag(
                "td",
                "–" if value is None else format_two_decimals(value),
                data_column=stage,
                data_value=full_number(value) or "",
            )
            for stage, value in zip([*stages, "sum"], figures, strict=True)
        ]
        counted = make_tag("td", f"{detected[name][0]} of {detected[name][1]}", data_column="detected")
        rows.append(make_tag("tr", row_head(study, name), counted, *cells, data_row=name))
    head = ["configuration", "known", *stages, "sum"]
    return make_table(head, rows, caption="Mean duration of the stages, in seconds", id_="stages")


# Verdicts of criteria.

VERDICT_SIGNS = {MET: "✓", NOT_MET: "✗", UNDECIDED: "?", NOT_MEASURED: "–"}
"""What tells verdicts apart beside their colour."""


def verdict_mark(verdict: Verdict | None) -> Html:
    """A square with the sign of a verdict."""
    if verdict is None:
        return make_tag("span", " ", class_="mark absent", title="not judged")
    kind = verdict.verdict.replace(" ", "-")
    words = f"{verdict.result}: {verdict.found} {verdict.limits}"
    return make_tag(
        "span", VERDICT_SIGNS[verdict.verdict], class_=f"mark {kind}", title=words, aria_label=words, role="img"
    )


def verdicts_table(verdicts: Judgement) -> Html:
    """The table of a report: a row per verdict; below it how many pass."""
    head = ["criterion", "configuration", "bound", "found", "verdict", "why"]
    rows = [
        make_tag(
            "tr",
            make_tag("th", v.name, scope="row"),
            make_tag("td", allow_breaks(v.configuration), class_="text"),
            make_tag("td", allow_breaks(v.asked), class_="text"),
            make_tag("td", v.found, " ", make_tag("span", v.limits, class_="interval")),
            make_tag("td", verdict_mark(v), " ", make_tag("span" if v.passes else "b", v.result), class_="text"),
            make_tag("td", v.why, class_="text long"),
        )
        for v in verdicts.all
    ]
    below = [make_tag("p", f"{text}.", class_="below") for text in (verdicts.chance, *verdicts.notes)]
    headline = make_tag("p", f"{verdicts.headline}.", class_="lead")
    return join_html([headline, make_table(head, rows, id_="verdicts"), *below])

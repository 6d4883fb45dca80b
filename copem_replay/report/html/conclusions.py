"""The answer in words: the decision, what else stands out, what varies most, and, folded, how sure that is."""

from __future__ import annotations

import re
from collections.abc import Iterator
from operator import itemgetter
from typing import Any

import numpy as np
import pandas as pd

from copem_replay.core.errors import count_noun, name_first
from copem_replay.metrics.limits import NOT_ENOUGH, NOTHING_DRAWN
from copem_replay.report.figures.style import (
    describe_over,
    explain_no_intervals,
    find_with_fewer_rows,
    format_per_cent,
    format_signed_decimals,
    format_two_decimals,
    write_limits,
)
from copem_replay.report.html.markup import Html, escape_text, fold_parts, join_html, make_list, make_tag
from copem_replay.report.html.setup import NAMED, join_names
from copem_replay.report.html.study import ReportData
from copem_replay.results.compare.tables import NOTHING, describe_gain
from copem_replay.results.decision import decide

_INTERVAL = re.compile(r"(?:[^\s(]+ (?:s|%|percentage points) )?\[[^\[\]<]*\]")


def write_lead(study: ReportData) -> Html:
    """The decision, a paragraph a sentence."""
    sentences = decide(study.results, study.regret, study.verdicts).sentences
    return join_html([make_tag("p", _prevent_breaks(sentence), class_="lead") for sentence in sentences])


def write_details(study: ReportData) -> Html:
    """What else stands out, what varies most; caveats below, folded."""
    if not len(study.results.known):
        return make_list(str(note) for note in study.provenance.get("notes", []))
    found, caveats = _detail_sentences(study), [*_caveat_sentences(study)]
    folded = make_list(map(_prevent_breaks, caveats))
    sure = fold_parts(f"How sure this is: {count_noun(len(caveats), 'remark')}", folded)
    return join_html([make_list(map(_prevent_breaks, found)), sure])


def _prevent_breaks(sentence: str) -> Html:
    """Prevent line breaks between a value and its interval, and within the interval."""
    return Html(_INTERVAL.sub(lambda match: make_tag("span", Html(match[0]), class_="tight"), escape_text(sentence)))


def _detail_sentences(study: ReportData) -> Iterator[str]:
    rows = study.results.summary.set_index("configuration")
    contenders = study.contenders
    share = rows["detected_share"].astype(float)
    if share[list(contenders)].any():
        yield from _detected_sentences(study, share)
    yield from _pass_sentences(study)
    yield from _variation_sentences(study)


def _caveat_sentences(study: ReportData) -> Iterator[str]:
    """On what the answer is over, and what it leaves out."""
    yield from _elsewhere_sentences(study)
    yield from _truth_sentences(study)
    yield from _certainty_sentences(study)
    yield from _left_out_sentences(study)


def _elsewhere_sentences(study: ReportData) -> Iterator[str]:
    """Configurations whose units some logs lack."""
    if fewer := find_with_fewer_rows(study.results, study.contenders):
        yield (
            f"{join_names(list(fewer))} {'is' if len(fewer) == 1 else 'are'} ranked last: some logs lack the units, "
            "and means and shares are over the others alone. Differences are over what both have."
        )


def _format_points(row: Any) -> str:
    """A difference of shares with its interval, in percentage points, and whether it can be shown."""
    shown = f"{format_signed_decimals(100 * row['difference'])} percentage points"
    if row[["interval_over", "low", "high"]].isna().any():
        return f"{shown}, without an interval"
    logs = "" if pd.isna(row["logs_better"]) else f", {describe_gain(row)}"
    low, high = 100 * row["low"], 100 * row["high"]
    unsure, shown = low <= NOTHING and high >= -NOTHING, f"{shown} {write_limits(low, high)}{logs}"
    return shown + ": the interval includes 0, so no difference can be shown" * bool(unsure)


def _detected_sentences(study: ReportData, share: pd.Series) -> Iterator[str]:
    """Sentences on who never detects anything, or misses some objects; `share`: detected share by configuration."""
    never = [name for name in study.contenders if share[name] == 0]
    if never:
        yield f"{join_names(never)} never {'detects' if len(never) == 1 else 'detect'} any object."
    if (share[list(study.contenders)] == 1).all():
        yield "Every configuration detects every measured object in every run."
        return
    missed = [(name, 1 - float(share[name])) for name in study.contenders if 0 < share[name] < 1]
    if missed:
        worst, fewest = max(missed, key=itemgetter(1)), min(missed, key=itemgetter(1))
        rows = "of the rows (objects × runs)"
        if format_per_cent(worst[1]) == format_per_cent(fewest[1]):
            names = join_names([name for name, _ in missed])
            yield (
                f"{names} {'each miss' if len(missed) > 1 else 'misses'} {format_per_cent(worst[1])} % {rows}; Never "
                "detected names the objects."
            )
        else:
            yield (
                f"{len(missed)} configurations miss some objects, from {fewest[0]} with {format_per_cent(fewest[1])} % "
                f"to {worst[0]} with {format_per_cent(worst[1])} % {rows}; Never detected names the objects."
            )


def _pass_sentences(study: ReportData) -> Iterator[str]:
    """A sentence on the best and the worst share of conflicts that pass; none without verdicts."""
    rows = study.results.summary.set_index("configuration")
    if "pass_share" not in rows:
        return
    judged = rows.loc[[name for name in study.contenders if pd.notna(rows.loc[name, "pass_share"])]]
    if not len(judged):
        yield "Braking in time: no object is in conflict with the ego, so there is nothing to judge."
        return
    share = judged["pass_share"].astype(float)
    best, worst = str(share.idxmax()), str(share.idxmin())
    best_names, last = ([str(name) for name in share.index[share == share[one]]] for one in (best, worst))
    sentence = f"Braking in time: of {count_noun(int(judged.loc[best, 'n_conflict']), 'row')} in conflict "
    sentence += f"{_format_share(judged.loc[best])} pass with {name_first(best_names, NAMED)}"
    if len(best_names) < len(share):
        sentence += f", {_format_share(judged.loc[worst])} with {name_first(last, NAMED)}"
    if study.regret is not None and study.baseline not in best_names:
        overall = study.regret.overall
        differences = overall[overall["metric"] == "pass_share"].set_index("configuration")
        if best in differences.index and pd.notna(differences.loc[best, "difference"]):
            sentence += f"; {best} against {study.baseline} {_format_points(differences.loc[best])}"
    yield sentence + "."


def _format_share(row: Any) -> str:
    low, high = row["pass_share_low"], row["pass_share_high"]
    shown = f"{format_per_cent(float(row['pass_share']))} %"
    return shown if pd.isna(low) else f"{shown} {write_limits(100 * float(low), 100 * float(high))}"


def _truth_sentences(study: ReportData) -> Iterator[str]:
    truth = [name for name in study.names if name not in study.contenders]
    if truth:
        yield f"{join_names(truth)} {'is' if len(truth) == 1 else 'are'} the ground truth: the upper bound, not ranked."


def _variation_sentences(study: ReportData) -> Iterator[str]:
    """Which of object, configuration and run moves times most: standard deviations of means, up to the horizon."""
    rows = study.results.known
    rows = rows[rows["configuration"].isin(study.contenders)]
    horizon_s = study.results.provenance.horizon_used_s
    time_s, weight = rows["time_to_detection_s"].fillna(horizon_s).clip(upper=horizon_s), rows["runs"]
    episode = rows.groupby(["log", "object_id", "episode"], sort=False).ngroup()
    mean_s = float(np.average(time_s, weights=weight))
    means_s = {
        kind: (time_s * weight).groupby(key).transform("sum") / weight.groupby(key).transform("sum")
        for kind, key in (("object", episode), ("configuration", rows["configuration"]))
    }
    pairs = [episode, rows["configuration"]]
    pair_mean_s = (time_s * weight).groupby(pairs).transform("sum") / weight.groupby(pairs).transform("sum")
    deviations = {kind: means - mean_s for kind, means in means_s.items()} | {"run": time_s - pair_mean_s}
    sd_s = {kind: float(np.sqrt(np.average(of**2, weights=weight))) for kind, of in deviations.items()}
    shown = [(kind, value) for kind, value in sorted(sd_s.items(), key=itemgetter(1), reverse=True) if value >= 0.005]
    if shown:
        words = (f"from {kind} to {kind} by {format_two_decimals(value)} s" for kind, value in shown)
        yield f"Times vary most {', then '.join(words)} (standard deviations of means)."


def _certainty_sentences(study: ReportData) -> Iterator[str]:
    """A sentence on what intervals are over, or why there are none."""
    over, kind = (study.results.summary[name].dropna() for name in ("interval_over", "interval"))
    if not len(over) and (kind == NOTHING_DRAWN).any():
        yield (
            "There are no intervals: every run is the same, for recorded lists and the ground truth are not drawn. The "
            "result holds for this one object; additional runs say nothing about other traffic."
        )
        return
    if not len(over):
        yield (
            f"There are no intervals: {explain_no_intervals(study.results)}. The result holds for these objects; "
            f"{NOT_ENOUGH}."
        )
        return
    yield f"Intervals are 95 %, in brackets, over {describe_over(study.results)}."


def _left_out_sentences(study: ReportData) -> Iterator[str]:
    skipped = [str(log["log"]) for log in study.provenance.get("logs_skipped", [])]
    if skipped:
        yield f"In no figure, because the replay failed: {name_first(skipped, NAMED)}."
    notes = study.provenance.get("notes", [])
    if notes:
        yield f"{count_noun(len(notes), 'note')} on recordings and experiment: see Where this comes from."

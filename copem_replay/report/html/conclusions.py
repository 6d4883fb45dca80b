"""The answer in words: the decision, differences to the best, what varies most, and, folded, how sure that is."""

from __future__ import annotations

import re
from collections.abc import Iterator
from operator import itemgetter
from typing import Any

import numpy as np
import pandas as pd

from copem_replay.core.errors import count_noun
from copem_replay.metrics.braking.driving import SHARE
from copem_replay.metrics.limits import ALL_ALIKE, NOT_ENOUGH, NOTHING_DRAWN
from copem_replay.report.figures.style import (
    RANKED_BY,
    describe_over,
    explain_no_intervals,
    find_with_fewer_rows,
    format_per_cent,
    format_signed_decimals,
    format_three_digits,
    format_two_decimals,
    write_limits,
)
from copem_replay.report.html.markup import Html, escape_text, fold_parts, join_html, make_list, make_tag
from copem_replay.report.html.setup import join_names, shorten_list
from copem_replay.report.html.study import ReportData, detects_at_onset, explain_missing_interval
from copem_replay.results.compare import Comparison
from copem_replay.results.compare.tables import NOTHING, describe_gain
from copem_replay.results.decision import MATTERS_S, decide, find_brakers

_INTERVAL = re.compile(r"(?:[^\s(]+ (?:s|%|percentage points) )?\[[^\[\]<]*\]")


def write_lead(study: ReportData) -> Html:
    """The decision, in one sentence."""
    return make_tag("p", decide(study.results, study.regret, study.verdicts).sentence, class_="lead")


def write_details(study: ReportData) -> Html:
    """Differences to the best with intervals, what varies most; caveats below, folded."""
    if study.best is None:
        return make_list(str(note) for note in study.provenance.get("notes", []))
    caveats = [*_caveat_sentences(study)]
    return join_html(
        [
            make_list(map(_prevent_breaks, _detail_sentences(study))),
            fold_parts(
                f"How sure this is: {count_noun(len(caveats), 'remark')}", make_list(map(_prevent_breaks, caveats))
            ),
        ]
    )


def _prevent_breaks(sentence: str) -> Html:
    """Prevent line breaks between a value and its interval, and within the interval."""
    return Html(_INTERVAL.sub(lambda found: make_tag("span", Html(found[0]), class_="tight"), escape_text(sentence)))


def _detail_sentences(study: ReportData) -> Iterator[str]:
    rows = study.results.summary.set_index("configuration")
    contenders = study.contenders
    share = rows["detected_share"].astype(float)
    if share[list(contenders)].any():
        yield _soonest_sentence(study)
        yield from _needless_sentences(study)
        yield from _other_sentences(study)
        yield from _detected_sentences(study, share)
    yield from _pass_sentences(study)
    yield from _variation_sentences(study)


def _caveat_sentences(study: ReportData) -> Iterator[str]:
    """On what the answer is over, and what it leaves out."""
    if study.lead is not None:
        later, _, _, unsure = _split_by_difference(study.lead)
        yield from _missing_sentences(study, unsure)
        if len(later) and len(study.contenders) > 2:
            yield f"The same figures pick the winner{'s' * (len(study.as_soon) > 1)}, which flatters it a little."
    yield from _elsewhere_sentences(study)
    yield from _truth_sentences(study)
    yield from _certainty_sentences(study)
    yield from _left_out_sentences(study)


def _soonest_sentence(study: ReportData) -> Html:
    assert study.best is not None
    mean_s, horizon_s = (float(study.of(study.best)[key]) for key in (RANKED_BY, "ttd_rmst_horizon_s"))
    missed = (study.results.summary["detected_share"] < 1).any()
    counted_as = f" (an object that is never detected counts as {format_three_digits(horizon_s)} s)" if missed else ""
    name = make_tag("b", study.best)
    if study.lead is None:
        only = "it is the only configuration" if len(study.names) == 1 else "only the ground truth is beside it"
        after = f" detects after {format_two_decimals(mean_s)} s on average{counted_as}."
        return join_html([name, f"{after} There is nothing to compare it with: {only}."])
    tied = study.as_soon
    if len(tied) == 1:
        return _first_sentence(study, name, mean_s, counted_as)
    _, alike, sooner, _ = _split_by_difference(study.lead)
    when = "every object at its onset"
    if not detects_at_onset(study):
        when = f"at the same times: after {format_two_decimals(mean_s)} s on average{counted_as}"
    not_tied = len(study.lead.configurations) + 1 - len(tied)
    undecided = sum(name not in tied for rows in (alike, sooner) for name in rows["configuration"])
    others = f"the other {not_tied}" if not_tied > 1 else "the other"
    below = f" {others[:1].upper()}{others[1:]} {'are' if not_tied > 1 else 'is'} below." if not_tied else ""
    if undecided:
        to = others if undecided == not_tied else f"{undecided} of {others}"
        below = f" The interval of their difference to {to} includes 0."
    return join_html([make_tag("b", join_names(tied)), f" detect {when}.{below}"])


def _needless_sentences(study: ReportData) -> Iterator[str]:
    """With whom of the soonest the driver brakes for nothing."""
    brakers = set() if study.regret is None else find_brakers(study.regret)
    for name in study.as_soon:
        if name in brakers:
            share = format_per_cent(study.of(name)[SHARE])
            yield f"With {name} the driver brakes for nothing in {share} % of the driving time."


def _elsewhere_sentences(study: ReportData) -> Iterator[str]:
    """Configurations whose units some logs lack."""
    if fewer := find_with_fewer_rows(study.results, study.contenders):
        yield (
            f"{join_names(list(fewer))} {'is' if len(fewer) == 1 else 'are'} ranked last: some logs lack the units, "
            "and means and shares are over the others alone. Differences are over what both have."
        )


def _missing_sentences(study: ReportData, unsure: pd.DataFrame) -> Iterator[str]:
    """That differences have no interval, and why."""
    if not len(unsure):
        return
    assert study.lead is not None
    tied = study.as_soon
    all_tied = all(rows["configuration"].isin(tied).all() for rows in _split_by_difference(study.lead)[:3])
    apart = unsure[unsure["difference"].abs() > NOTHING]
    of_names = (
        ""
        if all_tied
        else f" of the difference to {join_names(list((apart if len(apart) else unsure)['configuration']))}"
    )
    yield f"No interval{of_names}: {explain_missing_interval(study, unsure)}."


def _first_sentence(study: ReportData, name: Html, mean_s: float, counted_as: str) -> Html:
    """The answer if no other configuration detects at the same times as the best one."""
    assert study.lead is not None
    later, alike, sooner, unsure = _split_by_difference(study.lead)
    undecided, others = len(alike) + len(sooner), len(study.lead.configurations)
    level = list(unsure.loc[unsure["difference"].abs() <= NOTHING, "configuration"])
    if level:
        names = make_tag("b", join_names([str(study.best), *level]))
        mean = f" have the same mean time, {format_two_decimals(mean_s)} s{counted_as},"
        return join_html([names, f"{mean} though they do not always detect at the same time."])
    near = _metric_rows(study.lead, RANKED_BY).query("abs(difference) < @MATTERS_S")["configuration"]
    if len(near):
        names = make_tag("b", join_names([str(study.best), *near]))
        return join_html(
            [
                names,
                f" detect soonest, after {format_two_decimals(mean_s)} s on average{counted_as}: differences below "
                f"{MATTERS_S:g} s name no winner.",
            ]
        )
    rivals = f"the other {others}" if others > 1 else study.lead.configurations[0]
    has, sure = f" has the shortest mean time, {format_two_decimals(mean_s)} s", ""
    if len(later) == others:
        has, sure = f" detects soonest, after {format_two_decimals(mean_s)} s on average", f", sooner than {rivals}"
    elif undecided:
        to = f"{undecided} of {rivals}" if undecided < others else rivals
        sure = f", but the interval of its difference to {to} includes 0"
    return join_html([name, f"{has}{counted_as}{sure}."])


def _split_by_difference(lead: Comparison) -> tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame, pd.DataFrame]:
    """Rows of differences to the best: interval above 0 (later), including 0, below 0 (sooner), without interval."""
    rows = _metric_rows(lead, RANKED_BY)
    rows = rows[rows["difference"].notna()].sort_values("difference", kind="stable")
    same = rows["interval"].isin([ALL_ALIKE, NOTHING_DRAWN]) & (rows["difference"].abs() <= NOTHING)
    unsure = (rows["interval_over"].isna() | rows["low"].isna() | rows["high"].isna()) & ~same
    later = ~unsure & (rows["low"] > NOTHING)
    sooner = ~unsure & (rows["high"] < -NOTHING)
    return rows[later], rows[~unsure & ~later & ~sooner], rows[sooner], rows[unsure]


def _other_sentences(study: ReportData) -> Iterator[str]:
    """The other configurations, by the interval of their difference to the best."""
    if study.lead is None:
        return
    tied = study.as_soon
    later, alike, sooner, unsure = (
        rows[~rows["configuration"].isin(tied)] for rows in _split_by_difference(study.lead)
    )
    if len(tied) == 1:  # nearer ones share the first place, in a sentence of their own
        alike = alike[alike["difference"].abs() >= MATTERS_S]
    unsure = unsure[unsure["difference"].abs() > NOTHING]
    if len(later):
        yield f"Later, the interval of the difference excluding 0: {_list_differences(later)}."
    if len(alike):
        yield (
            f"No difference to it is shown, the interval including 0: {_list_differences(alike)}. That does not show "
            "that there is none."
        )
    if len(sooner):  # a mean over censored times may rank otherwise than pairs do
        yield f"Sooner by pairs, though later in the table: {_list_differences(sooner)}."
    for word, rows in (
        ("Later", unsure[unsure["difference"] > 0]),
        ("Sooner by pairs", unsure[unsure["difference"] < 0]),
    ):
        if len(rows):
            yield f"{word}, without an interval: {_list_differences(rows)}."


def _list_differences(rows: pd.DataFrame) -> str:
    return shorten_list([f"{row.configuration} ({_format_difference(row)})" for row in rows.itertuples(index=False)])


def _format_difference(row: Any, unit: str = " s") -> str:
    shown = format_signed_decimals(row.difference) + unit
    if pd.isna(row.interval_over) or pd.isna(row.low) or pd.isna(row.high):
        return shown
    logs = "" if pd.isna(row.logs_better) else f", {describe_gain(row)}"
    return f"{shown} {write_limits(row.low, row.high)}{logs}"


def _format_unsure(row: Any) -> str:
    if pd.isna(row.interval_over) or pd.isna(row.low) or pd.isna(row.high):
        return ", without an interval"
    if row.low <= NOTHING and row.high >= -NOTHING:
        return ": the interval includes 0, so no difference can be shown"
    return ""


def _detected_sentences(study: ReportData, share: pd.Series) -> Iterator[str]:
    never = [name for name in study.contenders if share[name] == 0]
    if never:
        yield f"{join_names(never)} never {'detects' if len(never) == 1 else 'detect'} any object."
    if (share[list(study.contenders)] == 1).all():
        yield "Every configuration detects every measured object in every run."
        return
    missed = [(name, 1 - float(share[name])) for name in study.contenders if 0 < share[name] < 1]
    if missed:
        worst, least = max(missed, key=itemgetter(1)), min(missed, key=itemgetter(1))
        rows = "of the rows (objects × runs)"
        if format_per_cent(worst[1]) == format_per_cent(least[1]):
            names = join_names([name for name, _ in missed])
            yield (
                f"{names} {'each miss' if len(missed) > 1 else 'misses'} {format_per_cent(worst[1])} % {rows}; Never "
                "detected names the objects."
            )
        else:
            yield (
                f"{len(missed)} configurations miss some objects, from {least[0]} with {format_per_cent(least[1])} % "
                f"to {worst[0]} with {format_per_cent(worst[1])} % {rows}; Never detected names the objects."
            )


def _pass_sentences(study: ReportData) -> Iterator[str]:
    rows = study.results.summary.set_index("configuration")
    if "pass_share" not in rows:
        return
    judged = rows.loc[[name for name in study.contenders if pd.notna(rows.loc[name, "pass_share"])]]
    if not len(judged):
        yield "Braking in time: no object is in conflict with the ego, so there is nothing to judge."
        return
    share = judged["pass_share"].astype(float)
    best, worst = str(share.idxmax()), str(share.idxmin())
    alike, last = ([str(name) for name in share.index[share == share[one]]] for one in (best, worst))
    sentence = f"Braking in time: of {count_noun(int(judged.loc[best, 'n_conflict']), 'row')} in conflict "
    sentence += f"{_format_share(judged.loc[best])} pass with {shorten_list(alike)}"
    if len(alike) < len(share):
        sentence += f", {_format_share(judged.loc[worst])} with {shorten_list(last)}"
    if study.regret is not None and study.baseline not in alike:
        differences = _metric_rows(study.regret, "pass_share").set_index("configuration")
        if best in differences.index and pd.notna(differences.loc[best, "difference"]):
            row = differences.loc[best]
            points = row.copy()
            points[["difference", "low", "high"]] = 100 * row[["difference", "low", "high"]].astype(float)
            difference = _format_difference(points, " percentage points")
            sentence += f"; {best} against {study.baseline} {difference}{_format_unsure(points)}"
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
        what: (time_s * weight).groupby(key).transform("sum") / weight.groupby(key).transform("sum")
        for what, key in (("object", episode), ("configuration", rows["configuration"]))
    }
    pairs = [episode, rows["configuration"]]
    of_pair = (time_s * weight).groupby(pairs).transform("sum") / weight.groupby(pairs).transform("sum")
    apart = {what: means - mean_s for what, means in means_s.items()} | {"run": time_s - of_pair}
    sd_s = {what: float(np.sqrt(np.average(of**2, weights=weight))) for what, of in apart.items()}
    shown = [(what, value) for what, value in sorted(sd_s.items(), key=itemgetter(1), reverse=True) if value >= 0.005]
    if shown:
        words = (f"from {what} to {what} by {format_two_decimals(value)} s" for what, value in shown)
        yield f"Times vary most {', then '.join(words)} (standard deviations of means)."


def _certainty_sentences(study: ReportData) -> Iterator[str]:
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
        yield f"In no figure, because the replay failed: {shorten_list(skipped)}."
    notes = study.provenance.get("notes", [])
    if notes:
        yield f"{count_noun(len(notes), 'note')} on recordings and experiment: see Where this comes from."


def _metric_rows(comparison: Comparison, metric: str) -> pd.DataFrame:
    overall = comparison.overall
    return overall[overall["metric"] == metric]

"""The answer in words: which configuration wins, by how much, how sure that is, and what cannot be said."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pandas as pd

from copem_replay.core.text import counted
from copem_replay.metrics.fixed import NOTHING_DRAWN
from copem_replay.metrics.intervals import FEWEST_CLUSTERS
from copem_replay.report.figures.captions import per_cent, plain
from copem_replay.report.figures.contenders import RANKED_BY, measured_elsewhere
from copem_replay.report.html.headers import signed_difference
from copem_replay.report.html.markup import Html, joined, listed, tag, text
from copem_replay.report.html.setup import some, together
from copem_replay.report.html.study import Study
from copem_replay.report.html.ties import at_once, why_no_interval
from copem_replay.results.compare import Comparison
from copem_replay.results.compare.limits import ALL_ALIKE
from copem_replay.results.compare.tables import NOTHING

_INTERVAL = re.compile(r"(?:[^\s(]+ (?:s|%|percentage points) )?\[[^\[\]<]*\]")


def lead(study: Study) -> Html:
    """The answer in a sentence or two."""
    if study.best is None:
        return tag("p", "There is no answer: no measured object has an onset.", class_="lead")
    return tag("p", next(_sentences(study)), class_="lead")


def more(study: Study) -> Html:
    """All that has to be said besides, the most important first."""
    if study.best is None:
        return listed(str(note) for note in study.provenance.get("notes", []))
    _, *others = _sentences(study)
    return listed(map(_held_together, others))


def _held_together(sentence: str) -> Html:
    """No line breaks between a value and its interval, nor within."""
    return Html(_INTERVAL.sub(lambda found: tag("span", Html(found[0]), class_="tight"), text(sentence)))


def _sentences(study: Study) -> Iterator[str]:
    rows = study.results.summary.set_index("configuration")
    contenders = study.contenders
    share = rows["detected_share"].astype(float)
    if (share[list(study.names)] == 0).all():
        yield "No configuration detects any measured object in any run."
    elif (share[list(contenders)] == 0).all():
        yield "Only the ground truth holds the measured objects: no configuration detects any of them in any run."
    else:
        yield _soonest(study)
        yield from _elsewhere(study)
        yield from _others(study)
        yield from _detected(study, share)
    yield from _passes(study)
    yield from _truth(study)
    yield from _how_sure(study)
    yield from _left_out(study)


def _soonest(study: Study) -> Html:
    assert study.best is not None
    mean_s, horizon_s = (float(study.of(study.best)[key]) for key in (RANKED_BY, "ttd_rmst_horizon_s"))
    missed = (study.results.summary["detected_share"] < 1).any()
    counted_as = f" (an object that is never detected counts as {plain(horizon_s)} s)" if missed else ""
    name = tag("b", study.best)
    if study.lead is None:
        alone = "it is the only configuration" if len(study.names) == 1 else "only the ground truth is beside it"
        return joined([name, f" detects after {plain(mean_s)} s on average{counted_as}. There is nothing to compare "
                       f"it with: {alone}."])  # fmt: skip
    same = study.as_soon
    if len(same) == 1:
        return _first(study, name, mean_s, counted_as)
    _, alike, sooner, unsure = _told_apart(study.lead)
    when = "every object at its onset"
    if not at_once(study):
        when = f"at the same times: after {plain(mean_s)} s on average{counted_as}"
    rest = len(study.lead.configurations) + 1 - len(same)
    undecided = sum(name not in same for rows in (alike, sooner) for name in rows["configuration"])
    others = f"the other {rest}" if rest > 1 else "the other"
    below = f" {others[:1].upper()}{others[1:]} {'are' if rest > 1 else 'is'} below." if rest else ""
    if undecided:
        to = others if undecided == rest else f"{undecided} of {others}"
        below = f" The interval of their difference to {to} includes 0."
    return joined([_missing(study, unsure), tag("b", together(same)), f" detect {when}.{below}"])


def _elsewhere(study: Study) -> Iterator[str]:
    """Configurations that some logs leave out."""
    if fewer := measured_elsewhere(study.results, study.contenders):
        yield (
            f"{together(list(fewer))} {'is' if len(fewer) == 1 else 'are'} ranked last: some logs lack the units, and "
            "means and shares are over the others alone. Differences are over what both have."
        )


def _missing(study: Study, unsure: pd.DataFrame) -> str:
    """That differences have no interval, and why: before anything is said of them."""
    if not len(unsure):
        return ""
    assert study.lead is not None
    same = study.as_soon
    every = all(rows["configuration"].isin(same).all() for rows in _told_apart(study.lead)[:3])
    apart = unsure[unsure["difference"].abs() > NOTHING]
    of = "" if every else f" of the difference to {together(list((apart if len(apart) else unsure)['configuration']))}"
    return f"No interval{of}: {why_no_interval(study, unsure)}. "


def _first(study: Study, name: Html, mean_s: float, counted_as: str) -> Html:
    """Where no other detects at the same times as the best. That there is no interval is said before which it is."""
    assert study.lead is not None
    later, alike, sooner, unsure = _told_apart(study.lead)
    undecided, others = len(alike) + len(sooner), len(study.lead.configurations)
    before = _missing(study, unsure)
    level = list(unsure.loc[unsure["difference"].abs() <= NOTHING, "configuration"])
    if level:
        names = tag("b", together([str(study.best), *level]))
        return joined([before, names, f" have the same mean time, {plain(mean_s)} s{counted_as}, though they do not "
                       "always detect at the same time."])  # fmt: skip
    rivals = f"the other {others}" if others > 1 else study.lead.configurations[0]
    has, sure = f" has the shortest mean time, {plain(mean_s)} s", ""
    if len(later) == others:
        has, sure = f" detects soonest, after {plain(mean_s)} s on average", f", sooner than {rivals}"
    elif undecided:
        to = f"{undecided} of {rivals}" if undecided < others else rivals
        sure = f", but the interval of its difference to {to} includes 0"
    return joined([before, name, f"{has}{counted_as}{sure}."])


def _told_apart(lead: Comparison) -> tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame, pd.DataFrame]:
    """Differences to the best: that are later, cannot be told from none, are sooner, and have no interval."""
    rows = _of(lead, RANKED_BY)
    rows = rows[rows["difference"].notna()].sort_values("difference", kind="stable")
    same = rows["interval"].isin([ALL_ALIKE, NOTHING_DRAWN]) & (rows["difference"].abs() <= NOTHING)
    unsure = (rows["interval_over"].isna() | rows["low"].isna() | rows["high"].isna()) & ~same
    later = ~unsure & (rows["low"] > NOTHING)
    sooner = ~unsure & (rows["high"] < -NOTHING)
    return rows[later], rows[~unsure & ~later & ~sooner], rows[sooner], rows[unsure]


def _others(study: Study) -> Iterator[str]:
    """The others by whether their difference to the best can be told from none."""
    if study.lead is None:
        return
    same = study.as_soon
    later, alike, sooner, unsure = (rows[~rows["configuration"].isin(same)] for rows in _told_apart(study.lead))
    unsure = unsure[unsure["difference"].abs() > NOTHING]
    if len(later):
        yield f"Later, the interval of the difference excluding 0: {_each(later)}."
    if len(alike):
        yield (
            f"No difference to it is shown, the interval including 0: {_each(alike)}. That does not show that there is "
            "none."
        )
    if len(sooner):  # by pairs a mean over censored times may rank the other way round
        yield f"Sooner by pairs, though later in the table: {_each(sooner)}."
    for said, rows in (
        ("Later", unsure[unsure["difference"] > 0]),
        ("Sooner by pairs", unsure[unsure["difference"] < 0]),
    ):
        if len(rows):
            yield f"{said}, without an interval: {_each(rows)}."
    if len(later) and len(study.contenders) > 2:
        one = len(same) == 1
        yield (
            f"The same figures pick the {'winner, which flatters it' if one else 'winners, which flatters them'} a "
            "little."
        )


def _each(rows: pd.DataFrame) -> str:
    return some([f"{row.configuration} ({_difference(row)})" for row in rows.itertuples(index=False)])


def _difference(row: Any, unit: str = " s") -> str:
    shown = signed_difference("", row.difference) + unit
    if pd.isna(row.interval_over) or pd.isna(row.low) or pd.isna(row.high):
        return shown
    return f"{shown} [{plain(row.low)}, {plain(row.high)}]"


def _unsure(row: Any) -> str:
    if pd.isna(row.interval_over) or pd.isna(row.low) or pd.isna(row.high):
        return ", without an interval"
    if row.low <= NOTHING and row.high >= -NOTHING:
        return ": the interval includes 0, so no difference can be shown"
    return ""


def _detected(study: Study, share: pd.Series) -> Iterator[str]:
    never = [name for name in study.contenders if share[name] == 0]
    if never:
        yield f"{together(never)} never {'detects' if len(never) == 1 else 'detect'} any object."
    if (share[list(study.contenders)] == 1).all():
        yield "Every configuration detects every measured object in every run."
        return
    missed = [(name, 1 - float(share[name])) for name in study.contenders if 0 < share[name] < 1]
    if missed:
        worst, least = max(missed, key=lambda one: one[1]), min(missed, key=lambda one: one[1])
        rows = "of the rows (objects × runs)"
        if per_cent(worst[1]) == per_cent(least[1]):
            named = together([name for name, _ in missed])
            yield (
                f"{named} {'each miss' if len(missed) > 1 else 'misses'} {per_cent(worst[1])} % {rows}; Never detected "
                "names the objects."
            )
        else:
            yield (
                f"{len(missed)} configurations miss some objects, from {least[0]} with {per_cent(least[1])} % to "
                f"{worst[0]} with {per_cent(worst[1])} % {rows}; Never detected names the objects."
            )


def _passes(study: Study) -> Iterator[str]:
    rows = study.results.summary.set_index("configuration")
    if "pass_share" not in rows:
        return
    judged = rows.loc[[name for name in study.contenders if pd.notna(rows.loc[name, "pass_share"])]]
    if not len(judged):
        yield "Braking: no object is in conflict with the ego, so there is nothing to judge."
        return
    share = judged["pass_share"].astype(float)
    best, worst = str(share.idxmax()), str(share.idxmin())
    alike, last = ([str(name) for name in share.index[share == share[one]]] for one in (best, worst))
    said = f"Braking: of {counted(int(judged.loc[best, 'n_conflict']), 'row')} in conflict "
    said += f"{_share(judged.loc[best])} pass with {some(alike)}"
    if len(alike) < len(share):
        said += f", {_share(judged.loc[worst])} with {some(last)}"
    if study.regret is not None and study.baseline not in alike:
        found = _of(study.regret, "pass_share").set_index("configuration")
        if best in found.index and pd.notna(found.loc[best, "difference"]):
            row = found.loc[best]
            points = row.copy()
            points[["difference", "low", "high"]] = 100 * row[["difference", "low", "high"]].astype(float)
            said += f"; {best} against {study.baseline} {_difference(points, ' percentage points')}{_unsure(points)}"
    yield said + "."


def _share(row: Any) -> str:
    low, high = row["pass_share_low"], row["pass_share_high"]
    shown = f"{per_cent(float(row['pass_share']))} %"
    return shown if pd.isna(low) else f"{shown} [{per_cent(float(low))}, {per_cent(float(high))}]"


def _truth(study: Study) -> Iterator[str]:
    truth = [name for name in study.names if name not in study.contenders]
    if truth:
        yield f"{together(truth)} {'is' if len(truth) == 1 else 'are'} the ground truth: the upper bound, not ranked."


def _how_sure(study: Study) -> Iterator[str]:
    over, kind = (study.results.summary[name].dropna() for name in ("interval_over", "interval"))
    if not len(over) and (kind == NOTHING_DRAWN).any():
        yield (
            "There are no intervals: every run is the same, for recorded lists and the ground truth are not drawn. The "
            "result holds for this one object; additional runs say nothing about other traffic."
        )
        return
    if not len(over):
        yield (
            f"There are no intervals: there are fewer than {FEWEST_CLUSTERS} logs and fewer than {FEWEST_CLUSTERS} "
            "measured objects. The result holds for these objects; additional runs of the same traffic say nothing "
            "about other traffic."
        )
        return
    tells = {
        "runs": "how far other draws of the same models may differ, for this one object in this one log; they say "
        "nothing about other traffic",
        "objects": "how far other objects in traffic of this kind may differ",
        "logs": "how far other recordings of this kind may differ",
    }[str(over.iloc[0])]
    yield f"Intervals are 95 %, in brackets, over {over.iloc[0]}: {tells}."


def _left_out(study: Study) -> Iterator[str]:
    skipped = [str(log["log"]) for log in study.provenance.get("logs_skipped", [])]
    if skipped:
        yield f"In no figure, because the replay failed: {some(skipped)}."
    notes = study.provenance.get("notes", [])
    if notes:
        yield f"{counted(len(notes), 'note')} on recordings and experiment: see Where this comes from."


def _of(comparison: Comparison, metric: str) -> pd.DataFrame:
    overall = comparison.overall
    return overall[overall["metric"] == metric]

"""The answer in words: who wins, by how much, how sure that is, and what cannot be said."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pandas as pd

from copem_replay.core.text import counted
from copem_replay.metrics.fixed import NOTHING_DRAWN
from copem_replay.metrics.intervals import FEWEST_CLUSTERS
from copem_replay.metrics.summary_text import cell
from copem_replay.report.figures.captions import percent
from copem_replay.report.html.markup import Html, joined, listed, tag
from copem_replay.report.html.setup import some, together
from copem_replay.report.html.study import RANKED_BY, Study
from copem_replay.report.html.ties import as_soon_as_the_best, at_once, no_interval
from copem_replay.results.compare import Comparison
from copem_replay.results.compare.limits import ALL_ALIKE
from copem_replay.results.compare.tables import NOTHING, plain, signed


def answer(study: Study) -> Html:
    """All sentences, the most important one first."""
    if study.best is None:
        return joined(
            [
                tag("p", "There is no answer: no measured object has an onset, so nobody was measured.", class_="lead"),
                listed(str(note) for note in study.provenance.get("notes", [])),
            ]
        )
    first, *others = _sentences(study)
    return joined([tag("p", first, class_="lead"), listed(others)])


def _sentences(study: Study) -> Iterator[str]:
    rows = study.results.summary.set_index("configuration")
    contenders = study.contenders
    share = rows["detected_share"].astype(float)
    if (share[list(study.names)] == 0).all():
        yield "Nothing was detected: no configuration came to know of any measured object in any run."
    elif (share[list(contenders)] == 0).all():
        yield "Nothing was detected but by the truth itself: no other configuration came to know of anybody in any run."
    else:
        yield _soonest(study)
        yield from _others(study)
        yield from _against_baseline(study)
        yield from _detected(study, share)
    yield from _passes(study)
    yield from _accuracy(study)
    yield from _truth(study)
    yield _how_sure(study)
    yield from _left_out(study)


def _soonest(study: Study) -> Html:
    assert study.best is not None
    mean_s, horizon_s = (float(study.of(study.best)[key]) for key in (RANKED_BY, "ttd_rmst_horizon_s"))
    counted_as = f"never detected counting as {cell(horizon_s)} s"
    name = tag("b", study.best)
    if study.lead is None:
        alone = "it is the only configuration" if len(study.names) == 1 else "only the truth stands beside it"
        return joined([name, f" knew after {cell(mean_s)} s on the average ({counted_as}). There is nothing to compare "
                       f"it with: {alone}."])  # fmt: skip
    same = as_soon_as_the_best(study)
    if len(same) == 1:
        return _first(study, name, mean_s, counted_as)
    unsure = _told_apart(study.lead)[3]
    unsure = unsure[unsure["configuration"].isin(same)]
    when = (
        "at once" if at_once(study) else f"at the very same times: after {cell(mean_s)} s on the average ({counted_as})"
    )
    why = f"; {no_interval(study, unsure)}" if len(unsure) else ""
    rest = len(study.lead.configurations) + 1 - len(same)
    whom = f" The other {rest} are below." if rest > 1 else " The other is below." if rest else ""
    return joined([tag("b", together(same)), f" knew {when}{why}.{whom}"])


def _first(study: Study, name: Html, mean_s: float, counted_as: str) -> Html:
    """Where no other knew at the same times as the best. That there is no interval is said before who it is."""
    assert study.lead is not None
    later, alike, sooner, unsure = _told_apart(study.lead)
    undecided, others = len(alike) + len(sooner), len(study.lead.configurations)
    before = ""
    if len(unsure):
        why = no_interval(study, unsure)
        of = f" of the difference to {some(list(unsure['configuration']))}" if len(unsure) < others else ""
        before = f"{why[:1].upper()}{why[1:]}{of}. "
    level = list(unsure.loc[unsure["difference"].abs() <= NOTHING, "configuration"])
    if level:
        names = tag("b", together([str(study.best), *level]))
        return joined([before, names, f" have the same mean time, {cell(mean_s)} s ({counted_as}), though they did not "
                       "always know at the same time."])  # fmt: skip
    whom = f"the other {others}" if others > 1 else study.lead.configurations[0]
    has, sure = f" has the shortest mean time, {cell(mean_s)} s", ""
    if len(later) == others:
        has, sure = f" knew soonest, after {cell(mean_s)} s on the average", f", sooner than {whom}"
    elif undecided:
        sure = f", but cannot be told from {f'{undecided} of ' if undecided < others else ''}{whom}"
    return joined([before, name, f"{has} ({counted_as}){sure}."])


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
    same = as_soon_as_the_best(study)
    later, alike, sooner, unsure = (rows[~rows["configuration"].isin(same)] for rows in _told_apart(study.lead))
    unsure = unsure[unsure["difference"].abs() > NOTHING]
    if len(later):
        yield f"Later than that, the interval of the difference excluding 0: {_each(later)}."
    if len(alike):
        yield (
            f"No difference to it can be shown, the interval including 0: {_each(alike)}. That is not to say that "
            "there is none."
        )
    if len(sooner):  # by pairs a mean over censored times may rank the other way round
        yield f"Sooner by pairs, though later in the table: {_each(sooner)}."
    if len(unsure):
        yield f"After it, by differences without an interval: {_each(unsure)}."
    if len(later) and len(study.contenders) > 2:
        one = len(same) == 1
        yield (
            f"The {'winner was' if one else 'winners were'} picked by these same figures, which flatters "
            f"{'it' if one else 'them'} a little."
        )


def _each(rows: pd.DataFrame) -> str:
    return some([f"{row.configuration} ({_difference(row)})" for row in rows.itertuples(index=False)])


def _difference(row: Any, unit: str = " s") -> str:
    shown = f"{signed(row.difference)}{unit}"
    if pd.isna(row.interval_over) or pd.isna(row.low) or pd.isna(row.high):
        return shown
    return f"{shown} [{plain(row.low)}, {plain(row.high)}]"


def _against_baseline(study: Study) -> Iterator[str]:
    if study.regret is None or study.baseline in study.contenders:  # among whom it is said already
        return
    row = _of(study.regret, RANKED_BY).set_index("configuration").loc[study.best]
    if pd.isna(row["difference"]):
        return
    yield f"{study.best} against {study.baseline}, the baseline: {_difference(row)} in the mean time{_unsure(row)}."


def _unsure(row: Any) -> str:
    if pd.isna(row.interval_over) or pd.isna(row.low) or pd.isna(row.high):
        return ", without an interval"
    if row.low <= NOTHING and row.high >= -NOTHING:
        return ": the interval includes 0, so no difference can be shown"
    return ""


def _detected(study: Study, share: pd.Series) -> Iterator[str]:
    never = [name for name in study.contenders if share[name] == 0]
    if never:
        yield f"Never knew of anybody: {some(never)}."
    if (share[list(study.contenders)] == 1).all():
        yield "Everybody was detected in every run, in every configuration."
        return
    missed = [(name, 1 - float(share[name])) for name in study.contenders if 0 < share[name] < 1]
    if missed:
        worst, least = max(missed, key=lambda one: one[1]), min(missed, key=lambda one: one[1])
        rows = "of the rows (objects × runs) never detected"
        if percent(worst[1]) == percent(least[1]):
            whom = some([name for name, _ in missed])
            yield f"{whom}: {'each ' if len(missed) > 1 else ''}{percent(worst[1])} {rows}. Who that is, is said below."
        else:
            yield (
                f"{len(missed)} configurations missed somebody, from {least[0]} with {percent(least[1])} to {worst[0]} "
                f"with {percent(worst[1])} {rows}. Who that is, is said below."
            )


def _passes(study: Study) -> Iterator[str]:
    rows = study.results.summary.set_index("configuration")
    if "pass_share" not in rows:
        return
    judged = rows.loc[[name for name in study.contenders if pd.notna(rows.loc[name, "pass_share"])]]
    if not len(judged):
        yield "Braking: nobody is in conflict with the ego, so there is nothing to judge."
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
    shown = percent(float(row["pass_share"]))
    return shown if pd.isna(low) else f"{shown} [{percent(float(low))}, {percent(float(high))}]"


def _accuracy(study: Study) -> Iterator[str]:
    rows = study.results.summary.set_index("configuration")
    if "gospa_m" not in rows:
        return
    known = rows.loc[list(study.contenders), "gospa_m"].dropna().astype(float)
    own = rows.loc[known.index, "list_rate_hz"].round(2).nunique() > 1
    more = "; each over its own lists, of which some have more than others" if own else ""
    if len(known) > 1 and known.min() < known.max():
        best, worst = (list(known.index[(known - one).abs() <= NOTHING]) for one in (known.min(), known.max()))
        yield (
            "The best lists, places, misses and false entries taken together, by means without an interval, had "
            f"{together(best)}: GOSPA {cell(known.min())} m, against {cell(known.max())} m with {together(worst)}"
            f"{more}."
        )


def _truth(study: Study) -> Iterator[str]:
    truth = [name for name in study.names if name not in study.contenders]
    if truth:
        yield f"{', '.join(truth)}: the truth itself, what could be had at best; no contender."


def _how_sure(study: Study) -> str:
    over, kind = (study.results.summary[name].dropna() for name in ("interval_over", "interval"))
    if not len(over) and (kind == NOTHING_DRAWN).any():
        return (
            "How sure: there are no intervals, for every run is the same: recorded lists and the truth are not drawn. "
            "What is said holds for this one object; more runs would not tell about other traffic."
        )
    if not len(over):
        return (
            f"How sure: there are no intervals, for there are fewer than {FEWEST_CLUSTERS} logs and fewer than "
            f"{FEWEST_CLUSTERS} measured objects. What is said holds for these objects; more runs would not tell about "
            "other traffic."
        )
    tells = {
        "runs": "how far other draws of the same models might differ, for this one object in this one log; they do not "
        "tell about other traffic",
        "objects": "how far other objects in traffic of this kind might differ",
        "logs": "how far other recordings of this kind might differ",
    }[str(over.iloc[0])]
    return (
        f"How sure: intervals are 95 %, in brackets, over {over.iloc[0]}. They say {tells}. A difference that is "
        "the same throughout has none: how it varies is not known."
    )


def _left_out(study: Study) -> Iterator[str]:
    skipped = [str(log["log"]) for log in study.provenance.get("logs_skipped", [])]
    if skipped:
        yield f"In no figure, for it could not be replayed: {some(skipped)}."
    notes = study.provenance.get("notes", [])
    if notes:
        yield f"{counted(len(notes), 'note')} on recordings and experiment: see Notes."


def _of(comparison: Comparison, metric: str) -> pd.DataFrame:
    overall = comparison.overall
    return overall[overall["metric"] == metric]

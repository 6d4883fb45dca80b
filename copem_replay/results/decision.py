"""Decision: what results say, in a few sentences for those who decide; the report begins with it, the terminal ends so.

With criteria it is their verdicts. Else it is by the share of conflicts that pass, where it differs, else by the mean
time to detection, in parts (`_tell_parts`): what cooperation brings against the car alone, what fusion costs against
the ideal of the same lists, what latency costs. Without a car alone, or where a baseline is named, each configuration
is held against the baseline. Each pair is judged by the 95 % interval of its own difference, over its own rows; without
an interval nothing is claimed. Whoever brakes for nothing for longer than the baseline is named after that, and is
never among the best.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from copem_replay.core.errors import count_noun
from copem_replay.experiment.schema import Configuration, Experiment
from copem_replay.metrics.braking.driving import SHARE
from copem_replay.metrics.columns import NEEDLESS
from copem_replay.metrics.config import DUPLICATE_ENTRY, GHOST_ENTRY, LATE, MISPLACED
from copem_replay.metrics.limits import ALL_ALIKE, CLUSTERS, format_limit, format_limits
from copem_replay.results.compare import Comparison, compare_folders
from copem_replay.results.compare.compare import PairsAsked
from copem_replay.results.compare.labels import find_alone
from copem_replay.results.compare.limits import BETTER, OPEN, WORSE
from copem_replay.results.compare.tables import NOTHING
from copem_replay.results.verdicts import NOT_MET, Judgement

if TYPE_CHECKING:
    from copem_replay.results.read import Results


MATTERS = {
    "ttd_rmst_s": 0.05,  # half of the time between two lists at 10 Hz
    "pass_share": 0.005, SHARE: 0.005, "position_rmse_held_m": 0.05, "false_positives_per_min": 0.1,
}  # fmt: skip
"""The least difference of a figure that matters: smaller ones name no winner."""
DECIDED_BY = ("ttd_rmst_s", "pass_share")
"""Metrics that a decision is about."""
_SAME = "same"
"""The word of a pair whose figures are the same throughout, so that there is no interval."""
_NEAR = "near"
"""The word of a pair whose difference is shown to be smaller than what matters."""
_ALIKE = "alike"
"""The word of a pair whose difference is the same in all rows, so that there is no interval."""
_AT_A_PRICE = "at a price"
"""The word of a pair that is better and brakes for nothing."""
_CAUSES = {
    GHOST_ENTRY: "entries about nobody", DUPLICATE_ENTRY: "second entries of true objects",
    LATE: "old entries", MISPLACED: "misplaced true objects",
}  # fmt: skip
_NAMED = 4
"""Most configurations that are named with their figures: more make a sentence hard to read."""
_IDEAL = "the ideal of the same lists"
_OVERALL = PairsAsked(by_log=False)


@dataclass(frozen=True)
class Decision:
    """`sentences`: one a part; `best`: the configurations with the best figure, several if no difference matters."""

    sentences: tuple[str, ...]
    best: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        """All of it."""
        return " ".join(self.sentences)


def decide(results: Results, comparison: Comparison | None = None, verdicts: Judgement | None = None) -> Decision:
    """The decision on results. `comparison`: to their baseline, with `DECIDED_BY`; None: it is made here.

    `verdicts`: of criteria, which are the sentence where there are any.
    """
    if not len(results.known):
        return Decision(("There is no answer: no measured object has an onset.",))
    names = [name for name, facts in results.facts.items() if not facts.truth] or list(results.facts)
    share = results.summary.set_index("configuration")["detected_share"]
    if not share[names].any():
        others = "" if len(names) == len(results.facts) else " (only the ground truth has them)"
        decision = Decision((f"No configuration detects any measured object in any run{others}.",))
    elif len(names) == 1:
        decision = _describe_single(results, names[0])
    else:
        driven = (SHARE,) if SHARE in results.summary else ()
        comparison = comparison or compare_folders([results], metrics=(*DECIDED_BY, *driven), asked=_OVERALL)
        compared = [name for name in names if name in (comparison.baseline, *comparison.configurations)]
        parts = () if comparison.baseline_why is None else tuple(_tell_parts(results, comparison, compared))
        decision = decide_compared(comparison, results, parts)
    return decision if verdicts is None else Decision((describe_verdicts(verdicts),), decision.best)


def describe_verdicts(verdicts: Judgement) -> str:
    """Whether results are good enough by all criteria; of those that do not pass, the first is named."""
    number, failing = len(verdicts.all), [one for one in verdicts.all if not one.passes]
    if not failing:
        return "Good enough: the one verdict passes." if number == 1 else f"Good enough: all {number} verdicts pass."
    refuted = [one for one in failing if one.verdict == NOT_MET]
    worst = (refuted or failing)[0]
    head = "Not good enough" if refuted else "Not shown to be good enough"
    more = f", and {len(failing) - 1} more" if len(failing) > 1 else ""
    return (
        f"{head}: {len(failing)} of {number} verdicts do{'es' * (len(failing) == 1)} not pass: {worst.name} with "
        f"{worst.configuration} is {worst.verdict} (asked: {worst.asked}, found: {worst.found}){more}."
    )


def _describe_single(results: Results, name: str) -> Decision:
    row = results.summary.set_index("configuration").loc[name]
    figures = [_Scale(metric).say(float(row[metric])) for metric in DECIDED_BY if pd.notna(row.get(metric))]
    return Decision((f"{name}: {', and '.join(figures)}; there is nothing to compare it with.",), (name,))


# Of several configurations.


@dataclass(frozen=True)
class _Scale:
    """A metric that decides: how its values are said, and which differences matter."""

    metric: str

    @property
    def is_share(self) -> bool:
        return self.metric == "pass_share"

    def matters(self, difference: float) -> bool:
        return abs(difference) >= MATTERS[self.metric]

    @property
    def least(self) -> str:
        """The least difference that matters, in words."""
        least = MATTERS[self.metric]
        return f"{100 * least:g} percentage points" if self.is_share else f"{least:g} s"

    def gain(self, difference: float) -> float:
        """A difference whose sign is that of the gain."""
        return difference if self.is_share else -difference

    def number(self, value: float) -> str:
        """`85 %`, `0.73 s`; 0 and 100 % only for none and all."""
        if not self.is_share:
            return f"{round(value, 2) + 0.0:.2f} s".replace("-", "−")
        return f"{100 * value:.0f} %" if 0.005 <= value < 0.995 or value in (0, 1) else _format_edge(value)

    def tell_difference(self, pair: _JudgedPair) -> str:
        """`by 0.12 s [0.05, 0.20]`; if not shown or without interval `0.12 s sooner [-0.01, 0.25]`; “”: the same."""
        if pair.word in (_SAME, _NEAR):
            return ""
        claimed = pair.word in (BETTER, WORSE)
        if self.is_share:
            size, limits = 100 * pair.difference, tuple(100 * limit for limit in pair.limits)
            unit, limits = " percentage points", tuple(sorted(map(abs, limits))) if claimed else limits
            text = format_limit(abs(size)) if claimed else f"{'+' if size > 0 else ''}{format_limit(size)}"
            shown = f"{text}{unit} {format_limits(*limits)}"
        else:
            text = tell_seconds(pair.difference, *pair.limits)
            shown = text.replace(" later", "").replace(" sooner", "") if claimed else text
        shown = shown if pair.word else shown.partition(" [")[0]
        return f"by {shown}" if claimed else shown

    def say(self, value: float) -> str:
        """`85 % of conflicts pass`, `an object is known after 0.73 s on average`."""
        number = self.number(value)
        return f"{number} of conflicts pass" if self.is_share else f"an object is known after {number} on average"


def tell_seconds(difference_s: float, low_s: float = np.nan, high_s: float = np.nan) -> str:
    """`0.12 s sooner [-0.01, 0.25]`: a difference of times, and its interval in the direction that the word says."""
    turn = 1 if difference_s > 0 else -1
    limits = sorted(round(turn * limit_s, 2) + 0.0 for limit_s in (low_s, high_s))
    told = f"{abs(difference_s):.2f} s {'later' if difference_s > 0 else 'sooner'}"
    return told if np.isnan(limits).any() else f"{told} [{limits[0]:.2f}, {limits[1]:.2f}]"


def _format_edge(share: float) -> str:
    if 0.0005 <= share < 0.9995:
        return f"{100 * share:.1f} %"
    return "< 0.1 %" if share < 0.5 else "> 99.9 %"


def decide_compared(comparison: Comparison, results: Results | None = None, parts: Sequence[str] = ()) -> Decision:
    """The decision on a comparison. `results`: of the one folder that is compared. `parts`: sentences that stand in
    place of the differences to the baseline.

    The ground truth is no choice.
    """
    scale, pairs = _judge_pairs(comparison)
    if comparison.baseline in comparison.truths:
        return Decision((f"There is no answer: nothing can be held against {comparison.baseline}, the truth.",))
    if not pairs:
        return Decision((f"There is no answer: no log has both {comparison.baseline} and another configuration.",))
    brakers, braking = _tell_needless(comparison, results)
    gains = {name: scale.gain(pair.difference) for name, pair in pairs.items()} | {comparison.baseline: 0.0}
    gains = {name: gain for name, gain in gains.items() if name not in brakers}
    best = [name for name, gain in gains.items() if not scale.matters(max(gains.values()) - gain)]
    if comparison.baseline in gains and any(name in pairs and pairs[name].word == OPEN for name in best):
        best = [*dict.fromkeys([*best, comparison.baseline])]
    if not parts:
        words = _tell_latencies(comparison.baseline, pairs, scale, None if results is None else results.experiment)
        parts = (f"{words or _tell_groups(comparison.baseline, pairs, scale, brakers)}.",)
    return Decision((*parts, *([braking] if braking else [])), tuple(best))


def _judge_pairs(comparison: Comparison, scale: _Scale | None = None) -> tuple[_Scale, dict[str, _JudgedPair]]:
    """What decides, and each configuration but the truth against the baseline, where both have rows."""
    rows = comparison.overall[~comparison.overall["configuration"].isin(comparison.truths)]
    rows = rows[rows["difference"].notna()]
    scale = scale or _choose_scale(rows)
    rows = rows[rows["metric"] == scale.metric]
    return scale, {str(row.configuration): _JudgedPair.of(row, scale) for row in rows.itertuples(index=False)}


def _choose_scale(rows: pd.DataFrame) -> _Scale:
    """The share that passes where it differs at all, else the mean time."""
    differences = rows.loc[rows["metric"] == "pass_share", "difference"]
    return _Scale("pass_share" if (differences.abs() > NOTHING).any() else "ttd_rmst_s")


@dataclass(frozen=True)
class _JudgedPair:
    """A configuration held against the baseline over the rows of both: the values, their difference, its limits.

    `word`: what the interval of this very difference shows; empty: there is none, and a difference. `over`: what the
    interval is over, and how many, `11 objects`; empty: nothing.
    """

    value: float
    base: float
    difference: float
    limits: tuple[float, float]
    word: str
    over: str = ""

    @staticmethod
    def of(row: Any, scale: _Scale) -> _JudgedPair:
        """The pair of a comparison's row with its word: better, worse, open, the same, near, alike, “” (no limits)."""
        limits = (float(row.low), float(row.high))
        gains = [scale.gain(limit) for limit in limits]
        word = OPEN if min(gains) <= NOTHING and max(gains) >= -NOTHING else BETTER if min(gains) > 0 else WORSE
        if np.isnan(limits).any():
            alike = getattr(row, "interval", None) == ALL_ALIKE
            word = _SAME if abs(row.difference) < NOTHING else _ALIKE if alike else ""
        elif not scale.matters(max(gains, key=abs)):
            word = _NEAR
        kind, number = getattr(row, "interval_over", None), getattr(row, "clusters", np.nan)
        over = "" if pd.isna(kind) or pd.isna(number) else count_noun(int(number), CLUSTERS[str(kind)][0], str(kind))
        return _JudgedPair(float(row.value), float(row.baseline_value), float(row.difference), limits, word, over)


def _tell_groups(baseline: str, pairs: Mapping[str, _JudgedPair], scale: _Scale, brakers: Collection[str] = ()) -> str:
    """Who is better than the baseline, who is worse, of whom no difference is shown, and of whom none can be.
    `brakers`, who brake for nothing, are named apart as “better, but braking for nothing”.
    """
    better, worse = ("Better", "Worse") if scale.is_share else ("Sooner", "Later")
    bases = [pair.base for pair in pairs.values()]
    baseline_words = (
        f"{baseline} ({scale.say(bases[0]).removeprefix('an object is ')})"
        if max(bases) - min(bases) <= NOTHING
        else baseline
    )
    heads = {
        BETTER: f"{better} than {{}}: ",
        _AT_A_PRICE: f"{better} than {{}}, but braking for nothing: ",
        WORSE: f"{worse} than {{}}: ",
        _SAME: "The same as {}: ",
        _NEAR: f"Within {scale.least} of {{}}: ",
        _ALIKE: "By as much in every pair, against {}: ",
        OPEN: f"No difference to {{}} is shown{_tell_too_few(pairs)}: ",
        "": "On these objects alone, without an interval, against {}: ",
    }
    words = {
        name: _AT_A_PRICE if pair.word == BETTER and name in brakers else pair.word for name, pair in pairs.items()
    }
    parts: list[str] = []
    for word, head in heads.items():
        group = {name: pair for name, pair in pairs.items() if words[name] == word}
        if group:
            told = head.format(baseline if parts else baseline_words) + _list_pairs(group, scale)
            parts.append(told if not parts else told[:1].lower() + told[1:])
    return "; ".join(parts)


def _tell_too_few(pairs: Mapping[str, _JudgedPair]) -> str:
    """`, for 11 objects are too few`; nothing where pairs with an open difference are over different numbers."""
    [*over] = {pair.over for pair in pairs.values() if pair.word == OPEN}
    return f", for {over[0]} are too few" if len(over) == 1 and over[0] else ""


def _list_pairs(pairs: Mapping[str, _JudgedPair], scale: _Scale) -> str:
    """`A and B by 0.12 s [0.05, 0.2], C by …`: best first, equal words joined, after `_NAMED` names “and 3 more”."""
    by_words: dict[str, list[str]] = {}
    for name, pair in sorted(pairs.items(), key=lambda item: -scale.gain(item[1].difference)):
        by_words.setdefault(scale.tell_difference(pair), []).append(name)
    named_count = _NAMED if len(pairs) > _NAMED + 1 else len(pairs)  # one more takes no more room than to say so
    shown, names_left, unnamed_count = [], named_count, len(pairs) - named_count
    for words, names in by_words.items():
        named = names[:names_left]
        names_left -= len(named)
        if named:
            several = len(named) > 1 and (words or unnamed_count <= 0)  # else `and 3 more` ends the list
            listed = f"{', '.join(named[:-1])} and {named[-1]}" if several else ", ".join(named)
            shown.append(f"{listed} {words}".rstrip())
    return ", ".join(shown) + (f" and {unnamed_count} more" if unnamed_count > 0 else "")


# In parts.


def _tell_parts(results: Results, comparison: Comparison, names: Sequence[str]) -> Iterator[str]:
    """What cooperation, fusion (against the ideal of the same lists) and latency bring, a sentence each; then the rest.

    Nothing where no configuration is the car alone or no other unit takes part, unless fusion or latency is all there
    is.
    """
    alone, experiment = find_alone(results, names) or "", results.experiment
    base = {*experiment.units_of(experiment.configurations[alone])} if alone else set()
    inputs = {name: set(experiment.units_of(of)) for name, of in experiment.configurations.items() if name in names}
    on_ego = {unit for unit, of in experiment.units.items() if of.on == "ego"}
    joint = {name for name in names if alone and (inputs[name] - on_ego if base <= on_ego else inputs[name] > base)}
    ideals = {n: str(of.ideal) for n in names if (of := results.facts[n]).ideal_of == "inputs" and of.ideal in names}
    if not joint and (not ideals or {*names} - {*ideals, *ideals.values(), *_find_twins(experiment, names)}):
        return
    (scale, first), brakers = _judge_pairs(comparison), _tell_needless(comparison, None)[0]
    judged: dict[tuple[str, str], _JudgedPair | None] = {(of, comparison.baseline): pair for of, pair in first.items()}
    judge = partial(_hold_against, results, scale=scale, known=judged)
    shown = [name for name in names if name in joint - {*ideals.values()}]
    judge({name: alone for name in names if joint and name not in {alone, *ideals.values()}})  # all at once
    pairs = judge(dict.fromkeys(shown, alone))
    latencies = _tell_latencies(alone, pairs, scale, experiment)
    if pairs:
        sentence = latencies or f"Cooperation: {_start_low(_tell_groups(alone, pairs, scale, brakers))}"
        yield f"{sentence}."
    elif shown:
        yield f"Cooperation: not known, for no log has both {alone} and {' or '.join(shown[:_NAMED])}."
    if ideals and (fused := judge(ideals)):
        [*against] = {*ideals.values()}
        sentence = _tell_groups(against[0] if len(against) == 1 else _IDEAL, fused, scale, brakers)
        yield f"Fusion: {_start_low(sentence)}."
    twins = {} if latencies else _find_twins(experiment, names)
    if late_pairs := judge({name: twin for name, (twin, _) in twins.items()}):
        yield f"Latency: {_tell_costs(late_pairs, twins, scale)}."
    remaining = [name for name in names if name not in {alone, *shown, *ideals, *ideals.values(), *twins}]
    if joint and (remaining_pairs := judge(dict.fromkeys(remaining, alone))):
        yield f"Beside them: {_start_low(_tell_groups(alone, remaining_pairs, scale, brakers))}."


def _start_low(sentence: str) -> str:
    return sentence[:1].lower() + sentence[1:]


def _hold_against(
    results: Results, baseline_of: Mapping[str, str], scale: _Scale, known: dict[tuple[str, str], _JudgedPair | None]
) -> dict[str, _JudgedPair]:
    """Each configuration judged against its baseline, where both have rows. `known`: cache of pairs, filled here."""
    for baseline in dict.fromkeys(pair[1] for pair in baseline_of.items() if pair not in known):
        names = [name for name, other in baseline_of.items() if other == baseline and (name, other) not in known]
        compared = compare_folders(
            [results], configurations=names, baseline=baseline, metrics=(scale.metric,), asked=_OVERALL
        )
        judged = _judge_pairs(compared, scale)[1]
        known.update({(name, baseline): judged.get(name) for name in names})
    return {name: pair for name, other in baseline_of.items() if (pair := known[name, other]) is not None}


def _find_twins(experiment: Experiment, names: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Configurations that differ from one with a smaller latency in nothing else: that one, and `0.4 s more`."""
    twins: dict[str, tuple[str, str]] = {}
    for latencies_s in _group_by_latency(experiment, names):
        first, least_s = next(iter(latencies_s.items()))
        for name, latency_s in latencies_s.items():
            if (more_s := latency_s - least_s) > 0:
                twins[name] = first, f"{more_s:g} s{' more' * (least_s > 0)}"
    return twins


def _group_by_latency(experiment: Experiment, names: Iterable[str]) -> list[dict[str, float]]:
    """Groups of configurations that differ in latency only: name → latency (s), ascending."""
    groups: list[tuple[Configuration, dict[str, float]]] = []
    for name in names:
        configuration = experiment.configurations[name]
        if configuration.recorded is not None or isinstance(configuration.latency_s, dict):
            continue
        without_latency = configuration.model_copy(update={"latency_s": 0.0})
        latencies_s = next((of_alike for of, of_alike in groups if of == without_latency), None)
        if latencies_s is None:
            groups.append((without_latency, latencies_s := {}))
        latencies_s[name] = configuration.latency_s
    return [dict(sorted(latencies_s.items(), key=itemgetter(1))) for _, latencies_s in groups]


def _tell_costs(pairs: Mapping[str, _JudgedPair], twins: Mapping[str, tuple[str, str]], scale: _Scale) -> str:
    """`0.5 s costs 0.51 s [0.50, 0.52] (late against gnn)`; `twins`: by name the same without latency, and it."""
    verbs = {_SAME: "changes nothing", _NEAR: f"changes less than {scale.least}", OPEN: "is not shown to matter:"}
    endings, by_words = {_ALIKE: ", alike in every pair", "": " on these objects alone"}, dict[str, list[str]]()
    for name, pair in pairs.items():
        first, latency = twins[name]
        verb, size = verbs.get(pair.word), scale.tell_difference(pair)
        if verb is None:
            verb = "gains" if scale.gain(pair.difference) > 0 else "costs"
            size = re.sub("^by |^[+-]| later| sooner", "", size)
        words = f"{latency} {verb} {size}".rstrip() + endings.get(pair.word, "")
        by_words.setdefault(words, []).append(f"{name} against {first}")
    sentences = [f"{words} ({', '.join(of[:_NAMED])}{' …' * (len(of) > _NAMED)})" for words, of in by_words.items()]
    more = f"; and {len(sentences) - _NAMED} more" if len(sentences) > _NAMED else ""
    return "; ".join(sentences[:_NAMED]) + more


# Who brakes for nothing.


def _tell_needless(comparison: Comparison, results: Results | None) -> tuple[set[str], str]:
    """Who brakes for nothing longer than the baseline (if that itself does: than the best), and a sentence; “”: nobody.
    Shown by the interval of the difference; where there is none, by the difference.
    """
    rows = comparison.overall[comparison.overall["metric"] == SHARE]
    rows = rows[~rows["configuration"].isin(comparison.truths) & rows["difference"].notna()]
    is_shown = rows["low"].isna() | (rows["low"] > NOTHING) | (rows["high"] < -NOTHING)
    differing = rows[is_shown & (rows["difference"].abs() >= MATTERS[SHARE])]
    shorter, reference = differing[differing["difference"] < 0], comparison.baseline
    brakers = dict(zip(rows["configuration"], rows["value"].astype(float), strict=True))
    if len(shorter):  # the baseline brakes, and with it whoever is not shown to brake less
        best = shorter.loc[shorter["value"].idxmin()]
        reference, least_share = str(best["configuration"]), float(best["value"])
        brakers[comparison.baseline] = float(shorter["baseline_value"].max())
        for name in shorter["configuration"]:
            del brakers[name]
        brakers = {name: share for name, share in brakers.items() if share - least_share >= MATTERS[SHARE]}
    else:
        least_share = float(rows["baseline_value"].min()) if len(rows) else 0.0
        longer = set(differing["configuration"])
        brakers = {name: share for name, share in brakers.items() if name in longer}
    summary = None if results is None or SHARE not in results.summary else results.summary.set_index("configuration")
    names = sorted(brakers, key=lambda name: -brakers[name])
    if not names:
        braking_alike = [] if summary is None else [*summary.index[summary[SHARE] >= MATTERS[SHARE]]]
        because = _explain_braking(results, braking_alike)
        return set(), f"The driver brakes for nothing{because}." if because else ""
    h = 0.0 if summary is None else float(summary["driving_h"].max())
    driving = "the driving time" if summary is None else f"these {3600 * h:.3g} s" if h < 0.25 else f"these {h:.3g} h"
    driving += "" if summary is None else " of driving"
    sentence = f"But with {names[0]} the driver brakes for nothing in {_format_share(brakers[names[0]])} of {driving}"
    sentence += "".join(f", with {name} in {_format_share(brakers[name])}" for name in names[1:_NAMED])
    sentence += f" and with {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    sentence += f" ({reference}: {'never' if least_share == 0 else _format_share(least_share)})"
    if summary is not None:
        sentence += f", losing up to {summary.loc[names, 'needless_speed_lost_max_mps'].max():.3g} m/s at a time"
    return set(brakers), f"{sentence}{_explain_braking(results, names)}."


def _explain_braking(results: Results | None, names: Collection[str]) -> str:
    """` because of old entries`: what these brake for most of the time in which they brake for nothing; “”: unknown."""
    if results is None or not names or not results.has(NEEDLESS):
        return ""
    rows = results.frame(NEEDLESS)
    lasts_s = rows[rows["configuration"].isin(names)].groupby("cause")["lasts_s"].sum()
    return f" mostly because of {_CAUSES[str(lasts_s.idxmax())]}" if len(lasts_s) else ""


def _format_share(share: float) -> str:
    return f"{100 * share:.0f} %" if 0.095 <= share < 0.995 or share == 1 else f"{100 * share:.2g} %"


# Of configurations that differ in nothing but their latency.


def _tell_latencies(
    baseline: str, pairs: Mapping[str, _JudgedPair], scale: _Scale, experiment: Experiment | None
) -> str | None:
    """Up to which latency the others help, from which they are worse; None: latency is not the only difference."""
    groups = [] if experiment is None else _group_by_latency(experiment, pairs)
    if experiment is None or len(groups) != 1 or not len({*groups[0].values()}) == len(pairs) > 1:
        return None
    latencies_s, units = groups[0], {*experiment.units_of(experiment.configurations[next(iter(pairs))])}
    names, judged, order = list(latencies_s), [pairs[name].word for name in latencies_s], [BETTER, OPEN, WORSE]
    bases = [pair.base for pair in pairs.values()]
    if BETTER not in judged or len({*judged}) == 1 or not {*judged} <= {*order}:
        return None  # no latency parts them, or each has to be named
    if sorted(judged, key=order.index) != judged or max(bases) - min(bases) > NOTHING:
        return None  # not in the order of latencies, or not over the same rows: each has to be named
    cooperates = units > set(experiment.units_of(experiment.configurations[baseline]))
    subject, reference = (
        ("cooperation", baseline if "alone" in baseline else f"{baseline} alone")
        if cooperates
        else (names[0].partition(":")[0], baseline)
    )
    parts: list[str] = []
    for word, says in ((BETTER, f"{subject} helps"), (OPEN, f"no difference to {reference} is shown")):
        if word in judged:
            first, *_, last = [name for name in names if pairs[name].word == word] * 2
            at = "up to" if word == BETTER else "at" if first == last else f"from {latencies_s[first]:g} to"
            at = f"{at} {latencies_s[last]:g} s of latency" if latencies_s[last] else "without latency"
            parts.append(f"{at} {says}: {_tell_against(pairs[last], scale, reference, first=not parts)}")
    if WORSE in judged:
        first = names[judged.index(WORSE)]
        sentence = _tell_against(pairs[first], scale, reference, first=not parts)
        parts.append(f"from {latencies_s[first]:g} s of latency on {subject} is worse than {reference}: {sentence}")
    sentence = "; ".join(parts)
    return sentence[:1].upper() + sentence[1:]


def _tell_against(pair: _JudgedPair, scale: _Scale, none: str, *, first: bool) -> str:
    """`an object is known after 0.31 s on average against 0.73 s with PEM alone, by 0.42 s [0.39, 0.44]`."""
    against = f" against {scale.number(pair.base)} with {none}" if first else ""
    return f"{scale.say(pair.value) if first else scale.number(pair.value)}{against}, {scale.tell_difference(pair)}"

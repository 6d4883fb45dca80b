"""Decision: what results say, in one sentence for those who decide; the report begins with it, the terminal ends so.

With criteria the sentence is their verdicts. Else it is by the share of conflicts that pass, where it differs, else by
the mean time to detection: who is better than the baseline, who is worse, of whom no difference is shown, each by the
95 % interval of the difference over the rows of its own pair. Without an interval nothing is claimed. Whoever brakes
for nothing for longer than the baseline is named after that, and is never among the best.

Of one object in one run, what would help the configuration that knows it last: a key of another one, or its units.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from copem_replay.core.errors import count_noun
from copem_replay.core.tracks import SAME_INSTANT_S, TRUTH
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.braking.driving import SHARE
from copem_replay.metrics.limits import format_limit, format_limits
from copem_replay.results.compare import Comparison, compare_folders
from copem_replay.results.compare.limits import BETTER, OPEN, WORSE
from copem_replay.results.compare.tables import NOTHING
from copem_replay.results.verdicts import NOT_MET, Judgement

if TYPE_CHECKING:
    from copem_replay.results.read import Results


MATTERS_S = 0.05
"""Smaller differences of mean times name no winner: half of the time between two lists at 10 Hz."""
MATTERS_SHARE = 0.005
"""Smaller differences of shares name no winner: half of a per cent."""
DECIDED_BY = ("ttd_rmst_s", "pass_share")
"""Metrics that a decision is about."""
_SAME = "same"
"""The word of a pair whose figures are the same throughout, so that there is no interval."""
_NEAR = "near"
"""The word of a pair whose difference is shown, and shown to be smaller than what matters."""
_AT_A_PRICE = "at a price"
"""The word of a pair that is better and brakes for nothing."""
_NAMED = 4
"""Most configurations that are named with their figures: more make a sentence hard to read."""


@dataclass(frozen=True)
class Decision:
    """One sentence, and the configurations with the best figure; several, if their difference does not matter."""

    sentence: str
    best: tuple[str, ...] = ()


def find_brakers(comparison: Comparison) -> set[str]:
    """Who brakes for nothing for longer than the baseline or, where that does, than another."""
    return _tell_needless(comparison, None)[0]


def decide(results: Results, comparison: Comparison | None = None, verdicts: Judgement | None = None) -> Decision:
    """The decision on results. `comparison`: to their baseline, with `DECIDED_BY`; None: it is made here.

    `verdicts`: of criteria, which are the sentence where there are any.
    """
    if not len(results.known):
        return Decision("There is no answer: no measured object has an onset.")
    names = [name for name, facts in results.facts.items() if not facts.truth] or list(results.facts)
    share = results.summary.set_index("configuration")["detected_share"]
    if not share[names].any():
        others = "" if len(names) == len(results.facts) else " (only the ground truth has them)"
        found = Decision(f"No configuration detects any measured object in any run{others}.")
    elif len(names) == 1:
        found = _describe_alone(results, names[0])
    else:
        driven = (SHARE,) if SHARE in results.summary else ()
        comparison = comparison or compare_folders([results], metrics=(*DECIDED_BY, *driven))
        found = decide_compared(comparison, results.experiment, results.summary)
    return found if verdicts is None else Decision(describe_verdicts(verdicts), found.best)


def describe_verdicts(verdicts: Judgement) -> str:
    """Whether results are good enough, by all criteria; of those that do not pass the first is named."""
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


def _describe_alone(results: Results, name: str) -> Decision:
    row = results.summary.set_index("configuration").loc[name]
    figures = [_Scale(metric).say(float(row[metric])) for metric in DECIDED_BY if pd.notna(row.get(metric))]
    return Decision(f"{name}: {', and '.join(figures)}; there is nothing to compare it with.", (name,))


# Of several configurations.


@dataclass(frozen=True)
class _Scale:
    """A metric that decides: how its values are said, and which differences matter."""

    metric: str

    @property
    def is_share(self) -> bool:
        return self.metric == "pass_share"

    def matters(self, difference: float) -> bool:
        return abs(difference) >= (MATTERS_SHARE if self.is_share else MATTERS_S)

    @property
    def least(self) -> str:
        """The least difference that matters, in words."""
        return f"{100 * MATTERS_SHARE:g} percentage points" if self.is_share else f"{MATTERS_S:g} s"

    def gain(self, difference: float) -> float:
        """A difference whose sign is that of the gain."""
        return difference if self.is_share else -difference

    def number(self, value: float) -> str:
        """`85 %`, `0.73 s`; 0 and 100 % only for none and all."""
        if not self.is_share:
            return f"{round(value, 2) + 0.0:.2f} s".replace("-", "−")
        return f"{100 * value:.0f} %" if 0.005 <= value < 0.995 or value in (0, 1) else _format_edge(value)

    def tell_difference(self, pair: _JudgedPair) -> str:
        """`by 0.12 s [0.05, 0.2]`; of one that is not shown, or has no interval, with its sign."""
        times, unit = (100.0, " percentage points") if self.is_share else (1.0, " s")
        size, limits = times * pair.difference, (times * pair.limits[0], times * pair.limits[1])
        if pair.word in (BETTER, WORSE):
            ends = sorted(map(abs, limits))
            return f"by {format_limit(abs(size))}{unit} {format_limits(*ends)}"
        shown = f"{'+' if size > 0 else ''}{format_limit(size)}{unit}"
        return "" if pair.word == _SAME else shown if pair.word == "" else f"{shown} {format_limits(*limits)}"

    def say(self, value: float) -> str:
        """`85 % of conflicts pass`, `an object is known after 0.73 s on average`."""
        number = self.number(value)
        return f"{number} of conflicts pass" if self.is_share else f"an object is known after {number} on average"


def _format_edge(share: float) -> str:
    if 0.0005 <= share < 0.9995:
        return f"{100 * share:.1f} %"
    return "< 0.1 %" if share < 0.5 else "> 99.9 %"


def decide_compared(
    comparison: Comparison, experiment: Experiment | None = None, summary: pd.DataFrame | None = None
) -> Decision:
    """The decision on a comparison. `experiment`, `summary`: of the one folder that is compared, whose latencies it may
    be about.

    The ground truth is no choice.
    """
    rows = comparison.overall[~comparison.overall["configuration"].isin(comparison.truths)]
    rows = rows[rows["difference"].notna()]
    scale = _choose_scale(rows)
    rows = rows[rows["metric"] == scale.metric]
    if not len(rows) or comparison.baseline in comparison.truths:
        return Decision(f"There is no answer: nothing can be held against {comparison.baseline}.")
    pairs = {str(row.configuration): _JudgedPair.of(row, scale) for row in rows.itertuples(index=False)}
    brakers, sentence = _tell_needless(comparison, summary)
    gains = {name: scale.gain(pair.difference) for name, pair in pairs.items()} | {comparison.baseline: 0.0}
    gains = {name: gain for name, gain in gains.items() if name not in brakers}
    best = [name for name, gain in gains.items() if not scale.matters(max(gains.values()) - gain)]
    if comparison.baseline in gains and any(name in pairs and pairs[name].word == OPEN for name in best):
        best = [*dict.fromkeys([*best, comparison.baseline])]
    told = _tell_latencies(comparison.baseline, pairs, scale, experiment)
    return Decision(f"{told or _tell_groups(comparison.baseline, pairs, scale, brakers)}.{sentence}", tuple(best))


def _choose_scale(rows: pd.DataFrame) -> _Scale:
    """The share that passes where it differs at all, else the mean time."""
    differences = rows.loc[rows["metric"] == "pass_share", "difference"]
    return _Scale("pass_share" if (differences.abs() > NOTHING).any() else "ttd_rmst_s")


@dataclass(frozen=True)
class _JudgedPair:
    """A configuration held against the baseline over the rows of both: the values, their difference, its limits.

    `word`: what the interval of this very difference shows; empty: there is none, and a difference.
    """

    value: float
    base: float
    difference: float
    limits: tuple[float, float]
    word: str

    @staticmethod
    def of(row: Any, scale: _Scale) -> _JudgedPair:
        """The pair of a row of a comparison."""
        limits = (float(row.low), float(row.high))
        gains = [scale.gain(limit) for limit in limits]
        word = OPEN if min(gains) <= NOTHING and max(gains) >= -NOTHING else BETTER if min(gains) > 0 else WORSE
        if np.isnan(limits).any():
            word = _SAME if abs(row.difference) < NOTHING else ""
        elif word != OPEN and not scale.matters(max(gains, key=abs)):
            word = _NEAR
        return _JudgedPair(float(row.value), float(row.baseline_value), float(row.difference), limits, word)


def _tell_groups(baseline: str, pairs: Mapping[str, _JudgedPair], scale: _Scale, brakers: Collection[str] = ()) -> str:
    """Who is better than the baseline, who is worse, of whom no difference is shown, of whom nothing can be shown.

    `brakers`, who brake for nothing, do not stand among the better ones.
    """
    better, worse = ("Better", "Worse") if scale.is_share else ("Sooner", "Later")
    bases = [pair.base for pair in pairs.values()]
    held = f"{baseline} ({scale.say(bases[0])})" if max(bases) - min(bases) <= NOTHING else baseline
    heads = {
        BETTER: f"{better} than {{}}: ",
        _AT_A_PRICE: f"{better} than {{}}, but braking for nothing: ",
        WORSE: f"{worse} than {{}}: ",
        _SAME: "The same as {}: ",
        _NEAR: f"Apart from {{}} by less than {scale.least}: ",
        OPEN: "No difference to {} is shown: ",
        "": "No interval, so nothing is shown beyond these very objects, against {}: ",
    }
    words = {
        name: _AT_A_PRICE if pair.word == BETTER and name in brakers else pair.word for name, pair in pairs.items()
    }
    parts: list[str] = []
    for word, head in heads.items():
        group = {name: pair for name, pair in pairs.items() if words[name] == word}
        if group:
            told = head.format(baseline if parts else held) + _list_pairs(group, scale)
            parts.append(told if not parts else told[:1].lower() + told[1:])
    return "; ".join(parts)


def _list_pairs(pairs: Mapping[str, _JudgedPair], scale: _Scale) -> str:
    """`A and B by 0.12 s [0.05, 0.2], C by …`, the best first; those of equal words together, of many the first."""
    by_words: dict[str, list[str]] = {}
    for name, pair in sorted(pairs.items(), key=lambda item: -scale.gain(item[1].difference)):
        by_words.setdefault(scale.tell_difference(pair), []).append(name)
    shown, left = [], _NAMED
    for words, names in by_words.items():
        kept = names[:left]
        left -= len(kept)
        if kept:
            listed = " and ".join([", ".join(kept[:-1])] * (len(kept) > 1) + kept[-1:])
            shown.append(f"{listed} {words}".rstrip())
    more = len(pairs) - _NAMED
    return ", ".join(shown) + (f" and {more} more" if more > 0 else "")


# Who brakes for nothing.


def _tell_needless(comparison: Comparison, summary: pd.DataFrame | None) -> tuple[set[str], str]:
    """Who brakes for nothing for longer than the baseline, or if that does than another; and a sentence, “” of nobody.

    Shown by the interval of the difference; where there is none, of these drives.
    """
    rows = comparison.overall[comparison.overall["metric"] == SHARE]
    rows = rows[~rows["configuration"].isin(comparison.truths) & rows["difference"].notna()]
    shown = rows["low"].isna() | (rows["low"] > NOTHING) | (rows["high"] < -NOTHING)
    apart = rows[shown & (rows["difference"].abs() >= MATTERS_SHARE)]
    shorter, against = apart[apart["difference"] < 0], comparison.baseline
    brakers = dict(zip(rows["configuration"], rows["value"].astype(float), strict=True))
    if len(shorter):  # the baseline brakes, and with it whoever is not shown to brake less
        best = shorter.loc[shorter["value"].idxmin()]
        against, least = str(best["configuration"]), float(best["value"])
        brakers[comparison.baseline] = float(shorter["baseline_value"].max())
        for name in shorter["configuration"]:
            del brakers[name]
        brakers = {name: share for name, share in brakers.items() if share - least >= MATTERS_SHARE}
    else:
        least = float(rows["baseline_value"].min()) if len(rows) else 0.0
        longer = set(apart["configuration"])
        brakers = {name: share for name, share in brakers.items() if name in longer}
    if not brakers:
        return set(), ""
    names, of = sorted(brakers, key=lambda name: -brakers[name]), None
    if summary is not None:
        of = summary.set_index("configuration")
    driving = "the driving time" if of is None else _describe_driving(float(of["driving_h"].max()))
    told = f" But with {names[0]} the driver brakes for nothing in {_format_share(brakers[names[0]])} of {driving}"
    told += "".join(f", with {name} in {_format_share(brakers[name])}" for name in names[1:_NAMED])
    told += f" and with {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    told += f" ({against}: {'never' if least == 0 else _format_share(least)})"
    if of is not None:
        told += f", losing up to {of.loc[names, 'needless_speed_lost_max_mps'].max():.3g} m/s at a time"
    return set(brakers), f"{told}."


def _describe_driving(hours: float) -> str:
    return f"these {3600 * hours:.3g} s of driving" if hours < 0.25 else f"these {hours:.3g} h of driving"


def _format_share(share: float) -> str:
    return f"{100 * share:.0f} %" if 0.095 <= share < 0.995 or share == 1 else f"{100 * share:.2g} %"


# Of configurations that differ in nothing but their latency.


def _tell_latencies(
    baseline: str, pairs: Mapping[str, _JudgedPair], scale: _Scale, experiment: Experiment | None
) -> str | None:
    """Up to which latency the others help, and from which on they are worse; None: they differ in more than that."""
    found = None if experiment is None else _order_by_latency(experiment, baseline, list(pairs))
    if found is None or experiment is None:
        return None
    latencies_s, units = found
    names, judged, order = list(latencies_s), [pairs[name].word for name in latencies_s], [BETTER, OPEN, WORSE]
    bases = [pair.base for pair in pairs.values()]
    if not {*judged} <= {*order} or sorted(judged, key=order.index) != judged or max(bases) - min(bases) > NOTHING:
        return None  # not in the order of latencies, or not over the same rows: each has to be named
    cooperates = units > set(experiment.units_of(experiment.configurations[baseline]))
    what, none = ("cooperation", f"{baseline} alone") if cooperates else (names[0].partition(":")[0], baseline)
    parts: list[str] = []
    for word, says in ((BETTER, f"{what} helps"), (OPEN, f"no difference to {none} is shown")):
        if word in judged:
            last = [name for name in names if pairs[name].word == word][-1]
            up_to = f"up to {latencies_s[last]:g} s of latency" if latencies_s[last] else "without latency"
            parts.append(f"{up_to} {says}: {_tell_against(pairs[last], scale, none, first=not parts)}")
    if WORSE in judged:
        first = names[judged.index(WORSE)]
        told = _tell_against(pairs[first], scale, none, first=not parts)
        parts.append(f"from {latencies_s[first]:g} s of latency on {what} is worse than {none}: {told}")
    told = "; ".join(parts)
    return told[:1].upper() + told[1:]


def _tell_against(pair: _JudgedPair, scale: _Scale, none: str, *, first: bool) -> str:
    """`an object is known after 0.31 s on average against 0.73 s with PEM alone, by 0.42 s [0.39, 0.44]`."""
    against = f" against {scale.number(pair.base)} with {none}" if first else ""
    return f"{scale.say(pair.value) if first else scale.number(pair.value)}{against}, {scale.tell_difference(pair)}"


def _order_by_latency(
    experiment: Experiment, baseline: str, names: Sequence[str]
) -> tuple[dict[str, float], set[str]] | None:
    """Latencies of configurations, the smallest first, and their units; None: they differ in more than one latency."""
    configurations = experiment.configurations
    if len(names) < 2 or not set(names) <= set(configurations):
        return None
    first, *others = (configurations[name].model_copy(update={"latency_s": 0.0}) for name in names)
    latencies_s = {name: configurations[name].latency_s for name in names}
    units = set(experiment.units_of(first))
    if not units or any(other != first for other in others):
        return None
    numbers = {name: latency_s for name, latency_s in latencies_s.items() if not isinstance(latency_s, dict)}
    if len(set(numbers.values())) < len(names):
        return None
    return dict(sorted(numbers.items(), key=itemgetter(1))), units


# Of one object in one run: what would help.

_KEYS = {
    "units": "units", "link": "link", "latency_s": "latency", "fusion": "fusion", "issue_hz": "issue rate",
    "max_age_s": "greatest age",
}  # fmt: skip
"""Keys of configurations that are compared, and their words."""
_MOST_UNITS = 3
"""Most units that a sentence names."""


def tell_what_helps(experiment: Experiment, rows: pd.DataFrame) -> str:
    """What would help the configuration that knows an object last: “What would help PEM: the lists of mast1 as well …”.

    It is another configuration that knows the object earlier, with the same draws, and differs in one key or has more
    units: of those with the fewest other keys the earliest; “” where there is none. `rows`: of one object and run, a
    row per configuration.
    """
    asked = {name: experiment.configurations[name] for name in rows["configuration"]}
    known_s = dict(zip(rows["configuration"], rows["time_to_detection_s"].fillna(np.inf).tolist(), strict=True))
    names = [name for name, one in asked.items() if one.recorded is None and one.units != TRUTH]
    last_s = max((known_s[name] for name in names), default=0.0)
    pairs = [
        (len(keys), known_s[other], last, other, change)
        for last in names
        for other in names
        if known_s[last] == last_s > known_s[other] + SAME_INSTANT_S
        and (change := _describe_change(experiment, keys := _find_changed_keys(experiment, last, other), last, other))
    ]
    if not pairs:
        return ""
    _, best_s, last, best, change = min(pairs, key=itemgetter(0, 1))
    gain = (
        f"{last_s - best_s:.2f} s earlier"
        if np.isfinite(last_s)
        else f"{best_s:.2f} s after the onset instead of never"
    )
    return f"What would help {last}: {change}, as in {best}: known {gain}, with the same draws."


def _find_changed_keys(experiment: Experiment, last: str, other: str) -> list[str]:
    return [key for key in _KEYS if _value_of(experiment, key, last) != _value_of(experiment, key, other)]


def _value_of(experiment: Experiment, key: str, name: str) -> Any:
    asked = experiment.configurations[name]
    return frozenset(experiment.units_of(asked)) if key == "units" else getattr(asked, key)


def _describe_change(experiment: Experiment, keys: Sequence[str], last: str, best: str) -> str:
    """What is better in the other one: “0 s of latency instead of 1.5 s”; “” where much is different."""
    values = {key: (_value_of(experiment, key, last), _value_of(experiment, key, best)) for key in keys}
    old_units, new_units = values.pop("units", (frozenset(), frozenset()))
    rest = f" (and another {' and '.join(_KEYS[key] for key in values)})" if values else ""
    if new_units > old_units:
        return f"the lists of {_name_units(new_units - old_units)} as well{rest}"
    if len(keys) != 1:
        return ""
    if not values:
        return f"the lists of {_name_units(new_units)} instead"
    [(key, (old, new))] = values.items()
    if key == "latency_s" and not isinstance(old, dict) and not isinstance(new, dict):
        return f"{new:g} s of latency instead of {old:g} s"
    if key == "fusion" and old.kind != new.kind:
        return f"fusion {new.kind} instead of {old.kind}"
    return "no link" if key == "link" and new is None else f"another {_KEYS[key]}"


def _name_units(units: frozenset[str]) -> str:
    return ", ".join(sorted(units)) if len(units) <= _MOST_UNITS else count_noun(len(units), "unit")

"""Screens: what `copem-replay why` says on 80 columns and 24 lines; `--explain` has every figure and what it means."""

from __future__ import annotations

from collections.abc import Iterator

import pandas as pd

from copem_replay.core.errors import count_noun, name_first
from copem_replay.extras.why.api import VISIBLE_S, Explanation
from copem_replay.extras.why.causes import describe_cause
from copem_replay.extras.why.sensitivity import AS_IT_IS, describe_orders
from copem_replay.extras.why.triage import LATE_S, TOO_SHORT, describe_structure
from copem_replay.results.screen import tabulate_alike

_MOST_SPARED = 3
"""Lines on what units spare; all are in `units.csv`."""
_NAMED = 3
_HEADERS = {"range": "out of view", "hidden": "hidden", "missed": "missed in sight"}
"""Causes whose words are too long for a header; of others the part before a colon."""


def tell_explanation(explained: Explanation, folder: str, *, one_log: bool) -> Iterator[str]:
    """Lines. `folder`: of the results that `view` opens; `one_log`: they are of one log."""
    if explained.causes is not None:
        yield from [*_tabulate_seconds(explained.causes), ""]
    if explained.units is not None:
        yield from _tell_units(explained.units)
    if explained.triage is not None and explained.causes is not None:
        yield from _tell_late(explained.triage, folder, one_log=one_log)
    if explained.sensitivity is not None and explained.orders is not None:
        yield from _tell_orders(explained.sensitivity, explained.orders)


def _tabulate_seconds(causes: pd.DataFrame) -> list[str]:
    """A table as lines: a row for configurations with equal seconds, a column for each cause that adds any."""
    added = causes.pivot(index="configuration", columns="cause", values="added_s")
    added = added.reindex(index=causes["configuration"].unique(), columns=causes["cause"].unique()).fillna(0.0)
    unknown_s = added.sum(axis=1)
    shown = added.loc[unknown_s.sort_values(kind="stable").index, (added.abs() >= VISIBLE_S).any()]
    seconds = (
        (str(name), [f"{unknown_s[name] + 0.0:.2f}", *(f"{s:.2f}" if abs(s) >= VISIBLE_S else "–" for s in of)])
        for name, of in shown.iterrows()
    )
    heads = [_HEADERS.get(str(cause), describe_cause(str(cause)).partition(":")[0]) for cause in shown]
    lines, _ = tabulate_alike(seconds, ["unknown", *heads], more_in="why.csv")
    return [*lines, "Mean seconds that an object is unknown, to its end: `run` counts up to a limit."]


def _tell_units(units: pd.DataFrame) -> list[str]:
    """Sentences on what units spare beside those that are given, the most first; equal ones stand together."""
    largest_share = units.groupby("unit")["share_s"].max().sort_values(ascending=False, kind="stable")
    groups: dict[str, list[str]] = {}
    for unit in largest_share.index:
        by_words: dict[str, list[str]] = {}
        for row in units[units["unit"] == unit].itertuples(index=False):
            saved = f"{row.share_s:.2f} s" if abs(row.share_s) >= VISIBLE_S else "nothing"
            by_words.setdefault(saved, []).append(str(row.configuration))
        told = ", ".join(f"{words} in {name_first(of, _NAMED)}" for words, of in by_words.items())
        groups.setdefault(told, []).append(str(unit))
    shown = [f"{name_first(of, _NAMED)} save{'s' * (len(of) == 1)} {told}." for told, of in groups.items()]
    return [*shown[:_MOST_SPARED], *(["The other units are in units.csv."] if len(groups) > _MOST_SPARED else [])]


def _tell_late(groups: pd.DataFrame, folder: str, *, one_log: bool) -> list[str]:
    """Sentences on the group of late episodes that costs most, and a command to look at one."""
    if not len(groups):
        return [f"No object is unknown for more than {LATE_S:g} s in 5 % of the runs or more."]
    worst_group = groups.loc[groups["lost_s"].idxmax()]
    where = f" ({worst_group['where']})" if worst_group["where"] else ""
    example_words, count = f"{worst_group['example_class']} {worst_group['example']}", int(worst_group["objects"])
    objects = f"{count_noun(count, 'object')} such as {example_words}" if count > 1 else example_words
    objects = objects if worst_group["example"] else f"{count_noun(count, 'object')}, {TOO_SHORT}"
    shown = groups[groups["example"] != ""].sort_values("lost_s", ascending=False, kind="stable").head(1)
    structure_words = describe_structure(float(worst_group["structural_share"]))
    return [
        f"Most is lost in {worst_group['configuration']}: {worst_group['lost_s']:.1f} s, {objects}: "
        f"{describe_cause(str(worst_group['cause']))}{where}{structure_words}.",
        *(
            f"    copem-replay view {folder} --object {row.example}" + ("" if one_log else f" --log {row.log}")
            for row in shown.itertuples()
        ),
    ]


def _tell_orders(varied: pd.DataFrame, orders: pd.DataFrame) -> list[str]:
    """Whether configurations keep their order as the models vary; of one, for how long it is unknown then."""
    variations = [name for name in varied["variation"].unique() if name != AS_IT_IS]
    if varied["configuration"].nunique() < 2:
        means_s = varied.groupby("variation")["unknown_s"].mean()
        return [f"As the PEMs vary it is unknown for {means_s.min():.2f} to {means_s.max():.2f} s."]
    if not orders["beyond"].any():
        return [f"Their order stays as PEMs vary: detection {', '.join(variations)}."]
    return describe_orders(varied, orders)

"""What `require` prints, on 80 columns, and writes: a table, a figure, and the experiment with the required value."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from copem_replay.api.study import AnyPath
from copem_replay.core.errors import count_noun, escape_unprintable, name_first
from copem_replay.core.yaml import dump_yaml
from copem_replay.extras.require.api import Requirement
from copem_replay.metrics.summary import format_table
from copem_replay.report.figures.style import FAINT, INK, add_note, figure_style, new_figure, render_figure
from copem_replay.results.outputs import made_files
from copem_replay.results.verdicts import MET, NOT_MEASURED, NOT_MET, UNDECIDED
from copem_replay.results.write import relocate_experiment

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

EXPERIMENT = "required.yaml"
WORDS = {MET: "holds", UNDECIDED: "undecided", NOT_MET: "does not hold", NOT_MEASURED: "not measured"}
_MOST_REASONS = 4
_FILES = ("require.csv", "require.png", EXPERIMENT)
_MADE_BY = "# Made by copem-replay require: "
_GROUNDS = {MET: "#cfe8d5", UNDECIDED: "#e6e6e6", NOT_MET: "#f3d3cc"}
_COLOURS = ("#1f5fa8", "#b1560f", "#3d7d3a", "#8a3a8a", "#555555", "#a08000")


def describe_criterion(needed: Requirement) -> Iterator[str]:
    """What is asked of which configurations; the path of each key, and the values that may be tried."""
    names = list(dict.fromkeys(one.configuration for one in needed.trials[0].verdicts))
    yield f"{needed.named}: {needed.trials[0].verdicts[0].asked}, {name_first(names, 4)}"
    for key in needed.keys:
        yield f"{key.name}: {key.values[0]:g} to {key.values[-1]:g} by {key.values[1] - key.values[0]:g}"


def tabulate_requirement(needed: Requirement, width: int | None = None) -> list[str]:
    """A table, of one key the verdicts one after the other, of two the front; and how many values were tried."""
    rows = _list_segments(needed) if len(needed.keys) == 1 else _list_front(needed)
    number, monotone = count_noun(len(needed.trials), "value"), "monotone" if needed.monotone else "not monotone"
    tried = f"{number} tried of {needed.levels.size}, on the same draws: {monotone}"
    return [*format_table(pd.DataFrame(rows), width).splitlines(), "", tried]


def _join(texts: Iterable[str]) -> str:
    return " … ".join(dict.fromkeys(texts))


def _list_segments(needed: Requirement) -> Iterator[dict[str, str]]:
    for word, of in needed.segments:
        ends = (of[0], of[-1])
        row = {needed.keys[0].about: _join(f"{one.values[0]:g}" for one in ends), "criterion": WORDS[word]}
        if len(of[0].verdicts) == 1:
            row |= {"found": _join(one.verdicts[0].found for one in ends)}
            row |= {f"{100 * needed.criterion.confidence:g} %": _join(one.verdicts[0].limits for one in ends)}
        yield row


def _list_front(needed: Requirement) -> Iterator[dict[str, str]]:
    """Rows of a table: by values of the first key, up to or from which value of the second it holds and does not."""
    (first, second), largest = needed.keys, needed.wants[1] == "largest"
    holds, fails = ("holds up to", "not from") if largest else ("holds from", "not up to")
    values = np.array(second.values)

    def tell(k: int) -> tuple[str, ...]:
        ends = (values[needed.levels[k] == 3], -1 if largest else 0), (values[needed.levels[k] == 0], largest - 1)
        return tuple(f"{of[end]:g}" if len(of) else "–" for of, end in ends)

    for told, alike in groupby(range(len(first.values)), key=tell):
        span = [first.values[k] for k in alike]
        shown = _join(f"{value:g}" for value in (span[0], span[-1]))
        yield {first.about: shown, f"{second.about}: {holds}": told[0], fails: told[1]}


def tell_requirement(needed: Requirement) -> Iterator[str]:
    """The sentences of the answer."""
    words = {one.word for one in needed.trials}
    if len(words) == 1:
        yield _tell_throughout(needed, *words)
    elif len(needed.keys) == 1:
        yield from _tell_ends(needed)
    if not needed.monotone:
        yield "It is not monotone: the verdict changes back, and may do so unseen between values that were not tried."
    yield from _tell_undecided(needed)
    if needed.required is None:
        yield "No value that was tried passes."
    elif len(needed.keys) > 1:
        yield f"{EXPERIMENT} has {needed.name_values(needed.required)}, which passes, of the front."
    else:
        what = "value that passes" if needed.monotone else "of the first values that pass"
        yield f"{EXPERIMENT} has {needed.name_values(needed.required)}, the {needed.wants[0]} {what}."


def _tell_throughout(needed: Requirement, word: str) -> str:
    spans = " and ".join(f"{key.about} {key.values[0]:g} to {key.values[-1]:g}" for key in needed.keys)
    figures = {(one.configuration, one.group, one.estimate) for trial in needed.trials for one in trial.verdicts}
    alike = f": {needed.criterion.metric} is the same throughout" * (len(figures) == len(needed.trials[0].verdicts))
    return f"It {'is ' * (word not in (MET, NOT_MET))}{WORDS[word]} at every value, {spans}{alike}."


def _tell_ends(needed: Requirement) -> Iterator[str]:
    """`It holds up to latency_s 0.74; it does not hold from 0.78 on; it is undecided between.`"""
    largest, parts = needed.wants[0] == "largest", ["It holds nowhere"]
    ordered = needed.segments if largest else [(word, of[::-1]) for word, of in reversed(needed.segments)]
    first_met = next((k for k, (word, _) in enumerate(ordered) if word == MET), None)
    first_not_met = next((k for k, (word, _) in enumerate(ordered) if word == NOT_MET and k >= (first_met or 0)), None)
    if first_met is not None:
        held = needed.name_values(ordered[first_met][1][-1].values)
        parts = [f"It holds up to {held}" if largest else f"It holds from {held} on"]
    if first_not_met is not None:
        refuted = f"{ordered[first_not_met][1][0].values[0]:g}"
        parts.append(f"it does not hold from {refuted} on" if largest else f"it does not hold up to {refuted}")
    words = {word for word, _ in ordered}
    if words - {MET, NOT_MET}:
        side = "between" if {MET, NOT_MET} <= words else "above that" if largest == (MET in words) else "below that"
        before = (f"{value:g}" for _, of in ordered[: first_met or 0] for value in of[0].values)
        parts.append(f"it is undecided {' and at '.join([side, *before])}")
    yield f"{'; '.join(parts)}."
    is_good = [one.level >= 2 for one in needed.trials]
    turn_ix = [k for k in range(1, len(is_good)) if is_good[k] != is_good[k - 1]]
    if len(turn_ix) == 1 and UNDECIDED in words:
        low, high = (needed.trials[k].values[0] for k in (turn_ix[0] - 1, turn_ix[0]))
        yield f"The figure itself crosses its bound between {low:g} and {high:g}."


def _tell_undecided(needed: Requirement) -> Iterator[str]:
    """What would decide, or why nothing does, at both ends of what is undecided; of two keys at one pair of values."""
    trials = [one for one in needed.trials if one.word in (UNDECIDED, NOT_MEASURED)]
    told = dict[str, str]()
    for trial in trials[len(trials) // 2 :][:1] if len(needed.keys) > 1 else trials[:: max(len(trials) - 1, 1)]:
        for one in trial.verdicts:
            if one.verdict in (UNDECIDED, NOT_MEASURED):
                why = next((part for part in one.why.split("; ") if "decide" in part), one.why)
                of = f" ({one.configuration}{one.group and f', {one.group}'})" if len(trial.verdicts) > 1 else ""
                told.setdefault(f"{of}: {why}.", f"{one.verdict.capitalize()} at {needed.name_values(trial.values)}")
    yield from list(map("".join, zip(told.values(), told, strict=True)))[:_MOST_REASONS]


def requirement_figure(needed: Requirement) -> Figure:
    """The figure of one key, or of two."""
    with figure_style():
        axes = (figure := new_figure(7.2, 4.4)).subplots()
        (_draw_values if len(needed.keys) == 1 else _draw_front)(axes, needed)
        axes.set_xlabel(needed.keys[0].name)
        axes.set_title(next(describe_criterion(needed)), loc="left")
        add_note(figure, list(tell_requirement(needed)))
    return figure


def _draw_values(axes: Axes, needed: Requirement) -> None:
    """Draw for each verdict a line with its intervals, the bound, and behind them what holds."""
    left, right = _draw_grounds(axes, needed)
    lines: dict[str, list[tuple[float, ...]]] = {}
    for trial in needed.trials:
        for one in trial.verdicts if left <= trial.values[0] <= right else ():
            numbers = (np.nan if of is None else of for of in (one.estimate, one.low, one.high))
            lines.setdefault(f"{one.configuration} {one.group}", []).append((trial.values[0], *numbers))
    for colour, (name, points) in zip(_COLOURS, lines.items(), strict=False):
        value, estimate, low, high = np.array(points).T
        axes.vlines(value, np.fmin(low, estimate), np.fmax(high, estimate), color=colour, linewidth=1.2, alpha=0.6)
        axes.plot(value, estimate, color=colour, marker="o", markersize=3.5, linewidth=1.2, label=name)
    axes.axhline(needed.criterion.bound, color=INK, linewidth=0.9, linestyle=(0, (5, 3)))
    axes.set_ylabel(needed.trials[0].verdicts[0].asked)
    if len(lines) > 1:
        axes.legend(loc="best")


def _draw_grounds(axes: Axes, needed: Requirement) -> tuple[float, float]:
    """Draw bands of what holds and does not, hatched between. Returns the ends of the axis, beside the changes."""
    low, high = needed.keys[0].values[0], needed.keys[0].values[-1]
    ends = [(word, of[0].values[0], of[-1].values[0]) for word, of in needed.segments]
    changes = [x for _, *of in ends for x in of][1:-1] or [low, high]
    beside = max(changes[-1] - changes[0], (high - low) / 8)
    left, right = max(low, changes[0] - beside), min(high, changes[-1] + beside)
    axes.axvspan(left, right, facecolor=_GROUNDS[UNDECIDED], edgecolor="0.8", hatch="///", linewidth=0, zorder=0)
    for word, begin, end in ((word, max(begin, left), min(end, right)) for word, begin, end in ends):
        if word in (MET, NOT_MET):
            axes.axvspan(begin, end, facecolor=_GROUNDS[word], linewidth=0, zorder=0.5)
        turn = 0 if end - begin > (right - left) / 8 else 90
        place: dict[str, Any] = {"transform": axes.get_xaxis_transform(), "ha": "center", "va": "top", "rotation": turn}
        axes.text((begin + end) / 2, 0.985, WORDS[word], color=FAINT, fontsize=8, **place)
    axes.set_xlim(left, right)
    return left, right


def _draw_front(axes: Axes, needed: Requirement) -> None:
    """Draw what holds at each pair of values; dots: pairs that were tried; a star: that of required.yaml."""
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    (first, second), words = needed.keys, (needed.levels.T + 1) // 2
    colours = ListedColormap([_GROUNDS[word] for word in (NOT_MET, UNDECIDED, MET)])
    axes.pcolormesh(first.values, second.values, words, cmap=colours, vmin=0, vmax=2, shading="nearest", zorder=0)
    x, y = np.transpose([trial.values for trial in needed.trials])
    axes.scatter(x, y, s=4, color=FAINT, zorder=2, linewidths=0)
    handles: list[Any] = [Patch(color=_GROUNDS[word], label=WORDS[word]) for word in (MET, UNDECIDED, NOT_MET)]
    if needed.required is not None:
        place = np.transpose([needed.required])
        handles.append(axes.scatter(*place, marker="*", color=INK, zorder=3, label=EXPERIMENT))
    axes.set_ylabel(second.name)
    axes.grid(visible=False)
    axes.legend(handles=handles, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def write_requirement(needed: Requirement, folder: AnyPath) -> list[Path]:
    """Write require.csv, require.png and, where a value passes, required.yaml: all or none. Returns their paths.

    Raises OutputError: the folder is no place for them, or has files of these names that are not from here.

    >>> key = "configurations.both.latency_s=0:5:1"
    >>> needed = cr.require("logs/crossing_required.yaml", criterion="sooner than alone", free=[key])
    >>> [path.name for path in cr.write_requirement(needed, "out/required")]
    ['require.csv', 'require.png', 'required.yaml']
    """
    place, experiment = Path(folder), needed.experiment
    picture = render_figure(requirement_figure(needed), [".png"])[".png"]
    with made_files(place, _FILES, place.parent, is_own=_is_required) as scratch:
        needed.table.to_csv(scratch / "require.csv", index=False, lineterminator="\n")
        (scratch / "require.png").write_bytes(picture)
        if experiment is not None and needed.required is not None:
            head = f"{_MADE_BY}{', '.join(key.name for key in needed.keys)}: {needed.name_values(needed.required)}"
            text = dump_yaml(relocate_experiment(experiment, needed.study.logs, place))
            content = f"{escape_unprintable(head)}\n{text}"
            (scratch / EXPERIMENT).write_text(content, encoding="utf-8", newline="\n")
    return [place / name for name in _FILES if name != EXPERIMENT or experiment is not None]


def _is_required(path: Path) -> bool:
    """Whether a file is an experiment that was written here, and may be replaced."""
    with path.open("rb") as file:
        return file.read(len(_MADE_BY)) == _MADE_BY.encode()

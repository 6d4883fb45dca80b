"""Figure of the trade-off between knowing sooner and braking for nothing, a mark per configuration.

Seconds sooner than the car alone, over the rows of each pair as in the table of differences, against the share of the
driving time in which the driver brakes for nothing. Better is lower and farther to the right. Where entries claim
different existences, a line leads to what would be if only entries of more existence were listed: from
`thresholds.parquet` and `needless_s_at`, without another replay.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from copem_replay.core.tracks import Float
from copem_replay.metrics.braking.driving import SHARE
from copem_replay.metrics.row_figures import detection_endings
from copem_replay.metrics.survival import cumulative_incidence, restricted_mean
from copem_replay.report.figures.style import (
    RANKED_BY,
    add_note,
    choose_appearances,
    describe_results,
    figure_style,
    find_contenders,
    mark_configuration,
    new_figure,
    number_marks,
    shorten_names,
)
from copem_replay.results.compare import compare_folders
from copem_replay.results.compare.labels import find_alone

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from copem_replay.results.read import Results


_WIDE_IN, _HIGH_IN = 8.0, 4.0
_MARK_PT = 7.0
_NEAR_S, _NEAR_SHARE = 0.02, 0.05
"""Seconds, and part of the share, by which marks differ that cover each other: a fraction of a mark."""
_MOST_ROWS = 200_000
"""Of more rows no lines are drawn: they would take longer than all other figures."""
_KEYS = ["run", "object_id", "episode"]


def no_trade_off(results: Results, names: Sequence[str]) -> str | None:
    """The reason why the figure cannot be drawn, "" if it need not be given; None if it can."""
    if SHARE not in results.summary or not results.summary[SHARE].any():
        return ""  # nobody brakes for nothing
    return None if len(find_contenders(results, names)) > 1 else ""


def trade_off_figure(results: Results, *, configurations: Sequence[str] | None = None) -> Figure:
    """Seconds sooner than the car alone against the time braking for nothing; lower right is better."""
    names = list(find_contenders(results, results.chosen(configurations)))
    alone = find_alone(results, names) or names[0]
    compared = compare_folders([results], configurations=names, baseline=alone, metrics=[RANKED_BY]).overall
    sooner_s = {alone: 0.0} | dict(zip(compared["configuration"], -compared["difference"].astype(float), strict=True))
    share = 100 * results.summary.set_index("configuration")[SHARE].astype(float)
    names = [name for name in names if np.isfinite(sooner_s.get(name, np.nan)) and np.isfinite(share[name])]
    looks, short = choose_appearances(results), shorten_names(names)
    lines = {name: _sweep_existence(results, name) for name in names}
    with figure_style():
        figure = new_figure(_WIDE_IN, _HIGH_IN + 0.06 * max(len(names) - 8, 0))
        axes = figure.subplots()
        places = {name: (sooner_s[name], share[name]) for name in names}
        for k, name in enumerate(names):
            look, later = looks[name], [places[other] for other in names[k + 1 :]]
            size_pt = _MARK_PT * (1 + 0.5 * sum(_cover(places[name], place) for place in later))
            with mark_configuration(list(looks).index(name), axes):
                if (line := lines[name]) is not None:
                    axes.plot(sooner_s[name] + line[0], line[1], color=look.colour, linewidth=1, zorder=2)
                axes.scatter(
                    [sooner_s[name]], [share[name]], s=size_pt**2, marker=look.marker, facecolor=look.colour,
                    zorder=3, label=name, clip_on=False,
                )  # fmt: skip
        _set_scales(axes, share[names].to_numpy())
        axes.set_xlabel(f"Known sooner than with {shorten_names([alone])[alone]} (s)")
        axes.set_ylabel("Time braking for nothing (%)")
        swept = any(line is not None for line in lines.values())
        add_note(
            figure,
            [
                describe_results(results, names),
                "Better towards the lower right; marks at one place lie within each other",
                "Intervals: copem-replay compare",
                "Lines: only entries of more and more existence" if swept else "",
            ],
        )
        number_marks(figure, axes, [short[name] for name in names], _MARK_PT)
    return figure


def _cover(first: tuple[float, float], other: tuple[float, float]) -> bool:
    """Whether two marks lie so near to each other that the first would not be seen."""
    return abs(first[0] - other[0]) < _NEAR_S and bool(np.isclose(first[1], other[1], rtol=_NEAR_SHARE, atol=0.0))


def _set_scales(axes: Axes, share: Float) -> None:
    """Shares far apart logarithmically, with 0 at the foot."""
    above = share[share > 0]
    if len(above) and above.max() > 20 * above.min():
        axes.set_yscale("symlog", linthresh=float(above.min()), linscale=0.3)
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set_ylim(0.0, 1.3 * float(share.max(initial=0.0)) or 1.0)


def _sweep_existence(results: Results, name: str) -> tuple[Float, Float] | None:
    """By ascending existence (T,): seconds sooner than with all entries, % braking for nothing; None: no change."""
    if results.rows.counts and sum(results.rows.counts.values()) > _MOST_ROWS * len(results.experiment.configurations):
        return None
    lists = results.frame("lists.parquet")
    lists = lists[lists["configuration"] == name]
    existence, share = np.array(lists["existence"].iloc[0]), np.stack(lists["needless_s_at"].to_list()).sum(axis=0)
    share = 100 * share / float(lists["driving_s"].sum())
    steps = results.frame("thresholds.parquet")
    steps = steps[steps["configuration"] == name]
    horizon_s = results.provenance.horizon_used_s
    is_listed = existence <= steps["existence"].max()  # beyond, nothing is listed
    existence, share = existence[is_listed], share[is_listed]
    if len(existence) < 2:
        return None
    mean_s = _mean_times_s(results, name, steps, existence, horizon_s)
    is_change = np.concatenate([[True], (np.diff(mean_s) != 0) | (np.diff(share) != 0)])
    return (mean_s[0] - mean_s[is_change], share[is_change]) if is_change.sum() > 1 and share.any() else None


def _mean_times_s(results: Results, name: str, steps: pd.DataFrame, existence: Float, horizon_s: float) -> Float:
    """(T,) mean time to detection (s) up to the horizon, with only entries of at least each `existence`."""
    times_and_endings = [(list[Float](), list[np.ndarray]()) for _ in existence]
    for log in results.rows.logs:
        (rows,) = results.each("configuration", *_KEYS, "onset_s", "ended_s", "ended_by", log=log)
        rows, log_steps = rows[rows["configuration"] == name], steps[steps["log"] == log]
        row_of_step = pd.MultiIndex.from_frame(rows[_KEYS]).get_indexer(pd.MultiIndex.from_frame(log_steps[_KEYS]))
        detection_s, onset_s = log_steps["detection_s"].to_numpy(), rows["onset_s"].to_numpy()
        for at, (times, endings) in zip(existence, times_and_endings, strict=True):
            is_counted = (row_of_step >= 0) & (log_steps["existence"].to_numpy() >= at)
            known_s = np.full(len(rows), np.nan)
            np.fmin.at(known_s, row_of_step[is_counted], detection_s[is_counted])
            time_s, ending = detection_endings(rows.assign(time_to_detection_s=known_s - onset_s))
            times.append(np.round(time_s, 9))
            endings.append(ending)
    rounded = ((np.concatenate(times), np.concatenate(endings)) for times, endings in times_and_endings)
    return np.array([restricted_mean(*cumulative_incidence(*each), horizon_s) for each in rounded])

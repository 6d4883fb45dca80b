"""How long misses last: runs of them as recorded, as the fitted model makes them, and as one without memory would."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.report.figures.style import add_note, new_figure, style
from copem_replay.report.fit.kind import FitFigure
from copem_replay.report.fit.study import FITTED, MEMORYLESS, RECORDED, FitStudy

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_REPEATS = 200
_MOST = 20_000
"""Rows that are drawn again (chosen)."""


def miss_runs_figure(study: FitStudy) -> Figure:
    """How many runs of misses per pass are at least so long."""
    first = study.first_rows
    step = max(len(study.rows.log) // _MOST, 1)
    passes = np.arange(0, len(first) - 1, step)
    rows = np.concatenate([np.arange(first[p], first[p + 1]) for p in passes])
    new = np.isin(rows, first[passes])
    listed, p = study.rows.listed[rows], study.probability[rows]
    gap_s = np.diff(study.rows.captured_s[rows], prepend=0.0)
    memory = study.detection.memory
    share, tau_s = (0.0, 1.0) if memory is None else (memory["share"].value, memory["correlation_s"].value)
    drawn = {"fitted": _drawn(p, gap_s, new, share, tau_s), "without memory": _drawn(p, gap_s, new, 0.0, 1.0)}
    if share == 0:
        del drawn["fitted"]
    recorded = _longer(~listed[:, None], new)
    with style():
        figure = new_figure(6.4, 3.6)
        axes = figure.subplots()
        least = 0.3 / len(passes)
        for (name, hits), colour in zip(drawn.items(), (FITTED, MEMORYLESS)[-len(drawn) :], strict=True):
            each = _longer(~hits, new)
            low, high = np.quantile(each, [0.025, 0.975], axis=1)
            mean = each.mean(axis=1)
            lengths = np.arange(1, len(mean) + 1)
            axes.fill_between(lengths, np.maximum(low, 0.5) / len(passes), np.maximum(high, 0.5) / len(passes),
                              step="mid", color=colour, alpha=0.25, linewidth=0)  # fmt: skip
            there = mean / len(passes) > least
            axes.plot(lengths[there], mean[there] / len(passes), color=colour, linewidth=1.8, label=name)
        of = recorded[:, 0]
        axes.plot(np.arange(1, len(of) + 1), of / len(passes), color=RECORDED, marker="o", markersize=3.5,
                  linewidth=1.2, label="recorded")  # fmt: skip
        axes.set_xscale("log")
        axes.set_yscale("log")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(lambda value, _: f"{value:g}")
            axis.set_minor_formatter("")
        axes.set_ylim(bottom=least)
        axes.set_xlim(0.9, max(len(of), 8) * 1.4)
        axes.set_xlabel("At least so many misses in a row (lists)")
        axes.set_ylabel("Runs per pass")
        axes.legend(loc="upper right")
        add_note(figure, [f"{len(passes)} passes; lines: mean of {_REPEATS} repetitions, bands hold 95 % of them"])
    return figure


def _drawn(p: Float, gap_s: Float, new: Bool, share: float, tau_s: float) -> Bool:
    """(R, repeats) hits of a model that goes by a held number with probability `share`; a fixed stream of numbers."""
    rng = np.random.default_rng(0)
    hits = rng.uniform(size=(len(p), _REPEATS)) < p[:, None]
    if share == 0:
        return hits
    held = rng.uniform(size=_REPEATS)
    stays = np.where(new, 0.0, np.exp(-gap_s / tau_s))
    for k in range(len(p)):
        held = np.where(rng.uniform(size=_REPEATS) < stays[k], held, rng.uniform(size=_REPEATS))
        hits[k] = np.where(rng.uniform(size=_REPEATS) < share, held < p[k], hits[k])
    return hits


def _longer(missed: Bool, new: Bool) -> Int:
    """(lengths, columns) how many runs of misses are at least 1, 2, … rows long."""
    run, out = np.zeros(missed.shape[1], dtype=np.int64), np.zeros((1, missed.shape[1]), dtype=np.int64)
    columns = np.arange(missed.shape[1])
    for k in range(len(missed)):
        run = np.where(missed[k], (0 if new[k] else run) + 1, 0)
        if (longest := int(run.max(initial=0))) > len(out):
            out = np.vstack([out, np.zeros((longest - len(out), missed.shape[1]), dtype=np.int64)])
        on = run > 0
        out[run[on] - 1, columns[on]] += 1
    return out


MISS_RUNS = FitFigure(
    "How long misses last",
    "number of runs of misses per pass over their length, recorded, fitted and without memory",
    "How often an object is missed in at least so many lists in a row. Recorded points within the band of the fitted "
    "model: its misses last as long as the recorded ones. A model without memory has the same share of misses, but "
    "falls off too fast where misses last.",
    miss_runs_figure,
    lambda study: f"no miss in {len(study.rows.log)} rows" if study.rows.listed.all() else None,
)

"""Figure of slices: a heat map of groups × configurations for each entry, the mean time to detection in every cell."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from copem_replay.core.errors import InputError, count_noun
from copem_replay.report.figures.style import (
    INK,
    RANKED_BY,
    WHITE,
    add_note,
    contrast_ratio,
    figure_style,
    format_three_digits,
    new_figure,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

    from copem_replay.results.read import Results


MOST_GROUPS = 40
"""Most groups of an entry in a heat map; the rest are in `summary_by.csv`."""
_ROW_IN, _COLUMN_IN = 0.21, 0.95
_NONE = (0.93, 0.93, 0.93)
"""Colour of cells without a value."""


def slices_figure(
    results: Results, sliced: pd.DataFrame | None, *, configurations: Sequence[str] | None = None, linked: bool = False
) -> Figure:
    """A heat map for each entry of rows of `summary_by.csv`, one colour scale for all: darker is later.

    Of an entry with many groups those that detect latest are drawn. `linked`: drives are links to `drive-N`, N being
    the log's number. Raises InputError without rows.
    """
    names = results.chosen(configurations)
    if sliced is None or not len(sliced):
        raise InputError(f"{results.place}: no slices; `--by class` or `measure: {{by: [class]}}` gives some")
    tables = {str(by): _pivot_times(rows, names) for by, rows in sliced.groupby("by", sort=False)}
    shown = {by: _take_latest(table) for by, table in tables.items()}
    most_s = max(
        [float(np.nanmax(table.to_numpy())) for table in shown.values() if table.notna().any(axis=None)] or [1]
    )
    heights = [_ROW_IN * len(table) + 0.8 for table in shown.values()]
    links = {log.name: f"#drive-{k}" for k, log in enumerate(results.provenance.logs)} if linked else {}
    with figure_style():
        import matplotlib

        colours = matplotlib.colormaps["Blues"]
        longest = max(len(group) for table in shown.values() for group in table.index)
        figure = new_figure(max(4.0, 0.6 + 0.075 * longest + _COLUMN_IN * len(names)), sum(heights) + 0.5)
        panels = figure.subplots(
            len(shown), 1, squeeze=False, height_ratios=[len(table) or 1 for table in shown.values()]
        )[:, 0]
        for axes, (by, table) in zip(panels, shown.items(), strict=True):
            axes.set_title(f"by {by}", loc="left")
            _draw_cells(axes, table, most_s or 1.0, colours, links if by == "log" else {})
        horizon = sliced["ttd_rmst_horizon_s"].dropna()
        upto = f", at most {format_three_digits(float(horizon.iloc[0]))} s" if len(horizon) else ""
        add_note(figure, [f"Known after, mean, in seconds{upto}; darker is later", *_describe_left_out(tables, shown)])
    return figure


def _pivot_times(rows: pd.DataFrame, names: Sequence[str]) -> pd.DataFrame:
    """Groups × configurations: mean times in seconds, NaN where nothing counts, without groups where nothing does."""
    times = rows.pivot(index="group", columns="configuration", values=RANKED_BY).reindex(rows["group"].unique())
    return times.reindex(columns=list(names)).astype(float).dropna(how="all")


def _take_latest(table: pd.DataFrame) -> pd.DataFrame:
    if len(table) <= MOST_GROUPS:
        return table
    return table.loc[table.mean(axis=1).sort_values(ascending=False, kind="stable").index[:MOST_GROUPS]]


def _describe_left_out(tables: dict[str, pd.DataFrame], shown: dict[str, pd.DataFrame]) -> list[str]:
    return [
        f"By {by}: the {len(shown[by])} latest of {count_noun(len(table), 'group')}"
        for by, table in tables.items()
        if len(table) > len(shown[by])
    ]


def _draw_cells(axes: Axes, table: pd.DataFrame, most_s: float, colours: Colormap, links: dict[str, str]) -> None:
    """Draw a cell with its number (s) for each group and configuration; `most_s`: of the darkest; `links`: by group."""
    times_s = table.to_numpy()
    shades = colours(0.85 * np.nan_to_num(times_s) / most_s)[..., :3]
    shades[np.isnan(times_s)] = _NONE
    axes.imshow(shades, aspect="auto", interpolation="nearest")
    axes.set_xticks(range(len(table.columns)), [_break_name(name) for name in table.columns])
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    axes.set_yticks(range(len(table)), list(table.index))
    for label in axes.get_yticklabels():
        label.set_url(links.get(label.get_text()))
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    for (row, column), time_s in np.ndenumerate(times_s):
        shade = tuple(float(channel) for channel in shades[row, column])
        dark = contrast_ratio((shade[0], shade[1], shade[2]), INK) < contrast_ratio(
            (shade[0], shade[1], shade[2]), WHITE
        )
        text = "–" if np.isnan(time_s) else format_three_digits(time_s)
        axes.text(column, row, text, ha="center", va="center", color=WHITE if dark else INK, fontsize=7.5)


def _break_name(name: str) -> str:
    """A name in lines of about 12 characters."""
    import textwrap

    return "\n".join(textwrap.wrap(name, 14)) or name

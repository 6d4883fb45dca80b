"""How well the delay of the lists is told: how probable the errors are at other delays."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.tracks import Float
from copem_replay.report.figures.style import FAINT, add_note, new_figure, style
from copem_replay.report.fit.kind import FitFigure
from copem_replay.report.fit.study import FITTED, RECORDED, FitStudy

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from copem_replay.pipeline.fit.rows import FitRows

_AROUND_S = 0.3
_MOVING_MPS = 1.0


def delay_figure(study: FitStudy) -> Figure:
    """The root mean square of the errors, and of what is left of it without their mean, over the delay."""
    rows = _moving(study)
    delays = study.delay_s + np.linspace(-_AROUND_S, _AROUND_S, 61)
    plain, centred = _rmse(rows.east_m, rows.north_m, rows.view.yaw_rad, rows.view.speed_mps, delays - study.delay_s)
    with style():
        figure = new_figure(6.4, 3.2)
        axes = figure.subplots()
        axes.axvline(study.delay_s, color=FAINT, linewidth=1.0, dashes=(4, 2))
        axes.plot(delays, plain, color=RECORDED, linewidth=1.8, label="errors")
        axes.plot(delays, centred, color=FITTED, linewidth=1.8, dashes=(5, 1.6), label="without a shift along the way")
        axes.set_ylim(0, 1.05 * float(plain.max()))
        axes.set_xlabel("Delay of the lists (s)")
        axes.set_ylabel("Position error (RMSE, m)")
        axes.legend(loc="lower right")
        taken = f"dashed: {study.delay_s:.3g} s, which is taken"
        add_note(figure, [f"{len(rows.log)} entries of objects faster than {_MOVING_MPS:g} m/s; {taken}"])
    return figure


def _moving(study: FitStudy) -> FitRows:
    rows = study.rows
    return rows.take(rows.listed & np.isfinite(rows.east_m) & (rows.view.speed_mps > _MOVING_MPS))


def _rmse(east_m: Float, north_m: Float, yaw_rad: Float, speed_mps: Float, later_s: Float) -> tuple[Float, Float]:
    """(K,) each, if lists were captured so much earlier than is taken: then the object was that much less far."""
    ahead = east_m * np.cos(yaw_rad) + north_m * np.sin(yaw_rad)
    aside = north_m * np.cos(yaw_rad) - east_m * np.sin(yaw_rad)
    moved = ahead + speed_mps * later_s[:, None]
    left = moved - moved.mean(axis=1)[:, None]
    return np.sqrt((moved**2 + aside**2).mean(axis=1)), np.sqrt((left**2 + aside**2).mean(axis=1))


def _too_few(study: FitStudy) -> str | None:
    n = len(_moving(study).log)
    return None if n >= 10 else f"{n} entries are of objects faster than {_MOVING_MPS:g} m/s"


DELAY = FitFigure(
    "How late are the lists?",
    "root mean square position error over the assumed delay",
    "A wrong delay shifts entries along the way of moving objects. The narrower the valley, the better the delay is "
    "told. Where only the first line has one, a delay cannot be told from a shift of all entries along the way: "
    "speeds vary too little.",
    delay_figure,
    _too_few,
)

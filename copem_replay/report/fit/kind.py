"""What a figure of a fit is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from copem_replay.report.fit.study import FitStudy

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def _nothing_missing(study: FitStudy) -> str | None:
    return None


@dataclass(frozen=True)
class FitFigure:
    """A figure. `title`: its heading. `shows`: for readers who cannot see it. `about`: in plain words, below it.

    `missing`: the reason why there is none, None: there is one.
    """

    title: str
    shows: str
    about: str
    draw: Callable[[FitStudy], Figure]
    missing: Callable[[FitStudy], str | None] = _nothing_missing

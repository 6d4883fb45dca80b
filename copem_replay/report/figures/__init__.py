"""Figures of a results folder, each by a function from results to a matplotlib Figure.

`FIGURES` (`registry.py`) has them all, and `write_figure_files` writes them. matplotlib is imported with the first
figure, pyplot never.
"""

from __future__ import annotations

from copem_replay.report.figures.registry import FIGURES, FigureKind
from copem_replay.report.figures.selection import Selection

__all__ = ["FIGURES", "FigureKind", "Selection"]

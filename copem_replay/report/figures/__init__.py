"""Plot: figures from a results folder, each by a function that takes the results and gives a matplotlib Figure.

They are the rows of `FIGURES` (`registry.py`); `write.py` makes the files. Nothing of matplotlib is imported before a
figure is asked for, and pyplot never is.
"""

from copem_replay.report.figures.registry import FIGURES, FigureKind
from copem_replay.report.figures.selection import Selection

__all__ = ["FIGURES", "FigureKind", "Selection"]

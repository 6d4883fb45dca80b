"""Plot: figures from a results folder, each by a function that takes the results and gives a matplotlib Figure.

| function | shows |
|---|---|
| `answer_figure` | mean time to detection and share that passes, a dot with its interval per configuration |
| `differences_figure` | each configuration minus a baseline, with intervals and the line of 0 |
| `trade_off_figure` | false positives per minute over the position error |
| `runs_figure` | one run in up to four configurations: speed, distance, visible share, and what happened when |
| `distances_figure` | distance at detection of every row, a strip per configuration, pass and fail told apart |
| `curves_figure` | share detected over the time since the onset, with 95 % bands |
| `latency_breakdown_figure` | mean duration of the stages from the onset to the detection |
| `sweeps_figure` | shares and times over what was swept, where the folder has a `sweep.csv` |

They are the rows of `FIGURES` (`registry.py`); `write_figures` makes the files. Nothing of matplotlib is
imported before a figure is asked for, and pyplot never is.
"""

from typing import TYPE_CHECKING, Any

from copem_replay.report.figures.answer import answer_figure
from copem_replay.report.figures.detection_curves import curves_figure
from copem_replay.report.figures.differences import differences_figure
from copem_replay.report.figures.distances import distances_figure
from copem_replay.report.figures.latency_breakdown import latency_breakdown_figure
from copem_replay.report.figures.registry import FIGURES, FigureKind, Selection
from copem_replay.report.figures.sweeps import sweeps_figure
from copem_replay.report.figures.trade_off import trade_off_figure
from copem_replay.report.figures.write import write_figures
from copem_replay.results.read import Results, load_results

if TYPE_CHECKING:
    from copem_replay.report.figures.single_runs import runs_figure

__all__ = [
    "FIGURES",
    "FigureKind",
    "Results",
    "Selection",
    "answer_figure",
    "curves_figure",
    "differences_figure",
    "distances_figure",
    "latency_breakdown_figure",
    "load_results",
    "runs_figure",
    "sweeps_figure",
    "trade_off_figure",
    "write_figures",
]


def __getattr__(name: str) -> Any:
    """`runs_figure`, with all that replays a run, when it is first asked for."""
    if name == "runs_figure":
        from copem_replay.report.figures import single_runs

        return single_runs.runs_figure
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

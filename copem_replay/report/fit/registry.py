"""All figures of a fit, a row each: one more diagnostic is one file and one row."""

from __future__ import annotations

from copem_replay.report.fit.autocorrelation import AUTOCORRELATION
from copem_replay.report.fit.calibration import CALIBRATION
from copem_replay.report.fit.delay_profile import DELAY
from copem_replay.report.fit.error_map import ERROR_MAP
from copem_replay.report.fit.gaussian import GAUSSIAN
from copem_replay.report.fit.kind import FitFigure
from copem_replay.report.fit.miss_runs import MISS_RUNS
from copem_replay.report.fit.probability_map import PROBABILITY_MAP
from copem_replay.report.fit.ranks import RANKS
from copem_replay.report.fit.strips import STRIPS

FIT_FIGURES: dict[str, FitFigure] = {
    "ranks": RANKS,
    "calibration": CALIBRATION,
    "probability_map": PROBABILITY_MAP,
    "strips": STRIPS,
    "miss_runs": MISS_RUNS,
    "gaussian": GAUSSIAN,
    "autocorrelation": AUTOCORRELATION,
    "error_map": ERROR_MAP,
    "delay": DELAY,
}
"""By the name of their places in the page, in its order."""

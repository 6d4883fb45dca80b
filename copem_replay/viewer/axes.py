"""From when to when an object is looked at: the time axes of its lanes and curves."""

from __future__ import annotations

import pandas as pd

BEFORE_S, AFTER_S, LEAST_S = 0.5, 0.5, 2.0
"""So much before the onset and after the last detection, and at least so much in all (chosen)."""
UNKNOWN_S = 10.0
"""So much after the onset of an object that no configuration detects (chosen)."""


def axis_s(episodes: pd.DataFrame, end_s: float) -> tuple[float, float]:
    """From 0.5 s before the onset to 0.5 s after the last detection. `episodes`: of one object and run."""
    onset_s = float(episodes["onset_s"].iloc[0])
    detected_s = episodes["detection_s"][episodes["detected"]]
    last_s = float(detected_s.max()) if len(detected_s) else min(float(episodes["ended_s"].max()), onset_s + UNKNOWN_S)
    first_s = max(min(onset_s, float(detected_s.min()) if len(detected_s) else onset_s) - BEFORE_S, 0.0)
    return first_s, min(max(last_s + AFTER_S, first_s + LEAST_S), max(end_s, first_s + AFTER_S))
